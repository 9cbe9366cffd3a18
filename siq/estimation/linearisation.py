"""Linearisation: what small changes of states and parameters do between samples, and to what is measured.

Multiple shooting with a node at every sample: each interval is integrated from the state in hand, all of
them side by side, and the *gap* to the next state in hand is what the estimation closes
(`siq.estimation.estimation`). No long trajectory is integrated, so that a bad start cannot run away, nor be
trapped on the wrong side of a basin's boundary.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from siq.dynamics.dynamics import Dynamics
from siq.dynamics.parametric import Signals
from siq.estimation.kernels import carry_linearly
from siq.estimation.measurements import Measurements


class Columns(Protocol):
    """Right-hand sides of candidates, whose response is wanted beside that of the parameters."""

    def rates(self, x: np.ndarray, values: np.ndarray, node: int) -> np.ndarray:
        """In the equations, at states ``(d, k)`` of a node: shape ``(d, q, k)``."""

    def outputs(self, x: np.ndarray, values: np.ndarray) -> np.ndarray:
        """In the outputs, at states ``(d, n)`` of all samples: shape ``(m, q, n)``."""


class Rates(Protocol):
    """F and its derivatives, as `siq.dynamics.parametric.ParametricFunctions` has them."""

    def rates(self, x: np.ndarray, signals: Signals, values: np.ndarray) -> np.ndarray:
        """F at states ``(d, n)``: shape ``(d, n)``."""

    def slopes(self, x: np.ndarray, signals: Signals, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """By states and by free parameters: ``(d, d, n)`` and ``(d, p, n)``."""


class Drift(Rates, Protocol):
    """The same where it differs from interval to interval."""

    def at_intervals(self, chosen: np.ndarray) -> Rates:
        """That of some of the intervals, by their places."""


INTERVALS = 1 << 14  # numerical: carried together, since their derivatives at three places are much to keep
MOST_SUBSTEPS = 16
INSIDE = 1e-9  # share of a substep by which its ends lie inside, where an input jumps between samples


@dataclass(frozen=True)
class Grid:
    """The instants at which intervals between samples are worked on.

    Attributes
    ----------
    data
        The measurements.
    substeps
        Runge–Kutta steps in every interval.
    whole, chosen
        For a part of a grid: the grid, and the places of the intervals; the signals are taken from there.
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
        """Inputs at a node, all intervals: nodes 0, 1, 2 are begin, middle and end of the first substep."""
        if self.whole is not None:
            known = self.whole.signals(node, delays)
            at = self.chosen
            return Signals(known.inputs[:, at], known.delayed[:, at], known.slopes[:, at], known.t[at])
        if (node, delays) not in self._known:
            part, place = divmod(node, 3)
            fraction = part + (INSIDE, 0.5, 1.0 - INSIDE)[place]
            t = self.data.t[self.rows] + fraction * self.step
            recording = self.data.recording[self.rows]
            self._known[node, delays] = self.data.signals(t, recording, delays=delays, width=self.step)
        return self._known[node, delays]

    def at_samples(self, delays: tuple[tuple[int, float], ...]) -> Signals:
        """Inputs at the samples themselves."""
        return self.data.signals(self.data.t, self.data.recording, delays=delays)

    def at_intervals(self, chosen: np.ndarray) -> Grid:
        """Some of the intervals only, by their places."""
        return Grid(self.data, self.substeps, whole=self, chosen=chosen)

    @cached_property
    def _known(self) -> dict[tuple[int, tuple[tuple[int, float], ...]], Signals]:
        return {}


@dataclass(frozen=True)
class Linearisation:
    """See `siq.estimation.kernels.whitened_innovations` for the attributes.

    Where the simulated output is no number, the residual is infinite; NaN says that nothing was measured.
    """

    transition: np.ndarray
    response: np.ndarray
    gap: np.ndarray
    measured: np.ndarray
    measured_response: np.ndarray
    residual: np.ndarray

    @property
    def finite(self) -> bool:
        """Whether every number is one."""
        return bool(
            np.isfinite(self.gap).all()
            and np.isfinite(self.transition).all()
            and np.isfinite(self.response).all()
            and np.isfinite(self.measured).all()
            and not np.isinf(self.residual).any()
        )


def integrate_intervals(model: Dynamics, grid: Grid, values: np.ndarray, x: np.ndarray) -> np.ndarray:
    """The states at the ends of all intervals: from states ``(d, k)`` at their begins to ``(d, k)``."""
    delays = model.lags(values)
    step = grid.step
    for part in range(grid.substeps):
        with np.errstate(all="ignore"):  # what runs away is seen by its end
            x = _runge_kutta(model.functions, grid, values, x, part, step, delays)[0]
    return x


