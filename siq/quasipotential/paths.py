"""Minimum action paths between attractors, saddles and cycles.

The least action from an attractor A to a state B of its well is ``U(B) - U(A)``, U = 2V. Nothing is taken
from the methods that find V: what is used is f with its derivatives. Where noise acts on every state a path
is a chain of points (`siq.quasipotential.path_chains`); where it acts on some only, a solution of Hamilton's
equations (`siq.quasipotential.hamiltonian_paths`).

A cycle is an attractor as a point is: a path may leave it at any phase. The separatrix between two basins may
hold a saddle, or an unstable cycle, on which the path ends at any phase, too. From there f leads on. First
guesses of paths from or to cycles are trajectories of Hamilton's equations that start on all sides of a small
tube, or of a small ellipsoid, with the momentum ``p = Hρ``, H being the curvature of V.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp
from scipy.spatial import cKDTree

from siq.errors import NumericalFailure
from siq.numerics.integration import dormand_prince_step, next_step
from siq.quasipotential.characteristics import NO_ACTION
from siq.quasipotential.hamiltonian_paths import hamiltonian_paths
from siq.quasipotential.path_chains import (
    MOST_NODES,
    LimitSet,
    MinimumActionPath,
    PathProblem,
    Segments,
    Tube,
    evenly,
    products,
    total_turn,
)
from siq.systems.cycles import Cycle, states_on_both_sides
from siq.systems.dynamics import Dynamics
from siq.systems.equilibria import measure_at

DESCENT_POINTS = 4000  # of a way down that Hamilton's equations are told, which may wind
TURN = 0.15  # radian from one segment of the first chain to the next
SAME_PATH = 0.03  # of the distance: minima further apart are two

# The way down from a saddle, in units of the distance to its end and of the linearised equations.
UNSTABLE_START = 1e-4  # where it starts
ARRIVAL = 1e-3  # where it ends
MISSED = 20.0  # where it has missed the target
REST_SPEED = ARRIVAL**3  # where it has ended elsewhere
STEP_PRECISION = REST_SPEED / 10  # what jitters about a rest by more than its speed never comes to rest
LONGEST_DESCENT = 1e5  # in units of the shortest time

# The way down about cycles, in units of the domain.
CYCLE_ARRIVAL = 1e-2  # so close to an attractor it is drawn
LONGEST_PERIODS = 100.0  # in which it has to be there
CYCLE_DESCENT_POINTS = 200

# First guesses of paths from or to cycles, in units of the distance.
GUESS_START = 3e-4  # from an attractor
PHASES, SIDES = 48, 2  # of first guesses; sides for each state beyond the second
GUESSES_PER_STATE = 96  # around a point, for each state beyond the first
MOST_GUESS_STEPS = 4000
GUESS_ACCURACY = 1e-6  # numerical: of one step
LONGEST_GUESS_STEP = 0.03  # or of the size of the cycle
GUESS_REACH = 6.0  # what is so far away does not come back
GUESS_ARRIVAL, GUESS_PASSED = 0.05, 0.3  # so close to the end one has arrived, or has passed it by
GUESS_SPENT = 1e-3  # of its largest momentum: below, one has arrived somewhere, and goes where f leads
MOST_GUESSES = 2  # of either kind that are tried
ACTION_DIFFERENCE = 0.02  # share of the action by which two of them differ


def minimum_action_path(
    dynamics: Dynamics, start: LimitSet, end: LimitSet, *, nodes: int = 100, tolerance: float = 1e-4,
    initial: Sequence[np.ndarray] | None = None,
) -> MinimumActionPath:  # fmt: skip
    """The path of least action from one state to another: the lowest minimum found.

    No method promises that there is no lower one: `rivals` tells which others the first guesses led to.

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
    nodes, tolerance
        Points of the first chain, of which there are more where the path winds; their number is doubled until
        the error of the finest chain is that share of its action.
    initial
        First guesses, each of shape ``(k, d)`` with k ≥ 2, instead of the own ones: the path that would be
        right were f linear, the straight line, and lines bent to all sides.

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
        try:
            beside: np.ndarray | None = descent(dynamics, end, start, DESCENT_POINTS)
        except NumericalFailure:  # the end is no saddle, or one from which f leads elsewhere
            beside = None
        found = hamiltonian_paths(
            dynamics, start, end, beside=beside, tolerance=tolerance, curves=initial or ()
        )
        return replace(
            found[0],
            converged=found[0].converged and found[0].action <= min(one.action for one in found),
            rivals=tuple(one.action for one in found[1:] if one.smooth),
        )
    problem = PathProblem(dynamics, start, end)
    if problem.flat > 0:
        own = _first_guesses(problem, start, end)
        turning = max((total_turn(evenly(chain, DESCENT_POINTS)) for chain in own), default=0.0)
    else:
        own, turning = problem.first_chains()
    guesses = own if initial is None else [problem.chain(np.asarray(one, dtype=float)) for one in initial]
    count = min(max(nodes, int(turning / TURN)), MOST_NODES // 4)
    chains: list[tuple[np.ndarray, float, bool]] = []
    for guess in guesses:
        action = problem.action(problem.spaced(guess, count, 0.0))
        if np.isfinite(action):
            chains.append(problem.descended(guess, count, action, first=True))
    chains = sorted((one for one in chains if np.isfinite(one[1])), key=lambda one: one[1])
    if not chains:
        last = problem.points(problem.end[None])[0]
        raise NumericalFailure(
            f"no path from {problem.center.tolist()} to {last.tolist()} was found that has a finite action"
        )
    (fine, action, minimum), known = problem.descended(chains[0][0], count, chains[0][1]), False
    while not known and 2 * len(fine) < MOST_NODES:
        coarse, before = fine, action
        fine, action, minimum = problem.descended(coarse, 2 * len(coarse) - 1, before, first=not minimum)
        error = abs(action - before) / 3
        known = error <= max(tolerance * action, NO_ACTION * Segments(problem, fine).effort)
    line = _extrapolated(problem, (coarse, before), (fine, action))

    def tree(y: np.ndarray) -> cKDTree:
        return cKDTree(evenly(y, int(5 * np.linalg.norm(np.diff(y, axis=0), axis=1).sum() / SAME_PATH) + 2))

    # Minima that lie apart from the first chain, from what it has become, and from each other. They have the
    # error of short chains, which they share with the first one.
    rivals, trees = [], [tree(chains[0][0]), tree(fine)]
    for y, its_action, is_minimum in chains[1:]:
        if is_minimum and all(other.query(y)[0].max() > SAME_PATH for other in trees):
            rivals.append(its_action / max(chains[0][1], np.finfo(float).tiny))
            trees.append(tree(y))
    points, momenta = np.split(line[:, :-1], 2, axis=1)
    return MinimumActionPath(
        points=problem.points(points), momenta=problem.momenta(momenta), values=problem.unit * line[:, -1],
        action=problem.unit * float(line[-1, -1]), error=problem.unit * error,
        residual=problem.residual(points, momenta), converged=minimum and known,
        rivals=tuple(float(problem.unit * line[-1, -1] * share) for share in rivals),
    )  # fmt: skip


def _path_nodes(problem: PathProblem, y: np.ndarray) -> np.ndarray:
    """Points, momenta, and actions up to there, shape ``(n, 2d + 1)``."""
    parts = Segments(problem, y)
    # Momenta of the middles, carried over half a segment; both sides agree at a minimum.
    times = (parts.length / parts.speed)[:, None]
    middle = products(problem.noise.precision_at(parts.middles), (parts.forward / times - parts.force) / 2)
    turn = -times / 2 * problem.pull(parts.middles, middle)
    p = np.empty_like(y)
    p[1:-1] = (middle[1:] + turn[1:] + middle[:-1] - turn[:-1]) / 2
    p[0] = middle[0] + turn[0] if problem.begin is None else problem.begin.slope(y[0]) / 2
    p[-1] = middle[-1] - turn[-1] if problem.finish is None else -problem.finish.slope(y[-1]) / 2
    return np.column_stack([y, p, problem.level(y[:1]) + np.r_[0.0, np.cumsum(parts.actions)]])


def _extrapolated(
    problem: PathProblem, coarse: tuple[np.ndarray, float], fine: tuple[np.ndarray, float]
) -> np.ndarray:
    """Nodes without the error of second order, from a chain with its action and one with half its spacing.

    Where the two differ by more than their errors, by a turn about the attractor say, they do not match, and
    the finer one stands for itself.
    """
    action = max((4 * fine[1] - coarse[1]) / 3, 0.0)
    second = _path_nodes(problem, fine[0])
    nodes = (4 * second[::2] - _path_nodes(problem, coarse[0])) / 3
    d, ends = problem.dimension, np.zeros((2, nodes.shape[1]))
    if not problem.residual(nodes[:, :d], nodes[:, d:-1]) < problem.residual(second[:, :d], second[:, d:-1]):
        nodes = second
        nodes[:, -1] *= action / max(fine[1], np.finfo(float).tiny)
    if problem.finish is not None:
        ends[1, :d] = problem.finish.closest(nodes[-1:, :d])[0]
        nodes[-1, -1] = action - problem.remaining(nodes[-1, :d])
        nodes = np.vstack([nodes, ends[1:]])
    nodes[-1, -1] = action
    if problem.begin is None:
        return nodes
    ends[0, :d] = problem.begin.closest(nodes[:1, :d])[0]
    return np.vstack([ends[:1], nodes])


def transition_path(
    dynamics: Dynamics, start: LimitSet, over: LimitSet, end: LimitSet | None, *,
    box: np.ndarray | None = None, nodes: int = 100, **options: Any,
) -> MinimumActionPath:  # fmt: skip
    """The path of least action to what parts two basins, with the way that f leads on from there.

    Parameters
    ----------
    dynamics, start, nodes, **options
        As for `minimum_action_path`; `nodes` is the number of points downhill, too.
    over, end
        A saddle with one unstable direction, or an unstable cycle; and the other attractor, or stable cycle,
        None where f leads out of the region.
    box
        Shape ``(d, 2)``: of the states, in whose widths ways about cycles are measured.

    Raises
    ------
    NumericalFailure
        When f leads from the saddle to the target on neither side, or for want of an uphill path.
    """
    about_cycle = any(isinstance(one, Cycle) for one in (over, end))
    downhill = None
    if end is not None and not about_cycle:
        downhill = descent(dynamics, np.asarray(over, float), np.asarray(end, float), nodes)
    uphill = minimum_action_path(dynamics, start, over, nodes=nodes, **options)
    if end is None:
        downhill = uphill.points[-1:] if isinstance(over, Cycle) else np.asarray(over, float)[None]
    elif about_cycle:
        assert box is not None
        downhill = _downhill(dynamics, over, uphill.points[-1], end, box)
    return replace(uphill, downhill=downhill)


def descent(dynamics: Dynamics, saddle: np.ndarray, target: np.ndarray, nodes: int) -> np.ndarray:
    """The trajectory of f from a saddle to an attractor, in evenly spaced points."""
    measure = None if dynamics.diffusion.regular else measure_at(dynamics, target)
    problem = PathProblem(dynamics, saddle, target, measure=measure)
    values, vectors = np.linalg.eig(problem.jacobian(np.zeros((1, dynamics.dimension)))[0])
    if (values.real > 0).sum() != 1:
        raise NumericalFailure(f"{saddle.tolist()} is no saddle with one unstable direction")
    upwards = vectors[:, np.argmax(values.real)].real

    def arrives(_: float, y: np.ndarray) -> float:
        return float(np.linalg.norm(y - problem.end) - ARRIVAL)

    def leaves(_: float, y: np.ndarray) -> float:
        return float(MISSED - np.linalg.norm(y))

    def rests(_: float, y: np.ndarray) -> float:
        return float(np.linalg.norm(problem.force(y[None])) - REST_SPEED)

    begin = UNSTABLE_START * upwards / np.linalg.norm(upwards)
    # On an invariant boundary f leads to a further saddle; a little towards the target, on.
    starts = [begin, -begin, *(side * begin + UNSTABLE_START * problem.end for side in (1, -1))]
    way = _arriving(
        lambda _, y: problem.force(y[None])[0], starts, LONGEST_DESCENT, [arrives, leaves, rests],
        method="DOP853", rtol=STEP_PRECISION, atol=1e-12, dense_output=True,
    )  # fmt: skip
    if way is None:
        raise NumericalFailure(f"f does not lead from the saddle {saddle.tolist()} to {target.tolist()}")
    times = np.interp(np.linspace(0, len(way.t) - 1, 20 * len(way.t)), np.arange(len(way.t)), way.t)
    return problem.points(evenly(np.vstack([np.zeros_like(begin), way.sol(times).T, problem.end]), nodes))


def _arriving(
    rates: Callable[[float, np.ndarray], np.ndarray], starts: Sequence[np.ndarray] | np.ndarray,
    longest: float, events: Sequence[Any], **options: Any,
) -> Any:  # fmt: skip
    """The first solution from some starts that ends with the first of the events, or None.

    Most arrive within a hundredth of the longest time; one that goes round a cycle takes all of it.
    """
    for event in events:
        event.terminal, event.direction = True, -1
    tried = itertools.product((longest / 100, longest), starts)
    ways = (solve_ivp(rates, (0.0, time), start, events=events, **options) for time, start in tried)
    return next((way for way in ways if len(way.t_events[0])), None)


def _downhill(
    dynamics: Dynamics, over: LimitSet, begin: np.ndarray, target: LimitSet, box: np.ndarray
) -> np.ndarray:
    """The way that f leads on where the one or the other is a cycle."""
    width, place = np.ptp(box, axis=1), 0
    if isinstance(over, Cycle):
        place = int(np.argmin(np.linalg.norm((over.points - begin) / width, axis=1)))
    period = next(one.period for one in (target, over) if isinstance(one, Cycle))

    def arrives(_: float, y: np.ndarray) -> float:
        if isinstance(target, Cycle):
            return float(target.distances((y * width)[None], scale=width)[0] - CYCLE_ARRIVAL)
        return float(np.linalg.norm(y - target / width) - CYCLE_ARRIVAL)

    way = _arriving(
        lambda _, y: dynamics.drift((y * width)[None])[0] / width,
        states_on_both_sides(dynamics, over, width=width, place=place) / width,
        LONGEST_PERIODS * period, [arrives], rtol=1e-6, atol=1e-8, max_step=period / 40,
    )  # fmt: skip
    if way is None:
        raise NumericalFailure("f does not lead on to the attractor behind what parts the basins")
    return evenly(np.vstack([begin[None], way.y.T * width]), CYCLE_DESCENT_POINTS)


def _first_guesses(problem: PathProblem, start: LimitSet, end: LimitSet) -> list[np.ndarray]:
    """Curves from beside a start to an end, one of them a cycle, by rising action."""
    d, draw = problem.dimension, np.random.default_rng(0)
    # States on all sides of the start, and the momenta there.
    if isinstance(start, Cycle):
        assert isinstance(problem.begin, Tube)
        rows = np.linspace(0, len(start.points), PHASES, endpoint=False).astype(int)
        hessians = problem.begin.costs(rows)
        # The axes of the curvature, of which the first one is along the flow, and directions between them.
        across = np.linalg.eigh(hessians)[1].transpose(0, 2, 1)[:, 1:]
        between = draw.standard_normal((SIDES * (d - 2), d - 1))
        sides = np.concatenate([np.eye(d - 1), -np.eye(d - 1), between])
        sides /= np.linalg.norm(sides, axis=1, keepdims=True)
        offset = GUESS_START * np.einsum("sa,nai->nsi", sides, across)
        momenta = np.einsum("nij,nsj->nsi", hessians, offset).reshape(-1, d)
        states = (problem.begin.curve(rows)[:, None] + offset).reshape(-1, d)
    elif problem.hessian is not None:
        directions = draw.standard_normal((GUESSES_PER_STATE * (d - 1), d))
        states = GUESS_START * directions / np.linalg.norm(directions, axis=1, keepdims=True)
        momenta = states @ problem.hessian
    else:
        raise NumericalFailure("a path to a cycle has to begin at an attractor")
    ways = _hamiltonian_trajectories(problem, states, momenta)
    target = cKDTree(problem.scaled(end.points if isinstance(end, Cycle) else end[None]))
    found = []
    for way, action in zip(ways[:, :, :d], ways[:, :, -1], strict=True):
        away = target.query(way)[0]
        close = max(GUESS_ARRIVAL, float(away.min()))
        arrived = int(np.argmax(away <= close))
        left = np.flatnonzero(away[arrived:] > 2 * close)
        nearest = int(arrived + np.argmin(away[arrived : arrived + (left[0] if len(left) else len(away))]))
        curve = way[: nearest + 1] if isinstance(end, Cycle) else np.vstack([way[: nearest + 1], problem.end])
        if not isinstance(start, Cycle):
            curve[0] = 0.0
        if nearest > 0:
            found.append((float(away[nearest]), float(action[nearest]), curve))
    found.sort(key=lambda one: one[1])
    least = min((one[0] for one in found), default=np.inf)
    chosen: list[tuple[float, float, np.ndarray]] = []
    # A lower path may have passed the end by further than one that is not the lowest.
    for close in (max(GUESS_ARRIVAL, least), max(GUESS_PASSED, least)):
        most = len(chosen) + MOST_GUESSES
        for one in found:
            known = any(abs(one[1] - other[1]) <= ACTION_DIFFERENCE * abs(other[1]) for other in chosen)
            if one[0] <= close and not known and len(chosen) < most:
                chosen.append(one)
    return [curve for _, _, curve in chosen]


def _hamiltonian_trajectories(problem: PathProblem, states: np.ndarray, momenta: np.ndarray) -> np.ndarray:
    """States, momenta and actions along trajectories of Hamilton's equations: ``(n, steps, 2d + 1)``."""
    n, d = states.shape

    def rates(z: np.ndarray) -> np.ndarray:
        return np.column_stack(problem.velocities(z[:, :d], z[:, d : 2 * d]))

    z, alive, strongest = np.column_stack([states, momenta, np.zeros(n)]), np.arange(n), np.zeros(n)
    kept: list[np.ndarray] = [z.copy()]
    longest = LONGEST_GUESS_STEP * max(1.0, float(np.linalg.norm(np.ptp(states, axis=0))))
    steps = np.full(n, longest / np.linalg.norm(rates(z)[:, :d], axis=1).max())
    for _ in range(MOST_GUESS_STEPS):
        with np.errstate(all="ignore"):
            at = rates(z[alive])
            step = np.minimum(steps[alive], longest / np.maximum(np.linalg.norm(at[:, :d], axis=1), 1e-300))
            moved, error = dormand_prince_step(rates, z[alive], step, first=at)
            relative = np.abs(error[:, :d]).max(axis=1) / GUESS_ACCURACY
        steps[alive] = next_step(step, relative)
        taken = np.isfinite(moved).all(axis=1) & (relative <= 1)
        z[alive[taken]] = moved[taken]
        kept.append(z.copy())
        strength = np.linalg.norm(z[alive, d : 2 * d], axis=1)
        strongest[alive] = np.maximum(strongest[alive], strength)
        away = np.linalg.norm(z[alive, :d] - states[alive], axis=1)
        alive = alive[(away < GUESS_REACH) & (strength > GUESS_SPENT * strongest[alive])]
        if not len(alive):
            break
    return np.stack(kept, axis=1)
