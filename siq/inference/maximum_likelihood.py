"""Maximum likelihood: parameters, states and both kinds of noise from recordings.

The model is fitted with noise in what is measured (variance R) and, where asked, noise that drives the states
(intensity Q per time). With Q = 0 this is the least-squares fit of whole trajectories. With Q > 0 it is the
extended Kalman filter, linearised at what it knows at the start of each interval, whose likelihood is that
of its innovations. Linearising along *smoothed* states, which know the future, would be another thing: what
process noise did later is then in the states at which f is taken, and the coefficients of f come out too
small, by a half where sensor and process noise do alike. Smoothed states are where the filter begins, since
they follow the data whatever the model says, and they are what is shown of the motion.

A model that lacks physics is fitted with Q > 0 too, so that a later addition is judged along the right
trajectories. Initial states are unknown and enter as fixed effects; the variances are those of highest
restricted likelihood, which allows for these and for the parameters.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import scipy.optimize

from siq.inference.budget import Budget, evaluation
from siq.inference.kalman_filter import (
    RANK,
    ClosedFunctions,
    Grid,
    Linearisation,
    Noise,
    Whitened,
    linearise,
    solve,
    substeps_needed,
    whiten,
)
from siq.inference.measurements import Measurements, expectations
from siq.systems.dynamics import Dynamics

PIECE = 500  # samples in one stretch, so that its unknown first state hardly matters
MIN_ROUGHNESS_SHARE = 1e-4  # least measurement noise, as a share of what third differences show
COARSE_SAMPLES = 8000  # whose noise is known to 2 %: enough to begin with
LOGARITHM_STEP = 0.05  # numerical: of the logarithm of a variance, for differences of the likelihood
SLOPE_STEP = 1e-3  # numerical: the same for its slope alone
MAX_ERROR = 1.0  # standard error of a logarithm beyond which the likelihood is no parabola
MIN_CURVATURE = 1.0  # along a logarithm, from which on its standard error is below one
MAX_CORRECTION = 0.5  # of a logarithm, within which the likelihood is a parabola
NO_PROCESS_NOISE = np.exp(-23.0)  # relative to where the search began; below it there is none
SHORTEST_STEP = 1 / 64
INEXACT = 1e-4  # numerical: of effects carried along whole trajectories, where f may jump, the rest is error
NONLINEAR = 0.5  # share of a step's effect that may be unforeseen before the step is shortened
HARMLESS = 0.1  # of a filter's own corrections: what is unforeseen below that is corrected as they are
RUNS_AWAY = "the simulation runs away between two samples"
ITERATIONS = 25  # of a fit, at most
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
        # Of a state at rest whose domain is unknown, what its own equation moves it by.
        signals = data.signals(data.t, data.recording, delays=model.lags(model.values))
        rates = model.functions.rates(x.T, signals, model.values).T
        rates = np.where(np.isfinite(rates), rates, 0.0)
        moved = np.mean(rates[rows] ** 2 * step, axis=0)
        process = np.where(process > 0, process, np.where(np.isfinite(spread), 1e-4 * spread, 0.01 * moved))
    return Noise(data.with_known_noise(data.roughness), np.where(model.kinematic, 0.0, process))


def _estimate_noise(
    linearisation: Linearisation, data: Measurements, start: Noise, *,
    expected: tuple[np.ndarray, np.ndarray], charge: Callable[[float], None] | None = None,
    coarse: bool = False,
) -> Noise:  # fmt: skip
    """The noise of highest restricted likelihood along the trajectories in hand."""
    # The parameters are those that are best for the noise that the search begins with: they depend little on
    # it, and a fit returns here once they have settled.
    known, driven, outputs = data.known_sensors, start.driven, len(start.measurement)
    whole = linearisation.with_parameters_changed(whiten(linearisation, data, start).solve(expected)[0])
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
            noise = start.moved(vector, known)
            if len(rows) < count and noise.shape is not None and len(noise.shape) > 1:
                noise = replace(noise, shape=noise.shape[rows])
            value = -part.log_likelihood(first, step, noise)
            return value if np.isfinite(value) else 1e300

        return cost

    cost, of_process = cost_along(rows, first), np.zeros(start.coordinates)
    of_process[outputs : outputs + len(driven)] = 1.0
    # Upwards, too: a candidate that promised to need hardly any process noise may not have kept that.
    factors = (1.0, 1e-2, 1e-4, 1e-6, 1e2, 1e4) if len(driven) else (1.0,)
    best = min((np.log(factor) * of_process for factor in factors), key=cost)
    # States that process noise drives could follow every sample; the noise of a sensor never vanishes.
    least = np.log(MIN_ROUGHNESS_SHARE * data.roughness / start.measurement)
    bounds = [(0.0, 0.0) if known[k] else (min(least[k], 0.0), best[k] + 12.0) for k in range(outputs)]
    bounds += [(np.log(NO_PROCESS_NOISE), 12.0)] * len(driven)
    bounds += [(-10.0, 10.0)] * (start.coordinates - len(bounds))
    vector = _lowest(cost, best, bounds)
    if len(rows) < count and not coarse:
        everything = cost_along(np.arange(count), data.first)
        vector = _corrected(vector, everything, cost, ratio=count / len(rows), bounds=bounds)
    noise = start.moved(vector, known)
    gone = vector[outputs : outputs + len(driven)] <= np.log(NO_PROCESS_NOISE) + 1
    process = noise.process.copy()
    process[driven[gone]] = 0.0
    return replace(noise, process=process)


def _lowest(
    cost: Callable[[np.ndarray], float], begin: np.ndarray, bounds: Sequence[tuple[float, float]]
) -> np.ndarray:
    _, upper = np.array(bounds).T
    free = np.flatnonzero(np.ptp(bounds, axis=1))

    def with_slope(vector: np.ndarray) -> tuple[float, np.ndarray]:
        """The cost and its differences, backwards at an upper bound."""
        value, slope = cost(vector), np.zeros(len(vector))
        for place in free:
            step, moved = SLOPE_STEP, vector.copy()
            if vector[place] + step > upper[place]:
                step = -step
            moved[place] += step
            slope[place] = (cost(moved) - value) / (moved[place] - vector[place])
        return value, slope

    found = scipy.optimize.minimize(
        with_slope, begin, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 12, "ftol": 1e-7}
    )
    return found.x if found.fun <= cost(begin) else begin


def _corrected(
    vector: np.ndarray, whole: Callable[[np.ndarray], float], some: Callable[[np.ndarray], float], *,
    ratio: float, bounds: Sequence[tuple[float, float]],
) -> np.ndarray:  # fmt: skip
    """The minimum of a cost from that of a part of it, by one Newton step with the curvature of the part."""
    # What is left is of second order in the difference of the two, which many samples make small; where they
    # differ so much that the step leads upwards all is searched. The whole is larger by the ratio, and a
    # coordinate at one of its bounds stays there.
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


def noise_uncertainty(fit: Fit, data: Measurements) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Errors of the noise of a fit, by the curvature of the likelihood along its trajectories.

    Standard errors of the logarithms of the sensors' variances ``(m,)``, and of the intensities of the
    process noise ``(d,)``: infinite where one is only bounded from above, zero where it was given. And the
    covariance of the free parameters ``(p, p)``, with what the noise leaves open in them; and of these with
    the logarithms of the intensities behind them, ``(p + d, p + d)``.
    """
    known, line, driven = data.known_sensors, fit.linearisation, fit.noise.driven
    outputs, size = len(known), fit.noise.coordinates
    still = line.with_parameters_changed(whiten(line, data, fit.noise).solve()[0])
    places = [k for k in range(size) if k >= outputs or not known[k]]

    def moved(*changes: tuple[int, float]) -> Noise:
        vector = np.zeros(size)
        for place, change in changes:
            vector[place] += change
        return fit.noise.moved(vector, known)

    def value(*changes: tuple[int, float]) -> float:
        return still.log_likelihood(data.first, data.step, moved(*changes))

    middle, h = value(), LOGARITHM_STEP
    single = {k: (value((k, h)), value((k, -h))) for k in places}
    curvature = np.diag([(2 * middle - single[k][0] - single[k][1]) / h**2 for k in places])
    for row, one in enumerate(places):
        for column, other in enumerate(places[:row]):
            both = value((one, h), (other, h)) + value((one, -h), (other, -h))
            apart = value((one, h), (other, -h)) + value((one, -h), (other, h))
            curvature[row, column] = curvature[column, row] = (apart - both) / (4 * h**2)
    told = np.diag(curvature) > 1 / MAX_ERROR**2
    errors = np.full(size, np.inf)
    errors[:outputs][known] = 0.0
    inside = [place for place, seen in zip(places, told, strict=True) if seen]
    covariance, together = fit.covariance, np.zeros((size, size))
    slopes = np.zeros((len(covariance), size))
    if inside:
        ends = [[whiten(line, data, moved((one, step))).solve()[0] for step in (h, -h)] for one in inside]
        slope = np.stack([(up - down) / (2 * h) for up, down in ends], axis=1)
        # The parameters follow the noise, and what they take over is not told of it.
        followed = slope.T @ np.linalg.pinv(covariance, hermitian=True) @ slope
        levels, ways = np.linalg.eigh(curvature[np.ix_(told, told)] - followed)
        of_noise = (ways / np.maximum(levels, 1 / MAX_ERROR**2)) @ ways.T
        errors[inside] = np.sqrt(np.diag(of_noise))
        together[np.ix_(inside, inside)], slopes[:, inside] = of_noise, slope
        covariance = covariance + slope @ of_noise @ slope.T
    process, count = np.zeros_like(fit.noise.process), len(covariance)
    process[driven] = errors[outputs : outputs + len(driven)]
    own, joint = slice(outputs, outputs + len(driven)), np.zeros((count + len(process),) * 2)
    joint[:count, :count] = covariance
    joint[:count, count + driven] = (slopes @ together)[:, own]
    joint[count + driven, :count] = joint[:count, count + driven].T
    joint[np.ix_(count + driven, count + driven)] = together[own, own]
    return errors[:outputs], process, covariance, joint


