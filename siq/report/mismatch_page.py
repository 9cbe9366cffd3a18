"""The page of a diagnosis: what a simulation lacks, how sure that is, where it sits, and what follows."""

from __future__ import annotations

from collections.abc import Sequence

from siq.report.mismatch_findings import Findings
from siq.report.mismatch_first_screen import answer, badge, numbers, picture
from siq.report.mismatch_sections import sections
from siq.report.page import ReportContent, render_report


def mismatch_page(findings: Findings, *, title: str, commands: Sequence[str]) -> str:
    """Write the page as HTML: the recording that differs most, the verdict, the number, and the rest."""
    content = ReportContent(
        title=title,
        answer=answer(findings),
        badge=badge(findings),
        figure=picture(findings),
        figure_first=True,
        table=numbers(findings),
        sections=sections(findings, commands=commands),
    )
    return render_report(content)
