"""The extended Kalman filter: linearisation between samples, and innovations.

Where a state is known to within a covariance P, the mean of f is not f of the mean: to second order it is
``f + ½ Σ P_jk ∂²f/∂x_j∂x_k``. A filter that leaves this out attributes it to the coefficients of f.

Multiple shooting with a node at every sample: each interval is integrated from the state in hand, all of them
side by side, and the *gap* to the next state in hand is what the estimation closes
(`siq.inference.maximum_likelihood`). No long trajectory is integrated, so that a bad start cannot run away,
nor be trapped on the wrong side of a basin's boundary.

Along the trajectories of a fit everything is linear. The innovations, and what a unit of each parameter
explains of them, the unknown initial states projected out, are all that estimation, screening and tests need.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, Protocol

import numpy as np
import sympy

from siq.errors import NumericalFailure
from siq.inference.filter_kernels import carry_linearly, filter_recursion, projected_sums, smooth_backwards
from siq.inference.measurements import Measurements
from siq.inference.selection import triangle_of
from siq.numerics.randomness import positive
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics, Input, ParametricFunctions, Signals, symbol

INTERVALS = 1 << 14  # numerical: carried together, since their derivatives at three places are much to keep
MAX_SUBSTEPS = 16
SUBSTEP_ERROR = 3e-6  # of the spread of a state: far below what any sensor resolves
INSIDE = 1e-9  # share of a substep by which its ends lie inside, where an input jumps between samples
SLOWEST = 1.0  # of what is stationary: its rate times all the time that is recorded
RANK = 1e-9  # numerical: singular values below this share of the largest are rounding


class ClosedFunctions:
    """f of a model with the effect of a spread of the state; methods as of `ParametricFunctions`."""

    def __init__(self, model: Dynamics) -> None:
        self._pairs = [(j, k) for j in range(model.dimension) for k in range(j + 1)]
        names = [f"_spread_{j}_{k}" for j, k in self._pairs]
        equations = []
        for formula in model.equations:
            bent = sympy.S.Zero
            for (j, k), name in zip(self._pairs, names, strict=True):
                second = formula.diff(model.symbols[j], model.symbols[k])
                bent += second * symbol(name) * (sympy.Rational(1, 2) if j == k else 1)
            equations.append(formula + bent)
        further = tuple(Input(name, "1", "zero_order") for name in names)
        self._closed = replace(
            model, equations=tuple(equations), inputs=(*model.inputs, *further), covariance=None
        )
        self._spread = np.zeros((len(names), 0))

    def at(self, spread: np.ndarray) -> ClosedFunctions:
        """The functions for one covariance at each interval, shape ``(n, d, d)``."""
        found = copy(self)
        found._spread = np.stack([spread[:, j, k] for j, k in self._pairs])
        return found

    def rates(self, x: np.ndarray, signals: Signals, values: np.ndarray) -> np.ndarray:
        """Mean of f at mean states ``(d, n)``: shape ``(d, n)``."""
        return self._closed.functions.rates(x, self._joined(signals), values)

    def slopes(self, x: np.ndarray, signals: Signals, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Its derivatives by states and by free parameters: ``(d, d, n)`` and ``(d, p, n)``."""
        return self._closed.functions.slopes(x, self._joined(signals), values)

    def _joined(self, signals: Signals) -> Signals:
        places = len(signals.t) // self._spread.shape[1]  # at which the same intervals are looked at
        spread = np.tile(self._spread, places)
        return Signals(np.concatenate([signals.inputs, spread]), signals.delayed, signals.slopes, signals.t)


class Columns(Protocol):
    """Right-hand sides of candidates, whose response is wanted behind that of the parameters."""

    def rates(self, x: np.ndarray, values: np.ndarray, node: int) -> np.ndarray:
        """In the equations, at states ``(d, k)`` of a node: shape ``(d, q, k)``."""

    def outputs(self, x: np.ndarray, values: np.ndarray) -> np.ndarray:
        """In the outputs, at states ``(d, n)`` of all samples: shape ``(m, q, n)``."""


