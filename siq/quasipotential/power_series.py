"""The power series of V at an attractor, order by order (Al'brekht's method).

Around a stable equilibrium A of a smooth f the quasipotential is smooth, and the Hamilton–Jacobi equation
``∇V·(f + D∇V) = 0`` fixes its Taylor coefficients one degree after another. With ``y = x - A``, ``J`` the
Jacobian at A and ``M`` the Hessian of V there, the part of degree k obeys the linear system

    ((J + 2 D M) y) · ∇V_k = - Σ ∇V_a · f_b - Σ ∇V_a · D_e ∇V_c,

with ``2 ≤ a < k, a + b = k + 1`` in the first sum and ``2 ≤ a, c < k, a + c + e = k + 2`` in the second,
where D_e is the part of degree e of D; on the left D is its value at A. The eigenvalues of the left
side are sums of k eigenvalues of -J, never zero at an attractor: the series exists
and is unique once M is chosen as the solution of full rank.

Of many states the third powers alone are affordable. With ``V = ½ yᵀMy + ⅙ T(y, y, y)`` they say

    T(y, y, By) = -(My)·F(y, y) - 2 (My)ᵀ(∂D·y)(My),    B = J + 2DM,

F being the second derivatives of f. In Schur's form of B, which is triangular, each T_i follows from those
before it by Sylvester's equation. So `_cubic_series` takes d⁴ operations, where the system above has d³/6
unknowns. Eigenvectors would do, too, but those of a long chain that turns are all but parallel.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd
import scipy.linalg
import scipy.special
import sympy
from scipy.spatial import cKDTree

from siq.errors import Fault, NumericalFailure
from siq.inference.library import monomial_exponents
from siq.quasipotential.hamilton_jacobi import Expansion, PowerBasis
from siq.systems.cycles import Cycle, closed_orbit, hessians_along
from siq.systems.dynamics import Dynamics
from siq.systems.equilibria import classify, hessian_at
from siq.systems.formulas import compile_formulas, formulas_in_time

MOST_STATES_OF_DEGREE_4 = 8  # beyond, the local series is of degree 3

Function = Callable[[np.ndarray], np.ndarray]


def local_series(dynamics: Dynamics, attractor: np.ndarray) -> tuple[Function, Function]:
    """∇V and ∇²V about an attractor, shape ``(d,)``: points ``(n, d)`` to ``(n, d)`` and ``(n, d, d)``.

    They are those of V to its fourth powers; to its third where states are many.
    """
    if dynamics.dimension <= MOST_STATES_OF_DEGREE_4:
        series = quasipotential_series(dynamics, attractor, degree=4)
        return series.gradients, series.hessians
    square, cube = _cubic_series(dynamics, attractor)

    def gradients(x: np.ndarray) -> np.ndarray:
        y = x - attractor
        return np.asarray(y @ square + np.einsum("ijk,nj,nk->ni", cube, y, y, optimize=True) / 2)

    return gradients, lambda x: np.asarray(square + np.einsum("ijk,nk->nij", cube, x - attractor))


def _cubic_series(dynamics: Dynamics, attractor: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """M and T of V to its third powers, ``½ yᵀMy + ⅙ T(y, y, y)``: ``(d, d)`` and ``(d, d, d)``."""
    place = attractor[None]
    square, noise = hessian_at(dynamics, attractor), dynamics.diffusion
    flow = dynamics.jacobian(place)[0] + 2 * noise.at(place)[0] @ square
    known = np.einsum("ai,ijk->ajk", square, dynamics.hessian(place)[0])
    if not noise.constant:
        known = known + 2 * np.einsum("ai,ijk,jb->abk", square, noise.derivatives(place)[0], square)
    orders = [(0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0)]
    symmetric = sum(known.transpose(order) for order in orders) / 6
    triangle, unitary = scipy.linalg.schur(flow, output="complex")
    turned = -3 * np.einsum("abc,ai,bj,ck->ijk", symmetric, unitary, unitary, unitary, optimize=True)
    one, cube = np.eye(len(flow)), np.zeros_like(turned)
    for i in range(len(flow)):
        rest = turned[i] - np.einsum("m,mjk->jk", triangle[:i, i], cube[:i])
        cube[i] = scipy.linalg.solve_sylvester(triangle.T + triangle[i, i] * one, triangle, rest)
    back = unitary.conj()
    whole = np.einsum("ijk,ai,bj,ck->abc", cube, back, back, back, optimize=True)
    return square, np.ascontiguousarray(whole.real)


def quasipotential_series(dynamics: Dynamics, attractor: np.ndarray, *, degree: int) -> Expansion:
    """Taylor polynomial of V (not U = 2V) at an attractor ``(d,)``, with all terms of degree 2 to `degree`.

    V is zero there. The polynomial is useless beyond its radius of convergence, and not the best one over a
    region.

    Raises
    ------
    ValueError
        When A is no stable equilibrium to rounding, or f has no finite derivatives of the order
        ``degree - 1`` there.
    """
    if degree < 2:
        raise Fault(f"a series of degree {degree} was asked for", "V begins with degree 2")
    center = np.asarray(attractor, dtype=float)
    basis = _Homogeneous(dynamics.dimension, degree)
    with formulas_in_time("the series at an attractor"):
        force = basis.expanded("f", dynamics.formulas, dynamics.symbols, center, degree - 1)
    jacobian = dynamics.jacobian(center[None])[0]
    if classify(dynamics, center).kind != "attractor":
        raise ValueError(
            f"{center.tolist()} is no attractor: its Jacobian has an eigenvalue that does not decay"
        )
    hessian = hessian_at(dynamics, center)
    # States in units of their spread: without this the systems mix coefficients of very different sizes.
    scale = np.sqrt(np.diag(np.linalg.inv(hessian)))
    step = np.abs(np.linalg.solve(jacobian, force[0][:, 0]))
    if not np.all((step <= 1e-6 * np.abs(center).max()) | (step <= 1e-9 * scale)):
        raise ValueError(f"{center.tolist()} is no equilibrium: f is {force[0][:, 0].tolist()} there")
    force = [part * basis.scales(k, scale) / scale[:, None] for k, part in enumerate(force)]
    diffusion, d, both = dynamics.diffusion, dynamics.dimension, np.outer(scale, scale)
    if diffusion.constant:
        noise = [diffusion.matrix]
    else:
        entries = [entry for row in diffusion.formulas for entry in row]
        noise = basis.expanded("D", entries, dynamics.symbols, center, degree - 2)
    noise = [
        part.reshape(d, d, -1) * basis.scales(k, scale) / both[:, :, None] for k, part in enumerate(noise)
    ]
    hessian = hessian * both
    flow = jacobian * scale / scale[:, None] + 2 * noise[0][:, :, 0] @ hessian

    parts = {2: basis.quadratic(hessian)}
    gradients = {2: basis.gradient(parts[2], 2)}
    for k in range(3, degree + 1):
        known = np.zeros(len(basis.exponents[k]))
        for a in range(2, k):
            known += basis.dot(gradients[a], a - 1, force[k + 1 - a], k + 1 - a)
        for a in range(3, k):
            known += basis.dot(gradients[a], a - 1, noise[0][:, :, 0] @ gradients[k + 2 - a], k + 1 - a)
        for e in range(1, len(noise)):
            for a in range(2, k - e + 1):  # and c = k + 2 - a - e is at least 2
                momenta = gradients[k + 2 - a - e]
                pushed = np.stack([basis.dot(row, e, momenta, k + 1 - a - e) for row in noise[e]])
                known += basis.dot(gradients[a], a - 1, pushed, k + 1 - a)
        parts[k] = np.linalg.solve(basis.advection(flow, k), -known)
        gradients[k] = basis.gradient(parts[k], k)
    exponents = np.concatenate([basis.exponents[k] for k in parts])
    return Expansion(
        PowerBasis(dynamics.symbols, center, np.ones(d), exponents, np.zeros((0, d + 1))),
        np.concatenate([part / basis.scales(k, scale) for k, part in parts.items()]),
    )


class _Homogeneous:
    """Homogeneous polynomials as coefficients along ``exponents[degree]``, and what is done with them."""

    def __init__(self, dimension: int, degree: int) -> None:
        rows = np.array(monomial_exponents(dimension, degree))
        totals = rows.sum(axis=1)
        self.dimension = dimension
        self.exponents = [rows[totals == k] for k in range(degree + 1)]
        # A monomial's number in the base degree + 1 is unique, so that a table finds its place.
        self._weights = (degree + 1) ** np.arange(dimension)
        keys = [block @ self._weights for block in self.exponents]
        self._order = [np.argsort(key) for key in keys]
        self._sorted = [key[order] for key, order in zip(keys, self._order, strict=True)]

    def place(self, exponents: np.ndarray, degree: int) -> np.ndarray:
        """Where monomials of one degree stand: ``(..., d)`` to ``(...)``."""
        return self._order[degree][np.searchsorted(self._sorted[degree], exponents @ self._weights)]

    def scales(self, degree: int, scale: np.ndarray) -> np.ndarray:
        """What each monomial gains when the states are measured in units of `scale`."""
        return np.prod(scale ** self.exponents[degree], axis=1)

    def quadratic(self, matrix: np.ndarray) -> np.ndarray:
        """½ yᵀ matrix y."""
        first, second = (np.eye(self.dimension, dtype=int)[index] for index in np.indices(matrix.shape))
        coefficients = np.zeros(len(self.exponents[2]))
        np.add.at(coefficients, self.place(first + second, 2), matrix / 2)
        return coefficients

    def gradient(self, coefficients: np.ndarray, degree: int) -> np.ndarray:
        """Derivatives by each state, ``(n,)`` to ``(d, m)`` of the degree below."""
        values = np.zeros((self.dimension, len(self.exponents[degree - 1])))
        for state, step in enumerate(np.eye(self.dimension, dtype=int)):
            rows = np.flatnonzero(self.exponents[degree][:, state])
            powers = self.exponents[degree][rows]
            values[state, self.place(powers - step, degree - 1)] = powers[:, state] * coefficients[rows]
        return values

    def dot(self, left: np.ndarray, left_degree: int, right: np.ndarray, right_degree: int) -> np.ndarray:
        """Σ_i left_i right_i of polynomials, ``(d, n)`` and ``(d, m)``."""
        degree = left_degree + right_degree
        places = self.place(self.exponents[left_degree][:, None] + self.exponents[right_degree], degree)
        count = len(self.exponents[degree])
        return np.bincount(places.ravel(), weights=(left.T @ right).ravel(), minlength=count)

    def advection(self, flow: np.ndarray, degree: int) -> np.ndarray:
        """Matrix of ``P ↦ (flow y)·∇P`` on polynomials P of a degree."""
        exponents, units = self.exponents[degree], np.eye(self.dimension, dtype=int)
        matrix = np.zeros((len(exponents), len(exponents)))
        for i in range(self.dimension):
            columns = np.flatnonzero(exponents[:, i])
            for j in range(self.dimension):
                rows = self.place(exponents[columns] - units[i] + units[j], degree)
                matrix[rows, columns] += exponents[columns, i] * flow[i, j]
        return matrix

    def expanded(
        self, name: str, formulas: Sequence[sympy.Expr], symbols: Sequence[sympy.Symbol],
        center: np.ndarray, degree: int,
    ) -> list[np.ndarray]:  # fmt: skip
        """Taylor coefficients of formulas at the center: for each degree of each formula, ``(m, n)``."""
        parts = [np.zeros((len(formulas), len(self.exponents[k]))) for k in range(degree + 1)]
        if all(formula.is_polynomial(*symbols) for formula in formulas):
            # x^β = Σ_α binomial(β, α) center^(β - α) y^α: nothing is differentiated, nothing truncated.
            for component, formula in enumerate(formulas):
                terms = sympy.Poly(formula, *symbols).terms()
                powers = np.array([monomial for monomial, _ in terms])
                coefficients = np.array([float(coefficient) for _, coefficient in terms])
                for k, part in enumerate(parts):
                    for place, lower in enumerate(self.exponents[k]):
                        choices = np.prod(scipy.special.comb(powers, lower), axis=1)
                        rest = np.prod(center ** np.maximum(powers - lower, 0), axis=1)
                        part[component, place] = np.sum(coefficients * choices * rest)
            return parts
        derivatives = {(0,) * len(symbols): list(formulas)}
        for block in self.exponents[1 : degree + 1]:
            for row in block:
                state = int(np.flatnonzero(row)[-1])
                lower = tuple(int(power) - (index == state) for index, power in enumerate(row))
                derivatives[tuple(map(int, row))] = [d.diff(symbols[state]) for d in derivatives[lower]]
        every = [expression for row in derivatives.values() for expression in row]
        with np.errstate(all="ignore"):
            values = compile_formulas(every, tuple(symbols))(center[:, None])[:, 0]
        table = values.reshape(len(derivatives), len(formulas)).T
        factorials = scipy.special.factorial(list(derivatives)).prod(axis=1)
        blocks = np.cumsum([len(block) for block in self.exponents[:degree]])
        parts = np.split(table / factorials, blocks, axis=1)
        if not all(np.isfinite(part).all() for part in parts):
            raise ValueError(f"{name} has no finite derivatives up to order {degree} at {center.tolist()}")
        return parts


LEAST_SHARE = 1e-7  # numerical, of the largest coefficient: smaller ones are rounding
FARTHEST = 0.9  # of the radius of curvature: farther from a cycle its distance has no unique foot
MOST_POINTS = 1024  # of a cycle: as many as it takes for V, and no more
SHORTEST, RESOLVED = 16, 1e-8  # waves of each coefficient: their size to the largest one
STATIONS, UNSEEN = (64, 200), 1024  # phases and distances that tell the reach; states that test the residual
FOOT_STEPS, FOOT_ERROR = 12, 1e-6  # of Newton's method for the foot of a distance; and of the cycle's width


class CycleFormula(NamedTuple):
    """V about a stable cycle of two states, ``Σ_k c_k(φ) s^k``, zero on it.

    φ = 2π t/T is the phase on the cycle γ, and s the distance from it along its normal, positive to the left
    of the motion. With ``v = |γ'|``, ``n' = β γ'/v``, and f and D in parts along and across, the equation of
    V ::

        q V_t f_t + q² V_s f_s + D_tt V_t² + 2 q D_ts V_t V_s + q² D_ss V_s² = 0,    q = v + β s,

    is at the power s^k a linear equation ``c_k' + k (∂_s f_s + 4 c_2 D_ss) c_k = r_k`` with one periodic
    solution, r_k being known from lower powers; c_2 is half of the Hessian across.
    """

    #: f and D, and the cycle
    dynamics: Dynamics
    cycle: Cycle
    #: Shape ``(K - 1, n)``: c_2 … c_K at the points of the cycle
    coefficients: np.ndarray
    #: V up to which the formula holds
    level: float = 0.0
    #: ``|∇V·(f + D∇V)|/∇V·D∇V`` at most, at states that no step has seen, from a thousandth of the level up
    #: to it. By that share V may be off, to first order: along its characteristics it rises at the rate of
    #: the denominator.
    residual: float = np.inf
    #: The least and the largest s, shape ``(2, m)``, at m phases that are evenly spread
    reach: np.ndarray = np.zeros((2, 1))

    @classmethod
    def of(
        cls, dynamics: Dynamics, cycle: Cycle, *, degree: int = 10, tolerance: float = 0.01
    ) -> CycleFormula:
        """The formula of the degree, up to one, that holds farthest within a relative residual.

        Raises
        ------
        NumericalFailure
            Where there are more than two states, or the cycle is not stable.
        """
        if dynamics.dimension != 2:
            raise NumericalFailure("V about a cycle is written in phase and distance for two states only")
        while True:
            coefficients = _cycle_coefficients(dynamics, cycle, degree)
            waves = np.abs(np.fft.rfft(coefficients, axis=1))
            size = np.maximum(waves.max(axis=1), LEAST_SHARE * waves.max())
            if (waves[:, -SHORTEST:].max(axis=1) < RESOLVED * size).all() or len(cycle.points) >= MOST_POINTS:
                break
            t = cycle.period * np.arange(2 * len(cycle.points)) / (2 * len(cycle.points))
            guess, width = _wave(cycle.points.T, cycle.period, t).T, np.ptp(cycle.points, axis=0)
            cycle = closed_orbit(dynamics, guess, cycle.period, scale=width)
        found = cls(dynamics, cycle, coefficients)
        whole = [found._replace(coefficients=found.coefficients[:count]) for count in range(1, degree)]
        best = max((one._up_to(tolerance) for one in whole), key=lambda one: one.level)
        draw = np.random.default_rng(0)
        t = draw.uniform(0, cycle.period, UNSEEN)
        s = draw.uniform(best.reach.min(), best.reach.max(), UNSEEN)
        value, *_, share = best._at(t, s)
        tested = best._inside(t, s, value) & (value > best.level / 1000)
        return best._replace(residual=float(share[tested].max(initial=0.0)))

    def values(self, x: np.ndarray) -> np.ndarray:
        """V at points ``(n, 2)``: shape ``(n,)``, NaN beyond where the formula holds."""
        points, period = self.cycle.points, self.cycle.period
        t = period / len(points) * cKDTree(points).query(x)[1]
        for _ in range(FOOT_STEPS):
            place, along, across, speed, bend = self._frame(t)
            s = ((x - place) * across).sum(axis=1)
            t = t + ((x - place) * along).sum(axis=1) / (speed * np.maximum(1 + s * bend, 1 - FARTHEST))
        place, _, across, *_ = self._frame(t)  # about the foot on the cycle, at the time t
        s = ((x - place) * across).sum(axis=1)
        value = self._at(t, s)[0]
        foot = (
            np.linalg.norm(place + s[:, None] * across - x, axis=1)
            <= FOOT_ERROR * np.ptp(place, axis=0).max()
        )
        return np.where(foot & self._inside(t, s, value), value, np.nan)

    def _inside(self, t: np.ndarray, s: np.ndarray, value: np.ndarray) -> np.ndarray:
        """Whether the formula holds at times and distances with these values."""
        count = self.reach.shape[1]
        before = np.floor(t / self.cycle.period * count).astype(int)
        low, high = (self.reach[:, (before + step) % count] for step in (0, 1))
        within = (s >= np.maximum(low[0], high[0])) & (s <= np.minimum(low[1], high[1]))
        return np.asarray(within & (value <= self.level))

    def terms(self) -> pd.DataFrame:
        """Columns ``power harmonic cosine sine``: V is the sum of ``s^power`` times these parts of c(φ)."""
        waves = np.fft.rfft(self.coefficients, axis=1) / self.coefficients.shape[1]
        waves[:, 1:] *= 2
        kept = np.abs(waves) > LEAST_SHARE * np.abs(waves).max()
        rows = [
            (k + 2, m, waves[k, m].real, -waves[k, m].imag) for k, m in zip(*np.nonzero(kept), strict=True)
        ]
        return pd.DataFrame(rows, columns=["power", "harmonic", "cosine", "sine"])

    def _up_to(self, tolerance: float) -> CycleFormula:
        """With the level, and the distances, up to which the residual keeps to a tolerance and V rises."""
        period, (phases, places) = self.cycle.period, STATIONS
        bend = self._frame(np.arange(phases) / phases * period)[-1]
        level, reach = np.inf, []
        for side in (-1, 1):
            radius = float(np.max(-side * bend))
            longest = FARTHEST / radius if radius > 0 else np.ptp(self.cycle.points, axis=0).max()
            t = np.repeat(np.arange(phases) / phases * period, places)
            s = np.tile(side * longest * np.arange(1, places + 1) / places, phases)
            value, _, slope, share = (one.reshape(phases, places) for one in self._at(t, s))
            bad = ~((share <= tolerance) & (side * slope > 0))
            bad[:, -1] = True
            first = np.argmax(bad, axis=1)
            # All that is claimed lies below the lowest level that is reached in a good place.
            level = min(level, float(np.where(first > 0, value[np.arange(phases), first - 1], 0.0).min()))
            reach.append(side * longest * first / places)
        return self._replace(level=level, reach=np.array(reach))

    def _frame(self, t: np.ndarray) -> tuple[np.ndarray, ...]:
        """γ, its unit tangent and normal, |γ'|, and β/|γ'| at times ``(n,)``."""
        place, moved, bent = (_wave(self.cycle.points.T, self.cycle.period, t, order) for order in range(3))
        speed = np.linalg.norm(moved, axis=0)
        along = moved / speed
        across = np.stack([-along[1], along[0]])
        return place.T, along.T, across.T, speed, -(across * bent).sum(axis=0) / speed**2

    def _at(self, t: np.ndarray, s: np.ndarray) -> tuple[np.ndarray, ...]:
        """V, its slopes by t and s, and the relative residual."""
        t, again = np.unique(t, return_inverse=True)
        place, along, across, speed, bend = (one[again] for one in self._frame(t))
        powers = np.arange(2, len(self.coefficients) + 2)[:, None]
        c, moved = (_wave(self.coefficients, self.cycle.period, t, order)[:, again] for order in (0, 1))
        value, turned = (c * s**powers).sum(0), (moved * s**powers).sum(0)
        slope = (powers * c * s ** (powers - 1)).sum(0)
        x = place + s[:, None] * across
        push = (turned / (speed * (1 + s * bend)))[:, None] * along + slope[:, None] * across
        spent = (push * self.dynamics.diffusion.push(x, push)).sum(axis=1)
        rest = (push * self.dynamics.drift(x)).sum(axis=1) + spent
        return value, turned, slope, np.abs(rest) / np.maximum(spent, np.finfo(float).tiny)


def _wave(values: np.ndarray, period: float, t: np.ndarray, order: int = 0) -> np.ndarray:
    """A derivative by time of periodic functions with values ``(m, n)``, at times ``(k,)``: ``(m, k)``."""
    count = values.shape[1]
    numbers = 2j * np.pi / period * np.fft.fftfreq(count, 1 / count)
    numbers[count // 2] = 0.0  # of the highest wave only the cosine is known
    waves = np.fft.fft(values, axis=1) / count * numbers**order
    return np.asarray((waves @ np.exp(np.outer(numbers, t))).real)


def _cycle_coefficients(dynamics: Dynamics, cycle: Cycle, degree: int) -> np.ndarray:
    """c_2 … c_K of `CycleFormula` at the points of a cycle, power by power."""
    count, period = len(cycle.points), cycle.period
    t = period * np.arange(count) / count
    place, along, across, speed, bend = CycleFormula(dynamics, cycle, np.zeros((0, count)))._frame(t)
    s, normal = sympy.Symbol("s_", real=True), sympy.symbols("n_0 n_1", real=True)
    shift = {own: own + s * to for own, to in zip(dynamics.symbols, normal, strict=True)}
    formulas = [*dynamics.formulas, *(entry for row in dynamics.diffusion.formulas for entry in row)]
    series = [sympy.sympify(one).xreplace(shift) for one in formulas]
    arguments, parts = np.concatenate([place.T, across.T]), []
    with formulas_in_time("the powers of f"):
        for k in range(degree + 1):
            known = compile_formulas(
                [one.xreplace({s: sympy.S.Zero}) for one in series], [*dynamics.symbols, *normal]
            )
            parts.append(known(np.ascontiguousarray(arguments)))
            series = [one.diff(s) / (k + 1) for one in series]
    powers = np.array(parts)  # (K + 1, 6, n)
    flow, noise = powers[:, :2], powers[:, 2:].reshape(degree + 1, 2, 2, count)
    f_t, f_s = (np.einsum("kin,ni->kn", flow, one) for one in (along, across))
    d_tt, d_ts, d_ss = (
        np.einsum("kijn,ni,nj->kn", noise, one, other)
        for one, other in ((along, along), (along, across), (across, across))
    )
    f_s[0] = 0.0
    q = np.zeros((degree + 1, count))
    q[0], q[1] = speed, speed * bend

    def times(*factors: np.ndarray) -> np.ndarray:
        """The product of power series ``(K + 1, n)``."""
        found = factors[0]
        for one in factors[1:]:
            found = np.array([sum(found[i] * one[k - i] for i in range(k + 1)) for k in range(degree + 1)])
        return found

    derivative = _wave(np.eye(count), period, t, 1).T
    c = np.zeros((degree + 1, count))
    c[2] = np.einsum("ni,nij,nj->n", across, hessians_along(dynamics, cycle), across) / 2
    rate = f_s[1] + 4 * c[2] * d_ss[0]
    for k in range(3, degree + 1):
        turned, slope = c @ derivative.T, np.zeros_like(c)
        slope[:-1] = np.arange(1, degree + 1)[:, None] * c[1:]
        rest = times(q, turned, f_t) + times(q, q, slope, f_s) + times(d_tt, turned, turned)
        rest += 2 * times(q, d_ts, turned, slope) + times(q, q, d_ss, slope, slope)
        c[k] = np.linalg.solve(derivative + np.diag(k * rate), -rest[k] / speed**2)
    return c[2:]
