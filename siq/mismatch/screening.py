"""Screening: how much each probe would improve the fit, before any of them is fitted.

Along the trajectories of one fit everything is linear, so that the likelihood with a probe, its amplitude and
all parameters at their best, is a matter of least squares. It is worked out for several levels of process
noise: where physics is missing the fit had to admit such noise, and the right probe makes it needless.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from siq.dynamics.dynamics import Dynamics
from siq.errors import NumericalFailure
from siq.estimation.fit import Fit
from siq.estimation.innovations import Whitened, profile_likelihood, whiten
from siq.estimation.linearisation import Columns, Grid, Linearisation, linearise
from siq.estimation.measurements import Measurements

LEVELS = (1.0, 0.1, 1e-2, 1e-3, 1e-4, 0.0)
"""Process noise, relative to that of the fit."""
LARGEST_PORTION = 20_000_000  # numbers that are worked out at once; with copies about a gigabyte
LEAST_PORTION = 10  # columns
CLEARLY = 2.0  # standard errors below zero, from which on an amplitude is taken for negative
COLLINEAR = 0.02  # share of a column left beside the parameters, below which its amplitude knows no bounds


@dataclass(frozen=True)
class Screened:
    """What one group of columns would do.

    Attributes
    ----------
    gain
        Twice the increase of the log-likelihood, each side at its best level of process noise.
    level
        The level at which it is best.
    amplitudes, standard_errors
        There; shape ``(k,)``.
    finite
        Whether what the columns do to what is measured is a number at any level.
    """

    gain: float
    level: float
    amplitudes: np.ndarray
    standard_errors: np.ndarray
    finite: bool = True


def levels_of(fit: Fit) -> tuple[float, ...]:
    """The levels of random forces at which something is judged on top of a fit; one where it has none."""
    return LEVELS if fit.has_process_noise else (1.0,)


def in_portions(widths: Sequence[int], model: Dynamics, data: Measurements) -> Iterator[slice]:
    """Groups of columns, by their widths, divided so that the response to a portion fits into the memory."""
    most = max(LARGEST_PORTION // (len(data.t) * (model.dimension + len(model.outputs))), LEAST_PORTION)
    first, columns = 0, 0
    for place, width in enumerate(widths):
        if columns and columns + width > most:
            yield slice(first, place)
            first, columns = place, 0
        columns += width
    if columns:
        yield slice(first, len(widths))


def probe_response(model: Dynamics, grid: Grid, fit: Fit, columns: Columns) -> Linearisation:
    """The linearisation of a fit, with the columns of probes behind those of its parameters.

    Parameters
    ----------
    model, fit
        The simulation and its fit.
    grid
        On which the columns are worked out; it may be coarser than that of the fit.
    columns
        The probes.
    """
    with np.errstate(all="ignore"):  # what overflows is left out of the screening
        coarse = linearise(model, grid, fit.model.values, fit.linearised_at, columns=columns)
    known, parameters = fit.linearisation, len(fit.model.free)
    return replace(
        known,
        response=np.concatenate([known.response, coarse.response[:, :, parameters:]], axis=2),
        measured_response=np.concatenate(
            [known.measured_response, coarse.measured_response[:, :, parameters:]], axis=2
        ),
    )


def projected(white: Whitened, parameters: int) -> tuple[np.ndarray, np.ndarray]:
    """Innovations and further columns with the parameters' columns projected out.

    A column of which little is left is set to zero, since the parameters can do what it does, and so is one
    that is not finite.

    Raises
    ------
    NumericalFailure
        When a parameter's column is not finite.
    """
    own, further = white.columns[:, :parameters], white.columns[:, parameters:]
    if not np.isfinite(own).all():
        raise NumericalFailure("the effect of a parameter on what is measured is beyond all numbers")
    further = np.where(np.isfinite(further).all(axis=0), further, 0.0)
    if parameters:
        scale = np.sqrt((own**2).sum(axis=0))
        basis, values, _ = np.linalg.svd(own / np.where(scale > 0, scale, 1.0), full_matrices=False)
        basis = basis[:, values > 1e-9 * values[0]] if values[0] > 0 else basis[:, :0]
    else:
        basis = own
    left = white.innovations - basis @ (basis.T @ white.innovations)
    size = np.sqrt((further**2).sum(axis=0))
    further = further - basis @ (basis.T @ further)
    further[:, np.sqrt((further**2).sum(axis=0)) <= COLLINEAR * size] = 0.0
    return left, further


def screen(
    linearisation: Linearisation,
    data: Measurements,
    fit: Fit,
    groups: Sequence[slice],
    *,
    positive: Sequence[np.ndarray],
) -> list[Screened]:
    """Screen groups of columns.

    Parameters
    ----------
    linearisation
        With the columns of all groups behind those of the free parameters.
    data, fit
        The fit that is to be improved.
    groups
        The columns of each group, counted behind the parameters'.
    positive
        For each group which amplitudes must not be negative; one that would be is zero.

    Raises
    ------
    NumericalFailure
        When the simulation runs away at every level.
    """
    parameters = len(fit.model.free)
    base = -np.inf
    best = [Screened(-np.inf, 1.0, np.zeros(0), np.zeros(0), finite=False)] * len(groups)
    failure: NumericalFailure | None = None
    for level in levels_of(fit):
        try:
            white = whiten(linearisation, data, fit.noise.scaled(level))
        except NumericalFailure as error:  # without random forces an unstable simulation does not follow
            failure = error
            continue
        finite = np.isfinite(white.columns[:, parameters:]).all(axis=0)
        freedom = white.degrees_of_freedom - parameters
        left, columns = projected(white, parameters)
        total = float(left @ left)
        base = max(base, profile_likelihood(total, freedom, white.log_determinant))
        overlap = columns.T @ left
        for place, group in enumerate(groups):
            if not finite[group].all():
                continue
            best[place] = replace(best[place], finite=True)
            gram = columns[:, group].T @ columns[:, group]
            amplitudes, errors, after = _admissible(gram, overlap[group], total, freedom, positive[place])
            value = profile_likelihood(after, freedom, white.log_determinant)
            if amplitudes.any() and value > best[place].gain:
                best[place] = Screened(value, level, amplitudes, errors)
    if failure is not None and base == -np.inf:
        raise failure
    return [replace(each, gain=2 * (each.gain - base)) for each in best]


def _admissible(
    gram: np.ndarray, overlap: np.ndarray, total: float, freedom: int, positive: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Amplitudes that their signs allow, their standard errors, and the squares that are left.

    Those that would clearly be negative, and must not, are zero, the clearest first: what is left of a
    mechanism then is a special case of it.
    """
    kept = np.ones(len(overlap), dtype=bool)
    amplitudes, errors, after = np.zeros(len(overlap)), np.zeros(len(overlap)), total
    while kept.any():
        solved, covariance = _small_solve(gram[np.ix_(kept, kept)], overlap[kept])
        after = max(total - float(solved @ overlap[kept]), 1e-12 * total)
        spread = np.sqrt(np.diag(covariance) * after / max(freedom - len(solved), 1))
        amplitudes[kept], errors[kept] = solved, spread
        below = np.where(positive & kept, -amplitudes / np.maximum(errors, np.finfo(float).tiny), 0.0)
        worst = int(np.argmax(below))
        if below[worst] <= CLEARLY:
            break
        kept[worst] = False
        amplitudes[worst] = errors[worst] = 0.0
    return amplitudes, errors, after if kept.any() else total


def _small_solve(gram: np.ndarray, overlap: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    scale = np.sqrt(np.diag(gram))
    scale = np.where(scale > 0, scale, np.inf)
    values, vectors = np.linalg.eigh(gram / np.outer(scale, scale))
    kept = values > 1e-10 * max(values[-1], 1e-300)
    inverse = (vectors[:, kept] / values[kept]) @ vectors[:, kept].T / np.outer(scale, scale)
    return inverse @ overlap, inverse
