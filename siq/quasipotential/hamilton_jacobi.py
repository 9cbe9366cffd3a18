"""The Hamilton–Jacobi equation ``∇V·(f + D∇V) = 0``, solved for a V that is linear in its weights.

V is a sum of functions of a `Basis`: powers about an attractor, or a library of candidates. At points the
equation is a system of quadratic equations for the coefficients, which is solved by damped Gauss–Newton
(`gauss_newton`), where V is not smooth everywhere with weights that fall with the residual (`robust_fit`).

The equation has false solutions that are just as exact as the true one: V flat along a direction, V = 0, and
one for every invariant subspace of the linearisation. Where the iteration ends depends on where it starts;
what it found must be tested by what does not know of this equation (`siq.quasipotential.certificate_tests`).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol

import numpy as np
import scipy.linalg
import sympy

from siq.inference.library import CandidateLibrary, monomial_exponents
from siq.numerics.randomness import positive
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics
from siq.systems.equilibria import measure_at
from siq.systems.formulas import compile_formulas

MAX_POWERS = 260  # more make every Gauss–Newton step take seconds
MIN_SLOPE = 1e-8  # of f: where D∇V is smaller, Gauss–Newton is on its way to V = 0, which is a solution, too
DIAGONAL_RATIO = 1e-5  # diagonal of a triangular factor: below this share columns are not independent enough
OUTLIER_SCALE = 3.0  # of the median residual: what is larger counts less and less
SINGULAR_RATIO = 1e-10  # of the largest singular value: combinations of functions that the points leave open


class Basis(Protocol):
    """m functions of d states: values ``(n, m)`` and derivatives at points; a sum of them as a formula."""

    def values(self, x: np.ndarray) -> np.ndarray: ...  # noqa: D102

    def gradients(self, x: np.ndarray) -> np.ndarray: ...  # noqa: D102

    def hessians(self, x: np.ndarray) -> np.ndarray: ...  # noqa: D102

    def expression(self, coefficients: np.ndarray) -> sympy.Expr: ...  # noqa: D102


def _weighted_sum(coefficients: np.ndarray, terms: Iterable[sympy.Expr]) -> sympy.Expr:
    pairs = zip(coefficients, terms, strict=True)
    return sympy.Add(*(sympy.Float(float(one), 17) * term for one, term in pairs if one != 0))


@dataclass(frozen=True)
class LibraryBasis:
    """The functions of a candidate library that V may use, those in the places `chosen`."""

    library: CandidateLibrary
    chosen: np.ndarray

    @classmethod
    def of_potential(cls, library: CandidateLibrary) -> LibraryBasis:
        """All functions that V may use; the constant means nothing to V and is left out."""
        allowed = library.in_potential.copy()
        allowed[library.constant] = False
        return cls(library, np.flatnonzero(allowed))

    @property
    def size(self) -> int:
        """Number of functions, m."""
        return len(self.chosen)

    def values(self, x: np.ndarray) -> np.ndarray:
        """Points ``(n, d)`` to values ``(n, m)``."""
        return self.library.evaluate(x)[:, self.chosen]

    def gradients(self, x: np.ndarray) -> np.ndarray:
        """Points ``(n, d)`` to gradients ``(n, d, m)``."""
        d, q = self.library.dimension, self.library.size
        flat = self.library.derivatives[:, :, self.chosen].reshape(q, d * self.size)
        return (self.library.evaluate(x) @ flat).reshape(len(x), d, self.size)

    def hessians(self, x: np.ndarray) -> np.ndarray:
        """Points ``(n, d)`` to Hessians ``(n, d, d, m)``."""
        d = self.library.dimension
        flat = self._second(np.ascontiguousarray(x.T))
        return np.moveaxis(flat.reshape(self.size, d, d, len(x)), (0, 3), (3, 0))

    @cached_property
    def _second(self):  # type: ignore[no-untyped-def]
        second = self.library.second_derivatives(self.chosen.tolist())
        return compile_formulas([each for row in second for each in row], self.library.symbols)

    def expression(self, coefficients: np.ndarray) -> sympy.Expr:
        """The sum as a formula of the states."""
        return _weighted_sum(coefficients, (self.library.terms[k] for k in self.chosen))


def _tanh_derivatives(x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The hyperbolic tangent with its first and second derivative."""
    here = np.tanh(x)
    slope = 1 - here**2
    return here, slope, -2 * here * slope


