"""Minimum action paths between attractors, saddles and cycles.

The action of a curve φ from A to B, whatever the time it takes, is

    S = ∫ (|f| |φ'| - f·φ') ds,    a·b = aᵀD⁻¹b,

and its minimum is ``U(B) - U(A)``, U = 2V, if A is an attractor in whose well B lies. Nothing is taken from
the methods that find V: what is used is f with its derivatives.

The curve is a chain of points. Each segment has the action of a straight line with f of its middle, and the
points are moved across the chain by Newton's method. It is damped with the action of a chain whose times are
frozen at ``|Δφ|/|f|``, which is never below S: a large step for paths that wind about an attractor, where a
gradient would be useless. About an attractor the chain begins on a small ellipsoid, on which V is ``½ y·My``.

Where D has no inverse, as noise acts on some states only, a curve has no action that could be made minimal,
and Hamilton's equations are solved instead (`siq.quasipotential.hamiltonian_paths`).

References
----------
M. Heymann and E. Vanden-Eijnden, Comm. Pure Appl. Math. 61 (2008) 1052: the geometric action.

A cycle is an attractor as a point is: a path may leave it at any phase. What parts two basins may be a
saddle, or an unstable cycle, on which the path ends at any phase, too. From there f leads on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp

from siq.errors import NumericalFailure
from siq.quasipotential.hamiltonian_paths import hamiltonian_paths
from siq.quasipotential.path_chains import (
    MOST_NODES,
    NO_ACTION,
    DiscretisedPath,
    PathProblem,
    descended,
    evenly,
    extrapolated,
    first_chains,
    first_guesses,
    hamiltonian_residual,
    rivals_of,
    spaced,
)
from siq.systems.basins import ends_of
from siq.systems.cycles import Cycle, hessians_along, unstable_direction
from siq.systems.dynamics import Dynamics
from siq.systems.equilibria import Equilibrium, measure_at
from siq.systems.phase_portrait import PhasePortrait

FOLLOWED = 4000  # points of a way down that Hamilton's equations are told, which may wind
TURN = 0.15  # radian from one segment of the first chain to the next
UNSTABLE_START = 1e-4  # of the distance: where the way down from a saddle starts
ARRIVED = 1e-3  # of the distance: where it ends
FAR = 20.0  # in distances: where it has missed the target
AT_REST = ARRIVED**3  # speed, in units of the linearised equations: where it has ended elsewhere
PRECISION = AT_REST / 10  # of a step: what jitters about a rest by more than its speed never comes to rest
LONGEST_DESCENT = 1e5  # in units of the shortest time of the linearised equations


@dataclass(frozen=True)
class MinimumActionPath:
    """The path of least action between two states.

    Attributes
    ----------
    points
        Shape ``(n, d)``, in the states' units: from the start to the end, both included.
    momenta
        Shape ``(n, d)``: p there, which is ∇V where V is smooth; the path follows ``ẋ = f + 2Dp``.
    values
        Shape ``(n,)``: the action up to each point, that is U, not V, if the start is an attractor.
    action
        Of the whole path, extrapolated from the two finest chains: the barrier of U, if the end is a saddle.
    error
        Estimated error of the finest chain, from these two; that of `action` is mostly far smaller. Points,
        momenta and values are extrapolated in the same way.
    residual
        Largest ``|p·f + p·Dp|`` along the path, as a share of the largest ``|p·f| + p·Dp``.
    converged
        Whether the chain is a minimum, and its error within the tolerance.
    rivals
        Actions of other minima that were found from other first guesses, by rising action and to about a
        thousandth, as their chains are short. One with the same action is a mirror image, mostly.
    """

    points: np.ndarray
    momenta: np.ndarray
    values: np.ndarray
    action: float
    error: float
    residual: float
    converged: bool
    rivals: tuple[float, ...] = ()


@dataclass(frozen=True)
class TransitionPath:
    """The most probable way from one attractor to another: up to a saddle, and down without noise.

    Attributes
    ----------
    uphill
        From the attractor to the saddle.
    downhill
        Shape ``(n, d)``: the trajectory of f from the saddle to the other attractor, whose action is zero.
    """

    uphill: MinimumActionPath
    downhill: np.ndarray

    @property
    def points(self) -> np.ndarray:
        """All points, shape ``(m, d)``; the saddle stands there once."""
        return np.vstack([self.uphill.points, self.downhill[1:]])


def minimum_action_path(
    dynamics: Dynamics,
    start: np.ndarray | Cycle,
    end: np.ndarray | Cycle,
    *,
    nodes: int = 100,
    tolerance: float = 1e-4,
    initial: Sequence[np.ndarray] | None = None,
) -> MinimumActionPath:
    """The path of least action from one state to another.

    Parameters
    ----------
    dynamics
        f, twice differentiable.
    start
        Shape ``(d,)``: mostly an attractor, to rounding. Or a stable cycle, at any phase of which the path
        may begin.
    end
        Shape ``(d,)``: mostly a saddle, but any state will do. Where the path has to cross a saddle, it is
        found faster and better in two parts: see `transition_path`. Or an unstable cycle.
    nodes
        Points of the first chain. It has more where the path winds; and their number is doubled until the
        action is known.
    tolerance
        Error of the finest chain, as a share of its action.
    initial
        First guesses, each of shape ``(k, d)`` with k ≥ 2, instead of the own ones: the path that would be
        right were f linear, the straight line, and lines bent to all sides.

    Returns
    -------
    MinimumActionPath
        The lowest minimum found. No method promises that there is no lower one: `rivals` tells which others
        the first guesses led to.

    Raises
    ------
    ValueError
        When start and end are one.
    NumericalFailure
        When no first guess has a finite action, or Hamilton's equations have no solution that was found.
    """
    start, end = (one if isinstance(one, Cycle) else np.asarray(one, dtype=float) for one in (start, end))
    if not dynamics.diffusion.regular:
        if isinstance(start, Cycle) or isinstance(end, Cycle):
            raise NumericalFailure("paths from and to cycles need noise on every state of its own")
        return _by_hamilton(dynamics, start, end, tolerance, initial or ())
    problem = PathProblem(dynamics, start, end)
    own, turning = first_chains(problem) if problem.flat == 0 else _about_cycles(problem, start, end)
    guesses = own if initial is None else [problem.scaled(np.asarray(one, dtype=float)) for one in initial]
    count = min(max(nodes, int(turning / TURN)), MOST_NODES // 4)
    chains: list[DiscretisedPath] = []
    for guess in guesses:
        action = problem.action(spaced(problem, guess, count, 0.0))
        if not np.isfinite(action):
            continue
        chain = descended(problem, guess, count, action, first=True)
        if np.isfinite(chain.action):
            chains.append(chain)
    if not chains:
        last = problem.unscaled(problem.end[None])[0]
        raise NumericalFailure(
            f"no path from {problem.start.tolist()} to {last.tolist()} was found that has a finite action"
        )
    chains.sort(key=lambda one: one.action)
    fine, known = descended(problem, chains[0].points, count, chains[0].action), False
    while not known and 2 * len(fine.points) < MOST_NODES:
        coarse = fine
        fine = descended(
            problem, coarse.points, 2 * len(coarse.points) - 1, coarse.action, first=not coarse.minimum
        )
        error = abs(fine.action - coarse.action) / 3
        known = error <= max(tolerance * fine.action, NO_ACTION * problem.effort(fine.points))
    line = extrapolated(problem, coarse, fine)
    # Rivals have the error of short chains, which they share with the first one.
    shares = [one.action / max(chains[0].action, np.finfo(float).tiny) for one in rivals_of(chains, fine)]
    points, momenta = np.split(line[:, :-1], 2, axis=1)
    return MinimumActionPath(
        points=problem.unscaled(points),
        momenta=problem.unit * momenta @ problem.inverse,
        values=problem.unit * line[:, -1],
        action=problem.unit * float(line[-1, -1]),
        error=problem.unit * error,
        residual=hamiltonian_residual(problem, line),
        converged=fine.minimum and known,
        rivals=tuple(float(problem.unit * line[-1, -1] * share) for share in shares),
    )


def _about_cycles(
    problem: PathProblem, start: np.ndarray | Cycle, end: np.ndarray | Cycle
) -> tuple[list[np.ndarray], float]:
    """First chains from or to a cycle, and by how many radian the one that turns most does."""
    dynamics = problem.dynamics
    if isinstance(start, Cycle):
        hessians = hessians_along(dynamics, start)
    elif problem.hessian is not None:
        hessians = problem.inverse.T @ problem.hessian @ problem.inverse * problem.unit
    else:
        raise NumericalFailure("a path to a cycle has to begin at an attractor")
    chains = [problem.scaled(one) for one in first_guesses(dynamics, start, end, hessians, problem.units)]
    return chains, max((_turning(chain) for chain in chains), default=0.0)


def _turning(chain: np.ndarray) -> float:
    """By how many radian a chain turns."""
    forward = np.diff(evenly(chain, FOLLOWED), axis=0)
    forward /= np.maximum(np.linalg.norm(forward, axis=1, keepdims=True), np.finfo(float).tiny)
    return float(np.arccos(np.clip(np.sum(forward[1:] * forward[:-1], axis=1), -1, 1)).sum())


def _by_hamilton(
    dynamics: Dynamics, start: np.ndarray, end: np.ndarray, tolerance: float, curves: Sequence[np.ndarray]
) -> MinimumActionPath:
    """The path where noise acts on some states only."""
    try:
        beside: np.ndarray | None = descent(dynamics, end, start, FOLLOWED)
    except NumericalFailure:  # the end is no saddle, or one from which f leads elsewhere
        beside = None
    found = hamiltonian_paths(dynamics, start, end, beside=beside, tolerance=tolerance, curves=curves)
    best = found[0]
    known = best.error <= tolerance * best.values[-1]
    return MinimumActionPath(
        points=best.points,
        momenta=best.momenta,
        values=2 * best.values,
        action=best.action,
        error=2 * best.error,
        residual=best.residual,
        converged=best.smooth and known and best.action <= min(one.action for one in found),
        rivals=tuple(one.action for one in found[1:] if one.smooth),
    )


def transition_path(
    dynamics: Dynamics,
    attractor: np.ndarray,
    saddle: np.ndarray,
    target: np.ndarray,
    *,
    nodes: int = 100,
    tolerance: float = 1e-4,
    initial: Sequence[np.ndarray] | None = None,
) -> TransitionPath:
    """The most probable way from an attractor over a saddle to another attractor.

    Parameters
    ----------
    dynamics, nodes, tolerance, initial
        As for `minimum_action_path`; `nodes` is the number of points downhill, too.
    attractor, saddle, target
        Shape ``(d,)`` each; the saddle has one unstable direction.

    Raises
    ------
    NumericalFailure
        When f leads from the saddle to the target on neither side, or for want of an uphill path.
    """
    downhill = descent(dynamics, np.asarray(saddle, float), np.asarray(target, float), nodes)
    uphill = minimum_action_path(
        dynamics, attractor, saddle, nodes=nodes, tolerance=tolerance, initial=initial
    )
    return TransitionPath(uphill, downhill)


def descent(dynamics: Dynamics, saddle: np.ndarray, target: np.ndarray, nodes: int) -> np.ndarray:
    """The trajectory of f from a saddle to an attractor, in evenly spaced points."""
    measure = None if dynamics.diffusion.regular else measure_at(dynamics, target)
    problem = PathProblem(dynamics, saddle, target, measure=measure)
    values, vectors = np.linalg.eig(problem.jacobian(np.zeros((1, dynamics.dimension)))[0])
    if (values.real > 0).sum() != 1:
        raise NumericalFailure(f"{saddle.tolist()} is no saddle with one unstable direction")
    upwards = vectors[:, np.argmax(values.real)].real

    def rates(_: float, y: np.ndarray) -> np.ndarray:
        return problem.force(y[None])[0]

    def arrives(_: float, y: np.ndarray) -> float:
        return float(np.linalg.norm(y - problem.end) - ARRIVED)

    def leaves(_: float, y: np.ndarray) -> float:
        return float(FAR - np.linalg.norm(y))

    def rests(_: float, y: np.ndarray) -> float:
        return float(np.linalg.norm(problem.force(y[None])) - AT_REST)

    for event in (arrives, leaves, rests):
        event.terminal, event.direction = True, -1  # type: ignore[attr-defined]
    for side in (1, -1):
        begin = side * UNSTABLE_START * upwards / np.linalg.norm(upwards)
        way = solve_ivp(
            rates, [0, LONGEST_DESCENT], begin, method="DOP853", rtol=PRECISION, atol=1e-12,
            dense_output=True, events=[arrives, leaves, rests],
        )  # fmt: skip
        if len(way.t_events[0]):
            times = np.interp(np.linspace(0, len(way.t) - 1, 20 * len(way.t)), np.arange(len(way.t)), way.t)
            return problem.unscaled(
                evenly(np.vstack([np.zeros_like(begin), way.sol(times).T, problem.end]), nodes)
            )
    raise NumericalFailure(f"f does not lead from the saddle {saddle.tolist()} to {target.tolist()}")


BESIDE = 1e-3  # of the domain: from where f leads on, beside what parts two basins
CYCLE_WAYS_ARRIVED = 1e-2  # of the domain: so close to an attractor a way down is drawn
LONGEST = 100.0  # periods, in which it has to be there
POINTS = 200  # of a way down


def both_sides(dynamics: Dynamics, cycle: Cycle, portrait: PhasePortrait) -> np.ndarray:
    """Where f leads from both sides of an unstable cycle: numbers of attractors, -1 elsewhere."""
    starts = _beside(dynamics, cycle, 0, portrait.box)
    return ends_of(dynamics, starts, portrait.attractors, portrait.cycles, box=portrait.box)


def way_about_cycles(
    dynamics: Dynamics,
    portrait: PhasePortrait,
    start: int,
    over: Equilibrium | Cycle,
    end: int | None,
    *,
    tolerance: float,
) -> TransitionPath:
    """The path of least action to what parts two basins, and the way on.

    Parameters
    ----------
    dynamics
        f and D.
    portrait
        What is stable.
    start, end
        Numbers of attractors, of cycles after those of points; the end is None where f leads out of the
        region.
    over
        The saddle, or the unstable cycle.
    tolerance
        Of the action.

    Raises
    ------
    NumericalFailure
        When there is no such path that could be found.
    """
    settled: list[np.ndarray | Cycle] = [*(one.position for one in portrait.attractors), *portrait.cycles]
    last = over if isinstance(over, Cycle) else over.position
    uphill = minimum_action_path(dynamics, settled[start], last, tolerance=tolerance)
    if end is None:
        return TransitionPath(uphill, uphill.points[-1:])
    return TransitionPath(uphill, _downhill(dynamics, over, uphill.points[-1], settled[end], portrait.box))


def _beside(dynamics: Dynamics, over: Equilibrium | Cycle, place: int, box: np.ndarray) -> np.ndarray:
    """Two states on either side of a saddle, or of a point of an unstable cycle."""
    width = np.ptp(box, axis=1)
    if isinstance(over, Cycle):
        direction, position = unstable_direction(dynamics, over, place, scale=width), over.points[place]
    else:
        values, vectors = np.linalg.eig(dynamics.jacobian(over.position[None])[0])
        direction, position = vectors[:, np.argmax(values.real)].real, over.position
    direction = BESIDE * direction / np.abs(direction / width).max()
    return np.stack([position + direction, position - direction])


def _downhill(
    dynamics: Dynamics,
    over: Equilibrium | Cycle,
    begin: np.ndarray,
    target: np.ndarray | Cycle,
    box: np.ndarray,
) -> np.ndarray:
    width = np.ptp(box, axis=1)
    place = 0
    if isinstance(over, Cycle):
        place = int(np.argmin(np.linalg.norm((over.points - begin) / width, axis=1)))
    cycle = target if isinstance(target, Cycle) else over
    if isinstance(cycle, Cycle):
        period = cycle.period
    else:
        raise ValueError("neither end is a cycle")

    def rates(_: float, y: np.ndarray) -> np.ndarray:
        return np.asarray(dynamics.drift((y * width)[None])[0] / width)

    def arrives(_: float, y: np.ndarray) -> float:
        if isinstance(target, Cycle):
            return float(target.distances((y * width)[None], scale=width)[0] - CYCLE_WAYS_ARRIVED)
        return float(np.linalg.norm(y - target / width) - CYCLE_WAYS_ARRIVED)

    arrives.terminal = True  # type: ignore[attr-defined]
    for start in _beside(dynamics, over, place, box):
        way = solve_ivp(
            rates, (0.0, LONGEST * period), start / width, rtol=1e-6, atol=1e-8, max_step=period / 40,
            events=arrives,
        )  # fmt: skip
        if len(way.t_events[0]):
            return evenly(np.vstack([begin[None], way.y.T * width]), POINTS)
    raise NumericalFailure("f does not lead on to the attractor behind what parts the basins")
