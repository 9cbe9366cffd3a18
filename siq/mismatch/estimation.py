"""Estimation: parameters, states and the two kinds of noise, by maximum likelihood.

The model is fitted with noise in what is measured (variance R) and, where asked, noise that drives the states
(intensity Q per time). With Q = 0 this is the least-squares fit of whole trajectories; with Q > 0 it is the
extended Kalman smoother, iterated to convergence, whose likelihood is that of its innovations. A model that
lacks physics is fitted with Q > 0 too: the states then follow the data, whatever the model says, and a later
addition is judged along the right trajectories. Initial states are unknown and enter as fixed effects; the
variances are those of highest restricted likelihood, which allows for that.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from siq.mismatch.innovations import Noise, process_covariance, solve, whiten, with_parameters_changed
from siq.mismatch.kernels import smoothed_states, whitened_innovations
from siq.mismatch.linearisation import Grid, Linearisation, linearise, substeps_needed
from siq.mismatch.measurements import Measurements
from siq.mismatch.model import Model
from siq.mismatch.noise import noise_along

SMALLEST_STEP = 1 / 64
NONLINEAR = 0.5  # share of a step's effect that may be unforeseen before the step is shortened
SETTLED = 1e-4  # change of the innovations, squared and per sample, at which a fit has converged
STANDSTILL = 0.005  # change of the sum of squares over four steps, below which a fit moves to no avail
PATIENCE = 6  # steps before that is asked


@dataclass(frozen=True)
class Fit:
    """A fitted model.

    Attributes
    ----------
    model
        With the estimates as its parameters' values.
    covariance
        Of the free parameters, shape ``(p, p)``, from white innovations.
    x
        Smoothed states at all samples, shape ``(n, d)``.
    noise
        Estimates, or what was given.
    linearisation
        At `x` and the estimates.
    log_likelihood
        Not the restricted one, which depends on the units in which a model has its states.
    sum_of_squares
        Of the whitened innovations: about `degrees_of_freedom` where the model is right.
    degrees_of_freedom
        Measured values less initial states and free parameters.
    substeps
        Runge–Kutta steps between samples.
    converged
        Whether the iteration settled.
    """

    model: Model
    covariance: np.ndarray
    x: np.ndarray
    noise: Noise
    linearisation: Linearisation
    log_likelihood: float
    sum_of_squares: float
    degrees_of_freedom: int
    substeps: int
    converged: bool

    @property
    def standard_errors(self) -> np.ndarray:
        """Of the free parameters, shape ``(p,)``."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def has_process_noise(self) -> bool:
        """Whether the states were let deviate from their equations."""
        return bool((self.noise.process > 0).any())


def fit(
    model: Model,
    data: Measurements,
    *,
    x: np.ndarray,
    noise: Noise,
    estimate_process: bool,
    substeps: int | None = None,
    iterations: int = 25,
) -> Fit:
    """Fit free parameters, states and noise, by Gauss–Newton steps along linearised trajectories.

    Parameters
    ----------
    model
        Its parameters' values are where the fit begins.
    data
        The measurements.
    x
        States to begin with, shape ``(n, d)``.
    noise
        To begin with. Without process noise the fitted states follow their equations exactly.
    estimate_process
        Whether the process noise is estimated, too; the measurement noise always is.
    substeps
        Runge–Kutta steps between samples; by default as many as the accuracy needs.
    iterations
        Most steps.
    """
    if substeps is None:
        substeps = substeps_needed(model, data, model.values, x, tolerance=3e-6)
    grid = Grid(data, substeps)
    values, free = model.values, np.array(model.free, dtype=int)
    current = linearise(model, grid, values, x)
    if not current.finite:
        return _failed(model, x, noise, current, substeps)
    scale = np.maximum(x.std(axis=0), 1e-12 * np.ptp(model.domain, axis=1))
    before: np.ndarray | None = None
    totals: list[float] = []
    converged, settled_noise, whole = False, False, False
    for iteration in range(iterations):
        if iteration in (0, 2) or settled_noise:
            noise = noise_along(current, data, noise, estimate_process)
        white = whiten(current, data, noise)
        if not np.isfinite(white.columns).all() or not np.isfinite(white.innovations).all():
            return _failed(model, x, noise, current, substeps)
        change, _ = solve(white.columns, white.innovations)
        left = white.innovations - white.columns @ change
        # A shortened step leaves much of what is foreseen undone, and the forecast unchanged.
        if (
            before is not None
            and whole
            and ((left - before) ** 2).sum() < SETTLED * len(left) * max(1.0, (left**2).sum() / len(left))
        ):
            if settled_noise:
                converged = True
                break
            settled_noise = True
        before = left
        totals.append(float(white.innovations @ white.innovations))
        if len(totals) > PATIENCE and settled_noise is False and _stands_still(totals):
            settled_noise = True
        elif len(totals) > 2 * PATIENCE and _stands_still(totals):
            converged = True
            break
        stepped = _step(model, grid, values, x, current, change, free, data, noise, scale)
        if stepped is None:
            break
        values, x, current, length = stepped
        whole = length == 1.0
    return _fitted(
        model.with_values(values),
        data,
        x=x,
        noise=noise,
        along=current,
        substeps=substeps,
        converged=converged,
    )


