"""Minimum action paths as chains of points: action, descent, and the spacing of points.

The action of a curve φ from A to B, whatever the time it takes, is

    S = ∫ (|f| |φ'| - f·φ') ds,    a·b = aᵀD⁻¹b,

and each segment of a chain has the action of a straight line with f of its middle. Everything is in units in
which the distance of both ends, D and the derivatives of f are of size one.

Points are moved across the chain by Newton's method. It is damped by the action of a chain whose times are
frozen at ``|Δφ|/|f|``, an upper bound of S that touches it: a large step for paths that wind about an
attractor, where a gradient would be useless.

About an attractor a chain begins on a small ellipsoid, on which U is ``y·My``. About a stable cycle, on which
a path may wind at no cost, it begins on a thin tube: there U is ``ρ·Hρ``, ρ being the offset from the next
state of the cycle and H the curvature of V (`siq.systems.cycles.hessians_along`). A path to an unstable cycle
ends on a tube, with the curvature of what is left of its action. Beyond both a chain is continued as linear
dynamics goes.

References
----------
M. Heymann and E. Vanden-Eijnden, Comm. Pure Appl. Math. 61 (2008) 1052: the geometric action.
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
from siq.quasipotential.characteristics import ScaledSystem
from siq.systems.cycles import Cycle, hessians_along
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics
from siq.systems.equilibria import classify, hessian_at

REST = 1e-5  # |f| at an equilibrium, in units of the Jacobian and the distance
CYCLE_GRID = 8  # places between two points of a cycle, from which the closest one is sought
NEWTON_STEPS_TO_CYCLE = 4  # from there: the error is squared in each
CYCLE_SHIFT = 1e-3  # of the upper bound of S: above the error of tubes, below what parts two minima

START_LEVEL = 1e-6  # of the action: U on the ellipsoid where a chain begins
CENTRAL_SPACING = 0.005  # of the distance to the end: nearer to the attractor points lie no closer together
COINCIDENCE = 1e-14  # numerical, of the length: neighbours so close are one point
MOST_NODES = 60_000  # numerical, a guard on memory: 60 000 blocks of d × d
MOST_TURNS, STEPS_PER_TURN = 300, 64  # of a path from or to a cycle, within linear dynamics
SPIRAL_STEP = 0.15  # of the shortest time of the linear dynamics

KICKS = (0.3, 0.1, 0.03, 0.01)  # of the distance: tried from a chain that is at rest and no minimum
SMALLEST_SHIFT, LARGEST_SHIFT = 1e-3, 1e12  # of Newton's matrix
LEAST_GAIN, GOOD_GAIN = 0.05, 0.7  # of what a step promised: it is taken; the next one is bolder
MOST_STEPS, MOST_RESPACINGS, MOST_KICKS = 150, 40, 3
UNEVEN = 1.6  # longest to shortest segment at which a chain is spaced anew
COARSE, FINE = 1e-7, 1e-12  # share of S that a step must still gain, for first guesses and for the answer

MOST_BENDS = 6  # directions of bent first guesses: each costs as much as the path itself
BEND = 0.4  # of the distance: how far bent first guesses leave the straight line


LimitSet = np.ndarray | Cycle
"""A state, shape ``(d,)``, or a cycle."""


@dataclass(frozen=True)
class MinimumActionPath:
    """The path of least action between two states: a chain, or a solution of Hamilton's equations."""

    #: Shape ``(n, d)``, in the states' units, from the start to the end, both included; and p there, which is
    #: ∇V where V is smooth. The path follows ``ẋ = f + 2Dp``.
    points: np.ndarray
    momenta: np.ndarray
    #: Shape ``(n,)``: the action up to each point, that is U, not V, if the start is an attractor; and that
    #: of the whole path: the barrier of U, if the end is a saddle
    values: np.ndarray
    action: float
    #: Estimated error of the finest chain or mesh, from the two finest ones. That of `action`, which like
    #: points, momenta and values of a chain is extrapolated from both, is mostly far smaller.
    error: float
    #: Largest ``|p·f + p·Dp|`` along the path, as a share of the largest ``|p·f| + p·Dp``
    residual: float
    #: Whether the path is a minimum, and its error within the tolerance
    converged: bool
    #: Actions of other minima that were found from other first guesses, by rising action; of chains to about
    #: a thousandth, as these are short. One with the same action is a mirror image, mostly.
    rivals: tuple[float, ...] = ()
    #: Shape ``(n,)``, of a solution of Hamilton's equations: zero at its last point; infinite at equilibria,
    #: where it does not come to. None of a chain.
    times: np.ndarray | None = None
    #: Whether no neighbouring solution crosses the path; only then it is a minimum
    smooth: bool = True
    #: Shape ``(m, d)``: how f leads on from the end to another attractor, without any action; None where that
    #: was not asked for
    downhill: np.ndarray | None = None


