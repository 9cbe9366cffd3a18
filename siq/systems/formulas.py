"""Formulas of people: text, checked against a whitelist, to sympy, numpy, machine code and other languages.

A formula is data. Its text is parsed into a syntax tree, of which only numbers, declared names, the operators
``+ - * / **`` and named functions are accepted; the sympy expression is then built node by node. Nothing is
ever evaluated as code, as sympy's own parser does.

Expressions are evaluated as numpy functions (`compile_formulas`, `compile_values`).

For other programs a formula is written as text, LaTeX, and source in numpy, C and Julia. A polynomial about a
center is written in powers of the offsets from it by Horner's rule, never multiplied out: expanded, its terms
would be far larger than their sum. Numbers have the digits that it takes to read the same double back.
"""

from __future__ import annotations

import ast
import builtins
import functools
import keyword
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import sympy
from sympy.printing.c import C99CodePrinter, reserved_words
from sympy.printing.julia import JuliaCodePrinter
from sympy.printing.latex import LatexPrinter
from sympy.printing.numpy import NumPyPrinter
from sympy.printing.str import StrPrinter

from siq.errors import Fault, suggestion

FUNCTIONS: Mapping[str, Callable[..., sympy.Expr]] = {
    "sin": sympy.sin,
    "cos": sympy.cos,
    "tan": sympy.tan,
    "exp": sympy.exp,
    "log": sympy.log,
    "sqrt": sympy.sqrt,
    "tanh": sympy.tanh,
    "atan": sympy.atan,
    "Abs": sympy.Abs,
    "sign": sympy.sign,
    "Max": sympy.Max,
    "Min": sympy.Min,
}
"""The functions that a formula may use, by the names that it uses for them."""


class delay(sympy.Function):  # noqa: N801 (the name that formulas use)
    """``delay(u, tau)``: the input u as it was a time tau ago.

    It stands for itself; only what knows the course of the input can evaluate it, see
    `siq.systems.dynamics`.
    """

    nargs = 2
    is_real = True


CONSTANTS: Mapping[str, sympy.Expr] = {"pi": sympy.pi}

LARGEST_EXPONENT = 32  # numerical: several such powers of states of the order of 10 stay doubles
LARGEST_BASE = 1e9  # numerical: the same for numbers in formulas; (1e9)^32 = 1e288 is still a double
LARGEST_VALUE = 1e300  # numerical: below the largest double, 1.8e308
MAX_COMPILED = 4096  # compiled formulas that are kept: each takes some kilobytes
DIGITS = 17  # of decimal digits, that a double is read back exactly
MAX_FORMULA_LENGTH = 20_000  # characters, a guard against files that are no formulas

_OPERATORS: Mapping[type[ast.operator], Callable[[sympy.Expr, sympy.Expr], sympy.Expr]] = {
    ast.Add: lambda left, right: left + right,
    ast.Sub: lambda left, right: left - right,
    ast.Mult: lambda left, right: left * right,
    ast.Div: lambda left, right: left / right,
}


class FormulaError(Fault):
    """A formula that the whitelist refuses; the fault names the offending part."""


def parse_formula(
    text: str | float, names: Mapping[str, sympy.Expr], *, inputs: Collection[str] = ()
) -> sympy.Expr:
    """Build a sympy expression from the text of a formula.

    Parameters
    ----------
    text
        The formula, such as ``"-2*(x**3 - x) - y"``; a plain number is a formula as well.
    names
        What every name in the formula stands for: states as symbols, parameters as numbers.
    inputs
        Those of the names that may be delayed, ``delay(u, tau)``.

    Returns
    -------
    sympy.Expr
        The expression; numbers with a decimal point become floating-point numbers.

    Raises
    ------
    FormulaError
        For anything outside the whitelist: attributes, comparisons, strings, undeclared names, powers
        above `LARGEST_EXPONENT`, a division by zero, the root of a negative number.
    """
    text = str(text)
    if len(text) > MAX_FORMULA_LENGTH:
        raise FormulaError(f"the formula has {len(text)} characters", f"keep it below {MAX_FORMULA_LENGTH}")
    try:
        tree = ast.parse(text.strip(), mode="eval")
        expression = _build(tree.body, names, inputs)
    except (ArithmeticError, SyntaxError, TypeError, ValueError, MemoryError, RecursionError) as error:
        if isinstance(error, FormulaError):
            raise
        raise FormulaError(f"'{_short(text)}' is not a formula", "check brackets and operators") from None
    if expression.has(sympy.zoo, sympy.nan, sympy.oo, -sympy.oo, sympy.I):
        raise FormulaError(f"'{_short(text)}' is not a real number somewhere", "correct the formula")
    return expression


