"""Kinds that are no diffusion at all, or one whose noise is not Gaussian."""

from __future__ import annotations

from collections.abc import Callable

import numba
import numpy as np
import scipy.stats

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

NO_DIFFUSION = ("state_complete", "prediction", "gaussian_increments", "unchanged", "connected", "record")


def _series(
    draw: np.random.Generator,
    copies: int,
    made: Callable[[np.ndarray, np.random.Generator], np.ndarray],
    *,
    noise: float = 0.0,
) -> Record:
    """Recordings of a function of the fine times, with noise of this size from sample to sample."""
    scene = Scene.drawn(draw)
    paths = [made(scene.fine_times, draw) for _ in range(copies * scene.recordings)]
    return Record.sampled(scene, paths, sensor=lambda x: x + noise * draw.standard_normal(len(x)))


@kind(*NO_DIFFUSION, twin=plain)
def white_noise(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """White noise about one level, of the strength's share, beside a relaxation."""

    def made(t: np.ndarray, draw: np.random.Generator) -> np.ndarray:
        slow = np.sqrt(1 - strength) * relaxation(draw, len(t), 1.0)
        return slow + np.sqrt(strength) * draw.standard_normal(len(t))

    return _series(draw, copies, made)


@kind(*NO_DIFFUSION, twin=plain)
def bimodal_white_noise(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """Independent values about two levels."""

    def made(t: np.ndarray, draw: np.random.Generator) -> np.ndarray:
        return draw.choice([-1.0, 1.0], len(t)) + (0.8 - 0.6 * strength) * draw.standard_normal(len(t))

    return _series(draw, copies, made)


@kind(*NO_DIFFUSION, "one_system", twin=plain)
def brownian_motion(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """A walk that nothing holds, or hardly anything."""

    def made(t: np.ndarray, draw: np.random.Generator) -> np.ndarray:
        free = np.cumsum(draw.standard_normal(len(t))) * np.sqrt(FINE)
        held = np.sqrt(5.0) * relaxation(draw, len(t), 10.0)
        return strength * free + (1 - strength) * held

    return _series(draw, copies, made)


@kind(*NO_DIFFUSION, "one_system", twin=plain)
def pink_noise(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """Noise with the spectrum 1/f."""

    def made(t: np.ndarray, draw: np.random.Generator) -> np.ndarray:
        frequencies = np.fft.rfftfreq(len(t), FINE)
        spectrum = draw.standard_normal((2, len(frequencies))) / np.maximum(frequencies, frequencies[1]) ** (
            1 - strength / 2
        )
        series = np.fft.irfft(spectrum[0] + 1j * spectrum[1], n=len(t))
        return np.asarray(series / series.std())

    return _series(draw, copies, made)


@kind(*NO_DIFFUSION, twin=plain)
def noisy_telegraph(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """A telegraph signal with white noise upon it."""

    def made(t: np.ndarray, draw: np.random.Generator) -> np.ndarray:
        return telegraph(draw, t, 20.0)

    return _series(draw, copies, made, noise=0.6 - 0.5 * strength)


@kind(*NO_DIFFUSION, twin=plain)
def levy_flight(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """Lévy's flight in a parabola."""
    alpha = 2 - 0.8 * strength

    def made(t: np.ndarray, draw: np.random.Generator) -> np.ndarray:
        steps = scipy.stats.levy_stable.rvs(alpha, 0.0, size=len(t), random_state=draw)
        return _driven(0.05 * FINE ** (1 / alpha) / FINE**0.5 * steps, 0.5)

    return _series(draw, copies, made)


@numba.njit(cache=True)
def _driven(kicks: np.ndarray, stiffness: float) -> np.ndarray:
    path, x = np.empty(len(kicks)), 0.0
    for place in range(len(kicks)):
        path[place] = x
        x += -FINE * stiffness * x + kicks[place]
    return path


@numba.njit(cache=True)
def _kicked(kicks: np.ndarray, tilt: float) -> np.ndarray:
    path, x = np.empty(len(kicks)), 1.0
    for place in range(len(kicks)):
        path[place] = x
        x += FINE * (x - x**3 + tilt)
        x = min(max(x + kicks[place], -6.0), 6.0)  # where explicit steps are stable
    return path


@kind("gaussian_increments", "prediction", "state_complete", "record")
def levy_noise_in_wells(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """A double well under Lévy's noise."""
    scene = Scene.drawn(draw)
    alpha, paths = 2 - 0.7 * strength, []
    for _ in range(copies * scene.recordings):
        steps = scipy.stats.levy_stable.rvs(alpha, 0.0, size=len(scene.fine_times), random_state=draw)
        paths.append(_kicked(np.sqrt(scene.intensity / 2) * FINE ** (1 / alpha) * steps, scene.tilt))
    return Record.sampled(scene, paths, law=Law.of(scene) if strength == 0 else None)


@kind("gaussian_increments", "prediction", "state_complete", "record")
def jumps(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """A double well with jumps beside its diffusion."""
    scene = Scene.drawn(draw)
    rate, paths = 0.05 * strength, []
    for _ in range(copies * scene.recordings):
        count = len(scene.fine_times)
        jump = (draw.random(count) < rate * FINE) * draw.normal(0, 1.5, count)
        noise = np.sqrt(scene.intensity * FINE) * draw.standard_normal(count)
        paths.append(_kicked(noise + jump, scene.tilt))
    return Record.sampled(scene, paths, law=Law.of(scene) if strength == 0 else None)


@kind(*NO_DIFFUSION, twin=plain)
def resets(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """One well whose state is thrown to the other side now and then, and creeps back."""
    scene = Scene.drawn(draw)
    spread, paths = np.sqrt(scene.intensity / 4), []
    for _ in range(copies * scene.recordings):
        count = len(scene.fine_times)
        kicks = (draw.random(count) < 0.05 * FINE) * 2.5 * strength
        slow = _driven(kicks, 0.3)
        paths.append(slow + spread * relaxation(draw, count, 0.5))
    return Record.sampled(scene, paths)


@kind(*NO_DIFFUSION, twin=plain)
def sine(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """A sine with noise about it."""
    period = draw.uniform(5, 60)

    def made(t: np.ndarray, draw: np.random.Generator) -> np.ndarray:
        phase = draw.uniform(0, 2 * np.pi)
        return np.sin(2 * np.pi * t / period + phase) + (0.7 - 0.6 * strength) * relaxation(draw, len(t), 0.5)

    return _series(draw, copies, made)


@kind(*NO_DIFFUSION, twin=plain)
def square_wave(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """A square wave with noise about it."""
    period = draw.uniform(20, 80)

    def made(t: np.ndarray, draw: np.random.Generator) -> np.ndarray:
        wave = np.sign(np.sin(2 * np.pi * t / period + draw.uniform(0, 2 * np.pi)))
        return wave + (0.7 - 0.5 * strength) * relaxation(draw, len(t), 0.5)

    return _series(draw, copies, made)


@kind(*NO_DIFFUSION, twin=plain)
def noisy_rotation(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """One coordinate of a noisy limit cycle."""
    rate = draw.uniform(0.1, 1.0)

    def made(t: np.ndarray, draw: np.random.Generator) -> np.ndarray:
        wandering = np.cumsum(draw.standard_normal(len(t))) * np.sqrt(FINE) * (1.1 - strength) * 0.5
        radius = 1 + 0.1 * relaxation(draw, len(t), 1.0)
        return radius * np.cos(rate * t + wandering + draw.uniform(0, 2 * np.pi))

    return _series(draw, copies, made, noise=0.02)


@numba.njit(cache=True)
def _van_der_pol(
    count: int, nonlinearity: float, power: float, step: float, before: int, draw: np.random.Generator
) -> np.ndarray:
    path, x, y = np.empty(count), 1.0, 0.0
    for place in range(-before, count):
        if place >= 0:
            path[place] = x / 2
        push = step * (nonlinearity * (1 - x**2) * y - x) + np.sqrt(power * step) * draw.standard_normal()
        x += step * y
        y += push
    return path


@kind(*NO_DIFFUSION, twin=plain)
def van_der_pol(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """One coordinate of van der Pol's oscillator."""
    nonlinearity = 0.3 + 4 * strength

    def made(t: np.ndarray, draw: np.random.Generator) -> np.ndarray:
        return _van_der_pol(len(t), nonlinearity, 0.1, FINE, FORGOTTEN, draw)

    return _series(draw, copies, made)


@numba.njit(cache=True)
def _lorenz(
    count: int, power: float, pace: float, step: float, before: int, draw: np.random.Generator
) -> np.ndarray:
    path = np.empty(count)
    x, y, z, h = draw.normal(), draw.normal(), 25.0, step * pace
    for place in range(-before, count):
        if place >= 0:
            path[place] = x / 8.5
        for _ in range(4):
            dx, dy, dz = 10 * (y - x), x * (28 - z) - y, x * y - 8 / 3 * z
            x += h / 4 * dx + np.sqrt(power * h / 4) * draw.standard_normal()
            y += h / 4 * dy
            z += h / 4 * dz
    return path


@kind(*NO_DIFFUSION, twin=plain)
def lorenz(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """One coordinate of Lorenz's system, which hops by itself."""
    power, pace = 20 * (1 - strength), draw.uniform(0.1, 0.8)

    def made(t: np.ndarray, draw: np.random.Generator) -> np.ndarray:
        return _lorenz(len(t), power, pace, FINE, FORGOTTEN, draw)

    return _series(draw, copies, made)


@kind(*NO_DIFFUSION, twin=plain)
def chaotic_duffing(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """A position in a double well that a sine drives from one side to the other."""

    def made(t: np.ndarray, draw: np.random.Generator) -> np.ndarray:
        phase = draw.uniform(0, 2 * np.pi)
        return _duffing(len(t), 0.25 + 0.15 * strength, phase, 0.02, FINE, FORGOTTEN, draw)

    return _series(draw, copies, made)


@numba.njit(cache=True)
def _duffing(
    count: int, amplitude: float, phase: float, power: float, step: float, before: int,
    draw: np.random.Generator,
) -> np.ndarray:  # fmt: skip
    path, x, y = np.empty(count), 1.0, 0.0
    for place in range(-before, count):
        if place >= 0:
            path[place] = x
        force = x - x**3 - 0.25 * y + amplitude * np.cos(step * place + phase)
        push = step * force + np.sqrt(power * step) * draw.standard_normal()
        x += step * y
        y += push
    return path


@numba.njit(cache=True)
def _on_circle(noise: np.ndarray, first: float, second: float) -> np.ndarray:
    path, x = np.empty(len(noise)), 1.5
    for place in range(len(noise)):
        path[place] = x
        x += FINE * (second * np.sin(2 * x) - first * np.sin(x)) + noise[place]
    return path


@kind("gaussian_increments", "prediction", "state_complete", "record", "connected", twin=plain)
def wrapped_angle(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """An angle with two wells on the circle, wrapped, so that it jumps by a whole turn."""
    scene = Scene.drawn(draw)
    paths = []
    for _ in range(copies * scene.recordings):
        noise = np.sqrt(2 * scene.intensity * FINE) * draw.standard_normal(len(scene.fine_times))
        angle = _on_circle(noise, 0.3 * (1 - strength), 0.5)
        paths.append((angle + np.pi) % (2 * np.pi) - np.pi)
    return Record.sampled(scene, paths)


@kind(*NO_DIFFUSION, "one_system", twin=plain)
def growing_oscillation(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """A wave that swells from nothing and fades, once in a recording."""
    period = draw.uniform(10, 40)

    def made(t: np.ndarray, draw: np.random.Generator) -> np.ndarray:
        wave = np.sin(np.pi * t / t[-1]) * np.sin(2 * np.pi * t / period)
        return wave + (0.7 - 0.5 * strength) * relaxation(draw, len(t), 0.5)

    return _series(draw, copies, made)


@kind(*NO_DIFFUSION, twin=plain)
def undersampled(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """A double well whose samples are so far apart that each has forgotten the last one."""
    scene = Scene.drawn(draw)
    every = 1 + round(400 * strength**2)
    long = Scene(**{**vars(scene), "samples": scene.samples * every // 20})
    made = Record.sampled(long, double_wells(draw, long, copies), law=Law.of(scene))
    seen = [one[::every] for one in made.seen]
    return Record(scene, seen, [one[::every] for one in made.times], made.states, made.law)