class Tube:
    """The quadratic cost ``ρ·Hρ`` about a cycle, in the units of a problem."""

    def __init__(self, points: np.ndarray, hessians: np.ndarray, period: float) -> None:
        n, self.period = len(points), period
        self.count = n
        places = np.arange(n + 1)
        self.curve = CubicSpline(places, np.vstack([points, points[:1]]), bc_type="periodic")
        self.costs = CubicSpline(places, np.concatenate([hessians, hessians[:1]]), bc_type="periodic")
        self.tree = cKDTree(self.curve(np.arange(CYCLE_GRID * n) / CYCLE_GRID))

    def place(self, y: np.ndarray) -> np.ndarray:
        """Where on the cycle the state next to each point lies: ``(n, d)`` to ``(n,)``."""
        place = self.tree.query(np.nan_to_num(y))[1] / CYCLE_GRID
        for _ in range(NEWTON_STEPS_TO_CYCLE):
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
        for _ in range(NEWTON_STEPS_TO_CYCLE):
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

    def density(self, place: np.ndarray, flow: np.ndarray) -> np.ndarray:
        """Stationary density on the cycle, ``(det' H)^½/(T |f|)`` over ``(πε)^((d - 1)/2)``: shape ``(n,)``.

        It is spread evenly in time, and normally across with the variance ``ε/2 H⁻¹``; det' is the product of
        the eigenvalues across f.
        """
        across = np.linalg.eigvalsh(self.costs(place))[:, 1:].prod(axis=1)
        return np.asarray(np.sqrt(across) / (self.period * np.linalg.norm(flow, axis=1)))

    def curvature(self, y: np.ndarray) -> np.ndarray:
        """Second derivatives of the cost next to one point, to leading order: shape ``(d, d)``."""
        return np.asarray(2 * self.costs(self.place(y[None])[0]))


class _Bowl:
    """The quadratic cost about a point attractor at the origin, ``y·My``, with the methods of a tube."""

    def __init__(self, hessian: np.ndarray) -> None:
        self.hessian = hessian

    def closest(self, y: np.ndarray) -> np.ndarray:
        return np.zeros_like(y)

    def level(self, y: np.ndarray) -> np.ndarray:
        return np.einsum("ni,ij,nj->n", y, self.hessian, y)

    def slope(self, y: np.ndarray) -> np.ndarray:
        return np.asarray(2 * self.hessian @ y)

    def curvature(self, _: np.ndarray) -> np.ndarray:
        return 2 * self.hessian


LevelSet = _Bowl | Tube
"""What a chain begins or ends on."""


class Segments:
    """f of the middles of a chain, the differences Δ, and the sizes of both in the metric D⁻¹."""

    def __init__(self, problem: PathProblem, y: np.ndarray) -> None:
        self.middles, self.forward = (y[1:] + y[:-1]) / 2, np.diff(y, axis=0)
        self.force = problem.force(self.middles)
        whitening = problem.noise.whitening_at(self.middles)
        force, forward = (products(whitening, part) for part in (self.force, self.forward))
        self.speed, self.length = (
            np.linalg.norm(part, axis=1) + np.finfo(float).tiny for part in (force, forward)
        )
        # ``|f||Δ| - f·Δ``, written so that nothing cancels where f and Δ are parallel.
        turn = forward / self.length[:, None] - force / self.speed[:, None]
        self.actions = 0.5 * self.speed * self.length * np.sum(turn**2, axis=1)
        # ``∫ |f| |φ'| ds``, with which an action is compared that may be zero.
        self.effort = float(np.sum(self.speed * self.length))


