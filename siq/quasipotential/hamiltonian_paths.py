"""Minimum action paths by Hamilton's equations, where noise acts on some states only.

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

About A the equations are linear, which makes the first guess exact. From there the end is moved along a curve
to S, in steps as long as Newton's method follows. Curves that differ may lead to paths that differ. A path is
a minimum only if the tangents of its neighbours stay apart along it (`siq.quasipotential.characteristics`).

Where friction and noise balance, a particle goes up as it comes down, with its velocity reversed: the way
down, ``x(-t), -v(-t)``, is then a first guess of the whole path, which winds about the attractor as often as
the path does. Along it the noise pushes by ``2 D p_v = v̇ - f_v``, and Hamilton's equation of p_v,
``ṗ_v = -p_x - J_vvᵀ p_v`` where D is constant along v, gives the momenta of x.

References
----------
M. I. Freidlin and A. D. Wentzell, Random Perturbations of Dynamical Systems, Springer 1984, chapter 4.
W.-J. Beyn, IMA J. Numer. Anal. 9 (1990) 379: boundary conditions of orbits between equilibria.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress

import numpy as np
import scipy.linalg
from scipy.integrate import solve_bvp, solve_ivp
from scipy.interpolate import Akima1DInterpolator, PchipInterpolator, PPoly

from siq.errors import NumericalFailure
from siq.quasipotential.characteristics import HamiltonianFlow, crossed
from siq.quasipotential.path_chains import MinimumActionPath, bent_lines, unwound
from siq.quasipotential.power_series import local_series
from siq.systems.dynamics import Dynamics
from siq.systems.equilibria import classify, hessian_at

REST = 1e-5  # |f| at an equilibrium, in units of the flow
MOST_NODES = 50_000  # numerical, a guard on memory
MESH_GROWTH, ENOUGH_NODES = 6, 1000  # times the nodes of a guess, or so many: a finer mesh has no solution

# In units of the distance from A to S, in the metric of M.
START = 0.003  # where solutions begin, and the power series errs by its fifth power
FIRST_END = 0.1  # there the first end lies
LONGEST_STEP = 0.3  # of the end; it is halved where Newton's method does not follow ...
SHORTEST_STEP = 0.004  # ... and a curve given up below this: it leaves the well, or V is not smooth there
BENDS = 2  # directions of curves beside the straight one
APPROACH, LAST_APPROACH = 0.1, 0.002  # how far from S the end is at first, and in the answer
APPROACH_FACTOR = 3.0  # by so much nearer in one step
LEAST_SHARE = 0.05  # numerical: of the way to the conditions at the saddle, in one step
SAME_PATH, COMPARED_TIMES = 0.03, 400  # solutions further apart, at so many times, are two
CENTRAL_SPACING = 0.005  # nearer to A points lie no closer together
SPACING = 0.05  # of the distance from A: between two points of the answer
FEWEST_POINTS, MOST_POINTS = 400, 20_000  # of the answer

SPIRAL_STEP = 0.3  # of the shortest time of the linear equations: steps of a first guess
REVERSED_PACE = 3  # times as many points as a first guess has: momenta are differences of it
REVERSED_ACCURACY = 1e-9  # of the way down, relative: it winds often
ROUGH, SWITCHED, FINE = 1e-3, 1e-5, 1e-6  # residuals of collocation: on the way, at the saddle, of the answer
GAUSS = np.polynomial.legendre.leggauss(3)  # exact to the order of collocation


_States = tuple[np.ndarray, np.ndarray]
"""Backward times, from -T to 0, and the positions and momenta there, ``(2d, n)``."""
_Condition = tuple[np.ndarray, np.ndarray]
"""A matrix before the last position and momentum, and what it gives."""


class _HamiltonianProblem(HamiltonianFlow):
    """Hamilton's equations in units in which M is the unit matrix and the end is at the distance one."""

    def __init__(self, dynamics: Dynamics, attractor: np.ndarray, end: np.ndarray) -> None:
        offset = end - attractor
        level = 0.5 * float(offset @ hessian_at(dynamics, attractor) @ offset)
        if not level > 0:
            raise ValueError(f"the path is to end where it starts, at {attractor.tolist()}")
        super().__init__(dynamics, attractor, level)
        self.end = self.inverse @ offset
        self.series = local_series(dynamics, attractor)
        self.growth = self.relaxation + 2 * self.diffusion  # of what leaves A: ẏ = (J + 2DM) y
        self.fastest = float(np.abs(np.linalg.eigvals(self.growth)).max())
        self.unstable: float | None = None
        kind, speed = classify(dynamics, end), np.abs(self.force(self.end[None])).max()
        if speed >= REST * np.linalg.norm(self.relaxation) or kind.kind != "saddle" or kind.unstable != 1:
            return
        self.at_end = self.jacobian(self.end[None])[0]
        values, left, right = scipy.linalg.eig(self.at_end, left=True)
        place = int(np.argmax(values.real))
        self.unstable, self.left = float(values[place].real), left[:, place].real
        self.right = right[:, place].real / (self.left @ right[:, place].real)
        self.end_noise = self.noise.at(self.end[None])[0]
        self.push = float(self.left @ self.end_noise @ self.left)
        if not self.push > 0:
            raise NumericalFailure(f"the noise does not move states across the saddle {end.tolist()}")
        # Where paths come from: ẏ = J (y - S) + 2Dq with q = -λ/(w·Dw) w e^(-λt). What other directions
        # gather meanwhile is ∫ e^((J + λ)t) dt of what q gives them: since ever, where that is finite, or
        # since the path was far from S, where they decay about as fast as q.
        d = self.dimension
        given = -2 * self.unstable / self.push * self.end_noise @ self.left
        given -= self.right * (self.left @ given)
        block = np.zeros((d + 1, d + 1))
        block[:d, :d], block[:d, d] = self.at_end + self.unstable * np.eye(d), given
        since_ever = self.right - np.linalg.lstsq(block[:d, :d], given, rcond=None)[0]
        lately = self.right + scipy.linalg.expm(-np.log(APPROACH) / self.unstable * block)[:d, d]
        self.arrivals = [since_ever, lately]

    def field(self, z: np.ndarray) -> np.ndarray:
        """Velocities of (y, q), ``(2d, n)`` to ``(2d, n)``."""
        return np.concatenate(self.velocities(z[: self.dimension].T, z[self.dimension :].T)[:2], axis=1).T

    def matrices(self, z: np.ndarray) -> np.ndarray:
        """Their derivatives, ``(2d, n)`` to ``(2d, 2d, n)``."""
        y, q = z[: self.dimension].T, z[self.dimension :].T
        turned = self.turned(y, q)
        rows = [[turned, 2 * self.noise.at(y)], [-self.bend(y, q), -turned.transpose(0, 2, 1)]]
        return np.concatenate([np.concatenate(row, axis=2) for row in rows], axis=1).transpose(1, 2, 0)

    def slope(self, y: np.ndarray) -> np.ndarray:
        """Q of the power series at points, ``(n, d)``."""
        return self.slopes(self.series[0](self.points(y)))

    def curvature(self, y: np.ndarray) -> np.ndarray:
        """∂q/∂y of the power series at points, ``(n, d, d)``."""
        return self.curvatures(self.series[1](self.points(y)))

    def fixed(self, last: np.ndarray) -> _Condition:
        """The condition that y ends at a point, as a matrix before (y, q) and what it gives."""
        return np.eye(self.dimension, 2 * self.dimension), last

    def at_saddle(self, final: np.ndarray) -> _Condition:
        """The conditions at the saddle, as close to it as a solution ends: one more than unknowns."""
        d, rate = self.dimension, self.unstable
        assert rate is not None
        matrix = np.zeros((d + 1, 2 * d))
        matrix[0, :d] = self.left
        matrix[1:, d:] = np.eye(d)
        matrix[1:, :d] = rate / self.push * np.outer(self.left, self.left)
        right = matrix[:, :d] @ self.end
        right[0] = self.left @ final[:d]
        return matrix, right

    def solved(self, guess: _States, last: _Condition, tolerance: float) -> PPoly:
        """The solution with a condition at its end; raises NumericalFailure where none is found.

        As H is conserved, a condition at the saddle is one too many. A further unknown k makes up for it,
        ``ż = F + k ∇H``, along which H would grow: of a solution it comes out as zero.
        """
        d, (matrix, right), (times, states) = self.dimension, last, guess
        further = len(matrix) - d

        def gradient(own: np.ndarray) -> np.ndarray:
            """∇H from what F is, and its derivatives likewise."""
            return np.concatenate([-own[d:], own[:d]])

        def rates(_: np.ndarray, z: np.ndarray, k: np.ndarray | None = None) -> np.ndarray:
            own = self.field(z)
            return own if k is None else own + k[0] * gradient(own)

        def derivatives(_: np.ndarray, z: np.ndarray, k: np.ndarray | None = None) -> object:
            own = self.matrices(z)
            return own if k is None else (own + k[0] * gradient(own), gradient(self.field(z))[:, None])

        def ends(first: np.ndarray, final: np.ndarray, _: np.ndarray | None = None) -> np.ndarray:
            return np.concatenate([first[d:] - self.slope(first[None, :d])[0], matrix @ final - right])

        def slopes(first: np.ndarray, _: np.ndarray, k: np.ndarray | None = None) -> tuple[np.ndarray, ...]:
            own = np.concatenate([-self.curvature(first[None, :d])[0], np.eye(d)], axis=1)
            begin = np.concatenate([own, np.zeros((d + further, 2 * d))])
            final = np.concatenate([np.zeros((d, 2 * d)), matrix])
            return (begin, final) if k is None else (begin, final, np.zeros((2 * d + 1, 1)))

        with np.errstate(all="ignore"):
            try:
                found = solve_bvp(
                    rates, ends, times, states, p=np.zeros(1) if further else None,
                    fun_jac=derivatives, bc_jac=slopes, tol=tolerance, bc_tol=min(tolerance, 1e-6),
                    max_nodes=min(max(MESH_GROWTH * len(times), ENOUGH_NODES), MOST_NODES),
                )  # fmt: skip
            except (ValueError, np.linalg.LinAlgError) as error:  # not finite, where a trial has run away
                raise NumericalFailure("a trial of Newton's method has run away") from error
        if not found.success:
            raise NumericalFailure("Newton's method does not come to a solution of Hamilton's equations")
        return found.sol


