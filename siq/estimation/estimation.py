"""Estimation: parameters, states and the two kinds of noise, by maximum likelihood.

The model is fitted with noise in what is measured (variance R) and, where asked, noise that drives the states
(intensity Q per time). With Q = 0 this is the least-squares fit of whole trajectories; with Q > 0 it is the
extended Kalman smoother, iterated to convergence, whose likelihood is that of its innovations. A model that
lacks physics is fitted with Q > 0 too: the states then follow the data, whatever the model says, and a later
addition is judged along the right trajectories. Initial states are unknown and enter as fixed effects; the
variances are those of highest restricted likelihood, which allows for that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from siq.dynamics.dynamics import Dynamics
from siq.estimation.innovations import Noise, process_covariance, solve, whiten, with_parameters_changed
from siq.estimation.kernels import smoothed_states, whitened_innovations
from siq.estimation.linearisation import Grid, Linearisation, linearise, substeps_needed
from siq.estimation.measurements import Measurements
from siq.estimation.noise import noise_along

SMALLEST_STEP = 1 / 64
NONLINEAR = 0.5  # share of a step's effect that may be unforeseen before the step is shortened
SETTLED = 1e-4  # change of the innovations, squared and per sample, at which a fit has converged
STANDSTILL = 0.005  # change of the sum of squares over four steps, below which a fit moves to no avail
PATIENCE = 6  # steps before that is asked
RESTING = 1e-12  # of a state's domain, the least that its spread is taken for
RUNS_AWAY = "the simulation runs away between two samples"


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
    fault
        Why there is no result; empty where there is one, settled or not.
    """

    model: Dynamics
    covariance: np.ndarray
    x: np.ndarray
    noise: Noise
    linearisation: Linearisation
    log_likelihood: float
    sum_of_squares: float
    degrees_of_freedom: int
    substeps: int
    converged: bool
    fault: str = ""

    @property
    def standard_errors(self) -> np.ndarray:
        """Of the free parameters, shape ``(p,)``."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def has_process_noise(self) -> bool:
        """Whether the states were let deviate from their equations."""
        return bool((self.noise.process > 0).any())


def fit_by_multiple_shooting(
    model: Dynamics,
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

    Returns
    -------
    Fit
        Not converged, with a log-likelihood of -∞ and the reason as its `fault`, where the simulation runs
        away.
    """
    with np.errstate(all="ignore"):  # what runs away is told as a fault
        if substeps is None:
            substeps = substeps_needed(model, data, model.values, x, tolerance=3e-6)
        grid = Grid(data, substeps)
        begin = _Iterate(model.values, x, linearise(model, grid, model.values, x))
        if not begin.along.finite:
            return _failed(model, begin, noise, substeps, RUNS_AWAY)
        shooting = _Shooting(model, grid, _sizes(model, x))
        try:
            return _gauss_newton(shooting, begin, noise, estimate_process=estimate_process, most=iterations)
        except (ArithmeticError, np.linalg.LinAlgError) as error:
            return _failed(model, begin, noise, substeps, str(error))


@dataclass(frozen=True)
class _Iterate:
    """Where a fit stands: all parameters ``(p,)``, the states ``(n, d)``, and the linearisation there."""

    values: np.ndarray
    x: np.ndarray
    along: Linearisation