def linearise(
    model: Dynamics,
    grid: Grid,
    values: np.ndarray,
    x: np.ndarray,
    *,
    columns: Columns | None = None,
    drift: Drift | None = None,
) -> Linearisation:
    """Integrate every interval from the state in hand, with the derivatives.

    Parameters
    ----------
    model
        Its free parameters are the first columns of the response.
    grid
        Measurements and substeps.
    values
        All parameters, shape ``(p,)``.
    x
        The states in hand, shape ``(n, d)``.
    columns
        Further right-hand sides whose response is wanted behind those of the parameters.
    drift
        F where it is another than the model's, such as the mean of f over a spread of states.
    """
    data, compiled, delays = grid.data, model.functions, model.lags(values)
    dimension, rows, count = x.shape[1], grid.rows, len(grid.rows)
    transition = np.zeros((len(x), dimension, dimension))
    response = np.zeros((len(x), dimension, 0))
    gap = np.zeros((len(x), dimension))
    # Candidates have their own grid, and come as they are.
    together = count if columns is not None else INTERVALS
    for begin in range(0, count, together):
        chosen = np.arange(begin, min(begin + together, count))
        whole = len(chosen) == count
        part = grid if whole else grid.at_intervals(chosen)
        along: Rates = compiled
        if drift is not None:
            along = drift if whole else drift.at_intervals(chosen)
        ends, by_state, by_parameter = _carried(
            model, part, values, np.array(x[part.rows].T), along, columns=columns
        )
        if not begin:
            response = np.zeros((len(x), *by_parameter.shape[1:]))
        at = rows[chosen]
        transition[at], response[at] = by_state, by_parameter
        with np.errstate(invalid="ignore"):
            gap[at] = ends.T - x[at + 1]
    samples = np.ascontiguousarray(x.T)
    signals = grid.at_samples(delays)
    by_state, by_parameter = compiled.output_slopes(samples, signals, values)
    if columns is not None:
        by_parameter = np.concatenate([by_parameter, columns.outputs(samples, values)], axis=1)
    simulated = compiled.outputs(samples, signals, values).T
    return Linearisation(
        transition=transition,
        response=response,
        gap=gap,
        measured=np.ascontiguousarray(np.moveaxis(by_state, 2, 0)),
        measured_response=np.ascontiguousarray(np.moveaxis(by_parameter, 2, 0)),
        residual=data.outputs - np.where(np.isfinite(simulated), simulated, np.inf),
    )


def _carried(
    model: Dynamics,
    grid: Grid,
    values: np.ndarray,
    state: np.ndarray,
    drift: Rates,
    *,
    columns: Columns | None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """States ``(d, k)`` at the ends of intervals, with their derivatives ``(k, d, d)`` and ``(k, d, p)``."""
    delays, step = model.lags(values), grid.step
    dimension, count = state.shape
    transition = np.broadcast_to(np.eye(dimension), (count, dimension, dimension)).copy()
    for place in grid.data.restarting:
        state[place] = 0.0
        transition[:, place, place] = 0.0
    response: np.ndarray | None = None

    def slopes(at: np.ndarray, node: int) -> tuple[np.ndarray, np.ndarray]:
        signals = grid.signals(node, delays)
        by_state, by_parameter = drift.slopes(at, signals, values)
        if columns is not None:
            by_parameter = np.concatenate([by_parameter, columns.rates(at, values, node)], axis=1)
        return np.moveaxis(by_state, 2, 0), np.moveaxis(by_parameter, 2, 0)

    for part in range(grid.substeps):
        with np.errstate(all="ignore"):  # what runs away is seen by `Linearisation.finite`
            after, begin_rate, end_rate = _runge_kutta(drift, grid, values, state, part, step, delays)
            middle = (state + after) / 2 + step / 8 * (begin_rate - end_rate)
        at = [slopes(place, 3 * part + node) for node, place in enumerate((state, middle, after))]
        if response is None:
            response = np.zeros((count, dimension, at[0][1].shape[2]))
        carry_linearly(
            step, np.stack([each[0] for each in at]), np.stack([each[1] for each in at]), transition, response
        )
        state = after
    assert response is not None
    return state, transition, response


def substeps_needed(
    model: Dynamics, data: Measurements, values: np.ndarray, x: np.ndarray, *, tolerance: float
) -> int:
    """Runge–Kutta steps in every interval, so that doubling them changes little.

    Parameters
    ----------
    model, data, values
        The model and what it is compared with.
    x
        States, shape ``(n, d)``.
    tolerance
        Root mean square change of the increments allowed, relative to the spread of the states.
    """
    steps = 1
    scale = x.std(axis=0) + 1e-300
    coarse = integrate_intervals(model, Grid(data, 1), values, x[data.begins].T)
    while steps < MOST_SUBSTEPS:
        fine = integrate_intervals(model, Grid(data, 2 * steps), values, x[data.begins].T)
        with np.errstate(all="ignore"):
            squares = (fine - coarse) ** 2
            known = np.maximum((~np.isnan(squares)).sum(axis=1), 1)
            change = np.sqrt(np.nansum(squares, axis=1) / known) / scale
        if not (change > tolerance).any():
            break
        steps, coarse = 2 * steps, fine
    return steps


def _runge_kutta(
    drift: Rates,
    grid: Grid,
    values: np.ndarray,
    x: np.ndarray,
    part: int,
    step: np.ndarray,
    delays: tuple[tuple[int, float], ...],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """State after a substep, and f at its begin and its end; the inputs differ from stage to stage."""
    rates = drift.rates
    begin, middle, end = (grid.signals(3 * part + node, delays) for node in range(3))
    k1 = rates(x, begin, values)
    k2 = rates(x + step / 2 * k1, middle, values)
    k3 = rates(x + step / 2 * k2, middle, values)
    k4 = rates(x + step * k3, end, values)
    after = x + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return after, k1, rates(after, end, values)
