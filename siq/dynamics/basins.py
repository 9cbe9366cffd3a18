"""The basin of an attractor: recorded points that lead there, and what follows each on its way."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from siq.dynamics.descents import Descents, follow
from siq.dynamics.dynamics import Dynamics
from siq.dynamics.equilibria import Equilibrium, hessian_at
from siq.numerics.thinning import representative_subset

NEAREST = 600  # descents that start close to the attractor, where recordings leave directions out
POINTS = 6000  # chosen in a basin, about: as many as a fit of V takes


@dataclass(frozen=True)
class Focus:
    """Further starts about an attractor: how many, and up to which level of ``½ (x - A)·M (x - A)``."""

    count: int
    level: float


@dataclass(frozen=True)
class Basin:
    """Points along descents to one attractor; what follows each point on its way is known.

    Attributes
    ----------
    states
        Shape ``(n, k, d)``: descents that end at the attractor.
    chosen
        Shape ``(s, 2)``: descent and place of evenly spread points among them.
    spread
        How many of the descents, the first ones, start evenly over the region; None for all. The others
        start close to the attractor.
    """

    states: np.ndarray
    chosen: np.ndarray
    spread: int | None = None

    def starts(self, values: np.ndarray) -> np.ndarray:
        """Of values along descents, ``(n, k)``, those at the starts that are evenly spread."""
        return np.asarray(values[: self.spread, 0])

    def below(self, values: np.ndarray, level: float) -> np.ndarray:
        """Rows of `chosen` from which the way down stays below a level.

        Parameters
        ----------
        values
            V along the descents, shape ``(n, k)``.
        level
            The level.
        """
        return np.flatnonzero(self.highest(values)[self.chosen[:, 0], self.chosen[:, 1]] < level)

    @staticmethod
    def highest(values: np.ndarray) -> np.ndarray:
        """The highest of the values from each place of a descent on, ``(n, k)`` to ``(n, k)``."""
        return np.maximum.accumulate(values[:, ::-1], axis=1)[:, ::-1]

    def points(self, rows: np.ndarray) -> np.ndarray:
        """The states of some rows of `chosen`."""
        return self.states[self.chosen[rows, 0], self.chosen[rows, 1]]


def basin_of(
    dynamics: Dynamics,
    descents: Descents,
    index: int,
    attractors: Sequence[Equilibrium],
    *,
    box: np.ndarray,
    generator: np.random.Generator,
    focus: Focus | None = None,
) -> Basin:
    """The points from which f leads to an attractor.

    Parameters
    ----------
    dynamics
        f and D.
    descents
        From recorded points.
    index, attractors
        Which of the attractors.
    box
        Shape ``(d, 2)``: the recorded region.
    generator
        Draws further starts close to the attractor.
    focus
        How many of these, and how far; by default as recordings need it.
    """
    center, d = attractors[index].position, len(box)
    width = box[:, 1] - box[:, 0]
    recorded = descents.paths[descents.ends == index]
    # Recordings approach an attractor along its slow directions; V needs all of them. Of one state there is
    # but one, and more starts close by would only make light of those far out.
    hessian = hessian_at(dynamics, center)
    offsets = recorded[:, 0] - center
    if focus is None:
        reach = np.quantile(np.einsum("ni,ij,nj->n", offsets, hessian, offsets), 0.3)
        count = NEAREST if d > 1 else 0
    else:
        reach, count = 2 * focus.level, focus.count
        # A well may be small in its domain.
        width = np.minimum(width, 2 * np.sqrt(reach * np.diag(np.linalg.inv(hessian))))
    directions = generator.standard_normal((count, d))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    radii = np.sqrt(reach) * generator.uniform(0.02, 1.0, (count, 1))
    starts = center + (radii * directions) @ np.linalg.inv(np.linalg.cholesky(hessian))
    starts = starts[((starts > box[:, 0]) & (starts < box[:, 1])).all(axis=1)]
    near = follow(dynamics, starts, attractors, box=box)
    states = np.concatenate([recorded, near.paths[near.ends == index]])
    spread = None if focus is None else len(recorded)
    return Basin(states, _chosen(states, center, width, generator), spread)


def enlarged(
    dynamics: Dynamics,
    basin: Basin,
    index: int,
    attractors: Sequence[Equilibrium],
    starts: np.ndarray,
    *,
    box: np.ndarray,
    generator: np.random.Generator,
) -> Basin:
    """A basin with further descents, which begin where evenly spread ones are too few.

    Parameters
    ----------
    dynamics, index, attractors, box, generator
        As of `basin_of`.
    basin
        Of the attractor.
    starts
        Shape ``(n, d)``; those that lead elsewhere are left out.
    """
    further = follow(dynamics, starts, attractors, box=box)
    mine = further.paths[further.ends == index]
    spread = len(basin.states) if basin.spread is None else basin.spread
    if not len(mine):
        return basin
    states = np.concatenate([basin.states, mine])
    # Points lie about as dense as before, also where the new ones are.
    center, width = attractors[index].position, np.ptp(mine.reshape(-1, len(box)), axis=0)
    added = _chosen(mine, center, width, generator) + np.array([len(basin.states), 0])
    return Basin(states, np.concatenate([basin.chosen, added]), spread)


def _chosen(
    states: np.ndarray, center: np.ndarray, width: np.ndarray, generator: np.random.Generator
) -> np.ndarray:
    """Descent and place of points of descents, evenly spread, and denser towards the attractor."""
    d = states.shape[2]
    flat = (states.reshape(-1, d) - center) / width
    warped = flat / np.sqrt(np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-6))
    rows = representative_subset(warped, distance=0.6 * POINTS ** (-1 / d), generator=generator)
    return np.stack(np.divmod(rows, states.shape[1]), axis=1)
