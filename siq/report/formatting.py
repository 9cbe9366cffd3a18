"""Numbers and formulas as people read them: plain text, and MathML that browsers typeset offline.

A measured coefficient keeps its decimals (``1.000 x⁴``, not ``x⁴``), because how many of them are zero is
the result; integers and fractions, which only exact formulas contain, are written as they are.
"""

from __future__ import annotations

import html
import math
import re
from collections.abc import Mapping, Sequence
from typing import Any
from xml.dom.minidom import Document

import sympy
from markupsafe import Markup
from sympy.printing.mathml import MathMLPresentationPrinter
from sympy.printing.precedence import PRECEDENCE
from sympy.printing.str import StrPrinter

from siq.dynamics.formulas import CONSTANTS, FUNCTIONS, parse_formula
from siq.numerics.measured_text import value_text
from siq.numerics.number_text import MINUS, SUPERSCRIPTS, mantissa_and_exponent, number_text

CHARACTERS_PER_LINE = 56  # a longer formula is broken between its terms: browsers do not break MathML

_INVISIBLE_TIMES = "\u2062"


def polynomial_expression(terms: Mapping[str, float]) -> sympy.Expr:
    """Build the sum of coefficient × term, terms as in the table of coefficients (``x**2*y``).

    Parameters
    ----------
    terms
        Coefficient of each term; zeros are left out.

    Returns
    -------
    sympy.Expr
        The polynomial with floating-point coefficients.
    """
    names = {name for term in terms for name in re.findall(r"[^\W\d]\w*", term)} - {*FUNCTIONS, *CONSTANTS}
    symbols = {name: sympy.Symbol(name, real=True) for name in names}
    return sympy.Add(
        *(
            sympy.Float(float(value)) * parse_formula(term, symbols)
            for term, value in terms.items()
            if value != 0
        )
    )


def formula_text(expression: sympy.Expr, *, decimals: int = 3) -> str:
    """Write a formula in one line of plain text.

    Parameters
    ----------
    expression
        The formula.
    decimals
        Decimals of its floating-point coefficients.

    Returns
    -------
    str
        Such as ``"1.000 x⁴ − 2.001 x² + 0.999 y² + 1.001"``: terms by descending degree, the constant last.
    """
    return str(_TextPrinter(decimals).doprint(_with_integer_exponents(expression)))


def term_text(term: str) -> str:
    """Write a term of a table for a reader: ``x**2*y`` as ``x² y``, and the constant as it is.

    Examples
    --------
    >>> term_text("x**2*y"), term_text("1")
    ('x² y', '1')
    """
    names = set(re.findall(r"[^\W\d]\w*", term)) - {*FUNCTIONS, *CONSTANTS}
    return formula_text(parse_formula(term, {name: sympy.Symbol(name, real=True) for name in names}))


def formula_mathml(expression: sympy.Expr, *, decimals: int = 3) -> Markup:
    """Typeset a formula as MathML, which browsers show without scripts or fonts from elsewhere.

    Parameters
    ----------
    expression
        The formula.
    decimals
        Decimals of its floating-point coefficients.

    Returns
    -------
    markupsafe.Markup
        One ``<math>`` element, well-formed XML, safe to put in a page; long sums stand on several lines.
    """
    printer = _MathMLPrinter(decimals)
    spoken = formula_text(expression, decimals=decimals)
    return _math(printer, printer.lines(_with_integer_exponents(expression)), spoken)


def vector_mathml(expressions: Sequence[sympy.Expr], *, decimals: int = 3) -> Markup:
    """Typeset the components of a vector as a column in brackets.

    Parameters
    ----------
    expressions
        The components, from the first to the last.
    decimals
        Decimals of their floating-point coefficients.

    Returns
    -------
    markupsafe.Markup
        One ``<math>`` element, as from `formula_mathml`.
    """
    printer = _MathMLPrinter(decimals)
    table = printer.table([printer.lines(_with_integer_exponents(entry)) for entry in expressions])
    return _math(
        printer,
        printer.bracketed(table),
        "; ".join(formula_text(entry, decimals=decimals) for entry in expressions),
    )


def matrix_mathml(matrix: Sequence[Sequence[float]]) -> Markup:
    """Typeset a matrix of numbers in brackets; a number that stands alone without them."""
    printer = _MathMLPrinter(3)
    texts = [
        [
            str(int(value)).replace("-", MINUS) if float(value).is_integer() else value_text(value)
            for value in row
        ]
        for row in matrix
    ]
    spoken = "; ".join(", ".join(row) for row in texts)
    if texts == [[texts[0][0]]]:
        return _math(printer, printer.leaf("mn", texts[0][0]), spoken)
    rows = [
        printer.element("mtr", *(printer.element("mtd", printer.leaf("mn", text)) for text in row))
        for row in texts
    ]
    return _math(printer, printer.bracketed(printer.element("mtable", *rows)), spoken)


