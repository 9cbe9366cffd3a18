"""Characteristics of the Hamilton–Jacobi equation: V along curves that leave an attractor, and its errors.

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
with less action: see `lowest_sheet`. Curves leave an attractor at rates that differ by direction, so that
evenly spread starts end in a few bundles; new curves are put between neighbours that end far apart.

Where V is a formula, the curve that ends at x is the ascending path ``dx/dt = f + 2D∇V``, which can be
followed back. Changes δf and δD change V, to first order, by ``δV(x) = -∫ (p·δf + p·δD p) dt`` along it: the
action is stationary there, so that the path itself need not be changed. The integral is linear in the
coefficients of f and of D; their covariance does the rest.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from enum import IntEnum
from functools import cached_property, partial
from typing import Any, cast

import numpy as np
from scipy.spatial import ConvexHull, cKDTree

from siq.inference.field_estimate import AnyField, FieldEstimate
from siq.numerics.integration import dormand_prince_step, next_step
from siq.quasipotential.power_series import quasipotential_series
from siq.systems.dynamics import Dynamics
from siq.systems.equilibria import hessian_at

NO_ACTION = 1e-7  # of ∫|f||φ'|ds: less is a path without noise
Function = Callable[[np.ndarray], np.ndarray]
norm = cast(Function, partial(np.linalg.norm, axis=1))


class ScaledSystem:
    """f, D and Hamilton's equations of the states y, ``x = center + units y``, with actions in a `unit`.

    Times are in units of ``1/rate``. A momentum q of y is ``p = unit units⁻ᵀ q`` of x, so that
    ``ẏ = F + 2Dq`` and ``q̇ = -∂_y (q·F + q·Dq)`` with F and D, `noise`, in these units.
    """

    def __init__(
        self, dynamics: Dynamics, center: np.ndarray, units: np.ndarray, *, unit: float, rate: float = 1.0
    ) -> None:
        self.dynamics, self.center, self.units, self.inverse = dynamics, center, units, np.linalg.inv(units)
        self.unit, self.rate, self.dimension = unit, rate, dynamics.dimension
        self.noise = dynamics.diffusion.in_units(center, units, unit / rate)
        # Of matrices as rows: a product for each point takes several times as long as one for all.
        self._of_slopes, self._of_bends = np.kron(self.inverse.T / rate, units), np.kron(units, units)

    def points(self, y: np.ndarray) -> np.ndarray:
        """x of y, ``(n, d)``."""
        return self.center + y @ self.units.T

    def scaled(self, x: np.ndarray) -> np.ndarray:
        """y of x, ``(n, d)``."""
        return np.asarray((x - self.center) @ self.inverse.T)

    def momenta(self, q: np.ndarray) -> np.ndarray:
        """p of q, ``(n, d)``."""
        return np.asarray(self.unit * q @ self.inverse)

    def slopes(self, p: np.ndarray) -> np.ndarray:
        """q of p, ``(n, d)``."""
        return np.asarray(p @ self.units / self.unit)

    def curvatures(self, hessians: np.ndarray) -> np.ndarray:
        """Second derivatives of V by y from those by x, ``(..., d, d)``."""
        return np.asarray(self.units.T @ hessians @ self.units / self.unit)

    def force(self, y: np.ndarray) -> np.ndarray:
        """The drift at y, ``(n, d)``."""
        return self.dynamics.drift(self.points(y)) @ self.inverse.T / self.rate

    def jacobian(self, y: np.ndarray) -> np.ndarray:
        """∂F/∂y, ``(n, d, d)``."""
        slopes = self.dynamics.jacobian(self.points(y))
        return np.asarray((slopes.reshape(len(y), self.dimension**2) @ self._of_slopes).reshape(slopes.shape))

    def bend(self, y: np.ndarray, q: np.ndarray) -> np.ndarray:
        """``Σ_k q_k ∂²F_k + q·∂²D q``, the matrix before X in Ṗ: ``(n, d, d)``."""
        bends = self.dynamics.bend(self.points(y), q @ self.inverse / self.rate)
        second = (bends.reshape(len(y), self.dimension**2) @ self._of_bends).reshape(bends.shape)
        return np.asarray(second if self.noise.constant else second + self.noise.contract(y, q, 2))

    def turned(self, y: np.ndarray, q: np.ndarray) -> np.ndarray:
        """``G_ik = ∂_k F_i + 2 ((∂_k D)q)_i``, ``(n, d, d)``."""
        jacobian = self.jacobian(y)
        return jacobian if self.noise.constant else jacobian + 2 * self.noise.turn(y, q)

    def tangents(self, y: np.ndarray, q: np.ndarray, turned: np.ndarray) -> np.ndarray:
        """The matrix of the linear equations of ``(X, P)``, tangents of y and q: ``(n, 2d, 2d)``."""
        upper = np.concatenate([turned, 2 * self.noise.at(y)], axis=2)
        lower = np.concatenate([-self.bend(y, q), -turned.transpose(0, 2, 1)], axis=2)
        return np.concatenate([upper, lower], axis=1)

    def pull(self, y: np.ndarray, q: np.ndarray, turned: np.ndarray | None = None) -> np.ndarray:
        """q̇ at positions and momenta ``(n, d)``; `turned` where it is known."""
        turned = self.turned(y, q) if turned is None else turned
        # Of the slope of D the turn has twice as much.
        return np.asarray(self.noise.contract(y, q, 1) - np.einsum("nik,ni->nk", turned, q))

    def velocities(
        self, y: np.ndarray, q: np.ndarray, turned: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """ẏ, q̇ and the rate of U at positions and momenta ``(n, d)``; `turned` where it is known."""
        push = self.noise.push(y, q)
        return self.force(y) + 2 * push, self.pull(y, q, turned), 2 * np.sum(q * push, axis=1)

    def residual(self, y: np.ndarray, q: np.ndarray) -> float:
        """The largest Hamiltonian of points ``(n, d)``, in proportion to its parts."""
        force, push = self.force(y), self.noise.contract(y, q)
        drift = np.sum(q * force, axis=1)
        scale = max((np.abs(drift) + push).max(), NO_ACTION * np.sum(force**2, axis=1).max())
        return float(np.abs(drift + push).max() / scale)


class HamiltonianFlow(ScaledSystem):
    """The equations in units in which M is the unit matrix and the level the unit sphere.

    A row of a state is ``y, q, v, X, P``, of length ``2d + 1 + 2d²``, with ``units = (2 level)^½ L⁻¹``,
    ``M = LᵀL`` and ``V = level v`` (of V, not of U); X and P are derivatives of y and q. Tolerances then mean
    the same for states of any size.
    """

    def __init__(self, dynamics: Dynamics, center: np.ndarray, level: float) -> None:
        self.level, self.hessian = level, hessian_at(dynamics, center)
        units = np.sqrt(2 * level) * np.linalg.inv(np.linalg.cholesky(self.hessian).T)
        super().__init__(dynamics, center, units, unit=2 * level)
        rest = np.zeros((1, self.dimension))
        self.relaxation, self.diffusion = self.jacobian(rest)[0], self.noise.at(rest)[0]

    def parts(self, state: np.ndarray) -> tuple[np.ndarray, ...]:
        """y, q, v of rows, and X above P, ``(n, 2d, d)``."""
        d = self.dimension
        frames = state[:, 2 * d + 1 :].reshape(len(state), 2 * d, d)
        return state[:, :d], state[:, d : 2 * d], state[:, 2 * d], frames

    def rates(self, state: np.ndarray) -> np.ndarray:
        """Time derivative of rows."""
        y, q, _, frames = self.parts(state)
        turned, new = self.turned(y, q), np.empty_like(state)
        y_rate, q_rate, v_rate, frames_rate = self.parts(new)
        y_rate[...], q_rate[...], v_rate[...] = self.velocities(y, q, turned)
        frames_rate[...] = self.tangents(y, q, turned) @ frames
        return new

    def orthonormal(self, state: np.ndarray) -> np.ndarray:
        """The same planes of tangents with orthonormal columns, which neither grow nor collapse."""
        y, q, v, frames = self.parts(state)
        frames, upper = np.linalg.qr(frames)
        frames = frames * np.sign(np.diagonal(upper, axis1=1, axis2=2))[:, None, :]  # det X keeps its sign
        return np.concatenate([y, q, v[:, None], frames.reshape(len(state), 2 * self.dimension**2)], axis=1)


MAX_STEPS = 20_000  # numerical, a guard: a curve that takes more is stiff, or circles
END_WIDTH = 2.0**-24  # of the last step, by which it is known where a curve ends
HALVINGS = 8  # of what is left to search, on its cubic
MAX_RELAXATION_TIMES = 60.0  # in units of the slowest relaxation time of the attractor
REST_RATIO = 1e-3  # p to x - A, in units in which both are equal near A
SHEET_DISTANCE = 0.06  # of neighbours, the level being at about 1: more than the gaps of a fan
SHEET_MARGIN = 2e-3  # of the level: by so much sheets are told apart
REAL_RATIO = 1e-3  # imaginary to real part, below which an eigenvalue counts as negative and not as turning


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
    """Characteristics of one attractor, each up to its end: all points before any caustic of their own."""

    #: A, shape ``(d,)``; M, shape ``(d, d)``; and the value of V up to which curves were followed.
    attractor: np.ndarray
    hessian: np.ndarray
    level: float
    #: x, p = ∇V, V (not U) and ∇²V at all n points of all curves, and which curve a point belongs to; sorted
    #: by curve and along it. ∇²V diverges towards a caustic.
    points: np.ndarray
    momenta: np.ndarray
    values: np.ndarray
    hessians: np.ndarray
    curve: np.ndarray
    #: The unit vectors from which the c curves start, in the metric in which M is the unit matrix, shape
    #: ``(c, d)``; and an `End` for every curve.
    directions: np.ndarray
    ends: np.ndarray
    #: Shape ``(k, d)`` and ``(k,)``: where those curves that meet a caustic do so first, and V there.
    caustic_points: np.ndarray
    caustic_values: np.ndarray

    @cached_property
    def metric(self) -> np.ndarray:
        """T, shape ``(d, d)``: in ``T (x - A)`` the level would be the unit sphere, were V quadratic."""
        return np.linalg.cholesky(self.hessian).T / np.sqrt(2 * self.level)

    @property
    def last(self) -> np.ndarray:
        """Index of the last point of every curve, shape ``(c,)``."""
        return np.searchsorted(self.curve, np.arange(len(self.directions)), side="right") - 1

    def lowest_sheet(self) -> np.ndarray:
        """Mask of the points of a fan that may be taken as values of V, shape ``(n,)``.

        A neighbour within `SHEET_DISTANCE` says what V should be at a point by its own V, gradient and
        curvature. Where this is lower than the point's V by more than `SHEET_MARGIN` of the level, the point
        lies on an upper sheet: another curve gets there with less action. It then drops out with all that
        follows on its curve, for what is not optimal once never becomes so again.

        An upper sheet is only seen where the fan has curves of the lower sheet so close, not in its gaps, nor
        where those curves ended at a box or at a caustic; and close to a kink of V, where the sheets differ
        by less than the margin, points of both are kept, too high by at most the margin.
        """
        scaled = (self.points - self.attractor) @ self.metric.T
        eigenvalues, vectors = np.linalg.eigh(self.hessians)
        # Towards a caustic the curvature falls without bound and would predict any depth; it counts as none.
        bends = np.einsum("nij,nj,nkj->nik", vectors, np.maximum(eigenvalues, 0), vectors)
        upper = np.zeros(len(scaled), dtype=bool)
        # So close to the attractor V is smooth, and all curves are neighbours of each other.
        asked = np.flatnonzero(np.linalg.norm(scaled, axis=1) > 2 * SHEET_DISTANCE)
        tree = cKDTree(scaled[asked])
        for block in np.array_split(asked, max(len(asked) // CHUNK, 1)) if len(asked) else ():
            near = tree.query_ball_point(scaled[block], SHEET_DISTANCE)
            at = np.repeat(block, [len(others) for others in near])
            neighbour = asked[np.concatenate([np.asarray(others, dtype=int) for others in near])]
            offset = self.points[at] - self.points[neighbour]
            predicted = self.values[neighbour] + np.sum(offset * self.momenta[neighbour], axis=1)
            predicted += np.einsum("ni,nij,nj->n", offset, bends[neighbour], offset) / 2
            upper[at[predicted < self.values[at] - SHEET_MARGIN * self.level]] = True
        # Points are sorted along curves: whatever follows an upper point on its curve is upper too.
        count = np.cumsum(upper)
        return count == np.r_[0, count][np.searchsorted(self.curve, self.curve)]

    def value_near(self, x: np.ndarray, *, sheet: np.ndarray, distance: float = 0.1) -> np.ndarray:
        """V at points ``(m, d)``, to second order from the nearest point of a sheet, see `lowest_sheet`.

        NaN beyond `distance`, in the metric in which the level is at about 1, and where the second order is
        no small correction, close to a caustic. The error is of third order in the distance; of first where V
        has a kink between x and the nearest point.
        """
        distances, _, values, bend = self.expanded(x, sheet)
        # Towards a caustic ∇²V grows without bound, and two terms no longer tell V.
        known = (distances <= distance) & (np.abs(bend) <= MAX_SECOND_ORDER * self.level)
        return np.where(known, values + bend, np.nan)

    def expanded(self, x: np.ndarray, sheet: np.ndarray) -> tuple[np.ndarray, ...]:
        """Distance of a sheet's nearest point, V there, V at x to first order, and what the second adds."""
        tree = cKDTree((self.points[sheet] - self.attractor) @ self.metric.T)
        distance, nearest = tree.query((x - self.attractor) @ self.metric.T)
        rows = np.flatnonzero(sheet)[nearest]
        offset = x - self.points[rows]
        values = self.values[rows] + np.sum(offset * self.momenta[rows], axis=1)
        bend = np.einsum("ni,nij,nj->n", offset, self.hessians[rows], offset) / 2
        return distance, self.values[rows], values, bend

    def first_caustic(self) -> tuple[np.ndarray, float] | None:
        """The lowest caustic of its curves, and V there, or None; curves in between may meet it lower."""
        if not len(self.caustic_values):
            return None
        lowest = int(np.argmin(self.caustic_values))
        return self.caustic_points[lowest], float(self.caustic_values[lowest])


