"""Maximum likelihood: parameters, states and both kinds of noise from recordings.

The model is fitted with noise in what is measured (variance R) and, where asked, noise that drives the states
(intensity Q per time). With Q = 0 this is the least-squares fit of whole trajectories. With Q > 0 it is the
extended Kalman filter, linearised at what it knows at the begin of each interval, whose likelihood is that
of its innovations. Linearising along *smoothed* states, which know the future, would be another thing: what
process noise did later is then in the states at which f is taken, and the coefficients of f come out too
small, by a half where sensor and process noise do alike. Smoothed states are where the filter begins, since
they follow the data whatever the model says, and they are what is shown of the motion.

A model that lacks physics is fitted with Q > 0 too, so that a later addition is judged along the right
trajectories. Initial states are unknown and enter as fixed effects; the variances are those of highest
restricted likelihood, which allows for these and for the parameters.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.optimize

from siq.inference.budget import Budget, evaluation
from siq.inference.kalman_filter import (
    RANK,
    ClosedFunctions,
    Grid,
    Linearisation,
    Noise,
    linearise,
    middle_spread,
    solve,
    substeps_needed,
    whiten,
    with_parameters_changed,
)
from siq.inference.measurements import Expectations, Measurements
from siq.systems.dynamics import Dynamics

PIECE = 500  # samples in one stretch, so that its unknown first state hardly matters
MIN_ROUGHNESS_SHARE = 1e-4  # least measurement noise, as a share of what third differences show
COARSE_SAMPLES = 8000  # whose noise is known to 2 %: enough to begin with
LOGARITHM_STEP = 0.05  # numerical: for differences of the likelihood
MIN_CURVATURE = 1.0  # along a logarithm, from which on its standard error is below one
MAX_CORRECTION = 0.5  # of a logarithm, within which the likelihood is a parabola
NO_PROCESS_NOISE = np.exp(-23.0)  # relative to where the search began; below it there is none
SHORTEST_STEP = 1 / 64
INEXACT = 1e-4  # numerical: of effects carried along whole trajectories, where f may jump, the rest is error
NONLINEAR = 0.5  # share of a step's effect that may be unforeseen before the step is shortened
HARMLESS = 0.1  # of a filter's own corrections: what is unforeseen below that is corrected as they are
RUNS_AWAY = "the simulation runs away between two samples"
SUBSTEP_ERROR = 3e-6  # of the spread of a state: far below what any sensor resolves
SETTLED = 1e-4  # change of the innovations, squared and per sample, at which a fit has converged
FINE = 1e-3  # the same of all innovations together, by the parameters: a thirtieth of a standard error
STANDSTILL = 0.005  # change of the sum of squares over four steps, below which a fit moves to no avail
PATIENCE = 6  # steps before that is asked
RESTING = 1e-12  # of a state's domain, the least that its spread is taken for


def first_noise(model: Dynamics, data: Measurements, x: np.ndarray) -> Noise:
    """Noise to begin with: what third differences show of the outputs, and a drive as large as the motion."""
    rows = data.begins
    step = data.step[rows, None]
    process = 0.01 * np.mean((x[rows + 1] - x[rows]) ** 2 / step, axis=0)
    if not (process > 0).all():
        spread = np.ptp(model.limits, axis=1) ** 2 / (data.t[-1] - data.t[0] + 1e-300)
        # Of a state at rest whose domain nobody knows, what its own equation moves it by.
        signals = data.signals(data.t, data.recording, delays=model.lags(model.values))
        rates = model.functions.rates(x.T, signals, model.values).T
        rates = np.where(np.isfinite(rates), rates, 0.0)
        moved = np.mean(rates[rows] ** 2 * step, axis=0)
        process = np.where(process > 0, process, np.where(np.isfinite(spread), 1e-4 * spread, 0.01 * moved))
    return Noise(data.with_known_noise(data.roughness), np.where(model.kinematic, 0.0, process))


@dataclass(frozen=True)
class NoiseCoordinates:
    """The parameters of a noise as one vector: logarithms of variances, then correlations of process noise.

    Attributes
    ----------
    origin
        The noise at zero. A process noise that is zero there stays so.
    known
        Which variances of the measurement are known, and stay as they are; shape ``(m,)``.
    """

    origin: Noise
    known: np.ndarray

    @property
    def driven(self) -> np.ndarray:
        """Places of the states that process noise drives."""
        return np.flatnonzero(self.origin.process > 0)

    @property
    def correlates(self) -> bool:
        """Whether a correlation of the process noise is among the parameters."""
        return self.origin.shape is not None and len(self.origin.shape) == 1

    @property
    def size(self) -> int:
        """Number of parameters."""
        count = len(self.driven)
        pairs = count * (count - 1) // 2 if self.correlates else 0
        return len(self.known) + count + pairs

    def noise_at(self, vector: np.ndarray) -> Noise:
        """The noise for a vector, shape ``(size,)``."""
        outputs, driven = len(self.known), self.driven
        process = np.zeros_like(self.origin.process)
        process[driven] = self.origin.process[driven] * np.exp(vector[outputs : outputs + len(driven)])
        logarithms = np.where(self.known, 0.0, vector[:outputs])
        result = replace(
            self.origin, measurement=self.origin.measurement * np.exp(logarithms), process=process
        )
        if not self.correlates or len(driven) < 2:
            return result
        assert self.origin.shape is not None
        root = np.linalg.cholesky(self.origin.shape[0][np.ix_(driven, driven)])
        change = np.eye(len(driven))
        change[np.tril_indices(len(driven), -1)] = vector[outputs + len(driven) :]
        root = root @ change
        root /= np.linalg.norm(root, axis=1)[:, None]
        shape = self.origin.shape.copy()
        shape[0][np.ix_(driven, driven)] = root @ root.T
        return replace(result, shape=shape)


def _estimate_noise(
    linearisation: Linearisation,
    data: Measurements,
    start: Noise,
    *,
    expected: Expectations | None = None,
    charge: Callable[[float], None] | None = None,
    coarse: bool = False,
) -> Noise:
    """The noise of highest restricted likelihood along the trajectories in hand.

    The parameters are those that are best for the noise that the search begins with: they depend little on
    it, and a fit returns here once they have settled.
    """
    coordinates = NoiseCoordinates(start, data.known_sensors)
    driven, outputs = coordinates.driven, len(start.measurement)
    white = whiten(linearisation, data, start)
    columns, innovations = (expected or Expectations.none()).stacked_on(white.columns, white.innovations)
    whole = with_parameters_changed(linearisation, solve(columns, innovations)[0])
    count = len(data.t)
    # Pieces spread over all recordings, where there are many more samples than are needed.
    rows, first = np.arange(count), data.first
    if count > 2 * COARSE_SAMPLES:
        keep, kept = COARSE_SAMPLES / count, []
        for begin, end in zip(data.first[:-1], data.first[1:], strict=True):
            pieces = max(round((end - begin) * keep / PIECE), 1)
            length = max(int((end - begin) * keep / pieces), 1)
            kept += [
                np.arange(at, at + length) for at in np.linspace(begin, end - length, pieces).astype(int)
            ]
        rows, first = np.concatenate(kept), np.cumsum([0, *map(len, kept)])

    def cost_along(rows: np.ndarray, first: np.ndarray) -> Callable[[np.ndarray], float]:
        part, step = whole if len(rows) == count else whole.at_rows(rows), data.step[rows]

        def cost(vector: np.ndarray) -> float:
            if charge is not None:
                charge(len(rows) / count)
            noise = coordinates.noise_at(vector)
            if len(rows) < count and noise.shape is not None and len(noise.shape) > 1:
                noise = replace(noise, shape=noise.shape[rows])
            total, log_determinant, freedom = part.sums(first, step, noise)
            value = 0.5 * (total + log_determinant + freedom * np.log(2 * np.pi))
            return value if np.isfinite(value) else 1e300

        return cost

    cost = cost_along(rows, first)
    begins = [np.zeros(coordinates.size)]
    # Upwards, too: a candidate that promised to need hardly any process noise may not have kept that.
    for factor in (1e-2, 1e-4, 1e-6, 1e2, 1e4) if len(driven) else ():
        begins.append(np.zeros(coordinates.size))
        begins[-1][outputs : outputs + len(driven)] = np.log(factor)
    best = min(begins, key=cost)
    # States that process noise drives could follow every sample; the noise of a sensor never vanishes.
    least = np.log(MIN_ROUGHNESS_SHARE * data.roughness / start.measurement)
    bounds = [
        (0.0, 0.0) if coordinates.known[k] else (min(least[k], 0.0), best[k] + 12.0) for k in range(outputs)
    ]
    bounds += [(np.log(NO_PROCESS_NOISE), 12.0)] * len(driven)
    bounds += [(-10.0, 10.0)] * (coordinates.size - len(bounds))
    vector = _lowest(cost, best, bounds)
    if len(rows) < count and not coarse:
        everything = cost_along(np.arange(count), data.first)
        vector = _corrected(vector, everything, cost, ratio=count / len(rows), bounds=bounds)
    noise = coordinates.noise_at(vector)
    gone = vector[outputs : outputs + len(driven)] <= np.log(NO_PROCESS_NOISE) + 1
    noise.process[driven[gone]] = 0.0
    return noise


def _lowest(
    cost: Callable[[np.ndarray], float], begin: np.ndarray, bounds: Sequence[tuple[float, float]]
) -> np.ndarray:
    found = scipy.optimize.minimize(
        cost, begin, method="L-BFGS-B", bounds=bounds, options={"maxiter": 12, "ftol": 1e-7, "eps": 1e-3}
    )
    return found.x if found.fun <= cost(begin) else begin


def _corrected(
    vector: np.ndarray,
    whole: Callable[[np.ndarray], float],
    some: Callable[[np.ndarray], float],
    *,
    ratio: float,
    bounds: Sequence[tuple[float, float]],
) -> np.ndarray:
    """The minimum of a cost from that of a part of it, by one Newton step with the curvature of the part.

    What is left is of second order in the difference of the two, which many samples make small; where they
    differ so much that the step leads upwards all is searched. The whole is larger by the ratio, and a
    coordinate at one of its bounds stays there.
    """
    lower, upper = np.array(bounds).T
    inside = np.flatnonzero((vector > lower + LOGARITHM_STEP) & (vector < upper - LOGARITHM_STEP))
    unit = LOGARITHM_STEP * np.eye(len(vector))[inside]
    middle, part = whole(vector), some(vector)
    ahead = np.array([some(vector + one) for one in unit])
    curvature = np.empty((len(inside), len(inside)))
    for row, one in enumerate(unit):
        curvature[row, row] = ahead[row] + some(vector - one) - 2 * part
        for column in range(row):
            both = some(vector + one + unit[column])
            curvature[row, column] = curvature[column, row] = both - ahead[row] - ahead[column] + part
    curvature *= ratio / LOGARITHM_STEP**2
    slope = np.array([whole(vector + one) - middle for one in unit]) / LOGARITHM_STEP
    slope = slope - LOGARITHM_STEP / 2 * np.diag(curvature)
    values, directions = np.linalg.eigh(curvature)
    # Where the likelihood is flat, as towards no process noise, there is nothing to correct.
    curved = directions[:, values > MIN_CURVATURE]
    step = -curved @ (curved.T @ slope / values[values > MIN_CURVATURE])
    moved = vector.copy()
    moved[inside] += np.clip(step, -MAX_CORRECTION, MAX_CORRECTION)
    return moved if whole(moved) <= middle else _lowest(whole, vector, bounds)


def log_likelihood(linearisation: Linearisation, data: Measurements, noise: Noise) -> float:
    """Restricted log-likelihood along the trajectories in hand, the parameters at their best."""
    total, log_determinant, freedom = linearisation.sums(data.first, data.step, noise)
    return -0.5 * (total + log_determinant + freedom * np.log(2 * np.pi))


def _noise_along(
    linearisation: Linearisation,
    data: Measurements,
    noise: Noise,
    estimate_process: bool,
    *,
    expected: Expectations,
    charge: Callable[[float], None] | None = None,
    coarse: bool = False,
) -> Noise:
    """The noise along the trajectories in hand, the process noise only where it is to be estimated, too."""
    driven = bool((noise.process > 0).any())
    if estimate_process and driven:
        return _estimate_noise(linearisation, data, noise, expected=expected, charge=charge, coarse=coarse)
    if driven and data.sensor_noise is not None:
        return noise
    white = whiten(linearisation, data, noise)
    change, covariance = solve(*expected.stacked_on(white.columns, white.innovations))
    determined = len(change) - float(np.einsum("rp,pq,rq->", expected.rows, covariance, expected.rows))
    left = (white.innovations - white.columns @ change).reshape(len(data.t), -1)
    known = white.known.reshape(left.shape)
    # Each output has its share of the initial states and parameters.
    share = (white.degrees_of_freedom - determined) / known.sum()
    factor = (left**2).sum(axis=0) / np.maximum(known.sum(axis=0) * share, 1.0)
    if driven:  # one scale for both, since only their ratio is given
        factor = np.full_like(factor, (left**2).sum() / (known.sum() * share))
        return replace(noise, measurement=noise.measurement * factor, process=noise.process * factor[0])
    return replace(noise, measurement=data.with_known_noise(noise.measurement * np.maximum(factor, 1e-12)))


@dataclass(frozen=True)
class _Iterate:
    """Where a fit stands.

    Attributes
    ----------
    values
        All parameters, shape ``(p,)``.
    x
        The states at which f is taken, shape ``(n, d)``.
    along
        The linearisation there.
    smoothed
        The states given all measurements, shape ``(n, d)``.
    spread
        Covariance of what a filter knows at each sample, shape ``(n, d, d)``; None where nothing drives the
        states.
    """

    values: np.ndarray
    x: np.ndarray
    along: Linearisation
    smoothed: np.ndarray
    spread: np.ndarray | None = None


@dataclass(frozen=True)
class _Shooting:
    """A model to be fitted, on the grid of its measurements.

    Attributes
    ----------
    model, grid
        The dynamics, on the grid of the measurements.
    scale
        The size of each state, shape ``(d,)``.
    filtered
        Whether f is taken at what a filter knows, rather than at smoothed states.
    closed
        f with the effect of the filter's spread on it, where that is wanted.
    budget
        Charged for every evaluation; None where nobody counts.
    """

    model: Dynamics
    grid: Grid
    scale: np.ndarray
    filtered: bool = False
    closed: ClosedFunctions | None = None
    budget: Budget | None = None

    @property
    def resolution(self) -> float:
        """Least relative singular value with which effects of parameters are distinct; see `solve`."""
        return RANK if self.filtered else INEXACT

    def charge(self, evaluations: float = 1.0) -> None:
        """Count evaluations of the likelihood.

        Raises
        ------
        BudgetSpent
            When nothing is left of what is allowed.
        """
        if self.budget is not None:
            self.budget.charge(evaluations * evaluation(self.model, self.grid.data))

    def linearised(
        self, values: np.ndarray, x: np.ndarray, spread: np.ndarray | None, noise: Noise
    ) -> Linearisation:
        """At parameters ``(p,)`` and states ``(n, d)``."""
        self.charge(self.grid.substeps)
        if self.closed is None or spread is None:
            return linearise(self.model, self.grid, values, x)
        rows, data = self.grid.rows, self.grid.data
        intensity = noise.intensity if len(noise.intensity) == 1 else noise.intensity[rows]
        drift = self.closed.at(middle_spread(spread[rows], intensity, data.step[rows]))
        return linearise(self.model, self.grid, values, x, drift=drift)

    def noise_at(self, now: _Iterate, noise: Noise) -> Noise:
        """The noise where a fit stands: process noise may depend on the state."""
        if noise.field is None:
            return noise
        rows, middle = self.grid.rows, now.x.copy()
        middle[rows] += (now.x[rows + 1] + now.along.gap[rows] - now.x[rows]) / 2
        return noise.along(middle, now.spread, self.grid.data.step)

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
        smoothed, known, covariance = _state_changes(now.along, self.grid.data, noise, change)
        deviation = known if self.filtered else smoothed
        spread = covariance if noise.process.any() else None
        rows, scale = self.grid.rows, self.scale
        moved = np.einsum("kij,kj->ki", now.along.transition[rows], deviation[rows])
        moved += now.along.response[rows] @ change
        foreseen = now.along.gap[rows] + moved - deviation[rows + 1]
        effect = np.sqrt(np.mean(((np.abs(moved) + np.abs(deviation[rows + 1])) / scale) ** 2))
        # A filter's gaps are its corrections at each sample, which both kinds of noise ask for anyway.
        usual = np.sqrt(np.mean((now.along.gap[rows] / scale) ** 2)) if self.filtered else 0.0
        length = 1.0
        while length >= SHORTEST_STEP:
            values = _changed(self.model, now.values, length * change)
            x = now.x + length * deviation
            along = self.linearised(values, x, spread, noise)
            if along.finite:
                expected = (1 - length) * now.along.gap[rows] + length * foreseen
                unforeseen = np.sqrt(np.mean(((along.gap[rows] - expected) / scale) ** 2))
                if unforeseen <= NONLINEAR * length * effect + HARMLESS * usual + 1e-9:
                    return _Iterate(values, x, along, now.x + length * smoothed, spread), length
            length /= 2
        return None


def _state_changes(
    linearisation: Linearisation, data: Measurements, noise: Noise, change: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Most probable states after a change of the free parameters, see `Linearisation.smoothed`."""
    still = with_parameters_changed(linearisation, change)
    innovations, _, initial = still.filtered(data.first, data.step, noise.measurement, noise.intensity)[:3]
    begin = np.empty((len(data.labels), still.gap.shape[1]))
    for place, (start, end) in enumerate(zip(data.first[:-1], data.first[1:], strict=True)):
        columns = initial[start:end].reshape(-1, begin.shape[1])
        begin[place] = solve(columns, innovations[start:end].ravel(), least=INEXACT)[0]
    return still.smoothed(data.first, data.step, noise, begin)


