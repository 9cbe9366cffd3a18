"""Along which curves is the end of a solution moved, from which first guess, and how far does it get?

About an attractor Hamilton's equations are linear, which makes the first guess exact; and about a saddle,
which continues a solution to it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.linalg

from siq.landscape.hamiltonian_problem import (
    APPROACH,
    MOST_NODES,
    HamiltonianProblem,
    Solution,
    interpolated,
)

FIRST = 0.1  # of the distance from A to S, in the metric of M: there the first end lies
START = 0.003  # of it: where solutions begin, and the power series errs by its fifth power
ROUGH = 1e-3  # relative residual of collocation, on the way
LONGEST = 0.3  # of the distance: step of the end; it is halved where Newton's method does not follow ...
SHORTEST = 0.004  # ... and a curve given up below this: it leaves the well, or V is not smooth there
BENDS, BEND = 4, 0.4  # curves beside the straight one, and how far they leave it, as a share of the distance
SPIRAL = 0.3  # of the shortest time of the linear equations: steps of a first guess


def last_states(problem: HamiltonianProblem, beside: np.ndarray | None) -> list[np.ndarray]:
    """Where the end is moved to: itself, or states before the saddle, one of which will do."""
    if problem.unstable is None:
        return [problem.end]
    return [_before(problem, beside, one) for one in problem.arrivals]


def curves_to(
    problem: HamiltonianProblem, last: np.ndarray, further: Sequence[np.ndarray]
) -> list[np.ndarray]:
    """Along which the end is moved: straight, and bent to some sides."""
    share = np.linspace(0, 1, 201)[:, None]
    straight = share * last
    across = np.linalg.svd(last[None])[2][1 : BENDS // 2 + 1]
    bent = [straight + BEND * side * np.sin(np.pi * share) * way for way in across for side in (1, -1)]
    return [straight, *bent, *((one - problem.flow.center) @ problem.flow.inverse.T for one in further)]


def way_down(problem: HamiltonianProblem, beside: np.ndarray | None, last: np.ndarray) -> np.ndarray | None:
    """The way down taken backwards: V falls along it, so that it crosses no ridge, but it may wind."""
    if beside is None or problem.unstable is None:
        return None
    down = (beside - problem.flow.center) @ problem.flow.inverse.T
    far = down[np.linalg.norm(down - problem.end, axis=1) >= APPROACH]
    return np.vstack([far[::-1], last])


def _before(problem: HamiltonianProblem, beside: np.ndarray | None, arrival: np.ndarray) -> np.ndarray:
    """A state before the saddle, on the side of A."""
    side = np.sign(problem.left @ -problem.end)
    if beside is not None:
        down = (beside - problem.flow.center) @ problem.flow.inverse.T
        far = np.flatnonzero(np.linalg.norm(down - problem.end, axis=1) >= APPROACH)
        side = np.sign(problem.left @ (down[far[0]] - problem.end))
    return np.asarray(problem.end + side * APPROACH * arrival / np.linalg.norm(arrival))


def followed(problem: HamiltonianProblem, curve: np.ndarray) -> Solution | None:
    """The solution at the end of a curve, None where one of the steps fails."""
    outside = np.linalg.norm(curve, axis=1) >= FIRST
    curve = curve[int(np.flatnonzero(~outside).max(initial=0)) + 1 :]
    along = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))]

    def at(place: float) -> np.ndarray:
        return np.array([np.interp(place, along, column) for column in curve.T])

    solution = problem.solved(_linear(problem, at(0.0)), problem.fixed(at(0.0)), ROUGH)
    before: tuple[Solution, float] | None = None
    place, step, failed = 0.0, LONGEST, False
    while solution is not None and place < along[-1]:
        ahead = min(place + step, along[-1])
        guess = longer(problem, solution)
        if before is not None:
            guess = _predicted(guess, before[0], (ahead - place) / (place - before[1]))
        moved = problem.solved(guess, problem.fixed(at(ahead)), ROUGH)
        if moved is None:
            step, failed = step / 2, True
            if step < SHORTEST:
                return None
            continue
        before = solution, place
        solution, place = moved, ahead
        step, failed = (step if failed else min(1.5 * step, LONGEST)), False
    return solution


def _linear(problem: HamiltonianProblem, last: np.ndarray) -> Solution:
    """The way to a point close to A, were f linear: q = y there."""
    back = scipy.linalg.expm(-SPIRAL / problem.fastest * problem.growth)
    y = [last]
    while np.linalg.norm(y[-1]) > START and len(y) < MOST_NODES:
        y.append(back @ y[-1])
    states = np.array(y[::-1])
    times = SPIRAL / problem.fastest * np.arange(1 - len(y), 1)
    return interpolated(times, np.concatenate([states, states], axis=1))


def longer(problem: HamiltonianProblem, solution: Solution) -> Solution:
    """The same at evenly spaced times, begun so close to A as the power series asks for."""
    first = solution.at(solution.times[:1])[: problem.dimension, 0]
    if np.linalg.norm(first) > START:
        before = _linear(problem, first)
        times = np.r_[before.times[:-1] + solution.times[0], solution.times]
        states = np.concatenate([before.at(before.times[:-1]), solution.at(solution.times)], axis=1)
        solution = interpolated(times, states.T)
    count = int(-solution.times[0] * problem.fastest / SPIRAL) + 2
    return Solution(solution.at, np.linspace(solution.times[0], 0.0, count))


def onward(problem: HamiltonianProblem, solution: Solution, distance: float) -> Solution:
    """The same, continued by the linear equations to a distance from the saddle."""
    d, rate = problem.dimension, problem.unstable
    assert rate is not None
    final = solution.at(np.zeros(1))[:, 0]
    fastest = np.abs(np.linalg.eigvals(problem.jacobian)).max()
    step = SPIRAL / fastest
    whole = np.block([[problem.jacobian, 2 * problem.noise], [np.zeros((d, d)), -problem.jacobian.T]])
    flow = scipy.linalg.expm(step * whole)
    states = [np.concatenate([final[:d] - problem.end, final[d:]])]
    height = float(problem.left @ states[0][:d])
    while np.linalg.norm(states[-1][:d]) > distance and len(states) < MOST_NODES:
        ahead = flow @ states[-1]
        height *= np.exp(-step * rate)
        # What grows is not there: of the two parts along w either follows from the height.
        ahead[:d] += problem.right * (height - problem.left @ ahead[:d])
        ahead[d:] = -rate * height / problem.push * problem.left
        states.append(ahead)
    further = np.array(states[1:]).reshape(-1, 2 * d) + np.r_[problem.end, np.zeros(d)]
    times = np.r_[solution.times, step * np.arange(1, len(states))]
    rows = np.concatenate([solution.at(solution.times).T, further])
    return interpolated(times - times[-1], rows)


def _predicted(guess: Solution, before: Solution, share: float) -> Solution:
    """A solution moved on by a share of what it has moved from the one before, as far as both go back."""

    def at(times: np.ndarray) -> np.ndarray:
        own, common = guess.at(times), times >= before.times[0]
        own[:, common] += share * (own[:, common] - before.at(times[common]))
        return own

    return Solution(at, guess.times)
