"""Models: a system with what it conceals, the inputs that reach it, and what it did."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from benchmarks.proof.concealment.effects import Effect
from benchmarks.proof.concealment.physics import PhysicalSystem, Values


@dataclass(frozen=True)
class TrueSystem:
    """A system with the parameters that it really has, and what is concealed in it."""

    system: PhysicalSystem
    parameters: Mapping[str, float]
    effect: Effect | None = None

    @cached_property
    def names(self) -> tuple[str, ...]:
        """All states, those that the effect brings along at the end."""
        return (*self.system.states, *(self.effect.states if self.effect else ()))

    @cached_property
    def lag(self) -> float:
        """How late inputs arrive."""
        return self.effect.parameters[self.effect.lag] if self.effect and self.effect.lag else 0.0

    def drift(
        self, t: float | np.ndarray, x: np.ndarray, u: np.ndarray, sides: np.ndarray | None = None
    ) -> np.ndarray:
        """Time derivatives of all states.

        Parameters
        ----------
        t
            Time, one for all points or one for each.
        x
            States, shape ``(states, points)``.
        u
            Inputs that have arrived, shape ``(inputs, points)``.
        sides
            Signs of the effect's switches, shape ``(switches, points)``; that of a velocity with friction is
            0 where the mass rests and is held. Left out: the signs that they have, and what rests is held as
            long as friction can hold it.
        """
        effect = self.effect
        theta: Values = self.parameters
        rows = len(self.system.states)
        values = np.zeros_like(x)
        if effect is None:
            values[:] = self.system.equations(x, u, theta)
            return values
        p = effect.parameters
        named = {**dict(zip(self.names, x, strict=True)), "t": t}
        if effect.changed:
            theta = effect.changed(named, theta, p)
        if effect.driven:
            u = effect.driven(u, p)
        for row, value in enumerate(self.system.equations(x[:rows], u, theta)):
            values[row] = value
        acting = np.sign(self.switches(x)) if sides is None else sides
        if effect.added:
            named["sides"] = acting
            for name, value in effect.added(named, p).items():
                values[self.names.index(name)] += value
        if effect.friction:
            row = self.names.index(effect.friction.velocity)
            held = -np.clip(values[row], *self.holding()) if sides is None else -values[row]
            moving = acting[0]
            values[row] += np.where(moving == 0, held, effect.friction.force(x[row], moving, p))
        return values

    def switches(self, x: np.ndarray) -> np.ndarray:
        """Values of the effect's switches, shape ``(switches, points)``."""
        effect = self.effect
        if effect is None or not effect.switches:
            return np.zeros((0, x.shape[-1]))
        named = dict(zip(self.names, x, strict=True))
        return np.array([switch(named, effect.parameters) for switch in effect.switches])

    def holding(self) -> tuple[float, float]:
        """Between which forces per mass, lowest and highest, friction holds what rests."""
        assert self.effect is not None and self.effect.friction is not None
        force, p = self.effect.friction.force, self.effect.parameters
        return -float(force(0.0, -1.0, p)), -float(force(0.0, 1.0, p))


@dataclass(frozen=True)
class Drive:
    """Inputs between the samples: held, or straight from one to the next; and as late as they arrive."""

    times: np.ndarray
    inputs: np.ndarray
    held: bool
    lag: float

    def only(self, recording: int) -> Drive:
        """The inputs of one recording."""
        return Drive(self.times, self.inputs[:, [recording]], self.held, self.lag)

    def breaks(self) -> np.ndarray:
        """Samples, and all times between them at which a kink or a jump of the inputs arrives."""
        if not self.inputs.any():
            return self.times[[0, -1]]
        late = self.times + self.lag
        return np.union1d(self.times, late[late < self.times[-1]])

    def line(self, moment: float) -> tuple[np.ndarray, np.ndarray, float]:
        """The straight line that inputs follow at a moment: value and slope ``(inputs, recordings)``, origin.

        Before the recording they were what they are at its start.
        """
        interval = self.times[1]
        index = int((moment - self.lag) / interval)
        if moment < self.lag or index >= len(self.times) - 1:
            value = self.inputs[..., 0 if moment < self.lag else -1]
            return value, 0 * value, moment
        value, following = self.inputs[..., index], self.inputs[..., index + 1]
        slope = 0 * value if self.held else (following - value) / interval
        return value, slope, self.times[index] + self.lag

    def at(self, moments: np.ndarray) -> np.ndarray:
        """What has arrived at some moments, shape ``(inputs, recordings, moments)``."""
        elapsed = np.clip((moments - self.lag) / self.times[1], 0, len(self.times) - 1)
        before = elapsed.astype(int)
        if self.held:
            return self.inputs[..., before]
        after = np.minimum(before + 1, len(self.times) - 1)
        share = elapsed - before
        return (1 - share) * self.inputs[..., before] + share * self.inputs[..., after]

    def at_samples(self) -> np.ndarray:
        """What has arrived at the samples, shape ``(inputs, recordings, N)``."""
        return self.at(self.times) if self.lag else self.inputs


@dataclass(frozen=True)
class Trajectories:
    """What all recordings of a case really did, at the samples.

    Attributes
    ----------
    times
        Shape ``(N,)``.
    states
        Shape ``(states, recordings, N)``, states that the effect brings along included.
    inputs
        Shape ``(inputs, recordings, N)``, as they are recorded.
    """

    times: np.ndarray
    states: np.ndarray
    inputs: np.ndarray


def derivatives(model: TrueSystem, path: Trajectories, effect: Effect | None) -> np.ndarray:
    """Time derivatives along trajectories with a given effect, or with none, ``(states, recordings * N)``."""
    acting = TrueSystem(model.system, model.parameters, effect)
    rows = len(acting.names)
    inputs = Drive(path.times, path.inputs, model.system.held, acting.lag).at_samples()
    times = np.tile(path.times, path.states.shape[1])
    return acting.drift(times, path.states[:rows].reshape(rows, -1), inputs.reshape(len(inputs), len(times)))
