"""Systems whose quasipotential is known: what the methods are tested against.

Every builder returns the vector field, V (not U = 2V) as a formula where one is known everywhere, the
diffusion, the stable equilibria and a box around them. Numbers are rational, so that the Hamilton–Jacobi
residual of V is zero as a formula and not only to rounding.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import NamedTuple

import numpy as np
import sympy
from scipy.optimize import minimize

from siq.inference.field_estimate import FieldEstimate
from siq.inference.library import candidate_library, monomial_exponents
from siq.numerics.integration import FlowMap
from siq.quasipotential.formulas import SymbolicDecomposition
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics
from siq.systems.formulas import compile_formulas
from siq.systems.phase_portrait import PhasePortrait, phase_portrait
from workflow.scoring import exact_answer

Function = Callable[[np.ndarray], np.ndarray]


class KnownSystem(NamedTuple):
    """Dynamics with what is known about them.

    ``attractors`` has shape ``(k, d)`` and holds stable equilibria only, ``domain`` has shape ``(d, 2)``.
    """

    dynamics: Dynamics
    potential: sympy.Expr | None
    attractors: np.ndarray
    domain: np.ndarray

    @property
    def diffusion(self) -> np.ndarray:
        """D, shape ``(d, d)``."""
        return self.dynamics.diffusion.matrix

    def with_diffusion(self, matrix: np.ndarray) -> KnownSystem:
        """The same f under another noise."""
        return self._replace(dynamics=self.dynamics.with_diffusion(Diffusion(matrix)))


def potential_values(known: KnownSystem, x: np.ndarray) -> np.ndarray:
    """V at points, ``(n, d)`` to ``(n,)``."""
    assert known.potential is not None
    return _compiled(known.potential, known.dynamics.symbols)[0](np.ascontiguousarray(x.T))[0]


def potential_gradient(known: KnownSystem, x: np.ndarray) -> np.ndarray:
    """∇V at points, ``(n, d)`` to ``(n, d)``."""
    assert known.potential is not None
    return _compiled(known.potential, known.dynamics.symbols)[1](np.ascontiguousarray(x.T)).T


@functools.cache
def _compiled(potential: sympy.Expr, symbols: tuple[sympy.Symbol, ...]) -> tuple[Function, Function]:
    """V and ∇V, of components."""
    gradient = [potential.diff(symbol) for symbol in symbols]
    return compile_formulas([potential], symbols), compile_formulas(gradient, symbols)


@functools.cache
def linear_system(dimension: int, *, seed: int = 0, rotation: float = 6.0) -> KnownSystem:
    """``f = -(D - Q) M x`` with random M, D and antisymmetric Q of size `rotation`; V = ½ xᵀMx."""
    draw = np.random.default_rng([seed, dimension])
    symbols = _symbols(dimension)
    hessian, diffusion = _definite(draw, dimension), _definite(draw, dimension)
    turning = _antisymmetric(draw, dimension, rotation)
    states = sympy.Matrix(symbols)
    potential = sympy.expand((states.T * hessian * states)[0] / 2)
    return _known(symbols, potential, diffusion, turning, np.zeros((1, dimension)), [[-2, 2]] * dimension)


@functools.cache
def maier_stein(beta: float) -> KnownSystem:
    """``(x - x³ - βxy², -(1 + x²)y)``; V is known for β = 1 alone, where the noise-free flow is -∇V + g."""
    x, y = symbols = _symbols(2)
    equations = (x - x**3 - _rational(beta) * x * y**2, -(1 + x**2) * y)
    quasipotential = x**4 / 2 - x**2 + (1 + x**2) * y**2 + sympy.Rational(1, 2)
    return KnownSystem(
        Dynamics.of(symbols, equations),
        sympy.expand(quasipotential / 2) if beta == 1 else None,
        np.array([[-1.0, 0.0], [1.0, 0.0]]),
        np.array([[-2.0, 2.0], [-1.0, 1.0]]),
    )


@functools.cache
def archetype(dimension: int) -> KnownSystem:
    """The paper's system in d states: ``x`` quartic, every other state coupled to it in the same way."""
    symbols = _symbols(dimension)
    x, others = symbols[0], symbols[1:]
    potential = sympy.expand((x**2 - 1) ** 2 / 2 + sum((y**2 for y in others), sympy.S.Zero) / 2)
    turning = sympy.zeros(dimension)
    for index in range(1, dimension):
        turning[0, index], turning[index, 0] = -1, 1
    attractors = np.zeros((2, dimension))
    attractors[:, 0] = [-1, 1]
    domain = [[-2.0, 2.0]] + [[-1.5, 1.5]] * (dimension - 1)
    return _known(symbols, potential, sympy.eye(dimension), turning, attractors, domain)