@dataclass(frozen=True)
class PowerBasis:
    """Products of powers of ``y = (x - center)/scale``, with exponents ``(p, d)``, and random units.

    A unit ``tanh(w·y + b)`` is a row ``(w, b)`` of `units`, shape ``(m - p, d + 1)``. Its Taylor polynomial
    of degree 2 at the center is taken away, so that value, slope and curvature there are those of the powers.
    """

    symbols: tuple[sympy.Symbol, ...]
    center: np.ndarray
    scale: np.ndarray
    exponents: np.ndarray
    units: np.ndarray

    @classmethod
    def up_to(
        cls, degree: int, symbols: tuple[sympy.Symbol, ...], center: np.ndarray, scale: np.ndarray
    ) -> PowerBasis:
        """All powers of degree 2 up to `degree` about a center; the quadratic ones come first."""
        exponents = [row for row in monomial_exponents(len(symbols), degree) if sum(row) >= 2]
        center, none = np.asarray(center, dtype=float), np.zeros((0, len(symbols) + 1))
        return cls(symbols, center, scale, np.array(exponents), none)

    @classmethod
    def from_data(cls, data: Mapping[str, Any], symbols: tuple[sympy.Symbol, ...]) -> PowerBasis:
        """The powers, and units, that `Well.powers` wrote."""
        units = np.array(data.get("units", [])).reshape(-1, len(symbols) + 1)
        center, scale, exponents = (np.array(data[name]) for name in ("center", "scale", "exponents"))
        return cls(symbols, center, scale, exponents, units)

    @property
    def size(self) -> int:
        """Number of functions, m."""
        return len(self.exponents) + len(self.units)

    @property
    def free(self) -> np.ndarray:
        """Mask of the functions that a fit may change, ``(m,)``: all but the quadratic ones, which are M."""
        return np.append(self.exponents.sum(axis=1) > 2, np.full(len(self.units), True))

    @property
    def title(self) -> str:
        """The functions in words."""
        words = f"powers of degree {self.exponents.sum(axis=1).max()}"
        return f"{words} and {len(self.units)} random units" if len(self.units) else words

    def values(self, x: np.ndarray) -> np.ndarray:
        """Points ``(n, d)`` to values ``(n, m)``."""
        return np.concatenate([self._product(self._powers(x), ()), self._of_units(x, 0)], axis=1)

    def gradients(self, x: np.ndarray) -> np.ndarray:
        """Points ``(n, d)`` to gradients ``(n, d, m)``."""
        powers, of_units, slopes = self._powers(x), self._of_units(x, 1), self.units[:, :-1].T
        each = enumerate(slopes / self.scale[:, None])
        return np.stack([np.hstack([self._product(powers, (i,)), of_units * one]) for i, one in each], axis=1)

    def hessians(self, x: np.ndarray) -> np.ndarray:
        """Points ``(n, d)`` to Hessians ``(n, d, d, m)``."""
        powers, of_units, d = self._powers(x), self._of_units(x, 2), len(self.symbols)
        values, slopes = np.empty((len(x), d, d, self.size)), self.units[:, :-1] / self.scale
        for i, j in itertools.combinations_with_replacement(range(d), 2):
            bends = of_units * slopes[:, i] * slopes[:, j]
            values[:, i, j] = values[:, j, i] = np.hstack([self._product(powers, (i, j)), bends])
        return values

    def expression(self, coefficients: np.ndarray) -> sympy.Expr:
        """The sum as a formula of the states."""
        scaled = [
            symbol if (c, s) == (0, 1) else (symbol - sympy.Float(float(c), 17)) / sympy.Float(float(s), 17)
            for symbol, c, s in zip(self.symbols, self.center, self.scale, strict=True)
        ]
        powers = (
            sympy.prod(base ** int(e) for base, e in zip(scaled, row, strict=True)) for row in self.exponents
        )
        of_powers, of_units = np.split(coefficients, [len(self.exponents)])
        return _weighted_sum(of_powers, powers) + self.sum_of_units(of_units, scaled)

    def sum_of_units(self, coefficients: np.ndarray, scaled: Sequence[sympy.Expr]) -> sympy.Expr:
        """The units as a formula of y: hyperbolic tangents, less one polynomial for all of them."""
        slopes = self.units[:, :-1]
        here, slope, bend = (coefficients * one for one in _tanh_derivatives(self.units[:, -1]))
        along = (_weighted_sum(unit, [*scaled, sympy.S.One]) for unit in self.units)
        taylor = [here.sum(), *(slope @ slopes), *((slopes.T * bend) @ slopes / 2).ravel()]
        products = (one * other for one, other in itertools.product(scaled, repeat=2))
        tangents = _weighted_sum(coefficients, map(sympy.tanh, along))
        return tangents - _weighted_sum(np.array(taylor), [sympy.S.One, *scaled, *products])

    def _of_units(self, x: np.ndarray, order: int) -> np.ndarray:
        """Derivatives of the units by ``w·y``, of an order up to 2, shape ``(n, m - p)``."""
        along, biases = ((x - self.center) / self.scale) @ self.units[:, :-1].T, self.units[:, -1]
        here, slope, bend = _tanh_derivatives(biases)
        there = np.tanh(along + biases)
        if order == 0:
            return np.asarray(there - here - along * (slope + bend / 2 * along))
        steepness = 1 - there**2
        return np.asarray(steepness - slope - bend * along if order == 1 else -2 * there * steepness - bend)

    def _powers(self, x: np.ndarray) -> np.ndarray:
        """Powers of every scaled state, shape ``(highest + 1, d, n)``."""
        y = ((x - self.center) / self.scale).T
        powers = np.ones((int(self.exponents.max()) + 1, *y.shape))
        for exponent in range(1, len(powers)):
            powers[exponent] = powers[exponent - 1] * y
        return powers

    def _product(self, powers: np.ndarray, derivatives: tuple[int, ...]) -> np.ndarray:
        exponents = self.exponents.copy()
        factor = np.ones(len(exponents))
        for axis in derivatives:
            factor = factor * exponents[:, axis] / self.scale[axis]
            exponents[:, axis] = np.maximum(exponents[:, axis] - 1, 0)
        result = np.repeat(factor[:, None], powers.shape[2], axis=1)
        for axis in range(powers.shape[1]):
            result *= powers[exponents[:, axis], axis]
        return result.T


