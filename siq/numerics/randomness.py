"""Seeds, and draws from normal distributions."""

from __future__ import annotations

import zlib
from enum import StrEnum

import numpy as np


class Purpose(StrEnum):
    """What random numbers are drawn for; each purpose has a stream of its own within each run."""

    SIMULATE = "simulate"
    RESAMPLE = "resample"
    STABILITY = "stability"
    HOLD_OUT = "hold out"
    DIVIDE = "divide"
    TRAINING = "training"
    REFINE = "refine"
    SHUFFLE = "shuffle"
    LANDSCAPE = "landscape"
    REFERENCE = "reference"
    UNSEEN = "unseen"
    ROUNDING = "rounding"
    ESCAPE = "escape"
    INVARIANT = "invariant"
    EQUATIONS = "equations"


def seed_sequence(seed: int, *keys: int | str) -> np.random.SeedSequence:
    """The seed of one purpose within one run, independent of all others.

    Parameters
    ----------
    seed
        The study's seed.
    keys
        The run's number and the purpose, such as ``(3, Purpose.TRAINING)``.

    Returns
    -------
    numpy.random.SeedSequence
        The same for the same arguments, whatever else a study draws and however many runs it has.
    """
    spawn_key = tuple(zlib.crc32(key.encode()) if isinstance(key, str) else key for key in keys)
    return np.random.SeedSequence(seed, spawn_key=spawn_key)


def generator(seed: int, *keys: int | str) -> np.random.Generator:
    """A random generator for one purpose within one run; see `seed_sequence`."""
    return np.random.default_rng(seed_sequence(seed, *keys))


def normal_draws(
    mean: np.ndarray, covariance: np.ndarray, count: int, *, generator: np.random.Generator
) -> np.ndarray:
    """Draws from a normal distribution, of coordinates whose sizes differ by any factor.

    Coefficients of x and of x³ may differ by 10¹⁴ in the unit of a recording. The covariance is therefore
    taken apart as standard deviations and correlations, of which eigenvalues can be told from rounding.

    Parameters
    ----------
    mean
        Shape ``(p,)``.
    covariance
        Shape ``(p, p)``; coordinates without variance stay at their mean.
    count
        So many draws.
    generator
        Where they come from.

    Returns
    -------
    numpy.ndarray
        Shape ``(count, p)``.
    """
    deviation = np.sqrt(np.diag(covariance))
    scale = np.where(deviation > 0, deviation, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    drawn = generator.standard_normal((count, len(mean)))
    return np.asarray(mean + (drawn @ root.T) * scale)
