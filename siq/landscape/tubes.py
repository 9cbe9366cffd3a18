"""Where paths of least action leave a cycle, or arrive at one: on a thin tube around it.

Along a stable cycle V is zero, and a path may wind on it at no cost for as long as it likes: it has no first
state. It is followed from a tube on, on which V is ``½ ρ·Hρ``, ρ being the offset from the next state of the
cycle and H the curvature of V there (`siq.dynamics.cycles.hessians_along`). A path to an unstable cycle
winds on it in the end; from a tube on what is left of its action is ``ρ·Hρ``, with the curvature of what it
costs to reach the cycle.

First guesses are trajectories of Hamilton's equations that start on all sides of a small tube, or of a small
ellipsoid, with the momentum ``p = Hρ``. One of them passes close to
the end.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

from siq.dynamics.cycles import Cycle
from siq.dynamics.dynamics import Dynamics
from siq.numerics.integration import dormand_prince_step, next_step

FINER = 8  # places between two points of a cycle, from which the closest one is sought
NEWTON_STEPS = 4  # from there: the error is squared in each
AWAY = 3e-4  # of the distance to be gone: how far from an attractor first guesses start
PHASES, SIDES = 48, 2  # of first guesses; sides for each state beyond the second
POINTS_OF_TWO = 96  # around a point
MOST_STEPS = 4000
ACCURACY = 1e-6  # numerical, of the distance: of one step of a first guess
LONGEST_STEP = 0.03  # of the distance, or of the size of the cycle
GONE = 6.0  # distances: what is so far away does not come back
CLOSE = 0.05  # of the distance: so close to the end a first guess counts as having arrived
PASSED = 0.3  # of the distance: and so close as one that has passed it by
CHOSEN = 2  # first guesses of either kind that are tried
UNLIKE = 0.02  # share of the action by which two of them differ


class Tube:
    """The quadratic cost about a cycle, in the units of a problem.

    Parameters
    ----------
    points
        Shape ``(n, d)``: of the cycle.
    hessians
        Shape ``(n, d, d)``: the cost is ``ρ·Hρ``.
    period
        Of the cycle.
    """

    def __init__(self, points: np.ndarray, hessians: np.ndarray, period: float) -> None:
        n, self.period = len(points), period
        places = np.arange(n + 1)
        self.curve = CubicSpline(places, np.vstack([points, points[:1]]), bc_type="periodic")
        self.costs = CubicSpline(places, np.concatenate([hessians, hessians[:1]]), bc_type="periodic")
        self.tree = cKDTree(self.curve(np.arange(FINER * n) / FINER))

    def place(self, y: np.ndarray) -> np.ndarray:
        """Where on the cycle the state next to each point lies: ``(n, d)`` to ``(n,)``."""
        place = self.tree.query(np.nan_to_num(y))[1] / FINER
        for _ in range(NEWTON_STEPS):
            along, bent = self.curve(place, 1), self.curve(place, 2)
            offset = y - self.curve(place)
            curved = np.sum(along**2, axis=1) - np.sum(offset * bent, axis=1)
            step = np.sum(offset * along, axis=1) / np.where(curved > 0, curved, np.inf)
            place = place + np.clip(np.nan_to_num(step), -0.5, 0.5)
        return np.asarray(place)

    def closest(self, y: np.ndarray) -> np.ndarray:
        """The next state of the cycle: ``(n, d)`` to ``(n, d)``."""
        return np.asarray(self.curve(self.place(y)))

    def level(self, y: np.ndarray) -> np.ndarray:
        """The cost: ``(n, d)`` to ``(n,)``."""
        place = self.place(y)
        offset = y - self.curve(place)
        return np.asarray(np.einsum("ni,nij,nj->n", offset, self.costs(place), offset))

    def onto(self, y: np.ndarray, level: float) -> np.ndarray:
        """A point moved along the slope to where the cost is as given: ``(d,)`` to ``(d,)``."""
        for _ in range(NEWTON_STEPS):
            slope = self.slope(y)
            steepness = float(slope @ slope)
            if not steepness > 0:
                break
            y = y - (float(self.level(y[None])[0]) - level) / steepness * slope
        return y

    def slope(self, y: np.ndarray) -> np.ndarray:
        """Of the cost at one point, shape ``(d,)``."""
        place = self.place(y[None])[0]
        along, offset = self.curve(place, 1), y - self.curve(place)
        moved = along / (along @ along - offset @ self.curve(place, 2))
        return np.asarray(2 * self.costs(place) @ offset + (offset @ self.costs(place, 1) @ offset) * moved)

    def curvature(self, y: np.ndarray) -> np.ndarray:
        """Second derivatives of the cost next to one point, to leading order: shape ``(d, d)``."""
        return np.asarray(2 * self.costs(self.place(y[None])[0]))


@dataclass(frozen=True)
class Bowl:
    """The quadratic cost about a point attractor at the origin, ``y·My``, with the methods of a tube."""

    hessian: np.ndarray

    def closest(self, y: np.ndarray) -> np.ndarray:
        """The attractor, for each of some points."""
        return np.zeros_like(y)

    def level(self, y: np.ndarray) -> np.ndarray:
        """The cost: ``(n, d)`` to ``(n,)``."""
        return np.einsum("ni,ij,nj->n", y, self.hessian, y)

    def slope(self, y: np.ndarray) -> np.ndarray:
        """Of the cost at one point, shape ``(d,)``."""
        return np.asarray(2 * self.hessian @ y)

    def curvature(self, y: np.ndarray) -> np.ndarray:
        """Second derivatives of the cost, shape ``(d, d)``."""
        return 2 * self.hessian


def first_guesses(
    dynamics: Dynamics,
    start: np.ndarray | Cycle,
    end: np.ndarray | Cycle,
    hessians: np.ndarray,
    unit: np.ndarray,
) -> list[np.ndarray]:
    """Curves from beside a start to an end, by rising action.

    Parameters
    ----------
    dynamics
        f and D.
    start, end
        Points ``(d,)`` or cycles.
    hessians
        The curvature of V: ``(d, d)`` at a point, ``(n, d, d)`` along a cycle.
    unit
        Shape ``(d, d)``: its columns are steps of one distance.
    """
    inverse = np.linalg.inv(unit)
    states, momenta = _beside(start, hessians, unit)
    ways, actions = _followed(dynamics, states, momenta, inverse)
    target = cKDTree((end.points if isinstance(end, Cycle) else end[None]) @ inverse.T)
    found = []
    for way, action in zip(ways, actions, strict=True):
        away = target.query(way @ inverse.T)[0]
        close = max(CLOSE, float(away.min()))
        arrived = int(np.argmax(away <= close))
        left = np.flatnonzero(away[arrived:] > 2 * close)
        nearest = int(arrived + np.argmin(away[arrived : arrived + (left[0] if len(left) else len(away))]))
        curve = way[: nearest + 1] if isinstance(end, Cycle) else np.vstack([way[: nearest + 1], end])
        if nearest > 0:
            found.append((float(away[nearest]), float(action[nearest]), curve))
    found.sort(key=lambda one: one[1])
    least = min((one[0] for one in found), default=np.inf)
    chosen: list[tuple[float, float, np.ndarray]] = []
    # A lower path may have passed the end by further than one that is not the lowest.
    for close in (max(CLOSE, least), max(PASSED, least)):
        new: list[tuple[float, float, np.ndarray]] = []
        for one in found:
            known = any(abs(one[1] - other[1]) <= UNLIKE * abs(other[1]) for other in (*chosen, *new))
            if one[0] <= close and not known and len(new) < CHOSEN:
                new.append(one)
        chosen += new
    return [curve for _, _, curve in chosen]


def _beside(
    start: np.ndarray | Cycle, hessians: np.ndarray, unit: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """States on all sides of a start, and the momenta there."""
    d = len(unit)
    draw = np.random.default_rng(0)
    if isinstance(start, Cycle):
        rows = np.linspace(0, len(start.points), PHASES, endpoint=False).astype(int)
        # The axes of the curvature, of which the first one is along the flow, and directions between them.
        across = np.linalg.eigh(unit.T @ hessians[rows] @ unit)[1].transpose(0, 2, 1)[:, 1:]
        between = draw.standard_normal((SIDES * (d - 2), d - 1))
        sides = np.concatenate([np.eye(d - 1), -np.eye(d - 1), between])
        sides /= np.linalg.norm(sides, axis=1, keepdims=True)
        offset = AWAY * np.einsum("sa,nai->nsi", sides, across) @ unit.T
        momenta = np.einsum("nij,nsj->nsi", hessians[rows], offset)
        states = start.points[rows][:, None] + offset
        return states.reshape(-1, d), momenta.reshape(-1, d)
    directions = draw.standard_normal((POINTS_OF_TWO * (d - 1), d))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    offset = AWAY * directions @ unit.T
    return start + offset, offset @ hessians


def _followed(
    dynamics: Dynamics, states: np.ndarray, momenta: np.ndarray, inverse: np.ndarray
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Trajectories of Hamilton's equations, and the action along each."""
    n, d = states.shape

    def rates(z: np.ndarray) -> np.ndarray:
        x, p = z[:, :d], z[:, d : 2 * d]
        push = dynamics.diffusion.push(x, p)
        falls = -np.einsum("nij,ni->nj", dynamics.jacobian(x), p) - dynamics.diffusion.pull(x, p)
        return np.column_stack([dynamics.drift(x) + 2 * push, falls, 2 * np.sum(p * push, axis=1)])

    z = np.column_stack([states, momenta, np.zeros(n)])
    first = states @ inverse.T
    kept: list[np.ndarray] = [z.copy()]
    alive = np.arange(n)
    rate = np.linalg.norm(rates(z)[:, :d] @ inverse.T, axis=1).max()
    longest = LONGEST_STEP * max(1.0, float(np.linalg.norm(np.ptp(first, axis=0))))
    steps = np.full(n, longest / rate)
    for _ in range(MOST_STEPS):
        with np.errstate(all="ignore"):
            speed = np.linalg.norm(rates(z[alive])[:, :d] @ inverse.T, axis=1)
            step = np.minimum(steps[alive], longest / np.maximum(speed, 1e-300))
            moved, error = dormand_prince_step(rates, z[alive], step)
            relative = np.abs(error[:, :d] @ inverse.T).max(axis=1) / ACCURACY
        steps[alive] = next_step(step, relative)
        taken = np.isfinite(moved).all(axis=1) & (relative <= 1)
        z[alive[taken]] = moved[taken]
        kept.append(z.copy())
        away = np.linalg.norm(z[alive][:, :d] @ inverse.T - first[alive], axis=1)
        alive = alive[away < GONE]
        if not len(alive):
            break
    ways = np.stack(kept, axis=1)
    return list(ways[:, :, :d]), list(ways[:, :, -1])
