"""Kinds in which one recorded state is not the whole state."""

from __future__ import annotations

import numba
import numpy as np
import scipy.signal

from benchmarks.hostile.kinds import kind, plain
from benchmarks.hostile.records import (
    FINE,
    FORGOTTEN,
    Law,
    Record,
    Scene,
    double_wells,
    relaxation,
    telegraph,
)


@numba.njit(cache=True)
def _remembering(
    count: int, coupling: float, memory: float, tilt: float, power: float, step: float, before: int,
    draw: np.random.Generator,
) -> np.ndarray:  # fmt: skip
    path, x, past = np.empty(count), 1.0, 1.0
    for place in range(-before, count):
        if place >= 0:
            path[place] = x
        force = x - x**3 + tilt - coupling * (x - past)
        past += step * (x - past) / memory
        x += step * force + np.sqrt(power * step) * draw.standard_normal()
    return path


@kind("state_complete", "record")
def force_with_memory(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """A double well that is drawn to where it was."""
    scene = Scene.drawn(draw)
    memory, count = draw.uniform(2, 15), len(scene.fine_times)
    paths = [
        _remembering(count, 1.0 * strength, memory, scene.tilt, scene.intensity, FINE, FORGOTTEN, draw)
        for _ in range(copies * scene.recordings)
    ]
    return Record.sampled(scene, paths, law=Law.of(scene) if strength == 0 else None)


@numba.njit(cache=True)
def _delayed(
    count: int, gain: float, delay: int, tilt: float, power: float, step: float, before: int,
    draw: np.random.Generator,
) -> np.ndarray:  # fmt: skip
    whole = np.ones(before + count)
    for place in range(before + count - 1):
        x, earlier = whole[place], whole[max(place - delay, 0)]
        force = x - x**3 + tilt - gain * earlier
        whole[place + 1] = x + step * force + np.sqrt(power * step) * draw.standard_normal()
    return whole[before:]


@kind("state_complete", "record", "prediction")
def feedback_with_delay(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """A double well with a feedback that comes late."""
    scene = Scene.drawn(draw)
    delay, sign = int(draw.uniform(1, 8) / FINE), float(draw.choice([-1.0, 1.0]))
    gain, count = 0.4 * strength * sign, len(scene.fine_times)
    paths = [
        _delayed(count, gain, delay, scene.tilt, scene.intensity, FINE, FORGOTTEN, draw)
        for _ in range(copies * scene.recordings)
    ]
    return Record.sampled(scene, paths, law=Law.of(scene) if strength == 0 else None)


@numba.njit(cache=True)
def _relay(
    count: int, threshold: float, power: float, step: float, before: int, draw: np.random.Generator
) -> np.ndarray:
    path, x, side = np.empty(count), 1.0, 1.0
    for place in range(-before, count):
        if place >= 0:
            path[place] = x
        if x * side < -threshold:
            side = -side
        x += 2 * step * (side - x) + np.sqrt(power * step) * draw.standard_normal()
    return path


@kind("state_complete", "record", "prediction", "connected", twin=plain)
def hysteresis(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """A relay with two thresholds decides to which of two levels the state is drawn."""
    scene = Scene.drawn(draw)
    power = scene.intensity * (1 + strength) * 2.5
    count = len(scene.fine_times)
    paths = [
        _relay(count, 0.6 * strength, power, FINE, FORGOTTEN, draw) for _ in range(copies * scene.recordings)
    ]
    return Record.sampled(scene, paths)


@numba.njit(cache=True)
def _inert(
    count: int, mass: float, tilt: float, power: float, step: float, before: int, draw: np.random.Generator
) -> np.ndarray:
    path, x, speed = np.empty(count), 1.0, 0.0
    for place in range(-before, count):
        if place >= 0:
            path[place] = x
        push = step * (x - x**3 + tilt - speed) + np.sqrt(power * step) * draw.standard_normal()
        speed += push / mass
        x += step * speed
    return path


@kind("state_complete", "record", "prediction", twin=plain)
def hidden_velocity(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """A double well with inertia, of which the position was recorded."""
    scene = Scene.drawn(draw)
    count = len(scene.fine_times)
    paths = [
        _inert(count, 0.05 + 2.0 * strength**2, scene.tilt, scene.intensity, FINE, FORGOTTEN, draw)
        for _ in range(copies * scene.recordings)
    ]
    return Record.sampled(scene, paths)


@kind("state_complete", "record", "prediction", twin=plain)
def coloured_force(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """A double well that is driven by noise with a memory instead of white noise."""
    scene = Scene.drawn(draw)
    time = 0.05 + 1.0 * strength**2

    def push(t: np.ndarray, draw: np.random.Generator) -> np.ndarray:
        return np.sqrt(scene.intensity / (2 * time)) * relaxation(draw, len(t), time)

    def nothing(t: np.ndarray, draw: np.random.Generator) -> np.ndarray:
        return np.zeros(len(t))

    return Record.sampled(scene, double_wells(draw, scene, copies, push=push, power=nothing))


@numba.njit(cache=True)
def _three(
    count: int, places: np.ndarray, power: float, step: float, before: int, draw: np.random.Generator
) -> np.ndarray:
    path, x, y = np.empty((count, 2)), places[0, 0], places[0, 1]
    for place in range(-before, count):
        if place >= 0:
            path[place, 0], path[place, 1] = x, y
        radius = x**2 + y**2
        force_x, force_y = -0.4 * x * radius, -0.4 * y * radius
        for well in range(len(places)):
            dx, dy = x - places[well, 0], y - places[well, 1]
            pull = 2.2 * np.exp(-(dx**2 + dy**2) / 0.5)
            force_x -= pull * dx
            force_y -= pull * dy
        x += step * force_x + np.sqrt(power * step) * draw.standard_normal()
        y += step * force_y + np.sqrt(power * step) * draw.standard_normal()
    return path


@kind("state_complete", "record", "prediction", "connected", twin=plain)
def projected_wells(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """Three wells in two states, of which one was recorded that shows two."""
    scene = Scene.drawn(draw)
    high = 0.3 + 0.8 * strength
    places = np.array([[-0.8, high], [-0.8, -high], [0.9, high]])
    count, power = len(scene.fine_times), scene.intensity * 1.3
    paths = [
        _three(count, places, power, FINE, FORGOTTEN, draw)[:, 0] for _ in range(copies * scene.recordings)
    ]
    return Record.sampled(scene, paths)


@kind("state_complete", "record", "prediction")
def two_double_wells(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """The sum of two independent double wells, a large and a small one."""
    scene = Scene.drawn(draw)
    first, second = double_wells(draw, scene, copies), double_wells(draw, scene, copies)
    added = [one + 0.7 * strength * other for one, other in zip(first, second, strict=True)]
    return Record.sampled(scene, added, law=Law.of(scene) if strength == 0 else None)


@kind("state_complete", "record", "prediction", "connected", twin=plain)
def regular_stays(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """Two levels with stays that are more regular than exponential ones."""
    scene = Scene.drawn(draw)
    shape, stay = 1 + 8 * strength, draw.uniform(15, 40)
    spread = np.sqrt(scene.intensity / 4)
    paths = []
    for _ in range(copies * scene.recordings):
        t = scene.fine_times
        level = scipy.signal.lfilter([FINE / 0.3], [1, FINE / 0.3 - 1], telegraph(draw, t, stay, shape=shape))
        paths.append(level + spread * relaxation(draw, len(t), 0.5))
    return Record.sampled(scene, paths)


@kind("state_complete", "record", "prediction", "gaussian_increments", "connected", twin=plain)
def filtered_telegraph(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """A telegraph signal behind a slow filter, with some noise."""
    scene = Scene.drawn(draw)
    stay, time, spread = draw.uniform(15, 40), 0.2 + 2.0 * strength, 0.5 * np.sqrt(scene.intensity / 4)
    paths = []
    for _ in range(copies * scene.recordings):
        t = scene.fine_times
        level = scipy.signal.lfilter([FINE / time], [1, FINE / time - 1], telegraph(draw, t, stay))
        paths.append(level + spread * relaxation(draw, len(t), 0.5))
    return Record.sampled(scene, paths)


@numba.njit(cache=True)
def _excitable(
    count: int, current: float, slow: float, power: float, step: float, before: int,
    draw: np.random.Generator,
) -> np.ndarray:  # fmt: skip
    path, x, y = np.empty(count), 1.0, 0.0
    for place in range(-before, count):
        if place >= 0:
            path[place] = x
        move = step * (x - x**3 - y) + np.sqrt(power * step) * draw.standard_normal()
        y += step * slow * (x - current)
        x += move
    return path


@kind("state_complete", "record", "prediction", "unchanged", twin=plain)
def relaxation_oscillator(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """An oscillator that jumps between two branches in turn (FitzHugh and Nagumo)."""
    scene = Scene.drawn(draw)
    slow, count = 0.002 + 0.05 * strength, len(scene.fine_times)
    paths = [
        _excitable(count, 0.0, slow, scene.intensity * 0.6, FINE, FORGOTTEN, draw)
        for _ in range(copies * scene.recordings)
    ]
    return Record.sampled(scene, paths)
