"""From which first chains is a path sought, and which of the minima that they lead to are rivals?"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from siq.landscape.chain_spacing import START_SHARE, evenly, spiral
from siq.landscape.discretised_paths import DiscretisedPath, PathProblem

MOST_BENDS = 6  # directions of bent first guesses: each costs as much as the path itself
BEND = 0.4  # of the distance: how far bent first guesses leave the straight line
APART = 0.03  # of the distance: minima further apart are two


def first_chains(problem: PathProblem) -> tuple[list[np.ndarray], float]:
    """First chains, and by how many radian the first of them turns, in the metric of M.

    That would be the right one were f linear: ``ẋ = (J + 2DM) x``, backwards from the end.
    """
    share = np.linspace(0, 1, 201)[:, None]
    line = share * problem.end
    chains = [line]
    # The columns of the right factor span what is across the line.
    across = np.linalg.svd(problem.end[None])[2][1 : MOST_BENDS + 1]
    chains += [line + BEND * side * np.sin(np.pi * share) * way for way in across for side in (1, -1)]
    if problem.hessian is None:
        return chains, 0.0
    linear = np.vstack([spiral(problem, problem.end, START_SHARE), problem.end])
    forward = np.diff(linear @ np.linalg.cholesky(problem.hessian), axis=0)
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    turns = np.arccos(np.clip(np.sum(forward[1:] * forward[:-1], axis=1), -1, 1))
    return [linear, *chains], float(turns.sum())


def rivals_of(chains: Sequence[DiscretisedPath], best: DiscretisedPath) -> list[DiscretisedPath]:
    """The minima that lie apart from the first chain, from what has become of it, and from each other."""

    def tree(chain: DiscretisedPath) -> cKDTree:
        length = np.linalg.norm(np.diff(chain.points, axis=0), axis=1).sum()
        return cKDTree(evenly(chain.points, int(5 * length / APART) + 2))

    rivals: list[DiscretisedPath] = []
    trees = [tree(chains[0]), tree(best)]
    for chain in chains[1:]:
        if chain.minimum and all(other.query(chain.points)[0].max() > APART for other in trees):
            rivals.append(chain)
            trees.append(tree(chain))
    return rivals
