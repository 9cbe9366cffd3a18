"""The triangle R of many rows, on which every least-squares fit to them depends, some rows at a time."""

from __future__ import annotations

import numpy as np

ROWS = 1 << 14  # numerical: worked on together, so that no second copy of all rows is in memory


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
