"""What does a laboratory record?"""

from __future__ import annotations

import zlib

import numba
import numpy as np
import pandas as pd

from benchmarks.laboratories.models import Laboratory
from benchmarks.laboratories.polynomials import Polynomials, drift, intensity, polynomials

FORGOTTEN = 2_000  # samples before the record begins, in which a well is filled


@numba.njit(cache=True)
def _run(
    system: Polynomials,
    x: np.ndarray,
    step: float,
    within: int,
    samples: int,
    averaged: bool,
    draw: np.random.Generator,
) -> np.ndarray:
    d = len(x)
    short = step / within
    seen = np.empty((samples, d))
    for sample in range(samples):
        mean = np.zeros(d)
        for _ in range(within):
            force, strength = drift(system, x), np.sqrt(intensity(system, x) * short)
            for place in range(d):
                move = short * force[place] + strength * draw.standard_normal()
                if (
                    averaged
                ):  # the mean of a path between two ends: their middle, and the variance of a bridge
                    mean[place] += x[place] + move / 2 + strength * draw.standard_normal() / np.sqrt(12)
                x[place] += move
        seen[sample] = mean / within if averaged else x
    return seen


def generator(laboratory: Laboratory, seed: int) -> np.random.Generator:
    """The random numbers of one seed: each laboratory has its own."""
    return np.random.default_rng([zlib.crc32(laboratory.name.encode()), seed])


def recorded(laboratory: Laboratory, draw: np.random.Generator) -> np.ndarray:
    """What the instrument says, shape ``(records, samples, d)``; every record begins in one of the wells."""
    system = polynomials(laboratory)
    parts = []
    for _ in range(laboratory.records):
        x = np.array(laboratory.attractors[draw.integers(len(laboratory.attractors))], dtype=float)
        options = (laboratory.step, laboratory.within)
        _run(system, x, *options, min(FORGOTTEN, laboratory.samples), False, draw)
        parts.append(_run(system, x, *options, laboratory.samples, laboratory.averaged, draw))
    seen = np.stack(parts)
    return seen + laboratory.sensor * draw.standard_normal(seen.shape)


def table(laboratory: Laboratory, seen: np.ndarray) -> pd.DataFrame:
    """The same as a table of recordings."""
    times = np.arange(seen.shape[1]) * laboratory.step
    return pd.concat(
        [
            pd.DataFrame(
                {"recording": f"r{place}", "t": times} | dict(zip(laboratory.states, one.T, strict=True))
            )
            for place, one in enumerate(seen)
        ],
        ignore_index=True,
    )


def crossings(laboratory: Laboratory, seen: np.ndarray) -> int:
    """How often the records go from one well to another: from near one attractor to near another.

    Near is the nearest, and less than half of the way to the nearest saddle off.
    """
    places, saddles = np.array(laboratory.attractors), np.array(laboratory.saddles)
    reach = np.linalg.norm(places[:, None] - saddles, axis=2).min(axis=1) / 2
    count = 0
    for one in seen:
        away = np.linalg.norm(one[:, None] - places, axis=2)
        nearest = away.argmin(axis=1)
        inside = nearest[away[np.arange(len(one)), nearest] < reach[nearest]]
        count += int((np.diff(inside) != 0).sum())
    return count