@dataclass(frozen=True, eq=False)
class Expansion:
    """V = Σ c_k φ_k: the functions φ of a basis, with coefficients of the shape ``(m,)``."""

    basis: Basis
    coefficients: np.ndarray

    def values(self, x: np.ndarray) -> np.ndarray:
        """V at points ``(n, d)``, shape ``(n,)``."""
        return self.basis.values(x) @ self.coefficients

    def gradients(self, x: np.ndarray) -> np.ndarray:
        """∇V at points, shape ``(n, d)``."""
        return self.basis.gradients(x) @ self.coefficients

    def hessians(self, x: np.ndarray) -> np.ndarray:
        """∇²V at points, shape ``(n, d, d)``."""
        return self.basis.hessians(x) @ self.coefficients


def affordable_degree(dimension: int, degree: int) -> int:
    """The highest degree up to `degree`, but at least 2, with no more than `MAX_POWERS` powers."""
    while degree > 2 and math.comb(dimension + degree, degree) > MAX_POWERS:
        degree -= 1
    return degree


@dataclass(frozen=True)
class HamiltonJacobi:
    """The equation at some points, weighted so that fast regions do not rule."""

    points: np.ndarray  #: shape (n, d)
    gradients: np.ndarray  #: ∂θ_j/∂x_i there, shape (n, d, m)
    flow: np.ndarray  #: f there, shape (n, d)
    diffusion: Diffusion  #: D
    weight: np.ndarray  #: one over ∣f∣ in the metric of the noise, shape (n,)
    measure: Diffusion  #: that metric, D or what stands in for a D without inverse

    @classmethod
    def at(
        cls, basis: Basis, x: np.ndarray, dynamics: Dynamics, *, attractor: np.ndarray | None = None
    ) -> HamiltonJacobi:
        """The equation at those of some points, shape ``(n, d)``, where f does not vanish.

        Where D has no inverse, the attractor, shape ``(d,)``, tells in which metric that is seen.
        """
        flow, noise = dynamics.drift(x), dynamics.diffusion
        measure = noise if attractor is None else measure_at(dynamics, attractor)
        speed = np.sqrt(measure.squared_speed(x, flow))
        moving = speed > 1e-9 * speed.max()
        x, flow, speed = x[moving], flow[moving], speed[moving]
        return cls(x, basis.gradients(x), flow, noise, 1 / speed, measure)

    def residual(self, coefficients: np.ndarray) -> np.ndarray:
        """Weighted ``∇V·(f + D∇V)``, shape ``(n,)``."""
        gradient = self.slopes(coefficients)
        return self.weight * (gradient * (self.flow + self.diffusion.push(self.points, gradient))).sum(axis=1)

    def jacobian(self, coefficients: np.ndarray) -> np.ndarray:
        """Derivative of the residual with respect to the coefficients, shape ``(n, m)``."""
        gradient = self.slopes(coefficients)
        along = self.weight[:, None] * (self.flow + 2 * self.diffusion.push(self.points, gradient))
        return np.einsum("nd,ndm->nm", along, self.gradients)

    def slopes(self, coefficients: np.ndarray) -> np.ndarray:
        """∇V at the points, shape ``(n, d)``."""
        n, d, m = self.gradients.shape
        slopes: np.ndarray = (self.gradients.reshape(n * d, m) @ coefficients).reshape(n, d)
        return slopes

    def relative_residuals(self, coefficients: np.ndarray) -> np.ndarray:
        """``∣∇V·(f + D∇V)∣ / (∣∇V∣ ∣f∣)`` at the points, shape ``(n,)``."""
        size = np.sqrt(self.measure.contract(self.points, self.slopes(coefficients)))
        return np.asarray(np.abs(self.residual(coefficients)) / np.where(size > 0, size, np.inf))

    def sizes(self) -> np.ndarray:
        """Rms of each function's gradient over the points, in the metric of the noise: shape ``(m,)``."""
        steepness = self.measure.contract(self.points, self.gradients.transpose(0, 2, 1))
        return np.sqrt(np.asarray(steepness.mean(axis=0)))

    def robust_fit(
        self, start: np.ndarray, free: np.ndarray, *, rounds: int, finest: float, steps: int,
        orthonormal: bool = False, damping: float = 0.0,
    ) -> np.ndarray:  # fmt: skip
        """Coefficients by Gauss–Newton with weights that fall with the square of the residual (Cauchy's).

        Where V stops to be smooth, by caustics or by a kink, the residual is large and counts for nothing,
        instead of spoiling the formula elsewhere. Below the residual `finest` nothing is an outlier.

        Of the coefficients ``(m,)`` to start from those change that are `free`, a mask. Weights are made so
        many `rounds`, with at most so many `steps` each. If `orthonormal`, combinations of functions are
        fitted that are orthonormal over the points. `damping` is that of `gauss_newton`.
        """
        equation, theta, moving = self, start, free
        if orthonormal:
            equation, turned = _orthonormalised(self, free)
            moving = np.arange(turned.shape[1]) < turned.shape[1] - int((~free).sum())
            # The same function over the points, of which the coefficients may be far from unique.
            now = self.measure.push(self.points, self.slopes(np.where(free, start, 0.0)))
            theta = np.einsum("nim,ni->m", equation.gradients, now) / len(now)
            theta[~moving] = start[~free]
        for _ in range(rounds):
            rest = equation.relative_residuals(theta)
            scale = max(OUTLIER_SCALE * float(np.median(rest)), finest)
            weighted = replace(equation, weight=equation.weight / np.sqrt(1 + (rest / scale) ** 2))
            theta, _ = weighted.gauss_newton(theta, free=moving, steps=steps, damping=damping)
        return np.asarray(turned @ theta) if orthonormal else theta

    def gauss_newton(
        self, start: np.ndarray, *, free: np.ndarray | None = None, steps: int = 60,
        tolerance: float = 1e-13, damping: float = 0.0,
    ) -> tuple[np.ndarray, float]:  # fmt: skip
        """Coefficients with the least squares of the residual, relative to the size of ∇V; and what is left.

        The residual alone would draw a bad start to V = 0, which solves the equation, too. What is left is
        the root mean square of the weighted one over that of ∇V; infinite for V = 0, or all but 0.

        Of the coefficients ``(m,)`` to start from those change that are `free`, a mask, by default all, until
        their relative change is below the tolerance. Levenberg's damping, a share of the
        diagonal, keeps functions small that the points hardly tell apart.
        """
        coefficients = start.copy()
        free = np.ones(len(start), dtype=bool) if free is None else free
        scale = positive(self.sizes())

        def relative(current: np.ndarray) -> tuple[np.ndarray, float]:
            """The residual over rms of ∇V in the metric of the noise, shape ``(n,)``, and that rms."""
            size = float(np.sqrt(self.measure.contract(self.points, self.slopes(current)).mean()))
            return self.residual(current) / max(size, 1e-300), size

        residual, size = relative(coefficients)
        for _ in range(steps if free.any() else 0):
            if size == 0:
                break
            # Of that rms the derivative by the coefficients.
            along = self.measure.push(self.points, self.slopes(coefficients))
            slant = np.einsum("nd,ndm->m", along, self.gradients) / (len(along) * size)
            jacobian = self.jacobian(coefficients)[:, free] - np.outer(residual, slant[free])
            matrix, step = jacobian / (size * scale[free]), None
            try:  # the normal equations, ten times as fast, where they do: the next step corrects this one
                normal = matrix.T @ matrix
                normal[np.diag_indices_from(normal)] *= 1 + damping
                factor, lower = scipy.linalg.cho_factor(normal, check_finite=False)
                diagonal = np.diag(factor)
                if diagonal.min() > DIAGONAL_RATIO * diagonal.max():
                    step = scipy.linalg.cho_solve((factor, lower), matrix.T @ -residual, check_finite=False)
            except scipy.linalg.LinAlgError:
                pass
            if step is None:  # directions that the points do not determine are left as they are
                step = np.linalg.lstsq(matrix, -residual, rcond=1e-11)[0]
            step, length = step / scale[free], 1.0
            while True:
                trial = coefficients.copy()
                trial[free] += length * step
                attempt, size = relative(trial)
                improved = np.linalg.norm(attempt) < np.linalg.norm(residual)
                if improved or length < 1e-3:
                    break
                length /= 2
            if not improved:
                break
            gain = 1 - float(np.linalg.norm(attempt)) / max(float(np.linalg.norm(residual)), 1e-300)
            change = np.linalg.norm(length * step * scale[free])
            reached = np.linalg.norm(coefficients * scale)
            coefficients, residual = trial, attempt
            if change <= tolerance * reached or gain < 1e-7:
                break
        squared = self.measure.contract(self.points, self.slopes(coefficients))
        if not np.sqrt((self.weight**2 * squared).mean()) > MIN_SLOPE:
            return coefficients, np.inf
        return coefficients, float(np.sqrt((self.residual(coefficients) ** 2).mean() / squared.mean()))


