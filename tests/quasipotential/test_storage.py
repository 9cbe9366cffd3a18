from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import sympy
from known_systems import maier_stein, portrait_of

from siq.errors import InputError
from siq.quasipotential.formulas import (
    SymbolicDecomposition,
    expression_from_data,
    expression_to_data,
    model_to_data,
    read_model,
    write_model,
)
from siq.quasipotential.wells import WellOptions, local_well

x, y = (sympy.Symbol(name, real=True) for name in "xy")
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
    write_model(path, model_to_data({"regression": one}, CERTIFICATES))
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
    well = local_well(known.dynamics, portrait_of(known), 0, options=WellOptions(degrees=(4, 6)))
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
    data = model_to_data({"regression": one}, CERTIFICATES)["methods"]["regression"]["V"]
    assert {e[0]: c for e, c in zip(data["exponents"], data["coefficients"], strict=True)} == dict(
        enumerate(coefficients)
    )


def test_anything_can_evaluate_a_polynomial_without_this_library(tmp_path: Path) -> None:
    one = decomposition()
    write_model(tmp_path / "model.json", model_to_data({"regression": one}, CERTIFICATES))
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
    formula = expression_from_data(data, (x, y))
    assert float(formula.subs({x: 4.0, y: 5.0})) == pytest.approx(3 * 1.5**2 * 5)


def test_a_formula_that_is_no_polynomial_travels_as_text() -> None:
    data = expression_to_data(sympy.sqrt(x**2 + 1) - y, (x, y))
    assert set(data) == {"formula"}
    assert expression_from_data(data, (x, y)) == sympy.sqrt(x**2 + 1) - y


@pytest.mark.parametrize(
    "formula", ["__import__('os').system('touch TRAP')", "x.real", "9**9**9", "w + 1", "exec('1')"]
)
def test_a_hostile_formula_is_refused(tmp_path: Path, formula: str) -> None:
    path, trap = tmp_path / "model.json", tmp_path / "trap"
    model = model_to_data({"regression": decomposition()}, CERTIFICATES)
    model["methods"]["regression"]["V"] = {"formula": formula.replace("TRAP", str(trap))}
    write_model(path, model)
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
    write_model(tmp_path / "model.json", model_to_data({}, {}))
    assert read_model(tmp_path / "model.json") == ({}, {})


def test_a_model_that_cannot_be_written_leaves_the_old_one(tmp_path: Path) -> None:
    path = tmp_path / "model.json"
    write_model(path, {"states": [], "methods": {}, "certificate": {}})
    before = path.read_bytes()
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_model(path, {"states": [float("nan")]})
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["model.json"]
