"""Seeds: where the random numbers of a study come from."""

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
