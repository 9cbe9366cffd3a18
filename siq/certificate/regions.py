"""Which points lie among the recorded states that lead to an attractor?

Nothing is asked here of any V: descents along f from recorded states tell.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from siq.dynamics.phase_portrait import PhasePortrait

NEAR = 2.5  # of the spacing of the states, as for the points of a well: further away nothing was recorded


@dataclass(frozen=True, eq=False)
class BasinRegion:
    """The states that lead to one attractor, and those that lead elsewhere, for comparisons of distance.

    Attributes
    ----------
    width
        Of the recorded box, shape ``(d,)``: distances are shares of it.
    own
        States on descents to the attractor.
    spacing
        Of each from its neighbours, on other descents too.
    elsewhere
        Starts of descents that end elsewhere or nowhere, and states on those to other attractors; None
        where there are none.
    """

    width: np.ndarray
    own: cKDTree
    spacing: np.ndarray
    elsewhere: cKDTree | None

    def across(self, x: np.ndarray) -> np.ndarray:
        """Mask of points ``(n, d)`` that lie closer to states which lead elsewhere."""
        if self.elsewhere is None:
            return np.zeros(len(x), dtype=bool)
        others = self.elsewhere.query(x / self.width)[0]
        return np.asarray(others < self.own.query(x / self.width)[0])

    def recorded(self, x: np.ndarray) -> np.ndarray:
        """Mask of points ``(n, d)`` among the states that lead to the attractor."""
        distance, nearest = self.own.query(x / self.width)
        return np.asarray((distance <= NEAR * self.spacing[nearest]) & ~self.across(x))


def basin_region(portrait: PhasePortrait, index: int) -> BasinRegion:
    """The region of one attractor, ``portrait.attractors[index]``."""
    width = portrait.box[:, 1] - portrait.box[:, 0]
    width = np.where(width > 0, width, 1.0)
    states = [basin.points(np.arange(len(basin.chosen))) / width for basin in portrait.basins]
    descents = portrait.descents
    away = [descents.paths[descents.ends != index][:, 0] / width]
    away += [points for number, points in enumerate(states) if number != index]
    elsewhere = np.concatenate(away)
    own = cKDTree(states[index])
    # Of the 2d-th neighbour: states on one descent lie closer to each other than descents do.
    neighbours = min(2 * len(width) + 1, len(states[index]))
    spacing = np.atleast_2d(own.query(states[index], k=neighbours)[0])[:, -1]
    return BasinRegion(width, own, spacing, cKDTree(elsewhere) if len(elsewhere) else None)
