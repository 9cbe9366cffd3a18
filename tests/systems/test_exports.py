"""Formulas in other languages give what ours give."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import sympy

from siq.inference.library import monomial_exponents
from siq.systems.formulas import FUNCTIONS, Formula, compile_formulas, parse_formula

POINTS = 10_000
ACCURACY = 1e-12  # of the sum of absolute terms

Evaluate = Callable[[np.ndarray], np.ndarray]


class Case:
    """A formula, points ``(d, n)`` at which to evaluate it, and V, ∇V and sums of absolute terms there."""

    def __init__(self, formula: Formula, points: np.ndarray) -> None:
        self.formula = formula
        self.points = points
        offsets = points - np.array(formula.offsets)[:, None]
        together = (formula.expression, *formula.gradient)
        self.values = compile_formulas(together, formula.symbols)(offsets)
        self.sums = np.stack(
            [
                np.abs(compile_formulas(sympy.Add.make_args(each), formula.symbols)(offsets)).sum(axis=0)
                for each in together
            ]
        )

    def check(self, values: np.ndarray) -> None:
        assert values.shape[1:] == (POINTS,)
        assert (np.abs(values - self.values[: len(values)]) <= ACCURACY * self.sums[: len(values)]).all()


def powers(center: list[float], scale: list[float], degree: int, *, seed: int = 0) -> Case:
    d = len(center)
    draw = np.random.default_rng(seed)
    symbols = tuple(sympy.Symbol(name, real=True) for name in "xyz"[:d])
    exponents = np.array([row for row in monomial_exponents(d, degree) if sum(row) >= 2])
    formula = Formula.of_powers(
        "V", symbols, center=np.array(center), scale=np.array(scale), exponents=exponents,
        coefficients=draw.normal(size=len(exponents)), units=("mm",) * d,
    )  # fmt: skip
    points = np.array(center)[:, None] + np.array(scale)[:, None] * draw.uniform(-2, 2, (d, POINTS))
    return Case(formula, points)


def functions() -> Case:
    names = {name: sympy.Symbol(name, real=True) for name in ("lambda_", "double", "end")}
    text = (
        "Max(lambda_, double, 0.3)*pi + Min(end, 1)/3 + Abs(end)/7 + sign(double) + tanh(lambda_*end)"
        " + 1/(1 + end**2) + exp(-double**2) + atan(end) + sqrt(1 + lambda_**2) + sin(end) + cos(double)"
        " + tan(end/4) + log(1 + double**2)"
    )
    points = np.random.default_rng(1).normal(size=(3, POINTS))
    return Case(Formula("U", parse_formula(text, names), tuple(names.values())), points)


def product() -> Case:
    """Multiplied out, its terms would be 10⁸ times as large as it."""
    x, y = sympy.symbols("x y", real=True)
    points = np.array([[100.0], [50.0]]) + np.random.default_rng(2).normal(size=(2, POINTS))
    return Case(Formula("V", (x - 100) ** 4 * (y - 50) ** 2 + (x - 100) ** 2, (x, y)), points)


def one_state() -> Case:
    x, y = sympy.symbols("x y", real=True)
    points = np.random.default_rng(3).normal(size=(2, POINTS))
    return Case(Formula("V", x**4 / 4 - sympy.Rational(1, 3) * x**2, (x, y)), points)


CASES = {
    "resonator": cache(lambda: powers([-0.0071, -0.0109], [0.011, 0.009], 10)),
    "far from zero": cache(lambda: powers([1000.25, -300.1, 0.0], [0.3, 2.0, 1.0], 6)),
    "functions": cache(functions),
    "product": cache(product),
    "a state that does not matter": cache(one_state),
}


@pytest.fixture(params=list(CASES))
def case(request: pytest.FixtureRequest) -> Case:
    return CASES[request.param]()


def test_numpy_source_gives_the_same(case: Case) -> None:
    module: dict[str, object] = {}
    exec(case.formula.source("numpy"), module)
    name = case.formula.name
    value, gradient = module[name], module[f"{name}_gradient"]
    assert callable(value) and callable(gradient)
    case.check(np.stack([value(*case.points), *gradient(*case.points)]))
    grid = [row.reshape(100, 100) for row in case.points]
    assert np.array_equal(gradient(*grid).reshape(len(grid), -1), gradient(*case.points))
    assert np.shape(gradient(*case.points[:, 0])) == (len(grid),)


def test_torch_source_gives_the_same(case: Case) -> None:
    torch = pytest.importorskip("torch")
    module: dict[str, object] = {}
    exec(case.formula.source("torch"), module)
    value, gradient = module[case.formula.name], module[f"{case.formula.name}_gradient"]
    assert callable(value) and callable(gradient)
    points = torch.tensor(case.points)
    case.check(torch.cat([value(*points)[None], gradient(*points)]).numpy())
    assert gradient(*points[:, 0]).shape == (len(points),)


def test_jax_source_gives_the_same(case: Case) -> None:
    jax = pytest.importorskip("jax")
    jax.config.update("jax_enable_x64", True)
    module: dict[str, object] = {}
    exec(case.formula.source("jax"), module)
    value, gradient = module[case.formula.name], module[f"{case.formula.name}_gradient"]
    assert callable(value) and callable(gradient)
    case.check(np.stack([jax.jit(value)(*case.points), *jax.jit(gradient)(*case.points)]))


def test_c_source_gives_the_same(case: Case, tmp_path: Path) -> None:
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("there is no C compiler called cc")
    source, library = tmp_path / "formula.c", tmp_path / "formula.so"
    source.write_text(case.formula.source("c"), encoding="utf-8")
    warnings = ["-Wall", "-Wextra", "-Werror"]
    subprocess.run(
        [compiler, "-std=c99", *warnings, "-shared", "-fPIC", "-o", library, source, "-lm"], check=True
    )
    compiled = ctypes.CDLL(str(library))
    d, name = len(case.points), case.formula.name
    value, gradient = compiled[name], compiled[f"{name}_gradient"]
    value.argtypes, value.restype = [ctypes.c_double] * d, ctypes.c_double
    gradient.argtypes = [ctypes.c_double] * d + [ctypes.POINTER(ctypes.c_double)]
    slopes = (ctypes.c_double * d)()
    found = np.empty((1 + d, POINTS))
    for column, point in enumerate(case.points.T.tolist()):
        found[0, column] = value(*point)
        gradient(*point, slopes)
        found[1:, column] = slopes
    case.check(found)


def test_julia_source_gives_the_same(case: Case, tmp_path: Path) -> None:
    julia = shutil.which("julia")
    if julia is None:
        pytest.skip("there is no julia on the path")
    name = case.formula.name
    np.savetxt(tmp_path / "points.txt", case.points.T, fmt="%.17g")
    (tmp_path / "run.jl").write_text(
        case.formula.source("julia")
        + 'for line in eachline("points.txt")\n'
        + "    p = parse.(Float64, split(line))\n"
        + f'    println(join([{name}(p...); {name}_gradient(p...)], " "))\nend\n',
        encoding="utf-8",
    )
    ran = subprocess.run([julia, "run.jl"], cwd=tmp_path, check=True, capture_output=True, text=True)
    case.check(np.array([line.split() for line in ran.stdout.splitlines()], dtype=float).T)


def test_julia_source_is_whole(case: Case) -> None:
    source = case.formula.source("julia")
    assert source.count("(") == source.count(")") and source.count("[") == source.count("]")
    assert "Not supported" not in source and "?" not in source
    assert source.count("function ") == source.count("\nend\n") == 2


def test_text_is_read_back_by_our_own_parser(case: Case) -> None:
    names = {symbol.name: symbol for symbol in case.formula.symbols}
    names |= {f"{name}_": symbol for name, symbol in names.items()}  # for those that programs do not allow
    variables, values = list(case.formula.symbols), case.points
    for line in case.formula.source("text").splitlines():
        if not line.startswith("#"):
            name, text = line.split(" = ")
            last = compile_formulas([parse_formula(text, names)], variables)(values)
            names[name] = sympy.Symbol(name, real=True)
            variables, values = [*variables, names[name]], np.concatenate([values, last])
    case.check(last)


def test_the_sympy_expression_gives_the_same(case: Case) -> None:
    case.check(compile_formulas([case.formula.to_sympy()], case.formula.symbols)(case.points))


def test_latex_has_every_term_and_balanced_braces(case: Case) -> None:
    for digits in (4, 17):
        text = case.formula.to_latex(digits=digits)
        assert text.count("{") == text.count("}")
        assert text.count(r"\left") == text.count(r"\right")
        assert text.count(r"\begin{aligned}") == text.count(r"\end{aligned}") == any(case.formula.offsets)
    terms = sympy.Add.make_args(case.formula.expression)
    last = text.split("&= ")[-1]
    if any(case.formula.offsets):  # sums of powers: a sign stands between any two terms
        assert last.count(" + ") + last.count(" - ") == len(terms) - 1
    for name in (symbol.name for symbol in case.formula.expression.free_symbols):
        assert sympy.latex(sympy.Symbol(name)) in text


def test_every_function_of_the_formula_language_is_exported() -> None:
    text = CASES["functions"]().formula.source("text")
    assert all(name in text for name in FUNCTIONS)


def test_what_a_unit_contains_cannot_leave_the_comment() -> None:
    x = sympy.Symbol("x", real=True)
    formula = Formula("V", x**2, (x,), units=("m\nimport os\u2028\r#\\",), title="of\n\n1/0 \\")
    for language, mark in (("numpy", "#"), ("c", "//"), ("text", "#")):
        source = formula.source(language)
        header = source[: source.index("V(x)", 8) if source.count("V(x)") > 1 else None].splitlines()
        assert [line for line in header if "import os" in line or "1/0" in line] == [
            line for line in header if line.startswith(mark) and ("import os" in line or "1/0" in line)
        ]
        assert not any(line.endswith("\\") for line in source.splitlines())


@pytest.mark.parametrize("name", ["x): import os; (", "x y", "", "1x"])
def test_a_name_that_no_program_allows_is_refused(name: str) -> None:
    symbol = sympy.Symbol(name, real=True)
    with pytest.raises(ValueError, match="name in a program"):
        Formula("V", symbol**2, (symbol,))
    with pytest.raises(ValueError, match="name in a program"):
        Formula(name, sympy.S.One, ())


def test_a_formula_with_anything_but_states_is_refused() -> None:
    x, mu = sympy.symbols("x mu", real=True)
    with pytest.raises(ValueError, match="mu in V is no state"):
        Formula("V", mu * x**2, (x,))
    with pytest.raises(ValueError, match="not finite"):
        Formula("V", x + sympy.oo, (x,))
    with pytest.raises(ValueError, match="2 units for 1 states"):
        Formula("V", x, (x,), units=("m", "s"))
