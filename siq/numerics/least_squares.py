"""Least squares over many rows, and representative subsets of points.

Trajectories crowd near attractors. Algorithm 1 of Lin, Li & Ren (2022) keeps a subset that covers the
same region evenly: points are visited in random order, and a visited point removes its neighbours.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

ROWS = 1 << 14  # numerical: worked on together, so that no second copy of all rows is in memory


def positive(sizes: np.ndarray) -> np.ndarray:
    """Sizes to divide by: one where they vanish."""
    return np.where(sizes > 0, sizes, 1.0)


def triangle_of(columns: np.ndarray, goals: np.ndarray) -> np.ndarray:
    """R of the QR decomposition of columns with their goals behind them.

    Parameters
    ----------
    columns
        Shape ``(n, c)``.
    goals
        Shape ``(n,)`` or ``(n, g)``.

    Returns
    -------
    numpy.ndarray
        Shape ``(c + g, c + g)``, or ``(n, c + g)`` of fewer rows.
    """
    goals = goals.reshape(len(goals), -1)
    count = columns.shape[1]
    width = count + goals.shape[1]
    found = np.zeros((0, width))
    rows = max(ROWS, 8 * width)
    for begin in range(0, len(goals), rows):
        part = slice(begin, begin + rows)
        together = np.empty((len(found) + len(goals[part]), width))
        together[: len(found)] = found
        together[len(found) :, :count] = columns[part]
        together[len(found) :, count:] = goals[part]
        found = np.asarray(np.linalg.qr(together, mode="r"))
    return found


def representative_subset(
    points: np.ndarray, *, distance: float, generator: np.random.Generator
) -> np.ndarray:
    """Indices of a random subset whose points are pairwise at least `distance` apart.

    Parameters
    ----------
    points
        Shape ``(n, d)``, any dimension.
    distance
        r of the paper, Euclidean, in the units of the points.
    generator
        Decides the order in which points are visited.

    Returns
    -------
    numpy.ndarray
        Sorted indices of the points kept. Every point left out lies closer than `distance` to a kept one.

    Notes
    -----
    Visiting all points one by one is slow where they crowd. Points are therefore first offered in
    batches, of which only those that are the earliest in the random order among their neighbours are
    kept; the result is exactly that of the sequential visit.
    """
    if not distance > 0:
        raise ValueError(f"the thinning distance is {distance}; give a positive number")
    remaining = generator.permutation(len(points))
    kept: list[np.ndarray] = []
    batch = 2048
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
        remaining = rest
    return np.sort(np.concatenate(kept))


def _sequential_visit(points: np.ndarray, distance: float) -> np.ndarray:
    pairs = cKDTree(points).query_pairs(distance, output_type="ndarray")
    pairs = pairs[np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1) < distance]
    pairs = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
    alive = np.ones(len(points), dtype=bool)
    starts = np.searchsorted(pairs[:, 0], np.arange(len(points) + 1))
    for index in range(len(points)):
        if alive[index] and starts[index] < starts[index + 1]:
            alive[pairs[starts[index] : starts[index + 1], 1]] = False
    return np.flatnonzero(alive)