@functools.cache
def double_well(dimension: int) -> KnownSystem:
    """``f = -D∇V`` with g = 0 and D a multiple of no unit matrix; two wells of different depth."""
    symbols = _symbols(dimension)
    x, others = symbols[0], symbols[1:]
    potential = sympy.expand((x**2 - 1) ** 2 / 4 + x / 10 + sum(((y - x / 2) ** 2 for y in others), x * 0))
    diffusion = sympy.diag(*(sympy.Rational(2 + index, 2) for index in range(dimension)))
    # The other states follow x, whose wells are the outer roots of x³ - x + 1/10.
    roots = np.sort(np.roots([1, 0, -1, 0.1]).real)[[0, 2]]
    attractors = np.outer(roots, np.r_[1.0, np.full(dimension - 1, 0.5)])
    potential -= _rational((roots[0] ** 2 - 1) ** 2 / 4 + roots[0] / 10)
    return _known(
        symbols, potential, diffusion, sympy.zeros(dimension), attractors, [[-2.0, 2.0]] * dimension
    )


@functools.cache
def limit_cycle(*, rotation: float = 2.0) -> KnownSystem:
    """Hopf's normal form, V = (x² + y² - 1)²/4: the attractor is the unit circle, and no equilibrium."""
    x, y = symbols = _symbols(2)
    potential = (x**2 + y**2 - 1) ** 2 / 4
    # g = ω(-y, x) is tangent to the circles; as Q∇V it would need Q to diverge on the cycle.
    turning = (-_rational(rotation) * y, _rational(rotation) * x)
    equations = tuple(sympy.expand(g - potential.diff(s)) for g, s in zip(turning, symbols, strict=True))
    return KnownSystem(
        Dynamics.of(symbols, equations),
        sympy.expand(potential),
        np.zeros((0, 2)),
        np.array([[-1.6, 1.6], [-1.6, 1.6]]),
    )


@functools.cache
def polynomial_system(
    dimension: int, *, seed: int = 0, rotation: float = 1.0, linear_rotation: bool = True
) -> KnownSystem:
    """``f = (Q(x) - D)∇V`` with a random V of degree 4 and Q antisymmetric, constant or linear in x.

    V grows like ``Σ x_i⁴`` and has as many wells as the draw gives it; it is zero at the deepest. Its
    maxima and saddles are equilibria of f as well, its wells the only stable ones.
    """
    draw = np.random.default_rng([seed, dimension, 4])
    symbols = _symbols(dimension)
    # The quadratic part mostly turns downwards, or one well is all that ever comes.
    size = {1: 0.1, 2: 0.3, 3: 0.25}
    potential = sum((s**4 / 4 - s**2 / 2 for s in symbols), sympy.S.Zero)
    for powers in monomial_exponents(dimension, 3)[1:]:
        coefficient = _rounded(draw.normal(size=1) * size[sum(powers)] / np.sqrt(dimension))[0]
        potential += coefficient * sympy.Mul(*(s**e for s, e in zip(symbols, powers, strict=True)))
    slanted = (_rounded(draw.normal(size=dimension)).T * sympy.Matrix(symbols))[0]
    potential = sympy.expand(potential + slanted**4 / 16)
    diffusion = _definite(draw, dimension)
    turning = _antisymmetric(draw, dimension, rotation)
    if linear_rotation:
        for symbol in symbols:
            turning += _antisymmetric(draw, dimension, rotation / 2) * symbol
    domain = [[-3.0, 3.0]] * dimension
    attractors, levels = _wells(potential, symbols, draw)
    return _known(symbols, potential - _rational(levels.min()), diffusion, turning, attractors, domain)


def exact_field(known: KnownSystem, degree: int, *, relative_error: float = 0.0) -> FieldEstimate:
    """The field as if identified: its own coefficients, each with the same relative standard error.

    Without an error it counts as free of noise; with one, its coefficients are still the exact ones.
    """
    library = candidate_library([symbol.name for symbol in known.dynamics.symbols], degree=degree)
    position = {term: k for k, term in enumerate(library.terms)}
    coefficients = np.zeros((library.size, library.dimension))
    for i, equation in enumerate(known.dynamics.formulas):
        for powers, value in sympy.Poly(equation, *known.dynamics.symbols).terms():
            term = sympy.Mul(*(s**e for s, e in zip(known.dynamics.symbols, powers, strict=True)))
            coefficients[position[term], i] = float(value)
    support = np.argwhere(coefficients.T)
    errors = (relative_error or 1e-12) * coefficients[support[:, 1], support[:, 0]]
    return FieldEstimate(
        library, coefficients, support, np.diag(errors**2), known.diffusion * relative_error**2,
        relative_error or 1e-10, FlowMap(), known.dynamics.diffusion,
    )  # fmt: skip


def uniform_points(known: KnownSystem, count: int, *, seed: int = 0, share: float = 1.0) -> np.ndarray:
    """States drawn uniformly from the domain, or from a part of it about its middle; shape ``(count, d)``."""
    middle, half = known.domain.mean(axis=1), share * np.diff(known.domain, axis=1)[:, 0] / 2
    return np.random.default_rng(seed).uniform(middle - half, middle + half, size=(count, len(middle)))


