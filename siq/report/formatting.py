"""Numbers, formulas and sentences as people read them.

Sentences stand in templates (`siq/report/templates`), which `paragraphs` fills from summaries; words for
codes stand in YAML files beside them (`texts`). Formulas are typeset by sympy's MathML printer, with the
terms of a sum by falling degree. A measured coefficient keeps its decimals (``1.000 x⁴``, not ``x⁴``), since
how many of them are zero is the result; integers and fractions, which only exact formulas contain, are
written as they are.
"""

from __future__ import annotations

import html
import math
import re
from collections.abc import Sequence
from functools import cache
from importlib.resources import files
from typing import Any
from xml.dom.minidom import Document

import numpy as np
import sympy
import yaml
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from sympy.printing.mathml import MathMLPresentationPrinter
from sympy.printing.precedence import PRECEDENCE
from sympy.printing.str import StrPrinter

from siq.numerics.text import (
    MINUS,
    SUPERSCRIPTS,
    listed,
    mantissa_and_exponent,
    number_text,
    p_text,
    percent,
    range_text,
    unit_text,
    value_text,
)
from siq.quasipotential.occupancy import VisitTest
from siq.quasipotential.rates import MIN_BARRIER_OVER_NOISE, MeanTime
from siq.report.summary import LandscapeSummary, WellSummary
from siq.systems.formulas import CONSTANTS, FUNCTIONS, parse_formula

COUNTS = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine")
MOST_STATES_IN_A_SENTENCE = 4  # of which a sentence writes out a position
LARGE_ERROR = 0.5  # relative error from which a range says more than ±
CHARACTERS_PER_LINE = 56  # a longer formula is broken between its terms: browsers do not break MathML
_INVISIBLE_TIMES = "\u2062"


def counted_text(visits: VisitTest, unit: str = "") -> str:
    """The mean of visits on the record, with its interval of 95 %; of none that ended a lower bound."""
    lowest, highest = visits.whole.limits
    if not visits.whole.visits:
        return f"more than {value_text(lowest, unit=unit, digits=2)}"
    text = f"{value_text(visits.whole.mean, digits=3)} ({range_text(lowest, highest)})"
    return f"{text}\u00a0{unit_text(unit)}" if unit_text(unit) else text


def predicted_text(visits: VisitTest, unit: str = "") -> str:
    """The mean of visits as f and D predict it, with its error; a range where that is large."""
    if visits.error > LARGE_ERROR:
        factor = math.exp(visits.error)
        return range_text(visits.predicted / factor, visits.predicted * factor, unit=unit)
    return value_text(visits.predicted, visits.error * visits.predicted, unit=unit)


def time_text(mean: MeanTime | None, unit: str = "") -> str:
    """A mean time with its error; a range where the error is as large as the time; empty where not known."""
    if mean is None:
        return ""
    if mean.error > LARGE_ERROR:
        text = range_text(*mean.limits, unit=unit)
    else:
        text = value_text(mean.value, mean.value * mean.error, unit=unit)
    return text if mean.complete else f"at most {text}"


def with_unit(name: str, unit: str) -> str:
    """A heading, or the name of an axis, with its unit in brackets; a plain number has none.

    ``T_minus_273``, from which `Recordings.centred` took 273, is ``T − 273`` as elsewhere on a page.
    """
    shown = unit_text(unit)
    name = re.sub(
        r"_(?:(plus)|minus)_(\d+)(?:_(\d+))?$",
        lambda one: f" {'+' if one[1] else MINUS} {'.'.join(filter(None, one.groups()[1:]))}", name,
    )  # fmt: skip
    return f"{name} ({shown})" if shown else name


