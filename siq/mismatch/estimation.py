"""Estimation: parameters, states and the two kinds of noise, by maximum likelihood.

The model is fitted with noise in what is measured (variance R) and, where asked, noise that drives the states
(intensity Q per time). With Q = 0 this is the least-squares fit of whole trajectories; with Q > 0 it is the
extended Kalman smoother, iterated to convergence, whose likelihood is that of its innovations. A model that
lacks physics is fitted with Q > 0 too: the states then follow the data, whatever the model says, and a later
addition is judged along the right trajectories. Initial states are unknown and enter as fixed effects; the
variances are those of highest restricted likelihood, which allows for that.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg
import scipy.optimize

from siq.mismatch.kernels import noise_likelihood, smoothed_states, whitened_innovations
from siq.mismatch.linearisation import Grid, Linearisation, linearise, substeps_needed
from siq.mismatch.measurements import Measurements
from siq.mismatch.model import Model

RANK = 1e-4  # singular values below this share of the largest say nothing
SMALLEST_STEP = 1 / 64
NONLINEAR = 0.5  # share of a step's effect that may be unforeseen before the step is shortened
SETTLED = 1e-4  # change of the innovations, squared and per sample, at which a fit has converged
STANDSTILL = 0.005  # change of the sum of squares over four steps, below which a fit moves to no avail
PATIENCE = 6  # steps before that is asked
SMOOTHEST = 1e-4  # least measurement noise, as a share of what third differences show
LOWEST = np.exp(-23.0)  # of a process noise, relative to where the search began; below it there is none


@dataclass(frozen=True)
class Noise:
    """Variances of the two kinds of noise.

    Attributes
    ----------
    measurement
        R, per sample, shape ``(m,)``.
    process
        Q, per time, shape ``(d,)``; zero where nothing drives the state.
    """

    measurement: np.ndarray
    process: np.ndarray

    def without_process(self) -> Noise:
        """The same measurement noise, and states that follow their equations exactly."""
        return Noise(self.measurement, np.zeros_like(self.process))

    def scaled(self, factor: float) -> Noise:
        """The same measurement noise, with the process noise multiplied."""
        return Noise(self.measurement, self.process * factor)


@dataclass(frozen=True)
class Whitened:
    """Innovations in units of their standard deviation, initial states projected out.

    Attributes
    ----------
    innovations
        Shape ``(n·m,)``.
    columns
        What a unit of each parameter explains of them, shape ``(n·m, p)``.
    recording
        The recording of each, shape ``(n·m,)``.
    known
        Which of them were measured, shape ``(n·m,)``.
    degrees_of_freedom
        Measured values less initial states.
    log_determinant
        Of the innovations' covariance.
    """

    innovations: np.ndarray
    columns: np.ndarray
    recording: np.ndarray
    known: np.ndarray
    degrees_of_freedom: int
    log_determinant: float

    def log_likelihood(self, sum_of_squares: float) -> float:
        """Log-likelihood where the innovations have the given sum of squares."""
        return -0.5 * (sum_of_squares + self.log_determinant + self.known.sum() * np.log(2 * np.pi))


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


def whiten(linearisation: Linearisation, data: Measurements, noise: Noise) -> Whitened:
    """Innovations of the filter in units of their standard deviation, initial states projected out."""
    transition = linearisation.transition
    step = np.append(np.diff(data.t), 0.0)
    process = process_covariance(transition, step, noise.process)
    innovations, columns, initial, log_determinant = whitened_innovations(
        data.first,
        transition,
        linearisation.response,
        linearisation.gap,
        process,
        linearisation.measured,
        linearisation.measured_response,
        linearisation.residual,
        noise.measurement,
    )
    outputs = innovations.shape[1]
    known = ~np.isnan(linearisation.residual).ravel()
    innovations = innovations.ravel()
    columns = columns.reshape(len(innovations), -1)
    initial = initial.reshape(len(innovations), -1)
    used = 0
    for begin, end in zip(data.first[:-1] * outputs, data.first[1:] * outputs, strict=True):
        basis = _orthonormal(initial[begin:end])
        innovations[begin:end] -= basis @ (basis.T @ innovations[begin:end])
        columns[begin:end] -= basis @ (basis.T @ columns[begin:end])
        used += basis.shape[1]
    return Whitened(
        innovations=innovations,
        columns=columns,
        recording=np.repeat(data.recording, outputs),
        known=known,
        degrees_of_freedom=int(known.sum()) - used,
        log_determinant=log_determinant,
    )


def process_covariance(transition: np.ndarray, step: np.ndarray, intensity: np.ndarray) -> np.ndarray:
    """Covariance that noise of the given intensities adds over each interval, by Simpson's rule.

    Parameters
    ----------
    transition
        Φ over the intervals, shape ``(n, d, d)``.
    step
        Their lengths, shape ``(n,)``.
    intensity
        Q per time, shape ``(d,)``.
    """
    total = np.zeros_like(transition)
    for place in np.flatnonzero(intensity):
        after = transition[:, :, place]
        unit = np.zeros(len(intensity))
        unit[place] = 1.0
        middle = (after + unit) / 2
        total += intensity[place] * (after[:, :, None] * after[:, None, :])
        total += 4 * intensity[place] * (middle[:, :, None] * middle[:, None, :])
        total[:, place, place] += intensity[place]
    return total * (step / 6)[:, None, None]


def solve(columns: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Least squares with columns of any scale; what the data do not tell is left alone.

    Returns
    -------
    estimate, covariance
        Shapes ``(p,)`` and ``(p, p)``, for errors of unit variance.
    """
    if columns.shape[1] == 0:
        return np.zeros(0), np.zeros((0, 0))
    scale = np.sqrt((columns**2).sum(axis=0))
    scale[scale == 0] = 1.0
    left, values, right = scipy.linalg.svd(columns / scale, full_matrices=False)
    kept = values > RANK * values[0] if values[0] > 0 else np.zeros(len(values), dtype=bool)
    inverse = right[kept].T / values[kept] / scale[:, None]
    return inverse @ (left[:, kept].T @ target), inverse @ inverse.T


