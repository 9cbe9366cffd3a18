"""Kinds whose f, or D, is no polynomial: what a certificate claims of them has to hold all the same."""

from __future__ import annotations

from collections.abc import Callable

import numba
import numpy as np

from benchmarks.hostile.kinds import kind, plain
from benchmarks.hostile.records import FINE, FORGOTTEN, Law, Record, Scene

Shape = Callable[[np.ndarray], np.ndarray]


def two_springs(x: np.ndarray) -> np.ndarray:
    """A spring on either side, so that U has an edge between them."""
    return np.tanh(10 * x) - x


def plateau(x: np.ndarray) -> np.ndarray:
    """Two steep wells, with a flat land between them and a small hill in it."""
    walls = sum(-3 * np.tanh(4 * (x - at)) * (1 + np.tanh(8 * (at * x - 0.6))) / 2 for at in (-1.0, 1.0))
    return np.asarray(walls + 1.2 * np.tanh(8 * x) * np.exp(-8 * x**2))


def two_traps(x: np.ndarray) -> np.ndarray:
    """Two Gaussian traps in a spring."""
    pulls = sum((at - x) * np.exp(-((x - at) ** 2) / 0.32) for at in (-1.0, 1.0))
    return np.asarray(1.6 * pulls - 0.3 * x)


SHAPES: tuple[Shape, ...] = (two_springs, plateau, two_traps)


@numba.njit(cache=True)
def _moved(
    x: float,
    force: np.ndarray,
    power: np.ndarray,
    low: float,
    spacing: float,
    count: int,
    draw: np.random.Generator,
) -> np.ndarray:
    path = np.empty(count)
    for place in range(-FORGOTTEN, count):
        if place >= 0:
            path[place] = x
        share = (x - low) / spacing
        left = min(max(int(share), 0), len(force) - 2)
        share -= left
        push = force[left] + share * (force[left + 1] - force[left])
        noise = power[left] + share * (power[left + 1] - power[left])
        x += FINE * push + np.sqrt(max(noise, 0.0) * FINE) * draw.standard_normal()
    return path


def _shaped(draw: np.random.Generator, scene: Scene, copies: int, force: Shape, power: Shape) -> Record:
    """A record in which the way from the left well to the top is as high as the scene's barrier."""
    law = Law.of(scene, lambda x: force(x) + scene.tilt)
    law = Law(law.grid, law.force, power(law.grid))
    inner = np.abs(law.grid) < 1.5
    height = law.height[inner]
    top = int(np.argmax(np.where(np.abs(law.grid[inner]) < 0.5, height, -np.inf)))
    law = Law(law.grid, law.force, law.power * (height[top] - height[:top].min()) / scene.barrier)
    count, spacing = len(scene.fine_times), float(law.grid[1] - law.grid[0])
    paths = [
        _moved(float(draw.choice([-1.0, 1.0])), law.force, law.power, law.grid[0], spacing, count, draw)
        for _ in range(copies * scene.recordings)
    ]
    return Record.sampled(scene, paths, law=law)


@kind("prediction", "record", twin=plain)
def force_no_polynomial(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """A force that is no polynomial: two springs, a plateau, or two Gaussian traps."""
    scene = Scene.drawn(draw)
    shape = SHAPES[int(draw.integers(len(SHAPES)))]

    def force(x: np.ndarray) -> np.ndarray:
        return np.asarray((1 - strength) * (x - x**3) + strength * shape(x))

    return _shaped(draw, scene, copies, force, np.ones_like)


@kind("prediction", "record", "gaussian_increments", twin=plain)
def noise_no_polynomial(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """A noise that is another one on either side, with a step between them that is no polynomial."""
    scene = Scene.drawn(draw)

    def power(x: np.ndarray) -> np.ndarray:
        return np.asarray(1 + 0.5 * strength * np.tanh(4 * x))

    return _shaped(draw, scene, copies, lambda x: x - x**3, power)
