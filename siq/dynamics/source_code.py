"""A formula as source in numpy, C and Julia: self-contained functions for other programs.

Sums of powers are worked out by Horner's rule; see `siq.dynamics.exports` for what all exports share.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence

import sympy
from sympy.printing.c import C99CodePrinter
from sympy.printing.julia import JuliaCodePrinter
from sympy.printing.numpy import NumPyPrinter

from siq.dynamics.exports import Doubles, Formula, Names
from siq.dynamics.formulas import DIGITS

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
