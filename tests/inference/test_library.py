from __future__ import annotations

from math import comb

import numpy as np
import pytest
import sympy

from siq.errors import NumericalFailure
from siq.inference.library import (
    CandidateLibrary,
    candidate_library,
    monomial_exponents,
)
from siq.systems.diffusion import Diffusion
from siq.systems.formulas import FormulaError

STATES = ("x", "y", "z", "w")
FULL = np.array([[2.0, 0.3], [0.3, 1.0]])


def assert_derivatives(library: CandidateLibrary) -> None:
    """T equals symbolic derivatives exactly, and finite differences of Θ."""
    for j in np.flatnonzero(library.in_potential):
        for i, symbol in enumerate(library.symbols):
            combined = sum(
                sympy.nsimplify(library.derivatives[k, i, j]) * library.terms[k]
                for k in np.flatnonzero(library.derivatives[:, i, j])
            )
            assert sympy.simplify(library.terms[j].diff(symbol) - combined) == 0
    points = np.random.default_rng(0).uniform(0.3, 1.2, size=(20, library.dimension))
    values = library.evaluate(points)
    for i in range(library.dimension):
        step = 1e-5 * np.eye(library.dimension)[i]
        difference = (library.evaluate(points + step) - library.evaluate(points - step)) / 2e-5
        allowed = library.in_potential
        np.testing.assert_allclose(
            (values @ library.derivatives[:, i])[:, allowed], difference[:, allowed], rtol=1e-6, atol=1e-7
        )


@pytest.mark.parametrize(("dimension", "degree"), [(1, 6), (1, 1), (2, 5), (2, 1), (3, 3), (4, 2)])
def test_derivatives_of_monomials_are_exact(dimension: int, degree: int) -> None:
    library = candidate_library(STATES[:dimension], degree=degree)
    assert library.size == comb(dimension + degree, degree)
    assert library.in_potential.all()
    assert library.in_circulatory.all()
    assert_derivatives(library)


@pytest.mark.parametrize(
    "further",
    [
        ("sin(x)*y",),
        ("sqrt(x**2 + 1)",),
        ("sin(x)", "cos(x)"),
        ("exp(-x*y)",),
        ("log(x)",),
        ("x*tanh(y)", "x**2*y**3"),
    ],
)
def test_further_functions_bring_their_derivatives_with_them(further: tuple[str, ...]) -> None:
    library = candidate_library(("x", "y"), degree=2, further=further)
    assert library.size >= 6 + len(further)
    assert library.in_circulatory.all()
    assert library.in_potential[: 6 + len(further)].all()
    assert not library.in_potential[6 + len(further) :].any()
    assert len(set(library.terms)) == library.size
    assert_derivatives(library)


@pytest.mark.parametrize(
    "further",
    [("sin(pi*x)", "cos(pi*x)"), ("sin(2*x)", "cos(2*x)"), ("sqrt(2*x**2 + 2)",), ("x**2*sqrt(2)*y**2",)],
)
def test_no_two_functions_are_multiples_of_each_other(further: tuple[str, ...]) -> None:
    library = candidate_library(("x", "y"), degree=2, further=further)
    points = np.random.default_rng(0).uniform(0.3, 1.2, size=(200, 2))
    values = library.evaluate(points)
    values = values / np.linalg.norm(values, axis=0)
    overlap = np.abs(values.T @ values - np.eye(library.size))
    assert overlap.max() < 1 - 1e-9


def test_the_values_are_those_of_the_names() -> None:
    library = candidate_library(("x", "y"), degree=3, further=["sin(x)*y"])
    points = np.random.default_rng(0).normal(size=(5, 2))
    values = library.evaluate(points)
    assert values.shape == (5, library.size)
    for k, name in enumerate(library.names):
        expected = [float(sympy.sympify(name).subs({"x": a, "y": b})) for a, b in points]
        np.testing.assert_allclose(values[:, k], expected, rtol=1e-13, err_msg=name)
    assert library.names[library.constant] == "1"


def test_exponents_are_all_those_up_to_the_degree() -> None:
    exponents = monomial_exponents(3, 4)
    assert len(exponents) == len(set(exponents)) == comb(7, 3)
    assert all(sum(row) <= 4 for row in exponents)
    assert [sum(row) for row in exponents] == sorted(sum(row) for row in exponents)


