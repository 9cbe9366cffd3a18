"""The report: one self-contained HTML page that answers a study in words, formulas, tables and figures.

The page asks nothing of any other machine: style, figures and formulas stand in it, and it has no scripts.
"""

from __future__ import annotations

import base64
import datetime
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from siq.numerics.number_text import number_text


@dataclass(frozen=True)
class FormulaRow:
    """One formula that a method found.

    Attributes
    ----------
    quantity
        What the formula gives: ``"U(x, y, z)"``, ``"∇V"``, ``"g"``.
    method
        The method that found it.
    identified, exact
        The formulas, typeset by `siq.report.formatting`; plain text is shown as text. None where there is
        none.
    certified
        Whether the formula passed every test of its certificate.
    reason
        If it did not, the test that it failed.
    """

    quantity: str
    method: str
    identified: Markup | str | None
    exact: Markup | str | None = None
    certified: bool = False
    reason: str = ""


@dataclass(frozen=True)
class ReportTable:
    """A table of the report.

    Attributes
    ----------
    caption
        What the table shows, in a sentence.
    frame
        The table; its index is not shown.
    column_help
        What the columns mean, by name.
    whole
        Where the whole table is, for one that is cut.
    rows_shown
        After how many rows the table is cut.
    """

    caption: str
    frame: pd.DataFrame
    column_help: Mapping[str, str] = field(default_factory=dict)
    whole: str = ""
    rows_shown: int = 30


@dataclass(frozen=True)
class ReportFigure:
    """A figure of the report.

    Attributes
    ----------
    caption
        What the figure shows, in sentences.
    alternative
        What somebody who cannot see it should know of it.
    image
        The bytes of the file.
    kind
        Its format.
    """

    caption: str
    alternative: str
    image: bytes
    kind: Literal["svg", "png"] = "svg"


@dataclass(frozen=True)
class ReportContent:
    """All that a report says.

    Attributes
    ----------
    title
        Title of the study.
    question
        What was asked, in paragraphs.
    answer
        The answer, in sentences.
    formulas, tables, figures
        In the order in which they are shown.
    failures
        Runs that failed or are not certified: columns ``run step status reason``, empty if there is none.
    commands
        Command lines that make everything again.
    study
        The study as YAML text.
    provenance
        Versions, cores and the like, by name.
    language
        Language of the page, for hyphenation and screen readers.
    """

    title: str
    question: Sequence[str] = ()
    answer: Sequence[str] = ()
    formulas: Sequence[FormulaRow] = ()
    tables: Sequence[ReportTable] = ()
    figures: Sequence[ReportFigure] = ()
    failures: pd.DataFrame = field(
        default_factory=lambda: pd.DataFrame(columns=["run", "step", "status", "reason"])
    )
    commands: Sequence[str] = ()
    study: str = ""
    provenance: Mapping[str, str] = field(default_factory=dict)
    language: str = "en"


def render_report(content: ReportContent) -> str:
    """Render a report as one HTML page.

    Parameters
    ----------
    content
        What the page says. All text is escaped, but for formulas that are `markupsafe.Markup`.

    Returns
    -------
    str
        The page. The same content gives the same page.
    """
    groups = [
        (*key, list(rows))
        for key, rows in itertools.groupby(
            content.formulas, key=lambda row: (row.method, row.certified, row.reason)
        )
    ]
    template = _environment().get_template("report.html.j2")
    return template.render(content=content, formula_groups=groups)


@dataclass(frozen=True)
class ReproductionSection:
    """One place of a publication, with ours beside it.

    Attributes
    ----------
    place
        The place: ``Fig. 8 (fig2b)``.
    text
        What it shows, and what of it is not shown here, in paragraphs.
    tables, figures
        Its numbers with ours, and our figures.
    """

    place: str
    text: Sequence[str] = ()
    tables: Sequence[ReportTable] = ()
    figures: Sequence[ReportFigure] = ()


@dataclass(frozen=True)
class ReproductionContent:
    """All that the page of a reproduction says.

    Attributes
    ----------
    title, introduction
        Title, and paragraphs below it.
    overview
        Tables over everything.
    contradictions
        Sentences.
    sections
        The places of the publication, in its order.
    commands
        Command lines that make everything again.
    language
        Language of the page, for hyphenation and screen readers.
    """

    title: str
    introduction: Sequence[str] = ()
    overview: Sequence[ReportTable] = ()
    contradictions: Sequence[str] = ()
    sections: Sequence[ReproductionSection] = ()
    commands: Sequence[str] = ()
    language: str = "en"


def render_reproduction(content: ReproductionContent) -> str:
    """Render a reproduction as one HTML page; all text is escaped."""
    return render_template("reproduction.html.j2", content)


def render_template(name: str, content: object) -> str:
    """Render a page of its own kind as HTML; all text is escaped, but for what is `markupsafe.Markup`."""
    return _environment().get_template(name).render(content=content)


def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("siq.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {
        "cell": _cell_text,
        "is_number": _is_number_column,
        "data_address": _data_address,
        "page_width": _page_width,
        "unbroken": lambda text: text.replace(" × 10", "\u00a0×\u00a010"),
        "records": lambda frame: list(frame.itertuples(index=False, name=None)),
    }
    return environment


def _data_address(figure: ReportFigure) -> str:
    # An SVG inside <img> keeps its identifiers to itself and cannot run or load anything.
    kind = {"svg": "image/svg+xml", "png": "image/png"}[figure.kind]
    return f"data:{kind};base64,{base64.b64encode(figure.image).decode('ascii')}"


def _page_width(figure: ReportFigure) -> int:
    # The first chunk of every PNG holds its width in dots, of which there are 200 to the inch; pages have 96.
    return round(int.from_bytes(figure.image[16:20], "big") * 96 / 200)


def _is_number_column(column: pd.Series) -> bool:
    return pd.api.types.is_numeric_dtype(column) and not pd.api.types.is_bool_dtype(column)


def _cell_text(value: object) -> str:
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