def _orthonormalised(equation: HamiltonJacobi, free: np.ndarray) -> tuple[HamiltonJacobi, np.ndarray]:
    """The equation in combinations of the free functions whose gradients are orthonormal, and their matrix.

    Powers are all but dependent over a sublevel set that is narrow, or bent; their combinations are not.
    Those that the points leave open are left out; functions that are not free stay and come last.
    """
    roots = equation.measure.root_at(equation.points)
    stacked = np.einsum("nij,nim->njm", roots, equation.gradients[:, :, free], optimize=True)
    scale = positive(np.sqrt((stacked**2).sum(axis=(0, 1))))
    upper = np.linalg.qr((stacked / scale).reshape(-1, stacked.shape[2]), mode="r")
    _, sizes, right = np.linalg.svd(upper, full_matrices=False)
    determined = sizes > SINGULAR_RATIO * sizes[0]
    combined = right[determined].T / sizes[determined] / scale[:, None] * np.sqrt(len(equation.points))
    m, k, stay = len(free), int(determined.sum()), np.flatnonzero(~free)
    turned = np.zeros((m, k + len(stay)))
    turned[np.ix_(np.flatnonzero(free), np.arange(k))] = combined
    turned[stay, k + np.arange(len(stay))] = 1.0
    n, d = equation.points.shape
    gradients = (equation.gradients.reshape(n * d, m) @ turned).reshape(n, d, -1)
    return replace(equation, gradients=gradients), turned
