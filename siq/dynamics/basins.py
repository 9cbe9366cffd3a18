"""The basin of an attractor: recorded points that lead there, and what follows each on its way."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from siq.dynamics.dynamics import Dynamics
from siq.dynamics.equilibria import Descents, Equilibrium, follow, hessian_at
from siq.numerics.thinning import representative_subset

NEAREST = 600  # descents that start close to the attractor, where recordings leave directions out
POINTS = 6000  # chosen in a basin, about: as many as a fit of V takes


@dataclass(frozen=True)
class Basin:
    """Points along descents to one attractor; what follows each point on its way is known.

    Attributes
    ----------
    states
        Shape ``(n, k, d)``: descents that end at the attractor.
    chosen
        Shape ``(s, 2)``: descent and place of evenly spread points among them.
    """

    states: np.ndarray
    chosen: np.ndarray

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
    """
    center, d = attractors[index].position, len(box)
    width = box[:, 1] - box[:, 0]
    recorded = descents.paths[descents.ends == index]
    # Recordings approach an attractor along its slow directions; V needs all of them. Of one state there is
    # but one, and more starts close by would only make light of those far out.
    hessian = hessian_at(dynamics, center)
    count = NEAREST if d > 1 else 0
    offsets = recorded[:, 0] - center
    reach = np.quantile(np.einsum("ni,ij,nj->n", offsets, hessian, offsets), 0.3)
    directions = generator.standard_normal((count, d))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    radii = np.sqrt(reach) * generator.uniform(0.02, 1.0, (count, 1))
    starts = center + (radii * directions) @ np.linalg.inv(np.linalg.cholesky(hessian))
    starts = starts[((starts > box[:, 0]) & (starts < box[:, 1])).all(axis=1)]
    near = follow(dynamics, starts, attractors, box=box)
    states = np.concatenate([recorded, near.paths[near.ends == index]])
    # Evenly spread, and denser towards the attractor, from where the fit grows.
    flat = (states.reshape(-1, d) - center) / width
    warped = flat / np.sqrt(np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-6))
    rows = representative_subset(warped, distance=0.6 * POINTS ** (-1 / d), generator=generator)
    return Basin(states, np.stack(np.divmod(rows, states.shape[1]), axis=1))
