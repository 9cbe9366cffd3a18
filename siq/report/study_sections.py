"""The parts of the page of a study: formulas, evidence, landscape, runs, the published method, workings."""

from __future__ import annotations

import os
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
import yaml
from markupsafe import Markup

from siq.data.record_states import RecordStates
from siq.identify.diffusion import DiffusionSource
from siq.identify.storage import FieldRecord
from siq.landscape.refusal import told_without_landscape
from siq.potential.symbolic import SymbolicDecomposition
from siq.report.beside_equations import beside_sentences, beside_table
from siq.report.certificate_text import certificate_badge, tests_table
from siq.report.formatting import formula_matrix_mathml, matrix_mathml, vector_mathml
from siq.report.inspection_section import inspection_section
from siq.report.invariant_tables import invariant_tables
from siq.report.landscape_answer import headline, remarks
from siq.report.landscape_tables import errors_table, escape_table, landscape_sentences, landscape_tables
from siq.report.page import Badge, FormulaRow, ReportSection, ReportTable
from siq.report.record_answer import record_sentences, record_table, with_seen_states
from siq.report.said_landscape import SaidLandscape
from siq.report.sentences import control_sentences, run_sentences
from siq.report.study_captions import Part, figures_of
from siq.report.study_formulas import coefficient_table, formula_rows
from siq.report.study_runs import method_tables
from siq.steps.outcomes import Method, Outcome, Status, Step, why_no_landscape
from siq.steps.shown import ModelFiles, Shown
from siq.study.study import Study
from siq.study.tables import as_table

SOURCES = {
    DiffusionSource.GIVEN: "As given.",
    DiffusionSource.ESTIMATED: "Estimated from the noise in the recordings, since none was given, and"
    " scaled to the determinant 1, so that ε is the size of the noise.",
    DiffusionSource.OF_VELOCITIES: "Estimated from the recorded positions. Its part that acts on the"
    " velocities, the only one there is, is scaled to the determinant 1, so that ε is the size of the random"
    " forces.",
    DiffusionSource.UNIT: "Taken as the unit matrix: none was given, and the recordings show no noise that"
    " would tell. U and the barriers follow from it.",
}

BY_STATE = "It depends on the state, in the sense of Itô: the noise is not the same everywhere."


@dataclass(frozen=True)
class StudyResults:
    """What a study left behind.

    Attributes
    ----------
    tables
        By name, see `siq.study.tables.COLUMNS`; `landscape_errors` and `escape` with a card only,
        and `beside_equations` where the study asks for it.
    folder
        Where the whole tables are.
    models
        The formulas of all runs.
    shown
        The run whose formulas are printed.
    exact
        The exact ones, where they are known.
    images, vectors
        The figures that there are by name, as PNG and as SVG.
    overview
        The landscape that the page opens with, as plain data; None where there is none.
    record
        f and D of the run that is shown, None where there is none.
    interactive
        A view of U that can be turned, None where there is none.
    inspection
        What is in the recordings, line by line; None where they were simulated.
    seen
        The two states that they show by themselves; None where nothing is known of that.
    """

    tables: Mapping[str, pd.DataFrame]
    folder: Path
    models: ModelFiles
    shown: Shown
    exact: SymbolicDecomposition | None
    images: Mapping[str, bytes]
    vectors: Mapping[str, bytes]
    overview: Mapping[str, Any] | None = None
    record: FieldRecord | None = None
    interactive: Markup | None = None
    inspection: Sequence[str] | None = None
    seen: RecordStates | None = None