def _build(node: ast.expr, names: Mapping[str, sympy.Expr], inputs: Collection[str]) -> sympy.Expr:
    def build(part: ast.expr) -> sympy.Expr:
        return _build(part, names, inputs)

    match node:
        case ast.Constant(value=bool() as value):
            raise FormulaError(f"'{value}' is not a number", "write 0 or 1")
        case ast.Constant(value=int() as value):
            return sympy.Integer(value) if abs(value) < LARGEST_BASE else sympy.Float(float(value), DIGITS)
        case ast.Constant(value=float() as value):
            if not np.isfinite(value):
                raise FormulaError("a number is too large", "write a finite number")
            return sympy.Float(value, DIGITS)
        case ast.Name(id=name):
            if name in names or name in CONSTANTS:
                return names[name] if name in names else CONSTANTS[name]
            remedy = suggestion(name, names, otherwise="declare it, or correct the spelling")
            raise FormulaError(f"the name '{name}' is not declared", remedy)
        case ast.UnaryOp(op=ast.USub(), operand=operand):
            return -build(operand)
        case ast.UnaryOp(op=ast.UAdd(), operand=operand):
            return build(operand)
        case ast.BinOp(op=ast.Pow(), left=left, right=right):
            return _power(build(left), build(right))
        case ast.BinOp(op=operator) if type(operator) in _OPERATORS:
            return _OPERATORS[type(operator)](build(node.left), build(node.right))
        case ast.BinOp(op=ast.BitXor()):
            raise FormulaError("'^' is not an operator", "write '**' for powers")
        case ast.Call(func=ast.Name(id="delay"), args=arguments, keywords=[]) if inputs:
            built = [build(argument) for argument in arguments]
            if len(built) != 2 or str(built[0]) not in inputs:
                remedy = f"write delay(u, tau) with one of {', '.join(inputs)} as u"
                raise FormulaError("'delay' needs an input and a time", remedy)
            return delay(*built)
        case ast.Call(func=ast.Name(id=name), args=arguments, keywords=[]):
            return _call(name, [build(argument) for argument in arguments])
    raise FormulaError(
        f"'{_short(ast.unparse(node))}' is not allowed in a formula",
        f"use numbers, declared names, + - * / ** and the functions {', '.join(FUNCTIONS)}",
    )


def _power(base: sympy.Expr, exponent: sympy.Expr) -> sympy.Expr:
    # An unbounded power such as 9**9**9, or (10**32)**32 repeated, would be worked out digit by digit.
    if exponent.is_number:
        if not exponent.is_real or abs(float(exponent)) > LARGEST_EXPONENT:
            raise FormulaError(f"the exponent {exponent} is too large", f"keep it below {LARGEST_EXPONENT}")
        if base.is_number and abs(complex(base)) > LARGEST_BASE:
            raise FormulaError("a power of a very large number is taken", "write the number out as a float")
        if base.is_number and base.is_negative and not exponent.is_integer:
            raise FormulaError(
                f"the power {exponent} of the negative number {base} is not real", "correct it"
            )
    return base**exponent


def _call(name: str, arguments: Sequence[sympy.Expr]) -> sympy.Expr:
    if name not in FUNCTIONS:
        remedy = suggestion(name, FUNCTIONS, otherwise=f"use one of {', '.join(FUNCTIONS)}")
        raise FormulaError(f"the function '{name}' is not allowed in a formula", remedy)
    wanted = "at least two arguments" if name in ("Max", "Min") else "one argument"
    if (len(arguments) < 2) if name in ("Max", "Min") else (len(arguments) != 1):
        raise FormulaError(f"'{name}' has {len(arguments)} arguments", f"give it {wanted}")
    if all(argument.is_number for argument in arguments):
        # Worked out at once: sympy would keep a tower such as exp(exp(exp(100))) and choke on it later.
        value = complex(FUNCTIONS[name](*(sympy.Float(float(a), DIGITS) for a in arguments)))
        if value.imag != 0 or not np.isfinite(value.real) or abs(value.real) > LARGEST_VALUE:
            raise FormulaError(f"'{name}' of a number is not a real number of usable size", "correct it")
    return FUNCTIONS[name](*arguments)


