"""Numbers and formulas as people read them, and pages as HTML that need nothing else.

A measured coefficient keeps its decimals (``1.000 x⁴``, not ``x⁴``), because how many of them are zero is
the result; integers and fractions, which only exact formulas contain, are written as they are.
"""

from __future__ import annotations

import base64
import datetime
import html
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.dom.minidom import Document

import numpy as np
import pandas as pd
import sympy
from jinja2 import ChoiceLoader, Environment, FileSystemLoader, PackageLoader, StrictUndefined
from markupsafe import Markup
from sympy.printing.mathml import MathMLPresentationPrinter
from sympy.printing.precedence import PRECEDENCE
from sympy.printing.str import StrPrinter

from siq.numerics.text import MINUS, SUPERSCRIPTS, mantissa_and_exponent, number_text, value_text
from siq.systems.formulas import CONSTANTS, FUNCTIONS, parse_formula

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


LARGEST_VECTOR = 400_000  # bytes: a larger SVG is offered as the PNG that is shown
DOTS_PER_INCH = 200  # of the PNG files; pages have 96
CHARACTER = 7.6  # pixels, about: the width of a figure in a table
CELL = 18.0  # pixels around it
SHORT_TEXT, LINE = 24, 34  # characters: longer texts wrap, to lines no shorter than the latter
PHONE, PAGE = 360, 950  # pixels that a table may fill


def render_template(name: str, content: object, *, folder: Path | None = None) -> str:
    """Render a page as HTML; all text is escaped, but for what is `markupsafe.Markup`.

    A `folder` may have templates of its own beside those of this package.
    """
    package = PackageLoader("siq.report")
    environment = Environment(
        loader=package if folder is None else ChoiceLoader([FileSystemLoader(folder), package]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {
        "cell": cell_text,
        "is_number": _is_number_column,
        "kept_columns": kept_columns,
        "data_address": _data_address,
        "figure_download": _figure_download,
        "table_download": _table_download,
        "file_name": file_name,
        "page_width": _page_width,
        "wide_for": _wide_for,
        "short": short_caption,
        "unbroken": lambda text: text.replace(" × 10", "\u00a0×\u00a010"),
        "records": lambda frame: list(frame.itertuples(index=False, name=None)),
    }
    return environment.get_template(name).render(content=content)


def kept_columns(frame: pd.DataFrame) -> pd.DataFrame:
    """The table without columns that say nothing: of missing values, or of empty texts."""
    said = [not (frame[name].isna() | (frame[name].astype(str) == "")).all() for name in frame.columns]
    return frame if all(said) or frame.empty else frame.loc[:, said]


def _address(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"


_KINDS = {"svg": "image/svg+xml", "png": "image/png"}


def _data_address(figure: Any) -> str:
    # An SVG inside <img> keeps its identifiers to itself and cannot run or load anything.
    return _address(_KINDS[figure.kind], figure.image)


def _figure_download(figure: Any) -> tuple[str, str]:
    """What a figure is downloaded as: its kind and its address."""
    if figure.vector is not None and len(figure.vector) <= LARGEST_VECTOR:
        return "svg", _address(_KINDS["svg"], figure.vector)
    return figure.kind, _data_address(figure)


def _table_download(table: Any) -> str:
    frame = table.frame if table.data is None else table.data
    text = frame.to_csv(index=False, lineterminator="\n")
    return _address("text/csv;charset=utf-8", text.encode("utf-8"))


def short_caption(caption: str) -> str:
    """The first sentence, or its first part, for the contents: no more than a line."""
    first = re.split(r"(?<=[a-zà-ÿ)\]])[.:;](?:\s|$)", caption, maxsplit=1)[0].rstrip(".")
    return first if len(first) <= 90 else first[:88].rsplit(" ", 1)[0] + " …"


def file_name(caption: str, number: int, *, what: str) -> str:
    """A name for a download: ``table-3-barriers-of-u``."""
    words = re.findall(r"[a-z0-9]+", caption.lower())[:5]
    return "-".join([what, str(number), *words])


def _page_width(figure: Any) -> int:
    # The first chunk of every PNG holds its width in dots.
    if figure.kind == "png":
        return round(int.from_bytes(figure.image[16:20], "big") * 96 / DOTS_PER_INCH)
    head = figure.image[:2000].decode("utf-8", errors="replace")
    found = re.search(r"<svg[^>]*\bwidth=\"([\d.]+)(pt|px|in)?\"", head)
    if found is None:
        return 600
    return round(float(found[1]) * {"pt": 96 / 72, "in": 96.0}.get(found[2] or "px", 1.0))


def _wide_for(frame: pd.DataFrame, rows: int) -> str:
    """For which screens a table is about too wide: ``page phone``, ``phone``, or none."""
    width = 0.0
    for name in frame.columns:
        cells = [_least_width(cell_text(value)) for value in frame[name].head(rows)]
        width += CELL + CHARACTER * max([longest_word(str(name)), *cells])
    return "page phone" if width > PAGE else "phone" if width > PHONE else ""


def _least_width(text: str) -> int:
    """Characters on the narrowest line that a cell can be set in: long texts wrap."""
    return len(text) if len(text) <= SHORT_TEXT else min(LINE, max(longest_word(text), SHORT_TEXT // 2))


def longest_word(text: str) -> int:
    """Characters of the longest word: headings wrap, figures do not."""
    return max((len(word) for word in text.split()), default=0)


def _is_number_column(column: pd.Series) -> bool:
    return pd.api.types.is_numeric_dtype(column) and not pd.api.types.is_bool_dtype(column)


def cell_text(value: object) -> str:
    """What stands in a cell."""
    if value is None or value is pd.NA or value is pd.NaT:
        return "—"
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if isinstance(value, int | np.integer):
        return str(value).replace("-", "−")
    if isinstance(value, float | np.floating):
        return str(int(value)).replace("-", "−") if _is_whole(float(value)) else number_text(float(value))
    if isinstance(value, datetime.datetime):
        return value.isoformat(sep=" ", timespec="seconds")
    return str(value)


def _is_whole(value: float) -> bool:
    # Counts become floating-point numbers as soon as one of their column is missing.
    return value.is_integer() and abs(value) < 1e5