@dataclass(frozen=True)
class StudyParts:
    """What each part of the page says; `images` are the figures that are shown, with the `lead`."""

    study: Study
    results: StudyResults
    images: Mapping[str, bytes]
    lead: str | None
    beside_paper: bool

    def _figures(self, part: Part) -> list[Any]:
        images = {name: image for name, image in self.images.items() if name != self.lead}
        return figures_of(part, images, self.results.vectors, beside_paper=self.beside_paper)

    @property
    def _method(self) -> Method:
        return self.results.shown.method

    def _certificate(self) -> Mapping[str, Any] | None:
        shown = self.results.shown
        if shown.run is None:
            return None
        found: Mapping[str, Any] | None = self.results.models.certificates(shown.run).get(str(shown.method))
        return found

    def answer(self) -> list[str]:
        """The sentence, and what has to be known of it."""
        overview, seen = self.results.overview, self.results.seen
        if overview is None or not overview["wells"]:
            return told_without_landscape(self._why(), seen)
        certificate = self._certificate()
        certified = certificate is not None and bool(certificate["certified"])
        return with_seen_states([headline(overview), *remarks(overview)], overview, seen, certified=certified)

    def _why(self) -> str:
        rows = self.results.tables["outcomes"].fillna({"reason": ""}).to_dict("records")
        return why_no_landscape(
            Outcome(int(row["run"]), Step(row["step"]), Status(row["status"]), str(row["reason"]))
            for row in rows
        )

    def badge(self) -> Badge:
        """Whether the answer may be believed."""
        rrmse, certificates = self.results.tables["rrmse"], self.results.tables["certificates"]
        mine = rrmse[rrmse["method"] == self._method]
        refused = certificates[(certificates["method"] == self._method) & ~certificates["passed"]]
        refused = refused[refused["run"] == self.results.shown.run]
        return certificate_badge(
            self._certificate(),
            certified=int(mine["certified"].sum()),
            runs=self.study.runs,
            refusals=dict(zip(refused["test"], refused["reason"], strict=True)),
        )

    def inspected(self) -> ReportSection | None:
        """What is in the recordings, before anything is learned from them."""
        if self.results.inspection is None:
            return None
        return inspection_section(self.results.inspection, self.results.images, self.results.vectors)

    def formulas(self) -> ReportSection | None:
        """What was found, typeset, with coefficients and their errors."""
        results, shown = self.results, self.results.shown
        rows = self._formulas_of(self._method)
        record = results.record
        if record is not None and not rows:
            field = vector_mathml(record.found.dynamics.formulas)
            rows.append(FormulaRow("f", field, "The vector field dx/dt without noise, as identified."))
        if record is not None:
            note = SOURCES[record.diffusion_source]
            noise = record.found.diffusion
            if noise.constant:
                rows.append(FormulaRow("D", matrix_mathml(noise.matrix.tolist()), note))
            else:
                rows.append(FormulaRow("D", formula_matrix_mathml(noise.formulas), f"{note} {BY_STATE}"))
        if not rows:
            return None
        text = []
        if self.study.runs > 1 and shown.run is not None:
            known = results.tables["rrmse"]["rrmse"].notna().any()
            text.append(
                f"The formulas are those of run {shown.run}"
                + (", the median of the runs by error." if known else ".")
            )
        if self._method == Method.REGRESSION and shown.run is not None:
            text.append("They are those of the published method: no refined formula was found.")
        return ReportSection(
            "Formulas", text, formulas=rows, tables=self._coefficients(), notes=[DECOMPOSITION]
        )

    def _formulas_of(self, method: Method) -> list[FormulaRow]:
        shown = self.results.shown
        found = {} if shown.run is None else self.results.models.formulas(shown.run)
        if method not in found:
            return []
        overview = self.results.overview or {"wells": [], "transitions": []}
        depths = [way["barrier"] for way in overview["transitions"] if way["barrier"] is not None]
        return formula_rows(
            found[method], self.results.exact,
            places=[one["attractor"] for one in overview["wells"]], depth=max(depths, default=0.0),
        )  # fmt: skip

    def _coefficients(self) -> list[ReportTable]:
        coefficients, shown = self.results.tables["coefficients"], self.results.shown
        mine = coefficients[
            (coefficients["run"] == shown.run) & (coefficients["method"] == str(shown.method))
        ]
        units: dict[str, str] = {}
        if self.results.overview is not None:
            said = SaidLandscape(self.results.overview)
            units = dict(zip(said.states, said.units, strict=True)) | {"t": said.time_unit}
        largest = mine[mine["component"] == "U"]["estimate"].abs().max()
        nothing = (
            (mine["term"] == "1") & (mine["component"] == "U") & (mine["estimate"].abs() < 1e-12 * largest)
        )
        mine = mine[~nothing]
        table = coefficient_table(mine, units=units, components=SHOWN)
        if table is None:
            return []
        chosen = mine[mine["component"].str.match("U$|g_|f_") & (mine["estimate"] != 0)]
        caption = "Coefficients with their standard errors; those without ± are exact to the digits shown."
        file = f"{self.results.folder}/coefficients.csv"
        return [ReportTable(caption, table, {}, file, 30, data=chosen.drop(columns=["run", "method"]))]

    def evidence(self) -> ReportSection | None:
        """Why the answer may be believed, or may not."""
        tables, shown, folder = self.results.tables, self.results.shown, self.results.folder
        found = []
        if shown.run is not None:
            mine = tests_table(tables["certificates"], shown.run, shown.method)
            if len(mine):
                caption = "The tests of the certificate"
                caption += f", of run {shown.run}." if self.study.runs > 1 else "."
                found.append(ReportTable(caption, mine, {}, f"{folder}/certificates.csv", rows_named=True))
        if "landscape_errors" in tables and len(tables["landscape_errors"]):
            found.append(errors_table(tables["landscape_errors"], folder))
        if "beside_equations" in tables and len(tables["beside_equations"]):
            found.append(beside_table(tables["beside_equations"], folder))
        if "escape" in tables and len(tables["escape"]):
            time = "1" if self.results.overview is None else SaidLandscape(self.results.overview).time_unit
            found.append(escape_table(tables["escape"], time, folder))
        troubled = self._troubled()
        if len(troubled):
            caption = "What went wrong, or was not certified."
            found.append(ReportTable(caption, troubled, {}, f"{folder}/outcomes.csv", rows_shown=60))
        text = [] if self.study.runs > 1 else self._runs_said()
        text += control_sentences(tables["certificates"])
        text += beside_sentences(tables.get("beside_equations"))
        text += [
            line
            for line in landscape_sentences(tables["landscape"], tables["outcomes"])
            if shown.run is not None
        ]
        figures = self._figures(Part.EVIDENCE)
        if not (text or found or figures):
            return None
        return ReportSection(
            "How far it can be trusted", text, tables=found, figures=figures, notes=self._remarks()
        )

    def record(self) -> ReportSection | None:
        """The record's own hops and histogram, beside what was identified."""
        shown, certificate = self.results.shown, self._certificate()
        table = self.results.tables.get("record", as_table("record", []))
        mine = table[table["run"] == shown.run]
        missing = "" if certificate is None else str(certificate.get("no_record_test") or "")
        text, figures = record_sentences(mine, missing), self._figures(Part.RECORD)
        if not text and not figures:
            return None
        overview = self.results.overview
        time = "1" if overview is None else SaidLandscape(overview).time_unit
        found = record_table(mine, time, self.results.folder)
        return ReportSection(
            "Against the record itself", text, tables=[] if found is None else [found], figures=figures
        )

    def _remarks(self) -> list[str]:
        """What steps that went well have to say, each once; where D is from stands beside D."""
        outcomes = self.results.tables["outcomes"]
        known = {source.note for source in DiffusionSource}
        texts = outcomes[outcomes["status"] == Status.OK]["reason"].dropna()
        return [
            f"{text[0].upper()}{text[1:]}." for text in dict.fromkeys(texts) if text and text not in known
        ]

    def _runs_said(self) -> list[str]:
        tables = self.results.tables
        return run_sentences(
            tables["rrmse"], tables["outcomes"], tables["summary"], runs=self.study.runs, method=self._method
        )

    def _troubled(self) -> pd.DataFrame:
        """Steps that failed, and refined formulas that are not certified; the run where there are several."""
        outcomes, rrmse = self.results.tables["outcomes"], self.results.tables["rrmse"]
        troubled = outcomes[outcomes["status"].isin([Status.FAILED, Status.WARNING])]
        # Which tests refused a formula is said once.
        troubled = troubled[~troubled["reason"].fillna("").str.startswith("not certified")]
        rows = pd.concat([troubled, _refusals(rrmse, self.results.tables["certificates"])])
        rows = rows[["run", "step", "status", "reason"]].sort_values(["run", "step"])
        return rows.drop(columns="run") if self.study.runs == 1 else rows

    def landscape(self) -> ReportSection | None:
        """Every way out, every equilibrium, the density."""
        tables, folder = self.results.tables, self.results.folder
        options = self.study.landscape
        found = landscape_tables(
            self.results.overview,
            tables["landscape"],
            noises=() if options is None else options.noise_intensities,
            folder=folder,
        )
        found += invariant_tables(tables["invariant"], tables["well_shares"], folder)
        figures = self._figures(Part.LANDSCAPE)
        if not found and not figures:
            return None
        text = []
        overview = self.results.overview
        if overview is not None and self.study.runs > 1:
            text = [f"The landscape is that of run {overview['run']}."]
        return ReportSection("The landscape in full", text, tables=found, figures=figures)

    def over_runs(self) -> ReportSection | None:
        """What varies from run to run; of one run nothing does."""
        if self.study.runs == 1:
            return None
        tables, folder = self.results.tables, self.results.folder
        found = method_tables(
            tables, folder, (str(self._method), str(Method.CONTROL)), beside_paper=self.beside_paper
        )
        return ReportSection(
            f"What {self.study.runs} runs say together", self._runs_said(),
            tables=found, figures=self._figures(Part.RUNS),
        )  # fmt: skip

    def published(self) -> ReportSection | None:
        """What the published method made of the networks, and what was published."""
        other = self.study.training is not None and self._method != Method.REGRESSION
        rows = self._formulas_of(Method.REGRESSION) if other else []
        figures = self._figures(Part.PUBLISHED)
        if not rows and not figures:
            return None
        text = []
        training, regression = self.study.training, self.study.regression
        if training is not None:
            text.append(
                f"The published method trains two networks, here for at most {training.steps} steps on"
                f" batches of"
                f" {training.batch_size}, and regresses formulas of degree {regression.degree} at most on"
                f" them. Terms"
                f" below {regression.threshold} are dropped (of the {regression.threshold_on})."
            )
        if rows:
            text.append(self._regression_verdict())
        tables = []
        if self.study.runs > 1 and other:
            tables = method_tables(
                self.results.tables, self.results.folder, (str(Method.REGRESSION),),
                beside_paper=self.beside_paper,
            )  # fmt: skip
        return ReportSection(
            "The published method", text, rows, tables, figures, folded=not self.beside_paper
        )

    def _regression_verdict(self) -> str:
        shown = self.results.shown
        assert shown.run is not None  # it has formulas
        one = self.results.models.certificates(shown.run)[str(Method.REGRESSION)]
        if one["certified"]:
            return "Its formulas are certified."
        return f"Its formulas are not certified: {one['reason']}."

    def workings(self) -> ReportSection:
        """The recordings, and what became of each step."""
        outcomes = self.results.tables["outcomes"]
        steps = outcomes.drop(columns="run") if self.study.runs == 1 else outcomes
        caption = "What became of each step" + (" of each run." if self.study.runs > 1 else ".")
        return ReportSection(
            "The recordings and the workings", [self._source(), self._method_said()],
            tables=[ReportTable(caption, steps, {}, f"{self.results.folder}/outcomes.csv", 12)],
            figures=self._figures(Part.WORKINGS), folded=True,
        )  # fmt: skip

    def _source(self) -> str:
        recordings = self.study.recordings
        if recordings is not None:
            return f"The recordings are those in {recordings.file}."
        return f"The recordings are simulated trajectories of the system {self.study.system}."

    def _method_said(self) -> str:
        routes = self.study.refinement.with_routes(networks=self.study.training is not None).routes or ()
        if self.results.record is None:
            return "No f was identified, so that there is no formula."
        return (
            f"f was identified {self._identified_by()}. The formulas solve the Hamilton–Jacobi"
            " equation of this"
            f" f, by the {' and the '.join(routes)} route, and have to pass the tests of the certificate."
        )

    def _identified_by(self) -> str:
        record = self.results.record
        if record is not None and record.memory is not None:
            return f"from pairs of samples, as seen from {record.memory[0]} steps earlier"
        if record is not None and record.sensor_variance is not None:
            return "by the likelihood of whole recordings, with the noise of the sensor beside it"
        return "from neighbouring samples alone"

    def provenance(self, versions: Mapping[str, str]) -> ReportSection:
        """The study as it was asked, with what, and how long."""
        timings = self.results.tables["timings"]
        total = timings.groupby("step")["seconds"].sum()
        spent = ", ".join(f"{step} {seconds:.0f} s" for step, seconds in total.items())
        named = ", ".join(f"{name} {version}" for name, version in versions.items())
        machine = f"Python {platform.python_version()} on {platform.system()} {platform.machine()}"
        text = [f"{named}; {machine}, {os.cpu_count()} cores.", f"Processor time by step: {spent}."]
        printed = yaml.safe_dump(_printed(self.study), sort_keys=False, allow_unicode=True)
        return ReportSection("The study and the versions", text, listing=printed, folded=True)


ROUNDING = 1e-12  # of the largest coefficient of U: a constant so small is left of zero
SHOWN = "U$|f_"
"""Components whose coefficients are shown; those of g follow from them, and can be downloaded."""

DECOMPOSITION = (
    "f is split as f = −D∇V + g with ∇V·g = 0, and U = 2V. For the noise √ε σ dW with D = σσᵀ the density"
    " of states is"
    " exp(−U/ε) to leading order."
)


def _printed(study: Study) -> dict[str, Any]:
    """The study as plain data; of recordings nothing is simulated."""
    data = study.model_dump(mode="json", by_alias=True)
    return data if study.recordings is None else data | {"simulation": None}


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
