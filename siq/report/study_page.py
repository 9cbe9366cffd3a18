"""The page of a study: the answer first, then formulas, then evidence, then the workings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from siq.report.landscape_answer import wells_table
from siq.report.page import ReportContent, ReportSection, ReportTable
from siq.report.study_captions import LEADING, OF_ONE_STATE, figure_of, shown_figures
from siq.report.study_sections import StudyParts, StudyResults
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
    page = StudyParts(study, results, images, lead, beside_paper)
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
        page.inspected(),
        page.formulas(),
        page.record(),
        page.evidence(),
        page.landscape(),
        page.over_runs(),
        page.published(),
        page.workings(),
        ReportSection("How to run it again", listing=command, text=[AGAIN]),
        page.provenance(versions),
    ]
    return ReportContent(
        title=study.title or study.name,
        answer=page.answer(),
        badge=page.badge(),
        figure=figure,
        table=table,
        interactive=results.interactive,
        sections=[section for section in sections if section is not None],
    )
