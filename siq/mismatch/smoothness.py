"""Smoothness: over which lengths a function changes that what a fit leaves asks for, and how large it is.

Along the trajectories of a fit everything is linear. The likelihood of a smooth function, averaged over
everything that it could be, tells its lengths and its size: one that is too rough could have been too much
else, and one that is too smooth explains too little (MacKay, Neural Computation 4, 415 (1992)).
"""

from __future__ import annotations

import itertools
import logging
from dataclasses import dataclass, replace

import numpy as np

from siq.dynamics.dynamics import Dynamics
from siq.estimation.fit import Fit
from siq.estimation.innovations import Whitened, profile_likelihood, whiten
from siq.estimation.linearisation import Grid
from siq.estimation.measurements import Measurements
from siq.mismatch.clusters import correlation_time_of
from siq.mismatch.evidence import evidences_by_size, orthonormal
from siq.mismatch.function_places import NUMBERS, PlaceColumns
from siq.mismatch.grounds import Ground
from siq.mismatch.nameless_models import Part
from siq.mismatch.product_functions import ProductFunction, product_of
from siq.mismatch.screening import levels_of, probe_response, projected
from siq.mismatch.smooth_functions import SmoothFunction, smooth_function, triangle_of
from siq.mismatch.structure import SUBSTEPS
from siq.mismatch.tried import UNFORESEEN

LOGGER = logging.getLogger(__name__)
SHARES = (1 / 16, 1 / 8, 1 / 4, 1 / 2, 1.0, 2.0)  # of the range; over twice of it a function is a parabola
MOST_BUMPS = 100  # a guard on the time of a fit


@dataclass(frozen=True)
class Told:
    """What a fit leaves says of a function's values, at a level of random forces.

    Attributes
    ----------
    level
        Relative to the random forces of the fit.
    fine
        The function, with bumps as narrow as any.
    correlated
        Correlation time τ of the innovations in samples, with such a function: n of them count as n/τ.
    gram, overlap
        Of what a unit of each bump does to the innovations, with each other and with the innovations; shapes
        ``(b, b)`` and ``(b,)``. Over τ, as are those that follow.
    total, freedom
        Sum of squares of the innovations, and degrees of freedom.
    likelihood
        Logarithm, without the function.
    """

    level: float
    fine: SmoothFunction
    correlated: float
    gram: np.ndarray
    overlap: np.ndarray
    total: float
    freedom: float
    likelihood: float

    def over(self, correlated: float) -> Told:
        """The same where so many samples hang together."""
        return Told(
            self.level, self.fine, correlated, self.gram / correlated, self.overlap / correlated,
            self.total / correlated, self.freedom / correlated, self.likelihood / correlated,
        )  # fmt: skip


@dataclass(frozen=True)
class Smoothness:
    """How smooth a function is, as recordings tell it.

    Attributes
    ----------
    shares
        Its lengths, as shares of the ranges of its coordinates.
    deviation
        Its size.
    told
        What the recordings tell, at the level of random forces at which it is likeliest.
    noise
        Variance of the innovations then, in units of what the fit takes for it.
    log_evidence
        Logarithm of the odds for such a function, over none, each at its best level; averaged over all
        lengths and sizes.
    considered
        How many lengths and sizes these are.
    """

    shares: tuple[float, ...]
    deviation: float
    told: Told
    noise: float
    log_evidence: float
    considered: int


def smoothness_of(
    fit: Fit, data: Measurements, ground: Ground, *, known: Part | None = None, alike: bool = False
) -> Smoothness | None:
    """The likeliest smoothness of a function on top of a fit; None where it cannot be worked out.

    Parameters
    ----------
    fit, data
        The fit along whose trajectories everything is linear, and what it was made for.
    ground
        Where the function stands.
    known
        A part of the fit that is a first description of this function, in whose stead it comes.
    alike
        Whether both lengths are the same share of the range.
    """
    least, fine = _finest(ground, data, fit.model)
    some = [share for share in SHARES if share >= least]
    choices = [(each,) * len(ground.words) for each in some]
    if not alike:
        choices = list(itertools.product(some, repeat=len(ground.words)))
    # What processes of these lengths have for values at the finest bumps, as heights of these.
    shapes = [fine.heights_of(triangle_of(fine.centres, np.array(each) * ground.ranges)) for each in choices]
    alone = -np.inf
    values: list[np.ndarray] = []
    highest, best = -np.inf, None
    for told in _told(fit, data, fine, known):
        alone = max(alone, told.likelihood)
        for shares, shape in zip(choices, shapes, strict=True):
            gained, scale, rest = evidences_by_size(
                shape.T @ told.gram @ shape, shape.T @ told.overlap, told.total, freedom=told.freedom
            )
            values.append(told.likelihood + gained)
            place = int(np.argmax(gained))
            if values[-1][place] > highest:
                # The scale of the noise was at its best, too, and the size is one in units of it.
                highest, noise = values[-1][place], float(rest[place] / told.freedom)
                deviation = float(np.sqrt(scale[place] * noise))
                best = Smoothness(shares, deviation, told, noise, 0.0, len(gained) * len(choices))
    if best is None or not best.deviation > 0:
        return None
    whole = np.concatenate(values)
    mean = float(np.logaddexp.reduce(whole) - np.log(len(whole)))
    return replace(best, log_evidence=mean - alone)


