"""Which states, and which derivatives, can be had from what was measured?

As one would without a filter: a smoothing spline of every output that is a state (its stiffness by
generalised cross-validation), and where ``x' = v`` the derivative of one as the other. Where a state cannot
be had in this way, no method that needs it can be applied.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
import scipy.interpolate

from siq.inference.maximum_likelihood import Fit
from siq.inference.measurements import Measurements
from siq.systems.dynamics import Dynamics, Signals

TRIMMED = 0.05  # of a recording, at each end, where derivatives of a smoothing spline are poor
BLOCKS = 24  # of neighbouring samples, about, between which errors are taken to be independent
FOLDS = 4  # of which one is left out at a time


@dataclass(frozen=True)
class SeenStates:
    """States along the recordings, as they can be had.

    Attributes
    ----------
    x, rates
        States and their derivatives, shape ``(d, n)``.
    signals
        Inputs and times at the samples.
    inside
        Which samples are far enough from the ends of their recordings, shape ``(n,)``.
    block, fold
        To which stretch of neighbours a sample belongs, and with which part it is left out; shape ``(n,)``.
    """

    x: np.ndarray
    rates: np.ndarray
    signals: Signals
    inside: np.ndarray
    block: np.ndarray
    fold: np.ndarray

    @property
    def coordinates(self) -> np.ndarray:
        """States and inputs, shape ``(d + i, n)``."""
        return np.concatenate([self.x, self.signals.inputs])

    def first_states(self, data: Measurements, fit: Fit) -> tuple[np.ndarray, np.ndarray]:
        """First states of the recordings, ``(recordings, d)``: as seen, and as the card's fit has them."""
        return self.x[:, data.first[:-1]].T, fit.x[data.first[:-1]]


def seen_states(model: Dynamics, data: Measurements) -> SeenStates | None:
    """States and derivatives from what was measured; None where a state cannot be had."""
    x, rates = np.full((2, model.dimension, len(data.t)), np.nan)
    inside = np.zeros(len(data.t), dtype=bool)
    measured = {str(formula): place for place, (_, formula) in enumerate(model.outputs)}
    for begin, end in zip(data.first[:-1], data.first[1:], strict=True):
        rows, t = slice(begin, end), data.t[begin:end]
        cut = max(round(TRIMMED * (end - begin)), 2)
        inside[begin + cut : end - cut] = True
        for state, name in enumerate(model.states):
            if name in measured:
                curve = smooth(t, data.outputs[rows, measured[name]])
                x[state, rows], rates[state, rows] = curve(t), curve(t, 1)
        for state, equation in enumerate(model.equations):
            if model.kinematic[state] and model.states[state] in measured:
                velocity = model.states.index(str(equation))
                if model.states[velocity] not in measured:
                    curve = smooth(t, data.outputs[rows, measured[model.states[state]]])
                    x[velocity, rows], rates[velocity, rows] = curve(t, 1), curve(t, 2)
    if not np.isfinite(x).all():
        return None
    block, fold = parts(data)
    signals = data.signals(data.t, data.recording, delays=model.lags(model.values))
    return SeenStates(x, rates, signals, inside, block, fold)


def smooth(t: np.ndarray, y: np.ndarray) -> scipy.interpolate.BSpline:
    """A smoothing spline through what is known of one output of one recording, shape ``(n,)`` each."""
    known = np.isfinite(y)
    size = float(np.std(y[known])) or 1.0
    step = float(np.median(np.diff(t)))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        # In units of samples and of the motion, in which the search for the stiffness is well scaled.
        curve = scipy.interpolate.make_smoothing_spline(t[known] / step, y[known] / size)
    return scipy.interpolate.BSpline(curve.t * step, curve.c * size, curve.k)


def parts(data: Measurements) -> tuple[np.ndarray, np.ndarray]:
    """Blocks of neighbouring samples, and the fold that each sample is left out with; shape ``(n,)`` each.

    Whole recordings are left out where there are four or more, and else stretches of them.
    """
    lengths = np.diff(data.first)
    counts = np.maximum(np.round(BLOCKS * lengths / lengths.sum()).astype(int), 1)
    block, before = np.empty(len(data.t), dtype=int), 0
    for begin, length, count in zip(data.first[:-1], lengths, counts, strict=True):
        block[begin : begin + length] = before + np.arange(length) * count // length
        before += count
    fold = data.recording % FOLDS if len(lengths) >= FOLDS else block % FOLDS
    return block, fold