def _on_mesh(solution: PPoly) -> _States:
    return solution.x, solution(solution.x)


def hamiltonian_paths(
    dynamics: Dynamics, attractor: np.ndarray, end: np.ndarray, *, beside: np.ndarray | None = None,
    tolerance: float = 1e-5, curves: Sequence[np.ndarray] = (),
) -> list[MinimumActionPath]:  # fmt: skip
    """Solutions from an attractor to a state, by rising action, those that are minima first.

    Parameters
    ----------
    dynamics, attractor, end
        f and D, twice differentiable; and two states, shape ``(d,)``, the end mostly a saddle.
    beside, curves
        A trajectory of f from the saddle to the attractor, shape ``(k, d)``: tells from where the saddle is
        approached, and is itself a curve for the end to move along; and further curves from attractor to end.
    tolerance
        Of the action, relative.

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
    problem = _HamiltonianProblem(dynamics, attractor, end)
    found: list[MinimumActionPath] = []
    known: list[PPoly] = []

    def apart(one: PPoly, two: PPoly) -> bool:
        """Whether two solutions that end at one state come from different sides."""
        times = np.linspace(max(one.x[0], two.x[0]), 0.0, COMPARED_TIMES)
        return bool(np.abs((one(times) - two(times))[: problem.dimension]).max() > SAME_PATH)

    # The end is moved to the end itself, or to states before the saddle on the side of A.
    lasts = [problem.end]
    if problem.unstable is not None:
        side = np.sign(problem.left @ -problem.end)
        if beside is not None:
            down = problem.scaled(beside)
            far = np.flatnonzero(np.linalg.norm(down - problem.end, axis=1) >= APPROACH)
            guess = _reversed_motion(problem, beside, far)
            if guess is not None:
                with suppress(NumericalFailure):
                    known.append(
                        problem.solved(guess, problem.fixed(guess[1][: problem.dimension, -1]), ROUGH)
                    )
                    found.append(_finished(problem, known[0], tolerance))
            side = np.sign(problem.left @ (down[far[0]] - problem.end))
        lasts = [problem.end + side * APPROACH * one / np.linalg.norm(one) for one in problem.arrivals]
    for last in lasts:
        solutions = list(known)
        for curve in (*bent_lines(last, BENDS), *map(problem.scaled, curves)):
            with suppress(NumericalFailure):
                solution = _followed(problem, curve)
                if all(apart(solution, one) for one in solutions):
                    solutions.append(solution)
                    found.append(_finished(problem, solution, tolerance))
        if not found and beside is not None and problem.unstable is not None:
            # The way down taken backwards: V falls along it, so that it crosses no ridge, but it may wind.
            with suppress(NumericalFailure):
                wound = _followed(problem, np.vstack([down[far][::-1], last]))
                found.append(_finished(problem, wound, tolerance))
        if found:
            break
    if not found:
        raise NumericalFailure(
            f"no solution of Hamilton's equations was found from {attractor.tolist()} to {end.tolist()}"
        )
    return sorted(found, key=lambda path: (not path.smooth, path.action))


def _followed(problem: _HamiltonianProblem, curve: np.ndarray) -> PPoly:
    """The solution at the end of a curve; raises NumericalFailure where one of the steps fails."""
    outside = np.linalg.norm(curve, axis=1) >= FIRST_END
    curve = curve[int(np.flatnonzero(~outside).max(initial=0)) + 1 :]
    along = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))]

    def at(place: float) -> np.ndarray:
        return np.array([np.interp(place, along, column) for column in curve.T])

    solution = problem.solved(_linear(problem, at(0.0)), problem.fixed(at(0.0)), ROUGH)
    before: tuple[PPoly, float] | None = None
    place, step, failed = 0.0, LONGEST_STEP, False
    while place < along[-1]:
        ahead = min(place + step, along[-1])
        times, states = _longer(problem, solution)
        if before is not None:
            # Moved on by a share of what it has moved from the one before, as far as both go back.
            common = times >= before[0].x[0]
            moved_by = states[:, common] - before[0](times[common])
            states[:, common] += (ahead - place) / (place - before[1]) * moved_by
        try:
            moved = problem.solved((times, states), problem.fixed(at(ahead)), ROUGH)
        except NumericalFailure:
            step, failed = step / 2, True
            if step < SHORTEST_STEP:
                raise
            continue
        before = solution, place
        solution, place = moved, ahead
        step, failed = (step if failed else min(1.5 * step, LONGEST_STEP)), False
    return solution


def _linear(problem: _HamiltonianProblem, last: np.ndarray) -> _States:
    """The way to a point close to A, were f linear: q = y there."""
    states, times = unwound(problem.growth, np.eye(problem.dimension), last, step=SPIRAL_STEP, level=START**2)
    return times, np.concatenate([states, states], axis=1).T


def _longer(problem: _HamiltonianProblem, solution: PPoly) -> _States:
    """A solution at evenly spaced times, begun so close to A as the power series asks for."""
    times, states = _on_mesh(solution)
    first = states[: problem.dimension, 0]
    if np.linalg.norm(first) > START:
        earlier, before = _linear(problem, first)
        times = np.r_[earlier[:-1] + times[0], times]
        solution = Akima1DInterpolator(times, np.concatenate([before[:, :-1], states], axis=1), axis=1)
    even = np.linspace(times[0], 0.0, int(-times[0] * problem.fastest / SPIRAL_STEP) + 2)
    return even, np.asarray(solution(even))


def _onward(problem: _HamiltonianProblem, solution: PPoly, distance: float) -> _States:
    """A solution continued by the linear equations to a distance from the saddle."""
    d, rate = problem.dimension, problem.unstable
    assert rate is not None
    times, before = _on_mesh(solution)
    step = SPIRAL_STEP / np.abs(np.linalg.eigvals(problem.at_end)).max()
    whole = np.block([[problem.at_end, 2 * problem.end_noise], [np.zeros((d, d)), -problem.at_end.T]])
    flow, at_rest = scipy.linalg.expm(step * whole), np.r_[problem.end, np.zeros(d)]
    states = [before[:, -1] - at_rest]
    height = float(problem.left @ states[0][:d])
    while np.linalg.norm(states[-1][:d]) > distance and len(states) < MOST_NODES:
        ahead = flow @ states[-1]
        height *= np.exp(-step * rate)
        # What grows is not there: of the two parts along w either follows from the height.
        ahead[:d] += problem.right * (height - problem.left @ ahead[:d])
        ahead[d:] = -rate * height / problem.push * problem.left
        states.append(ahead)
    further = np.array(states[1:]).reshape(-1, 2 * d) + at_rest
    times = np.r_[times, step * np.arange(1, len(states))]
    return times - times[-1], np.concatenate([before, further.T], axis=1)


def _reversed_motion(problem: _HamiltonianProblem, beside: np.ndarray, far: np.ndarray) -> _States | None:
    """A first guess of the path to a saddle, which ends before it: the way down with velocities reversed.

    None where states are not positions and their velocities, noise acts on others than velocities, or the way
    down is not known: `far` are its states that are not close to the saddle.
    """
    dynamics, symbols = problem.dynamics, list(problem.dynamics.symbols)
    defined = [(at, symbols.index(one)) for at, one in enumerate(dynamics.formulas) if one in symbols]
    positions, velocities = np.array(defined, dtype=int).reshape(-1, 2).T
    if not np.array_equal(np.sort(np.r_[positions, velocities]), np.arange(len(symbols))):
        return None
    # Noise has to act on velocities alone.
    if not len(far) or any(dynamics.diffusion.formulas[place][place] != 0 for place in positions):
        return None

    def arrives(_: float, x: np.ndarray) -> float:
        return float(np.linalg.norm(problem.scaled(x))) - START

    arrives.terminal = True  # type: ignore[attr-defined]
    step = SPIRAL_STEP / problem.fastest / REVERSED_PACE
    motion = solve_ivp(
        lambda _, x: dynamics.drift(x[None])[0], (0.0, step * MOST_NODES), beside[far[0]], method="DOP853",
        rtol=REVERSED_ACCURACY, atol=REVERSED_ACCURACY * np.abs(beside - problem.center).max(axis=0),
        events=arrives, dense_output=True,
    )  # fmt: skip
    if motion.status != 1:  # it does not come to A
        return None
    down = np.asarray(motion.sol(np.arange(0.0, motion.t[-1], step)[::-1]).T)
    x = down.copy()
    x[:, velocities] *= -1
    noise = dynamics.diffusion.at(x)[:, velocities[:, None], velocities]
    # On the way down velocities change by f_v at their own sign; reversed, they change by the same.
    missing = (dynamics.drift(down) - dynamics.drift(x))[:, velocities]
    momenta = np.zeros_like(x)
    try:
        pushed = np.linalg.solve(2 * noise, missing[:, :, None])[:, :, 0]
    except np.linalg.LinAlgError:
        return None
    momenta[:, velocities] = pushed
    turned = dynamics.jacobian(x)[:, velocities[:, None], velocities]
    momenta[:, positions] = -np.gradient(pushed, step, axis=0) - np.einsum("nij,ni->nj", turned, pushed)
    states = np.concatenate([problem.scaled(x), problem.slopes(momenta)], axis=1).T
    return (step * np.arange(1 - len(x), 1))[::-REVERSED_PACE][::-1], states[:, ::-REVERSED_PACE][:, ::-1]


def _finished(problem: _HamiltonianProblem, solution: PPoly, tolerance: float) -> MinimumActionPath:
    """The path of a solution that ends close to the end: on to it, and solved as finely as is asked."""
    last = problem.fixed(problem.end)
    if problem.unstable is not None:
        # What winds has to be known better than on the way, or H is not zero where the condition changes.
        last = problem.fixed(solution(0.0)[: problem.dimension])
        solution = _as_at_saddle(problem, problem.solved(_on_mesh(solution), last, SWITCHED))
        distance = APPROACH
        while distance > LAST_APPROACH:
            distance /= APPROACH_FACTOR
            guess = _onward(problem, solution, distance)
            solution = problem.solved(guess, problem.at_saddle(guess[1][:, -1]), ROUGH)
        last = problem.at_saddle(solution(0.0))
    fine = problem.solved(_longer(problem, solution), last, ROUGH / 10)
    value = _values(problem, fine, fine.x)[-1]
    for fineness in (FINE, FINE / 10, FINE / 100):
        fine = problem.solved(_on_mesh(fine), last, fineness)
        before, value = value, _values(problem, fine, fine.x)[-1]
        if abs(value - before) <= tolerance * value:
            break
    d, (nodes, z) = problem.dimension, _on_mesh(fine)
    # About A the path may wind: points lie as close as their distance from it, and from the end, asks for.
    pace = np.linalg.norm(problem.field(z)[:d], axis=0) / (np.linalg.norm(z[:d], axis=0) + CENTRAL_SPACING)
    measure = np.r_[0.0, np.cumsum((pace[1:] + pace[:-1]) / 2 * np.diff(nodes))]
    count = int(np.clip(measure[-1] / SPACING, FEWEST_POINTS, MOST_POINTS))
    times = PchipInterpolator(measure, nodes)(np.linspace(0.0, measure[-1], count))
    times[0], times[-1] = nodes[0], 0.0
    places = np.union1d(times, nodes)
    values = _values(problem, fine, places)
    values = np.r_[0.0, values[np.searchsorted(places, times)], values[-1]]
    z = fine(times).T
    residual = problem.residual(z[:, :d], z[:, d:])
    if residual > SWITCHED:  # k is not zero: no solution comes to the saddle from this side
        raise NumericalFailure("H is not zero along what solves the conditions at the saddle")
    z, times = np.vstack([np.zeros(2 * d), z]), np.r_[-np.inf, times]
    if problem.unstable is not None:
        z, times = np.vstack([z, np.r_[problem.end, np.zeros(d)]]), np.append(times, np.inf)
    values, error = problem.unit * values[: len(z)], problem.unit * abs(value - before)
    smooth = _smooth(problem, fine)
    return MinimumActionPath(
        points=problem.points(z[:, :d]), momenta=problem.momenta(z[:, d:]), values=values,
        action=float(values[-1]), error=error, residual=residual,
        converged=smooth and bool(error <= tolerance * values[-1]), times=times, smooth=smooth,
    )  # fmt: skip


def _as_at_saddle(problem: _HamiltonianProblem, solution: PPoly) -> PPoly:
    """A solution that ends somewhere before the saddle, moved to where those end that come to it.

    In steps as long as Newton's method follows: of what other directions have gathered on the way the ends
    that are tried know little, least where they decay about as fast as the path comes to the saddle.
    """
    matrix, right = problem.at_saddle(solution(0.0))
    own = matrix @ solution(0.0)
    share, step = 0.0, 1.0
    while share < 1:
        ahead = min(share + step, 1.0)
        try:
            solution = problem.solved(_on_mesh(solution), (matrix, own + ahead * (right - own)), SWITCHED)
        except NumericalFailure:
            step /= 2
            if step < LEAST_SHARE:
                raise
        else:
            share = ahead
    return solution


def _values(problem: _HamiltonianProblem, solution: PPoly, times: np.ndarray) -> np.ndarray:
    """V at times of a solution, and at the end: the last one twice if that is where they end."""
    d, length = problem.dimension, np.diff(times)
    total, begin = np.zeros(len(length)), 0.0
    first, final = (solution(times[place])[:d] for place in (0, -1))
    for place, weight in zip(*GAUSS, strict=True):
        z = solution(times[:-1] + (1 + place) / 2 * length).T
        total += weight / 2 * length * problem.velocities(z[:, :d], z[:, d:])[2]
        # Of the power series, v = 2 ∫ q·dy from A on.
        begin += weight * float(problem.slope((1 + place) / 2 * first[None])[0] @ first)
    values = begin + np.r_[0.0, np.cumsum(total)]
    rest = 0.0
    if problem.unstable is not None:
        rest = problem.unstable * float(problem.left @ (final - problem.end)) ** 2 / problem.push
    return np.append(values, values[-1] + rest)


def _smooth(problem: _HamiltonianProblem, solution: PPoly) -> bool:
    """Whether no neighbour crosses the path, by the tangents of those that leave A beside it."""
    d, times = problem.dimension, solution.x
    length, one = np.diff(times)[:, None, None], np.eye(2 * d)
    # Over each piece of the mesh the tangents change by a matrix: one step of the rule of Runge and Kutta.
    at_nodes, between = (
        problem.matrices(solution(t)).transpose(2, 0, 1) for t in (times, (times[1:] + times[:-1]) / 2)
    )
    k1 = at_nodes[:-1]
    k2 = between @ (one + length / 2 * k1)
    k3 = between @ (one + length / 2 * k2)
    k4 = at_nodes[1:] @ (one + length * k3)
    frames = [np.linalg.qr(np.vstack([one[:d, :d], problem.curvature(solution(times[0])[None, :d])[0]]))[0]]
    for change in one + length / 6 * (k1 + 2 * k2 + 2 * k3 + k4):
        new, upper = np.linalg.qr(change @ frames[-1])
        frames.append(new * np.sign(np.diag(upper)))
    tangents = np.array(frames)[:, :d]
    return not crossed(tangents[:-1], tangents[1:]).any()
