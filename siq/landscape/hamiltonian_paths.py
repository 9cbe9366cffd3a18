"""Paths of least action by Hamilton's equations: the most probable way where noise acts on some states only.

Of a D without inverse no action of a curve can be formed: most curves cannot be followed at all. Its paths of
least action are still the solutions of

    ẋ = f + 2Dp,    ṗ_k = -(Jᵀp)_k - p·(∂_k D)p,    V̇ = p·Dp,

which leave the attractor A where ``p = ∇V``, V being its power series there, and come to the saddle S along
what the linearised equations attract to ``(S, 0)``: with w the left eigenvector of J at S to its unstable
rate λ, and r the right ones to the others,

    p·r = 0,    V_S - V = λ (w·(x - S))² / (2 w·Dw).

The other condition, ``p = -λ w·(x - S)/(w·Dw) w``, follows, as H vanishes from A on; in its place stands how
close to S the solution ends. Both boundary conditions and the equations are solved together, by collocation
on a mesh of its own (`scipy.integrate.solve_bvp`).

The first guess is exact: about A the equations are linear. From there the end is moved along a curve to S, in
steps as long as Newton's method follows, and the solution with it. Curves that differ may lead to paths that
differ. Where V is smooth along a path, the tangents of its neighbours stay apart (`siq.reference.
characteristics`); if they do not, it is no minimum.

References
----------
M. I. Freidlin and A. D. Wentzell, Random Perturbations of Dynamical Systems, Springer 1984, chapter 4.
W.-J. Beyn, IMA J. Numer. Anal. 9 (1990) 379: boundary conditions of orbits between equilibria.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import PchipInterpolator

from siq.dynamics.dynamics import Dynamics
from siq.dynamics.equilibria import classify
from siq.errors import NumericalFailure
from siq.landscape.followed_solutions import ROUGH, curves_to, followed, last_states, longer, onward, way_down
from siq.landscape.hamiltonian_problem import APPROACH, HamiltonianProblem, Solution
from siq.landscape.reversed_motion import reversed_motion
from siq.reference.characteristics import crossed

LAST = 0.002  # of the distance from A to S, in the metric of M: how far from S the end is in the answer
LEAST_SHARE = 0.05  # numerical: of the way to the conditions at the saddle, in one step
NEARER = 3.0  # by so much in one step
SWITCHED, FINE = 1e-5, 1e-6  # relative residuals of collocation, at the saddle and of the answer
APART, COMPARED = 0.03, 400  # of the distance, at so many times: solutions further apart are two
CENTRAL = 0.005  # of the distance to the end: nearer to A points lie no closer together
TURN = 0.05  # of this distance, or of that from A: between two points of the answer
FEWEST, MOST = 400, 20_000  # points of the answer
GAUSS = np.polynomial.legendre.leggauss(3)  # exact to the order of collocation


@dataclass(frozen=True, eq=False)
class HamiltonianPath:
    """A solution of Hamilton's equations from an attractor to a state.

    Attributes
    ----------
    points, momenta
        Shape ``(n, d)``, in the states' units, from the attractor to the end.
    values
        Shape ``(n,)``: V, not U, up to each point.
    times
        Shape ``(n,)``: zero at the last point of the solution; infinite at equilibria, where it does not
        come to.
    error
        By how much V at the end differs from that of the mesh before.
    residual
        Largest ``|p·f + p·Dp|``, as a share of the largest ``|p·f| + p·Dp``.
    smooth
        Whether no neighbour crosses it: only then it is a minimum.
    """

    points: np.ndarray
    momenta: np.ndarray
    values: np.ndarray
    times: np.ndarray
    error: float
    residual: float
    smooth: bool

    @property
    def action(self) -> float:
        """Of the whole path, the barrier of U if the end is a saddle."""
        return 2 * float(self.values[-1])


def hamiltonian_paths(
    dynamics: Dynamics,
    attractor: np.ndarray,
    end: np.ndarray,
    *,
    beside: np.ndarray | None = None,
    tolerance: float = 1e-5,
    curves: Sequence[np.ndarray] = (),
) -> list[HamiltonianPath]:
    """Solutions from an attractor to a state, by rising action, those that are minima first.

    Parameters
    ----------
    dynamics
        f and D, twice differentiable.
    attractor, end
        Shape ``(d,)``; the end is mostly a saddle.
    beside
        A trajectory of f from the saddle to the attractor, shape ``(k, d)``: tells from where the saddle is
        approached, and is itself a curve for the end to move along.
    tolerance
        Of the action, relative.
    curves
        Further curves from the attractor to the end, shape ``(k, d)`` each.

    Raises
    ------
    NumericalFailure
        When the start is no attractor, or no curve leads to a solution.
    """
    if classify(dynamics, attractor).kind != "attractor":
        raise NumericalFailure(
            f"{attractor.tolist()} is no stable equilibrium; where noise acts on some states only, paths are"
            " sought from stable equilibria alone"
        )
    problem = HamiltonianProblem(dynamics, attractor, end)
    found: list[HamiltonianPath] = []
    backwards = _of_reversed_motion(problem, beside)
    known = [] if backwards is None else [backwards]
    path = None if backwards is None else _finished(problem, backwards, tolerance)
    found += [] if path is None else [path]
    for last in last_states(problem, beside):
        solutions = list(known)
        for curve in curves_to(problem, last, curves):
            solution = followed(problem, curve)
            if solution is None or any(not _apart(solution, one, problem.dimension) for one in solutions):
                continue
            solutions.append(solution)
            path = _finished(problem, solution, tolerance)
            found += [] if path is None else [path]
        way = None if found else way_down(problem, beside, last)
        if way is not None and (solution := followed(problem, way)) is not None:
            path = _finished(problem, solution, tolerance)
            found += [] if path is None else [path]
        if found:
            break
    if not found:
        raise NumericalFailure(
            f"no solution of Hamilton's equations was found from {attractor.tolist()} to {end.tolist()}"
        )
    return sorted(found, key=lambda path: (not path.smooth, path.action))


def _of_reversed_motion(problem: HamiltonianProblem, beside: np.ndarray | None) -> Solution | None:
    """The solution next to the way down with velocities reversed, which ends where that does."""
    guess = reversed_motion(problem, beside)
    if guess is None:
        return None
    return problem.solved(guess, problem.fixed(guess.at(np.zeros(1))[: problem.dimension, 0]), ROUGH)


def _apart(one: Solution, two: Solution, dimension: int) -> bool:
    """Whether two solutions that end at one state come from different sides."""
    times = np.linspace(max(one.times[0], two.times[0]), 0.0, COMPARED)
    return bool(np.abs(one.at(times)[:dimension] - two.at(times)[:dimension]).max() > APART)


def _finished(problem: HamiltonianProblem, solution: Solution, tolerance: float) -> HamiltonianPath | None:
    """The path of a solution that ends close to the end: on to it, and solved as finely as is asked."""
    if problem.unstable is None:
        ended: Solution | None = solution
        last = problem.fixed(problem.end)
    else:
        # What winds has to be known better than on the way, or H is not zero where the condition changes.
        known = problem.solved(
            solution, problem.fixed(solution.at(np.zeros(1))[: problem.dimension, 0]), SWITCHED
        )
        if known is None:
            return None
        ended = _as_at_saddle(problem, known)
        distance = APPROACH
        while ended is not None and distance > LAST:
            distance /= NEARER
            ended = onward(problem, ended, distance)
            ended = problem.solved(ended, problem.at_saddle(ended), ROUGH)
        if ended is None:
            return None
        last = problem.at_saddle(ended)
    rough = None if ended is None else problem.solved(longer(problem, ended), last, ROUGH / 10)
    if rough is None:
        return None
    fine: Solution | None = None
    value = _values(problem, rough)[-1]
    for fineness in (FINE, FINE / 10, FINE / 100):
        fine = problem.solved(rough, last, fineness)
        if fine is None:
            return None
        before, value, rough = value, _values(problem, fine)[-1], fine
        if abs(value - before) <= tolerance * value:
            break
    return _path(problem, rough, abs(value - before))


def _as_at_saddle(problem: HamiltonianProblem, solution: Solution) -> Solution | None:
    """A solution that ends somewhere before the saddle, moved to where those end that come to it.

    In steps as long as Newton's method follows: of what other directions have gathered on the way the ends
    that are tried know little, least where they decay about as fast as the path comes to the saddle.
    """
    matrix, right = problem.at_saddle(solution)
    own = matrix @ solution.at(np.zeros(1))[:, 0]
    share, step, moved = 0.0, 1.0, solution
    while share < 1:
        ahead = min(share + step, 1.0)
        new = problem.solved(moved, (matrix, own + ahead * (right - own)), SWITCHED)
        if new is None:
            step /= 2
            if step < LEAST_SHARE:
                return None
            continue
        moved, share = new, ahead
    return moved


def _values(problem: HamiltonianProblem, solution: Solution) -> np.ndarray:
    """V at the nodes of the mesh, and at the end: the last one twice if that is where the mesh ends."""
    length = np.diff(solution.times)
    total = np.zeros(len(length))
    for place, weight in zip(*GAUSS, strict=True):
        z = solution.at(solution.times[:-1] + (1 + place) / 2 * length).T
        y, q = z[:, : problem.dimension], z[:, problem.dimension :]
        total += weight / 2 * length * problem.flow.velocities(y, q)[2]
    first, final = (solution.at(solution.times[[place]])[: problem.dimension].T for place in (0, -1))
    begin = 0.0  # of the power series, v = 2 ∫ q·dy from A on
    for place, weight in zip(*GAUSS, strict=True):
        share = (1 + place) / 2
        begin += weight * float(problem.slope(share * first)[0] @ first[0])
    values = begin + np.r_[0.0, np.cumsum(total)]
    rest = 0.0
    if problem.unstable is not None:
        rest = problem.unstable * float(problem.left @ (final[0] - problem.end)) ** 2 / problem.push
    return np.append(values, values[-1] + rest)


def _path(problem: HamiltonianProblem, solution: Solution, error: float) -> HamiltonianPath:
    d, flow = problem.dimension, problem.flow
    z = solution.at(solution.times).T
    velocity = np.linalg.norm(problem.rates(z.T)[:d].T, axis=1)
    # About A the path may wind: points lie as close as their distance from it, and from the end, asks for.
    pace = velocity / (np.linalg.norm(z[:, :d], axis=1) + CENTRAL)
    measure = np.r_[0.0, np.cumsum((pace[1:] + pace[:-1]) / 2 * np.diff(solution.times))]
    count = int(np.clip(measure[-1] / TURN, FEWEST, MOST))
    times = PchipInterpolator(measure, solution.times)(np.linspace(0.0, measure[-1], count))
    times[0], times[-1] = solution.times[0], 0.0
    z = solution.at(times).T
    places = np.union1d(times, solution.times)
    whole = _values(problem, Solution(solution.at, places))
    values = np.append(whole[np.searchsorted(places, times)], whole[-1])
    y, q = z[:, :d], z[:, d:]
    force = flow.dynamics.drift(flow.points(y)) @ flow.inverse.T
    drift, push = np.sum(q * force, axis=1), problem.flow.velocities(y, q)[2] / 2
    residual = float(np.abs(drift + push).max() / (np.abs(drift) + push).max())
    times = np.r_[-np.inf, times]
    if problem.unstable is not None:
        y, q, times = np.vstack([y, problem.end]), np.vstack([q, np.zeros(d)]), np.append(times, np.inf)
    else:
        values = values[:-1]
    y, q, values = np.vstack([np.zeros(d), y]), np.vstack([np.zeros(d), q]), np.r_[0.0, values]
    return HamiltonianPath(
        flow.points(y), 2 * flow.level * q @ flow.inverse, flow.level * values, times,
        flow.level * error, residual, _smooth(problem, solution),
    )  # fmt: skip


def _smooth(problem: HamiltonianProblem, solution: Solution) -> bool:
    """Whether no neighbour crosses the path, by the tangents of those that leave A beside it."""
    d, times = problem.dimension, solution.times
    middles = (times[1:] + times[:-1]) / 2
    at_nodes, between = (problem.matrices(solution.at(t)).transpose(2, 0, 1) for t in (times, middles))
    first = solution.at(times[:1])[:d].T
    frame = np.linalg.qr(np.concatenate([np.eye(d), problem.curvature(first)[0]]))[0]
    for index, step in enumerate(np.diff(times)):
        k1 = at_nodes[index] @ frame
        k2 = between[index] @ (frame + step / 2 * k1)
        k3 = between[index] @ (frame + step / 2 * k2)
        moved = frame + step / 6 * (k1 + 2 * k2 + 2 * k3 + at_nodes[index + 1] @ (frame + step * k3))
        new, upper = np.linalg.qr(moved)
        new *= np.sign(np.diag(upper))
        if crossed(frame[None, :d], new[None, :d])[0]:
            return False
        frame = new
    return True
