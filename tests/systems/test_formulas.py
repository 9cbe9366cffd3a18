from __future__ import annotations

import math
import signal
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest
import sympy

from siq.systems.formulas import FUNCTIONS, FormulaError, compile_formulas, compile_values, parse_formula

x, y, zeta = (sympy.Symbol(name, real=True) for name in ("x", "y", "zeta"))
NAMES = {"x": x, "y": y, "zeta": zeta}
TINY_POINTS = np.random.default_rng(0).uniform(0.1, 2, size=(2, 50))


@contextmanager
def time_limit(seconds: int) -> Iterator[None]:
    def stop(*_: object) -> None:
        raise TimeoutError(f"took more than {seconds} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def compiled(text: str, points: np.ndarray) -> np.ndarray:
    return compile_formulas([parse_formula(text, NAMES)], (x, y))(points)[0]


@pytest.mark.parametrize(
    "text",
    [
        '__import__("os").system("ls")',
        "x.__class__",
        "x.real",
        "x[0]",
        "x < y",
        "x == y",
        "x and y",
        "not x",
        "~x",
        "x if y else 1",
        "lambda: 1",
        "[x for x in y]",
        "{x}",
        "(x, y)",
        "(x := 1)",
        "'x'",
        "f'{x}'",
        "b'x'",
        "None",
        "...",
        "True*x",
        "1j*x",
        "x // y",
        "x % y",
        "x @ y",
        "x << 2",
        "x^2",
        "(x)(y)",
        "sin(x=1)",
        "sin(x, evaluate=1)",
        "sin(*x)",
        "sin(**x)",
        "sin(x, y)",
        "sin()",
        "Max(x)",
        "eval(x)",
        "lambdify(x)",
        "9**9**9",
        "x**33",
        "x**-33",
        "x**1" + "0" * 400,
        "1" + "0" * 400 + "**2",
        "(2**32)**32",
        "10**exp(5)",
        "1/0",
        "0**-1",
        "0/0",
        "x/(y - y)",
        "sqrt(-1)",
        "sqrt(-x**2)",
        "log(-1)",
        "log(0)",
        "1e999",
        "nan",
        "inf",
        "",
        "x;y",
        "x = 1",
        "import os",
        "x +",
        "(x",
        "\0",
        "-" * 5000 + "x",
        "(" * 300 + "x" + ")" * 300,
        "x+" * 9000 + "x",
        "x" * 20_001,
    ],
)
def test_what_is_not_on_the_whitelist_is_refused(text: str) -> None:
    with time_limit(10), pytest.raises(FormulaError) as caught:
        parse_formula(text, NAMES)
    assert caught.value.fault
    assert caught.value.remedy
    assert len(str(caught.value)) < 1000


@pytest.mark.parametrize("text", ["(-2)**(1/3)", "x*(-8)**(1/3)", "(-2.0)**0.5 + x"])
def test_a_fractional_power_of_a_negative_number_is_refused(text: str) -> None:
    with pytest.raises(FormulaError):
        parse_formula(text, NAMES)


def test_an_exponent_too_large_to_be_worked_out_is_refused_at_once() -> None:
    with time_limit(5), pytest.raises(FormulaError):
        parse_formula("x**exp(exp(exp(100)))", NAMES)


@pytest.mark.parametrize("text", ["exp(exp(exp(exp(9.0))))", "1" + "0" * 400 + "*x"], ids=["nested", "long"])
def test_a_number_beyond_floating_point_is_refused_as_a_formula_error(text: str) -> None:
    with time_limit(5), pytest.raises(FormulaError):
        compiled(text, TINY_POINTS)


@pytest.mark.parametrize(
    ("text", "remedy"),
    [
        ("2*zetta", "perhaps you meant 'zeta'"),
        ("sine(x)", "perhaps you meant 'sin'"),
        ("x^2", "write '**' for powers"),
    ],
)
def test_a_slip_is_told_with_what_was_probably_meant(text: str, remedy: str) -> None:
    with pytest.raises(FormulaError) as caught:
        parse_formula(text, NAMES)
    assert caught.value.remedy == remedy


@pytest.mark.parametrize(
    ("written", "meant"),
    [
        ("abs(x)", "Abs(x)"),
        ("max(x, 1)", "Max(x, 1)"),
        ("min(x, 1)", "Min(x, 1)"),
        ("ln(x)", "log(x)"),
        ("arctan(x)", "atan(x)"),
    ],
)
def test_a_function_may_have_the_name_that_other_languages_give_it(written: str, meant: str) -> None:
    assert parse_formula(written, NAMES) == parse_formula(meant, NAMES)


def test_an_undeclared_name_is_named() -> None:
    with pytest.raises(FormulaError, match="the name 'omega' is not declared"):
        parse_formula("omega*x", NAMES)


def test_every_function_evaluates_as_the_math_module_does() -> None:
    reference = {
        "sin": math.sin,
        "cos": math.cos,
        "tan": math.tan,
        "exp": math.exp,
        "log": math.log,
        "sqrt": math.sqrt,
        "tanh": math.tanh,
        "atan": math.atan,
        "Abs": abs,
        "sign": lambda value: math.copysign(1.0, value),
        "Max": max,
        "Min": min,
    }
    assert set(reference) == set(FUNCTIONS)
    for name, function in reference.items():
        two = name in ("Max", "Min")
        points = TINY_POINTS if name in ("log", "sqrt") else TINY_POINTS - 1.05
        expected = [function(*(point if two else point[:1])) for point in points.T]
        values = compiled(f"{name}(x, y)" if two else f"{name}(x)", points)
        np.testing.assert_allclose(values, expected, rtol=1e-14, err_msg=name)


def test_max_and_min_take_numbers_among_their_arguments() -> None:
    points = TINY_POINTS - 1
    np.testing.assert_array_equal(compiled("Max(x, 0, y)", points), np.maximum(points.max(axis=0), 0))
    np.testing.assert_array_equal(compiled("Min(x, 0.5)", points), np.minimum(points[0], 0.5))


@pytest.mark.parametrize("exponent", [*range(-8, 9), 32, -32])
def test_integer_powers_equal_those_of_numpy(exponent: int) -> None:
    points = TINY_POINTS - 3  # negative bases as well
    np.testing.assert_allclose(compiled(f"x**({exponent})", points), points[0] ** exponent, rtol=1e-13)
    np.testing.assert_allclose(
        compiled(f"(x + 2*y)**({exponent})", points), (points[0] + 2 * points[1]) ** exponent, rtol=1e-13
    )


def test_fractional_powers_equal_those_of_numpy() -> None:
    np.testing.assert_allclose(compiled("x**0.3 + y**(5/2)", TINY_POINTS),
                               TINY_POINTS[0] ** 0.3 + TINY_POINTS[1] ** 2.5, rtol=1e-14)  # fmt: skip


class CountedNumber(float):
    """A number that counts the products in which it stands on the left."""

    products = 0

    def __mul__(self, other: float) -> CountedNumber:
        CountedNumber.products += 1
        return CountedNumber(float(self) * float(other))

    def __add__(self, other: float) -> CountedNumber:
        return CountedNumber(float(self) + float(other))

    __radd__ = __add__


def test_nested_powers_take_no_more_products_than_they_have_levels() -> None:
    text, expected = "x", 0.1
    for _ in range(10):
        text, expected = f"(({text})**2 + y)", expected**2 + 0.3
    points = np.array([CountedNumber(0.1), CountedNumber(0.3)], dtype=object)
    CountedNumber.products = 0
    assert compiled(text, points) == pytest.approx(expected, rel=1e-14)
    assert CountedNumber.products <= 20


def test_constants_broadcast_over_points_of_any_shape() -> None:
    function = compile_formulas([parse_formula("pi", NAMES), parse_formula("x", NAMES)], (x, y))
    assert function(np.zeros((2, 3, 4))).shape == (2, 3, 4)
    assert function(np.zeros(2)).shape == (2,)
    np.testing.assert_array_equal(function(np.zeros((2, 5)))[0], np.full(5, math.pi))


def test_a_plain_number_is_a_formula() -> None:
    assert parse_formula(0, NAMES) == 0
    assert float(parse_formula(2.5e-3, NAMES)) == 2.5e-3
    assert float(parse_formula("4.5e-4", NAMES)) == 4.5e-4


@pytest.mark.parametrize("number", [1 / 3, 0.1 + 0.2, 2 / 3 * 1e-9, 1.7976931348623157e308, 4.5e-4])
def test_numbers_keep_all_their_digits(number: float) -> None:
    formula = parse_formula(repr(number), NAMES)
    assert float(formula) == number
    assert float(str(formula)) == number
    assert compiled(f"{number!r}*x", np.array([1.0, 0.0])) == number


@pytest.mark.parametrize("name", ["x", "_part"])
def test_names_such_as_those_of_common_parts_do_not_clash(name: str) -> None:
    x0, x1 = (sympy.Symbol(f"{name}{place}", real=True) for place in range(2))
    texts = ["sin(x0*x1) + x1", "sin(x0*x1)**2 + exp(x1 - x0)", "exp(x1 - x0)*x0"]
    function = compile_formulas([parse_formula(text, {"x0": x0, "x1": x1}) for text in texts], (x0, x1))
    a, b = TINY_POINTS
    expected = [np.sin(a * b) + b, np.sin(a * b) ** 2 + np.exp(b - a), np.exp(b - a) * a]
    np.testing.assert_allclose(function(TINY_POINTS), expected, rtol=1e-14)


def test_compiled_values_equal_those_of_sympy_on_a_random_formula() -> None:
    formula = parse_formula("-2*(x**3 - x)*exp(-y**2/3) + tanh(x*y)/(1 + x**2)**2 - 0.7*Abs(y)", NAMES)
    values = compile_formulas([formula], (x, y))(TINY_POINTS)[0]
    expected = [float(formula.subs({x: a, y: b}).evalf(20)) for a, b in TINY_POINTS.T]
    np.testing.assert_allclose(values, expected, rtol=1e-13)


def test_parts_under_a_condition_are_worked_out_as_without_it() -> None:
    part = sympy.exp(x * y) + sympy.sqrt(1 + x**2)
    formulas = [sympy.Piecewise((part, x > y), (-part, True)), x * part**-2, part]
    values = compile_formulas(formulas, (x, y))(TINY_POINTS)
    expected = [[float(each.subs({x: a, y: b})) for a, b in TINY_POINTS.T] for each in formulas]
    np.testing.assert_allclose(values, expected, rtol=1e-13)


def test_derivatives_of_a_limit_take_numbers_beside_arrays() -> None:
    x, limit = sympy.symbols("x limit", real=True)
    slopes = compile_values([sympy.Min(10, limit, x).diff(x), sympy.Max(-limit, x).diff(limit)], [x, limit])
    by_state, by_limit = slopes(np.array([-6.0, 3.0, 7.0, 12.0]), 5.0)
    assert by_state.tolist() == [1, 1, 0, 0]
    assert by_limit.tolist() == [-1, 0, 0, 0]
