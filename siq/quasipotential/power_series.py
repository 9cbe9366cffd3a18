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

import numpy as np
import scipy.linalg
import scipy.special
import sympy

from siq.errors import Fault
from siq.inference.library import monomial_exponents
from siq.quasipotential.hamilton_jacobi import Expansion, PowerBasis
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
    one = np.eye(len(flow))
    cube = np.zeros_like(turned)
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
        self,
        name: str,
        formulas: Sequence[sympy.Expr],
        symbols: Sequence[sympy.Symbol],
        center: np.ndarray,
        degree: int,
    ) -> list[np.ndarray]:
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
