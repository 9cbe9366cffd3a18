"""Kinds in which a double well is what it should be, and the instrument or the file is not."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.signal

from benchmarks.hostile.kinds import Maker, kind, plain
from benchmarks.hostile.records import STEP, WITHIN, Law, Record, Scene, double_wells, relaxation, telegraph

Sensor = Callable[[np.ndarray], np.ndarray]


def _seen(draw: np.random.Generator, copies: int, sensor: Callable[[Scene], Sensor]) -> Record:
    """A double well as a sensor shows it; what the sensor draws once is drawn before all paths."""
    scene = Scene.drawn(draw)
    own = sensor(scene)
    return Record.sampled(scene, double_wells(draw, scene, copies), law=Law.of(scene), sensor=own)


def _noisy(size: float) -> Maker:
    """The honest record of a noisy sensor: white Gaussian noise of this size, times the strength."""

    def make(draw: np.random.Generator, strength: float, copies: int) -> Record:
        def sensor(scene: Scene) -> Sensor:
            return lambda x: x + size * strength * draw.standard_normal(len(x))

        return _seen(draw, copies, sensor)

    return make


@kind("gaussian_increments", "prediction", "state_complete", twin=_noisy(0.15))
def heavy_tailed_sensor(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """Sensor noise of Student's distribution with two degrees of freedom."""

    def sensor(scene: Scene) -> Sensor:
        return lambda x: x + 0.15 * strength * draw.standard_t(2, len(x))

    return _seen(draw, copies, sensor)


