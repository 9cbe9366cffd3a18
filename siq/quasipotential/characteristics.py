"""Characteristics of the Hamilton–Jacobi equation: V along curves that leave an attractor.

Positions x, momenta p, the value V along the way, and the tangents (X, P) that tell how neighbouring
trajectories lie. The equations stand in `siq.quasipotential.characteristics`; here they are evaluated for
many rows at once.

From the Hamiltonian ``H = p·f + p·Dp`` with ``p = ∇V``:

    ẋ = f + 2Dp,    ṗ_k = -(Jᵀp)_k - p·(∂_k D)p,    V̇ = p·Dp,

started on a small ellipsoid around the attractor A, where ``p = M (x - A)`` and ``V = ½ (x - A)·M (x - A)``
with the first few corrections. No ansatz enters: within its limits this is a reference against which formulas
are judged.

Neighbouring curves may meet. With the curves go their tangents ``X = ∂x, P = ∂p`` with respect to the start,

    Ẋ = G X + 2D P,    Ṗ = -Gᵀ P - (Σ_k p_k ∇²f_k + p·∇²D p) X,    ∇²V = P X⁻¹,

with ``G_ik = J_ik + 2 ((∂_k D)p)_i``, which is J where D is constant; and where ``det X`` vanishes
lies a *caustic*: V has no derivative there, and what the curve carries beyond is not the quasipotential.
Every curve ends at its first caustic. A curve can lose its meaning before that, where another sheet arrives
with less action: see `lowest_sheet`.

Curves leave an attractor at rates that differ by direction, so that evenly spread starts end in a few bundles
along the fastest directions. New curves are therefore put between neighbours that end far apart.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum
from functools import cached_property
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull, cKDTree

from siq.numerics.integration import dormand_prince_step, next_step
from siq.quasipotential.power_series import quasipotential_series
from siq.systems.dynamics import Dynamics
from siq.systems.equilibria import hessian_at


class HamiltonianFlow:
    """The equations in units in which M is the unit matrix and the level the unit sphere.

    A row of a state is ``y, q, v, X, P``, of length ``2d + 1 + 2d²``, with ``x = A + units y``, ``units =
    (2 level)^½ L⁻¹``, ``M = LᵀL``, ``p = (2 level)^½ Lᵀ q`` and ``V = level v``; X and P are derivatives of y
    and q. Tolerances then mean the same for states of any size.

    Parameters
    ----------
    dynamics
        f, twice differentiable.
    center
        The attractor A, shape ``(d,)``.
    level
        The value of V, not of U = 2V, that becomes 1.
    """

    def __init__(self, dynamics: Dynamics, center: np.ndarray, level: float) -> None:
        self.dynamics, self.center, self.level = dynamics, center, level
        self.dimension = dynamics.dimension
        self.hessian = hessian_at(dynamics, center)
        upper = np.linalg.cholesky(self.hessian).T
        self.units = np.sqrt(2 * level) * np.linalg.inv(upper)
        self.inverse = upper / np.sqrt(2 * level)
        self.noise = dynamics.diffusion.in_units(center, self.units, 2 * level)
        self.constant = dynamics.diffusion.constant
        self.diffusion = self.noise.at(np.zeros((1, self.dimension)))
        self.jacobian = self.inverse @ dynamics.jacobian(center[None])[0] @ self.units

    def parts(self, state: np.ndarray) -> tuple[np.ndarray, ...]:
        """y, q, v, X, P of rows."""
        d = self.dimension
        tangents = state[:, 2 * d + 1 :].reshape(len(state), 2, d, d)
        return state[:, :d], state[:, d : 2 * d], state[:, 2 * d], tangents[:, 0], tangents[:, 1]

    def rates(self, state: np.ndarray) -> np.ndarray:
        """Time derivative of rows."""
        y, q, _, x_tangents, p_tangents = self.parts(state)
        turned, diffusion, bend = self.linear(y, q)
        new = np.empty_like(state)
        y_rate, q_rate, v_rate, x_rate, p_rate = self.parts(new)
        y_rate[...], q_rate[...], v_rate[...] = self.velocities(y, q, turned)
        x_rate[...] = turned @ x_tangents + 2 * diffusion @ p_tangents
        p_rate[...] = -turned.transpose(0, 2, 1) @ p_tangents - bend @ x_tangents
        return new

    def velocities(
        self, y: np.ndarray, q: np.ndarray, turned: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """ẏ, q̇ and v̇ at positions and momenta ``(n, d)``; `turned` is that of `linear`, where it is known."""
        force = self.dynamics.drift(self.points(y)) @ self.inverse.T
        push = (self.at(y) @ q[:, :, None])[:, :, 0]
        if turned is None:
            turned = self.inverse @ self.dynamics.jacobian(self.points(y)) @ self.units
            turned = turned if self.constant else turned + 2 * self.noise.turn(y, q)
        pulled = -(turned.transpose(0, 2, 1) @ q[:, :, None])[:, :, 0]
        if not self.constant:  # of which the turn has twice as much
            pulled += self.noise.contract(y, q, 1)
        return force + 2 * push, pulled, 2 * np.sum(q * push, axis=1)

    def linear(self, y: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """G, D and the matrix before X in Ṗ, at positions and momenta: ``(n, d, d)`` each."""
        x, p = self.points(y), 2 * self.level * q @ self.inverse
        turned = self.inverse @ self.dynamics.jacobian(x) @ self.units
        bend = self.units.T @ self.dynamics.bend(x, p) @ self.units / (2 * self.level)
        if self.constant:
            return turned, self.at(y), bend
        return turned + 2 * self.noise.turn(y, q), self.at(y), bend + self.noise.contract(y, q, 2)

    def at(self, y: np.ndarray) -> np.ndarray:
        """D at positions, ``(n, d, d)``."""
        if self.constant:
            return np.broadcast_to(self.diffusion, (len(y), self.dimension, self.dimension))
        return self.noise.at(y)

    def points(self, y: np.ndarray) -> np.ndarray:
        """Points in the states' units."""
        return self.center + y @ self.units.T

    def pack(self, x: np.ndarray, p: np.ndarray, values: np.ndarray, hessians: np.ndarray) -> np.ndarray:
        """States that start at points with given V and derivatives."""
        tangents = np.broadcast_to(np.eye(self.dimension), hessians.shape)
        bends = self.units.T @ hessians @ self.units / (2 * self.level)
        rows = [(x - self.center) @ self.inverse.T, p @ self.units / (2 * self.level)]
        rows += [values[:, None] / self.level, tangents.reshape(len(x), -1), bends.reshape(len(x), -1)]
        return self.orthonormal(np.concatenate(rows, axis=1))

    def unpack(self, state: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Points, momenta, V and its Hessians, in the units of the states."""
        y, q, v, x_tangents, p_tangents = self.parts(state)
        # A pseudoinverse, because at a caustic itself X is singular; that Hessian is not handed on.
        bends = 2 * self.level * self.inverse.T @ (p_tangents @ np.linalg.pinv(x_tangents)) @ self.inverse
        bends = (bends + bends.transpose(0, 2, 1)) / 2
        return self.points(y), 2 * self.level * q @ self.inverse, self.level * v, bends

    def orthonormal(self, state: np.ndarray) -> np.ndarray:
        """The same planes of tangents with orthonormal columns, which neither grow nor collapse."""
        y, q, v, x_tangents, p_tangents = self.parts(state)
        frames, upper = np.linalg.qr(np.concatenate([x_tangents, p_tangents], axis=1))
        frames = frames * np.sign(np.diagonal(upper, axis1=1, axis2=2))[:, None, :]  # det X keeps its sign
        flat = frames.reshape(len(state), 2 * self.dimension**2)
        return np.concatenate([y, q, v[:, None], flat], axis=1)


MOST_STEPS = 20_000  # numerical, a guard: a curve that takes more is stiff, or circles
HALVINGS = 26  # of the last step, to find where a curve ends
LONGEST_TIME = 60.0  # in units of the slowest relaxation time of the attractor
RESTING = 1e-3  # p to x - A, in units in which both are equal near A
STRAIGHT = 1e-3  # imaginary to real part, below which an eigenvalue counts as negative and not as turning


class End(IntEnum):
    """Why a characteristic ends: `REST` is another equilibrium, or a cycle, where p vanishes."""

    LEVEL = 0
    CAUSTIC = 1
    BOX = 2
    REST = 3
    TIME = 4
    STALLED = 5


@dataclass(frozen=True)
class Fan:
    """Characteristics of one attractor, each up to its end; all points lie before any caustic of their own.

    Attributes
    ----------
    attractor, hessian, level
        A, shape ``(d,)``; M, shape ``(d, d)``; and the value of V up to which curves were followed.
    points
        Shape ``(n, d)``, in the states' units: all points of all curves, sorted by curve and along it.
    momenta
        Shape ``(n, d)``: p = ∇V there. The quasipotential U = 2V has the gradient 2p.
    values
        Shape ``(n,)``: V, not U.
    hessians
        Shape ``(n, d, d)``: ∇²V there. It diverges towards a caustic.
    curve
        Shape ``(n,)``: index of the point's curve.
    directions
        Shape ``(c, d)``: the unit vectors from which the c curves start, in the metric in which M is the unit
        matrix.
    ends
        Shape ``(c,)``: an `End` for every curve.
    caustic_points, caustic_values, caustic_curves
        Shape ``(k, d)``, ``(k,)`` and ``(k,)``: where curves first meet a caustic, and V there.
    """

    attractor: np.ndarray
    hessian: np.ndarray
    level: float
    points: np.ndarray
    momenta: np.ndarray
    values: np.ndarray
    hessians: np.ndarray
    curve: np.ndarray
    directions: np.ndarray
    ends: np.ndarray
    caustic_points: np.ndarray
    caustic_values: np.ndarray
    caustic_curves: np.ndarray

    @cached_property
    def metric(self) -> np.ndarray:
        """T, shape ``(d, d)``: in ``T (x - A)`` the level would be the unit sphere, were V quadratic."""
        return np.linalg.cholesky(self.hessian).T / np.sqrt(2 * self.level)

    @property
    def last(self) -> np.ndarray:
        """Index of the last point of every curve, shape ``(c,)``."""
        return np.searchsorted(self.curve, np.arange(len(self.directions)), side="right") - 1


def characteristics(
    dynamics: Dynamics,
    attractor: np.ndarray,
    *,
    level: float,
    box: np.ndarray,
    directions: np.ndarray,
    start: float = 1e-6,
    start_degree: int = 4,
    spacing: float = 0.05,
    time_limit: float | None = None,
    tolerance: float = 1e-10,
    most_steps: int = MOST_STEPS,
) -> Fan:
    """Follow characteristics until V reaches a level, a caustic is met, or a box or a time limit is left.

    Parameters
    ----------
    dynamics
        f, twice differentiable.
    attractor
        A, shape ``(d,)``, a stable equilibrium.
    level
        V (not U) at which curves end, such as 0.99 of the barrier of V.
    box
        Shape ``(d, 2)``, in the states' units.
    directions
        Shape ``(c, d)``: where the curves start; of any length. See `siq.quasipotential.characteristics`.
    start
        V on the first ellipsoid, as a share of the level.
    start_degree
        Degree of the power series that gives p, V and the tangents there; 2 is the quadratic form of M
        alone. With it V is nearly as good, but the tangents are off by ``start ** ½``, which can grow to a
        false caustic where curves draw together. Where f has kinks close to A, 2 is what remains.
    spacing
        Largest distance between points along a curve; the level is at about 1.
    time_limit
        In time units; by default 60 of the slowest relaxation times.
    tolerance
        Local error, relative to the distance from A, to V and to the tangents.
    most_steps
        Of any curve: what takes more, in a stiff system, ends as `End.STALLED`.

    Notes
    -----
    Curves that cross without a caustic of their own are not noticed here: see
    `lowest_sheet`. Near an attractor with different rates most directions end close
    together: see `adapted_fan`. Past another equilibrium errors grow, so that a level
    far above the barrier gives less accurate curves.
    """
    flow = HamiltonianFlow(dynamics, np.asarray(attractor, dtype=float), level)
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    series = quasipotential_series(dynamics, flow.center, degree=start_degree)
    x = flow.center + np.sqrt(start) * directions @ flow.units.T
    initial = flow.pack(x, series.gradient(x), series.evaluate(x), series.hessian(x))
    if time_limit is None:
        time_limit = LONGEST_TIME / np.abs(np.linalg.eigvals(flow.jacobian).real).min()

    run = _Run(flow, np.asarray(box, dtype=float), spacing, time_limit, tolerance, most_steps)
    states, curve, ends = run.follow(initial)
    met = ends[curve] == End.CAUSTIC
    met &= np.append(curve[1:] != curve[:-1], True)
    points, momenta, values, hessians = flow.unpack(states)
    return Fan(
        attractor=flow.center,
        hessian=flow.hessian,
        level=level,
        points=points[~met],
        momenta=momenta[~met],
        values=values[~met],
        hessians=hessians[~met],
        curve=curve[~met],
        directions=directions,
        ends=ends,
        caustic_points=points[met],
        caustic_values=values[met],
        caustic_curves=curve[met],
    )


def join(first: Fan, second: Fan) -> Fan:
    """Two fans of the same attractor and level as one; the curves of the second are counted on."""
    shift = len(first.directions)

    def both(name: str) -> np.ndarray:
        return np.concatenate([getattr(first, name), getattr(second, name)])

    return replace(
        first,
        points=both("points"),
        momenta=both("momenta"),
        values=both("values"),
        hessians=both("hessians"),
        curve=np.concatenate([first.curve, second.curve + shift]),
        directions=both("directions"),
        ends=both("ends"),
        caustic_points=both("caustic_points"),
        caustic_values=both("caustic_values"),
        caustic_curves=np.concatenate([first.caustic_curves, second.caustic_curves + shift]),
    )


class _Run:
    """Many curves at once, each with a step of its own, until each has ended."""

    def __init__(
        self,
        flow: HamiltonianFlow,
        box: np.ndarray,
        spacing: float,
        time_limit: float,
        tolerance: float,
        most_steps: int,
    ) -> None:
        self.flow, self.box, self.spacing = flow, box, spacing
        self.time_limit, self.tolerance, self.most_steps = time_limit, tolerance, most_steps

    def follow(self, initial: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """States of all points, the curve of each, and why each curve ends."""
        count = len(initial)
        states, times, ends = initial.copy(), np.zeros(count), np.full(count, End.STALLED, dtype=int)
        steps = np.full(count, 0.1 / np.linalg.norm(self.flow.jacobian, 2))
        last_steps = np.zeros(count)
        running = np.arange(count)
        kept, kept_curves = [initial], [running]
        for _ in range(self.most_steps):
            if not len(running):
                break
            step = np.minimum(steps[running], self._longest(states[running]))
            step = np.minimum(step, self.time_limit - times[running])
            with np.errstate(all="ignore"):
                new, error = dormand_prince_step(self.flow.rates, states[running], step)
                relative = self._relative(error, states[running])
            accepted = relative <= 1
            steps[running] = next_step(step, relative)
            ended = np.zeros(len(running), dtype=bool)
            ended[accepted] = self._ended(states[running[accepted]], new[accepted])
            last_steps[running[ended]] = step[ended]
            on = running[accepted & ~ended]
            states[on] = self.flow.orthonormal(new[accepted & ~ended])
            times[on] += step[accepted & ~ended]
            kept.append(states[on])
            kept_curves.append(on)
            late = times[running] >= self.time_limit * (1 - 1e-12)
            ends[running[late]] = End.TIME
            resting = self._resting(states[running])
            ends[running[resting]] = End.REST
            stalled = steps[running] < 1e-13 * self.time_limit
            running = running[~(ended | late | resting | stalled)]
        crossing = np.flatnonzero(last_steps)
        final, ends[crossing] = self._locate(states[crossing], last_steps[crossing])
        all_states = np.concatenate([*kept, final])
        curves = np.concatenate([*kept_curves, crossing])
        order = np.argsort(curves, kind="stable")
        return all_states[order], curves[order], ends

    def _longest(self, state: np.ndarray) -> np.ndarray:
        y_rate = self.flow.parts(self.flow.rates(state))[0]
        return self.spacing / np.maximum(np.linalg.norm(y_rate, axis=1), 1e-300)

    def _relative(self, error: np.ndarray, state: np.ndarray) -> np.ndarray:
        y, q, v, _, _ = self.flow.parts(state)
        y_error, q_error, v_error, x_error, p_error = self.flow.parts(error)
        distance = np.linalg.norm(np.concatenate([y, q], axis=1), axis=1)
        worst = np.linalg.norm(np.concatenate([y_error, q_error], axis=1), axis=1) / distance
        worst = np.maximum(worst, np.abs(v_error) / v)
        frames = np.concatenate([x_error, p_error], axis=1)
        return np.maximum(worst, np.linalg.norm(frames, axis=(1, 2))) / self.tolerance

    def _resting(self, state: np.ndarray) -> np.ndarray:
        # To stay longer would be wrong as well as slow: from there on errors of p grow instead of decay.
        y, q, _, _, _ = self.flow.parts(state)
        return np.linalg.norm(q, axis=1) < RESTING * np.linalg.norm(y, axis=1)

    def _ended(self, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        return self._reason(before, after) >= 0

    def _reason(self, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        """An `End` where a step from `before` to `after` leads to one, otherwise -1."""
        y, _, v, tangents, _ = self.flow.parts(after)
        reason = np.full(len(after), -1)
        x = self.flow.points(y)
        reason[np.any((x < self.box[:, 0]) | (x > self.box[:, 1]), axis=1)] = End.BOX
        reason[v >= 1] = End.LEVEL
        reason[crossed(self.flow.parts(before)[3], tangents)] = End.CAUSTIC
        return reason

    def _locate(self, before: np.ndarray, step: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The last states before the ends within a step, and the reasons."""
        low, high, reason = np.zeros(len(step)), step.copy(), np.full(len(step), -1)
        for _ in range(HALVINGS):
            middle = (low + high) / 2
            found = self._reason(before, dormand_prince_step(self.flow.rates, before, middle)[0])
            reason = np.where(found >= 0, found, reason)
            low, high = np.where(found >= 0, low, middle), np.where(found >= 0, middle, high)
        state = dormand_prince_step(self.flow.rates, before, low)[0]
        final = dormand_prince_step(self.flow.rates, before, high)[0]
        return state, self._reason(before, final)


def crossed(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Whether X has become singular between two tangent frames, ``(n, d, d)``.

    The eigenvalues of ``X_after X_before⁻¹`` start at 1, and can come to lie on the negative axis only
    through zero: a rotation by half a turn takes several steps. Unlike the sign of the determinant this
    sees also two that vanish at once, as they do on the axis of a system with rotational symmetry.
    """
    if not len(before):
        return np.zeros(0, dtype=bool)
    eigenvalues = np.linalg.eigvals(np.linalg.solve(before.transpose(0, 2, 1), after.transpose(0, 2, 1)))
    negative = (eigenvalues.real <= 0) & (np.abs(eigenvalues.imag) <= STRAIGHT * np.abs(eigenvalues.real))
    return negative.any(axis=1) | (np.linalg.det(after) * np.linalg.det(before) <= 0)


CLOSEST = 1e-12  # of directions: what cannot be told apart is not divided further
CHUNK = 2048  # numerical: curves followed together, as fit into the cache
MOST_PARTS = 8  # into which a gap is divided at once
BENT = 0.03  # of the level: a larger term of second order is no correction


@dataclass(frozen=True)
class Caustic:
    """Where the quasipotential of a fan first has no derivative for lack of a single direction.

    Attributes
    ----------
    position
        Shape ``(d,)``.
    value
        V there, not U.
    """

    position: np.ndarray
    value: float


def even_directions(dimension: int, count: int, *, generator: np.random.Generator) -> np.ndarray:
    """Unit vectors, shape ``(count, d)``: even in the plane, the first along the first axis; else random."""
    if dimension == 1:
        return np.array([[1.0], [-1.0]])
    if dimension == 2:
        angles = 2 * np.pi * np.arange(count) / count
        return np.stack([np.cos(angles), np.sin(angles)], axis=1)
    directions = generator.normal(size=(count, dimension))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def adapted_fan(
    dynamics: Dynamics,
    attractor: np.ndarray,
    *,
    level: float,
    box: np.ndarray,
    generator: np.random.Generator,
    count: int = 64,
    most: int = 512,
    rounds: int = 5,
    gap: float = 0.1,
    **options: Any,
) -> Fan:
    """A fan whose curves end close together, as far as a number of curves allows.

    Parameters
    ----------
    dynamics, attractor, level, box, **options
        As for `characteristics`.
    generator
        Draws the first directions where there are more than two states.
    count, most
        Number of curves at first, and at most.
    rounds
        How often curves are put in between, up to seven into every gap.
    gap
        Distance between the ends of neighbours that is close enough; the level is at about 1.

    Returns
    -------
    Fan
        In the order in which the curves were added. Where a saddle or a caustic parts neighbours, a gap stays
        however many curves are put into it. In four and more dimensions `most` is what limits the spread.
    """
    directions = even_directions(dynamics.dimension, count, generator=generator)

    def follow(starts: np.ndarray) -> Fan:
        return characteristics(dynamics, attractor, level=level, box=box, directions=starts, **options)

    fan = follow(directions)
    for _ in range(rounds):
        between = _between(fan, gap)[: most - len(fan.directions)]
        if not len(between):
            break
        fan = join(fan, follow(between))
    return fan


def first_caustic(fan: Fan) -> Caustic | None:
    """The lowest caustic that a curve of the fan meets, or None.

    V is the value along the curve. The lowest sheet may have ended before; and curves between those of the
    fan may meet the caustic a little lower.
    """
    if not len(fan.caustic_values):
        return None
    lowest = int(np.argmin(fan.caustic_values))
    return Caustic(fan.caustic_points[lowest], float(fan.caustic_values[lowest]))


def lowest_sheet(fan: Fan, *, distance: float = 0.06, margin: float = 2e-3) -> np.ndarray:
    """Which points may be taken as values of V: no neighbour says that less action would do.

    A neighbour within `distance` says what V should be at a point by its own V, gradient and curvature. Where
    this is lower than the point's V by more than the margin, the point lies on an upper sheet: another curve
    gets there with less action. It then drops out with all that follows on its curve, for what is not
    optimal once never becomes so again.

    Parameters
    ----------
    fan
        Curves about one attractor.
    distance
        In the metric in which the level is at about 1. Should exceed the gaps of the fan.
    margin
        As a share of the level.

    Returns
    -------
    numpy.ndarray
        Shape ``(n,)``, a mask of the fan's points.

    Notes
    -----
    Limits: an upper sheet is only seen where the fan has curves of the lower sheet within `distance`, not
    in its gaps, nor where those curves ended at a box or at a caustic; and close to a kink of V, where
    the sheets differ by less than the margin, points of both are kept, too high by at most the margin.
    """
    scaled = (fan.points - fan.attractor) @ fan.metric.T
    eigenvalues, vectors = np.linalg.eigh(fan.hessians)
    # Towards a caustic the curvature falls without bound and would predict any depth; it counts as none.
    bends = np.einsum("nij,nj,nkj->nik", vectors, np.maximum(eigenvalues, 0), vectors)
    upper = np.zeros(len(scaled), dtype=bool)
    # So close to the attractor V is smooth, and all curves are neighbours of each other.
    asked = np.flatnonzero(np.linalg.norm(scaled, axis=1) > 2 * distance)
    if not len(asked):
        return ~upper
    tree = cKDTree(scaled[asked])
    for block in np.array_split(asked, max(len(asked) // CHUNK, 1)):
        near = tree.query_ball_point(scaled[block], distance)
        at = np.repeat(block, [len(others) for others in near])
        neighbour = asked[np.concatenate([np.asarray(others, dtype=int) for others in near])]
        offset = fan.points[at] - fan.points[neighbour]
        predicted = fan.values[neighbour] + np.sum(offset * fan.momenta[neighbour], axis=1)
        predicted += np.einsum("ni,nij,nj->n", offset, bends[neighbour], offset) / 2
        upper[at[predicted < fan.values[at] - margin * fan.level]] = True
    # Points are sorted along curves: whatever follows an upper point on its curve is upper too.
    count = np.cumsum(upper)
    before_curve = np.r_[0, count][np.searchsorted(fan.curve, fan.curve)]
    return count == before_curve


def value_near(fan: Fan, x: np.ndarray, *, sheet: np.ndarray, distance: float = 0.1) -> np.ndarray:
    """V at points, to second order from the nearest point of a fan: ``(m, d)`` to ``(m,)``.

    Parameters
    ----------
    fan
        Curves about one attractor.
    x
        Where V is wanted.
    sheet
        Which points of the fan may be used, shape ``(n,)``; see `lowest_sheet`.
    distance
        Beyond it, in the metric in which the level is at about 1, the value is NaN; so it is where the second
        order is no small correction, close to a caustic. The error is of third order in the distance, but
        where V has a kink between x and the nearest point, of first.
    """
    points = fan.points[sheet]
    found, nearest = cKDTree((points - fan.attractor) @ fan.metric.T).query(
        (x - fan.attractor) @ fan.metric.T
    )
    offset = x - points[nearest]
    values = fan.values[sheet][nearest] + np.sum(offset * fan.momenta[sheet][nearest], axis=1)
    bend = np.einsum("ni,nij,nj->n", offset, fan.hessians[sheet][nearest], offset) / 2
    # Towards a caustic ∇²V grows without bound, and two terms no longer tell V.
    known = (found <= distance) & (np.abs(bend) <= BENT * fan.level)
    return np.where(known, values + bend, np.nan)


def _between(fan: Fan, gap: float) -> np.ndarray:
    """Directions between neighbours that end further apart than the gap, widest first."""
    pairs = _neighbours(fan.directions)
    ends = (fan.points[fan.last] - fan.attractor) @ fan.metric.T
    width = np.linalg.norm(ends[pairs[:, 0]] - ends[pairs[:, 1]], axis=1)
    apart = np.linalg.norm(fan.directions[pairs[:, 0]] - fan.directions[pairs[:, 1]], axis=1)
    wide = np.flatnonzero((width > gap) & (apart > CLOSEST))
    wide = wide[np.argsort(-width[wide], kind="stable")]
    # Several at once in a very wide gap: a pass takes as long for one curve as for a hundred.
    parts = np.clip(np.ceil(width[wide] / gap), 2, MOST_PARTS).astype(int)
    first, second = (np.repeat(fan.directions[pairs[wide, side]], parts - 1, axis=0) for side in (0, 1))
    share = np.concatenate([np.arange(1, number) / number for number in parts] or [np.zeros(0)])[:, None]
    middle = (1 - share) * first + share * second
    return middle / np.maximum(np.linalg.norm(middle, axis=1, keepdims=True), CLOSEST)


def _neighbours(directions: np.ndarray) -> np.ndarray:
    """Pairs of neighbours on the sphere of directions, shape ``(k, 2)``."""
    if directions.shape[1] == 1:
        return np.zeros((0, 2), dtype=int)
    if directions.shape[1] == 2:
        order = np.argsort(np.arctan2(directions[:, 1], directions[:, 0]))
        return np.stack([order, np.roll(order, -1)], axis=1)
    facets = ConvexHull(directions).simplices
    size = facets.shape[1]
    edges = np.concatenate([facets[:, [a, b]] for a in range(size) for b in range(a)])
    return np.unique(np.sort(edges, axis=1), axis=0)