def formula_matrix_mathml(rows: Sequence[Sequence[sympy.Expr]], *, decimals: int = 3) -> Markup:
    """Typeset a matrix of formulas in brackets; a formula that stands alone without them."""
    if len(rows) == 1:
        return formula_mathml(rows[0][0], decimals=decimals)
    printer = _MathMLPrinter(decimals)
    table = [
        printer.element(
            "mtr",
            *(printer.element("mtd", printer.lines(_with_integer_exponents(entry))) for entry in row),
        )
        for row in rows
    ]
    spoken = "; ".join(", ".join(formula_text(entry, decimals=decimals) for entry in row) for row in rows)
    return _math(printer, printer.bracketed(printer.element("mtable", *table)), spoken)


def _entry_text(value: float) -> str:
    return str(int(value)).replace("-", MINUS) if value.is_integer() else value_text(value)


def _math(printer: _MathMLPrinter, content: Any, spoken: str) -> Markup:
    element = printer.element("math", content)
    element.setAttribute("aria-label", spoken)
    # The only place where markup is declared safe: minidom has escaped every text and attribute in it.
    return Markup(element.toxml())


def _with_integer_exponents(expression: sympy.Expr) -> sympy.Expr:
    def is_float_power(part: sympy.Basic) -> bool:
        return bool(part.is_Pow and part.exp.is_Float and float(part.exp).is_integer())

    return sympy.sympify(expression).replace(
        is_float_power, lambda part: sympy.Pow(part.base, int(part.exp), evaluate=False)
    )


def _ordered_terms(expression: sympy.Expr) -> list[sympy.Expr]:
    """Terms of a sum: by descending degree, functions after polynomial terms, the constant last."""

    def place(term: sympy.Expr) -> tuple[int, int, str]:
        letters = sorted(term.free_symbols, key=lambda symbol: symbol.name)
        if not letters:
            return (2, 0, "")
        if not term.is_polynomial(*letters):
            return (1, 0, str(term))
        powers = sympy.degree_list(term, *letters)
        spelled = "".join(f"{letter.name} " * power for letter, power in zip(letters, powers, strict=True))
        return (0, -sum(powers), spelled)

    return sorted(sympy.Add.make_args(expression), key=place)


def _sign_and_parts(term: sympy.Expr) -> tuple[bool, sympy.Expr | None, sympy.Expr]:
    """Split a term into: is it negative, its positive coefficient where one is written, and the rest."""
    coefficient, rest = term.as_coeff_Mul()
    if not coefficient.is_extended_real:
        return False, None, term
    negative = bool(coefficient < 0)
    coefficient = -coefficient if negative else coefficient
    return negative, None if coefficient is sympy.S.One and rest is not sympy.S.One else coefficient, rest


class _TextPrinter(StrPrinter):
    def __init__(self, decimals: int) -> None:
        super().__init__()
        self.decimals = decimals

    def terms(self, expression: sympy.Expr) -> list[tuple[str, str]]:
        """Sign and text of each term, in order."""
        signed = []
        for term in _ordered_terms(expression):
            negative, coefficient, rest = _sign_and_parts(term)
            parts = [] if coefficient is None else [self.parenthesize(coefficient, PRECEDENCE["Mul"])]
            if rest is not sympy.S.One:
                factors = rest.as_ordered_factors() if rest.is_Mul else [rest]
                parts += [self.parenthesize(factor, PRECEDENCE["Mul"]) for factor in factors]
            signed.append((MINUS if negative else "+", " ".join(parts)))
        return signed

    def _print_Add(self, expr: sympy.Expr, order: str | None = None) -> str:  # noqa: N802 (sympy's name)
        (sign, first), *others = self.terms(expr)
        return (sign if sign == MINUS else "") + first + "".join(f" {sign} {text}" for sign, text in others)

    _print_Mul = _print_Add  # noqa: N815 (sympy's name); a product is a sum of one term

    def _print_Float(self, expr: sympy.Float) -> str:  # noqa: N802 (sympy's name)
        return number_text(float(expr), decimals=self.decimals)

    def _print_Pow(self, expr: sympy.Pow, rational: bool = False) -> str:  # noqa: N802 (sympy's name)
        if not expr.exp.is_Integer:
            return str(super()._print_Pow(expr, rational=rational)).replace("**", "^")
        return f"{self.parenthesize(expr.base, PRECEDENCE['Pow'])}{str(expr.exp).translate(SUPERSCRIPTS)}"


