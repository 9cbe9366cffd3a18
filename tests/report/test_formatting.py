from xml.etree import ElementTree

import numpy as np
import pytest
import sympy

from siq.data.recordings import Recordings
from siq.report.formatting import _formula_text, array_mathml, formula_mathml, with_unit

x, y, z = sympy.symbols("x y z", real=True)
IDENTIFIED = 0.9991 * y**2 + 1.0009 - 2.0012 * x**2 + 0.9991 * z**2 + 1.0001 * x**4


def shown(markup: str) -> str:
    """What a reader sees of MathML, with all spaces left out."""
    return "".join(ElementTree.fromstring(markup).itertext()).replace("\u2062", "")


def test_the_papers_formula_reads_as_in_the_paper() -> None:
    assert _formula_text(IDENTIFIED) == "1.000 x⁴ − 2.001 x² + 0.999 y² + 0.999 z² + 1.001"
    assert shown(formula_mathml(IDENTIFIED)) == "1.000x4−2.001x2+0.999y2+0.999z2+1.001"


@pytest.mark.parametrize(
    ("expression", "text"),
    [
        (x**4 - 2 * x**2 + 1, "x⁴ − 2 x² + 1"),
        (-1.0 * y - 1.0 * z, "−1.000 y − 1.000 z"),
        (y - x * y, "−x y + y"),
        (x / 2, "(1/2) x"),
        (2.0 * sympy.sin(3 * x) + x, "x + 2.000 sin(3 x)"),
        ((x + 1) ** 2 * y, "y (x + 1)²"),
        (x / y, "x y⁻¹"),
        (x ** sympy.Float(2.0), "x²"),
        (4.5e-4 * x - 3e9, "4.500 × 10⁻⁴ x − 3.000 × 10⁹"),
        (sympy.Float(0), "0.000"),
        (sympy.Integer(0), "0"),
    ],
)
def test_formula_text(expression: sympy.Expr, text: str) -> None:
    assert _formula_text(expression) == text


@pytest.mark.parametrize(
    "expression",
    [
        IDENTIFIED,
        sympy.pi * sympy.exp(-x) + sympy.sqrt(x) / (1 + y),
        sympy.Max(x, y)
        + sympy.Abs(x - 1.5)
        + sympy.sign(x)
        + sympy.tanh(x) ** 2
        + sympy.atan(x)
        + sympy.log(x),
        sympy.Symbol("omega_0") ** sympy.Rational(3, 2),
        sympy.Float("nan"),
    ],
)
def test_mathml_is_wellformed_xml(expression: sympy.Expr) -> None:
    root = ElementTree.fromstring(formula_mathml(expression))
    assert root.tag == "math"
    assert root.attrib["aria-label"]


def test_powers_and_scientific_notation_are_superscripts() -> None:
    root = ElementTree.fromstring(formula_mathml(4.5e-4 * x**3))
    assert ["".join(power.itertext()) for power in root.iter("msup")] == ["10−4", "x3"]


def test_a_long_sum_stands_on_several_lines() -> None:
    sum_of_many = sympy.Add(*(1.25 * x**power for power in range(1, 13)))
    root = ElementTree.fromstring(formula_mathml(sum_of_many))
    assert len(list(root.iter("mtr"))) > 1
    assert shown(formula_mathml(sum_of_many)).startswith("1.250x12+1.250x11")


def test_a_vector_is_a_column_in_brackets() -> None:
    root = ElementTree.fromstring(array_mathml([2.001 * x**3 - 2.001 * x, 0.999 * y, 0.999 * z], decimals=2))
    assert ["".join(row.itertext()).replace("\u2062", "") for row in root.iter("mtr")] == [
        "2.00x3−2.00x",
        "1.00y",
        "1.00z",
    ]
    assert "".join(root.itertext())[0] + "".join(root.itertext())[-1] == "[]"


def test_hostile_names_are_escaped() -> None:
    markup = formula_mathml(sympy.Symbol("<script>alert(1)</script>") * sympy.Symbol("&lt;b&gt;"))
    ElementTree.fromstring(markup)
    assert "<script" not in markup
    assert "<b>" not in markup


def test_a_matrix_has_brackets_unless_it_is_one_entry() -> None:
    assert shown(array_mathml([[1.0, -0.5], [-0.5, 2.0]])) == "[1−0.5000−0.50002]"
    assert shown(array_mathml([[2.0]])) == "2" and shown(array_mathml([[x + 1]])) == "x+1"


@pytest.mark.parametrize("middle", [101325.2, -39.3, 0.3175])
def test_a_state_moved_by_a_round_number_has_one_title_on_a_page(middle: float) -> None:
    values = np.random.default_rng(0).uniform(-3, 3, (500, 1)) * abs(middle) / 1000
    moved = Recordings.from_arrays(np.arange(500.0), middle + values, names=["p"]).centred(degree=5)
    assert moved.names != ("p",) and with_unit(moved.names[0], "1") == moved.titles[0]
    assert with_unit("x_minus_y", "mm") == "x_minus_y (mm)"
