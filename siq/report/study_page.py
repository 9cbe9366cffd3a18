"""The page of a study: the answer first, then formulas, then evidence, then the workings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from siq.report.evidence_section import evidence_section, study_badge
from siq.report.formula_section import formula_section
from siq.report.landscape_answer import wells_table
from siq.report.page import ReportContent, ReportSection, ReportTable
from siq.report.study_captions import LEADING, OF_ONE_STATE, figure_of, shown_figures
from siq.report.study_results import ShownStudy, StudyResults
from siq.report.study_sections import (
    landscape_section,
    published_section,
    record_section,
    recordings_section,
    runs_section,
    study_answer,
)
from siq.report.workings_section import provenance_section, workings_section
from siq.study.study import Study

AGAIN = "Change one parameter of the study and run it again: only what depends on it is made again."


def study_page(
    study: Study, results: StudyResults, *, command: str, versions: Mapping[str, str]
) -> ReportContent:
    """All that the page of a study says.

    Parameters
    ----------
    study
        What was asked.
    results
        What came of it.
    command
        How to make the page again.
    versions
        Of the programs that took part, by name.
    """
    beside_paper = study.published is not None
    drawn = shown_figures(
        set(results.images), runs=study.runs, networks=study.training is not None, published=beside_paper
    )
    images = {name: image for name, image in results.images.items() if name in drawn}
    lead = next((name for name in LEADING if name in drawn), None)
    page = ShownStudy(study, results, images, lead, beside_paper)
    overview = results.overview
    table = None
    if overview is not None and overview["wells"]:
        shown, data = wells_table(overview)
        table = ReportTable("Stable states, barriers and times.", shown, data=data, rows_named=True)
    figure = None
    if lead is not None:
        figure = figure_of(lead, results.images, results.vectors, beside_paper=beside_paper)
        if overview is not None and len(overview["states"]) == 1:
            figure = replace(figure, caption=OF_ONE_STATE, alternative=OF_ONE_STATE)
    sections = [
        recordings_section(page),
        formula_section(page),
        record_section(page),
        evidence_section(page),
        landscape_section(page),
        runs_section(page),
        published_section(page),
        workings_section(page),
        ReportSection("How to run it again", listing=command, text=[AGAIN]),
        provenance_section(page, versions),
    ]
    return ReportContent(
        title=study.title or study.name,
        answer=study_answer(page),
        badge=study_badge(page),
        figure=figure,
        table=table,
        interactive=results.interactive,
        sections=[section for section in sections if section is not None],
    )
