"""Symbolic decompositions, and model.json read back."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import sympy
from known_systems import exact_archetype, maier_stein, portrait_of

from siq.errors import InputError, NumericalFailure
from siq.inference.library import candidate_library
from siq.quasipotential.formulas import (
    SymbolicDecomposition,
    _decomposition_data,
    _expression_from_data,
    _expression_to_data,
    _minimum,
    decomposition_from_coefficients,
    exact_decomposition,
    read_model,
    term_coefficients,
    write_model,
)
from siq.quasipotential.refinement import RefinementOptions
from siq.quasipotential.wells import local_well
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


DRAW = np.random.default_rng(0)


def number() -> sympy.Float:
    return sympy.Float(float(DRAW.normal() * 10.0 ** DRAW.integers(-12, 4)), 17)


def polynomial() -> sympy.Expr:
    return sympy.Add(*(number() * x**i * y**j for i in range(4) for j in range(3)))


def decomposition(potential: sympy.Expr | None = None) -> SymbolicDecomposition:
    return SymbolicDecomposition(
        symbols=(x, y),
        potential=polynomial() if potential is None else potential,
        circulatory=(polynomial(), sympy.S.Zero),
        vector_field=(polynomial(), 3 * x - y),
    )


CERTIFICATES = {"regression": {"certified": False, "tests": {}, "reason": "none"}}


def saved(path: Path, one: SymbolicDecomposition) -> SymbolicDecomposition:
    write_model(path, {"regression": one}, CERTIFICATES)
    decompositions, certificates = read_model(path)
    assert certificates == CERTIFICATES
    return decompositions["regression"]


@pytest.mark.parametrize(
    "potential",
    [
        None,
        sympy.Float(1e-20, 17) * x**4 + sympy.Float(1e8, 17) * y**2,
        number() * sympy.sqrt(x**2 + 1) + number() * x * y + number() * sympy.exp(-(x**2) / 3) * y**3,
        number() * sympy.log(x**2 + 2) - number(),
        sympy.S.Zero,
    ],
    ids=["polynomial", "far apart", "root and exponential", "logarithm", "zero"],
)
def test_a_model_comes_back_equal_to_the_last_bit(tmp_path: Path, potential: sympy.Expr | None) -> None:
    one = decomposition(potential)
    again = saved(tmp_path / "model.json", one)
    assert again.symbols == one.symbols
    points = DRAW.uniform(-2, 2, size=(2, 30))
    np.testing.assert_allclose(again.evaluate(points), one.evaluate(points), rtol=1e-13)
    third = saved(tmp_path / "again.json", again)
    assert (tmp_path / "again.json").read_bytes() == (tmp_path / "model.json").read_bytes()
    np.testing.assert_array_equal(third.evaluate(points), again.evaluate(points))


def test_wells_come_back_with_all_that_was_found_of_them(tmp_path: Path) -> None:
    known = maier_stein(3)
    well = local_well(known.dynamics, portrait_of(known), 0, options=RefinementOptions(degrees=(4, 6)))
    one = SymbolicDecomposition((x, y), None, (), known.dynamics.formulas, (well,))
    (again,) = saved(tmp_path / "model.json", one).wells
    points = well.points[::20]
    np.testing.assert_array_equal(again.values(points), well.values(points))
    np.testing.assert_allclose(again.residual_at(points), well.residual_at(points), rtol=1e-6, atol=1e-12)
    assert (again.level, again.reach, again.residual) == (well.level, well.reach, well.residual)
    assert again.trials == well.trials and len(well.trials) == 2
    assert well.saddle is not None
    np.testing.assert_array_equal(again.saddle, well.saddle)
    # Without points the level alone says where the formula holds.
    assert again.reaches(points).all() and not again.reaches(well.attractor[None] + 10).any()


def test_coefficients_of_polynomials_are_kept_exactly(tmp_path: Path) -> None:
    coefficients = [float(number()) for _ in range(6)] + [5e-324, 1.7e308, 0.1]
    one = decomposition(sympy.Add(*(sympy.Float(c, 17) * x**k for k, c in enumerate(coefficients))))
    data = _decomposition_data(one)["V"]
    assert {e[0]: c for e, c in zip(data["exponents"], data["coefficients"], strict=True)} == dict(
        enumerate(coefficients)
    )


def test_anything_can_evaluate_a_polynomial_without_this_library(tmp_path: Path) -> None:
    one = decomposition()
    write_model(tmp_path / "model.json", {"regression": one}, CERTIFICATES)
    data = json.loads((tmp_path / "model.json").read_text())["methods"]["regression"]
    points = DRAW.uniform(-2, 2, size=(2, 10))
    expected = one.evaluate(points)
    for part, values in zip([data["V"], *data["g"], *data["f"]], expected, strict=True):
        scaled = (points - np.array(part["center"])[:, None]) / np.array(part["scale"])[:, None]
        mine = sum(
            (
                c * np.prod(scaled ** np.array(e)[:, None], axis=0)
                for e, c in zip(part["exponents"], part["coefficients"], strict=True)
            ),
            np.zeros(10),
        )
        np.testing.assert_allclose(mine, values, rtol=1e-11, atol=1e-11)


def test_center_and_scale_are_obeyed_when_reading() -> None:
    data = {"center": [1.0, 0.0], "scale": [2.0, 1.0], "exponents": [[2, 1]], "coefficients": [3.0]}
    formula = _expression_from_data(data, (x, y))
    assert float(formula.subs({x: 4.0, y: 5.0})) == pytest.approx(3 * 1.5**2 * 5)


def test_a_formula_that_is_no_polynomial_travels_as_text() -> None:
    data = _expression_to_data(sympy.sqrt(x**2 + 1) - y, (x, y))
    assert set(data) == {"formula"}
    assert _expression_from_data(data, (x, y)) == sympy.sqrt(x**2 + 1) - y


@pytest.mark.parametrize(
    "formula", ["__import__('os').system('touch TRAP')", "x.real", "9**9**9", "w + 1", "exec('1')"]
)
def test_a_hostile_formula_is_refused(tmp_path: Path, formula: str) -> None:
    path, trap = tmp_path / "model.json", tmp_path / "trap"
    write_model(path, {"regression": decomposition()}, CERTIFICATES)
    model = json.loads(path.read_text("utf-8"))
    model["methods"]["regression"]["V"] = {"formula": formula.replace("TRAP", str(trap))}
    path.write_text(json.dumps(model), "utf-8")
    with pytest.raises(InputError, match=r"model\.json"):
        read_model(path)
    assert not trap.exists()


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "{}",
        "null",
        "{",
        '{"states": ["x"], "methods": {"a": {}}, "certificate": {}}',
        '{"states": ["x"], "methods": [], "certificate": {}}',
        '{"states": 3, "methods": {}, "certificate": {}}',
    ],
)
def test_what_is_not_a_model_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "model.json"
    path.write_text(text)
    with pytest.raises(InputError, match="not a model"):
        read_model(path)
    with pytest.raises(InputError, match="not a model"):
        read_model(tmp_path / "missing.json")


def test_a_model_without_formulas_is_a_model(tmp_path: Path) -> None:
    write_model(tmp_path / "model.json", {}, {})
    assert read_model(tmp_path / "model.json") == ({}, {})


def test_a_model_that_cannot_be_written_leaves_the_old_one(tmp_path: Path) -> None:
    path = tmp_path / "model.json"
    write_model(path, {}, {})
    before = path.read_bytes()
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_model(path, {"regression": decomposition()}, {"regression": {"error": float("nan")}})
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["model.json"]
