"""How does a card with something added run freely? Runge and Kutta's rule of order four between samples."""

from __future__ import annotations

import numpy as np

from benchmarks.discrepancies.added import Added
from siq.inference.measurements import Measurements
from siq.systems.dynamics import Dynamics, Signals

STEPS = 2  # of the rule, in the usual interval between two samples
INSIDE = 1e-9  # of a step, by which an input is read within it: it may jump at its ends


class Simulation:
    """A simulation of recordings by any mended card; see `benchmarks.proof.foreign_scores.oracle.Simulator`.

    Parameters
    ----------
    model
        With or without delays.
    data
        The recordings.
    added
        What is added to the equations.
    """

    def __init__(self, model: Dynamics, data: Measurements, added: Added | None = None) -> None:
        self.model, self.data, self.added = model, data, added
        self.begins = data.begins
        length = data.t[self.begins + 1] - data.t[self.begins]
        self._steps = STEPS * np.maximum(np.round(length / np.median(length)), 1).astype(int)
        self._h = length / self._steps
        recording, lags = data.recording[self.begins], model.lags(model.values)
        self._signals = [
            [
                data.signals(
                    data.t[self.begins] + (np.minimum(step, self._steps - 1) + part) * self._h,
                    recording,
                    delays=lags,
                )
                for part in (INSIDE, 0.5, 1 - INSIDE)
            ]
            for step in range(int(self._steps.max()))
        ]
        self._at_samples = data.signals(data.t, data.recording, delays=lags)
        # Intervals by how many lie before them in their recordings.
        within = self.begins - data.first[data.recording[self.begins]]
        self._layers = [np.flatnonzero(within == k) for k in range(int(within.max()) + 1)]

    def rates(self, x: np.ndarray, signals: Signals, values: np.ndarray) -> np.ndarray:
        """Time derivatives at states ``(d, n)``."""
        rates = self.model.functions.rates(x, signals, values)
        return rates if self.added is None else rates + self.added(x, signals.inputs)

    def run(self, values: np.ndarray, starts: np.ndarray) -> np.ndarray:
        """States at all samples, shape ``(n, d)``, from the first ones ``(recordings, d)``."""
        states = np.empty((len(self.data.t), self.model.dimension))
        states[self.data.first[:-1]] = starts
        with np.errstate(all="ignore"):
            for which in self._layers:
                rows = self.begins[which]
                states[rows + 1] = self._across(states[rows].T, values, which).T
        return states

    def outputs(self, states: np.ndarray, values: np.ndarray) -> np.ndarray:
        """What is measured at the samples, ``(n, m)``, for states ``(n, d)``."""
        return self.model.functions.outputs(states.T, self._at_samples, values).T

    def _across(self, x: np.ndarray, values: np.ndarray, which: np.ndarray) -> np.ndarray:
        h, steps = self._h[which], self._steps[which]
        for step in range(int(steps.max())):
            begin, middle, end = (_only(each, which) for each in self._signals[step])
            first = self.rates(x, begin, values)
            second = self.rates(x + h / 2 * first, middle, values)
            third = self.rates(x + h / 2 * second, middle, values)
            last = self.rates(x + h * third, end, values)
            x = x + np.where(step < steps, h / 6 * (first + 2 * second + 2 * third + last), 0.0)
        return x


def _only(signals: Signals, which: np.ndarray) -> Signals:
    return Signals(
        signals.inputs[:, which], signals.delayed[:, which], signals.slopes[:, which], signals.t[which]
    )
