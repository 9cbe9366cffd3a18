"""Screening: how much each probe would improve the fit, before any of them is fitted.

Along the trajectories of one fit everything is linear, so that the likelihood with a probe, its amplitude and
all parameters at their best, is a matter of least squares. It is worked out for several levels of process
noise: where physics is missing the fit had to admit such noise, and the right probe makes it needless.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from siq.mismatch.estimation import Fit
from siq.mismatch.innovations import Whitened, profile_likelihood, whiten
from siq.mismatch.linearisation import Columns, Grid, Linearisation, linearise
from siq.mismatch.measurements import Measurements
from siq.mismatch.model import Model

LEVELS = (1.0, 0.1, 1e-2, 1e-3, 1e-4, 0.0)
"""Process noise, relative to that of the fit."""
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
    """

    gain: float
    level: float
    amplitudes: np.ndarray
    standard_errors: np.ndarray


def probe_response(model: Model, grid: Grid, fit: Fit, columns: Columns) -> Linearisation:
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
    coarse = linearise(model, grid, fit.model.values, fit.x, columns=columns)
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

    A column of which little is left is set to zero: the parameters can do what it does.
    """
    own, further = white.columns[:, :parameters], white.columns[:, parameters:]
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
        For each group which amplitudes must not be negative; a group that would need one gains nothing.
    """
    parameters = len(fit.model.free)
    levels = LEVELS if fit.has_process_noise else (1.0,)
    base = -np.inf
    best = [Screened(-np.inf, 1.0, np.zeros(0), np.zeros(0))] * len(groups)
    for level in levels:
        white = whiten(linearisation, data, fit.noise.scaled(level))
        freedom = white.degrees_of_freedom - parameters
        left, columns = projected(white, parameters)
        total = float(left @ left)
        base = max(base, profile_likelihood(total, freedom, white.log_determinant))
        overlap = columns.T @ left
        for place, group in enumerate(groups):
            gram = columns[:, group].T @ columns[:, group]
            amplitudes, covariance = _small_solve(gram, overlap[group])
            after = max(total - float(amplitudes @ overlap[group]), 1e-12 * total)
            scale = after / max(freedom - len(amplitudes), 1)
            errors = np.sqrt(np.diag(covariance) * scale)
            value = profile_likelihood(after, freedom, white.log_determinant)
            if (amplitudes[positive[place]] < -2 * errors[positive[place]]).any():
                continue
            if value > best[place].gain:
                best[place] = Screened(value, level, amplitudes, errors)
    return [
        Screened(2 * (each.gain - base), each.level, each.amplitudes, each.standard_errors) for each in best
    ]


def _small_solve(gram: np.ndarray, overlap: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    scale = np.sqrt(np.diag(gram))
    scale = np.where(scale > 0, scale, np.inf)
    values, vectors = np.linalg.eigh(gram / np.outer(scale, scale))
    kept = values > 1e-10 * max(values[-1], 1e-300)
    inverse = (vectors[:, kept] / values[kept]) @ vectors[:, kept].T / np.outer(scale, scale)
    return inverse @ overlap, inverse
