"""Kinds that are several systems, or one that changes in time."""

from __future__ import annotations

import numpy as np

from benchmarks.hostile.kinds import kind, plain, several
from benchmarks.hostile.records import (
    Law,
    Record,
    Scene,
    Series,
    double_wells,
    one_wells,
    relaxation,
    telegraph,
)


def _double_wells(
    draw: np.random.Generator, scene: Scene, copies: int, strength: float, **flaw: Series
) -> Record:
    """A double well with a flaw (`double_wells`); without any it is the diffusion of the scene."""
    law = Law.of(scene) if strength == 0 else None
    return Record.sampled(scene, double_wells(draw, scene, copies, **flaw), law=law)


@kind("one_system", "connected", twin=several)
def two_offsets(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """Two instruments with different offsets, one well each, not a single hop."""
    scene = Scene.drawn(draw, recordings=(2, 4, 8))
    paths = one_wells(draw, scene, copies)
    apart = 2.5 * strength
    return Record.sampled(scene, [path + apart * (place % 2) for place, path in enumerate(paths)])


@kind("unchanged", "connected", "state_complete", "gaussian_increments", twin=plain)
def joined_levels(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """Two stationary one-well records read as one."""
    scene = Scene.drawn(draw, recordings=(1,))
    paths = one_wells(draw, scene, copies)
    late = scene.fine_times > scene.fine_times[-1] * draw.uniform(0.3, 0.7)
    return Record.sampled(scene, [path + 2.5 * strength * late for path in paths])


@kind("one_system", "connected", twin=several)
def baselines_of_one_well(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """Twelve recordings of one well, each with a baseline of its own."""
    scene = Scene.drawn(draw, recordings=(12,))
    levels = 1.2 * strength * draw.standard_normal(scene.recordings)
    paths = one_wells(draw, scene, copies)
    return Record.sampled(scene, [path + levels[place % len(levels)] for place, path in enumerate(paths)])


@kind("one_system")
def gains(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """A double well that every instrument amplifies otherwise."""
    scene = Scene.drawn(draw, recordings=(4, 8))
    gain = np.exp(0.5 * strength * draw.standard_normal(scene.recordings))
    paths = double_wells(draw, scene, copies)
    scaled = [gain[place % len(gain)] * path for place, path in enumerate(paths)]
    return Record.sampled(scene, scaled, law=Law.of(scene) if strength == 0 else None)


@kind("one_system")
def baselines(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """A double well in recordings that have a baseline each, which is taken off: the law is that without."""
    scene = Scene.drawn(draw, recordings=(4, 8))
    level = 0.7 * strength * draw.standard_normal(scene.recordings)
    paths = double_wells(draw, scene, copies)
    moved = [path + level[place % len(level)] for place, path in enumerate(paths)]
    return Record.sampled(scene, moved, law=Law.of(scene))


def _by_recording(draw: np.random.Generator, strength: float, copies: int, what: str, size: float) -> Record:
    """Double wells, of which half of the recordings have more and half less of something."""
    scene = Scene.drawn(draw, recordings=(2, 4, 8))
    paths: list[np.ndarray] = []
    for place in range(copies * scene.recordings):
        value = size * strength * (1 if place % 2 else -1) + (0.0 if what == "push" else 1.0)
        own = Scene(**{**vars(scene), "recordings": 1})
        paths += double_wells(
            draw, own, 1, **{what: lambda t, _, value=value: np.full(len(t), value)}
        )  # fmt: skip
    return Record.sampled(scene, paths, law=Law.of(scene) if strength == 0 else None)


@kind("one_system")
def two_curvatures(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """Recordings of two double wells, a deep and a shallow one."""
    return _by_recording(draw, strength, copies, "curvature", 0.5)


@kind("one_system")
def two_tilts(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """Recordings of a double well that is tilted to one side or the other."""
    return _by_recording(draw, strength, copies, "push", 0.25)


@kind("one_system", "gaussian_increments")
def two_temperatures(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """Recordings of one double well under weak and under strong noise."""
    return _by_recording(draw, strength, copies, "power", 0.6)


@kind("one_system", "prediction")
def two_clocks(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """Recordings half of which have a clock that runs fast."""
    scene = Scene.drawn(draw, recordings=(4, 8))
    made = Record.sampled(scene, double_wells(draw, scene, copies), law=Law.of(scene))
    rate = 1 - 0.7 * strength
    times = [one * rate if place % 2 else one for place, one in enumerate(made.times)]
    return Record(scene, made.seen, times, made.states, made.law)


@kind("one_system", "unchanged", twin=several)
def mirrored(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """A tilted double well, to which its recordings were added once more with the other sign."""
    scene = Scene.drawn(draw, recordings=(2, 4))
    half = Scene(**{**vars(scene), "samples": scene.samples // 2, "tilt": 0.25 * strength})
    paths = double_wells(draw, half, copies)
    both = Record.sampled(half, [*paths, *(-path for path in paths)])
    return Record(scene, both.seen, both.times, [path[::10] for path in paths], Law.of(half))


@kind("unchanged", "state_complete", "record")
def swinging_tilt(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """A double well whose tilt swings with a short period."""
    scene = Scene.drawn(draw)
    period = draw.uniform(5, 40)

    def push(t: np.ndarray, draw: np.random.Generator) -> np.ndarray:
        return np.asarray(0.4 * strength * np.sin(2 * np.pi * t / period))

    return _double_wells(draw, scene, copies, strength, push=push)


@kind("unchanged", "state_complete", "record")
def slow_swing(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """A double well whose tilt swings two to four times in a recording."""
    scene = Scene.drawn(draw, recordings=(1, 2))
    period, phase = scene.times[-1] / draw.uniform(2, 4), draw.uniform(0, 2 * np.pi)

    def push(t: np.ndarray, draw: np.random.Generator) -> np.ndarray:
        return np.asarray(0.3 * strength * np.sin(2 * np.pi * t / period + phase))

    return _double_wells(draw, scene, copies, strength, push=push)


@kind("unchanged", "state_complete", "record")
def swinging_barrier(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """A double well whose barrier goes up and down with a period."""
    scene = Scene.drawn(draw)
    period = draw.uniform(10, 80)

    def curvature(t: np.ndarray, draw: np.random.Generator) -> np.ndarray:
        return np.asarray(1 + 0.7 * strength * np.sin(2 * np.pi * t / period))

    return _double_wells(draw, scene, copies, strength, curvature=curvature)


@kind("unchanged", "state_complete", "gaussian_increments", "record")
def swinging_noise(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """A double well whose noise swells and fades with a period."""
    scene = Scene.drawn(draw)
    period = draw.uniform(10, 80)

    def power(t: np.ndarray, draw: np.random.Generator) -> np.ndarray:
        return np.asarray(1 + 0.9 * strength * np.sin(2 * np.pi * t / period))

    return _double_wells(draw, scene, copies, strength, power=power)


@kind("unchanged", "one_system", "record")
def ramp_of_tilt(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """A double well that is tilted from one side to the other in the course of every recording."""
    scene = Scene.drawn(draw, recordings=(1, 2, 4))

    def push(t: np.ndarray, draw: np.random.Generator) -> np.ndarray:
        return np.asarray(0.35 * strength * (2 * t / t[-1] - 1))

    return _double_wells(draw, scene, copies, strength, push=push)


@kind("unchanged", "one_system", "gaussian_increments", "record")
def growing_noise(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """A double well whose noise grows in the course of every recording."""
    scene = Scene.drawn(draw, recordings=(1, 2, 4))

    def power(t: np.ndarray, draw: np.random.Generator) -> np.ndarray:
        return np.asarray(1 + 0.7 * strength * (2 * t / t[-1] - 1))

    return _double_wells(draw, scene, copies, strength, power=power)


@kind("unchanged", "one_system", "record")
def changed_midway(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """A double well whose barrier drops in the middle of every recording."""
    scene = Scene.drawn(draw, recordings=(1, 2))

    def curvature(t: np.ndarray, draw: np.random.Generator) -> np.ndarray:
        return np.where(t < t[-1] / 2, 1 + 0.3 * strength, 1 - 0.5 * strength)

    return _double_wells(draw, scene, copies, strength, curvature=curvature)


@kind("state_complete", "unchanged", "record")
def gate(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """A hidden gate that switches the tilt of a double well."""
    scene = Scene.drawn(draw)
    stay = 10 ** draw.uniform(0.5, 2)

    def push(t: np.ndarray, draw: np.random.Generator) -> np.ndarray:
        return 0.35 * strength * telegraph(draw, t, stay)

    return _double_wells(draw, scene, copies, strength, push=push)


@kind("state_complete", "unchanged", "gaussian_increments", "record")
def bursts(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """A double well whose noise comes in bursts."""
    scene = Scene.drawn(draw)
    stay = 10 ** draw.uniform(0.3, 1.5)

    def power(t: np.ndarray, draw: np.random.Generator) -> np.ndarray:
        return 1 + 0.9 * strength * telegraph(draw, t, stay)

    return _double_wells(draw, scene, copies, strength, power=power)


@kind("state_complete", "unchanged", "record")
def hidden_slow_variable(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """A slow variable that was not recorded tilts a double well."""
    scene = Scene.drawn(draw)
    time = 10 ** draw.uniform(0.5, 2)

    def push(t: np.ndarray, draw: np.random.Generator) -> np.ndarray:
        return 0.35 * strength * relaxation(draw, len(t), time)

    return _double_wells(draw, scene, copies, strength, push=push)


@kind("connected", "record", "prediction", twin=plain)
def few_passages(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """A double well that is so deep that hardly a passage was seen."""
    scene = Scene.drawn(draw)
    scene = Scene(**{**vars(scene), "barrier": scene.barrier + 3.0 * strength})
    return Record.sampled(scene, double_wells(draw, scene, copies), law=Law.of(scene))
