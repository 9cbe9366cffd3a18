"""Characteristics of the Hamilton–Jacobi equation: V along curves that leave an attractor.

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
with less action: see `siq.reference.sheets.lowest_sheet`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum
from functools import cached_property

import numpy as np

from siq.dynamics.dynamics import Dynamics
from siq.numerics.integration import dormand_prince_step, next_step
from siq.reference.hamiltonian import HamiltonianFlow
from siq.reference.power_series import quasipotential_series

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
        Shape ``(c, d)``: where the curves start; of any length. See `siq.reference.sheets`.
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
    `siq.reference.sheets.lowest_sheet`. Near an attractor with different rates most directions end close
    together: see `siq.reference.sheets.adapted_fan`. Past another equilibrium errors grow, so that a level
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