def compile_formulas(
    expressions: Sequence[sympy.Expr], variables: Sequence[sympy.Symbol]
) -> Callable[[np.ndarray], np.ndarray]:
    """Turn expressions into one vectorised numpy function.

    Integer powers become products and common parts are worked out once, which makes polynomial vector
    fields several times faster than numpy's power function.

    Parameters
    ----------
    expressions
        What to evaluate, ``m`` expressions in `variables`.
    variables
        The ``d`` symbols, in the order of the components of a point.

    Returns
    -------
    callable
        Maps components of shape ``(d, ...)`` to values of shape ``(m, ...)``: components first, so that
        each is contiguous in memory.
    """
    function = compile_values(expressions, variables)

    def evaluate(components: np.ndarray) -> np.ndarray:
        values = np.empty((len(expressions), *components.shape[1:]))
        for index, value in enumerate(function(*components)):
            values[index] = value
        return values

    return evaluate


def compile_values(
    expressions: Sequence[sympy.Expr], variables: Sequence[sympy.Symbol], *, common: bool = True
) -> Callable[..., Sequence[np.ndarray | float]]:
    """Turn expressions into a function of as many arguments as there are variables.

    Compare `compile_formulas`, whose argument is one array: here some variables may be arrays and others,
    such as parameters, numbers.

    Parameters
    ----------
    expressions, variables
        See `compile_formulas`.
    common
        Whether parts that several expressions share are worked out once. Finding them takes longer than it
        saves for a few short ones.

    Returns
    -------
    callable
        Gives one value for each expression: an array, or a number where only numbers stand in it.
    """
    return _compiled(tuple(expressions), tuple(variables), common)


@functools.lru_cache(maxsize=MAX_COMPILED)
def _compiled(
    expressions: tuple[sympy.Expr, ...], variables: tuple[sympy.Symbol, ...], common: bool
) -> Callable[..., Sequence[np.ndarray | float]]:
    """`compile_values`, once for the same formulas: a diagnosis asks for many of them often."""
    return sympy.lambdify(
        list(variables),
        list(expressions),
        modules=[{"integer_power": _integer_power}, "numpy"],
        printer=_ProductPrinter(),
        cse=common,
        # Renaming is slow, and needed only for names that the generated code may use itself.
        dummify=any(hasattr(np, str(each)) or hasattr(builtins, str(each)) for each in variables),
    )


def exact_number(value: float) -> sympy.Expr:
    """A float as an integer where it is one, so that exact formulas stay exact."""
    return sympy.Integer(int(value)) if float(value).is_integer() else sympy.Float(float(value), DIGITS)


class _ProductPrinter(NumPyPrinter):
    """Writes integer powers as products: numpy's own power is tens of times slower."""

    def __init__(self) -> None:
        super().__init__({"fully_qualified_modules": False, "inline": True, "allow_unknown_functions": True})

    def _print_Pow(self, expr: sympy.Pow, rational: bool = False) -> str:  # noqa: N802 (sympy's name)
        base, exponent = expr.args
        if exponent.is_Integer and 2 <= abs(exponent) <= LARGEST_EXPONENT:
            power = f"integer_power({self._print(base)}, {abs(int(exponent))})"
            return power if exponent > 0 else f"(1.0/{power})"
        return super()._print_Pow(expr, rational=rational)

    def _print_DiracDelta(self, expr: sympy.Expr) -> str:  # noqa: N802
        # The derivative of sign, which a Jacobian has; it is zero but on a set of measure zero.
        return "0.0"

    # Conditions that are numbers and such that are arrays are joined one by one; numpy wants equal shapes.
    def _print_And(self, expr: sympy.And) -> str:  # noqa: N802
        return self._joined("logical_and", expr)

    def _print_Or(self, expr: sympy.Or) -> str:  # noqa: N802
        return self._joined("logical_or", expr)

    def _joined(self, operation: str, expr: sympy.Basic) -> str:
        parts = ", ".join(self._print(each) for each in expr.args)
        one_by_one = self._module_format("functools.reduce")
        return f"{one_by_one}({self._module_format(f'numpy.{operation}')}, [{parts}])"


