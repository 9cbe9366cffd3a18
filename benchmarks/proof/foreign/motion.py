"""What a system does: Runge and Kutta's rule of order four in small steps that begin anew at every tick.

Between ticks the input is straight or held, so f is as smooth within a step as its formulas are.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from benchmarks.proof.cases import RanAway, rounded
from benchmarks.proof.foreign.effects import AMPLITUDE, Effect
from benchmarks.proof.foreign.formulas import Evaluator, evaluator
from benchmarks.proof.foreign.systems import Experiment, RandomSystem

STEPS = 10  # of the rule, between two ticks
PILOT = 3  # the same where two digits are enough
WIDEST = 4.0  # widths of the box of first states, within which a motion counts as bounded


@dataclass(frozen=True)
class Truth:
    """A system as it really is.

    Attributes
    ----------
    system
        What its card could say.
    parameters
        Their true values.
    effect
        What the card lacks.
    """

    system: RandomSystem
    parameters: Mapping[str, float]
    effect: Effect | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Everything that a formula may depend on."""
        return (*self.system.states, *self.system.inputs, *self.parameters, AMPLITUDE)

    @cached_property
    def _rates(self) -> Evaluator:
        effect = self.effect
        texts = [
            f"{text} + {effect.term}" if effect and not effect.in_sensor and effect.place == name else text
            for name, text in zip(self.system.states, self.system.equations, strict=True)
        ]
        return evaluator(texts, self.names)

    def rates(self, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Time derivatives at states ``(d, n)`` and inputs ``(n,)``, shape ``(d, n)``."""
        return self._rates(self.named(x, u))

    def named(self, x: np.ndarray, u: np.ndarray) -> dict[str, np.ndarray | float]:
        """States, input and parameters by name."""
        given = dict(zip(self.system.states, x, strict=True))
        given |= dict.fromkeys(self.system.inputs, u)
        return {**given, **self.parameters, AMPLITUDE: self.effect.amplitude if self.effect else 0.0}

    def times(self, factor: float) -> Truth:
        """The same with a stronger effect."""
        assert self.effect is not None
        return replace(self, effect=replace(self.effect, amplitude=rounded(factor, 6)))


@dataclass(frozen=True)
class Motion:
    """What a system did.

    Attributes
    ----------
    interval
        Time between two ticks.
    states, slopes
        At every small step, shape ``(d, R, (longest - 1) * steps + 1)``, with their time derivatives.
    steps
        Small steps between two ticks.
    """

    interval: float
    states: np.ndarray
    slopes: np.ndarray
    steps: int

    def at(self, recording: int, t: np.ndarray) -> np.ndarray:
        """States of a recording at some times, by cubics between the small steps; shape ``(d, n)``."""
        h = self.interval / self.steps
        place = np.clip((t / h).astype(int), 0, self.states.shape[2] - 2)
        s = t / h - place
        before, after = self.states[:, recording, place], self.states[:, recording, place + 1]
        rise, fall = self.slopes[:, recording, place], self.slopes[:, recording, place + 1]
        return (
            (1 + 2 * s) * (1 - s) ** 2 * before + s * (1 - s) ** 2 * h * rise
            + s**2 * (3 - 2 * s) * after - s**2 * (1 - s) * h * fall
        )  # fmt: skip

    def ticks(self) -> np.ndarray:
        """States at the ticks, shape ``(d, R, longest)``."""
        return self.states[..., :: self.steps]


def drive_at(experiment: Experiment, *, held: bool, tick: int, share: float) -> np.ndarray:
    """The input at a part of the interval behind a tick, shape ``(R,)``."""
    before = experiment.drive[:, tick]
    return before if held else (1 - share) * before + share * experiment.drive[:, tick + 1]


def move(truth: Truth, experiment: Experiment, *, steps: int = STEPS) -> Motion:
    """Carry an experiment out, all recordings as long as the longest.

    Raises
    ------
    RanAway
        When a state leaves the bounds.
    """
    system = truth.system
    h, ticks = system.interval / steps, int(experiment.lengths.max())
    low, high = system.box.T
    wide = WIDEST * (high - low)[:, None]
    least, most = low[:, None] - wide, high[:, None] + wide
    x = experiment.starts
    states = np.empty((*x.shape, (ticks - 1) * steps + 1))
    slopes = np.empty_like(states)
    for tick in range(ticks - 1):
        drive = _driver(experiment, system.held, tick)
        for small in range(steps):
            begin, middle, end = (drive((small + part) / steps) for part in (0.0, 0.5, 1.0))
            first = truth.rates(x, begin)
            states[..., tick * steps + small], slopes[..., tick * steps + small] = x, first
            second = truth.rates(x + h / 2 * first, middle)
            third = truth.rates(x + h / 2 * second, middle)
            x = x + h / 6 * (first + 2 * second + 2 * third + truth.rates(x + h * third, end))
        if not ((x > least) & (x < most)).all():
            raise RanAway
    states[..., -1], slopes[..., -1] = x, truth.rates(x, experiment.drive[:, ticks - 1])
    return Motion(system.interval, states, slopes, steps)


def _driver(experiment: Experiment, held: bool, tick: int) -> Callable[[float], np.ndarray]:
    return lambda share: drive_at(experiment, held=held, tick=tick, share=share)
