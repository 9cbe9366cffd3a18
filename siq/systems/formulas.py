"""Formulas: from text, checked against a whitelist, to sympy, numpy, machine code and other languages.

A formula is data. Its text is parsed into a syntax tree, of which only numbers, declared names, the operators
``+ - * / **`` and named functions are accepted; the sympy expression is then built node by node. Nothing is
ever evaluated as code, as sympy's own parser does.

Expressions are evaluated as numpy functions (`compile_formulas`, `compile_values`).

For other programs a formula is written as text, LaTeX, and source in numpy, JAX, torch, C and Julia. A
polynomial about a center is written in powers of the offsets from it by Horner's rule, never multiplied out:
expanded, its terms would be far larger than their sum. Numbers have the digits that it takes to read the same
double back.
"""

from __future__ import annotations

import ast
import builtins
import functools
import keyword
import operator
import re
import signal
import threading
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Literal

import jinja2
import numpy as np
import sympy
from sympy.functions.elementary.piecewise import ExprCondPair
from sympy.printing.c import C99CodePrinter, reserved_words
from sympy.printing.codeprinter import CodePrinter
from sympy.printing.julia import JuliaCodePrinter
from sympy.printing.latex import LatexPrinter
from sympy.printing.numpy import NumPyPrinter
from sympy.printing.str import StrPrinter

from siq.errors import Fault, suggestion

FUNCTIONS: Mapping[str, Callable[..., sympy.Expr]] = {
    "sin": sympy.sin, "cos": sympy.cos, "tan": sympy.tan, "exp": sympy.exp, "log": sympy.log,
    "sqrt": sympy.sqrt, "tanh": sympy.tanh, "atan": sympy.atan, "Abs": sympy.Abs, "sign": sympy.sign,
    "Max": sympy.Max, "Min": sympy.Min,
}  # fmt: skip
"""The functions that a formula may use, by the names that it uses for them."""
OTHER_NAMES = {"abs": "Abs", "max": "Max", "min": "Min", "ln": "log", "arctan": "atan"}  # of the same


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
LONGEST_WORK = 10.0  # seconds of processor time: cards of ten states take less than one
MAX_FORMULA_LENGTH = 20_000  # characters, a guard against files that are no formulas

_OPERATORS: Mapping[type[ast.operator], Callable[[sympy.Expr, sympy.Expr], sympy.Expr]] = {
    ast.Add: lambda left, right: left + right, ast.Sub: lambda left, right: left - right,
    ast.Mult: lambda left, right: left * right, ast.Div: lambda left, right: left / right,
}  # fmt: skip


class FormulaError(Fault):
    """A formula that the whitelist refuses; the fault names the offending part."""


class _TooLong(BaseException):
    """The time is over; no handler of errors may take it for one."""


@contextmanager
def formulas_in_time(what: str) -> Iterator[None]:
    """Refuse formulas on which sympy would work for ever, as where many functions stand in one another.

    Its time grows exponentially with them, and no count of terms predicts it. A timer of the process
    interrupts it after `LONGEST_WORK`; elsewhere than in the main thread, and on systems without such a
    timer, there is no limit.

    Raises
    ------
    FormulaError
        When `what` is not worked out by then.
    """
    main = threading.current_thread() is threading.main_thread()
    if not main or not hasattr(signal, "setitimer") or signal.getitimer(signal.ITIMER_VIRTUAL)[0]:
        yield
        return

    def stop(number: int, frame: object) -> None:
        raise _TooLong

    before = signal.signal(signal.SIGVTALRM, stop)
    signal.setitimer(signal.ITIMER_VIRTUAL, LONGEST_WORK)
    try:
        yield
    except _TooLong:
        fault = f"{what} could not be worked out within {LONGEST_WORK:g} s"
        raise FormulaError(fault, "let fewer functions stand in one another") from None
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)
        signal.signal(signal.SIGVTALRM, before)