def portrait_of(known: KnownSystem, count: int = 400, *, share: float = 1.0) -> PhasePortrait:
    """The phase portrait that recordings from all over the domain would give, made once."""
    text = (
        str(known.dynamics.formulas),
        str(known.dynamics.diffusion.formulas),
        known.domain.tobytes(),
        count,
        share,
    )
    if text not in _PORTRAITS:
        points = uniform_points(known, count, share=share)
        _PORTRAITS[text] = phase_portrait(known.dynamics, points)
    return _PORTRAITS[text]


_PORTRAITS: dict[tuple[object, ...], PhasePortrait] = {}


def as_system(known: KnownSystem) -> Dynamics:
    """The same as a system to be simulated."""
    return replace(known.dynamics, name="known", domain=known.domain)


@functools.cache
def exact_archetype() -> SymbolicDecomposition:
    """The exact decomposition of the paper's archetypal system, from its card."""
    exact = exact_answer(Path(__file__).parents[1] / "config" / "systems" / "archetype3d.yaml")
    assert exact is not None
    return exact


def hamilton_jacobi_residual(known: KnownSystem) -> sympy.Expr:
    """∇V·(f + D∇V) as an expanded formula."""
    assert known.potential is not None
    gradient = sympy.Matrix([known.potential.diff(symbol) for symbol in known.dynamics.symbols])
    diffusion = sympy.Matrix([[_rational(entry) for entry in row] for row in known.diffusion])
    return sympy.expand((gradient.T * (sympy.Matrix(known.dynamics.formulas) + diffusion * gradient))[0])


def _symbols(dimension: int) -> tuple[sympy.Symbol, ...]:
    names = "xyzwuv"[:dimension]
    return tuple(sympy.Symbol(name, real=True) for name in names)


def _rational(value: float) -> sympy.Rational:
    """The number that a double holds, exactly."""
    exact = Fraction(float(value))
    return sympy.Rational(exact.numerator, exact.denominator)


def _rounded(values: np.ndarray) -> sympy.Matrix:
    """Drawn numbers cut to the 1/64, so that formulas stay short."""
    return sympy.Matrix(np.round(np.atleast_1d(values) * 64).astype(int).tolist()) / 64


def _definite(draw: np.random.Generator, dimension: int) -> sympy.Matrix:
    factor = draw.normal(size=(dimension, dimension))
    return _rounded(factor @ factor.T / dimension + np.eye(dimension) / 2)


def _antisymmetric(draw: np.random.Generator, dimension: int, size: float) -> sympy.Matrix:
    # Away from zero, or a draw now and then hardly turns at all.
    signs = draw.choice([-1, 1], size=(dimension, dimension))
    matrix = size * signs * draw.uniform(0.5, 1.5, size=(dimension, dimension))
    return _rounded(np.tril(matrix, -1) - np.tril(matrix, -1).T)


def _known(
    symbols: tuple[sympy.Symbol, ...],
    potential: sympy.Expr,
    diffusion: sympy.Matrix,
    turning: sympy.Matrix,
    attractors: np.ndarray,
    domain: list[list[float]],
) -> KnownSystem:
    """The system ``f = (Q - D)∇V``, whose g = Q∇V is orthogonal to ∇V because Q is antisymmetric."""
    gradient = sympy.Matrix([potential.diff(symbol) for symbol in symbols])
    equations = tuple(sympy.expand(part) for part in (turning - diffusion) * gradient)
    return KnownSystem(
        Dynamics.of(symbols, equations, diffusion=np.array(diffusion.tolist(), dtype=float)),
        potential,
        attractors,
        np.array(domain, dtype=float),
    )


def _wells(
    potential: sympy.Expr, symbols: tuple[sympy.Symbol, ...], draw: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Minima of V, found from many starts and polished to rounding, with V there."""
    value = compile_formulas([potential], symbols)
    first = [potential.diff(s) for s in symbols]
    slope = compile_formulas(first, symbols)
    bend = compile_formulas([e.diff(s) for e in first for s in symbols], symbols)
    found: list[np.ndarray] = []
    for start in draw.uniform(-2.5, 2.5, size=(40 * len(symbols), len(symbols))):
        point = minimize(lambda z: value(z)[0], start, jac=slope, method="BFGS").x
        for _ in range(5):
            point = point - np.linalg.solve(bend(point).reshape(len(symbols), -1), slope(point))
        definite = np.linalg.eigvalsh(bend(point).reshape(len(symbols), -1))[0] > 0
        if definite and all(np.linalg.norm(point - other) > 1e-6 for other in found):
            found.append(point)
    wells = np.array(sorted(found, key=lambda z: tuple(z)))
    return wells, np.array([value(well)[0] for well in wells])