@dataclass(frozen=True)
class Grid:
    """The instants at which intervals between samples are worked on, by so many Runge–Kutta steps each.

    A part of a grid has the whole one, from which the signals are taken, and the places of its intervals.
    """

    data: Measurements
    substeps: int
    whole: Grid | None = None
    chosen: np.ndarray | None = None

    @cached_property
    def rows(self) -> np.ndarray:
        """Rows at which the intervals begin."""
        return self.data.begins if self.whole is None else self.whole.rows[self.chosen]

    @cached_property
    def step(self) -> np.ndarray:
        """Length of a substep of each interval."""
        if self.whole is not None:
            return self.whole.step[self.chosen]
        return (self.data.t[self.rows + 1] - self.data.t[self.rows]) / self.substeps

    def signals(self, node: int, delays: tuple[tuple[int, float], ...]) -> Signals:
        """Inputs at a node, all intervals: 0, 1, 2 are the start, middle and end of the first substep."""
        if self.whole is not None:
            known, at = self.whole.signals(node, delays), self.chosen
            return Signals(known.inputs[:, at], known.delayed[:, at], known.slopes[:, at], known.t[at])
        if delays not in self._known:  # all nodes at once, since every integration passes each
            nodes = (np.arange(self.substeps)[:, None] + np.array([INSIDE, 0.5, 1.0 - INSIDE])).ravel()
            t = (self.data.t[self.rows, None] + nodes * self.step[:, None]).ravel()
            recording = np.repeat(self.data.recording[self.rows], len(nodes))
            width = np.repeat(self.step, len(nodes))
            found = self.data.signals(t, recording, delays=delays, width=width)
            courses = np.vstack([found.inputs, found.delayed, found.slopes, found.t])
            by_node = np.moveaxis(courses.reshape(-1, len(self.rows), len(nodes)), 2, 0).copy()
            ends = np.cumsum([len(found.inputs), len(delays), len(delays)])
            self._known[delays] = [
                Signals(inputs, delayed, slopes, times[0])
                for inputs, delayed, slopes, times in (np.split(each, ends) for each in by_node)
            ]
        return self._known[delays][node]

    def at_samples(self, delays: tuple[tuple[int, float], ...]) -> Signals:
        """Inputs at the samples themselves."""
        return self.data.signals(self.data.t, self.data.recording, delays=delays)

    def at_intervals(self, chosen: np.ndarray) -> Grid:
        """Some of the intervals only, by their places."""
        return Grid(self.data, self.substeps, whole=self, chosen=chosen)

    @cached_property
    def _known(self) -> dict[tuple[tuple[int, float], ...], list[Signals]]:
        return {}