@kind("gaussian_increments", "prediction", "state_complete", twin=_noisy(0.2))
def sensor_noise_of_the_state(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """Sensor noise that is strong in one well and weak in the other."""

    def sensor(scene: Scene) -> Sensor:
        return lambda x: x + 0.2 * strength * np.abs(1 + x) * draw.standard_normal(len(x))

    return _seen(draw, copies, sensor)


@kind("prediction", "state_complete", "unchanged", "gaussian_increments", twin=_noisy(0.2))
def correlated_sensor(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """Sensor noise with a memory of some samples."""

    def sensor(scene: Scene) -> Sensor:
        time = draw.uniform(2, 10) * STEP
        return lambda x: x + 0.3 * strength * relaxation(draw, len(x), time, step=STEP)

    return _seen(draw, copies, sensor)


@kind("gaussian_increments", "prediction", "state_complete")
def clipped(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """An amplifier that saturates, at both ends."""

    def sensor(scene: Scene) -> Sensor:
        limit = 2.2 - 1.3 * strength if strength else np.inf
        return lambda x: np.clip(x, -limit, limit)

    return _seen(draw, copies, sensor)


@kind("gaussian_increments", "prediction", "state_complete")
def quantised(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """A converter of few bits."""

    def sensor(scene: Scene) -> Sensor:
        step = 0.8 * strength
        return (lambda x: step * np.round(x / step)) if strength else (lambda x: x)

    return _seen(draw, copies, sensor)


@kind("gaussian_increments", "prediction", "state_complete", "unchanged")
def held_values(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """A file that repeats each value until the next one comes."""

    def sensor(scene: Scene) -> Sensor:
        times = 1 + round(8 * strength)
        return lambda x: np.repeat(x[::times], times)[: len(x)]

    return _seen(draw, copies, sensor)


def _gaps(draw: np.random.Generator, count: int, share: float) -> np.ndarray:
    """Which samples a gap hides, ``(count,)``: gaps of 10 to 60 samples, the share of all in the mean."""
    hidden, place = np.zeros(count, dtype=bool), 0
    while share > 0:
        gap = int(draw.integers(10, 61))
        place += int(draw.exponential(gap * (1 - share) / share)) + 1
        if place + gap >= count - 1:
            break
        hidden[place : place + gap] = True
        place += gap
    return hidden


@kind("gaussian_increments", "prediction", "state_complete")
def interpolated_gaps(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """Gaps that were filled along straight lines."""

    def sensor(scene: Scene) -> Sensor:
        def filled(x: np.ndarray) -> np.ndarray:
            known = np.flatnonzero(~_gaps(draw, len(x), 0.6 * strength))
            return np.interp(np.arange(len(x)), known, x[known])

        return filled

    return _seen(draw, copies, sensor)


@kind("gaussian_increments", "prediction", "state_complete")
def held_gaps(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """Gaps that were filled with the last value before them."""

    def sensor(scene: Scene) -> Sensor:
        def filled(x: np.ndarray) -> np.ndarray:
            known = np.flatnonzero(~_gaps(draw, len(x), 0.6 * strength))
            return x[known[np.searchsorted(known, np.arange(len(x)), side="right") - 1]]

        return filled

    return _seen(draw, copies, sensor)


@kind("gaussian_increments", "prediction", "state_complete")
def finer_grid(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """A record that was interpolated to a finer grid of times."""

    def sensor(scene: Scene) -> Sensor:
        times = 1 + round(4 * strength)
        return lambda x: np.interp(np.arange(len(x)) / times, np.arange(len(x)), x)

    scene = Scene.drawn(draw)
    made = Record.sampled(scene, double_wells(draw, scene, copies), law=Law.of(scene), sensor=sensor(scene))
    times = 1 + round(4 * strength)
    return Record(scene, made.seen, [one / times for one in made.times], made.states, made.law)


def _hummed(draw: np.random.Generator, copies: int, size: float, periods: tuple[float, float]) -> Record:
    """A sine upon the values, of a period in samples that is drawn between two."""

    def sensor(scene: Scene) -> Sensor:
        period = draw.uniform(*periods)
        return lambda x: x + size * np.sin(2 * np.pi * np.arange(len(x)) / period)

    return _seen(draw, copies, sensor)


@kind("state_complete", "unchanged", "prediction", "gaussian_increments")
def hum(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """The hum of the mains upon the values, some samples long."""
    return _hummed(draw, copies, 0.6 * strength, (2.5, 12))


@kind("state_complete", "unchanged", "prediction", "gaussian_increments")
def aliased_hum(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """A hum whose frequency is close to that of the samples, so that it looks slow."""
    return _hummed(draw, copies, 0.8 * strength, (40, 400))


@kind("unchanged", "one_system", "state_complete", "prediction")
def mechanical_drift(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """A stage that drifts: values wander, and the system does not know of it."""

    def sensor(scene: Scene) -> Sensor:
        def drifted(x: np.ndarray) -> np.ndarray:
            wandering = np.cumsum(draw.standard_normal(len(x))) / np.sqrt(len(x))
            return x + 1.2 * strength * (wandering + draw.normal() * np.linspace(-0.5, 0.5, len(x)))

        return drifted

    return _seen(draw, copies, sensor)


@kind("unchanged", "state_complete", "gaussian_increments", "prediction", "connected", twin=plain)
def popcorn(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """One well, and a sensor that has two offsets and switches between them."""
    scene = Scene.drawn(draw)
    spread, stay = np.sqrt(scene.intensity / 4), draw.uniform(15, 40)
    paths = []
    for _ in range(copies * scene.recordings):
        t = scene.fine_times
        paths.append(spread * relaxation(draw, len(t), 0.5) + strength * telegraph(draw, t, stay))
    made = Record.sampled(scene, paths)
    return made


@kind("state_complete", "prediction", "record")
def smoothed(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """Values that were smoothed before every so many of them were kept."""
    scene = Scene.drawn(draw)
    paths = double_wells(draw, scene, copies)
    time = 1.5 * strength
    fade = np.exp(-STEP / WITHIN / time) if time else 0.0
    seen = [scipy.signal.lfilter([1 - fade], [1, -fade], one, zi=[fade * one[0]])[0] for one in paths]
    made = Record.sampled(scene, paths, law=Law.of(scene))
    return Record(scene, [one[::WITHIN] for one in seen], made.times, made.states, made.law)


@kind("prediction", "gaussian_increments", "record", "state_complete")
def jittered_clock(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """Samples that were taken earlier or later than the file says."""
    scene = Scene.drawn(draw)
    paths = double_wells(draw, scene, copies)
    made = Record.sampled(scene, paths, law=Law.of(scene))
    seen = []
    for path, times in zip(paths, made.times, strict=True):
        late = 2.0 * strength * draw.standard_normal(len(times))  # samples; beyond a half the order changes
        at = np.clip(np.round((np.arange(len(times)) + late) * WITHIN), 0, len(path) - 1)
        seen.append(path[at.astype(int)])
    return Record(scene, seen, made.times, made.states, made.law)


@kind("gaussian_increments", "prediction", "record", "state_complete")
def lost_buffers(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """Blocks of samples that were lost without a gap in the times."""
    scene = Scene.drawn(draw)
    made = Record.sampled(scene, double_wells(draw, scene, copies), law=Law.of(scene))
    seen = [one[~_gaps(draw, len(one), 0.6 * strength)] for one in made.seen]
    return Record(scene, seen, [STEP * np.arange(len(one)) for one in seen], made.states, made.law)


@kind("gaussian_increments", "prediction", "record", "state_complete", "unchanged")
def shuffled(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """Pieces of a recording in the wrong order."""
    scene = Scene.drawn(draw)
    made = Record.sampled(scene, double_wells(draw, scene, copies), law=Law.of(scene))
    seen = []
    for one in made.seen:
        pieces = np.array_split(one, max(len(one) // round(400 - 350 * strength), 2))
        order = draw.permutation(len(pieces)) if strength else np.arange(len(pieces))
        seen.append(np.concatenate([pieces[place] for place in order]))
    return Record(scene, seen, made.times, made.states, made.law)


@kind("unchanged", "one_system", "record", "state_complete", "gaussian_increments")
def duplicated(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """A short recording that stands several times in the file, as if it were a long one."""
    scene = Scene.drawn(draw)
    times = 1 + round(7 * strength)
    short = Scene(**{**vars(scene), "samples": -(-scene.samples // times)})
    made = Record.sampled(short, double_wells(draw, short, copies), law=Law.of(scene))
    seen = [np.tile(one, times) for one in made.seen]
    return Record(scene, seen, [STEP * np.arange(len(one)) for one in seen], made.states, made.law)


@kind("gaussian_increments", "prediction", "state_complete")
def dropouts(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """Single samples that read zero."""

    def sensor(scene: Scene) -> Sensor:
        return lambda x: np.where(draw.random(len(x)) < 0.05 * strength, 0.0, x)

    return _seen(draw, copies, sensor)


@kind("connected", "gaussian_increments", "prediction", "record")
def middle_left_out(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """A file without the samples between the wells, which were thought to be faulty."""
    scene = Scene.drawn(draw)
    made = Record.sampled(scene, double_wells(draw, scene, copies), law=Law.of(scene))
    kept = [np.abs(one) > 0.7 * strength for one in made.seen]
    seen = [one[known] for one, known in zip(made.seen, kept, strict=True)]
    times = [one[known] for one, known in zip(made.times, kept, strict=True)]
    return Record(scene, seen, times, made.states, made.law)
