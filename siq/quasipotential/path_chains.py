"""Minimum action paths as chains of points: their action, its descent, and the spacing of points.

Along a stable cycle V is zero, and a path may wind on it at no cost for as long as it likes: it has no first
state. It is followed from a tube on, on which V is ``½ ρ·Hρ``, ρ being the offset from the next state of the
cycle and H the curvature of V there (`siq.systems.cycles.hessians_along`). A path to an unstable cycle
winds on it in the end; from a tube on what is left of its action is ``ρ·Hρ``, with the curvature of what it
costs to reach the cycle.

First guesses are trajectories of Hamilton's equations that start on all sides of a small tube, or of a small
ellipsoid, with the momentum ``p = Hρ``. One of them passes close to
the end.

Everything is in units in which the distance of both ends, D and the derivatives of f are of size one. What
the chains are for is said in `siq.quasipotential.paths`.

About an attractor or a cycle a path may wind for long, and a chain is continued there as linear dynamics
goes, to where its level is as small as is asked for.

By Newton's method, with steps across the chain, damped by an upper bound of the action that touches it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg
from scipy.integrate import solve_ivp
from scipy.interpolate import Akima1DInterpolator, CubicSpline
from scipy.spatial import cKDTree

from siq.errors import NumericalFailure
from siq.numerics.integration import dormand_prince_step, next_step
from siq.systems.cycles import Cycle, hessians_along
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics
from siq.systems.equilibria import classify, hessian_at

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
        falls = -np.einsum("nij,ni->nj", dynamics.jacobian(x), p) - dynamics.diffusion.contract(x, p, 1)
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


AT_REST = 1e-5  # |f| at a state that counts as an equilibrium, in units of the Jacobian and the distance
FLAT = 1e-3  # of the upper bound of S: numerical, above the error of tubes, below what parts two minima
NO_ACTION = 1e-7  # of ∫|f||φ'|ds: less is a path without noise


@dataclass(frozen=True)
class DiscretisedPath:
    """Points ``(n, d)`` in the units of a problem, their action, and whether it is a minimum."""

    points: np.ndarray
    action: float
    minimum: bool


@dataclass(frozen=True)
class Segments:
    """f of the middles, the differences and the sizes of both: ``(n - 1, d)`` and ``(n - 1,)``.

    `whitening` is that of the middles, ``(n - 1, d, d)``, and `turn` is the difference of both directions.
    """

    middles: np.ndarray
    force: np.ndarray
    forward: np.ndarray
    whitening: np.ndarray
    speed: np.ndarray
    length: np.ndarray
    turn: np.ndarray

    @property
    def actions(self) -> np.ndarray:
        """``|f||Δ| - f·Δ``, written so that nothing cancels where f and Δ are parallel."""
        return 0.5 * self.speed * self.length * np.sum(self.turn**2, axis=1)

    @property
    def metric(self) -> np.ndarray:
        """D⁻¹ of the middles, ``(n - 1, d, d)``."""
        return self.whitening.transpose(0, 2, 1) @ self.whitening


class PathProblem:
    """Chains between two states, in units in which D at the start, their distance and ∂f/∂x are of size one.

    ``x = start + units y``. M is the Hessian of V at the start, None where that is no attractor; then the
    first point of a chain is as fixed as the last. Where D has no inverse a `measure` stands in for it, and
    there is no action of chains.

    The start may be a stable cycle, and the end an unstable one: a chain begins and ends on thin tubes then.
    """

    def __init__(
        self,
        dynamics: Dynamics,
        start: np.ndarray | Cycle,
        end: np.ndarray | Cycle,
        *,
        measure: Diffusion | None = None,
    ) -> None:
        around, onto = (one if isinstance(one, Cycle) else None for one in (start, end))
        start, end = _closest_states(start, end)
        noise = dynamics.diffusion.frozen(start) if measure is None else measure
        distance = float(np.linalg.norm(noise.whitening @ (end - start)))
        if not distance > 0:
            raise ValueError(f"the path is to end where it starts, at {start.tolist()}")
        self.dynamics, self.start, self.units = dynamics, start, distance * noise.root
        self.inverse = noise.whitening / distance
        self.constant = dynamics.diffusion.constant
        self.noise = dynamics.diffusion.in_units(start, self.units, distance**2)
        jacobians = self.inverse @ dynamics.jacobian(np.stack([start, end])) @ self.units
        self.rate = float(np.linalg.norm(jacobians, axis=(1, 2)).max())
        self.unit = distance**2 * self.rate  # of the action
        self.end = self.inverse @ (end - start)
        self.hessian: np.ndarray | None = None
        self.begin: Bowl | Tube | None = None
        self.finish: Tube | None = None
        if onto is not None:
            self.finish = self._tube(onto, hessians_along(dynamics, onto, reaching=True))
        if around is not None:
            self.begin = self._tube(around, hessians_along(dynamics, around))
            return
        resting = np.linalg.norm(self.force(np.zeros((1, len(start))))) < AT_REST
        if resting and classify(dynamics, start).kind == "attractor":
            hessian = hessian_at(dynamics, start)
            self.hessian = self.units.T @ hessian @ self.units / self.unit
            self.begin = Bowl(self.hessian)

    def _tube(self, cycle: Cycle, hessians: np.ndarray) -> Tube:
        points = (cycle.points - self.start) @ self.inverse.T
        return Tube(points, self.units.T @ hessians @ self.units / self.unit, cycle.period * self.rate)

    @property
    def flat(self) -> float:
        """By how much of the upper bound S may fail to curve upwards at a minimum.

        About cycles any phase may be as good as any other.
        """
        return FLAT if isinstance(self.begin, Tube) or self.finish is not None else 0.0

    def scaled(self, x: np.ndarray) -> np.ndarray:
        """Points in the units of the problem, from its start to its end."""
        y = (x - self.start) @ self.inverse.T
        if not isinstance(self.begin, Tube):
            y[0] = 0.0
        if self.finish is None:
            y[-1] = self.end
        return np.asarray(y)

    def unscaled(self, y: np.ndarray) -> np.ndarray:
        """Points in the states' units."""
        return self.start + y @ self.units.T

    def force(self, y: np.ndarray) -> np.ndarray:
        """F, ``(n, d)``."""
        return self.dynamics.drift(self.unscaled(y)) @ self.inverse.T / self.rate

    def jacobian(self, y: np.ndarray) -> np.ndarray:
        """∂f/∂y, ``(n, d, d)``."""
        return self.inverse @ self.dynamics.jacobian(self.unscaled(y)) @ self.units / self.rate

    def bend(self, y: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """``Σ_k weights_k ∂²f_k``, ``(n, d, d)``."""
        second = self.dynamics.bend(self.unscaled(y), weights @ self.inverse / self.rate)
        return np.asarray(self.units.T @ second @ self.units)

    def segments(self, y: np.ndarray) -> Segments:
        """What the action of a chain is made of."""
        middles, forward = (y[1:] + y[:-1]) / 2, np.diff(y, axis=0)
        force = self.force(middles)
        own_force, own_forward = force, forward
        if self.constant:
            whitening = np.broadcast_to(np.eye(y.shape[1]), (len(middles), y.shape[1], y.shape[1]))
        else:
            whitening = self.noise.whitening_at(middles)
            own_force, own_forward = products(whitening, force), products(whitening, forward)
        speed, length = (
            np.linalg.norm(part, axis=1) + np.finfo(float).tiny for part in (own_force, own_forward)
        )
        turn = own_forward / length[:, None] - own_force / speed[:, None]
        return Segments(middles, force, forward, whitening, speed, length, turn)

    def level(self, y: np.ndarray) -> np.ndarray:
        """The action from the start to points close to it, ``y·My``; zero without M."""
        return np.zeros(len(y)) if self.begin is None else self.begin.level(y)

    def remaining(self, y: np.ndarray) -> float:
        """The action from a point close to the end to that."""
        return 0.0 if self.finish is None else float(self.finish.level(y[None])[0])

    def action(self, y: np.ndarray) -> float:
        """S of a chain; infinite where it leads through states at which D is not positive."""
        with np.errstate(all="ignore"):  # a trial may run away
            try:
                inner = float(self.segments(y).actions.sum())
                return float(self.level(y[:1])[0]) + inner + self.remaining(y[-1])
            except NumericalFailure:
                return np.inf

    def effort(self, y: np.ndarray) -> float:
        """The integral ``∫ |f| |φ'| ds``, with which an action is compared that may be zero."""
        parts = self.segments(y)
        return float(np.sum(parts.speed * parts.length))


def _closest_states(start: np.ndarray | Cycle, end: np.ndarray | Cycle) -> tuple[np.ndarray, np.ndarray]:
    """Of two states or cycles, the two states that are closest to each other."""
    one, two = (each.points if isinstance(each, Cycle) else each[None] for each in (start, end))
    away = np.linalg.norm(one[:, None] - two, axis=2)
    row, column = np.unravel_index(int(np.argmin(away)), away.shape)
    return one[row], two[column]


def products(matrices: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Of each matrix with its vector: ``(n, d, d)`` and ``(n, d)`` to ``(n, d)``."""
    return np.asarray((matrices @ vectors[:, :, None])[:, :, 0])


START_SHARE = 1e-6  # of the action: U on the ellipsoid where a chain begins
CENTRAL = 0.005  # of the distance to the end: nearer to the attractor points lie no closer together
COINCIDING = 1e-14  # numerical, of the length: neighbours so close are one point
MOST_NODES = 60_000  # numerical, a guard on memory: 60 000 blocks of d × d
MOST_TURNS, STEPS_OF_A_TURN = 300, 64  # of a path from or to a cycle, within linear dynamics
SPIRAL_STEP = 0.15  # of the shortest time of the linear dynamics


def spaced(problem: PathProblem, y: np.ndarray, count: int, level: float) -> np.ndarray:
    """A chain along another one, which begins where the level is as given and is spaced for accuracy.

    Near an attractor the segments are in proportion to the distance from it, in the metric of M, since the
    path may wind.
    """
    if problem.hessian is not None and problem.level(y[:1])[0] > level > 0:
        y = np.vstack([spiral(problem, y[0], level / problem.level(y[:1])[0]), y])
    if level > 0 and isinstance(problem.begin, Tube):
        y = np.vstack([_winding(problem, problem.begin, y[0], level, -1.0)[::-1], y])
    if level > 0 and problem.finish is not None:
        y = np.vstack([y, _winding(problem, problem.finish, y[-1], level, 1.0)])
    length = np.r_[0, np.cumsum(np.linalg.norm(np.diff(y, axis=0), axis=1))]
    apart = np.append(np.diff(length) > COINCIDING * length[-1], True)
    length, y = length[apart], y[apart]
    curve = Akima1DInterpolator(length, y)
    dense = np.interp(np.arange(0, len(y) - 0.95, 0.1), np.arange(len(y)), length)
    y = curve(dense)
    if problem.begin is not None:
        first = max(int(np.flatnonzero(problem.level(y) <= level).max(initial=0)), 0)
        dense, y = dense[first:], y[first:]
    if problem.finish is not None:
        beyond = np.flatnonzero(problem.finish.level(y) > level).max(initial=len(y) - 3) + 2
        dense, y = dense[:beyond], y[:beyond]
    measure = np.r_[0, np.cumsum(relative_lengths(problem, y))]
    return curve(np.interp(np.linspace(0, measure[-1], count), measure, dense))


def relative_lengths(problem: PathProblem, y: np.ndarray) -> np.ndarray:
    """Lengths of the segments, relative to what they should be."""
    forward, middles = np.diff(y, axis=0), (y[1:] + y[:-1]) / 2
    if problem.hessian is None:
        return np.linalg.norm(forward, axis=1)
    near = np.sqrt(problem.level(middles)) + CENTRAL * np.sqrt(problem.level(problem.end[None]))
    return np.sqrt(problem.level(forward)) / near


def spiral(problem: PathProblem, last: np.ndarray, share: float) -> np.ndarray:
    """The way that linear dynamics takes to a point from where its level is a share of the one there."""
    assert problem.hessian is not None
    flow = problem.jacobian(np.zeros((1, len(last))))[0] + 2 * problem.hessian
    back = scipy.linalg.expm(-SPIRAL_STEP * flow / np.abs(np.linalg.eigvals(flow)).max())
    lowest = share * problem.level(last[None])[0]
    y = [back @ last]
    while y[-1] @ problem.hessian @ y[-1] > lowest and len(y) < MOST_NODES:
        y.append(back @ y[-1])
    return np.array(y[::-1])


def _winding(problem: PathProblem, tube: Tube, last: np.ndarray, level: float, sense: float) -> np.ndarray:
    """The way by linear dynamics from a point onwards to a tube, or back to where it left one.

    ``ẏ = F + 2Dp`` with ``p`` as the quadratic cost has it, with or against time.
    """

    def rates(_: float, y: np.ndarray) -> np.ndarray:
        slope, force = tube.slope(y), problem.force(y[None])[0]
        push = slope if problem.constant else problem.noise.at(y[None])[0] @ slope
        return np.asarray(sense * force - push)

    def arrives(_: float, y: np.ndarray) -> float:
        return float(tube.level(y[None])[0] - level)

    arrives.terminal = True  # type: ignore[attr-defined]
    if not arrives(0.0, last) > 0:
        return np.zeros((0, len(last)))
    way = solve_ivp(
        rates, (0.0, MOST_TURNS * tube.period), last, rtol=1e-4, atol=1e-6,
        max_step=tube.period / STEPS_OF_A_TURN, events=arrives,
    )  # fmt: skip
    return np.asarray(way.y[:, 1:].T)


def evenly(points: np.ndarray, count: int) -> np.ndarray:
    """Evenly spaced points on a polygon."""
    along = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))]
    places = np.linspace(0, along[-1], count)
    return np.stack([np.interp(places, along, column) for column in points.T], axis=1)


KICKS = (0.3, 0.1, 0.03, 0.01)  # of the distance: tried from a chain that is at rest and no minimum
SMALLEST_SHIFT, LARGEST_SHIFT = 1e-3, 1e12  # of Newton's matrix
LEAST_GAIN, GOOD_GAIN = 0.05, 0.7  # of what a step promised: it is taken; the next one is bolder
STEPS, RESPACINGS, MOST_KICKS = 150, 40, 3
UNEVEN = 1.6  # longest to shortest segment at which a chain is spaced anew
COARSE, FINE = 1e-7, 1e-12  # share of S that a step must still gain, for first guesses and for the answer


def descended(
    problem: PathProblem, y: np.ndarray, count: int, action: float, *, first: bool = False
) -> DiscretisedPath:
    """Move a chain of `count` points down to a minimum of S, by steps across the chain.

    A `first` chain is spaced anew where it has become uneven, and pushed off where it rests at a saddle
    of S.

    Parameters
    ----------
    problem
        The action.
    y
        Points along which the chain is laid, in any number.
    count
        Number of points of the chain.
    action
        About that of the path; it decides where the chain begins.
    first
        Whether it starts far from a minimum.
    """
    level = START_SHARE * action
    y = spaced(problem, y, count, level)
    if y.shape[1] == 1:
        return DiscretisedPath(y, problem.action(y), True)
    action, shift, spacings, kicks = problem.action(y), 1.0, 0, 0
    for _ in range(STEPS):
        across = Across(problem, y)
        resting = (COARSE if first else _fine(problem)) * action + np.finfo(float).eps * across.effort
        gained, expected = 0.0, np.inf
        while shift < LARGEST_SHIFT:
            step = across.step(shift)
            if step is not None:
                new = across.moved(step)
                expected = -0.5 * float(across.slope @ step)
                gained = action - problem.action(new)
                if gained > LEAST_GAIN * expected or expected < resting:
                    break
            shift = max(4 * shift, SMALLEST_SHIFT)
        else:
            break
        if gained > 0:
            y, action = new, action - gained
        if expected > resting:
            shift *= 0.2 if gained > GOOD_GAIN * expected else 1.0
            shift = max(shift if shift > 1e-8 else 0.0, problem.flat)
            measure = relative_lengths(problem, y)
            if first and spacings < RESPACINGS and measure.max() > UNEVEN * measure.min():
                y = spaced(problem, y, count, level)
                action, spacings = problem.action(y), spacings + 1
        elif across.step(problem.flat) is None:
            if not first or kicks == MOST_KICKS:
                break
            kicks += 1
            lower = min((across.moved(push) for push in across.kicks()), key=problem.action)
            if problem.action(lower) >= action:
                break
            y, action, shift = lower, problem.action(lower), 1.0
        elif shift <= SMALLEST_SHIFT:
            return DiscretisedPath(y, action, True)
        else:
            shift = problem.flat
    return DiscretisedPath(y, action, False)


def _fine(problem: PathProblem) -> float:
    """Share of S that a step must still gain: of tubes, the third order that their cost leaves out."""
    return START_SHARE**1.5 if problem.flat > 0 else FINE


class Across:
    """Moves of a chain across itself: slope and second derivatives of S, in banded form.

    A chain may slide along itself without any change of S but that of its error, which must not matter. The
    matrix for frozen times is that of ``Σ |Δ - τf|²/2τ``, ``τ = |Δ|/|f|`` being held fast, without the second
    derivatives of f and D: of an upper bound of S that touches it. With ``q = D⁻¹(Δ/τ - f)``, twice the
    momentum, and ``G_ik = ∂_k f_i + ((∂_k D)q)_i``, its blocks are ``τ GᵀD⁻¹G``, ``-D⁻¹G`` and ``D⁻¹/τ``.
    """

    def __init__(self, problem: PathProblem, y: np.ndarray) -> None:
        parts, dimension = problem.segments(y), y.shape[1]
        self.y, self.effort = y, float(np.sum(parts.speed * parts.length))
        self.range = slice(1 if problem.begin is None else 0, -1 if problem.finish is None else None)
        times = (parts.length / parts.speed)[:, None, None]
        metric, middles, jacobian = parts.metric, parts.middles, problem.jacobian(parts.middles)
        force, forward = (products(metric, part) for part in (parts.force, parts.forward))
        twice = forward / times[:, 0] - force
        turned, by_middle = jacobian, np.einsum("nij,ni->nj", jacobian, twice)
        bent = problem.bend(middles, -times[:, 0] * twice)
        # The times change, too: by so much, up to a factor, with the middles and the differences.
        slower = 2 * times[:, 0] * np.einsum("nij,ni->nj", jacobian, force)
        if not problem.constant:
            noise = problem.noise
            turned = jacobian + noise.turn(middles, twice)
            by_middle = by_middle + noise.contract(middles, twice, 1) / 2
            bent = bent - times / 2 * noise.contract(middles, twice, 2)
            slower -= (
                times[:, 0] * noise.contract(middles, force, 1)
                - noise.contract(middles, forward, 1) / times[:, 0]
            )
        by_middle *= -times[:, 0]
        slope = np.zeros_like(y)
        slope[1:] += by_middle / 2 + twice
        slope[:-1] += by_middle / 2 - twice
        longer, share = -2 * forward / times[:, 0], (0.25 / (parts.speed * parts.length))[:, None, None]
        pushed = metric @ turned
        frozen = _Blocks(times * turned.transpose(0, 2, 1) @ pushed, -pushed, metric / times)
        exact = _Blocks(
            frozen.middle + bent - share * _outer(slower, slower),
            frozen.mixed - share * _outer(longer, slower),
            frozen.forward - share * _outer(longer, longer),
        )
        first, last = np.zeros((2, dimension, dimension))
        if problem.begin is not None:
            slope[0] += problem.begin.slope(y[0])
            first = problem.begin.curvature(y[0])
        if problem.finish is not None:
            slope[-1] += problem.finish.slope(y[-1])
            last = problem.finish.curvature(y[-1])
        self.problem = problem
        normal = _normals(y)
        if isinstance(problem.begin, Tube):  # along the tube, on which the chain begins, and ends
            normal[0] = np.linalg.svd(problem.begin.slope(y[0])[None])[2][1:].T
        if problem.finish is not None:
            normal[-1] = np.linalg.svd(problem.finish.slope(y[-1])[None])[2][1:].T
        self.normal = normal[self.range]
        self.slope = np.einsum("nij,ni->nj", self.normal, slope[self.range]).ravel()
        self.exact = exact.banded(self.normal, self.range.start, (first, last))
        self.frozen = frozen.banded(self.normal, self.range.start, (first, last))

    def step(self, shift: float) -> np.ndarray | None:
        """Newton's step with a shift; None where the matrix is not positive definite."""
        try:
            with np.errstate(all="ignore"):
                matrix = self.exact + shift * self.frozen
            factor = scipy.linalg.cholesky_banded(matrix, lower=True)
        except (np.linalg.LinAlgError, ValueError):  # ValueError: not finite
            return None
        return -scipy.linalg.cho_solve_banded((factor, True), self.slope)

    def moved(self, step: np.ndarray) -> np.ndarray:
        """The chain after a step."""
        y = self.y.copy()
        y[self.range] += np.einsum("nij,nj->ni", self.normal, step.reshape(len(self.normal), -1))
        if isinstance(begin := self.problem.begin, Tube):
            y[0] = begin.onto(y[0], float(begin.level(self.y[:1])[0]))
        if (finish := self.problem.finish) is not None:
            y[-1] = finish.onto(y[-1], float(finish.level(self.y[-1:])[0]))
        return y

    def kicks(self) -> list[np.ndarray]:
        """Steps to both sides along the direction in which S curves downwards most."""
        _, vectors = scipy.linalg.eig_banded(self.exact, lower=True, select="i", select_range=(0, 0))
        way = vectors[:, 0] / np.abs(vectors).max()
        return [side * size * way for size in KICKS for side in (1, -1)]


@dataclass(frozen=True)
class _Blocks:
    """Second derivatives of the segments by middles and differences, ``(n - 1, d, d)`` each."""

    middle: np.ndarray
    mixed: np.ndarray  # difference before middle
    forward: np.ndarray

    def banded(self, normal: np.ndarray, start: int, ends: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        """The matrix of the moves ``normal`` from point `start` on, in the lower form of scipy's solvers.

        `ends` are added to the blocks of the first point and of the last.
        """
        count, _, m = normal.shape
        transposed = self.mixed.transpose(0, 2, 1)
        both = (self.mixed + transposed) / 2
        diagonal = np.zeros((len(self.middle) + 1, *ends[0].shape))
        diagonal[1:] += self.middle / 4 + self.forward + both
        diagonal[:-1] += self.middle / 4 + self.forward - both
        diagonal[0] += ends[0]
        diagonal[-1] += ends[1]
        # Row of the next point, column of this one.
        below = self.middle / 4 - self.forward + (self.mixed - transposed) / 2
        turned = normal.transpose(0, 2, 1)
        diagonal = turned @ diagonal[start : start + count] @ normal
        below = turned[1:] @ below[start : start + count - 1] @ normal[:-1]
        matrix = np.zeros((2 * m, count * m))
        for column in range(m):
            for row in range(column, m):
                matrix[row - column, column::m] = diagonal[:, row, column]
            for row in range(m):
                matrix[m + row - column, column::m][: count - 1] = below[:, row, column]
        return matrix


def _outer(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    return left[:, :, None] * right[:, None, :]


def _normals(y: np.ndarray) -> np.ndarray:
    """Orthonormal directions across a chain at its points, shape ``(n, d, d - 1)``."""
    along = np.gradient(y, axis=0)
    return np.linalg.svd(along[:, None, :])[2][:, 1:].transpose(0, 2, 1)


def path_nodes(problem: PathProblem, chain: DiscretisedPath) -> np.ndarray:
    """Points, momenta, and actions up to there, shape ``(n, 2d + 1)``."""
    y, parts = chain.points, problem.segments(chain.points)
    # Momenta of the middles, carried over half a segment with ṗ = -Jᵀp - p·(∂D)p; both sides agree at a
    # minimum.
    times = (parts.length / parts.speed)[:, None]
    middle = products(parts.metric, (parts.forward / times - parts.force) / 2)
    change = np.einsum("nij,ni->nj", problem.jacobian(parts.middles), middle)
    if not problem.constant:
        change += problem.noise.contract(parts.middles, middle, 1)
    turn = times / 2 * change
    p = np.empty_like(y)
    p[1:-1] = (middle[1:] + turn[1:] + middle[:-1] - turn[:-1]) / 2
    p[0] = middle[0] + turn[0] if problem.begin is None else problem.begin.slope(y[0]) / 2
    p[-1] = middle[-1] - turn[-1] if problem.finish is None else -problem.finish.slope(y[-1]) / 2
    values = problem.level(y[:1]) + np.r_[0.0, np.cumsum(parts.actions)]
    return np.column_stack([y, p, values])


def hamiltonian_residual(problem: PathProblem, nodes: np.ndarray) -> float:
    """The largest Hamiltonian, in proportion to its parts."""
    y, p = np.split(nodes[:, :-1], 2, axis=1)
    force = problem.force(y)
    drift = np.sum(p * force, axis=1)
    push = np.sum((p if problem.constant else products(problem.noise.at(y), p)) * p, axis=1)
    scale = max((np.abs(drift) + push).max(), NO_ACTION * np.sum(force**2, axis=1).max())
    return float(np.abs(drift + push).max() / scale)


def extrapolated(problem: PathProblem, coarse: DiscretisedPath, fine: DiscretisedPath) -> np.ndarray:
    """Nodes without the error of second order, from a chain and one with half its spacing.

    Where the two differ by more than their errors, by a turn about the attractor say, they do not match, and
    the finer one stands for itself.
    """
    action = max((4 * fine.action - coarse.action) / 3, 0.0)
    second = path_nodes(problem, fine)
    nodes = (4 * second[::2] - path_nodes(problem, coarse)) / 3
    if not hamiltonian_residual(problem, nodes) < hamiltonian_residual(problem, second):
        nodes = second
        nodes[:, -1] *= action / max(fine.action, np.finfo(float).tiny)
    d, ends = problem.end.size, np.zeros((2, nodes.shape[1]))
    if problem.finish is not None:
        ends[1, :d] = problem.finish.closest(nodes[-1:, :d])[0]
        nodes[-1, -1] = action - problem.remaining(nodes[-1, :d])
        nodes = np.vstack([nodes, ends[1:]])
    nodes[-1, -1] = action
    if problem.begin is None:
        return nodes
    ends[0, :d] = problem.begin.closest(nodes[:1, :d])[0]
    return np.vstack([ends[:1], nodes])


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