@dataclass(frozen=True)
class Linearisation:
    """A model along trajectories; see `siq.inference.filter_kernels.filter_recursion` for the attributes.

    Where the simulated output is no number, the residual is infinite; NaN says that nothing was measured.
    """

    transition: np.ndarray
    response: np.ndarray
    gap: np.ndarray
    measured: np.ndarray
    measured_response: np.ndarray
    residual: np.ndarray
    stationary: tuple[int, ...] = ()  #: places of states, see `siq.inference.measurements.Measurements`
    #: Where the sensor's noise depends on what it shows, outputs are in units of it: ln of its variance there
    #: over its mean, shape ``(n, m)``.
    logarithms: np.ndarray | None = None

    @property
    def finite(self) -> bool:
        """Whether every number is one."""
        numbers = self.gap, self.transition, self.response, self.measured
        return all(np.isfinite(each).all() for each in numbers) and not np.isinf(self.residual).any()

    def at_rows(self, rows: np.ndarray | slice) -> Linearisation:
        """That of some of the samples."""
        arrays = [one.name for one in fields(self) if isinstance(getattr(self, one.name), np.ndarray)]
        return replace(self, **{name: getattr(self, name)[rows] for name in arrays})

    def filtered(
        self, first: np.ndarray, step: np.ndarray, noise: Noise, *, begin: np.ndarray | None = None,
        begin_covariance: np.ndarray | None = None, functions: np.ndarray | None = None,
        places: np.ndarray | None = None, kept: bool = False,
    ) -> tuple[Any, ...]:  # fmt: skip
        """Innovations of the filter along it; see `siq.inference.filter_kernels.filter_recursion`.

        By default recordings begin at zero without a covariance, but for what is stationary; with functions
        and places of the process noise the likelihood is derived by it.
        """
        d, known = self.gap.shape[1], list(self.stationary)
        if begin_covariance is None and known:
            # dz = -z/τ dt + √q dW has the variance qτ/2: so recordings begin, and no state is to be found.
            row = int(np.argmax(step > 0))
            kept_share = np.clip(self.transition[row].diagonal()[known], 1e-300, 1.0)
            decay = np.maximum(-np.log(kept_share) / step[row], SLOWEST / step.sum())
            begin_covariance = np.zeros((d, d))
            begin_covariance[known, known] = noise.intensity[0].diagonal()[known] / (2 * decay)
        found = filter_recursion(
            first, self.transition, self.response, self.gap, self.measured,
            np.ascontiguousarray(self.measured_response),  # each order has machine code of its own
            self.residual, noise.measurement, step, noise.intensity,
            np.zeros((len(first) - 1, d)) if begin is None else begin,
            np.zeros((d, d)) if begin_covariance is None else begin_covariance,
            np.zeros((0, 0)) if functions is None else functions,
            np.zeros((0, 3), dtype=np.int64) if places is None else places, places is not None, kept,
        )  # fmt: skip
        found[0][:, :, [1 + self.response.shape[2] + place for place in known]] = 0.0
        if self.logarithms is None:
            return found
        return (found[0], found[1] + float(self.logarithms[~np.isnan(self.residual)].sum()), *found[2:])

    def smoothed(
        self, first: np.ndarray, step: np.ndarray, noise: Noise, begin: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The most probable deviations of the states, initial ones and parameters being known.

        Given all measurements, given those of the same sample and before, shape ``(n, d)`` each, and the
        covariance of the latter ``(n, d, d)``.
        """
        found = self.filtered(first, step, noise, begin=begin, kept=True)
        predicted, filtered, before, after, *gains = found[5:]
        chain = first, self.transition, self.measured, self.residual, np.ascontiguousarray(found[0][:, :, 0])
        return smooth_backwards(*chain, predicted, before, *gains), filtered, after

    def sums(self, first: np.ndarray, step: np.ndarray, noise: Noise) -> tuple[float, float, int]:
        """Sum of squared innovations, log-determinant and degrees of freedom, parameters at their best."""
        found = self.filtered(first, step, noise)
        total, logarithm, removed = projected_sums(first, found[0], 1 + self.response.shape[2])
        return total, found[1] + logarithm, int((~np.isnan(self.residual)).sum()) - removed

    def log_likelihood(self, first: np.ndarray, step: np.ndarray, noise: Noise) -> float:
        """The restricted one, the parameters at their best."""
        total, log_determinant, freedom = self.sums(first, step, noise)
        return -0.5 * (total + log_determinant + freedom * np.log(2 * np.pi))

    def with_parameters_changed(self, change: np.ndarray) -> Linearisation:
        """The linearisation after a change of the parameters, which are then no longer free."""
        gap, residual = self.gap + self.response @ change, self.residual - self.measured_response @ change
        none, unseen = np.zeros((*gap.shape, 0)), np.zeros((*residual.shape, 0))
        return replace(self, response=none, gap=gap, measured_response=unseen, residual=residual)


def integrate_intervals(model: Dynamics, grid: Grid, values: np.ndarray, x: np.ndarray) -> np.ndarray:
    """The states at the ends of all intervals: from states ``(d, k)`` at their starts to ``(d, k)``."""
    delays = model.lags(values)
    for part in range(grid.substeps):
        with np.errstate(all="ignore"):  # what runs away is seen by its end
            x = _runge_kutta(model.functions, grid, values, x, part, delays)[0]
    return x


def linearise(
    model: Dynamics, grid: Grid, values: np.ndarray, x: np.ndarray, *, columns: Columns | None = None,
    drift: ClosedFunctions | None = None, spread: np.ndarray | None = None, noise: Noise | None = None,
    without: Sequence[int] = (),
) -> Linearisation:  # fmt: skip
    """Integrate every interval from the states in hand ``(n, d)``, with the derivatives.

    Free parameters, and behind them further right-hand sides, are the columns of the response; `values` are
    those of all parameters. The mean of f over a spread of states, ``(intervals, d, d)``, may take the place
    of f as `drift`.

    Where the states are what a filter with a process noise knows, it is given. A fault of a sensor, φ, acts
    on what was foreseen, and taken at what is known it would explain the innovations e by themselves. The
    gain K changes with it, too, by -K φ' K for an exact sensor: known states are corrected by φ where they
    are. Without that, a scale of a state, which parameters can take over, would explain errors that last.
    What is foreseen is so `without` the effect of some free parameters, where what is missing is asked for in
    the place of that.
    """
    data, compiled, delays = grid.data, model.functions, model.lags(values)
    samples, signals = np.ascontiguousarray(x.T), grid.at_samples(delays)

    def slopes(at: np.ndarray) -> list[np.ndarray]:
        by_state, by_parameter = compiled.output_slopes(at, signals, values)
        if columns is not None:
            by_parameter = np.concatenate([by_parameter, columns.outputs(at, values)], axis=1)
        return [np.ascontiguousarray(np.moveaxis(each, 2, 0)) for each in (by_state, by_parameter)]

    measured, answered = slopes(samples)
    simulated = compiled.outputs(samples, signals, values).T
    (n, d), rows, count = x.shape, grid.rows, len(grid.rows)
    transition, response = np.zeros((n, d, d)), np.zeros((n, d, answered.shape[2]))
    gap = np.zeros((n, d))
    # Candidates have their own grid, and come as they are.
    together = count if columns is not None else INTERVALS
    for begin in range(0, count, together):
        chosen = np.arange(begin, min(begin + together, count))
        part = grid if len(chosen) == count else grid.at_intervals(chosen)
        along = compiled if drift is None or spread is None else drift.at(spread[chosen])
        at = rows[chosen]
        begins, width = np.array(x[at].T), response.shape[2]
        ends, transition[at], response[at] = _carried(model, part, values, begins, along, columns, width)
        with np.errstate(invalid="ignore"):
            gap[at] = ends.T - x[at + 1]
    residual = data.outputs - np.where(np.isfinite(simulated), simulated, np.inf)
    logarithms = None
    if data.sensor_law is not None:
        # By what was foreseen, which knows nothing of the sample's own noise.
        foreseen = x.copy()
        foreseen[rows + 1] += gap[rows]
        levels = compiled.outputs(np.ascontiguousarray(foreseen.T), signals, values).T
        variance = Measurements.relative_variance(data.sensor_law, levels)
        residual, logarithms = residual / np.sqrt(variance), np.log(variance)
        measured, answered = (one / np.sqrt(variance)[:, :, None] for one in (measured, answered))
    found = Linearisation(
        transition, response, gap, measured, answered, residual, data.stationary, logarithms
    )  # fmt: skip
    if noise is None or not answered.any():
        return found
    places = list(without)
    effect = response[:, :, places] @ values[[model.free[place] for place in places]]
    still = replace(
        found, response=response[:, :, :0], gap=gap - effect, measured_response=answered[:, :, :0]
    )
    *_, before, after, _, _, gains, variances = still.filtered(data.first, data.step, noise, kept=True)
    foreseen, known = (slopes(samples + deviation.T)[1] for deviation in (before, after))
    corrected = transition @ np.einsum("nmd,nm,nmp->ndp", gains, 1 / variances, known - foreseen)
    return replace(found, response=response - corrected, measured_response=foreseen)


def _carried(
    model: Dynamics, grid: Grid, values: np.ndarray, state: np.ndarray,
    drift: ParametricFunctions | ClosedFunctions, columns: Columns | None, width: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """States ``(d, k)`` at the ends of intervals, and their derivatives ``(k, d, d)``, ``(k, d, width)``."""
    delays, step, (d, count) = model.lags(values), grid.step, state.shape
    transition, response = np.repeat(np.eye(d)[:, :, None], count, axis=2), np.zeros((d, width, count))
    for place in grid.data.restarting:
        state[place] = 0.0
        transition[place, place] = 0.0

    # All derivatives at once, or of so many substeps as are not too much to keep.
    together = 1 if columns is not None else max(INTERVALS // max(count, 1), 1)
    end_rate = None
    for first in range(0, grid.substeps, together):
        places: list[np.ndarray] = []
        for part in range(first, min(first + together, grid.substeps)):
            with np.errstate(all="ignore"):  # what runs away is seen by `Linearisation.finite`
                # Within an interval only a delayed input jumps.
                known = None if delays else end_rate
                after, begin_rate, end_rate = _runge_kutta(drift, grid, values, state, part, delays, known)
                middle = (state + after) / 2 + step / 8 * (begin_rate - end_rate)
            places += [state, middle, after]
            state = after
        nodes = range(3 * first, 3 * first + len(places))
        signals = [grid.signals(node, delays) for node in nodes]
        by_state, by_parameter = drift.slopes(np.concatenate(places, axis=1), Signals.joined(signals), values)
        if columns is not None:
            further = [columns.rates(x, values, node) for x, node in zip(places, nodes, strict=True)]
            by_parameter = np.concatenate([by_parameter, np.concatenate(further, axis=2)], axis=1)
        for begin in range(0, len(places) * count, 3 * count):
            carry_linearly(step, by_state, by_parameter, begin, transition, response)
    return state, transition.transpose(2, 0, 1), response.transpose(2, 0, 1)


def substeps_needed(
    model: Dynamics, data: Measurements, values: np.ndarray, x: np.ndarray, *,
    tolerance: float = SUBSTEP_ERROR,
) -> int:  # fmt: skip
    """Runge–Kutta steps in every interval, so that doubling them changes little.

    The tolerance is the root mean square change of the increments from states ``(n, d)`` that is allowed,
    relative to their spread. One that rests, as hidden ones do at first, is displaced by its size, or by 1.
    """
    spread = x.std(axis=0)
    aside = np.where(spread > 0, 0.0, np.where(x[0] != 0, np.abs(x[0]), 1.0))
    steps, begins, scale = 1, (x[data.begins] + aside).T, spread + aside
    coarse = integrate_intervals(model, Grid(data, 1), values, begins)
    while steps < MAX_SUBSTEPS:
        fine = integrate_intervals(model, Grid(data, 2 * steps), values, begins)
        with np.errstate(all="ignore"):
            squares = (fine - coarse) ** 2
            known = np.maximum((~np.isnan(squares)).sum(axis=1), 1)
            change = np.sqrt(np.nansum(squares, axis=1) / known) / scale
        if not (change > tolerance).any():
            break
        steps, coarse = 2 * steps, fine
    return steps


def _runge_kutta(
    drift: ParametricFunctions | ClosedFunctions, grid: Grid, values: np.ndarray, x: np.ndarray, part: int,
    delays: tuple[tuple[int, float], ...], first: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """State after a substep, and f at its start (`first` where known) and end; inputs differ among stages."""
    rates, step = drift.rates, grid.step
    begin, middle, end = (grid.signals(3 * part + node, delays) for node in range(3))
    k1 = rates(x, begin, values) if first is None else first
    k2 = rates(x + step / 2 * k1, middle, values)
    k3 = rates(x + step / 2 * k2, middle, values)
    after = x + step / 6 * (k1 + 2 * k2 + 2 * k3 + rates(x + step * k3, end, values))
    return after, k1, rates(after, end, values)


def _mean_intensity(noise: Diffusion, x: np.ndarray, spread: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Mean of εD(x) over intervals, and over what a filter knows of the state: shape ``(n, d, d)``."""
    d = noise.dimension
    matrices = noise.at(x[:, :d])
    # In the middle of an interval noise of half of it is added.
    wide = spread[:, :d, :d] + matrices * step[:, None, None] / 2
    bent = np.einsum("nijkl,nkl->nij", noise.derivatives(x[:, :d], 2), wide) / 2
    # On its way a fit may come where the formula is no covariance.
    levels, vectors = np.linalg.eigh(matrices + bent)
    whole = np.zeros((len(x), x.shape[1], x.shape[1]))
    whole[:, :d, :d] = np.einsum("nik,nk,njk->nij", vectors, np.maximum(levels, 0.0), vectors)
    return whole


@dataclass(frozen=True)
class Noise:
    """Variances of the two kinds of noise."""

    #: R per sample, shape ``(m,)``; and Q per time, shape ``(d,)``, zero where nothing drives the state.
    measurement: np.ndarray
    process: np.ndarray
    #: Of the process noise, where its components are not independent and of constant strength: ``(1, d, d)``,
    #: or ``(n, d, d)`` for one at each sample. The intensity is then ``√Q_i shape_ij √Q_j``.
    shape: np.ndarray | None = None
    #: εD(x), whose mean at each sample is the shape; a fit keeps the shape up with it.
    field: Diffusion | None = None

    @classmethod
    def of_rate(cls, measurement: np.ndarray, rate: np.ndarray) -> Noise:
        """Of the covariance of process noise per time ``(d, d)``, which may leave some states alone."""
        process, shape = np.diag(rate).copy(), np.eye(len(rate))
        inside = np.ix_(process > 0, process > 0)
        size = np.sqrt(process[process > 0])
        shape[inside] = rate[inside] / np.outer(size, size)
        return cls(measurement, process, shape[None])

    def along(self, x: np.ndarray, spread: np.ndarray | None, step: np.ndarray) -> Noise:
        """A noise with the shape that its field has at states; see `_mean_intensity`."""
        if self.field is None:
            return self
        spread = np.zeros((*x.shape, x.shape[1])) if spread is None else spread
        return replace(self, shape=_mean_intensity(self.field, x, spread, step))

    def without_process(self) -> Noise:
        """Only the measurement noise, with states that follow their equations exactly."""
        return replace(self, process=np.zeros_like(self.process))

    def of_states(self, dimension: int) -> Noise:
        """A noise where there are more states, or fewer: those added are not driven."""
        driven = self.process[:dimension]
        return replace(self, process=np.append(driven, np.zeros(dimension - len(driven))))

    def scaled(self, factor: float) -> Noise:
        """A noise with the process noise multiplied."""
        return replace(self, process=self.process * factor)

    @cached_property
    def driven(self) -> np.ndarray:
        """Places of the states that process noise drives."""
        return np.flatnonzero(self.process > 0)

    @property
    def coordinates(self) -> int:
        """How many numbers make another noise of it, see `moved`."""
        count = len(self.driven)
        pairs = count * (count - 1) // 2 if self.shape is not None and len(self.shape) == 1 else 0
        return len(self.measurement) + count + pairs

    def moved(self, vector: np.ndarray, known: np.ndarray) -> Noise:
        """The noise at coordinates: changes of logarithms of variances, then of correlations; zero here.

        Variances of the measurement that are known ``(m,)`` stay, and so does a process noise that is zero.
        """
        outputs, driven, factors = len(known), self.driven, np.exp(vector)
        process = self.process.copy()
        process[driven] *= factors[outputs : outputs + len(driven)]
        measurement = np.where(known, self.measurement, self.measurement * factors[:outputs])
        result = Noise(measurement, process, self.shape, self.field)
        if self.shape is None or len(self.shape) != 1 or len(driven) < 2:
            return result
        shape, change, inside = self.shape.copy(), np.eye(len(driven)), np.ix_(driven, driven)
        change[np.tril_indices(len(driven), -1)] = vector[outputs + len(driven) :]
        root = np.linalg.cholesky(shape[0][inside]) @ change
        root /= np.linalg.norm(root, axis=1)[:, None]
        shape[0][inside] = root @ root.T
        return replace(result, shape=shape)

    @property
    def intensity(self) -> np.ndarray:
        """Intensity of the process noise, per time: shape ``(1, d, d)``, or ``(n, d, d)``."""
        if self.shape is None:
            return np.diag(self.process)[None]
        return self.shape * np.sqrt(np.outer(self.process, self.process))


def profile_likelihood(total: float, freedom: int, log_determinant: float) -> float:
    """Log-likelihood, up to a constant, with the common scale of both kinds of noise at its best."""
    return -0.5 * (freedom * np.log(max(total, 1e-300) / freedom) + log_determinant)


@dataclass(frozen=True)
class Whitened:
    """Innovations in units of their standard deviation, initial states projected out."""

    #: Shape ``(n·m,)``; and what a unit of each parameter explains of them, shape ``(n·m, p)``.
    innovations: np.ndarray
    columns: np.ndarray
    #: The recording of each, and which of them were measured, shape ``(n·m,)``.
    recording: np.ndarray
    known: np.ndarray
    #: Measured values less initial states; and of the innovations' covariance.
    degrees_of_freedom: int
    log_determinant: float

    def solve(
        self, expected: tuple[np.ndarray, np.ndarray] | None = None, *, least: float = RANK
    ) -> tuple[np.ndarray, np.ndarray]:
        """Parameters and their covariance, with one row more for each expectation; see `solve`."""
        columns, goal = self.columns, self.innovations
        if expected is not None and len(expected[0]):
            columns, goal = np.concatenate([columns, expected[0]]), np.concatenate([goal, expected[1]])
        return solve(columns, goal, least=least)

    def log_likelihood(self, sum_of_squares: float) -> float:
        """Log-likelihood where the innovations have the given sum of squares."""
        return -0.5 * (sum_of_squares + self.log_determinant + self.known.sum() * np.log(2 * np.pi))


def whiten(linearisation: Linearisation, data: Measurements, noise: Noise) -> Whitened:
    """Innovations of the filter in units of their standard deviation, initial states projected out.

    Raises
    ------
    NumericalFailure
        When the simulation, as linearised, runs away along a recording. Columns of parameters may be infinite
        all the same.
    """
    white, log_determinant = linearisation.filtered(data.first, data.step, noise)[:2]
    outputs, known = white.shape[1], ~np.isnan(linearisation.residual).ravel()
    parts = np.split(white.reshape(-1, white.shape[2]), [1, 1 + linearisation.response.shape[2]], axis=1)
    innovations, columns, initial = map(np.ascontiguousarray, (parts[0][:, 0], *parts[1:]))
    if not (np.isfinite(innovations).all() and np.isfinite(initial).all() and np.isfinite(log_determinant)):
        raise NumericalFailure("small deviations from the recorded motion grow beyond all numbers")
    used = 0
    for begin, end in zip(data.first[:-1] * outputs, data.first[1:] * outputs, strict=True):
        own = initial[begin:end] / positive(np.sqrt((initial[begin:end] ** 2).sum(axis=0)))
        basis, triangle = np.linalg.qr(own)
        values = np.abs(np.diag(triangle))
        if values.min(initial=1.0) <= RANK * values.max(initial=0.0):
            basis, values, _ = np.linalg.svd(own, full_matrices=False)
            basis = basis[:, values > RANK * max(values[0], 1e-300)]
        innovations[begin:end] -= basis @ (basis.T @ innovations[begin:end])
        columns[begin:end] -= basis @ (basis.T @ columns[begin:end])
        used += basis.shape[1]
    recording, freedom = np.repeat(data.recording, outputs), int(known.sum()) - used
    return Whitened(innovations, columns, recording, known, freedom, log_determinant)


def solve(columns: np.ndarray, target: np.ndarray, *, least: float = RANK) -> tuple[np.ndarray, np.ndarray]:
    """Least squares with columns ``(n, p)`` of any scale; what the data do not tell is left alone.

    Singular values below the share `least` of the largest tell nothing. Returned are the estimate, and its
    covariance for errors of unit variance.

    Raises
    ------
    NumericalFailure
        When a column or the target is not finite.
    """
    if columns.shape[1] == 0:
        return np.zeros(0), np.zeros((0, 0))
    if not (np.isfinite(columns).all() and np.isfinite(target).all()):
        raise NumericalFailure("the effect of a parameter on what is measured is beyond all numbers")
    scale = positive(np.sqrt(np.einsum("np,np->p", columns, columns)))
    triangle = triangle_of(columns, target)
    left, values, right = np.linalg.svd(triangle[:, :-1] / scale, full_matrices=False)
    kept = values > least * values[0] if values[0] > 0 else np.zeros(len(values), dtype=bool)
    inverse = right[kept].T / values[kept] / scale[:, None]
    return inverse @ (left[:, kept].T @ triangle[:, -1]), inverse @ inverse.T
