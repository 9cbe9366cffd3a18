"""Why may the answer of a study be believed, or may it not?"""

from __future__ import annotations

import pandas as pd

from siq.identify.diffusion import DiffusionSource
from siq.report.beside_equations import beside_sentences, beside_table
from siq.report.certificate_text import certificate_badge, tests_table
from siq.report.landscape_tables import errors_table, escape_table, landscape_sentences
from siq.report.page import Badge, ReportSection, ReportTable
from siq.report.said_landscape import SaidLandscape
from siq.report.sentences import control_sentences, run_sentences
from siq.report.study_captions import Part
from siq.report.study_results import ShownStudy
from siq.steps.outcomes import Method, Status


def study_badge(page: ShownStudy) -> Badge:
    """Whether the answer may be believed."""
    rrmse, certificates = page.results.tables["rrmse"], page.results.tables["certificates"]
    mine = rrmse[rrmse["method"] == page.method]
    refused = certificates[(certificates["method"] == page.method) & ~certificates["passed"]]
    refused = refused[refused["run"] == page.results.shown.run]
    return certificate_badge(
        page.certificate(),
        certified=int(mine["certified"].sum()),
        runs=page.study.runs,
        refusals=dict(zip(refused["test"], refused["reason"], strict=True)),
    )


def evidence_section(page: ShownStudy) -> ReportSection | None:
    """Why the answer may be believed, or may not."""
    tables, shown, folder = page.results.tables, page.results.shown, page.results.folder
    found = []
    if shown.run is not None:
        mine = tests_table(tables["certificates"], shown.run, shown.method)
        if len(mine):
            caption = "The tests of the certificate"
            caption += f", of run {shown.run}." if page.study.runs > 1 else "."
            found.append(ReportTable(caption, mine, {}, f"{folder}/certificates.csv", rows_named=True))
    if "landscape_errors" in tables and len(tables["landscape_errors"]):
        found.append(errors_table(tables["landscape_errors"], folder))
    if "beside_equations" in tables and len(tables["beside_equations"]):
        found.append(beside_table(tables["beside_equations"], folder))
    if "escape" in tables and len(tables["escape"]):
        time = "1" if page.results.overview is None else SaidLandscape(page.results.overview).time_unit
        found.append(escape_table(tables["escape"], time, folder))
    troubled = _troubled(page)
    if len(troubled):
        caption = "What went wrong, or was not certified."
        found.append(ReportTable(caption, troubled, {}, f"{folder}/outcomes.csv", rows_shown=60))
    text = [] if page.study.runs > 1 else runs_said(page)
    text += control_sentences(tables["certificates"])
    text += beside_sentences(tables.get("beside_equations"))
    text += [
        line for line in landscape_sentences(tables["landscape"], tables["outcomes"]) if shown.run is not None
    ]
    figures = page.figures(Part.EVIDENCE)
    if not (text or found or figures):
        return None
    return ReportSection(
        "How far it can be trusted", text, tables=found, figures=figures, notes=_remarks(page)
    )


def _remarks(page: ShownStudy) -> list[str]:
    """What steps that went well have to say, each once; where D is from stands beside D."""
    outcomes = page.results.tables["outcomes"]
    known = {source.note for source in DiffusionSource}
    texts = outcomes[outcomes["status"] == Status.OK]["reason"].dropna()
    return [f"{text[0].upper()}{text[1:]}." for text in dict.fromkeys(texts) if text and text not in known]


def runs_said(page: ShownStudy) -> list[str]:
    """What all runs say together, in sentences."""
    tables = page.results.tables
    return run_sentences(
        tables["rrmse"], tables["outcomes"], tables["summary"], runs=page.study.runs, method=page.method
    )


def _troubled(page: ShownStudy) -> pd.DataFrame:
    """Steps that failed, and refined formulas that are not certified; the run where there are several."""
    outcomes, rrmse = page.results.tables["outcomes"], page.results.tables["rrmse"]
    troubled = outcomes[outcomes["status"].isin([Status.FAILED, Status.WARNING])]
    # Which tests refused a formula is said once.
    troubled = troubled[~troubled["reason"].fillna("").str.startswith("not certified")]
    rows = pd.concat([troubled, _refusals(rrmse, page.results.tables["certificates"])])
    rows = rows[["run", "step", "status", "reason"]].sort_values(["run", "step"])
    return rows.drop(columns="run") if page.study.runs == 1 else rows


def _refusals(rrmse: pd.DataFrame, certificates: pd.DataFrame) -> pd.DataFrame:
    """Every refined formula that is not certified, with the tests that refused it."""
    refused = certificates[(certificates["method"] == Method.REFINED) & ~certificates["passed"]]
    reasons = refused.groupby("run")["reason"].agg(lambda texts: "; ".join(dict.fromkeys(texts)))
    rows = rrmse[(rrmse["method"] == Method.REFINED) & ~rrmse["certified"]]
    return pd.DataFrame(
        {
            "run": rows["run"],
            "step": "certify",
            "status": "not certified",
            "reason": rows["run"].map(reasons).fillna("there is no refined formula"),
        }
    )