class PathProblem(ScaledSystem):
    """Chains between two states, in units in which D at the start, their distance and ∂f/∂x are of size one.

    M is the Hessian of V at the start, None where that is no attractor; then the first point of a chain is as
    fixed as the last. Where D has no inverse a `measure` stands in for it, and there is no action of chains.

    The start may be a stable cycle, and the end an unstable one: a chain begins and ends on thin tubes then.
    """

    def __init__(
        self, dynamics: Dynamics, start: LimitSet, end: LimitSet, *, measure: Diffusion | None = None
    ) -> None:
        # Of cycles, the states that are closest to the other end.
        one, two = (each.points if isinstance(each, Cycle) else each[None] for each in (start, end))
        away = np.linalg.norm(one[:, None] - two, axis=2)
        row, column = np.unravel_index(int(np.argmin(away)), away.shape)
        first, last = one[row], two[column]
        noise = dynamics.diffusion.frozen(first) if measure is None else measure
        distance = float(np.linalg.norm(noise.whitening @ (last - first)))
        if not distance > 0:
            raise ValueError(f"the path is to end where it starts, at {first.tolist()}")
        units = distance * noise.root
        jacobians = np.linalg.inv(units) @ dynamics.jacobian(np.stack([first, last])) @ units
        rate = float(np.linalg.norm(jacobians, axis=(1, 2)).max())
        super().__init__(dynamics, first, units, unit=distance**2 * rate, rate=rate)
        self.end = self.inverse @ (last - first)
        self.hessian: np.ndarray | None = None
        self.begin: LevelSet | None = None
        self.finish: Tube | None = None

        def tube(cycle: Cycle, hessians: np.ndarray) -> Tube:
            return Tube(self.scaled(cycle.points), self.curvatures(hessians), cycle.period * rate)

        if isinstance(end, Cycle):
            self.finish = tube(end, hessians_along(dynamics, end, reaching=True))
        if isinstance(start, Cycle):
            self.begin = tube(start, hessians_along(dynamics, start))
        elif self.rests(np.zeros(len(first))) and classify(dynamics, first).kind == "attractor":
            self.hessian = self.curvatures(hessian_at(dynamics, first))
            self.begin = _Bowl(self.hessian)
        # By how much of the upper bound S may fail to curve upwards at a minimum: about cycles any phase may
        # be as good as any other.
        self.flat = CYCLE_SHIFT if isinstance(self.begin, Tube) or self.finish is not None else 0.0

    def rests(self, y: np.ndarray) -> bool:
        """Whether f vanishes at a state, to rounding."""
        return bool(np.linalg.norm(self.force(y[None])) < REST)

    def chain(self, x: np.ndarray) -> np.ndarray:
        """A curve ``(n, d)`` in the units of the problem, from its start to its end."""
        y = self.scaled(x)
        if not isinstance(self.begin, Tube):
            y[0] = 0.0
        if self.finish is None:
            y[-1] = self.end
        return y

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
                inner = float(Segments(self, y).actions.sum())
            except NumericalFailure:
                return np.inf
            return float(self.level(y[:1])[0]) + inner + self.remaining(y[-1])

    def spaced(self, y: np.ndarray, count: int, level: float) -> np.ndarray:
        """A chain along another one, which begins where the level is as given and is spaced for accuracy.

        Near an attractor the segments are in proportion to the distance from it, in the metric of M, since
        the path may wind.
        """
        if self.hessian is not None and self.level(y[:1])[0] > level > 0:
            y = np.vstack([_spiral(self, y[0], level), y[1:]])
        if level > 0 and isinstance(self.begin, Tube):
            y = np.vstack([_winding(self, self.begin, y[0], level, -1.0)[::-1], y])
        if level > 0 and self.finish is not None:
            y = np.vstack([y, _winding(self, self.finish, y[-1], level, 1.0)])
        length = np.r_[0, np.cumsum(np.linalg.norm(np.diff(y, axis=0), axis=1))]
        apart = np.append(np.diff(length) > COINCIDENCE * length[-1], True)
        length, y = length[apart], y[apart]
        curve = Akima1DInterpolator(length, y)
        dense = np.interp(np.arange(0, len(y) - 0.95, 0.1), np.arange(len(y)), length)
        y = curve(dense)
        if self.begin is not None:
            first = int(np.flatnonzero(self.level(y) <= level).max(initial=0))
            dense, y = dense[first:], y[first:]
        if self.finish is not None:
            beyond = np.flatnonzero(self.finish.level(y) > level).max(initial=len(y) - 3) + 2
            dense, y = dense[:beyond], y[:beyond]
        measure = np.r_[0, np.cumsum(_relative_lengths(self, y))]
        return curve(np.interp(np.linspace(0, measure[-1], count), measure, dense))

    def descended(
        self, y: np.ndarray, count: int, action: float, *, first: bool = False
    ) -> tuple[np.ndarray, float, bool]:
        """A chain of `count` points moved along y down to a minimum of S, its action, and whether it is one.

        `action` is about that of the path, and decides where the chain begins. A `first` chain, far from a
        minimum, is spaced anew where it has become uneven, and pushed off where it rests at a saddle of S.
        """
        level = START_LEVEL * action
        # Share of S that a step must still gain: of tubes, the third order that their cost leaves out.
        fine = START_LEVEL**1.5 if self.flat > 0 else FINE
        y = self.spaced(y, count, level)
        if y.shape[1] == 1:
            return y, self.action(y), True
        action, shift, spacings, kicks = self.action(y), 1.0, 0, 0
        for _ in range(MOST_STEPS):
            across = _Across(self, y)
            resting = (COARSE if first else fine) * action + np.finfo(float).eps * across.effort
            gained, expected = 0.0, np.inf
            while shift < LARGEST_SHIFT:
                step = across.step(shift)
                if step is not None:
                    new = across.moved(step)
                    expected = -0.5 * float(across.slope @ step)
                    gained = action - self.action(new)
                    if gained > LEAST_GAIN * expected or expected < resting:
                        break
                shift = max(4 * shift, SMALLEST_SHIFT)
            else:
                break
            if gained > 0:
                y, action = new, action - gained
            if expected > resting:
                shift *= 0.2 if gained > GOOD_GAIN * expected else 1.0
                shift = max(shift if shift > 1e-8 else 0.0, self.flat)
                measure = _relative_lengths(self, y)
                if first and spacings < MOST_RESPACINGS and measure.max() > UNEVEN * measure.min():
                    y = self.spaced(y, count, level)
                    action, spacings = self.action(y), spacings + 1
            elif across.step(self.flat) is None:
                if not first or kicks == MOST_KICKS:
                    break
                kicks += 1
                lower = min((across.moved(push) for push in across.kicks()), key=self.action)
                if self.action(lower) >= action:
                    break
                y, action, shift = lower, self.action(lower), 1.0
            elif shift <= SMALLEST_SHIFT:
                return y, action, True
            else:
                shift = self.flat
        return y, action, False

    def first_chains(self) -> tuple[list[np.ndarray], float]:
        """First chains, and by how many radian the first of them turns, in the metric of M.

        That would be the right one were f linear: ``ẋ = (J + 2DM) x``, backwards from the end.
        """
        chains = bent_lines(self.end, MOST_BENDS)
        if self.hessian is None:
            return chains, 0.0
        linear = _spiral(self, self.end, START_LEVEL * self.level(self.end[None])[0])
        return [linear, *chains], total_turn(linear @ np.linalg.cholesky(self.hessian))