def first_states(model: Model, data: Measurements) -> np.ndarray:
    """States to begin with: measured ones as measured, velocities by differences, others mid-domain."""
    states = np.tile(model.domain.mean(axis=1), (len(data.t), 1))
    from_output = {str(formula): place for place, (_, formula) in enumerate(model.outputs)}
    derivative_of = {
        str(equation): name
        for name, equation, is_definition in zip(model.states, model.equations, model.kinematic, strict=True)
        if is_definition
    }
    for place, name in enumerate(model.states):
        if name in from_output:
            states[:, place] = _filled(data, data.outputs[:, from_output[name]])
    for place, name in enumerate(model.states):
        if name not in from_output and derivative_of.get(name) in from_output:
            position = _filled(data, data.outputs[:, from_output[derivative_of[name]]])
            for begin, end in zip(data.first[:-1], data.first[1:], strict=True):
                if end - begin > 1:
                    states[begin:end, place] = np.gradient(position[begin:end], data.t[begin:end])
    return states


def first_noise(model: Model, data: Measurements, x: np.ndarray) -> Noise:
    """Noise to begin with: what third differences show of the outputs, and a drive as large as the motion."""
    measurement = data.roughness
    rows = data.begins
    step = (data.t[rows + 1] - data.t[rows])[:, None]
    process = 0.01 * np.mean((x[rows + 1] - x[rows]) ** 2 / step, axis=0)
    spread = np.ptp(model.domain, axis=1) ** 2 / (data.t[-1] - data.t[0] + 1e-300)
    process = np.where(process > 0, process, 1e-4 * np.abs(spread))
    return Noise(measurement, np.where(model.kinematic, 0.0, process))


def estimate_noise(linearisation: Linearisation, data: Measurements, start: Noise) -> Noise:
    """The noise of highest restricted likelihood along the trajectories in hand.

    The parameters are those that are best for the noise that the search begins with: they depend little on
    it, and a fit returns here once they have settled.

    Parameters
    ----------
    linearisation
        Along the trajectories.
    data
        The measurements.
    start
        Where the search begins. A process noise that is zero stays so.
    """
    driven = np.flatnonzero(start.process > 0)
    outputs = len(start.measurement)
    white = whiten(linearisation, data, start)
    linearisation = _with_parameters_changed(linearisation, solve(white.columns, white.innovations)[0])

    def noise_at(logarithms: np.ndarray) -> Noise:
        process = np.zeros_like(start.process)
        process[driven] = start.process[driven] * np.exp(logarithms[outputs:])
        return Noise(start.measurement * np.exp(logarithms[:outputs]), process)

    def cost(logarithms: np.ndarray) -> float:
        value = -log_likelihood(linearisation, data, noise_at(logarithms))
        return value if np.isfinite(value) else 1e300

    begins = [np.zeros(outputs + len(driven))]
    for factor in (1e-2, 1e-4, 1e-6) if len(driven) else ():
        begins.append(np.concatenate([np.zeros(outputs), np.full(len(driven), np.log(factor))]))
    best = min(begins, key=cost)
    # States that random forces drive could follow every sample; the noise of a sensor never vanishes.
    least = np.log(SMOOTHEST * data.roughness / start.measurement)
    bounds = [(min(least[k], 0.0), best[k] + 12.0) for k in range(outputs)]
    bounds += [(np.log(LOWEST), 12.0)] * len(driven)
    found = scipy.optimize.minimize(
        cost, best, method="L-BFGS-B", bounds=bounds, options={"maxiter": 12, "ftol": 1e-7, "eps": 1e-3}
    )
    logarithms = found.x if found.fun <= cost(best) else best
    noise = noise_at(logarithms)
    gone = logarithms[outputs:] <= np.log(LOWEST) + 1
    noise.process[driven[gone]] = 0.0
    return noise