def fitted(
    model: Model, data: Measurements, *, x: np.ndarray, noise: Noise, substeps: int, converged: bool
) -> Fit:
    """What is known of a fit that was made otherwise: without process noise, its states follow the equations.

    Parameters
    ----------
    model
        With the estimates.
    data, substeps, converged
        Of the fit.
    x
        The fitted states, shape ``(n, d)``.
    noise
        To begin with; the measurement noise is estimated.
    """
    along = linearise(model, Grid(data, substeps), model.values, x)
    if not along.finite:
        return _failed(model, x, noise, along, substeps)
    noise = noise_along(along, data, noise, estimate_process=False)
    return _fitted(model, data, x=x, noise=noise, along=along, substeps=substeps, converged=converged)


def _fitted(
    model: Model,
    data: Measurements,
    *,
    x: np.ndarray,
    noise: Noise,
    along: Linearisation,
    substeps: int,
    converged: bool,
) -> Fit:
    white = whiten(along, data, noise)
    if not np.isfinite(white.columns).all() or not np.isfinite(white.innovations).all():
        return _failed(model, x, noise, along, substeps)
    change, covariance = solve(white.columns, white.innovations)
    free = np.array(model.free, dtype=int)
    # The last change is below the errors. The likelihood is that of the states in hand, not of a forecast.
    total = float(white.innovations @ white.innovations)
    return Fit(
        model=model.with_values(_changed(model.values, free, change if converged else 0 * change)),
        covariance=covariance,
        x=x,
        noise=noise,
        linearisation=along,
        log_likelihood=white.log_likelihood(total),
        sum_of_squares=total,
        degrees_of_freedom=white.degrees_of_freedom - len(free),
        substeps=substeps,
        converged=converged,
    )


def _step(
    model: Model,
    grid: Grid,
    values: np.ndarray,
    x: np.ndarray,
    current: Linearisation,
    change: np.ndarray,
    free: np.ndarray,
    data: Measurements,
    noise: Noise,
    scale: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, Linearisation, float] | None:
    """The step that the linearisation suggests, shortened until it does about what was foreseen."""
    deviation = state_changes(current, data, noise, change)
    rows = grid.rows
    moved = np.einsum("kij,kj->ki", current.transition[rows], deviation[rows])
    moved += current.response[rows] @ change
    foreseen = current.gap[rows] + moved - deviation[rows + 1]
    effect = np.sqrt(np.mean(((np.abs(moved) + np.abs(deviation[rows + 1])) / scale) ** 2))
    length = 1.0
    while length >= SMALLEST_STEP:
        trial_values = _changed(values, free, length * change)
        trial_x = x + length * deviation
        trial = linearise(model, grid, trial_values, trial_x)
        if trial.finite:
            expected = (1 - length) * current.gap[rows] + length * foreseen
            unforeseen = np.sqrt(np.mean(((trial.gap[rows] - expected) / scale) ** 2))
            if unforeseen <= NONLINEAR * length * effect + 1e-9:
                return trial_values, trial_x, trial, length
        length /= 2
    return None


def state_changes(
    linearisation: Linearisation, data: Measurements, noise: Noise, change: np.ndarray
) -> np.ndarray:
    """Most probable changes of all states, shape ``(n, d)``, given those of the parameters, ``(p,)``."""
    step = np.append(np.diff(data.t), 0.0)
    process = process_covariance(linearisation.transition, step, noise.process)
    still = with_parameters_changed(linearisation, change)
    gap, residual = still.gap, still.residual
    innovations, _, initial, _ = whitened_innovations(
        data.first,
        still.transition,
        still.response,
        gap,
        process,
        still.measured,
        still.measured_response,
        residual,
        noise.measurement,
    )
    begin = np.empty((len(data.labels), gap.shape[1]))
    for place, (start, end) in enumerate(zip(data.first[:-1], data.first[1:], strict=True)):
        columns = initial[start:end].reshape(-1, gap.shape[1])
        begin[place] = solve(columns, innovations[start:end].ravel())[0]
    return smoothed_states(
        data.first,
        linearisation.transition,
        gap,
        process,
        linearisation.measured,
        residual,
        noise.measurement,
        begin,
    )


def _stands_still(totals: list[float]) -> bool:
    """Whether a fit moves without becoming better: where f jumps its derivatives are never exact."""
    recent = totals[-4:]
    return max(recent) - min(recent) < STANDSTILL * max(recent)


def _changed(values: np.ndarray, free: np.ndarray, change: np.ndarray) -> np.ndarray:
    result = values.copy()
    result[free] += change
    return result


def _failed(model: Model, x: np.ndarray, noise: Noise, current: Linearisation, substeps: int) -> Fit:
    free = len(model.free)
    return Fit(
        model=model,
        covariance=np.full((free, free), np.nan),
        x=x,
        noise=noise,
        linearisation=current,
        log_likelihood=-np.inf,
        sum_of_squares=np.inf,
        degrees_of_freedom=1,
        substeps=substeps,
        converged=False,
    )