def _integer_power(base: np.ndarray, exponent: int) -> np.ndarray:
    product = base
    for _ in range(exponent - 1):
        product = product * base
    return product


def _short(text: str) -> str:
    return text if len(text) <= 60 else text[:57] + "..."


LARGEST_INTEGER = 2**31  # of a C int

# _Names that a state may have in a card and may not have in a program.
_JULIA = frozenset(
    {"abstract", "baremodule", "begin", "catch", "const", "do", "elseif", "end", "export", "false", "finally",
     "function", "global", "import", "let", "local", "macro", "module", "mutable", "primitive", "quote",
     "struct", "true", "try", "type", "using"}
)  # fmt: skip
_TAKEN = frozenset(
    {*keyword.kwlist, *reserved_words, *_JULIA, "inline", "restrict", *FUNCTIONS, *CONSTANTS,
     "abs", "fabs", "fmax", "fmin", "functools", "max", "min", "numpy", "pow"}
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Formula:
    """A function of the states, with what others have to know of it.

    Main attributes
    ---------------
    name
        Of the function: ``V``.
    expression
        The function of `symbols`, which stand for the states, or for their offsets from `center`.
    symbols
        The d states, in the order of the arguments.

    Other attributes
    ----------------
    center
        Where the offsets are zero, d numbers; none where the expression is one of the states themselves.
    units
        Of the states.
    title
        What it is, in a line.

    Raises
    ------
    ValueError
        When a name is none that a program could use, the formula is not finite, or something in it is no
        state.

    Examples
    --------
    >>> x = sympy.Symbol("x", real=True)
    >>> print(as_text(Formula("V", x**2 / 2 + x**3 / 3, (x,), center=(0.5,), units=("mm",))))
    # V(x)
    # x in mm
    dx = x - 0.5
    V = dx**3/3 + dx**2/2
    """

    name: str
    expression: sympy.Expr
    symbols: tuple[sympy.Symbol, ...]
    center: tuple[float, ...] = ()
    units: tuple[str, ...] = ()
    title: str = ""

    def __post_init__(self) -> None:
        for name in (self.name, *(symbol.name for symbol in self.symbols)):
            if not name.isidentifier():
                raise Fault(f"'{name}' cannot be a name in a program", "use letters, digits and _")
        unknown = self.expression.free_symbols - set(self.symbols)
        if unknown:
            names = ", ".join(sorted(map(str, unknown)))
            raise Fault(f"{names} in {self.name} is no state", "insert a value")
        if self.expression.has(sympy.nan, sympy.zoo, sympy.oo, -sympy.oo):
            raise ValueError(f"{self.name} is not finite: there is nothing to write")
        for what, values in (("coordinates of a center", self.center), ("units", self.units)):
            if values and len(values) != len(self.symbols):
                raise ValueError(f"there are {len(values)} {what} for {len(self.symbols)} states")

    @classmethod
    def of_powers(
        cls,
        name: str,
        symbols: Sequence[sympy.Symbol],
        *,
        center: np.ndarray,
        scale: np.ndarray,
        exponents: np.ndarray,
        coefficients: np.ndarray,
        units: Sequence[str] = (),
        title: str = "",
    ) -> Formula:
        """``Σ_k c_k Π_i ((x_i - center_i)/scale_i)^e_ki``, written in the units of the states.

        Parameters
        ----------
        name, symbols, units, title
            As of the class.
        center, scale
            Shape ``(d,)``.
        exponents
            Shape ``(m, d)``.
        coefficients
            Shape ``(m,)``.
        """
        plain = coefficients / np.prod(scale.astype(float) ** exponents, axis=1)
        terms = (
            sympy.Float(value, DIGITS) * sympy.Mul(*(s ** int(e) for s, e in zip(symbols, row, strict=True)))
            for value, row in zip(plain, exponents, strict=True)
            if value != 0
        )
        return cls(
            name, sympy.Add(*terms), tuple(symbols), tuple(float(c) for c in center), tuple(units), title
        )

    @property
    def gradient(self) -> tuple[sympy.Expr, ...]:
        """Its derivatives by the states, in the symbols of `expression`; a jump counts for nothing."""
        return tuple(_without_jumps(self.expression.diff(symbol)) for symbol in self.symbols)

    @property
    def offsets(self) -> tuple[float, ...]:
        """The center, zero where there is none."""
        return self.center or (0.0,) * len(self.symbols)


def as_sympy(formula: Formula) -> sympy.Expr:
    """The formula as a sympy expression of the states."""
    shifted = {
        symbol: symbol - exact_number(offset)
        for symbol, offset in zip(formula.symbols, formula.offsets, strict=True)
        if offset
    }
    return formula.expression.xreplace(shifted)


def as_text(formula: Formula) -> str:
    """The formula as text that `siq.systems.formulas.parse_formula` reads, a line for each definition."""
    names = _Names(formula)
    return "\n".join(
        [f"# {line}" for line in names.header]
        + [f"{offset} = {definition}" for offset, definition in names.definitions(_Text().doprint)]
        + [f"{formula.name} = {_Text().doprint(formula.expression.xreplace(names.variables))}"]
    )


def as_latex(formula: Formula, *, digits: int = DIGITS) -> str:
    r"""The formula as LaTeX, in an ``aligned`` environment where offsets are defined as well.

    Parameters
    ----------
    formula
        The formula.
    digits
        Significant digits of its numbers, for a page that has no room for 17.
    """
    left = rf"{_latex(sympy.Symbol(formula.name), digits)}"
    offsets = {
        symbol: sympy.Symbol(rf"\Delta_{{{_latex(symbol, digits)}}}")
        for symbol, offset in zip(formula.symbols, formula.offsets, strict=True)
        if offset
    }
    right = _latex(formula.expression.xreplace(offsets), digits)
    if not offsets:
        return f"{left} = {right}"
    lines = [
        rf"{offsets[symbol].name} &= {_latex(symbol - sympy.Float(offset, DIGITS), digits)}"
        for symbol, offset in zip(formula.symbols, formula.offsets, strict=True)
        if offset
    ]
    return "\n".join([r"\begin{aligned}", *(f"{line} \\\\" for line in lines), f"{left} &= {right}",
                      r"\end{aligned}"])  # fmt: skip


class _Names:
    """Names of the states and their offsets in a program, and the lines that define them."""

    def __init__(self, formula: Formula) -> None:
        self._formula = formula
        taken = {*_TAKEN, formula.name, f"{formula.name}_gradient"}
        self.arguments = [_free(symbol.name, taken) for symbol in formula.symbols]
        self.result = _free("gradient", taken)
        self.variables: dict[sympy.Symbol, sympy.Symbol] = {}
        self._defined: list[tuple[str, sympy.Expr]] = []
        for symbol, name, offset in zip(formula.symbols, self.arguments, formula.offsets, strict=True):
            argument = sympy.Symbol(name, real=True)
            if offset:
                shifted = _free(f"d{name}", taken)
                self._defined.append((shifted, argument - exact_number(offset)))
                argument = sympy.Symbol(shifted, real=True)
            self.variables[symbol] = argument

    @property
    def header(self) -> list[str]:
        """Comment above the source: the function, and the states with their units."""
        formula = self._formula
        title = f": {formula.title}" if formula.title else ""
        lines = [f"{formula.name}({', '.join(self.arguments)}){title}"]
        units = formula.units or ("1",) * len(self.arguments)
        lines += [f"{name} in {unit}" for name, unit in zip(self.arguments, units, strict=True)]
        # A unit is the user's text: nothing of it may end a comment.
        return [re.sub(r"[^\S ]+|[\\\x00-\x1f\x7f\x85\u2028\u2029]", " ", line) for line in lines]

    @property
    def ignored(self) -> list[str]:
        """Variables that the function or its derivatives do not contain."""
        formula = self._formula
        common = set(formula.symbols).intersection(*(each.free_symbols for each in (
            formula.expression, *formula.gradient)))  # fmt: skip
        return [str(variable) for symbol, variable in self.variables.items() if symbol not in common]

    def definitions(self, written: Callable[[sympy.Expr], str]) -> list[tuple[str, str]]:
        """Offsets by name, with what they are."""
        return [(name, written(value)) for name, value in self._defined]


def _free(name: str, taken: set[str]) -> str:
    while name in taken:
        name += "_"
    taken.add(name)
    return name


def _without_jumps(expression: sympy.Expr) -> sympy.Expr:
    """A derivative away from where it jumps: no peak there, and steps as signs, which every program has."""
    return expression.replace(sympy.DiracDelta, lambda *_: sympy.S.Zero).replace(
        sympy.Heaviside, lambda place, *_: (1 + sympy.sign(place)) / 2
    )


def _latex(expression: sympy.Expr, digits: int) -> str:
    rounded = {each: sympy.Float(each, digits) for each in expression.atoms(sympy.Float)}
    return str(LatexPrinter({"full_prec": False}).doprint(expression.xreplace(rounded)))


class _Doubles:
    """Numbers with the digits that it takes to read the same double back."""

    def _print_Float(self, expr: sympy.Float) -> str:  # noqa: N802 (sympy's names, here and below)
        return repr(float(expr))

    def _print_Integer(self, expr: sympy.Integer) -> str:  # noqa: N802
        return repr(float(expr)) if abs(expr) >= LARGEST_INTEGER else str(int(expr))


class _Text(_Doubles, StrPrinter):
    pass


SOURCE_WIDTH = 100  # characters after which source goes on in the next line


def numpy_source(formula: Formula, *, gradient: bool = True) -> str:
    """A module of Python with the function ``V(x, y)`` of numbers or arrays, which numpy broadcasts.

    Parameters
    ----------
    formula
        The formula.
    gradient
        Whether ``V_gradient(x, y)`` is written as well: components first, shape ``(d, ...)``.
    """
    names = _Names(formula)
    printer = _NumPy({"fully_qualified_modules": True, "user_functions": {}})
    offsets = [f"    {name} = {text}" for name, text in names.definitions(printer.doprint)]
    value, *slopes = _written(formula, names, printer.doprint)
    arguments = ", ".join(names.arguments)
    lines = [f"# {line}" for line in names.header]
    lines += ["import functools", ""] if any("functools." in each for each in (value, *slopes)) else []
    lines += ["import numpy", "", "", f"def {formula.name}({arguments}):", *offsets]
    lines += ["    return (", *_wrapped(value, 8), "    )"]
    if gradient:
        lines += ["", "", f"def {formula.name}_gradient({arguments}):", *offsets]
        lines += ["    return numpy.stack(numpy.broadcast_arrays("]
        for slope in (*slopes, *(f"0.0*{name}" for name in names.arguments)):
            lines += _wrapped(f"{slope},", 8)
        lines += [f"    )[:{len(slopes)}])"]
    return "\n".join(lines) + "\n"


def c_source(formula: Formula, *, gradient: bool = True) -> str:
    """C99 with the function ``double V(double x, double y)``.

    Parameters
    ----------
    formula
        The formula.
    gradient
        Whether ``void V_gradient(double x, double y, double gradient[2])`` is written as well.
    """
    names = _Names(formula)
    printer = _C()
    offsets = [f"    const double {name} = {text};" for name, text in names.definitions(printer.doprint)]
    value, *slopes = _written(formula, names, printer.doprint)
    arguments = ", ".join(f"double {name}" for name in names.arguments)
    # A compiler would warn of what a formula does not contain.
    ignored = [f"    (void){name};" for name in names.ignored]
    lines = [f"// {line}" for line in names.header]
    lines += ["#include <math.h>", "", f"double {formula.name}({arguments})", "{", *offsets, *ignored]
    lines += ["    return", *_wrapped(f"{value};", 8), "}"]
    if gradient:
        lines += ["", f"void {formula.name}_gradient({arguments}, double {names.result}[{len(slopes)}])"]
        lines += ["{", *offsets, *ignored]
        for place, slope in enumerate(slopes):
            lines += [f"    {names.result}[{place}] =", *_wrapped(f"{slope};", 8)]
        lines += ["}"]
    return "\n".join(lines) + "\n"


def julia_source(formula: Formula, *, gradient: bool = True) -> str:
    """Julia with the function ``V(x, y)`` of numbers; ``V.(x, y)`` takes arrays.

    Parameters
    ----------
    formula
        The formula.
    gradient
        Whether ``V_gradient(x, y)`` is written as well, which returns a vector.
    """
    names = _Names(formula)
    printer = _Julia()
    offsets = [f"    {name} = {text}" for name, text in names.definitions(printer.doprint)]
    value, *slopes = _written(formula, names, printer.doprint)
    arguments = ", ".join(names.arguments)
    lines = [f"# {line}" for line in names.header]
    lines += [f"function {formula.name}({arguments})", *offsets, "    return (", *_wrapped(value, 8)]
    lines += ["    )", "end"]
    if gradient:
        lines += ["", f"function {formula.name}_gradient({arguments})", *offsets, "    return ["]
        for slope in slopes:
            lines += ["        (", *_wrapped(slope, 12), "        ),"]
        lines += ["    ]", "end"]
    return "\n".join(lines) + "\n"


def _written(formula: Formula, names: _Names, written: Callable[[sympy.Expr], str]) -> list[str]:
    """The function and its derivatives, a sum of powers by Horner's rule, and a number in the place of π."""
    texts = []
    for each in (formula.expression, *formula.gradient):
        powers = _powers(each, formula.symbols)
        if powers is not None:
            each = _horner(powers, formula.symbols)
        else:
            each = each.xreplace({one: sympy.Float(one, DIGITS) for one in each.atoms(sympy.NumberSymbol)})
        texts.append(written(each.xreplace(names.variables)))
    return texts


def _powers(
    expression: sympy.Expr, symbols: Sequence[sympy.Symbol]
) -> Mapping[tuple[int, ...], sympy.Expr] | None:
    """Coefficients by exponents of a sum of powers as it stands, None of anything else."""
    found: dict[tuple[int, ...], sympy.Expr] = {}
    for term in sympy.Add.make_args(expression):
        coefficient, function = term.as_independent(*symbols, as_Add=False)
        parts = function.as_powers_dict()
        parts.pop(sympy.S.One, None)
        if not set(parts) <= set(symbols) or not all(e.is_Integer and e > 0 for e in parts.values()):
            return None
        exponents = tuple(int(parts.get(symbol, 0)) for symbol in symbols)
        if exponents in found:
            return None
        found[exponents] = coefficient if coefficient.is_Rational else sympy.Float(float(coefficient), DIGITS)
    return found


def _horner(powers: Mapping[tuple[int, ...], sympy.Expr], symbols: Sequence[sympy.Symbol]) -> sympy.Expr:
    if not symbols:
        return sympy.Add(*powers.values())
    highest = max((exponents[0] for exponents in powers), default=0)
    total = sympy.S.Zero
    for power in range(highest, -1, -1):
        rest = {exponents[1:]: value for exponents, value in powers.items() if exponents[0] == power}
        total = _horner(rest, symbols[1:]) + symbols[0] * total
    return total


def _wrapped(source: str, indent: int) -> list[str]:
    """Source in lines of bearable length, each but the last ending with an operator."""
    lines, line = [], " " * indent
    for piece in re.split(r"(?<= [-+*/]) ", source):
        if line.strip() and len(line) + len(piece) > SOURCE_WIDTH:
            lines.append(line.rstrip())
            line = " " * indent
        line += piece + " "
    return [*lines, line.rstrip()]


class _NumPy(_Doubles, NumPyPrinter):
    pass


class _C(_Doubles, C99CodePrinter):
    pass


class _Julia(_Doubles, JuliaCodePrinter):
    def _print_Max(self, expr: sympy.Expr) -> str:  # noqa: N802
        return f"max({', '.join(map(self._print, expr.args))})"

    def _print_Min(self, expr: sympy.Expr) -> str:  # noqa: N802
        return f"min({', '.join(map(self._print, expr.args))})"
