"""How are hostile records simulated, and what is true of the process behind one?

States are dimensionless: the symmetric double well has ``dx = (x - x³) dt + √ε dW``, wells at ±1 and a
barrier ``ΔU/ε = 1/2ε``. A `Scene` holds what is drawn for one case, its unit, its offset and the unit of time
included, so that no method can know the scale. A `Record` is what the instrument wrote, with the states that
were there.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numba
import numpy as np
import scipy.signal

from siq.data.recordings import Recordings

STEP = 0.1  # between samples: a fifth of the time in which a well of depth 1/4 relaxes
WITHIN = 10  # steps of Euler and Maruyama between samples
FINE = STEP / WITHIN  # of these steps
FORGOTTEN = 2_000  # of these before a recording begins
SAMPLES = 20_000  # of all recordings of a case together: 20 hops and more

Series = Callable[[np.ndarray, np.random.Generator], np.ndarray]
"""Values at the fine times of a recording."""


@dataclass(frozen=True)
class Scene:
    """What is drawn for one case: two cases of one seed share it, however long they are.

    Attributes
    ----------
    barrier
        ``1/2ε``, the ΔU/ε of the symmetric double well.
    tilt
        A constant force.
    unit, offset, pace
        Of the values: ``value = offset + unit·x``; and the unit of time.
    recordings, samples
        How many, and of how many samples each.
    """

    barrier: float
    tilt: float
    unit: float
    offset: float
    pace: float
    recordings: int
    samples: int

    @classmethod
    def drawn(cls, draw: np.random.Generator, *, recordings: Sequence[int] = (1, 4, 10)) -> Scene:
        """A double well that hops twenty times or more in the samples of a case, mostly fifty."""
        count = int(draw.choice(recordings))
        unit = 10 ** draw.uniform(-2, 2)
        return cls(
            draw.uniform(1.7, 2.4), draw.uniform(-0.04, 0.04), unit, unit * draw.normal(0, 2),
            10 ** draw.uniform(-2, 2), count, SAMPLES // count,
        )  # fmt: skip

    @property
    def intensity(self) -> float:
        """The ε of the noise."""
        return 0.5 / self.barrier

    @property
    def times(self) -> np.ndarray:
        """Of the samples of a recording."""
        return STEP * np.arange(self.samples)

    @property
    def fine_times(self) -> np.ndarray:
        """Of the steps of the simulation, from the first sample to the last."""
        return FINE * np.arange((self.samples - 1) * WITHIN + 1)


@dataclass(frozen=True)
class Law:
    """A diffusion ``dx = f dt + √q dW`` in one state: barriers and mean times by quadrature.

    `grid` are evenly spaced states far beyond all that is visited, `force` and `power` are f and q there.
    """

    grid: np.ndarray
    force: np.ndarray
    power: np.ndarray

    @classmethod
    def of(cls, scene: Scene, force: Callable[[np.ndarray], np.ndarray] | None = None) -> Law:
        """The double well of a scene, or another force with its noise."""
        grid = np.linspace(-2.5, 2.5, 5001)
        drift = grid - grid**3 + scene.tilt if force is None else force(grid)
        return cls(grid, drift, np.full(len(grid), scene.intensity))

    @property
    def height(self) -> np.ndarray:
        """``U/ε = -∫ 2f/q dx``, zero at its lowest: shape ``(n,)``."""
        slope = -2 * self.force / self.power
        steps = np.diff(self.grid) * (slope[1:] + slope[:-1]) / 2
        height = np.append(0.0, np.cumsum(steps))
        return np.asarray(height - height.min())

    def time(self, start: float, end: float) -> float:
        """Mean time of the first passage, ``∫ exp(Φ(y)) ∫ 2 exp(-Φ(z))/q dz dy`` with Φ = U/ε."""
        sign = 1.0 if end >= start else -1.0
        grid, height, power = self.grid[:: int(sign)], self.height[:: int(sign)], self.power[:: int(sign)]
        step = abs(grid[1] - grid[0])
        behind = np.cumsum(2 * np.exp(-height) / power) * step
        inner = (sign * grid >= sign * start) & (sign * grid <= sign * end)
        return float((np.exp(height) * behind)[inner].sum() * step)


@dataclass(frozen=True)
class Record:
    """What an instrument wrote of a scene, and what was there.

    Attributes
    ----------
    scene
        What was drawn.
    seen, times
        Dimensionless values, one array ``(n_k,)`` for each recording, and their times.
    states
        The true states, evenly sampled, one array for each recording; the values without what the instrument
        did.
    law
        The diffusion that they follow, where it is one in a single state.
    """

    scene: Scene
    seen: list[np.ndarray]
    times: list[np.ndarray]
    states: list[np.ndarray] = field(repr=False)
    law: Law | None = None

    @classmethod
    def sampled(
        cls,
        scene: Scene,
        paths: Sequence[np.ndarray],
        *,
        law: Law | None = None,
        sensor: Callable[[np.ndarray], np.ndarray] | None = None,
    ) -> Record:
        """Of paths in fine steps, samples as a sensor shows them: ``(n,) -> (n,)``, the states by default."""
        states = [path[::WITHIN] for path in paths]
        seen = states if sensor is None else [sensor(one) for one in states]
        return cls(scene, seen, [STEP * np.arange(len(one)) for one in seen], states, law)

    def recordings(self) -> Recordings:
        """The same as a user reads it, in the units of the scene."""
        scene = self.scene
        values = [(scene.offset + scene.unit * one)[:, None] for one in self.seen]
        return Recordings.from_arrays([scene.pace * one for one in self.times], values, names=["x"])


@numba.njit(cache=True)
def _wells(
    x: float,
    curvature: np.ndarray,
    push: np.ndarray,
    power: np.ndarray,
    step: float,
    before: int,
    draw: np.random.Generator,
) -> np.ndarray:
    path = np.empty(len(push))
    for place in range(-before, len(push)):
        at = max(place, 0)
        if place >= 0:
            path[place] = x
        force = curvature[at] * x - x**3 + push[at]
        x += step * force + np.sqrt(power[at] * step) * draw.standard_normal()
    return path


def double_wells(
    draw: np.random.Generator,
    scene: Scene,
    copies: int,
    *,
    push: Series | None = None,
    curvature: Series | None = None,
    power: Series | None = None,
) -> list[np.ndarray]:
    """Paths of ``dx = (a x - x³ + tilt + push) dt + √(ε·power) dW``, in fine steps; `copies` times as many.

    The series are functions of the fine times of a recording; a is 1, and so is the power, by default.
    """
    t, paths = scene.fine_times, []
    for _ in range(copies * scene.recordings):
        parts = [np.full(len(t), 1.0) if one is None else one(t, draw) for one in (curvature, power)]
        pushed = scene.tilt + (np.zeros(len(t)) if push is None else push(t, draw))
        start = float(draw.choice([-1.0, 1.0]))
        noise = scene.intensity * parts[1]
        paths.append(_wells(start, parts[0], pushed, noise, FINE, FORGOTTEN, draw))
    return paths


def relaxation(draw: np.random.Generator, count: int, time: float, *, step: float = FINE) -> np.ndarray:
    """A stationary Ornstein–Uhlenbeck process of unit variance, ``(count,)``, with a correlation time."""
    fade = np.exp(-step / time)
    noise = np.sqrt(1 - fade**2) * draw.standard_normal(count)
    return np.asarray(scipy.signal.lfilter([1], [1, -fade], noise, zi=[fade * draw.standard_normal()])[0])


def one_wells(draw: np.random.Generator, scene: Scene, copies: int) -> list[np.ndarray]:
    """Paths of ``dx = -2x dt + √ε dW``, which is the double well about one of its states, in fine steps."""
    spread = np.sqrt(scene.intensity / 4)
    count = len(scene.fine_times)
    return [spread * relaxation(draw, count, 0.5) for _ in range(copies * scene.recordings)]


def telegraph(draw: np.random.Generator, t: np.ndarray, stay: float, *, shape: float = 1.0) -> np.ndarray:
    """±1 at evenly spaced times, with stays of a gamma distribution, exponential by default: ``(n,)``."""
    ends, last = [], 0.0
    while last <= t[-1]:
        stays = draw.gamma(shape, stay / shape, 64 + int(t[-1] / stay))
        ends.append(last + np.cumsum(stays))
        last = float(ends[-1][-1])
    hops = np.searchsorted(np.concatenate(ends), t, side="right")
    return np.asarray(draw.choice([-1.0, 1.0]) * (1.0 - 2.0 * (hops % 2)))
