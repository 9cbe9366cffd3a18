"""What a model says of recordings, and how that depends on parameters and first states.

Runge and Kutta's rule of order four between samples, an interval that spans lost samples being cut into as
many parts. Derivatives are those of the computed motion: differences over one interval at a time, for all
intervals at once, and chained from the first sample on.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from siq.inference.measurements import Measurements
from siq.systems.dynamics import Dynamics, symbol
from siq.systems.formulas import compile_values

STEPS = 2  # of the rule, in the usual interval between two samples
NUDGE = 1e-6  # relative to its size, by which a state or a parameter is moved for a difference
INSIDE = 1e-9  # of a step, by which the input is read within it: it may jump at its ends


@dataclass(frozen=True)
class Sensitivities:
    """Derivatives along a motion.

    Attributes
    ----------
    carried
        Of the states behind an interval by those before it, shape ``(n, d, d)``.
    by_parameters
        The same by the free parameters, shape ``(n, d, p)``.
    by_forces
        The same by constants that are added to each equation, shape ``(n, d, d)``.
    """

    carried: np.ndarray
    by_parameters: np.ndarray
    by_forces: np.ndarray


class Integrator:
    """A model and recordings that it is held against.

    Parameters
    ----------
    model
        Without delays.
    data
        The recordings.
    """

    def __init__(self, model: Dynamics, data: Measurements) -> None:
        self.model, self.data = model, data
        inputs = [each.name for each in model.inputs]
        names = [*model.states, *inputs, "t", *(each.name for each in model.parameters)]
        arguments = [symbol(name) for name in names]
        self._rates = compile_values(list(model.equations), arguments)
        self._outputs = compile_values([formula for _, formula in model.outputs], arguments)
        self.begins = data.begins
        length = data.t[self.begins + 1] - data.t[self.begins]
        self._steps = STEPS * np.maximum(np.round(length / np.median(length)), 1).astype(int)
        self._h = length / self._steps
        self._signals = self._signals_of_steps()
        self._at_samples = self._signals_at(data.t, data.recording)
        # Intervals by how many lie before them in their recordings.
        within = self.begins - data.first[data.recording[self.begins]]
        self.layers = [np.flatnonzero(within == k) for k in range(int(within.max()) + 1)]

    @property
    def inputs(self) -> np.ndarray:
        """Inputs at the samples, shape ``(inputs, n)``."""
        return self._at_samples[:-1]

    def _signals_at(self, t: np.ndarray, recording: np.ndarray) -> np.ndarray:
        """Inputs and, behind them, the time: shape ``(inputs + 1, n)``."""
        values = np.empty((len(self.model.inputs) + 1, len(t)))
        values[-1] = t
        for place, courses in enumerate(self.data.courses):
            rows = recording == place
            for index, course in enumerate(courses):
                values[index, rows] = course(t[rows])
        return values

    def _signals_of_steps(self) -> np.ndarray:
        """Inputs and time at begin, middle and end of each step, ``(steps, 3, inputs + 1, intervals)``."""
        most = int(self._steps.max())
        recording = self.data.recording[self.begins]
        found = np.empty((most, 3, len(self.model.inputs) + 1, len(self.begins)))
        for step in range(most):
            for stage, part in enumerate((INSIDE, 0.5, 1 - INSIDE)):
                t = self.data.t[self.begins] + (np.minimum(step, self._steps - 1) + part) * self._h
                found[step, stage] = self._signals_at(t, recording)
        return found

    def rates(self, x: np.ndarray, signals: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Time derivatives, of the shape of the states; ``values`` is ``(parameters, …)``."""
        with np.errstate(all="ignore"):
            found = self._rates(*x, *signals, *values)
            return np.stack([np.broadcast_to(each, x.shape[1:]) for each in found])

    def outputs(self, states: np.ndarray, values: np.ndarray) -> np.ndarray:
        """What is measured at the samples, ``(n, m)``, for states ``(n, d)``."""
        with np.errstate(all="ignore"):
            found = self._outputs(*states.T, *self._at_samples, *values)
        return np.stack([np.broadcast_to(each, len(states)) for each in found], axis=1).astype(float)

    def across(
        self, x: np.ndarray, values: np.ndarray, which: np.ndarray, force: np.ndarray | float = 0.0
    ) -> np.ndarray:
        """States behind intervals, from those before them.

        Parameters
        ----------
        x
            Shape ``(d, intervals, …)``.
        values
            Of the parameters, each of a shape that goes with the states.
        which
            The intervals.
        force
            Added to each equation, of the shape of the states.
        """
        more = (1,) * (x.ndim - 2)
        h, steps = self._h[which].reshape(-1, *more), self._steps[which].reshape(-1, *more)
        for step in range(int(steps.max())):
            u = self._signals[step][:, :, which].reshape(3, -1, len(which), *more)
            first = self.rates(x, u[0], values) + force
            second = self.rates(x + h / 2 * first, u[1], values) + force
            third = self.rates(x + h / 2 * second, u[1], values) + force
            last = self.rates(x + h * third, u[2], values) + force
            change = h / 6 * (first + 2 * second + 2 * third + last)
            x = x + np.where(step < steps, change, 0.0)
        return x

    def run(self, values: np.ndarray, starts: np.ndarray) -> np.ndarray:
        """States at all samples, shape ``(n, d)``, from the first ones ``(recordings, d)``."""
        states = np.empty((len(self.data.t), self.model.dimension))
        states[self.data.first[:-1]] = starts
        with np.errstate(all="ignore"):
            for which in self.layers:
                rows = self.begins[which]
                states[rows + 1] = self.across(states[rows].T, values, which).T
        return states

    def sensitivities(self, values: np.ndarray, states: np.ndarray) -> Sensitivities:
        """Derivatives over every interval, along a motion ``(n, d)``."""
        d, free = self.model.dimension, list(self.model.free)
        p = len(free)
        x = states[self.begins].T
        size = np.maximum(np.abs(states).max(axis=0), 1e-12)
        step_x = NUDGE * size
        step_p = NUDGE * np.maximum(np.abs(values[free]), 1e-3)
        step_f = NUDGE * size / np.median(self._h * self._steps)
        columns = 1 + d + p + d
        moved = np.repeat(x[:, :, None], columns, axis=2)
        parameters = np.repeat(values[:, None, None], columns, axis=2)
        force = np.zeros((d, 1, columns))
        for k in range(d):
            moved[k, :, 1 + k] += step_x[k]
            force[k, 0, 1 + d + p + k] = step_f[k]
        for k, place in enumerate(free):
            parameters[place, 0, 1 + d + k] += step_p[k]
        behind = self.across(moved, parameters, np.arange(len(self.begins)), force)
        change = np.moveaxis(behind[:, :, 1:] - behind[:, :, :1], 0, 1)
        return Sensitivities(
            change[:, :, :d] / step_x, change[:, :, d : d + p] / step_p, change[:, :, d + p :] / step_f
        )

    def output_slopes(self, values: np.ndarray, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives of the outputs by states ``(n, m, d)`` and by free parameters ``(n, m, p)``."""
        base = self.outputs(states, values)
        size = np.maximum(np.abs(states).max(axis=0), 1e-12)
        by_states = np.empty((*base.shape, self.model.dimension))
        for k in range(self.model.dimension):
            moved = states.copy()
            moved[:, k] += NUDGE * size[k]
            by_states[..., k] = (self.outputs(moved, values) - base) / (NUDGE * size[k])
        by_parameters = np.empty((*base.shape, len(self.model.free)))
        for k, place in enumerate(self.model.free):
            step = NUDGE * max(abs(values[place]), 1e-3)
            other = values.copy()
            other[place] += step
            by_parameters[..., k] = (self.outputs(states, other) - base) / step
        return by_states, by_parameters

    def chained(
        self, along: Sensitivities, driven: np.ndarray, begin: np.ndarray | None = None
    ) -> np.ndarray:
        """Deviations of the states at all samples, shape ``(n, d, c)``.

        Parameters
        ----------
        along
            Derivatives over every interval.
        driven
            What each interval adds to the deviations, shape ``(intervals, d, c)``.
        begin
            Deviations at the first samples, ``(recordings, d, c)``; by default none.
        """
        result = np.zeros((len(self.data.t), self.model.dimension, driven.shape[2]))
        if begin is not None:
            result[self.data.first[:-1]] = begin
        for which in self.layers:
            rows = self.begins[which]
            result[rows + 1] = along.carried[which] @ result[rows] + driven[which]
        return result