def test_degree_limits_say_which_monomials_v_and_g_may_use() -> None:
    library = candidate_library(("x", "y"), degree=5, potential_degree=4, circulatory_degree=3)
    degrees = np.array([sympy.Poly(term, *library.symbols).total_degree() for term in library.terms])
    np.testing.assert_array_equal(library.in_potential, degrees <= 4)
    np.testing.assert_array_equal(library.in_circulatory, degrees <= 3)
    assert not library.derivatives[:, :, degrees == 5].any()


def decompose(library: CandidateLibrary, diffusion: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Random coefficients of V and g within what is allowed, and f = -D∇V + g worked out at points."""
    draw = np.random.default_rng(1)
    potential = np.where(library.in_potential, draw.normal(size=library.size), 0)
    circulatory = draw.normal(size=(library.size, library.dimension)) * library.in_circulatory[:, None]
    gradient = np.einsum("kij,j->ki", library.derivatives, potential)
    return circulatory - gradient @ diffusion, potential, circulatory


def flatten(vector_field: np.ndarray, potential: np.ndarray, circulatory: np.ndarray) -> np.ndarray:
    return np.concatenate([vector_field.T.ravel(), potential, circulatory.T.ravel()])


@pytest.mark.parametrize("diffusion", [np.eye(2), np.diag([1.0, 9.0]), FULL])
@pytest.mark.parametrize(
    "options",
    [
        {"degree": 3},
        {"degree": 3, "potential_degree": 2, "circulatory_degree": 1},
        {"degree": 2, "further": ["sin(x)*y"]},
    ],
)
def test_the_constraints_hold_exactly_when_f_is_minus_d_grad_v_plus_g(
    diffusion: np.ndarray, options: dict
) -> None:
    library = candidate_library(("x", "y"), **options)
    matrix = library.constraints(Diffusion(diffusion))
    assert np.linalg.matrix_rank(matrix) == len(matrix)
    parts = decompose(library, diffusion)
    np.testing.assert_allclose(matrix @ flatten(*parts), 0, atol=1e-12)
    # The functions themselves: V by symbolic differentiation, not by T.
    points = np.random.default_rng(2).normal(size=(10, 2))
    values = library.evaluate(points)
    formula = sum(c * term for c, term in zip(parts[1], library.terms, strict=True))
    gradient = np.array(
        [
            [float(formula.diff(s).subs(dict(zip(library.symbols, p, strict=True)))) for s in library.symbols]
            for p in points
        ]
    )
    np.testing.assert_allclose(values @ parts[0], values @ parts[2] - gradient @ diffusion, atol=1e-9)
    for place in np.random.default_rng(3).choice(matrix.shape[1], size=25, replace=False):
        changed = flatten(*parts)
        changed[place] += 0.1
        violated = np.abs(matrix @ changed).max() > 1e-3
        constant_of_v = place == library.dimension * library.size + library.constant
        assert violated != constant_of_v


def test_every_solution_of_the_constraints_is_a_decomposition() -> None:
    library = candidate_library(("x", "y"), degree=3)
    matrix = library.constraints(Diffusion(FULL))
    free = matrix.shape[1] - np.linalg.matrix_rank(matrix)
    assert free == library.size * (1 + library.dimension)  # V and g are free, f follows


@pytest.mark.parametrize(
    ("further", "message"),
    [
        (["sin(w)"], "'w' is not declared"),
        (["x.real"], "not allowed"),
        (["pi"], "constant"),
        (["x**2"], "already"),
        (["x*x"], "already"),
        (["sin(x)", "sin(x)"], "already"),
    ],
)  # fmt: skip
def test_a_further_function_that_does_not_fit_is_refused(further: list[str], message: str) -> None:
    with pytest.raises(FormulaError, match=message):
        candidate_library(("x", "y"), degree=2, further=further)


def test_states_far_from_their_origin_are_refused_with_what_to_subtract() -> None:
    library = candidate_library(["T"], degree=5)
    states = np.random.default_rng(0).uniform(-1.7, 1.7, (500, 1))
    for near in (0.0, 5.0, 15.0):
        library.check_origin(states + near, names=["T"])
    with pytest.raises(
        NumericalFailure, match=r"^T stays .* between 271.\d+ and 274.\d+, .* subtract 273 from it"
    ):
        library.check_origin(states + 273, names=["T"])
    candidate_library(["T"], degree=1).check_origin(states + 273, names=["T"])
