"""How well are parameters known, where nobody knows how strong random forces are?

Forty samples seldom prove random forces, and a fit without them has errors that are right only if there are
none. What the recordings do not rule out belongs to the errors: they are averaged over all strengths of the
random forces, each with its likelihood, and so is how the parameters would change.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from siq.errors import NumericalFailure
from siq.estimation.budget import Budget, evaluation
from siq.estimation.estimation import fit_by_multiple_shooting
from siq.estimation.fit import Fit
from siq.estimation.innovations import Noise, profile_likelihood, solve, whiten
from siq.estimation.measurements import Measurements

DECADES = 14  # of strengths that are looked through, downwards from forces that would make all of the motion
POINTS = 16  # of the average
UNLIKELY = 8.0  # logarithm of a likelihood, relative to the largest, that adds nothing to an average


def covariance_with_unknown_forces(
    fit: Fit, data: Measurements, *, budget: Budget | None = None
) -> np.ndarray:
    """Covariance of the free parameters of a fit, shape ``(p, p)``, whatever the strength of random forces.

    The strength is one factor on the random forces of the fit; on such as would make the motion of each state
    where it has none. Beforehand every standard deviation of them is as probable (Gelman 2006, Bayesian
    Analysis 1, 515); the scale of all noise and the parameters are integrated out as linear. A fit without
    random forces is made once more with those of the average, since its trajectories may be far from those
    that random forces made.

    Parameters
    ----------
    fit
        Whose linearisation and noise are used.
    data
        The recordings.
    budget
        Charged for the work.
    """
    if not len(fit.model.free) or not np.isfinite(fit.covariance).all():
        return fit.covariance
    if fit.has_process_noise:
        return _average(fit, data, fit.noise.process, budget)[0]
    process = forces_of_the_motion(fit, data)
    if not (process > 0).any():
        return fit.covariance
    covariance, size = _average(fit, data, process, budget)
    forced = fit_by_multiple_shooting(
        fit.model, data, x=fit.x, noise=Noise(fit.noise.measurement, process * size**2),
        estimate_process=False, substeps=fit.substeps, budget=budget,
    )  # fmt: skip
    if not forced.converged or not forced.has_process_noise:
        return covariance
    free = np.array(fit.model.free, dtype=int)
    apart = (forced.model.values - fit.model.values)[free]
    return _average(forced, data, forced.noise.process, budget)[0] + np.outer(apart, apart)


@dataclass(frozen=True)
class _Strength:
    """What follows from one strength of random forces: its log-likelihood, change and covariance of θ."""

    size: float
    value: float
    change: np.ndarray
    covariance: np.ndarray


def _average(
    fit: Fit, data: Measurements, process: np.ndarray, budget: Budget | None
) -> tuple[np.ndarray, float]:
    """Covariance averaged over factors on the standard deviation of forces; and the mean of that factor."""
    known = data.sensor_noise is not None and bool(np.isfinite(data.sensor_noise).all())
    units = np.sqrt(np.diag(fit.covariance))
    units = np.where(units > 0, units, 1.0)

    def at(size: float) -> _Strength | None:
        if budget is not None:
            budget.charge(evaluation(fit.model, data))
        try:
            white = whiten(
                fit.linearisation, data, Noise(fit.noise.measurement, process * size**2, fit.noise.shape)
            )
            change, covariance = solve(white.columns, white.innovations)
        except (NumericalFailure, np.linalg.LinAlgError):
            return None
        left = white.innovations - white.columns @ change
        total, freedom = float(left @ left), white.degrees_of_freedom - len(change)
        covariance = covariance if known else covariance * (total / freedom)
        sign, volume = np.linalg.slogdet(covariance / np.outer(units, units))
        value = profile_likelihood(total, freedom, white.log_determinant)
        if known:
            value = -0.5 * (total + white.log_determinant)
        return _Strength(size, value + (0.5 * volume if sign > 0 else 0.0), change, covariance)

    # Of forces that are estimated the strength is about one, and of others anywhere below.
    sizes = np.concatenate([[0.0], 10.0 ** (np.arange(-DECADES, 5) / 2)])
    coarse = np.array([-np.inf if (one := at(size)) is None else one.value for size in sizes])
    if not np.isfinite(coarse).any():
        return fit.covariance, 0.0
    likely = np.flatnonzero(coarse > coarse.max() - UNLIKELY)
    lowest, highest = sizes[max(likely[0] - 1, 0)], sizes[min(likely[-1] + 1, len(sizes) - 1)]
    found = [one for size in np.linspace(lowest, highest, POINTS) if (one := at(size)) is not None]
    if not found:
        return fit.covariance, 0.0
    weights = np.exp(np.array([one.value for one in found]) - max(one.value for one in found))
    weights /= weights.sum()
    covariance = np.zeros_like(fit.covariance)
    for weight, one in zip(weights, found, strict=True):
        covariance += weight * (one.covariance + np.outer(one.change, one.change))
    return covariance, float(weights @ [one.size for one in found])


def forces_of_the_motion(fit: Fit, data: Measurements) -> np.ndarray:
    """Intensities of random forces that would make the motion of states they can drive, shape ``(d,)``."""
    rows = data.begins
    step = (data.t[rows + 1] - data.t[rows])[:, None]
    process = np.mean((fit.x[rows + 1] - fit.x[rows]) ** 2 / step, axis=0)
    return np.where(fit.model.kinematic, 0.0, process)