def _changed(model: Dynamics, values: np.ndarray, change: np.ndarray) -> np.ndarray:
    """Parameters' values after a change of the free ones."""
    result = values.copy()
    result[list(model.free)] += change
    return result


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
    linearised_at
        Where f was taken for `linearisation`, shape ``(n, d)``: `x` without process noise, otherwise what the
        filter knows at each sample.
    spread
        Covariance of what the filter knows at each sample, shape ``(n, d, d)``; None without process noise.
    noise
        Estimates, or what was given.
    linearisation
        At `linearised_at` and the estimates.
    log_likelihood
        Not the restricted one, which depends on the units in which a model has its states.
    sum_of_squares
        Of the whitened innovations, and of what is expected of parameters: about `degrees_of_freedom` where
        the model is right.
    degrees_of_freedom
        Measured values, and what is expected of several parameters together, less initial states and free
        parameters.
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
    linearised_at: np.ndarray
    spread: np.ndarray | None
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


def fit_of_states(
    model: Dynamics, data: Measurements, *, x: np.ndarray, noise: Noise, substeps: int, converged: bool
) -> Fit:
    """A fit that was made otherwise: without process noise, its states follow the equations.

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
    at = _Iterate(model.values, x, linearise(model, Grid(data, substeps), model.values, x), x)
    if not at.along.finite:
        return _failed_fit(model, at, noise, substeps, RUNS_AWAY)
    try:
        noise = _noise_along(at.along, data, noise, False, expected=Expectations.of(model))
        return _fit_at(
            model, data, at, noise=noise, substeps=substeps, converged=converged, resolution=INEXACT
        )
    except (ArithmeticError, np.linalg.LinAlgError) as error:
        return _failed_fit(model, at, noise, substeps, str(error))


def _fit_at(
    model: Dynamics,
    data: Measurements,
    at: _Iterate,
    *,
    noise: Noise,
    substeps: int,
    converged: bool,
    resolution: float,
) -> Fit:
    """The fit whose iteration ended at parameters, states and noise."""
    white = whiten(at.along, data, noise)
    expected = Expectations.of(model, at.values)
    columns, innovations = expected.stacked_on(white.columns, white.innovations)
    change, covariance = solve(columns, innovations, least=resolution)
    # The last change is below the errors. The likelihood is that of the states in hand, not of a forecast.
    total = float(innovations @ innovations)
    together = sum(len(each.roots) for each in model.expected_together)
    return Fit(
        model=model.with_values(_changed(model, at.values, change if converged else 0 * change)),
        covariance=covariance,
        x=at.smoothed,
        linearised_at=at.x,
        spread=at.spread,
        noise=noise,
        linearisation=at.along,
        log_likelihood=white.log_likelihood(total),
        sum_of_squares=total,
        degrees_of_freedom=white.degrees_of_freedom + together - len(model.free),
        substeps=substeps,
        converged=converged,
    )


def _failed_fit(model: Dynamics, at: _Iterate, noise: Noise, substeps: int, fault: str) -> Fit:
    """A fit that has no result, and the reason; see `Fit.fault`."""
    free = len(model.free)
    return Fit(
        model=model,
        covariance=np.full((free, free), np.nan),
        x=at.smoothed,
        linearised_at=at.x,
        spread=at.spread,
        noise=noise,
        linearisation=at.along,
        log_likelihood=-np.inf,
        sum_of_squares=np.inf,
        degrees_of_freedom=1,
        substeps=substeps,
        converged=False,
        fault=fault,
    )


def fit_by_multiple_shooting(
    model: Dynamics,
    data: Measurements,
    *,
    x: np.ndarray,
    noise: Noise,
    estimate_process: bool,
    substeps: int | None = None,
    iterations: int = 25,
    budget: Budget | None = None,
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
    budget
        Charged for every evaluation.

    Returns
    -------
    Fit
        Not converged, with a log-likelihood of -∞ and the reason as its `fault`, where the simulation runs
        away.

    Raises
    ------
    BudgetSpent
        When nothing is left of what is allowed.
    """
    with np.errstate(all="ignore"):  # what runs away is told as a fault
        if substeps is None:
            substeps = substeps_needed(model, data, model.values, x, tolerance=SUBSTEP_ERROR)
        grid = Grid(data, substeps)
        begin = _Iterate(model.values, x, linearise(model, grid, model.values, x), x)
        shooting = _Shooting(model, grid, _sizes(model, x), budget=budget)
        fit = _gauss_newton(shooting, begin, noise, estimate_process=estimate_process, most=iterations)
    if not (fit.converged and fit.has_process_noise):
        return fit
    return fit_by_filter(
        fit.model, data, x=fit.x, noise=fit.noise, estimate_process=estimate_process, substeps=substeps,
        iterations=iterations, closure=False, budget=budget,
    )  # fmt: skip