def characteristics(
    dynamics: Dynamics, attractor: np.ndarray, *, level: float, box: np.ndarray, directions: np.ndarray,
    start: float = 1e-6, start_degree: int = 4, spacing: float = 0.05, tolerance: float = 1e-10,
    most_steps: int = MAX_STEPS,
) -> Fan:  # fmt: skip
    """Follow characteristics to a level of V, a caustic, the rim of a box, or for 60 of the slowest times.

    Parameters
    ----------
    dynamics, attractor
        f, twice differentiable, and D; and A, shape ``(d,)``, a stable equilibrium.
    level, box
        V (not U) at which curves end, such as 0.99 of the barrier of V; and the states' box, ``(d, 2)``.
    directions
        Shape ``(c, d)``: where the curves start; of any length.
    start, start_degree
        V on the first ellipsoid, as a share of the level; and the degree of the power series that gives p, V
        and the tangents there. With degree 2 V is nearly as good, but the tangents are off by ``start ** ½``,
        which can grow to a false caustic where curves draw together. Where f has kinks close to A, 2 remains.
    spacing
        Largest distance between points along a curve; the level is at about 1.
    tolerance
        Local error, relative to the distance from A, to V and to the tangents.
    most_steps
        Of any curve: what takes more, in a stiff system, ends as `End.STALLED`.
    """
    flow = HamiltonianFlow(dynamics, np.asarray(attractor, dtype=float), level)
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    series = quasipotential_series(dynamics, flow.center, degree=start_degree)
    x = flow.center + np.sqrt(start) * directions @ flow.units.T
    rows = [flow.scaled(x), flow.slopes(series.gradients(x)), series.values(x)[:, None] / level]
    rows += [np.broadcast_to(np.eye(flow.dimension).ravel(), (len(x), flow.dimension**2))]
    rows += [flow.curvatures(series.hessians(x)).reshape(len(x), -1)]
    initial = flow.orthonormal(np.concatenate(rows, axis=1))
    time_limit = MAX_RELAXATION_TIMES / np.abs(np.linalg.eigvals(flow.relaxation).real).min()
    box = np.asarray(box, dtype=float)

    def relative(error: np.ndarray, state: np.ndarray) -> np.ndarray:
        place = slice(2 * flow.dimension)
        *_, v, _ = flow.parts(state)
        *_, v_error, frames = flow.parts(error)
        worst = np.maximum(norm(error[:, place]) / norm(state[:, place]), np.abs(v_error) / v)
        return np.maximum(worst, np.linalg.norm(frames, axis=(1, 2))) / tolerance

    def reason(before: np.ndarray, after: np.ndarray) -> np.ndarray:
        """An `End` where a step from `before` to `after` leads to one, otherwise -1."""
        y, _, v, frames = flow.parts(after)
        found, x = np.full(len(after), -1), flow.points(y)
        found[np.any((x < box[:, 0]) | (x > box[:, 1]), axis=1)] = End.BOX
        found[v >= 1] = End.LEVEL
        found[crossed(flow.parts(before)[3][:, : y.shape[1]], frames[:, : y.shape[1]])] = End.CAUSTIC
        return found

    # Many curves at once, each with a step of its own, until each has ended.
    count = len(initial)
    states, times, ends = initial.copy(), np.zeros(count), np.full(count, End.STALLED, dtype=int)
    steps = np.full(count, 0.1 / np.linalg.norm(flow.relaxation, 2))
    last_steps, running = np.zeros(count), np.arange(count)
    kept, kept_curves = [initial], [running]
    for _ in range(most_steps):
        if not len(running):
            break
        rates = flow.rates(states[running])
        step = np.minimum(steps[running], spacing / np.maximum(norm(flow.parts(rates)[0]), 1e-300))
        step = np.minimum(step, time_limit - times[running])
        with np.errstate(all="ignore"):
            new, error = dormand_prince_step(flow.rates, states[running], step, first=rates)
            size = relative(error, states[running])
        accepted = size <= 1
        steps[running] = next_step(step, size)
        ended = np.zeros(len(running), dtype=bool)
        ended[accepted] = reason(states[running[accepted]], new[accepted]) >= 0
        last_steps[running[ended]] = step[ended]
        on = running[accepted & ~ended]
        states[on] = flow.orthonormal(new[accepted & ~ended])
        times[on] += step[accepted & ~ended]
        kept.append(states[on])
        kept_curves.append(on)
        late = times[running] >= time_limit * (1 - 1e-12)
        ends[running[late]] = End.TIME
        # To stay longer would be wrong as well as slow: from there on errors of p grow instead of decay.
        y, q, *_ = flow.parts(states[running])
        resting = norm(q) < REST_RATIO * norm(y)
        ends[running[resting]] = End.REST
        running = running[~(ended | late | resting | (steps[running] < 1e-13 * time_limit))]
    # The last states before the ends within a step: where its cubic ends, and just before and behind that.
    crossing = np.flatnonzero(last_steps)
    before, bracket = states[crossing], np.stack([np.zeros(len(crossing)), last_steps[crossing]])
    index, thrice = np.arange(len(crossing)), np.tile(before, (3, 1))
    first = flow.rates(before)
    around = np.stack([before, dormand_prince_step(flow.rates, before, bracket[1], first=first)[0]])
    while len(index) and (np.ptp(bracket, axis=0) > END_WIDTH * last_steps[crossing]).any():
        width, rise, share = np.ptp(bracket, axis=0), around[1] - around[0], np.zeros((len(index), 1))
        slopes = width[:, None] * flow.rates(np.concatenate(around)).reshape(around.shape)
        bends = 3 * rise - 2 * slopes[0] - slopes[1], slopes[0] + slopes[1] - 2 * rise
        for part in 0.5 ** np.arange(1, HALVINGS + 1):
            at = share + part
            cubic = around[0] + at * (slopes[0] + at * (bends[0] + at * bends[1]))
            share = np.where(reason(before, cubic)[:, None] >= 0, share, at)
        shares = np.sort(np.hstack([share - 2 * part, np.full_like(share, 0.5), share + 2 * part]).T, axis=0)
        inside = bracket[0] + width * np.clip(shares, 0.0, 1.0)
        tried = dormand_prince_step(flow.rates, thrice, inside.ravel(), first=np.tile(first, (3, 1)))[0]
        beyond = np.append(reason(thrice, tried) >= 0, np.ones(len(index), dtype=bool)).reshape(4, -1)
        end, places = 1 + beyond.argmax(axis=0), np.vstack([bracket[0], inside, bracket[1]])
        known = np.concatenate([around[:1], tried.reshape(3, *before.shape), around[1:]])
        bracket, around = (np.stack([each[end - 1, index], each[end, index]]) for each in (places, known))
    kept.append(around[0])
    ends[crossing] = reason(before, around[1])
    curve = np.concatenate([*kept_curves, crossing])
    order = np.argsort(curve, kind="stable")
    curve = curve[order]
    met = (ends[curve] == End.CAUSTIC) & np.append(curve[1:] != curve[:-1], True)
    y, q, v, frames = flow.parts(np.concatenate(kept)[order])
    x_tangents, p_tangents = np.split(frames, 2, axis=1)
    points, momenta, values = flow.points(y), flow.momenta(q), level * v
    # A pseudoinverse, because at a caustic itself X is singular; that Hessian is not handed on.
    hessians = flow.unit * flow.inverse.T @ (p_tangents @ np.linalg.pinv(x_tangents)) @ flow.inverse
    hessians = (hessians + hessians.transpose(0, 2, 1)) / 2
    return Fan(
        flow.center, flow.hessian, level, points[~met], momenta[~met], values[~met], hessians[~met],
        curve[~met], directions, ends, points[met], values[met],
    )  # fmt: skip


