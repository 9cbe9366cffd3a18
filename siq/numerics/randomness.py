"""Randomness: seeds by purpose, draws from normal distributions, representative subsets of points.

Trajectories crowd near attractors. Algorithm 1 of Lin, Li & Ren (2022) keeps a subset that covers the
same region evenly: points are visited in random order, and a visited point removes its neighbours.
"""

from __future__ import annotations

import zlib
from enum import StrEnum

import numpy as np
from scipy.spatial import cKDTree


class Purpose(StrEnum):
    """What random numbers are drawn for; each purpose has a stream of its own within each run."""

    SIMULATE = "simulate"
    RESAMPLE = "resample"
    STABILITY = "stability"
    HOLD_OUT = "hold out"
    DIVIDE = "divide"
    TRAINING = "training"
    UNITS = "units"
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
    """The seed of one purpose within one run, of a study's seed and keys such as ``(3, Purpose.TRAINING)``.

    It is the same for the same arguments, whatever else a study draws and however many runs it has.
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
    taken apart as standard deviations and correlations, of which eigenvalues can be told from rounding. Of
    a mean ``(p,)`` the draws have the shape ``(count, p)``; coordinates without variance stay there.
    """
    scale = positive(np.sqrt(np.diag(covariance)))
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    return np.asarray(mean + (generator.standard_normal((count, len(mean))) @ root.T) * scale)


def positive(sizes: np.ndarray) -> np.ndarray:
    """Sizes to divide by: one where they vanish."""
    return np.where(sizes > 0, sizes, 1.0)


def representative_subset(
    points: np.ndarray, *, distance: float, generator: np.random.Generator
) -> np.ndarray:
    """Sorted indices of a random subset of points ``(n, d)`` that are pairwise at least `distance` apart.

    The distance is Euclidean, r of the paper. Every point left out lies closer to a kept one; the generator
    decides the order in which points are visited. Visiting all of them one by one is slow where they crowd.
    They are therefore first offered in batches, of which only those that are the earliest in the random order
    among their neighbours are kept; the result is exactly that of the sequential visit.
    """
    if not distance > 0:
        raise ValueError(f"the thinning distance is {distance}; give a positive number")
    remaining = generator.permutation(len(points))
    kept: list[np.ndarray] = []
    batch = 256  # at first, when points still crowd
    while len(remaining):
        # The first batch in the random order decides alone about itself: all kept points have already
        # removed their neighbours from it.
        head = remaining[:batch]
        chosen = head[_sequential_visit(points[head], distance)]
        kept.append(chosen)
        rest = remaining[batch:]
        if len(rest):
            nearest, _ = cKDTree(points[chosen]).query(points[rest], distance_upper_bound=distance)
            rest = rest[~(nearest < distance)]
        remaining, batch = rest, 2 * batch
    return np.sort(np.concatenate(kept))


def _sequential_visit(points: np.ndarray, distance: float) -> np.ndarray:
    pairs = cKDTree(points).query_pairs(distance, output_type="ndarray")
    pairs = pairs[np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1) < distance]
    pairs = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
    alive = np.ones(len(points), dtype=bool)
    firsts, starts = np.unique(pairs[:, 0], return_index=True)
    bounds, others = [*starts.tolist(), len(pairs)], np.ascontiguousarray(pairs[:, 1])
    for place, index in enumerate(firsts.tolist()):
        if alive[index]:
            alive[others[bounds[place] : bounds[place + 1]]] = False
    return np.flatnonzero(alive)
