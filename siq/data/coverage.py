"""Which part of the space of states did recordings visit, and how often?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from siq.data.recordings import Recordings

BINS = 20  # along each state, between the quantiles: about what a formula of degree five can tell apart
OUTER = 0.001  # of the samples on either side: a few outliers would make the rest one bin
VISITED = 10  # samples in a cell, from which something is known of it: a mean to a third of its spread


@dataclass(frozen=True)
class Coverage:
    """The visited part of the range of the states.

    Attributes
    ----------
    share
        Of the cells of a grid over the range of the first two states (of one, where there is one), those that
        were visited.
    cells
        Number of cells.
    starts
        Number of different recordings: of relaxations each begins somewhere else.
    """

    share: float
    cells: int
    starts: int


def coverage_of(recordings: Recordings) -> Coverage:
    """How much of the range of the first states was visited."""
    values = recordings.values[:, :2]
    low, high = np.quantile(values, [OUTER, 1 - OUTER], axis=0)
    width = np.where(high > low, high - low, 1.0)
    place = np.floor((values - low) / width * BINS).astype(int)
    inside = ((place >= 0) & (place < BINS)).all(axis=1)
    d = values.shape[1]
    flat = np.ravel_multi_index(tuple(place[inside].T), (BINS,) * d)
    counts = np.bincount(flat, minlength=BINS**d)
    return Coverage(float((counts >= VISITED).mean()), BINS**d, len(recordings.labels))