def _noise_along(
    linearisation: Linearisation, data: Measurements, noise: Noise, estimate_process: bool, *,
    expected: tuple[np.ndarray, np.ndarray], **search: Any,
) -> Noise:  # fmt: skip
    """The noise along the trajectories in hand, the process noise only where it is to be estimated, too."""
    driven = bool((noise.process > 0).any())
    if estimate_process and driven:
        return _estimate_noise(linearisation, data, noise, expected=expected, **search)
    if driven and data.sensor_noise is not None:
        return noise
    white = whiten(linearisation, data, noise)
    change, covariance = white.solve(expected)
    determined = len(change) - float(np.einsum("rp,pq,rq->", expected[0], covariance, expected[0]))
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
class Fit:
    """A fitted model."""

    model: Dynamics  #: with the estimates as its parameters' values
    covariance: np.ndarray  #: of the free ones, shape ``(p, p)``
    x: np.ndarray  #: smoothed states at all samples, shape ``(n, d)``
    #: Where f was taken, shape ``(n, d)``: x without process noise, otherwise what the filter knows there.
    linearised_at: np.ndarray
    spread: np.ndarray | None  #: covariance of what it knows there, ``(n, d, d)``; None without process noise
    noise: Noise  #: estimates, or what was given
    linearisation: Linearisation  #: there, at the estimates
    #: Not the restricted one, which depends on the units in which a model has its states.
    log_likelihood: float
    #: Of the whitened innovations, and of what is expected of parameters; about as many where the model is
    #: right: measured values, and what is expected of several parameters together, less initial states and
    #: free parameters.
    sum_of_squares: float
    degrees_of_freedom: int
    substeps: int  #: Runge–Kutta steps between samples
    converged: bool  #: whether the iteration settled
    fault: str = ""  #: why there is no result, empty where there is one, settled or not

    @property
    def standard_errors(self) -> np.ndarray:
        """Of the free parameters, shape ``(p,)``."""
        return np.sqrt(np.diag(self.covariance))

    def restricted_likelihood(self, data: Measurements) -> float:
        """The log-likelihood in which it counts, too, how well initial states are known, in their units.

        It compares models in which as many of them are unknown.
        """
        return self.linearisation.log_likelihood(data.first, data.step, self.noise)

    @property
    def error_of(self) -> dict[str, float]:
        """Standard error of every free parameter, by name."""
        names = (self.model.parameters[place].name for place in self.model.free)
        return dict(zip(names, map(float, self.standard_errors), strict=True))

    @property
    def has_process_noise(self) -> bool:
        """Whether the states were let deviate from their equations."""
        return bool((self.noise.process > 0).any())


