"""Which terms does a least-squares problem ask for? The subset with the best sum of squares and size.

Dropping the weakest of all terms, again and again, leads to terms that are significant each. It fails where
terms look alike on the data: of ``x**3`` and ``x**5`` the wrong one may go first. So every addition, omission
and exchange of a term is tried from there, until none is an improvement. The search does not begin with no
terms at all: two that are strong together and weak alone, as ``x`` and ``x**3`` within two wells, would never
be found.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.linalg

ALIKE = 1e-10  # numerical: of a column's square, what has to be left of it beside the others
MOST_MOVES = 500  # numerical: each lowers the criterion, so that the search ends by itself


def strong_terms(columns: np.ndarray, goal: np.ndarray, *, penalty: float) -> np.ndarray:
    """Columns that are left when the weakest leaves again and again, until each explains the penalty.

    The arguments are those of `best_subset`.
    """
    active = np.flatnonzero(np.linalg.norm(columns, axis=0) > 0)
    while len(active):
        size = np.linalg.norm(columns[:, active], axis=0)
        orthogonal, upper = np.linalg.qr(columns[:, active] / size)
        coefficients = scipy.linalg.solve_triangular(upper, orthogonal.T @ goal)
        errors = np.linalg.norm(scipy.linalg.solve_triangular(upper, np.eye(len(active))), axis=1)
        strength = (coefficients / errors) ** 2
        weakest = int(np.argmin(strength))
        if strength[weakest] >= penalty:
            break
        active = np.delete(active, weakest)
    return active


def best_subset(
    columns: np.ndarray, goal: np.ndarray, *, penalty: float, starts: Sequence[np.ndarray]
) -> np.ndarray:
    """Columns that minimise ``‖goal - columns_S c‖² + penalty |S|``, by local search from several starts.

    Parameters
    ----------
    columns
        Shape ``(n, p)``, in units in which the errors of the goal have variance one. The triangle of a QR
        decomposition does as well.
    goal
        Shape ``(n,)``.
    penalty
        What a term has to explain: the square of the standard errors that its coefficient has to exceed.
    starts
        Subsets to begin with, such as that of `strong_terms`.

    Returns
    -------
    numpy.ndarray
        Their indices, in order.
    """
    size = np.linalg.norm(columns, axis=0)
    scaled = columns / np.where(size > 0, size, 1.0)
    usable = size > 0
    found = [
        _descend(scaled, goal, penalty, [int(k) for k in start if usable[k]], usable) for start in starts
    ]
    return np.array(sorted(min(found, key=lambda one: one[0])[1]), dtype=int)


def _descend(
    columns: np.ndarray, goal: np.ndarray, penalty: float, begin: list[int], usable: np.ndarray
) -> tuple[float, list[int]]:
    """The criterion, less the square of the goal, and the subset where no move improves it."""
    chosen = list(begin)
    value = penalty * len(chosen) - _explained(columns, goal, chosen)
    for _ in range(MOST_MOVES):
        moves = [(value, chosen)]
        for without in (chosen, *([k for k in chosen if k != gone] for gone in chosen)):
            base = penalty * len(without) - _explained(columns, goal, without)
            moves.append((base, without))
            gains = np.where(usable, _gains(columns, goal, without), 0.0)
            gains[without] = 0.0
            best = int(np.argmax(gains))
            moves.append((base + penalty - float(gains[best]), [*without, best]))
        lowest, subset = min(moves, key=lambda move: move[0])
        if not lowest < value - 1e-9 * max(abs(value), 1.0):
            break
        value, chosen = lowest, subset
    return value, chosen


def _explained(columns: np.ndarray, goal: np.ndarray, chosen: list[int]) -> float:
    if not chosen:
        return 0.0
    basis = np.linalg.qr(columns[:, chosen])[0]
    return float(((basis.T @ goal) ** 2).sum())


def _gains(columns: np.ndarray, goal: np.ndarray, chosen: list[int]) -> np.ndarray:
    """What each further column would explain besides those that are chosen, shape ``(p,)``."""
    rest, left = columns, goal
    if chosen:
        basis = np.linalg.qr(columns[:, chosen])[0]
        rest = columns - basis @ (basis.T @ columns)
        left = goal - basis @ (basis.T @ goal)
    own = (rest**2).sum(axis=0)
    return np.where(own > ALIKE, (rest.T @ left) ** 2 / np.maximum(own, ALIKE), 0.0)
