from __future__ import annotations

import numpy as np
import pytest
import sympy
from known_systems import exact_archetype

from siq.errors import NumericalFailure
from siq.inference.library import candidate_library
from siq.quasipotential.formulas import (
    _minimum,
    decomposition_from_coefficients,
    exact_decomposition,
    term_coefficients,
)
from siq.systems.dynamics import Dynamics

x, y = (sympy.Symbol(name, real=True) for name in "xy")
POINTS = np.random.default_rng(0).uniform(-2, 2, size=(500, 2))


@pytest.mark.parametrize(
    ("expression", "lowest"),
    [
        (x**4 - 2 * x**2 + y**2, -1.0),
        ((x - 0.3) ** 4 - 2 * (x - 0.3) ** 2 + 0.2 * x + (y + 0.7) ** 2, None),
        (1e-8 * (x**4 - 2 * x**2 + y**2) + 5, 5 - 1e-8),
        (sympy.log(x**2 + 0.1) + y**2, np.log(0.1)),
        (x + y**2, POINTS[:, 0].min()),  # no well inside: the edge of the box
    ],
    ids=["double well", "shifted", "small", "logarithm", "edge"],
)
def test_the_minimum_within_the_box_of_the_points_is_found(
    expression: sympy.Expr, lowest: float | None
) -> None:
    if lowest is None:
        grid = np.linspace(-2, 2, 400_001)
        lowest = float(sympy.lambdify([x, y], expression)(grid, -0.7).min())
    found = _minimum(expression, (x, y), POINTS)
    assert found == pytest.approx(lowest, rel=1e-9, abs=1e-10)


def test_the_deeper_of_two_wells_is_found_even_where_points_are_rare() -> None:
    well = x**4 - 2 * x**2 - 0.02 * x + y**2
    crowd = np.random.default_rng(1).normal([-1, 0], 0.05, size=(5000, 2))
    points = np.concatenate([crowd, POINTS[:40]])
    deepest = min(well.subs({x: root, y: 0}) for root in np.roots([4, 0, -4, -0.02]).real)
    assert _minimum(well, (x, y), points) == pytest.approx(float(deepest), abs=1e-9)


def test_a_formula_that_is_nowhere_finite_is_a_numerical_failure() -> None:
    with pytest.raises(NumericalFailure, match="nowhere finite"), np.errstate(invalid="ignore"):
        _minimum(sympy.sqrt(-1 - x**2 - sympy.Symbol("y", real=True) ** 2 + 0.5), (x, y), POINTS)


def test_formulas_from_coefficients_evaluate_as_the_library_does() -> None:
    library = candidate_library(("x", "y"), degree=4, further=["sqrt(x**2 + 1)"])
    draw = np.random.default_rng(2)
    circulatory, vector_field = draw.normal(size=(2, library.size, 2))
    potential = np.where(library.in_potential, draw.normal(size=library.size), 0)
    found = decomposition_from_coefficients(
        library, potential=potential, circulatory=circulatory, vector_field=vector_field, points=POINTS
    )
    values, theta = found.evaluate(POINTS.T), library.evaluate(POINTS)
    np.testing.assert_allclose(values[1:3].T, theta @ circulatory, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(values[3:].T, theta @ vector_field, rtol=1e-10, atol=1e-10)
    shift = theta @ potential - values[0]
    np.testing.assert_allclose(shift, shift[0], atol=1e-10)
    assert -1e-9 < values[0].min() < 0.5  # V is zero at its _minimum, which lies between points
    gradient = np.stack([theta @ library.derivatives[:, i] @ potential for i in range(2)])
    np.testing.assert_allclose(found.evaluate_gradient(POINTS.T), gradient, rtol=1e-9, atol=1e-9)


def test_evaluation_agrees_with_sympy() -> None:
    exact = exact_archetype()
    points = np.random.default_rng(3).uniform(-2, 2, size=(3, 5))
    values = exact.evaluate(points)
    formulas = [exact.potential, *exact.circulatory, *exact.vector_field]
    for column, point in enumerate(points.T):
        at = dict(zip(exact.symbols, map(float, point), strict=True))
        expected = [float(formula.subs(at)) for formula in formulas]
        np.testing.assert_allclose(values[:, column], expected, rtol=1e-12, atol=1e-12)


def test_the_exact_decomposition_of_the_archetype_is_that_of_the_paper(archetype: Dynamics) -> None:
    exact = exact_archetype()
    a, b, c = archetype.symbols
    assert sympy.expand(exact.quasipotential - (a**4 - 2 * a**2 + b**2 + c**2 + 1)) == 0
    expected = (-b - c, 2 * a**3 - 2 * a, 2 * a**3 - 2 * a)
    assert all(sympy.expand(g - e) == 0 for g, e in zip(exact.circulatory, expected, strict=True))
    assert sympy.expand(sum(v * g for v, g in zip(exact.gradient, exact.circulatory, strict=True))) == 0


def test_the_exact_decomposition_carries_the_diffusion() -> None:
    diffusion = np.array([[2.0, 0.5], [0.5, 1.0]])
    found = exact_decomposition(
        Dynamics.of((x, y), (y - x, -y), diffusion=diffusion), x**2 + 3 * y**2 + x * y
    )
    gradient = np.array([x + y / 2, 3 * y + x / 2])
    rebuilt = [
        g - sum(sympy.nsimplify(diffusion[i, j]) * gradient[j] for j in range(2))
        for i, g in enumerate(found.circulatory)
    ]
    assert [sympy.expand(part - f) for part, f in zip(rebuilt, (y - x, -y), strict=True)] == [0, 0]


def test_terms_are_those_of_the_expanded_formula() -> None:
    assert term_coefficients((x + 2 * y) ** 2 - 1.5) == {"x**2": 1, "x*y": 4, "y**2": 4, "1": -1.5}
    assert term_coefficients(sympy.S.Zero) == {}


def test_an_irrational_factor_belongs_to_the_coefficient() -> None:
    found = term_coefficients(sympy.sqrt(2) * x**2 + sympy.pi * y)
    assert found == {"x**2": pytest.approx(2**0.5), "y": pytest.approx(np.pi)}


def test_components_have_the_names_of_the_tables() -> None:
    components = exact_archetype().components()
    assert list(components) == ["U", "V", "f_x", "f_y", "f_z", "g_x", "g_y", "g_z"]