@np.errstate(all="ignore")  # what runs away is told as a fault
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
    along = linearise(model, Grid(data, substeps), model.values, x)

    def fit(begin: Fit) -> Fit:
        known = _noise_along(along, data, noise, False, expected=expectations(model))
        return _ended(replace(begin, noise=known), data, converged=converged, resolution=INEXACT)

    return _fit_from(model, x, along, noise, substeps, fit)


def _ended(at: Fit, data: Measurements, *, converged: bool, resolution: float) -> Fit:
    """The fit whose iteration ended at parameters, states and noise."""
    white, expected = whiten(at.linearisation, data, at.noise), expectations(at.model)
    change, covariance = white.solve(expected, least=resolution)
    # The last change is below the errors. The likelihood is that of the states in hand, not of a forecast.
    innovations = np.append(white.innovations, expected[1])
    total = float(innovations @ innovations)
    together = sum(len(each.roots) for each in at.model.expected_together)
    there = at.model.moved(change) if converged else at.model
    if (_sides(there, data, at.x) != _sides(at.model, data, at.x)).any():
        there = at.model  # before a pole of f, where what is likeliest lies beyond it
    return replace(
        at, model=there, covariance=covariance,
        log_likelihood=white.log_likelihood(total), sum_of_squares=total,
        degrees_of_freedom=white.degrees_of_freedom + together - len(at.model.free), converged=converged,
    )  # fmt: skip


