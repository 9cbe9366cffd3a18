"""What a page is made from: sections with formulas, tables and figures, and what it opens with.

The page asks nothing of any other machine: style, figures, formulas and downloads stand in it. It has no
scripts, but for the view of U that can be turned, where there is one. `siq.report.rendering` makes HTML
of it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import pandas as pd
from markupsafe import Markup

from siq.report.rendering import render_template as render_template


@dataclass(frozen=True)
class FormulaRow:
    """One formula.

    Attributes
    ----------
    quantity
        What the formula gives: ``"U"``, ``"f"``, typeset or as text.
    formula
        Typeset by `siq.report.formatting`; plain text is shown as text.
    note
        What to know of it, in a sentence.
    exact
        The exact formula, where one is known.
    whole
        The formula in full, folded away, where `formula` leaves small terms out.
    """

    quantity: Markup | str
    formula: Markup | str
    note: str = ""
    exact: Markup | str | None = None
    whole: Markup | str | None = None


@dataclass(frozen=True)
class ReportTable:
    """A table of the report; it can be downloaded as CSV, with all its rows.

    Attributes
    ----------
    caption
        What the table shows, in a sentence.
    frame
        The table; its index is not shown, and neither are columns that hold nothing.
    column_help
        What the columns mean, by name.
    whole
        Where it lies as a file, for one that is cut.
    rows_shown
        After how many rows the table is cut.
    data
        What is downloaded, where that is more than what is shown.
    rows_named
        Whether the first column names the rows.
    """

    caption: str
    frame: pd.DataFrame
    column_help: Mapping[str, str] = field(default_factory=dict)
    whole: str = ""
    rows_shown: int = 30
    data: pd.DataFrame | None = None
    rows_named: bool = False


@dataclass(frozen=True)
class ReportFigure:
    """A figure of the report; it can be downloaded.

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
    vector
        The same as SVG, for the download.
    """

    caption: str
    alternative: str
    image: bytes
    kind: Literal["svg", "png"] = "svg"
    vector: bytes | None = None


@dataclass(frozen=True)
class ReportSection:
    """A section of the report.

    Attributes
    ----------
    heading
        Its heading.
    text
        Paragraphs.
    formulas, tables, figures
        Below the text, in this order.
    notes
        Paragraphs below all of it, in small print.
    folded
        Whether it is closed until a reader opens it.
    listing
        Lines of code, such as commands.
    """

    heading: str
    text: Sequence[str] = ()
    formulas: Sequence[FormulaRow] = ()
    tables: Sequence[ReportTable] = ()
    figures: Sequence[ReportFigure] = ()
    notes: Sequence[str] = ()
    folded: bool = False
    listing: str = ""


@dataclass(frozen=True)
class Badge:
    """Whether the answer may be believed.

    Attributes
    ----------
    label
        In two words.
    good
        Whether it may.
    promise
        What that means, in plain words.
    """

    label: str
    good: bool
    promise: Sequence[str] = ()


@dataclass(frozen=True)
class ReportContent:
    """All that a report says, in the order in which it is read.

    Attributes
    ----------
    title
        Title of the study.
    answer
        The answer: a sentence that stands alone, and what has to be known of it.
    badge
        Whether it may be believed.
    figure, table
        What it looks like, beside each other.
    figure_first
        Whether the figure stands above the answer.
    interactive
        A view that can be turned, with its script; None where there is none.
    sections
        Everything else.
    language
        Language of the page, for hyphenation and screen readers.
    """

    title: str
    answer: Sequence[str] = ()
    badge: Badge | None = None
    figure: ReportFigure | None = None
    table: ReportTable | None = None
    figure_first: bool = False
    interactive: Markup | None = None
    sections: Sequence[ReportSection] = ()
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
    return render_template("report.html.j2", content)


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