def parse_formula(
    text: str | float, names: Mapping[str, sympy.Expr], *, inputs: Collection[str] = ()
) -> sympy.Expr:
    """Build a sympy expression from the text of a formula, such as ``"-2*(x**3 - x) - y"``, or a number.

    Numbers with a decimal point become floating-point numbers.

    Parameters
    ----------
    names
        What every name in the formula stands for: states as symbols, parameters as numbers.
    inputs
        Those of the names that may be delayed, ``delay(u, tau)``.

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
        expression = _build(ast.parse(text.strip(), mode="eval").body, names, inputs)
    except FormulaError:
        raise
    except (ArithmeticError, SyntaxError, TypeError, ValueError, MemoryError, RecursionError):
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
    name = OTHER_NAMES.get(name, name)
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
    """Turn m expressions in d variables into one vectorised numpy function.

    It maps components of shape ``(d, ...)`` to values of shape ``(m, ...)``: components first, so that each
    is contiguous in memory. Integer powers become products and common parts are worked out once, which makes
    polynomial vector fields several times faster than numpy's power function.
    """
    function = compile_values(expressions, variables)

    def evaluate(components: np.ndarray) -> np.ndarray:
        values = np.empty((len(expressions), *components.shape[1:]))
        one = components.size == len(components)  # point, whose numbers take a fifth of the time of arrays
        for index, value in enumerate(function(*(components.ravel() if one else components))):
            values[index] = value
        return values

    return evaluate


def compile_values(
    expressions: Sequence[sympy.Expr], variables: Sequence[sympy.Symbol]
) -> Callable[..., Sequence[np.ndarray | float]]:
    """Turn expressions into a function of as many arguments as there are variables.

    Compare `compile_formulas`, whose argument is one array: here some variables may be arrays and others,
    such as parameters, numbers. It gives one value for each expression: an array, or a number where only
    numbers stand in it.
    """
    return _compiled(tuple(expressions), tuple(variables))


@functools.lru_cache(maxsize=MAX_COMPILED)
def _compiled(
    expressions: tuple[sympy.Expr, ...], variables: tuple[sympy.Symbol, ...]
) -> Callable[..., Sequence[np.ndarray | float]]:
    """`compile_values`, once for the same formulas: a diagnosis asks for many of them often."""
    return sympy.lambdify(
        list(variables),
        list(expressions),
        modules=[{"integer_power": lambda x, power: functools.reduce(operator.mul, [x] * power)}, "numpy"],
        printer=_ProductPrinter(),
        cse=_common_parts,
        docstring_limit=0,  # to write the formulas out once more would take a third of the time
        # Renaming is slow, and needed only for names that the generated code may use itself.
        dummify=any(
            str(each) == "integer_power" or hasattr(np, str(each)) or hasattr(builtins, str(each))
            for each in variables
        ),
    )


def _common_parts(
    formulas: Sequence[sympy.Expr],
) -> tuple[list[tuple[sympy.Symbol, sympy.Expr]], list[sympy.Expr]]:
    """What stands in formulas more than once, and these with symbols in its place.

    `sympy.cse` simplifies anew whatever it has put a symbol into, which is slow.
    """
    taken = {each.name for formula in formulas for each in formula.free_symbols}
    symbols = (each for each in sympy.numbered_symbols("_part", real=True) if each.name not in taken)
    seen, twice = set[sympy.Basic](), set[sympy.Basic]()
    named: dict[sympy.Basic, sympy.Symbol] = {}
    parts: list[tuple[sympy.Symbol, sympy.Expr]] = []

    def look(at: sympy.Basic) -> None:
        if at in seen:
            twice.add(at)
        elif at.args:
            seen.add(at)
            for each in at.args:
                look(each)

    def written(formula: sympy.Basic) -> sympy.Basic:
        if not formula.args or formula in named:
            return named.get(formula, formula)
        put, result = tuple(map(written, formula.args)), formula
        if put != formula.args:
            kept = {} if isinstance(formula, ExprCondPair) else {"evaluate": False}
            result = formula.func(*put, **kept)
        if formula in twice and isinstance(formula, sympy.Expr):
            parts.append((next(symbols), result))
            result = named[formula] = parts[-1][0]
        return result

    for formula in formulas:
        look(formula)
    return parts, [written(formula) for formula in formulas]


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
            whole, printed = abs(int(exponent)), self._print(base)
            product = f"({'*'.join([printed] * whole)})"  # of a name: a call takes longer for a few points
            power = product if base.is_Symbol else f"integer_power({printed}, {whole})"
            return power if exponent > 0 else f"(1.0/{power})"
        return super()._print_Pow(expr, rational=rational)

    def _print_DiracDelta(self, expr: sympy.Expr) -> str:  # noqa: N802
        # The derivative of sign, which a Jacobian has; it is zero but on a set of measure zero.
        return "0.0"

    # Conditions that are numbers and such that are arrays are joined one by one; numpy wants equal shapes.
    def _print_And(self, expr: sympy.Basic, operation: str = "logical_and") -> str:  # noqa: N802
        parts = ", ".join(self._print(each) for each in expr.args)
        one_by_one = self._module_format("functools.reduce")
        return f"{one_by_one}({self._module_format(f'numpy.{operation}')}, [{parts}])"

    def _print_Or(self, expr: sympy.Basic) -> str:  # noqa: N802
        return self._print_And(expr, "logical_or")


def _short(text: str) -> str:
    return text if len(text) <= 60 else text[:57] + "..."


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
    >>> print(Formula("V", x**2 / 2 + x**3 / 3, (x,), center=(0.5,), units=("mm",)).source("text"))
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
        cls, name: str, symbols: Sequence[sympy.Symbol], *, center: np.ndarray, scale: np.ndarray,
        exponents: np.ndarray, coefficients: np.ndarray, units: Sequence[str] = (), title: str = "",
    ) -> Formula:  # fmt: skip
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
        return cls(name, sympy.Add(*terms), tuple(symbols), tuple(map(float, center)), tuple(units), title)

    @property
    def gradient(self) -> tuple[sympy.Expr, ...]:
        """Its derivatives by the states, in the symbols of `expression`; a jump counts for nothing."""
        return tuple(
            # No peak where it jumps, and steps as signs, which every program has.
            self.expression.diff(symbol)
            .replace(sympy.DiracDelta, lambda *_: sympy.S.Zero)
            .replace(sympy.Heaviside, lambda place, *_: (1 + sympy.sign(place)) / 2)
            for symbol in self.symbols
        )

    @property
    def offsets(self) -> tuple[float, ...]:
        """The center, zero where there is none."""
        return self.center or (0.0,) * len(self.symbols)

    def to_sympy(self) -> sympy.Expr:
        """The function as a sympy expression of the states."""
        pairs = zip(self.symbols, self.offsets, strict=True)
        return self.expression.xreplace({symbol: symbol - exact_number(at) for symbol, at in pairs if at})

    def to_latex(self, *, digits: int = DIGITS) -> str:
        r"""The function as LaTeX, in an ``aligned`` environment where offsets are defined as well.

        Parameters
        ----------
        digits
            Significant digits of its numbers, for a page that has no room for 17.
        """

        def latex(expression: sympy.Expr) -> str:
            rounded = {each: sympy.Float(each, digits) for each in expression.atoms(sympy.Float)}
            return str(LatexPrinter({"full_prec": False}).doprint(expression.xreplace(rounded)))

        moved = {symbol: at for symbol, at in zip(self.symbols, self.offsets, strict=True) if at}
        offsets = {symbol: sympy.Symbol(rf"\Delta_{{{latex(symbol)}}}") for symbol in moved}
        left, right = latex(sympy.Symbol(self.name)), latex(self.expression.xreplace(offsets))
        if not offsets:
            return f"{left} = {right}"
        lines = [
            rf"{offsets[symbol].name} &= {latex(symbol - sympy.Float(at, DIGITS))} \\"
            for symbol, at in moved.items()
        ]
        return "\n".join([r"\begin{aligned}", *lines, f"{left} &= {right}", r"\end{aligned}"])

    def source(self, language: Literal["text", "numpy", "jax", "torch", "c", "julia"]) -> str:
        """The function for other programs.

        Parameters
        ----------
        language
            ``text``: a line for each definition, which `parse_formula` reads. Otherwise a function of the
            states, and one of the same name with ``_gradient``: in ``numpy``, ``jax`` and ``torch``, where
            both take arrays, or tensors, components come first, shape ``(d, ...)``; in ``c`` they go to the
            last argument.
        """
        printer = _PRINTERS[language]()
        taken = {*_TAKEN, self.name, f"{self.name}_gradient"}

        def free(name: str) -> str:
            while name in taken:
                name += "_"
            taken.add(name)
            return name

        arguments, result = [free(symbol.name) for symbol in self.symbols], free("gradient")
        offsets: list[tuple[str, str]] = []
        variables: dict[sympy.Symbol, sympy.Symbol] = {}
        for symbol, name, at in zip(self.symbols, arguments, self.offsets, strict=True):
            variable = sympy.Symbol(name, real=True)
            if at:
                offsets.append((free(f"d{name}"), printer.doprint(variable - exact_number(at))))
                variable = sympy.Symbol(offsets[-1][0], real=True)
            variables[symbol] = variable
        functions = (self.expression, *self.gradient)
        common = set.intersection(*(each.free_symbols for each in functions))
        units = self.units or ("1",) * len(arguments)
        header = [
            f"{self.name}({', '.join(arguments)})" + (f": {self.title}" if self.title else ""),
            *(f"{name} in {unit}" for name, unit in zip(arguments, units, strict=True)),
        ]
        # A sum of powers by Horner's rule, for programs that evaluate it.
        written = functions[:1] if language == "text" else [_horner(each, self.symbols) for each in functions]
        value, *slopes = (printer.doprint(each.xreplace(variables)) for each in written)
        environment = jinja2.Environment(
            loader=jinja2.PackageLoader("siq.systems"), undefined=jinja2.StrictUndefined, trim_blocks=True,
            autoescape=False,
        )  # fmt: skip
        environment.filters["wrapped"] = _wrapped
        module = _MODULES.get(language)
        return environment.get_template(f"formula.{'numpy' if module else language}.j2").render(
            module=module, name=self.name, arguments=arguments, result=result, offsets=offsets,
            value=value, slopes=slopes,
            # A unit is the user's text: nothing of it may end a comment.
            header=[re.sub(r"[^\S ]+|[\\\x00-\x1f\x7f\x85\u2028\u2029]", " ", line) for line in header],
            ignored=[str(variables[symbol]) for symbol in self.symbols if symbol not in common],
        )  # fmt: skip


LARGEST_INTEGER = 2**31  # of a C int

# Names that a state may have in a card and may not have in a program.
_JULIA = frozenset(
    {"abstract", "baremodule", "begin", "catch", "const", "do", "elseif", "end", "export", "false", "finally",
     "function", "global", "import", "let", "local", "macro", "module", "mutable", "primitive", "quote",
     "struct", "true", "try", "type", "using"}
)  # fmt: skip
_TAKEN = frozenset(
    {*keyword.kwlist, *reserved_words, *_JULIA, "inline", "restrict", *FUNCTIONS, *CONSTANTS,
     "abs", "fabs", "fmax", "fmin", "functools", "jax", "max", "min", "numpy", "pow", "torch"}
)  # fmt: skip


SOURCE_WIDTH = 100  # characters after which source goes on in the next line


def _horner(expression: sympy.Expr, symbols: Sequence[sympy.Symbol]) -> sympy.Expr:
    """A sum of powers, as it stands, by Horner's rule; anything else with numbers for π and √2."""
    functions = expression.atoms(sympy.NumberSymbol, sympy.Function, sympy.Pow)
    constants = {each for each in functions if not each.free_symbols}
    plain = expression.xreplace({each: each.evalf(DIGITS) for each in constants})
    powers = plain.as_poly(*symbols) if symbols else None
    # Of a product as many terms as it has factors would be a coincidence.
    if powers is None or len(powers.terms()) != len(sympy.Add.make_args(plain)):
        return plain
    return sympy.horner(powers, wrt=symbols)


