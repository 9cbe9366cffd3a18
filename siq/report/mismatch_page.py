"""The page of a diagnosis: what a simulation lacks, how sure that is, where it sits, and what follows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from siq.report.mismatch_findings import Findings
from siq.report.mismatch_first_screen import VerdictBadge, answer, badge, numbers, picture
from siq.report.mismatch_sections import MismatchSection, sections
from siq.report.page import ReportFigure, ReportTable, render_template


@dataclass(frozen=True)
class MismatchContent:
    """All that the page says, in the order in which it is read.

    Attributes
    ----------
    title
        What was asked.
    answer
        The verdict in a sentence that stands alone, and what has to be known with it.
    badge
        The same in two words.
    figure, table
        The recording before and after, and the number.
    sections
        Everything else.
    interactive
        A view that can be turned; there is none.
    language
        Of the page.
    """

    title: str
    answer: Sequence[str]
    badge: VerdictBadge
    figure: ReportFigure | None
    table: ReportTable | None
    sections: Sequence[MismatchSection]
    interactive: None = None
    language: str = "en"


def mismatch_page(findings: Findings, *, title: str, commands: Sequence[str]) -> str:
    """Write the page as HTML."""
    content = MismatchContent(
        title=title,
        answer=answer(findings),
        badge=badge(findings),
        figure=picture(findings),
        table=numbers(findings),
        sections=sections(findings, commands=commands),
    )
    return render_template("report.html.j2", content)