def _position_text(well: WellSummary, summary: LandscapeSummary) -> str:
    """Where a well is: ``x = −0.996 ± 0.005 nm``, ``(x, y) = (−0.50, 0.00) µm``."""
    names, units = [with_unit(name, "1") for name in summary.names], summary.units
    if len(names) > MOST_STATES_IN_A_SENTENCE:
        return "the place that the table gives"
    if len(names) == 1:
        value = value_text(well.position[0], well.position_errors[0], unit=units[0])
        return f"{names[0]}\u00a0=\u00a0{value}"
    size = float(np.abs([one.position for one in summary.wells]).max())
    values = []
    for value, error in zip(well.position, well.position_errors, strict=True):
        if not math.isfinite(error) or error < 1e-4 * size:
            error = 1e-3 * size if size else 1.0
            if abs(value) < 0.5e-3 * error:  # what rounding left of zero
                values.append("0")
                continue
        decimals = max(0, -math.floor(math.log10(error))) if error > 0 else 3
        if decimals > 6 or size >= 1e5:
            values.append(value_text(value))
        else:
            text = f"{abs(value):.{decimals}f}"
            values.append((MINUS if value < 0 and float(text) else "") + text)
    if len(set(units)) == 1:
        unit = unit_text(units[0])
        named = ",\u00a0".join(names)  # a phone breaks the values, not the names
        return f"({named})\u00a0=\u00a0({', '.join(values)})" + (f"\u00a0{unit}" if unit else "")
    return ", ".join(
        f"{name}\u00a0=\u00a0{value}\u00a0{unit_text(unit)}".rstrip()
        for name, value, unit in zip(names, values, units, strict=True)
    )


def _relative_text(share: float) -> str:
    """A relative error: ``3.7 %``, ``4.2 × 10⁻⁶``.

    Examples
    --------
    >>> _relative_text(0.0371)
    '3.7 %'
    """
    if share < 1e-4:
        return number_text(share, decimals=1)
    percent = 100 * share
    return f"{percent:.2g} %" if percent < 99.5 else f"{percent:.0f} %"


def percent_text(share: float, digits: int = 2) -> str:
    """A difference in per cent, empty where it is not known."""
    return f"{value_text(100 * share, digits=digits)} %" if np.isfinite(share) else ""


@cache
def environment() -> Environment:
    """Templates of plain text, with numbers as filters: ``{{ value | value(error, unit="s") }}``."""
    made = Environment(
        loader=PackageLoader("siq.report"), undefined=StrictUndefined, autoescape=False, trim_blocks=True,
        lstrip_blocks=True,
    )  # fmt: skip
    made.filters |= {
        "value": value_text, "number": number_text, "share": percent, "relative": _relative_text,
        "percent": percent_text, "p": p_text, "range": lambda ends, **options: range_text(*ends, **options),
        "unit": unit_text, "listed": lambda names, word="and": listed(list(names), word),
        "capital": lambda text: text[:1].upper() + text[1:],
        "lower_first": lambda text: text[:1].lower() + text[1:],
        "count_word": lambda count: COUNTS[count] if count < len(COUNTS) else str(count), "term": term_text,
        "one_line": lambda text: " ".join(in_paragraphs(text)),
        "time": lambda mean, unit: time_text(mean, unit if unit_text(unit) else "time units"),
        "counted": counted_text, "predicted": predicted_text, "place": _position_text,
    }  # fmt: skip
    made.tests["finite"] = lambda value: bool(np.isfinite(value))
    made.globals["law_from"] = MIN_BARRIER_OVER_NOISE
    return made


def in_paragraphs(text: str) -> list[str]:
    """Paragraphs of a text, which blank lines part; within them a new line is a space."""
    found = (re.sub(r"[ \n]+", " ", part).strip(" ") for part in re.split(r"\n\s*?\n", text))
    return [part for part in found if part]


def paragraphs(template: str, **values: Any) -> list[str]:
    """The paragraphs of a template of text."""
    return in_paragraphs(environment().get_template(template).render(values))


@cache
def texts(name: str) -> Any:
    """Words for codes, from a YAML file of templates."""
    return yaml.safe_load((files("siq.report") / "templates" / f"{name}.yaml").read_text(encoding="utf-8"))


def _formula_text(expression: sympy.Expr, *, decimals: int = 3) -> str:
    """A formula in one line: ``"1.000 x⁴ − 2.001 x² + 1.001"``, by falling degree, the constant last."""
    return str(_TextPrinter(decimals).doprint(_with_integer_exponents(expression)))


