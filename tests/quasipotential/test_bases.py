from __future__ import annotations

import numpy as np
import pytest
import sympy

from siq.inference.library import candidate_library, monomial_exponents
from siq.quasipotential.hamilton_jacobi import (
    Basis,
    LibraryBasis,
    affordable_degree,
    potential_basis,
    power_basis,
)
from siq.systems.formulas import compile_formulas

SYMBOLS = tuple(sympy.Symbol(name, real=True) for name in "xyz")


def library_basis() -> LibraryBasis:
    return potential_basis(
        candidate_library("xyz", degree=3, potential_degree=3, further=("sqrt(1 + x**2)", "log(2 + y**2)*z"))
    )


BASES: dict[str, Basis] = {
    "library": library_basis(),
    "part of a library": library_basis().restricted(np.array([0, 5, 7, 19, 20])),
    "powers": power_basis(SYMBOLS, np.array([0.3, -1.2, 0.0]), np.array([0.5, 2.0, 10.0]), degree=5),
    "one state": power_basis(SYMBOLS[:1], np.array([0.3]), np.array([0.5]), degree=6),
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
    names = [library.names[k] for k in potential_basis(library).chosen]
    assert names == ["x", "y", "x**2", "x*y", "y**2"]


def test_powers_begin_with_the_quadratic_ones() -> None:
    basis = power_basis(SYMBOLS, np.ones(3), np.ones(3), degree=4)
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