def _join(first: Fan, second: Fan) -> Fan:
    """Two fans of the same attractor and level as one; the curves of the second are counted on."""
    second = replace(second, curve=second.curve + len(first.directions))
    names = [one.name for one in fields(Fan)[3:]]  # all but the attractor, the Hessian and the level
    joined: dict[str, Any] = {n: np.concatenate([getattr(first, n), getattr(second, n)]) for n in names}
    return replace(first, **joined)


def crossed(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Whether X has become singular between two tangent frames, ``(n, d, d)``.

    The eigenvalues of ``X_after X_before⁻¹`` start at 1, and can come to lie on the negative axis only
    through zero: a rotation by half a turn takes several steps. Unlike the sign of the determinant this
    sees also two that vanish at once, as they do on the axis of a system with rotational symmetry.
    """
    if not len(before):
        return np.zeros(0, dtype=bool)
    eigenvalues = np.linalg.eigvals(np.linalg.solve(before.transpose(0, 2, 1), after.transpose(0, 2, 1)))
    negative = (eigenvalues.real <= 0) & (np.abs(eigenvalues.imag) <= REAL_RATIO * np.abs(eigenvalues.real))
    return negative.any(axis=1) | (np.linalg.det(after) * np.linalg.det(before) <= 0)


MIN_DIRECTION_DISTANCE = 1e-12  # of directions: what cannot be told apart is not divided further
CHUNK = 2048  # numerical: curves followed together, as fit into the cache
MAX_GAP_PARTS = 8  # into which a gap is divided at once
MAX_SECOND_ORDER = 0.03  # of the level: a larger term of second order is no correction


def _even_directions(dimension: int, count: int, *, generator: np.random.Generator) -> np.ndarray:
    """Unit vectors, shape ``(count, d)``: even in the plane, the first along the first axis; else random."""
    if dimension == 1:
        return np.array([[1.0], [-1.0]])
    if dimension == 2:
        angles = 2 * np.pi * np.arange(count) / count
        return np.stack([np.cos(angles), np.sin(angles)], axis=1)
    directions = generator.normal(size=(count, dimension))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def adapted_fan(
    dynamics: Dynamics, attractor: np.ndarray, *, level: float, box: np.ndarray,
    generator: np.random.Generator, count: int = 64, most: int = 512, rounds: int = 5, gap: float = 0.1,
    **options: Any,
) -> Fan:  # fmt: skip
    """A fan whose curves end close together, as far as a number of curves allows.

    Parameters
    ----------
    dynamics, attractor, level, box, **options
        As for `characteristics`.
    generator
        Draws the first directions where there are more than two states.
    count, most
        Number of curves at first, and at most: in four and more dimensions that is what limits the spread.
    rounds
        How often curves are put in between, up to seven into every gap.
    gap
        Distance between the ends of neighbours that is close enough; the level is at about 1. Where a saddle
        or a caustic parts neighbours, a gap stays however many curves are put into it.
    """
    directions = _even_directions(dynamics.dimension, count, generator=generator)

    def follow(starts: np.ndarray) -> Fan:
        return characteristics(dynamics, attractor, level=level, box=box, directions=starts, **options)

    fan = follow(directions)
    for _ in range(rounds):
        between = _between(fan, gap)[: most - len(fan.directions)]
        if not len(between):
            break
        fan = _join(fan, follow(between))
    return fan


def _between(fan: Fan, gap: float) -> np.ndarray:
    """Directions between neighbours that end further apart than the gap, widest first."""
    directions = fan.directions
    if directions.shape[1] == 1:
        return np.zeros((0, 1))
    if directions.shape[1] == 2:
        order = np.argsort(np.arctan2(directions[:, 1], directions[:, 0]))
        pairs = np.stack([order, np.roll(order, -1)], axis=1)
    else:  # edges of the facets of what the directions span on the sphere
        facets = ConvexHull(directions).simplices
        edges = np.concatenate([facets[:, [a, b]] for a in range(facets.shape[1]) for b in range(a)])
        pairs = np.unique(np.sort(edges, axis=1), axis=0)
    ends = (fan.points[fan.last] - fan.attractor) @ fan.metric.T
    width = np.linalg.norm(ends[pairs[:, 0]] - ends[pairs[:, 1]], axis=1)
    apart = np.linalg.norm(directions[pairs[:, 0]] - directions[pairs[:, 1]], axis=1)
    wide = np.flatnonzero((width > gap) & (apart > MIN_DIRECTION_DISTANCE))
    wide = wide[np.argsort(-width[wide], kind="stable")]
    # Several at once in a very wide gap: a pass takes as long for one curve as for a hundred.
    parts = np.clip(np.ceil(width[wide] / gap), 2, MAX_GAP_PARTS).astype(int)
    first, second = (np.repeat(directions[pairs[wide, side]], parts - 1, axis=0) for side in (0, 1))
    share = np.concatenate([np.arange(1, number) / number for number in parts] or [np.zeros(0)])[:, None]
    middle = (1 - share) * first + share * second
    return middle / np.maximum(np.linalg.norm(middle, axis=1, keepdims=True), MIN_DIRECTION_DISTANCE)


RELAXATIONS = 12.0  # times 1/slowest rate: e^-12 of V is left at the beginning of an ascending path
HEUN_STEP = 0.3  # of 1/fastest rate: Heun's rule is then good to some per cent of an error
MIN_PATH_STEPS, MAX_PATH_STEPS = 200, 4000  # numerical
RUNAWAY_WIDTHS = 3.0  # of the box's width from its middle: a path so far out does not come from the attractor
ARRIVAL_DISTANCE = 0.02  # of the box's width from the attractor: as far a path may begin
MAX_UNKNOWN_SHARE = 0.1  # share of the points whose error may stay unknown, at the rim of a well


def fastest_rate(dynamics: Dynamics, x: np.ndarray, width: np.ndarray) -> float:
    """The 99 % quantile over points of the norm of the Jacobian, states being measured in their widths."""
    width = np.where(width > 0, width, 1.0)
    scaled = dynamics.jacobian(x) * width / width[:, None]
    return float(np.quantile(np.linalg.norm(scaled, axis=(1, 2)), 0.99))


def ascending_integrals(
    gradient: Function, dynamics: Dynamics, x: np.ndarray, integrand: Callable[..., np.ndarray], *,
    middle: np.ndarray, width: np.ndarray, slowest: float, fastest: float,
    fewest_steps: int = MIN_PATH_STEPS, beginning: Callable[[np.ndarray], np.ndarray] | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Integrals over time along the paths ``dx/dt = f + 2D∇V`` that end at points, by Heun's rule.

    Parameters
    ----------
    gradient, dynamics, x
        ∇V, points ``(n, d)`` to ``(n, d)``; f and D; and where the paths end, shape ``(n, d)``.
    integrand
        Of points, ∇V, f and D∇V there: to ``(n, k)``.
    middle, width
        Of the box of the states, shape ``(d,)``: a path that leaves it by `RUNAWAY_WIDTHS` has run away.
    slowest, fastest, fewest_steps
        Rates, and a number of steps, that set how long, and how finely, the paths are followed back.
    beginning
        Of points ``(n, d)``: ``(n, 1)`` to be added where a path begins there. Integrals are then the least
        that they come to, wherever a path begins.

    Returns
    -------
    integrals, beginnings, lost
        Shapes ``(n, k)``, ``(n, d)`` and ``(n,)``: the last is a mask of the paths that run away.
    """
    steps = int(np.clip(RELAXATIONS / slowest * fastest / HEUN_STEP, fewest_steps, MAX_PATH_STEPS))
    step = RELAXATIONS / slowest / steps
    far = RUNAWAY_WIDTHS * np.where(width > 0, width, 1.0)

    def terms(points: np.ndarray) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
        """Velocity backwards, and what the integrand is made of."""
        slope, flow = gradient(points), dynamics.drift(points)
        push = dynamics.diffusion.push(points, slope)
        return -(flow + 2 * push), (points, slope, flow, push)

    beginnings, running, lost = x.copy(), np.arange(len(x)), np.zeros(len(x), dtype=bool)
    least = np.full((len(x), 1), np.inf)
    with np.errstate(over="ignore", invalid="ignore"):
        velocity, parts = terms(x)
        before = integrand(*parts)
        total = np.zeros_like(before)
        for _ in range(steps):
            x = x + step / 2 * (velocity + terms(x + step * velocity)[0])
            inside = (np.abs(x - middle) < far).all(axis=1)
            if not inside.all():
                lost[running[~inside]] = True
                running, x, before = running[inside], x[inside], before[inside]
            if not len(running):
                break
            velocity, parts = terms(x)
            after = integrand(*parts)
            total[running] += step / 2 * (before + after)
            if beginning is not None:
                least[running] = np.fmin(least[running], total[running] + beginning(x))
            before = after
    beginnings[running] = x
    return np.minimum(total, least), beginnings, lost


def _potential_slopes(
    found: FieldEstimate, gradient: Function, attractor: np.ndarray, x: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """∂V/∂Ξ at points, by every coefficient that f might have, and ∂V/∂θ by those of an estimated εD.

    Shapes ``(n, q, d)`` and ``(n, k)``; NaN where no ascending path comes from the attractor.
    """
    dynamics, q, d = found.dynamics, found.library.size, found.library.dimension
    rates = -np.linalg.eigvals(dynamics.jacobian(attractor[None])[0]).real
    places = np.concatenate([x, attractor[None]])
    # Of a few points some state may hardly differ: paths to them use what V allows them in each.
    hessian, offset = hessian_at(dynamics, attractor), x - attractor
    highest = float(np.einsum("ni,ij,nj->n", offset, hessian, offset).max())
    width = np.maximum(np.ptp(places, axis=0), np.sqrt(highest * np.diag(np.linalg.inv(hessian))))
    width = np.where(width > 0, width, 1.0)

    def by_coefficients(
        points: np.ndarray, slope: np.ndarray, flow: np.ndarray, push: np.ndarray
    ) -> np.ndarray:
        of_field = np.einsum("nq,nd->nqd", found.library.evaluate(points), slope).reshape(len(points), -1)
        return np.column_stack([of_field, found.noise_slopes(points, slope)])

    total, beginnings, lost = ascending_integrals(
        gradient, dynamics, x, by_coefficients, middle=(places.max(axis=0) + places.min(axis=0)) / 2,
        width=width, slowest=rates.min(), fastest=fastest_rate(dynamics, x, width),
    )  # fmt: skip
    lost |= ~(np.abs(beginnings - attractor) < ARRIVAL_DISTANCE * width).all(axis=1)
    total = np.where(lost[:, None], np.nan, -total)
    return total[:, : q * d].reshape(-1, q, d), total[:, q * d :]


def _potential_errors(
    found: AnyField, gradient: Function, attractor: np.ndarray, x: np.ndarray
) -> np.ndarray:
    """Standard errors of ``V(x) - V(attractor)``, shape ``(n,)``, from what is not known of f and of D.

    `gradient` is ∇V, points ``(n, d)`` to ``(n, d)``. They are zero where f carries no noise, and NaN where
    no ascending path comes from the attractor.
    """
    if isinstance(found, Dynamics) or found.noise_free or not len(x):
        return np.zeros(len(x))
    of_field, of_noise = _potential_slopes(found, gradient, attractor, x)
    return np.asarray(np.sqrt(found.variance(of_field) + found.noise_variance(of_noise)))


def relative_error(
    found: AnyField, gradient: Function, attractor: np.ndarray, x: np.ndarray, values: np.ndarray
) -> float:
    """Root mean square of the standard errors of V (`_potential_errors`) over that of its values at points.

    Infinite where the errors of more than a tenth of the points cannot be told.
    """
    errors = _potential_errors(found, gradient, attractor, x)
    if not errors.any():
        return 0.0
    known = np.isfinite(errors)
    if known.mean() < 1 - MAX_UNKNOWN_SHARE:
        return np.inf
    return float(np.linalg.norm(errors[known]) / np.linalg.norm(values[known]))
