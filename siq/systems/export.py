"""Formulas for other programs: text, LaTeX, sympy, and source in numpy, C and Julia.

A polynomial about a center is written in powers of the offsets from it, never multiplied out: expanded, its
terms would be far larger than their sum. Numbers have as many digits as it takes to read the same double
back, 17 at most.

Sums of powers are worked out by Horner's rule; see `siq.systems.export` for what all exports share.
"""

from __future__ import annotations

import keyword
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import sympy
from sympy.printing.c import C99CodePrinter, reserved_words
from sympy.printing.julia import JuliaCodePrinter
from sympy.printing.latex import LatexPrinter
from sympy.printing.numpy import NumPyPrinter
from sympy.printing.str import StrPrinter

from siq.systems.formulas import CONSTANTS, DIGITS, FUNCTIONS, exact_number

LARGEST_INTEGER = 2**31  # of a C int

# Names that a state may have in a card and may not have in a program.
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
                raise ValueError(f"'{name}' cannot be a name in a program; use letters, digits and _")
        unknown = self.expression.free_symbols - set(self.symbols)
        if unknown:
            names = ", ".join(sorted(map(str, unknown)))
            raise ValueError(f"{names} in {self.name} is no state; insert a value")
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
    names = Names(formula)
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


class Names:
    """What the states and their offsets are called in a program, and the lines that say so."""

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
        """What stands above the source: the function, and states with their units."""
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


class Doubles:
    """Numbers with the digits that it takes to read the same double back."""

    def _print_Float(self, expr: sympy.Float) -> str:  # noqa: N802 (sympy's names, here and below)
        return repr(float(expr))

    def _print_Integer(self, expr: sympy.Integer) -> str:  # noqa: N802
        return repr(float(expr)) if abs(expr) >= LARGEST_INTEGER else str(int(expr))


class _Text(Doubles, StrPrinter):
    pass


LINE = 100  # characters after which source goes on in the next line


def numpy_source(formula: Formula, *, gradient: bool = True) -> str:
    """A module of Python with the function ``V(x, y)`` of numbers or arrays, which numpy broadcasts.

    Parameters
    ----------
    formula
        The formula.
    gradient
        Whether ``V_gradient(x, y)`` is written as well: components first, shape ``(d, ...)``.
    """
    names = Names(formula)
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
    names = Names(formula)
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
    names = Names(formula)
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


def _written(formula: Formula, names: Names, written: Callable[[sympy.Expr], str]) -> list[str]:
    """The function and its derivatives, powers by Horner's rule."""
    return [
        written(_for_programs(each, formula.symbols).xreplace(names.variables))
        for each in (formula.expression, *formula.gradient)
    ]


def _for_programs(expression: sympy.Expr, symbols: Sequence[sympy.Symbol]) -> sympy.Expr:
    """The same with a number in the place of π, and by Horner's rule where it is a sum of powers."""
    powers = _powers(expression, symbols)
    if powers is not None:
        return _horner(powers, symbols)
    numbers = {each: sympy.Float(each, DIGITS) for each in expression.atoms(sympy.NumberSymbol)}
    return expression.xreplace(numbers)


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
        if line.strip() and len(line) + len(piece) > LINE:
            lines.append(line.rstrip())
            line = " " * indent
        line += piece + " "
    return [*lines, line.rstrip()]


class _NumPy(Doubles, NumPyPrinter):
    pass


class _C(Doubles, C99CodePrinter):
    pass


class _Julia(Doubles, JuliaCodePrinter):
    def _print_Max(self, expr: sympy.Expr) -> str:  # noqa: N802
        return f"max({', '.join(map(self._print, expr.args))})"

    def _print_Min(self, expr: sympy.Expr) -> str:  # noqa: N802
        return f"min({', '.join(map(self._print, expr.args))})"