class _MathMLPrinter(MathMLPresentationPrinter):
    def __init__(self, decimals: int) -> None:
        super().__init__()
        self.decimals = decimals
        # sympy writes text unescaped, and HTML entities such as &pi; that XML does not know. A document of
        # its own, with entities resolved first, yields well-formed and harmless markup.
        self.dom = Document()
        create = self.dom.createTextNode
        self.dom.createTextNode = lambda text: create(html.unescape(str(text)))  # type: ignore

    def element(self, tag: str, *children: Any) -> Any:
        parent = self.dom.createElement(tag)
        for child in children:
            parent.appendChild(child)
        return parent

    def leaf(self, tag: str, text: str) -> Any:
        return self.element(tag, self.dom.createTextNode(text))

    def bracketed(self, content: Any) -> Any:
        """Brackets as high as what stands between them."""
        brackets = [self.leaf("mo", text) for text in "[]"]
        for bracket in brackets:
            for attribute in ("fence", "stretchy", "symmetric"):
                bracket.setAttribute(attribute, "true")
        return self.element("mrow", brackets[0], content, brackets[1])

    def table(self, rows: Sequence[Any]) -> Any:
        """Stack elements, flush left."""
        cells = [self.element("mtd", row) for row in rows]
        for cell in cells:
            cell.setAttribute("style", "text-align: left")
        return self.element("mtable", *(self.element("mtr", cell) for cell in cells))

    def lines(self, expression: sympy.Expr) -> Any:
        """Typeset a sum on as many lines as it needs."""
        widths = [len(text) + 3 for _, text in _TextPrinter(self.decimals).terms(expression)]
        lines: list[list[Any]] = [[]]
        filled = 0
        for index, term in enumerate(_ordered_terms(expression)):
            if filled and filled + widths[index] > CHARACTERS_PER_LINE:
                lines.append([])
                filled = 0
            lines[-1] += self._signed(term, first=index == 0)
            filled += widths[index]
        rows = [self.element("mrow", *line) for line in lines]
        return rows[0] if len(rows) == 1 else self.table(rows)

    def _signed(self, term: sympy.Expr, *, first: bool) -> list[Any]:
        negative, coefficient, rest = _sign_and_parts(term)
        nodes: list[Any] = []
        if negative or not first:
            nodes.append(self.leaf("mo", MINUS if negative else "+"))
            if first:
                nodes[0].setAttribute("form", "prefix")
        if coefficient is not None:
            nodes.append(self._print(coefficient))
        if rest is not sympy.S.One:
            if coefficient is not None:
                times = self.leaf("mo", _INVISIBLE_TIMES)
                times.setAttribute("lspace", "0.17em")
                nodes.append(times)
            nodes += self._factors(rest)
        return nodes

    def _factors(self, product: sympy.Expr) -> list[Any]:
        numerator, denominator = sympy.fraction(product, exact=True)
        if denominator is not sympy.S.One:
            return [self.element("mfrac", self._print(numerator), self._print(denominator))]
        nodes: list[Any] = []
        for factor in product.as_ordered_factors() if product.is_Mul else [product]:
            if nodes:
                nodes.append(self.leaf("mo", _INVISIBLE_TIMES))
            nodes.append(self.parenthesize(factor, PRECEDENCE["Mul"]))
        return nodes

    def _print_Add(self, expr: sympy.Expr, order: str | None = None) -> Any:  # noqa: N802 (sympy's name)
        terms = enumerate(_ordered_terms(expr))
        nodes = [node for index, term in terms for node in self._signed(term, first=index == 0)]
        return self.element("mrow", *nodes)

    _print_Mul = _print_Add  # noqa: N815 (sympy's name); a product is a sum of one term

    def _print_Float(self, expr: sympy.Float) -> Any:  # noqa: N802 (sympy's name)
        value = float(expr)
        if not math.isfinite(value):
            return self.leaf("mtext", number_text(value))
        mantissa, exponent = mantissa_and_exponent(abs(value), self.decimals)
        nodes = [self.leaf("mo", MINUS)] if value < 0 else []
        nodes.append(self.leaf("mn", mantissa))
        if exponent:
            digits = [self.leaf("mo", MINUS)] if exponent < 0 else []
            digits.append(self.leaf("mn", str(abs(exponent))))
            power = self.element("msup", self.leaf("mn", "10"), self.element("mrow", *digits))
            nodes += [self.leaf("mo", "×"), power]
        return nodes[0] if len(nodes) == 1 else self.element("mrow", *nodes)
