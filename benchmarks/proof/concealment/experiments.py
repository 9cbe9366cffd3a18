"""Experiments: how often, from which states and with which inputs a system is observed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Experiment:
    """What is done to a system in one case; all recordings have the same times of observation.

    Attributes
    ----------
    interval
        Time between two samples.
    samples
        N, the number of samples of every recording, the first at t = 0.
    starts
        Initial states, shape ``(states, recordings)``.
    inputs
        The inputs at the samples, shape ``(inputs, recordings, N)``.
    """

    interval: float
    samples: int
    starts: np.ndarray
    inputs: np.ndarray

    def times(self) -> np.ndarray:
        """Times of the samples, shape ``(N,)``."""
        return self.interval * np.arange(self.samples)


def counts(rng: np.random.Generator) -> tuple[int, int]:
    """Numbers of recordings and of samples: 8 to 12, 100 to 250, and between 1000 and 2000 in all."""
    recordings = int(rng.integers(8, 13))
    samples = int(rng.integers(max(100, -(-1000 // recordings)), min(250, 2000 // recordings) + 1))
    return recordings, samples


def amplitudes_within(largest: float, recordings: int, rng: np.random.Generator) -> np.ndarray:
    """Amplitudes from a quarter of the largest on: nonlinear terms differ in how they grow with amplitude."""
    return largest * rng.permutation(4.0 ** -np.linspace(0, 1, recordings))


def multisine(
    amplitudes: np.ndarray,
    times: np.ndarray,
    response: Callable[[np.ndarray], np.ndarray],
    rng: np.random.Generator,
) -> np.ndarray:
    """Random multisines that move a linear oscillator by given amplitudes.

    Parameters
    ----------
    amplitudes
        Amplitudes that the motion is to have, one a recording; zero is no input at all.
    times
        Times of the samples.
    response
        Amplitude of the motion per unit of input at angular frequencies ``1/s``.
    rng
        Draws frequencies and phases.

    Returns
    -------
    numpy.ndarray
        Shape ``(1, recordings, samples)``. The first sample is zero and the input grows within one period:
        so it does not matter what an input that arrives late was before the recording.
    """
    nyquist = np.pi / (times[1] - times[0])
    frequencies = rng.uniform(0.02, 0.22, size=(len(amplitudes), 10)) * nyquist
    phases = rng.uniform(0, 2 * np.pi, size=frequencies.shape)
    tones = np.cos(frequencies[..., None] * times + phases[..., None]).sum(axis=1)
    motion = np.sqrt((response(frequencies) ** 2).sum(axis=1) / 2)
    switched_on = np.sin(np.pi / 2 * np.minimum(times / (20 * times[1]), 1)) ** 2
    return ((amplitudes / np.sqrt(2) / motion)[:, None] * tones * switched_on)[None]


def driven_or_free(
    rng: np.random.Generator, largest: float, interval: float, response: Callable[[np.ndarray], np.ndarray]
) -> tuple[int, np.ndarray, np.ndarray]:
    """Samples, amplitudes of the initial states and inputs, every third recording being a free decay."""
    recordings, samples = counts(rng)
    amplitudes = amplitudes_within(largest, recordings, rng)
    driven = np.arange(recordings) % 3 != 0
    inputs = multisine(amplitudes * driven, interval * np.arange(samples), response, rng)
    return samples, amplitudes * np.where(driven, 0.5, 1.0), inputs


def on_orbits(amplitudes: np.ndarray, rate: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Position and velocity at random phases of harmonic motions."""
    phase = rng.uniform(0, 2 * np.pi, len(amplitudes))
    return amplitudes * np.cos(phase), -amplitudes * rate * np.sin(phase)


def linear_response(stiffness: float, damping: float) -> Callable[[np.ndarray], np.ndarray]:
    """Amplitude of the motion of a unit mass per unit of force, as a function of angular frequency."""
    return lambda rate: 1 / np.hypot(stiffness - rate**2, damping * rate)