@dataclass(frozen=True)
class _Shooting:
    """What is fitted: the model on the grid of the measurements, with the size of each state ``(d,)``."""

    model: Dynamics
    grid: Grid
    scale: np.ndarray

    def stepped(self, now: _Iterate, change: np.ndarray, noise: Noise) -> tuple[_Iterate, float] | None:
        """The step that the linearisation suggests, shortened until it does about what was foreseen.

        Parameters
        ----------
        now
            Where the fit stands.
        change
            Of the free parameters, shape ``(p,)``.
        noise
            Decides how the states follow.

        Returns
        -------
        _Iterate, float
            Where it leads, and the share of it that was taken; None where not even a short one does as
            foreseen.
        """
        deviation = state_changes(now.along, self.grid.data, noise, change)
        rows, scale = self.grid.rows, self.scale
        moved = np.einsum("kij,kj->ki", now.along.transition[rows], deviation[rows])
        moved += now.along.response[rows] @ change
        foreseen = now.along.gap[rows] + moved - deviation[rows + 1]
        effect = np.sqrt(np.mean(((np.abs(moved) + np.abs(deviation[rows + 1])) / scale) ** 2))
        length = 1.0
        while length >= SMALLEST_STEP:
            values = _changed(now.values, self.model.free, length * change)
            x = now.x + length * deviation
            along = linearise(self.model, self.grid, values, x)
            if along.finite:
                expected = (1 - length) * now.along.gap[rows] + length * foreseen
                unforeseen = np.sqrt(np.mean(((along.gap[rows] - expected) / scale) ** 2))
                if unforeseen <= NONLINEAR * length * effect + 1e-9:
                    return _Iterate(values, x, along), length
            length /= 2
        return None


def _gauss_newton(
    shooting: _Shooting, now: _Iterate, noise: Noise, *, estimate_process: bool, most: int
) -> Fit:
    data = shooting.grid.data
    before: np.ndarray | None = None
    totals: list[float] = []
    converged, settled_noise, whole = False, False, False
    for iteration in range(most):
        if iteration in (0, 2) or settled_noise:
            noise = noise_along(now.along, data, noise, estimate_process)
        white = whiten(now.along, data, noise)
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
        step = shooting.stepped(now, change, noise)
        if step is None:
            break
        now, length = step
        whole = length == 1.0
    return _fit_at(
        shooting.model, data, now, noise=noise, substeps=shooting.grid.substeps, converged=converged
    )


def fit_of_states(
    model: Dynamics, data: Measurements, *, x: np.ndarray, noise: Noise, substeps: int, converged: bool
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
    at = _Iterate(model.values, x, linearise(model, Grid(data, substeps), model.values, x))
    if not at.along.finite:
        return _failed(model, at, noise, substeps, RUNS_AWAY)
    try:
        noise = noise_along(at.along, data, noise, estimate_process=False)
        return _fit_at(model, data, at, noise=noise, substeps=substeps, converged=converged)
    except (ArithmeticError, np.linalg.LinAlgError) as error:
        return _failed(model, at, noise, substeps, str(error))


def _fit_at(
    model: Dynamics, data: Measurements, at: _Iterate, *, noise: Noise, substeps: int, converged: bool
) -> Fit:
    white = whiten(at.along, data, noise)
    change, covariance = solve(white.columns, white.innovations)
    # The last change is below the errors. The likelihood is that of the states in hand, not of a forecast.
    total = float(white.innovations @ white.innovations)
    return Fit(
        model=model.with_values(_changed(at.values, model.free, change if converged else 0 * change)),
        covariance=covariance,
        x=at.x,
        noise=noise,
        linearisation=at.along,
        log_likelihood=white.log_likelihood(total),
        sum_of_squares=total,
        degrees_of_freedom=white.degrees_of_freedom - len(model.free),
        substeps=substeps,
        converged=converged,
    )


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


def _sizes(model: Dynamics, x: np.ndarray) -> np.ndarray:
    """By how much each state varies, shape ``(d,)``; not zero where one rests."""
    about_zero = 2 * np.where(x.any(axis=0), np.abs(x).max(axis=0), 1.0)
    wide = np.ptp(model.limits, axis=1)
    return np.maximum(x.std(axis=0), RESTING * np.where(np.isfinite(wide), wide, about_zero))


def _changed(values: np.ndarray, free: Sequence[int], change: np.ndarray) -> np.ndarray:
    result = values.copy()
    result[np.array(free, dtype=int)] += change
    return result


def _failed(model: Dynamics, at: _Iterate, noise: Noise, substeps: int, fault: str) -> Fit:
    free = len(model.free)
    return Fit(
        model=model,
        covariance=np.full((free, free), np.nan),
        x=at.x,
        noise=noise,
        linearisation=at.along,
        log_likelihood=-np.inf,
        sum_of_squares=np.inf,
        degrees_of_freedom=1,
        substeps=substeps,
        converged=False,
        fault=fault,
    )
