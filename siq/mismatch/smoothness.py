"""Smoothness: over which lengths a function changes that what a fit leaves asks for, and how large it is.

Along the trajectories of a fit everything is linear. The likelihood of a smooth function, averaged over
everything that it could be, tells its lengths and its size: one that is too rough could have been too much
else, and one that is too smooth explains too little (MacKay, Neural Computation 4, 415 (1992)).
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from siq.dynamics.dynamics import Dynamics
from siq.estimation.estimation import Fit
from siq.estimation.innovations import Whitened, profile_likelihood, whiten
from siq.estimation.linearisation import Grid
from siq.estimation.measurements import Measurements
from siq.mismatch.evidence import evidences_by_size
from siq.mismatch.function_places import NUMBERS, PlaceColumns
from siq.mismatch.screening import LEVELS, probe_response, projected
from siq.mismatch.smooth_functions import Ground, SmoothFunction, smooth_function, triangle_of
from siq.mismatch.structure import SUBSTEPS
from siq.mismatch.trials import UNFORESEEN

LOGGER = logging.getLogger(__name__)
SHARES = (1 / 16, 1 / 8, 1 / 4, 1 / 2, 1.0, 2.0)  # of the range; over twice of it a function is a parabola
MOST_BUMPS = 100  # a guard on the time of a fit


@dataclass(frozen=True)
class Smoothness:
    """How smooth a function is, as recordings tell it.

    Attributes
    ----------
    shares
        Its lengths, as shares of the ranges of its coordinates.
    deviation
        Its size.
    level
        Of random forces, relative to those of the fit, at which it is likeliest.
    log_evidence
        Logarithm of the odds for such a function, over none, each at its best level; averaged over all
        lengths and sizes.
    considered
        How many lengths and sizes these are.
    """

    shares: tuple[float, ...]
    deviation: float
    level: float
    log_evidence: float
    considered: int


def smoothness_of(
    fit: Fit, data: Measurements, ground: Ground, *, known: Sequence[str] = (), alike: bool = False
) -> Smoothness | None:
    """The likeliest smoothness of a function on top of a fit; None where it cannot be worked out.

    Parameters
    ----------
    fit, data
        The fit along whose trajectories everything is linear, and what it was made for.
    ground
        Where the function stands.
    known
        Parameters of the fit that are a first description of this function, in whose stead it comes.
    alike
        Whether both lengths are the same share of the range.
    """
    least, fine = _finest(ground, data, fit.model)
    grid = Grid(data, fit.substeps if known else min(fit.substeps, SUBSTEPS))
    response = probe_response(fit.model, grid, fit, PlaceColumns(fit.model, grid, [fine]))
    some = [share for share in SHARES if share >= least]
    dimension = len(ground.words)
    choices = [(each,) * dimension for each in some]
    if not alike:
        choices = list(itertools.product(some, repeat=dimension))
    # What processes of these lengths have for values at the finest bumps, as heights of these.
    shapes = [fine.heights_of(triangle_of(fine.centres, np.array(each) * ground.ranges)) for each in choices]
    alone = -np.inf
    values: list[np.ndarray] = []
    best: tuple[float, Smoothness] | None = None
    for level in LEVELS if fit.has_process_noise else (1.0,):
        try:
            white = whiten(response, data, fit.noise.scaled(level))
            left, columns = projected(*_without(white, fit, known))
        except UNFORESEEN as error:
            LOGGER.info("no function of %s can be screened: %s", " and ".join(ground.words), error)
            continue
        freedom = white.degrees_of_freedom - len(fit.model.free) + len(known)
        total = float(left @ left)
        base = profile_likelihood(total, freedom, white.log_determinant)
        alone = max(alone, base)
        gram, overlap = columns.T @ columns, columns.T @ left
        for shares, shape in zip(choices, shapes, strict=True):
            gained, scale, rest = evidences_by_size(
                shape.T @ gram @ shape, shape.T @ overlap, total, freedom=freedom
            )
            values.append(base + gained)
            place = int(np.argmax(gained))
            if best is None or base + gained[place] > best[0]:
                # The scale of the noise was at its best, too, and the size is one in units of it.
                deviation = float(np.sqrt(scale[place] * rest[place] / freedom))
                best = (
                    base + gained[place],
                    Smoothness(shares, deviation, level, 0.0, len(gained) * len(choices)),
                )
    if best is None or not best[1].deviation > 0:
        return None
    whole = np.concatenate(values)
    mean = float(np.logaddexp.reduce(whole) - np.log(len(whole)))
    return replace(best[1], log_evidence=mean - alone)


def _finest(ground: Ground, data: Measurements, model: Dynamics) -> tuple[float, SmoothFunction]:
    """The shortest length, as a share of the range, of which the recordings need not too many bumps."""
    room = NUMBERS // (len(data.t) * (model.dimension + len(model.outputs)))
    most = max(min(MOST_BUMPS, room), 1)
    for share in SHARES:
        function = smooth_function(ground, (share,) * len(ground.words), most=most + 1)
        if function.width <= most:
            return share, function
    return SHARES[-1], smooth_function(ground, (SHARES[-1],) * len(ground.words), most=most)


def _without(white: Whitened, fit: Fit, known: Sequence[str]) -> tuple[Whitened, int]:
    """Innovations as if parameters were zero that are no longer there, and the number of the others."""
    names = [fit.model.parameters[place].name for place in fit.model.free]
    mine = [names.index(name) for name in known]
    values = fit.model.values[[fit.model.free[place] for place in mine]]
    others = np.delete(white.columns, mine, axis=1)
    innovations = white.innovations + white.columns[:, mine] @ values
    return replace(white, innovations=innovations, columns=others), len(names) - len(mine)
