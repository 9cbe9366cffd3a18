"""The page of a diagnosis: what a simulation lacks, where, how sure that is, and what follows from it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from siq.report.mismatch_findings import Findings, mechanisms_said, number, sizes
from siq.report.mismatch_sections import MismatchSection, sections
from siq.report.page import render_template


@dataclass(frozen=True)
class MismatchContent:
    """All that the page says.

    Attributes
    ----------
    title
        What was asked.
    verdict
        In two words.
    answer
        The same in sentences.
    sections
        In the order of the page.
    commands
        Command lines that make everything again.
    language
        Of the page.
    """

    title: str
    verdict: str
    answer: Sequence[str]
    sections: Sequence[MismatchSection]
    commands: Sequence[str] = ()
    language: str = "en"


def mismatch_page(findings: Findings, *, title: str, commands: Sequence[str]) -> str:
    """Write the page as HTML."""
    content = MismatchContent(
        title=title,
        verdict=str(findings.verdict["verdict"]),
        answer=answer(findings),
        sections=[section for section in sections(findings) if section is not None],
        commands=commands,
    )
    return render_template("mismatch.html.j2", content)


def answer(findings: Findings) -> list[str]:
    """The verdict in sentences: what, how large, and how much better the fit is."""
    verdict = findings.verdict
    lines = [str(verdict["sentence"])]
    for each in mechanisms_said(findings):
        if known := sizes(each):
            lines.append(f"{each['label'][:1].upper()}{each['label'][1:]}: {known}.")
    fit = verdict["fit"]
    named = ("before", "recalibrated", "augmented")
    words = dict(zip(named, ("as it is", "recalibrated", "with what was found"), strict=True))
    parts = [f"{number(fit[name])} {words[name]}" for name in named]
    floor = number(fit["noise_floor"])
    lines.append(
        f"On held-out recordings the simulation's error, in units of their spread, is {', '.join(parts)};"
        f" noise alone would be {floor}."
    )
    return lines