def fit_by_filter(
    model: Dynamics,
    data: Measurements,
    *,
    x: np.ndarray,
    noise: Noise,
    estimate_process: bool = True,
    estimate_sensor: bool = True,
    substeps: int | None = None,
    iterations: int = 25,
    closure: bool = True,
    budget: Budget | None = None,
) -> Fit:
    """The second half of `fit_by_multiple_shooting` alone, for a model that follows the data from the start.

    Parameters
    ----------
    model, data, x, noise, estimate_process, substeps, iterations, budget
        See there; process noise has to drive the states.
    estimate_sensor
        Whether measurement noise is estimated; if not, the process noise is as given, too.
    closure
        Whether the spread of what the filter knows acts on the mean of f (`siq.inference.kalman_filter`).

    Returns
    -------
    Fit
        See there.
    """
    with np.errstate(all="ignore"):  # what runs away is told as a fault
        if substeps is None:
            substeps = substeps_needed(model, data, model.values, x, tolerance=SUBSTEP_ERROR)
        closed = ClosedFunctions(model) if closure else None
        if not estimate_sensor:
            data = replace(data, sensor_noise=noise.measurement)
        shooting = _Shooting(
            model, Grid(data, substeps), _sizes(model, x), filtered=True, closed=closed, budget=budget
        )
        begin = _Iterate(model.values, x, shooting.linearised(model.values, x, None, noise), x)
        return _gauss_newton(shooting, begin, noise, estimate_process=estimate_process, most=iterations)