def _wrapped(source: str, indent: int) -> str:
    """Source in lines of bearable length, each but the last ending with an operator."""
    lines, line = [], " " * indent
    for piece in re.split(r"(?<= [-+*/]) ", source):
        if line.strip() and len(line) + len(piece) > SOURCE_WIDTH:
            lines.append(line.rstrip())
            line = " " * indent
        line += piece + " "
    return "\n".join([*lines, line.rstrip()])


class _Doubles:
    """Numbers with the digits that it takes to read the same double back."""

    def _print_Float(self, expr: sympy.Float) -> str:  # noqa: N802 (sympy's names, here and below)
        return repr(float(expr))

    def _print_Integer(self, expr: sympy.Integer) -> str:  # noqa: N802
        return repr(float(expr)) if abs(expr) >= LARGEST_INTEGER else str(int(expr))


class _Julia(_Doubles, JuliaCodePrinter):
    def _print_Max(self, expr: sympy.Expr) -> str:  # noqa: N802
        return f"{expr.func.__name__.lower()}({', '.join(map(self._print, expr.args))})"

    _print_Min = _print_Max  # noqa: N815


_MODULES = {"numpy": "numpy", "jax": "jax.numpy", "torch": "torch"}


class _Arrays(_Doubles, NumPyPrinter):
    """Functions by their names in numpy, which the module of another library has, too."""

    _module = "numpy"

    def __init_subclass__(cls) -> None:
        for table in ("_kf", "_kc"):
            known = getattr(NumPyPrinter, table).items()
            setattr(cls, table, {key: name.replace("numpy.", f"{cls._module}.") for key, name in known})


class _Torch(_Arrays):
    _module = "torch"

    def _print_Max(self, expr: sympy.Expr) -> str:  # noqa: N802
        function = "maximum" if isinstance(expr, sympy.Max) else "minimum"
        # Of tensors alone, so that numbers are made one.
        one = ("torch.as_tensor({}, dtype=torch.float64)" if each.is_number else "{}" for each in expr.args)
        args = (form.format(self._print(each)) for form, each in zip(one, expr.args, strict=True))
        return f"functools.reduce(torch.{function}, [{', '.join(args)}])"

    _print_Min = _print_Max  # noqa: N815


_PRINTERS: Mapping[str, type[CodePrinter | StrPrinter]] = {
    "text": type("_Text", (_Doubles, StrPrinter), {}), "c": type("_C", (_Doubles, C99CodePrinter), {}),
    "julia": _Julia, "numpy": type("_NumPy", (_Arrays,), {}), "torch": _Torch,
    "jax": type("_Jax", (_Arrays,), {"_module": "jax.numpy"}),
}  # fmt: skip