def bent_lines(end: np.ndarray, directions: int) -> list[np.ndarray]:
    """The straight line from zero to a point, and lines bent to both sides in so many directions."""
    share = np.linspace(0, 1, 201)[:, None]
    # The columns of the right factor span what is across the line.
    across, bow = np.linalg.svd(end[None])[2][1 : directions + 1], BEND * np.sin(np.pi * share)
    return [share * end, *(share * end + side * bow * way for way in across for side in (1, -1))]


def total_turn(y: np.ndarray) -> float:
    """By how many radian a chain ``(n, d)`` turns."""
    forward = np.diff(y, axis=0)
    forward /= np.maximum(np.linalg.norm(forward, axis=1, keepdims=True), np.finfo(float).tiny)
    return float(np.arccos(np.clip(np.sum(forward[1:] * forward[:-1], axis=1), -1, 1)).sum())


def products(matrices: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Of each matrix with its vector: ``(n, d, d)`` and ``(n, d)`` to ``(n, d)``."""
    return np.asarray((matrices @ vectors[:, :, None])[:, :, 0])


def _relative_lengths(problem: PathProblem, y: np.ndarray) -> np.ndarray:
    """Lengths of the segments, relative to what they should be."""
    forward, middles = np.diff(y, axis=0), (y[1:] + y[:-1]) / 2
    if problem.hessian is None:
        return np.linalg.norm(forward, axis=1)
    near = np.sqrt(problem.level(middles)) + CENTRAL_SPACING * np.sqrt(problem.level(problem.end[None]))
    return np.sqrt(problem.level(forward)) / near


def _spiral(problem: PathProblem, last: np.ndarray, level: float) -> np.ndarray:
    """The way that linear dynamics takes to a point from where the action is as given."""
    assert problem.hessian is not None
    flow = problem.jacobian(np.zeros((1, len(last))))[0] + 2 * problem.hessian
    return unwound(flow, problem.hessian, last, step=SPIRAL_STEP, level=level)[0]


def unwound(
    flow: np.ndarray, hessian: np.ndarray, last: np.ndarray, *, step: float, level: float
) -> tuple[np.ndarray, np.ndarray]:
    """States of ``ẏ = flow y`` up to a point from where ``y·My`` is below a level, and their times.

    These end at zero; `step` is in units of the shortest time of the flow.
    """
    step = step / np.abs(np.linalg.eigvals(flow)).max()
    back, y = scipy.linalg.expm(-step * flow), [last]
    while y[-1] @ hessian @ y[-1] > level and len(y) < MOST_NODES:
        y.append(back @ y[-1])
    return np.array(y[::-1]), step * np.arange(1 - len(y), 1)


def _winding(problem: PathProblem, tube: Tube, last: np.ndarray, level: float, sense: float) -> np.ndarray:
    """The way by linear dynamics from a point onwards to a tube, or back to where it left one.

    ``ẏ = F + 2Dp`` with ``p`` as the quadratic cost has it, with or against time.
    """

    def rates(_: float, y: np.ndarray) -> np.ndarray:
        return sense * problem.force(y[None])[0] - problem.noise.push(y[None], tube.slope(y)[None])[0]

    def arrives(_: float, y: np.ndarray) -> float:
        return float(tube.level(y[None])[0] - level)

    arrives.terminal = True  # type: ignore[attr-defined]
    if not arrives(0.0, last) > 0:
        return np.zeros((0, len(last)))
    way = solve_ivp(
        rates, (0.0, MOST_TURNS * tube.period), last, rtol=1e-4, atol=1e-6,
        max_step=tube.period / STEPS_PER_TURN, events=arrives,
    )  # fmt: skip
    return np.asarray(way.y[:, 1:].T)


def evenly(points: np.ndarray, count: int) -> np.ndarray:
    """Evenly spaced points on a polygon."""
    along = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))]
    places = np.linspace(0, along[-1], count)
    return np.stack([np.interp(places, along, column) for column in points.T], axis=1)


class _Across:
    """Moves of a chain across itself: slope and second derivatives of S, in banded form.

    A chain may slide along itself without any change of S but that of its error, which must not matter. The
    matrix for frozen times is that of ``Σ |Δ - τf|²/2τ``, ``τ = |Δ|/|f|`` being held fast, without the second
    derivatives of f and D: of an upper bound of S that touches it. With ``q = D⁻¹(Δ/τ - f)``, twice the
    momentum, and ``G_ik = ∂_k f_i + ((∂_k D)q)_i``, its blocks are ``τ GᵀD⁻¹G``, ``-D⁻¹G`` and ``D⁻¹/τ``.
    """

    def __init__(self, problem: PathProblem, y: np.ndarray) -> None:
        parts, noise, dimension = Segments(problem, y), problem.noise, y.shape[1]
        self.y, self.effort = y, parts.effort
        self.range = slice(1 if problem.begin is None else 0, -1 if problem.finish is None else None)
        times = (parts.length / parts.speed)[:, None, None]
        middles, jacobian = parts.middles, problem.jacobian(parts.middles)
        metric = noise.precision_at(middles)
        force, forward = (products(metric, part) for part in (parts.force, parts.forward))
        twice = forward / times[:, 0] - force
        turned = jacobian + noise.turn(middles, twice)
        by_middle = -2 * problem.pull(middles, twice / 2, turned)
        bent = -2 * times * problem.bend(middles, twice / 2)
        # The times change, too: by so much, up to a factor, with the middles and the differences.
        slower = (
            times[:, 0] * (2 * np.einsum("nij,ni->nj", jacobian, force) - noise.contract(middles, force, 1))
            + noise.contract(middles, forward, 1) / times[:, 0]
        )
        by_middle *= -times[:, 0]
        slope = np.zeros_like(y)
        slope[1:] += by_middle / 2 + twice
        slope[:-1] += by_middle / 2 - twice
        longer, product = -2 * forward / times[:, 0], parts.speed * parts.length
        moving = product > 1 / np.finfo(float).max  # a segment at rest has no times that change
        share = np.divide(0.25, product, where=moving, out=0 * product)[:, None, None]
        pushed = metric @ turned
        # Second derivatives of the segments by middles, by differences and middles, and by differences.
        frozen = (times * turned.transpose(0, 2, 1) @ pushed, -pushed, metric / times)
        exact = (
            frozen[0] + bent - share * (slower[:, :, None] * slower[:, None]),
            frozen[1] - share * (longer[:, :, None] * slower[:, None]),
            frozen[2] - share * (longer[:, :, None] * longer[:, None]),
        )
        first, last = np.zeros((2, dimension, dimension))
        if problem.begin is not None:
            slope[0] += problem.begin.slope(y[0])
            first = problem.begin.curvature(y[0])
        if problem.finish is not None:
            slope[-1] += problem.finish.slope(y[-1])
            last = problem.finish.curvature(y[-1])
        self.problem = problem
        # Orthonormal directions across the chain at its points, shape (n, d, d - 1).
        normal = np.linalg.svd(np.gradient(y, axis=0)[:, None, :])[2][:, 1:].transpose(0, 2, 1)
        if isinstance(problem.begin, Tube):  # along the tube, on which the chain begins, and ends
            normal[0] = np.linalg.svd(problem.begin.slope(y[0])[None])[2][1:].T
        if problem.finish is not None:
            normal[-1] = np.linalg.svd(problem.finish.slope(y[-1])[None])[2][1:].T
        self.normal = normal[self.range]
        self.slope = np.einsum("nij,ni->nj", self.normal, slope[self.range]).ravel()
        self.exact, self.frozen = (self._banded(blocks, first, last) for blocks in (exact, frozen))

    def _banded(self, blocks: Sequence[np.ndarray], first: np.ndarray, last: np.ndarray) -> np.ndarray:
        """The matrix of the moves, in the lower form of scipy's solvers.

        Of second derivatives of the segments by middles, by differences and middles, and by differences; and
        of what is added to the blocks of the first point and of the last.
        """
        middle, mixed, forward = blocks
        count, _, m = self.normal.shape
        transposed = mixed.transpose(0, 2, 1)
        both = (mixed + transposed) / 2
        diagonal = np.zeros((len(middle) + 1, *first.shape))
        diagonal[1:] += middle / 4 + forward + both
        diagonal[:-1] += middle / 4 + forward - both
        diagonal[0] += first
        diagonal[-1] += last
        # Row of the next point, column of this one.
        below = (middle / 4 - forward + (mixed - transposed) / 2)[self.range.start :][: count - 1]
        turned = self.normal.transpose(0, 2, 1)
        diagonal = turned @ diagonal[self.range] @ self.normal
        below = turned[1:] @ below @ self.normal[:-1]
        matrix = np.zeros((2 * m, count * m))
        for column, row in np.ndindex(m, m):
            if row >= column:
                matrix[row - column, column::m] = diagonal[:, row, column]
            matrix[m + row - column, column::m][: count - 1] = below[:, row, column]
        return matrix

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