def likeliest_product(asked: Smoothness, ground: Ground, *, times: float = 1.0) -> ProductFunction:
    """The likeliest product of two functions, where a function of two coordinates is asked for.

    Parameters
    ----------
    asked
        What the recordings say of a function of both.
    ground
        Where it stands.
    times
        Factor on the lengths to choose among.
    """
    told = asked.told
    by_value = told.fine.heights_of(told.fine.heights_of(told.gram).T)
    return product_of(
        ground,
        tuple(times * share for share in SHARES),
        points=told.fine.centres,
        gram=(by_value + by_value.T) / (2 * asked.noise),
        overlap=told.fine.heights_of(told.overlap) / asked.noise,
        deviation=asked.deviation,
        weight=told.correlated,
    )


def _told(fit: Fit, data: Measurements, fine: SmoothFunction, known: Part | None) -> list[Told]:
    """What is told at each level of random forces at which it can be worked out.

    Errors are as correlated as the likeliest level leaves them with such a function, at all levels.
    """
    grid = Grid(data, fit.substeps if known else min(fit.substeps, SUBSTEPS))
    response = probe_response(fit.model, grid, fit, PlaceColumns(fit.model, grid, [fine]))
    found: list[Told] = []
    highest, correlated = -np.inf, 1.0
    for level in levels_of(fit):
        try:
            white = whiten(response, data, fit.noise.scaled(level))
            white, parameters = _without(white, fit, known)
            left, columns = projected(white, parameters)
        except UNFORESEEN as error:
            LOGGER.info("no function of %s can be screened: %s", " and ".join(fine.ground.words), error)
            continue
        total, freedom = float(left @ left), white.degrees_of_freedom - parameters
        likelihood = profile_likelihood(total, freedom, white.log_determinant)
        found.append(
            Told(level, fine, 1.0, columns.T @ columns, columns.T @ left, total, freedom, likelihood)
        )
        basis = orthonormal(columns)
        rest = left - basis @ (basis.T @ left)
        likelihood = profile_likelihood(float(rest @ rest), freedom, white.log_determinant)
        if likelihood > highest:
            highest = likelihood
            correlated = correlation_time_of(rest, white.recording, outputs=len(fit.model.outputs))
    return [each.over(correlated) for each in found]


def _finest(ground: Ground, data: Measurements, model: Dynamics) -> tuple[float, SmoothFunction]:
    """The shortest length, as a share of the range, of which the recordings need not too many bumps."""
    room = NUMBERS // (len(data.t) * (model.dimension + len(model.outputs)))
    most = max(min(MOST_BUMPS, room), 1)
    for share in SHARES:
        function = smooth_function(ground, (share,) * len(ground.words), most=most + 1)
        if function.width <= most:
            return share, function
    return SHARES[-1], smooth_function(ground, (SHARES[-1],) * len(ground.words), most=most)


def _without(white: Whitened, fit: Fit, known: Part | None) -> tuple[Whitened, int]:
    """Innovations as if a part were not there, its columns left out, and the number of parameters left."""
    names = [fit.model.parameters[place].name for place in fit.model.free]
    amplitudes = () if known is None else known.trial.candidate.amplitudes
    mine = [names.index(name) for name in amplitudes]
    linear = mine if known is None or known.smooth is None else mine[: known.smooth.linear]
    values = fit.model.values[[fit.model.free[place] for place in linear]]
    others = np.delete(white.columns, mine, axis=1)
    innovations = white.innovations + white.columns[:, linear] @ values
    return replace(white, innovations=innovations, columns=others), len(names) - len(mine)