def _with_parameters_changed(linearisation: Linearisation, change: np.ndarray) -> Linearisation:
    """The linearisation after a change of the parameters, which are then no longer free."""
    return replace(
        linearisation,
        gap=linearisation.gap + linearisation.response @ change,
        residual=linearisation.residual - linearisation.measured_response @ change,
        response=np.zeros((*linearisation.gap.shape, 0)),
        measured_response=np.zeros((*linearisation.residual.shape, 0)),
    )


def log_likelihood(linearisation: Linearisation, data: Measurements, noise: Noise) -> float:
    """Restricted log-likelihood along the trajectories in hand, the parameters at their best."""
    total, log_determinant, freedom = noise_likelihood(
        data.first,
        linearisation.transition,
        linearisation.response,
        linearisation.gap,
        linearisation.measured,
        linearisation.measured_response,
        linearisation.residual,
        np.append(np.diff(data.t), 0.0),
        noise.measurement,
        noise.process,
    )
    return -0.5 * (total + log_determinant + freedom * np.log(2 * np.pi))


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
            noise = _noise_along(current, data, noise, estimate_process)
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
    white = whiten(current, data, noise)
    if not np.isfinite(white.columns).all() or not np.isfinite(white.innovations).all():
        return _failed(model, x, noise, current, substeps)
    change, covariance = solve(white.columns, white.innovations)
    # The last change is below the errors. The likelihood is that of the states in hand, not of a forecast.
    total = float(white.innovations @ white.innovations)
    return Fit(
        model=model.with_values(_changed(values, free, change if converged else 0 * change)),
        covariance=covariance,
        x=x,
        noise=noise,
        linearisation=current,
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
    still = _with_parameters_changed(linearisation, change)
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


def _noise_along(
    linearisation: Linearisation, data: Measurements, noise: Noise, estimate_process: bool
) -> Noise:
    if estimate_process and (noise.process > 0).any():
        return estimate_noise(linearisation, data, noise)
    white = whiten(linearisation, data, noise)
    change, _ = solve(white.columns, white.innovations)
    left = (white.innovations - white.columns @ change).reshape(len(data.t), -1)
    known = white.known.reshape(left.shape)
    # Each output has its share of the initial states and parameters.
    share = (white.degrees_of_freedom - len(change)) / known.sum()
    factor = (left**2).sum(axis=0) / np.maximum(known.sum(axis=0) * share, 1.0)
    if (noise.process > 0).any():  # one scale for both, since only their ratio is given
        factor = np.full_like(factor, (left**2).sum() / (known.sum() * share))
        return Noise(noise.measurement * factor, noise.process * factor[0])
    return replace(noise, measurement=noise.measurement * np.maximum(factor, 1e-12))


def _stands_still(totals: list[float]) -> bool:
    """Whether a fit moves without becoming better: where f jumps its derivatives are never exact."""
    recent = totals[-4:]
    return max(recent) - min(recent) < STANDSTILL * max(recent)


def _changed(values: np.ndarray, free: np.ndarray, change: np.ndarray) -> np.ndarray:
    result = values.copy()
    result[free] += change
    return result


def _orthonormal(columns: np.ndarray) -> np.ndarray:
    """Orthonormal basis of what columns span."""
    scale = np.sqrt((columns**2).sum(axis=0))
    scale[scale == 0] = 1.0
    basis, triangle = np.linalg.qr(columns / scale)
    values = np.abs(np.diag(triangle))
    if values.min(initial=1.0) <= RANK * values.max(initial=0.0):
        basis, values, _ = np.linalg.svd(columns / scale, full_matrices=False)
        basis = basis[:, values > RANK * max(values[0], 1e-300)]
    return basis


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


def _filled(data: Measurements, column: np.ndarray) -> np.ndarray:
    """A measured column with gaps filled linearly."""
    known = np.isfinite(column)
    if known.all() or not known.any():
        return np.nan_to_num(column)
    return np.interp(np.arange(len(column)), np.flatnonzero(known), column[known])