def term_text(term: str) -> str:
    """Write a term of a table for a reader: ``x**2*y`` as ``x² y``, and the constant as it is.

    Examples
    --------
    >>> term_text("x**2*y"), term_text("1")
    ('x² y', '1')
    """
    names = set(re.findall(r"[^\W\d]\w*", term)) - {*FUNCTIONS, *CONSTANTS}
    return _formula_text(parse_formula(term, {name: sympy.Symbol(name, real=True) for name in names}))


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
    return _typeset([[expression]], decimals, brackets=False)


def array_mathml(
    entries: Sequence[sympy.Expr] | Sequence[Sequence[sympy.Expr | float]], *, decimals: int = 3
) -> Markup:
    """Typeset a vector, as a column, or a matrix in brackets; an entry that stands alone without them."""
    if isinstance(entries[0], sympy.Expr):
        return _typeset([[entry] for entry in entries], decimals, flush=True)
    return _typeset(entries, decimals, brackets=len(entries) > 1)


def _typeset(
    rows: Sequence[Sequence[sympy.Expr | float]], decimals: int, *, brackets: bool = True, flush: bool = False
) -> Markup:
    """A table of formulas and numbers, in brackets, or the one entry; `flush` sets columns to the left."""
    printer = _MathMLPrinter(decimals)

    def text_and_node(entry: sympy.Expr | float) -> tuple[str, Any]:
        if isinstance(entry, sympy.Basic):
            return _formula_text(entry, decimals=decimals), printer.lines(_with_integer_exponents(entry))
        text = str(int(entry)).replace("-", MINUS) if float(entry).is_integer() else value_text(entry)
        return text, printer.leaf("mn", text)

    spoken, nodes = zip(*(zip(*map(text_and_node, row), strict=True) for row in rows), strict=True)
    content = printer.bracketed(printer.table(nodes, flush=flush)) if brackets else nodes[0][0]
    element = printer.element("math", content)
    element.setAttribute("aria-label", "; ".join(", ".join(row) for row in spoken))
    # The only place where markup is declared safe: minidom has escaped every text and attribute in it.
    return Markup(element.toxml())


def _with_integer_exponents(expression: sympy.Expr) -> sympy.Expr:
    return sympy.sympify(expression).replace(
        lambda part: part.is_Pow and part.exp.is_Float and float(part.exp).is_integer(),
        lambda part: sympy.Pow(part.base, int(part.exp), evaluate=False),
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

    def leaf(self, tag: str, text: str, **attributes: str) -> Any:
        made = self.element(tag, self.dom.createTextNode(text))
        for name, value in attributes.items():
            made.setAttribute(name, value)
        return made

    def bracketed(self, content: Any) -> Any:
        """Brackets as high as what stands between them."""
        high = dict.fromkeys(("fence", "stretchy", "symmetric"), "true")
        return self.element("mrow", self.leaf("mo", "[", **high), content, self.leaf("mo", "]", **high))

    def table(self, rows: Sequence[Sequence[Any]], *, flush: bool = True) -> Any:
        """A table of elements, by default flush left."""
        cells = [[self.element("mtd", entry) for entry in row] for row in rows]
        for cell in (cell for row in cells for cell in row if flush):
            cell.setAttribute("style", "text-align: left")
        return self.element("mtable", *(self.element("mtr", *row) for row in cells))

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
        return rows[0] if len(rows) == 1 else self.table([[row] for row in rows])

    def _signed(self, term: sympy.Expr, *, first: bool) -> list[Any]:
        negative, coefficient, rest = _sign_and_parts(term)
        nodes: list[Any] = []
        if negative or not first:
            place = {"form": "prefix"} if first else {}
            nodes.append(self.leaf("mo", MINUS if negative else "+", **place))
        if coefficient is not None:
            nodes.append(self._print(coefficient))
        if rest is not sympy.S.One:
            if coefficient is not None:
                nodes.append(self.leaf("mo", _INVISIBLE_TIMES, lspace="0.17em"))
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
