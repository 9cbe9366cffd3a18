"""The Hamilton–Jacobi equation at points, the bases of V, and Gauss–Newton."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import sympy
from known_systems import (
    KnownSystem,
    archetype,
    double_well,
    exact_field,
    linear_system,
    maier_stein,
    polynomial_system,
    uniform_points,
)

from siq.inference.library import candidate_library, monomial_exponents
from siq.quasipotential.global_formula import _forcing, _left_inverse
from siq.quasipotential.hamilton_jacobi import (
    Basis,
    HamiltonJacobi,
    LibraryBasis,
    PowerBasis,
    affordable_degree,
)
from siq.systems.dynamics import Dynamics
from siq.systems.formulas import compile_formulas

pytestmark = pytest.mark.portable

SYSTEMS = {
    "archetype": archetype(3),
    "Maier-Stein": maier_stein(1),
    "double well": double_well(2),
    "linear": linear_system(3),
    "polynomial": polynomial_system(2, seed=1),
}


def setting(
    known: KnownSystem, count: int = 400, degree: int = 4
) -> tuple[HamiltonJacobi, LibraryBasis, np.ndarray]:
    """The equation at random points, its basis, and the coefficients of the true V."""
    names = [symbol.name for symbol in known.dynamics.symbols]
    basis = LibraryBasis.of_potential(candidate_library(names, degree=degree))
    x = uniform_points(known, count, share=0.6)
    powers = {
        sympy.Mul(*(s**e for s, e in zip(known.dynamics.symbols, row, strict=True))): float(value)
        for row, value in sympy.Poly(known.potential, *known.dynamics.symbols).terms()
    }
    exact = np.array([powers.get(basis.library.terms[k], 0.0) for k in basis.chosen])
    return HamiltonJacobi.at(basis, x, known.dynamics), basis, exact


@pytest.mark.parametrize("known", SYSTEMS.values(), ids=SYSTEMS)
def test_the_true_v_has_no_residual(known: KnownSystem) -> None:
    equation, _, exact = setting(known)
    assert residual_of(equation, exact) < 1e-13


@pytest.mark.parametrize("known", SYSTEMS.values(), ids=SYSTEMS)
def test_the_jacobian_is_the_derivative_of_the_residual(known: KnownSystem) -> None:
    equation, _, exact = setting(known, count=60)
    at = exact + np.random.default_rng(0).normal(size=len(exact))
    found = equation.jacobian(at)
    assert found.shape == (len(equation.points), len(exact))
    step = 1e-6
    for column, shift in enumerate(step * np.eye(len(exact))):
        slope = (equation.residual(at + shift) - equation.residual(at - shift)) / (2 * step)
        np.testing.assert_allclose(found[:, column], slope, rtol=1e-6, atol=1e-6 * np.abs(found).max())


@pytest.mark.parametrize("known", SYSTEMS.values(), ids=SYSTEMS)
def test_gauss_newton_finds_the_true_v_from_near(known: KnownSystem) -> None:
    equation, _, exact = setting(known)
    draw = np.random.default_rng(2)
    for _ in range(3):
        start = exact * (1 + 0.1 * draw.uniform(-1, 1, size=len(exact)))
        coefficients, residual = equation.gauss_newton(start)
        assert residual < 1e-12
        np.testing.assert_allclose(coefficients, exact, atol=1e-9)


def test_coefficients_that_are_not_free_stay() -> None:
    equation, _, exact = setting(SYSTEMS["Maier-Stein"])
    free = np.arange(len(exact)) % 2 == 0
    start = np.where(free, 1.1 * exact, exact)
    coefficients, _ = equation.gauss_newton(start, free=free)
    np.testing.assert_array_equal(coefficients[~free], exact[~free])
    np.testing.assert_allclose(coefficients, exact, atol=1e-10)
    none, _ = equation.gauss_newton(start, free=np.zeros(len(exact), dtype=bool))
    np.testing.assert_array_equal(none, start)


def residual_of(equation: HamiltonJacobi, coefficients: np.ndarray) -> float:
    return equation.gauss_newton(coefficients, steps=0)[1]


def test_zero_has_an_infinite_residual_though_it_solves_the_equation() -> None:
    equation, _, exact = setting(SYSTEMS["archetype"])
    zero = np.zeros_like(exact)
    assert np.abs(equation.residual(zero)).max() == 0
    assert equation.gauss_newton(zero)[1] == np.inf


def test_the_relative_residual_does_not_depend_on_units_or_time() -> None:
    known = SYSTEMS["Maier-Stein"]
    equation, basis, exact = setting(known)
    wrong = exact * 1.1
    units, speed = np.array([1e-2, 30.0]), 1e-3
    powers = np.array([sympy.Poly(basis.library.terms[k], *known.dynamics.symbols).monoms()[0]
                       for k in basis.chosen])  # fmt: skip
    back = {s: s / float(u) for s, u in zip(known.dynamics.symbols, units, strict=True)}
    dynamics = Dynamics.of(
        known.dynamics.symbols,
        tuple(speed * float(u) * f.subs(back) for u, f in zip(units, known.dynamics.formulas, strict=True)),
        diffusion=speed * np.diag(units**2),
    )
    scaled = HamiltonJacobi.at(basis, equation.points * units, dynamics)
    other = wrong / np.prod(units**powers, axis=1)
    assert residual_of(scaled, other) == pytest.approx(residual_of(equation, wrong), rel=1e-9)


def test_points_where_f_vanishes_are_left_out() -> None:
    known = SYSTEMS["archetype"]
    _, basis, exact = setting(known)
    x = np.concatenate([known.attractors, np.zeros((1, 3)), uniform_points(known, 20)])
    equation = HamiltonJacobi.at(basis, x, known.dynamics)
    assert len(equation.points) == 20
    assert np.isfinite(equation.weight).all()
    assert residual_of(equation, exact) < 1e-13


@pytest.mark.parametrize("name", ["archetype", "Maier-Stein", "double well"])
def test_the_sensitivity_is_what_solving_again_gives(name: str) -> None:
    known = SYSTEMS[name]
    equation, _, exact = setting(known)
    found = exact_field(known, 5)
    response = -_left_inverse(equation.jacobian(exact)) @ _forcing(equation, exact, found)
    assert response.shape == (len(exact), len(found.support))
    step = 1e-5
    for column in range(len(found.support)):
        moved = []
        for sign in (1, -1):
            values = found.values.copy()
            values[column] += sign * step
            flow = found.dynamics.with_values(values).drift(equation.points)
            moved.append(replace(equation, flow=flow).gauss_newton(exact)[0])
        # The perturbed f has no exact V: the terms of second order are not negligible in every direction.
        np.testing.assert_allclose(response[:, column], (moved[0] - moved[1]) / (2 * step), atol=2e-3)


def test_restricted_equations_know_the_chosen_functions_only() -> None:
    equation, _, exact = setting(SYSTEMS["double well"])
    rows = np.flatnonzero(exact)
    part = replace(equation, gradients=equation.gradients[:, :, rows])
    assert part.gradients.shape[2] == len(rows)
    np.testing.assert_allclose(part.residual(exact[rows]), equation.residual(exact), atol=1e-12)


SYMBOLS = tuple(sympy.Symbol(name, real=True) for name in "xyz")


def library_basis() -> LibraryBasis:
    return LibraryBasis.of_potential(
        candidate_library("xyz", degree=3, potential_degree=3, further=("sqrt(1 + x**2)", "log(2 + y**2)*z"))
    )


BASES: dict[str, Basis] = {
    "library": library_basis(),
    "part of a library": replace(library_basis(), chosen=library_basis().chosen[[0, 5, 7, 19, 20]]),
    "powers": PowerBasis.up_to(5, SYMBOLS, np.array([0.3, -1.2, 0.0]), np.array([0.5, 2.0, 10.0])),
    "one state": PowerBasis.up_to(6, SYMBOLS[:1], np.array([0.3]), np.array([0.5])),
}


def points(basis: Basis, count: int = 7) -> np.ndarray:
    d = basis.gradients(np.zeros((1, 3 if not hasattr(basis, "symbols") else len(basis.symbols)))).shape[1]
    return np.random.default_rng(0).uniform(-1.5, 1.5, size=(count, d))


@pytest.mark.parametrize("basis", BASES.values(), ids=BASES)
def test_gradients_are_those_of_the_values(basis: Basis) -> None:
    x, step = points(basis), 1e-5
    found = basis.gradients(x)
    assert found.shape == (*x.shape, basis.size)
    for state, shift in enumerate(step * np.eye(x.shape[1])):
        slope = (basis.values(x + shift) - basis.values(x - shift)) / (2 * step)
        np.testing.assert_allclose(found[:, state], slope, rtol=1e-7, atol=1e-8)


@pytest.mark.parametrize("basis", BASES.values(), ids=BASES)
def test_hessians_are_those_of_the_gradients(basis: Basis) -> None:
    x, step = points(basis), 1e-5
    found = basis.hessians(x)
    assert found.shape == (*x.shape, x.shape[1], basis.size)
    np.testing.assert_allclose(found, found.transpose(0, 2, 1, 3), atol=1e-12)
    for state, shift in enumerate(step * np.eye(x.shape[1])):
        slope = (basis.gradients(x + shift) - basis.gradients(x - shift)) / (2 * step)
        np.testing.assert_allclose(found[:, state], slope, rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("basis", BASES.values(), ids=BASES)
def test_the_expression_has_the_values(basis: Basis) -> None:
    x = points(basis)
    coefficients = np.random.default_rng(1).normal(size=basis.size)
    coefficients[::3] = 0
    formula = compile_formulas([basis.expression(coefficients)], SYMBOLS[: x.shape[1]])
    np.testing.assert_allclose(
        formula(np.ascontiguousarray(x.T))[0], basis.values(x) @ coefficients, rtol=1e-11, atol=1e-11
    )


def test_the_constant_and_what_v_may_not_use_are_left_out() -> None:
    library = candidate_library("xy", degree=4, potential_degree=2)
    names = [library.names[k] for k in LibraryBasis.of_potential(library).chosen]
    assert names == ["x", "y", "x**2", "x*y", "y**2"]


def test_powers_begin_with_the_quadratic_ones() -> None:
    basis = PowerBasis.up_to(4, SYMBOLS, np.ones(3), np.ones(3))
    order = basis.exponents.sum(axis=1)
    assert (np.diff(order) >= 0).all()
    assert (order[0], order[-1]) == (2, 4)
    assert basis.size == len(monomial_exponents(3, 4)) - 4
    np.testing.assert_array_equal(basis.values(np.ones((1, 3))), 0.0)
    np.testing.assert_array_equal(basis.gradients(np.ones((1, 3))), 0.0)


@pytest.mark.parametrize("dimension", range(1, 9))
def test_an_affordable_degree_keeps_the_number_of_powers_small(dimension: int) -> None:
    degree = affordable_degree(dimension, 8)
    assert 2 <= degree <= 8
    assert degree == 2 or len(monomial_exponents(dimension, degree)) <= 260
    assert degree == 8 or len(monomial_exponents(dimension, degree + 1)) > 260
