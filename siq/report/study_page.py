"""The page of a study: the answer, formulas, evidence, the landscape, the workings."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd
import yaml

from siq.data.inspection import inspection_of
from siq.data.recordings import Recordings
from siq.data.selection import joined
from siq.data.two_states import RecordStates
from siq.inference.field_estimate import DiffusionSource
from siq.quasipotential.landscape import told_without_landscape
from siq.report.formula_sections import formula_section, formulas_by
from siq.report.landscape_answer import (
    certificate_badge,
    headline,
    record_sentences,
    record_table,
    remarks,
    tests_table,
    wells_table,
    with_seen_states,
)
from siq.report.landscape_summary import SaidLandscape
from siq.report.landscape_tables import (
    beside_sentences,
    beside_table,
    errors_table,
    escape_table,
    invariant_tables,
    landscape_sentences,
    landscape_tables,
)
from siq.report.page import Badge, ReportContent, ReportFigure, ReportSection, ReportTable
from siq.report.study_figures import LEADING, OF_ONE_STATE, Part, figure_of, shown_figures
from siq.report.study_results import ShownStudy, StudyResults, control_sentences, method_tables, run_sentences
from siq.workflow.outcomes import Method, Outcome, Status, Step, why_no_landscape
from siq.workflow.study import Study
from siq.workflow.tables import as_table


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


if TYPE_CHECKING:
    from matplotlib.figure import Figure

HEADING = "What is in the recordings"
CAPTIONS: Mapping[str, str] = {
    "record": "The states in the course of time; of long recordings from the lowest to the highest value.",
    "visited": "How often states were visited: what was never visited, no formula knows.",
    "memory": "Correlation of what increments leave once their mean is taken off, over the steps between"
    " them; within the band they know nothing of each other. The mean is that which earlier states tell.",
}


FILE, SEEN = "inspection.json", "seen.json"


def inspection_drawn(recordings: Recordings, *, folder: Path) -> dict[str, Figure]:
    """The figures of an inspection by name; what it says is written into the folder."""
    from siq.report.plots.recordings import inspection_figures  # matplotlib

    found = inspection_of(joined(recordings))
    (folder / FILE).write_text(json.dumps(found.lines(), ensure_ascii=False) + "\n", encoding="utf-8")
    (folder / SEEN).write_text(
        json.dumps(None if found.seen is None else found.seen.as_data(), ensure_ascii=False, allow_nan=False)
        + "\n",
        encoding="utf-8",
    )
    return inspection_figures(found)


def read_seen(folder: str | Path) -> RecordStates | None:
    """What `inspection_drawn` wrote of two states; None where recordings were simulated."""
    file = Path(folder) / SEEN
    data = json.loads(file.read_text(encoding="utf-8")) if file.is_file() else None
    return None if data is None else RecordStates.from_data(data)


def read_inspection(folder: str | Path) -> list[str] | None:
    """What `inspection_drawn` wrote, line by line; None where recordings were simulated."""
    file = Path(folder) / FILE
    return json.loads(file.read_text(encoding="utf-8")) if file.is_file() else None


def inspection_section(
    lines: Sequence[str], images: Mapping[str, bytes], vectors: Mapping[str, bytes]
) -> ReportSection:
    """The section, from the lines of an inspection and its figures, PNG and SVG by name."""
    sentences = [line if line.endswith((".", ":")) else f"{line}." for line in lines]
    figures = [
        ReportFigure(caption, caption, images[name], "png", vectors.get(name))
        for name, caption in CAPTIONS.items()
        if name in images
    ]
    # The name of a state stays as it is: X is not x.
    named = [line.partition(" ")[0].endswith(":") for line in sentences]
    capital = [
        line if is_state else f"{line[0].upper()}{line[1:]}"
        for line, is_state in zip(sentences, named, strict=True)
    ]
    return ReportSection(HEADING, capital, figures=figures)


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


def workings_section(page: ShownStudy) -> ReportSection:
    """The recordings, and what became of each step."""
    outcomes = page.results.tables["outcomes"]
    steps = outcomes.drop(columns="run") if page.study.runs == 1 else outcomes
    caption = "What became of each step" + (" of each run." if page.study.runs > 1 else ".")
    return ReportSection(
        "The recordings and the workings", [_source(page), _method_said(page)],
        tables=[ReportTable(caption, steps, {}, f"{page.results.folder}/outcomes.csv", 12)],
        figures=page.figures(Part.WORKINGS), folded=True,
    )  # fmt: skip


def _source(page: ShownStudy) -> str:
    recordings = page.study.recordings
    if recordings is not None:
        return f"The recordings are those in {recordings.file}."
    return f"The recordings are simulated trajectories of the system {page.study.system}."


def _method_said(page: ShownStudy) -> str:
    routes = page.study.refinement.with_routes(networks=page.study.training is not None).routes or ()
    if page.results.record is None:
        return "No f was identified, so that there is no formula."
    return (
        f"f was identified {_identified_by(page)}. The formulas solve the Hamilton–Jacobi"
        " equation of this"
        f" f, by the {' and the '.join(routes)} route, and have to pass the tests of the certificate."
    )


def _identified_by(page: ShownStudy) -> str:
    record = page.results.record
    if record is not None and record.memory is not None:
        return f"from pairs of samples, as seen from {record.memory[0]} steps earlier"
    if record is not None and record.sensor_variance is not None:
        return "by the likelihood of whole recordings, with the noise of the sensor beside it"
    return "from neighbouring samples alone"


def provenance_section(page: ShownStudy, versions: Mapping[str, str]) -> ReportSection:
    """The study as it was asked, with what, and how long."""
    timings = page.results.tables["timings"]
    total = timings.groupby("step")["seconds"].sum()
    spent = ", ".join(f"{step} {seconds:.0f} s" for step, seconds in total.items())
    named = ", ".join(f"{name} {version}" for name, version in versions.items())
    machine = f"Python {platform.python_version()} on {platform.system()} {platform.machine()}"
    text = [f"{named}; {machine}, {os.cpu_count()} cores.", f"Processor time by step: {spent}."]
    printed = yaml.safe_dump(_printed(page.study), sort_keys=False, allow_unicode=True)
    return ReportSection("The study and the versions", text, listing=printed, folded=True)


def _printed(study: Study) -> dict[str, Any]:
    """The study as plain data; of recordings nothing is simulated."""
    data = study.model_dump(mode="json", by_alias=True)
    return data if study.recordings is None else data | {"simulation": None}


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