def _fit_from(
    model: Dynamics, x: np.ndarray, along: Linearisation, noise: Noise, substeps: int,
    fit: Callable[[Fit], Fit],
) -> Fit:  # fmt: skip
    """A fit from a start; where it leads to no finite number, the start itself, with the fault."""
    unknown, fault = np.full((len(model.free),) * 2, np.nan), "" if along.finite else RUNS_AWAY
    begin = Fit(model, unknown, x, x, None, noise, along, -np.inf, np.inf, 1, substeps, False, fault)
    try:
        found = begin if fault else fit(begin)
        return found if np.isfinite(found.log_likelihood) else replace(begin, fault=RUNS_AWAY)
    except (ArithmeticError, np.linalg.LinAlgError) as error:
        return replace(begin, fault=str(error))


class _Shooting:
    """A model to be fitted, on the grid of its measurements, from states ``(n, d)`` to begin with.

    It may be filtered: f is taken at what a filter knows, rather than at smoothed states, and closed, with
    the effect of the filter's spread on f.
    """

    def __init__(
        self, model: Dynamics, data: Measurements, x: np.ndarray, substeps: int | None, *,
        filtered: bool = False, closed: ClosedFunctions | None = None, budget: Budget | None = None,
    ) -> None:  # fmt: skip
        if substeps is None:
            substeps = substeps_needed(model, data, model.values, x)
        about_zero = 2 * np.where(x.any(axis=0), np.abs(x).max(axis=0), 1.0)
        wide = np.ptp(model.limits, axis=1)
        resting = RESTING * np.where(np.isfinite(wide), wide, about_zero)
        self.model, self.grid, self.scale = model, Grid(data, substeps), np.maximum(x.std(axis=0), resting)
        self.filtered, self.closed, self.budget = filtered, closed, budget
        self.sides = _sides(model, data, x)

    def crosses(self, values: np.ndarray, x: np.ndarray) -> bool:
        """Whether a pole of f lies among states that were all on one side of it where the fit began."""
        sides = _sides(self.model.with_values(values), self.grid.data, x) if self.sides.any() else self.sides
        return bool((sides != self.sides)[self.sides != 0].any())

    def change_of(self, now: Fit, white: Whitened, expected: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        """The change of the free parameters that is asked for; what stands before a pole of f stays there."""
        moves = np.ones(len(now.model.free))
        while True:
            rows = (expected[0] * moves, expected[1])
            change = replace(white, columns=white.columns * moves).solve(rows, least=self.resolution)[0]
            alone = np.diag(SHORTEST_STEP * change * moves)
            stuck = [self.crosses(now.model.moved(one).values, now.linearised_at) for one in alone]
            if not np.any(stuck):
                return change
            moves = np.where(stuck, 0.0, moves)

    @property
    def resolution(self) -> float:
        """Least relative singular value with which effects of parameters are distinct; see `solve`."""
        return RANK if self.filtered else INEXACT

    def charge(self, evaluations: float = 1.0) -> None:
        """Count evaluations of the likelihood."""
        if self.budget is not None:
            self.budget.charge(evaluations * evaluation(self.model, self.grid.data))

    def linearised(
        self, values: np.ndarray, x: np.ndarray, spread: np.ndarray | None, noise: Noise
    ) -> Linearisation:
        """At parameters ``(p,)`` and states ``(n, d)``."""
        self.charge(self.grid.substeps)
        known = noise if self.filtered else None
        if self.closed is None or spread is None:
            return linearise(self.model, self.grid, values, x, noise=known)
        rows, data = self.grid.rows, self.grid.data
        intensity = noise.intensity if len(noise.intensity) == 1 else noise.intensity[rows]
        # In the middle of an interval noise of half of it is added.
        wide = spread[rows] + intensity * data.step[rows][:, None, None] / 2
        return linearise(self.model, self.grid, values, x, drift=self.closed, spread=wide, noise=known)

    def stepped(self, now: Fit, change: np.ndarray) -> tuple[Fit, float] | None:
        """The step suggested, shortened until it does about what was predicted, and the share taken."""
        data, here, noise = self.grid.data, now.linearisation, now.noise
        still = here.with_parameters_changed(change)
        white = still.filtered(data.first, data.step, noise)[0]
        begin = np.empty((len(data.labels), still.gap.shape[1]))
        for place, (start, end) in enumerate(itertools.pairwise(data.first)):
            part = white[start:end].reshape(-1, white.shape[2])
            begin[place] = solve(part[:, 1:], part[:, 0], least=INEXACT)[0]
        smoothed, known, covariance = still.smoothed(data.first, data.step, noise, begin)
        deviation = known if self.filtered else smoothed
        for place in data.stationary:  # their mean where a recording begins
            deviation[data.first[:-1], place] = 0.0
        spread = covariance if noise.process.any() else None
        rows, scale = self.grid.rows, self.scale
        moved = np.einsum("kij,kj->ki", here.transition[rows], deviation[rows])
        moved += here.response[rows] @ change
        foreseen = here.gap[rows] + moved - deviation[rows + 1]
        effect = np.sqrt(np.mean(((np.abs(moved) + np.abs(deviation[rows + 1])) / scale) ** 2))
        # A filter's gaps are its corrections at each sample, which both kinds of noise ask for anyway.
        usual = np.sqrt(np.mean((here.gap[rows] / scale) ** 2)) if self.filtered else 0.0
        length = 1.0
        while length >= SHORTEST_STEP:
            model, x = now.model.moved(length * change), now.linearised_at + length * deviation
            along = self.linearised(model.values, x, spread, noise)
            if along.finite and not self.crosses(model.values, x):
                expected = (1 - length) * here.gap[rows] + length * foreseen
                unforeseen = np.sqrt(np.mean(((along.gap[rows] - expected) / scale) ** 2))
                if unforeseen <= NONLINEAR * length * effect + HARMLESS * usual + 1e-9:
                    there = replace(now, model=model, x=now.linearised_at + length * smoothed)
                    return replace(there, linearised_at=x, spread=spread, linearisation=along), length
            length /= 2
        return None

    def fit(
        self, x: np.ndarray, along: Linearisation, noise: Noise, *, estimate_process: bool, most: int
    ) -> Fit:
        """The fit that begins at the model's values and states ``(n, d)``, in at most so many steps."""
        descended = partial(self.descended, estimate_process=estimate_process, most=most)
        return _fit_from(self.model, x, along, noise, self.grid.substeps, descended)

    def descended(self, now: Fit, *, estimate_process: bool, most: int) -> Fit:
        """Gauss–Newton steps from a start, at most so many."""
        data, noise = self.grid.data, now.noise
        before: np.ndarray | None = None
        totals: list[float] = []
        converged, settled_noise, whole = False, False, False
        for iteration in range(most):
            if noise.field is not None:  # process noise depends on where the fit stands
                rows, x = self.grid.rows, now.linearised_at
                middle = x.copy()
                middle[rows] += (x[rows + 1] + now.linearisation.gap[rows] - x[rows]) / 2
                noise = noise.along(middle, now.spread, data.step)
            expected = expectations(now.model)
            if iteration in (0, 2) or settled_noise:
                noise = _noise_along(
                    now.linearisation, data, noise, estimate_process, expected=expected, charge=self.charge,
                    coarse=not settled_noise,
                )  # fmt: skip
            now = replace(now, noise=noise)
            self.charge()
            white = whiten(now.linearisation, data, noise)
            change = self.change_of(now, white, expected)
            explained = white.columns @ change
            left = white.innovations - explained
            settled = SETTLED * len(left) * max(1.0, (left**2).sum() / len(left))
            # A shortened step leaves much of what is foreseen undone, and the forecast unchanged. So does a
            # whole one where effects are so curved that steps go to and fro: the states in hand have to be as
            # likely as the forecast is, since it is they that the likelihood is of.
            if (
                before is not None
                and whole
                and ((left - before) ** 2).sum() < settled
                and explained @ explained < (FINE if self.filtered else settled)
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
            step = self.stepped(now, change)
            if step is None:
                break
            now, length = step
            whole = length == 1.0
        return _ended(now, data, converged=converged, resolution=self.resolution)


@np.errstate(all="ignore")  # what runs away is told as a fault
def fit_by_multiple_shooting(
    model: Dynamics, data: Measurements, *, x: np.ndarray, noise: Noise, estimate_process: bool,
    substeps: int | None = None, budget: Budget | None = None,
) -> Fit:  # fmt: skip
    """Fit free parameters, states and noise, by Gauss–Newton steps along linearised trajectories.

    Where the simulation runs away the fit is not converged, with a log-likelihood of -∞ and its `fault`.

    Parameters
    ----------
    model, data
        Its parameters' values are where the fit begins.
    x, noise
        States ``(n, d)`` and noise to begin with. Without process noise the fitted states follow their
        equations exactly.
    estimate_process
        Whether the process noise is estimated, too; the measurement noise always is.
    substeps, budget
        Runge–Kutta steps between samples, by default as many as the accuracy needs; and charged for every
        evaluation.
    """
    shooting = _Shooting(model, data, x, substeps, budget=budget)
    along = linearise(model, shooting.grid, model.values, x)
    fit = shooting.fit(x, along, noise, estimate_process=estimate_process, most=ITERATIONS)
    if not (fit.converged and fit.has_process_noise):
        return fit
    return fit_by_filter(
        fit.model, data, x=fit.x, noise=fit.noise, estimate_process=estimate_process, substeps=fit.substeps,
        closure=False, budget=budget,
    )  # fmt: skip


@np.errstate(all="ignore")  # what runs away is told as a fault
def fit_by_filter(
    model: Dynamics, data: Measurements, *, x: np.ndarray, noise: Noise, estimate_process: bool = True,
    estimate_sensor: bool = True, substeps: int | None = None, iterations: int = ITERATIONS,
    closure: bool = True, budget: Budget | None = None,
) -> Fit:  # fmt: skip
    """The second half of `fit_by_multiple_shooting` alone, for a model that follows the data from the start.

    Process noise has to drive the states. Where measurement noise is not estimated, the process noise is as
    given, too. With the closure the spread of what the filter knows acts on the mean of f
    (`siq.inference.kalman_filter`).
    """
    if not estimate_sensor:
        data = replace(data, sensor_noise=noise.measurement)
    closed = ClosedFunctions(model) if closure else None
    shooting = _Shooting(model, data, x, substeps, filtered=True, closed=closed, budget=budget)
    along = shooting.linearised(model.values, x, None, noise)
    return shooting.fit(x, along, noise, estimate_process=estimate_process, most=iterations)


def _sides(model: Dynamics, data: Measurements, x: np.ndarray) -> np.ndarray:
    """On which side of each pole of f states ``(n, d)`` lie."""
    signals = data.signals(data.t, data.recording, delays=model.lags(model.values))
    return model.functions.sides(x.T, signals, model.values)


def _stands_still(totals: list[float]) -> bool:
    """Whether a fit moves without becoming better: where f jumps its derivatives are never exact."""
    recent = totals[-4:]
    return max(recent) - min(recent) < STANDSTILL * max(recent)