def _gauss_newton(
    shooting: _Shooting, begin: _Iterate, noise: Noise, *, estimate_process: bool, most: int
) -> Fit:
    """Gauss–Newton steps from a begin; what leads to no number is a fit with a fault."""
    if not begin.along.finite:
        return _failed_fit(shooting.model, begin, noise, shooting.grid.substeps, RUNS_AWAY)
    try:
        return _descended(shooting, begin, noise, estimate_process=estimate_process, most=most)
    except (ArithmeticError, np.linalg.LinAlgError) as error:
        return _failed_fit(shooting.model, begin, noise, shooting.grid.substeps, str(error))


def _descended(shooting: _Shooting, now: _Iterate, noise: Noise, *, estimate_process: bool, most: int) -> Fit:
    data, model = shooting.grid.data, shooting.model
    before: np.ndarray | None = None
    totals: list[float] = []
    converged, settled_noise, whole = False, False, False
    for iteration in range(most):
        noise = shooting.noise_at(now, noise)
        expected = Expectations.of(model, now.values)
        if iteration in (0, 2) or settled_noise:
            noise = _noise_along(
                now.along, data, noise, estimate_process, expected=expected, charge=shooting.charge,
                coarse=not settled_noise,
            )  # fmt: skip
        shooting.charge()
        white = whiten(now.along, data, noise)
        columns, innovations = expected.stacked_on(white.columns, white.innovations)
        change, _ = solve(columns, innovations, least=shooting.resolution)
        explained = white.columns @ change
        left = white.innovations - explained
        settled = SETTLED * len(left) * max(1.0, (left**2).sum() / len(left))
        # A shortened step leaves much of what is foreseen undone, and the forecast unchanged. So does a whole
        # one where effects are so curved that steps go to and fro: the states in hand have to be as likely
        # as the forecast is, since it is they that the likelihood is of.
        if (
            before is not None
            and whole
            and ((left - before) ** 2).sum() < settled
            and explained @ explained < (FINE if shooting.filtered else settled)
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
        model, data, now, noise=noise, substeps=shooting.grid.substeps, converged=converged,
        resolution=shooting.resolution,
    )  # fmt: skip


def _stands_still(totals: list[float]) -> bool:
    """Whether a fit moves without becoming better: where f jumps its derivatives are never exact."""
    recent = totals[-4:]
    return max(recent) - min(recent) < STANDSTILL * max(recent)


def _sizes(model: Dynamics, x: np.ndarray) -> np.ndarray:
    """By how much each state varies, shape ``(d,)``; not zero where one rests."""
    about_zero = 2 * np.where(x.any(axis=0), np.abs(x).max(axis=0), 1.0)
    wide = np.ptp(model.limits, axis=1)
    return np.maximum(x.std(axis=0), RESTING * np.where(np.isfinite(wide), wide, about_zero))
