"""What does a study answer, and what does its page say of its landscape, its runs, the published method?"""

from __future__ import annotations

from siq.landscape.refusal import told_without_landscape
from siq.report.evidence_section import runs_said
from siq.report.formula_section import formulas_by
from siq.report.inspection_section import inspection_section
from siq.report.invariant_tables import invariant_tables
from siq.report.landscape_answer import headline, remarks
from siq.report.landscape_tables import landscape_tables
from siq.report.page import ReportSection
from siq.report.record_answer import record_sentences, record_table, with_seen_states
from siq.report.said_landscape import SaidLandscape
from siq.report.study_captions import Part
from siq.report.study_results import ShownStudy
from siq.report.study_runs import method_tables
from siq.steps.outcomes import Method, Outcome, Status, Step, why_no_landscape
from siq.study.tables import as_table


def study_answer(page: ShownStudy) -> list[str]:
    """The sentence, and what has to be known of it."""
    overview, seen = page.results.overview, page.results.seen
    if overview is None or not overview["wells"]:
        return told_without_landscape(_why(page), seen)
    certificate = page.certificate()
    certified = certificate is not None and bool(certificate["certified"])
    return with_seen_states([headline(overview), *remarks(overview)], overview, seen, certified=certified)


def _why(page: ShownStudy) -> str:
    rows = page.results.tables["outcomes"].fillna({"reason": ""}).to_dict("records")
    return why_no_landscape(
        Outcome(int(row["run"]), Step(row["step"]), Status(row["status"]), str(row["reason"])) for row in rows
    )


def recordings_section(page: ShownStudy) -> ReportSection | None:
    """What is in the recordings, before anything is learned from them."""
    if page.results.inspection is None:
        return None
    return inspection_section(page.results.inspection, page.results.images, page.results.vectors)


def record_section(page: ShownStudy) -> ReportSection | None:
    """The record's own hops and histogram, beside what was identified."""
    shown, certificate = page.results.shown, page.certificate()
    table = page.results.tables.get("record", as_table("record", []))
    mine = table[table["run"] == shown.run]
    missing = "" if certificate is None else str(certificate.get("no_record_test") or "")
    text, figures = record_sentences(mine, missing), page.figures(Part.RECORD)
    if not text and not figures:
        return None
    overview = page.results.overview
    time = "1" if overview is None else SaidLandscape(overview).time_unit
    found = record_table(mine, time, page.results.folder)
    return ReportSection(
        "Against the record itself", text, tables=[] if found is None else [found], figures=figures
    )


def landscape_section(page: ShownStudy) -> ReportSection | None:
    """Every way out, every equilibrium, the density."""
    tables, folder = page.results.tables, page.results.folder
    options = page.study.landscape
    found = landscape_tables(
        page.results.overview,
        tables["landscape"],
        noises=() if options is None else options.noise_intensities,
        folder=folder,
    )
    found += invariant_tables(tables["invariant"], tables["well_shares"], folder)
    figures = page.figures(Part.LANDSCAPE)
    if not found and not figures:
        return None
    text = []
    overview = page.results.overview
    if overview is not None and page.study.runs > 1:
        text = [f"The landscape is that of run {overview['run']}."]
    return ReportSection("The landscape in full", text, tables=found, figures=figures)


def runs_section(page: ShownStudy) -> ReportSection | None:
    """What varies from run to run; of one run nothing does."""
    if page.study.runs == 1:
        return None
    tables, folder = page.results.tables, page.results.folder
    found = method_tables(
        tables, folder, (str(page.method), str(Method.CONTROL)), beside_paper=page.beside_paper
    )
    return ReportSection(
        f"What {page.study.runs} runs say together", runs_said(page),
        tables=found, figures=page.figures(Part.RUNS),
    )  # fmt: skip


def published_section(page: ShownStudy) -> ReportSection | None:
    """What the published method made of the networks, and what was published."""
    other = page.study.training is not None and page.method != Method.REGRESSION
    rows = formulas_by(page, Method.REGRESSION) if other else []
    figures = page.figures(Part.PUBLISHED)
    if not rows and not figures:
        return None
    text = []
    training, regression = page.study.training, page.study.regression
    if training is not None:
        text.append(
            f"The published method trains two networks, here for at most {training.steps} steps on"
            f" batches of"
            f" {training.batch_size}, and regresses formulas of degree {regression.degree} at most on"
            f" them. Terms"
            f" below {regression.threshold} are dropped (of the {regression.threshold_on})."
        )
    if rows:
        text.append(_regression_verdict(page))
    tables = []
    if page.study.runs > 1 and other:
        tables = method_tables(
            page.results.tables, page.results.folder, (str(Method.REGRESSION),),
            beside_paper=page.beside_paper,
        )  # fmt: skip
    return ReportSection("The published method", text, rows, tables, figures, folded=not page.beside_paper)


def _regression_verdict(page: ShownStudy) -> str:
    shown = page.results.shown
    assert shown.run is not None  # it has formulas
    one = page.results.models.certificates(shown.run)[str(Method.REGRESSION)]
    if one["certified"]:
        return "Its formulas are certified."
    return f"Its formulas are not certified: {one['reason']}."
