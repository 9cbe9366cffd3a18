"""The page of a study: the answer, formulas, evidence, the landscape, runs, a sweep, the workings.

One template, `templates/study.j2`, tells studies of recordings, of simulated cards and of given equations;
here stand the tables and numbers that it is filled with.
"""

from __future__ import annotations

import ast
import os
import platform
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import sympy
import yaml
from markupsafe import Markup

from siq.data.states import RecordStates
from siq.inference.field_estimate import DiffusionSource, FieldEstimate
from siq.numerics.text import range_text, unit_text, value_text
from siq.quasipotential.certificate import Certificate
from siq.quasipotential.formulas import SymbolicDecomposition, read_model
from siq.quasipotential.landscape import sentences_without_landscape
from siq.quasipotential.wells import Well
from siq.report.formatting import (
    array_mathml,
    formula_mathml,
    paragraphs,
    predicted_text,
    term_text,
    texts,
    time_text,
    with_unit,
)
from siq.report.landscape import answer_lines, comparison_table, in_words, landscape_tables, record_table
from siq.report.page import FormulaRow, ReportContent, ReportFigure, compose
from siq.report.summary import LandscapeSummary, well_name
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics
from siq.workflow.study import Study, SweepOptions
from siq.workflow.tables import Method, ModelFiles, Outcome, Shown, Status, Step, why_no_landscape

NEGLIGIBLE_TERM = 1e-3  # of the depth: a term that adds less everywhere is left to the whole formula
ROUNDED_CONSTANT = 1e-9  # of the depth: a constant of U far below it is what rounding left of zero
ROUNDED_COEFFICIENT = 1e-12  # of the largest coefficient of U, likewise
SHORT_FORMULA = 8  # terms that are read at a glance: so short a formula is shown as it is
PRINTED_OF_EQUATIONS = (
    "name", "title", "system", "from", "seed", "refinement", "certificate", "landscape", "invariant", "sweep",
)  # fmt: skip
SUMMARY_COLUMNS = (
    "method", "quantity", "exact", "mean", "standard_deviation", "median", "inclusion_frequency", "published",
    "published_standard_deviation", "runs",
)  # fmt: skip


@dataclass(frozen=True)
class StudyResults:
    """What a study left behind."""

    #: By name, see `siq.workflow.tables.COLUMNS`; `landscape_errors` and `escape` with a card only,
    #: `beside_equations`, `invariant` and those of a sweep where the study asks for it.
    tables: Mapping[str, pd.DataFrame]
    folder: Path  #: where the whole tables are
    images: Mapping[str, bytes]  #: the figures that there are by name, as PNG
    vectors: Mapping[str, bytes]  #: the same as SVG
    landscape: LandscapeSummary | None = None  #: that the page opens with; None where there is none
    models: ModelFiles = field(default_factory=lambda: ModelFiles(()))  #: the formulas of all runs
    shown: Shown = (0, Method.REFINED)  #: the run and the method whose formulas are printed
    exact: SymbolicDecomposition | None = None  #: the exact formulas, where they are known
    record: FieldEstimate | None = None  #: f and D of the run that is shown, None where there is none
    interactive: Markup | None = None  #: views that a reader can change, None without any
    inspection: Sequence[str] | None = None  #: of the recordings, line by line; None where simulated
    seen: RecordStates | None = None  #: the two states that they show by themselves
    system: Dynamics | None = None  #: f and D that were given as equations; None of recordings
    certificate: Mapping[str, Any] | None = None  #: of the formulas of these

    @property
    def rung(self) -> int:
        """Of the ladder of answers, see `siq.quasipotential.certificate.Certificate.rung`."""
        found = self.certificates.get(str(self.shown[1]))
        certificate = Certificate.from_data(found) if found and found.get("tests") else None
        hidden = self.record is not None and self.record.has_hidden_state
        return Certificate.rung(certificate, self.seen, hidden=hidden)

    def table(self, name: str) -> pd.DataFrame | None:
        """A table that has rows, None otherwise."""
        found = self.tables.get(name)
        return None if found is None or found.empty else found

    @property
    def time_unit(self) -> str:
        """Of the landscape, ``1`` where it is not known."""
        return "1" if self.landscape is None else self.landscape.time_unit

    @property
    def certificates(self) -> Mapping[str, Any]:
        """Of the run that is shown, by method."""
        if self.system is not None:
            formulas = self.landscape is not None and any(w is not None for w in self.landscape.formulas)
            return {str(Method.REFINED): self.certificate} if formulas else {}
        run = self.shown[0]
        return {} if run is None else read_model(self.models.paths[run])[1]


def study_page(
    study: Study, results: StudyResults, *, command: str, versions: Mapping[str, str], origin: str = ""
) -> ReportContent:
    """All that the page of a study says.

    `command` makes the page again; `versions` are those of the programs that took part, by name; `origin`
    says what the results came from.
    """
    (run, method), summary, given = results.shown, results.landscape, results.system
    several, beside_paper = study.runs > 1, study.published is not None
    certificate = results.certificates.get(str(method))
    noises = () if study.landscape is None else study.landscape.noise_intensities
    headings, table = texts("help")["headings"], results.table
    record, compared, landscape = table("record"), table("beside_equations"), table("landscape")
    record = None if record is None else record[record["run"] == run]
    record = None if record is None or record.empty else record
    other = study.training is not None and method != Method.REGRESSION
    certificates, rrmse, timings = results.tables["certificates"], table("rrmse"), table("timings")
    refused = certificates[(certificates["method"] == method) & ~certificates["passed"].astype(bool)]
    refused = refused[refused["run"] == run]
    figures, lead = _figures(study, results)
    density = given is not None and table("invariant") is None and "invariant" in results.tables
    escape, errors = table("escape"), table("landscape_errors")
    invariant, shares = table("invariant"), None if density else table("well_shares")
    swept: Iterable[int] = () if table("sweep") is None else results.tables["sweep"]["well"]
    named = ", ".join(f"{name} {version}" for name, version in versions.items())
    machine = f"Python {platform.python_version()} on {platform.system()} {platform.machine()}"
    printed = study.model_dump(mode="json", by_alias=True)
    if given is not None:  # nothing is simulated of recordings, and of equations fewer keys have a use
        printed = {key: printed[key] for key in PRINTED_OF_EQUATIONS}
    elif study.recordings is not None:
        printed |= {"simulation": None}

    return compose(
        "study.j2", title=study.title or (given.title if given is not None else "") or study.name,
        interactive=results.interactive, study=study, results=results, s=summary, given=given is not None,
        run=run, method=str(method), beside_paper=beside_paper, command=command, origin=origin,
        help=texts("help"), words=texts("certificate"), answer=_answer(results),
        certificate=certificate if summary is None else summary.stating(certificate),
        lead=lead, figures=figures, record=record,
        certified=0 if rrmse is None else int(rrmse[rrmse["method"] == method]["certified"].sum()),
        refusals=list(dict(zip(refused["test"], refused["reason"], strict=True)).values()),
        landscape=landscape_tables(summary, noises),
        states=_states_table(results.seen, summary) if results.seen and results.seen.supported else None,
        formulas=_formulas(results), coefficients=_coefficients(results),
        no_record_test=str((certificate or {}).get("no_record_test") or ""),
        record_table=None if record is None else record_table(record, results.time_unit),
        run_lines=paragraphs("runs.j2", r=_run_figures(results.tables, runs=study.runs, method=str(method))),
        control=_control_counts(certificates), without_landscape=_without_landscape(results.tables),
        compared=compared, comparison=None if compared is None else comparison_table(compared),
        compared_notes=[]
        if compared is None
        else [  # what could not be compared with the equations, and the numbers that it is of
            (str(note), [item for item in dict.fromkeys(some["item"].fillna("")) if item])
            for note, some in compared[compared["note"].fillna("") != ""].groupby("note", sort=False)
        ],
        tests=None if run is None else _tests_table(certificates, run, method),
        landscape_errors=None if errors is None else errors_over_runs(errors),
        escape=None if escape is None else escape.rename(columns=lambda name: name.replace("_", " ")),
        time_unit=results.time_unit, troubled=_troubled(study, results), remarks=_remarks(results),
        barriers_over_runs=None
        if landscape is None or landscape["run"].nunique() == 1
        else _counted_over_runs(
            landscape[landscape["kind"] == "transition"], "item", runs=("barrier", "size"),
            mean=("barrier", "mean"), lowest=("barrier", "min"), highest=("barrier", "max"),
            by_the_path_alone=("minimum_action", "mean"), prefactor=("prefactor", "mean"),
        ),
        invariant_missing=density,
        invariant=None if invariant is None else in_words(invariant.rename(columns=headings)),
        well_shares=None
        if shares is None or invariant is None
        else in_words(shares.rename(columns=headings)), sweep=study.sweep, tables=results.tables,
        folder=results.folder,
        bifurcations=None if given is None else _bifurcations(given, study.sweep, table("bifurcations")),
        swept_wells=[well_name(int(well)) for well in sorted(set(swept)) if well >= 0],
        of_runs=_method_tables(results.tables, (str(method), str(Method.CONTROL))) if several else None,
        published_formulas=_formulas_by(results, Method.REGRESSION) if other else [],
        published_certificate=results.certificates.get(str(Method.REGRESSION)),
        published_runs=_method_tables(results.tables, (str(Method.REGRESSION),))
        if several and other
        else None, networks="network"
        in (study.refinement.with_routes(networks=study.training is not None).routes or ()),
        steps=results.tables["outcomes"].drop(columns=[] if several else "run"),
        machine=f"{named}; {machine}, {os.cpu_count()} cores",
        printed=str(yaml.safe_dump(printed, sort_keys=False, allow_unicode=True)),
        spent={} if timings is None else timings.groupby("step")["seconds"].sum().to_dict(),
    )  # fmt: skip


LEADING = ("quasipotential", "landscape", "states")
"""Figures that a page can open with, the best first."""


def _figures(
    study: Study, results: StudyResults
) -> tuple[Mapping[str, list[ReportFigure]], ReportFigure | None]:
    """The figures by the parts of the page, in the order of their captions, and the one that it opens with.

    Figures without a caption stand last, with the workings.
    """
    captions, images, given = texts("captions"), results.images, results.system is not None
    known = {"runs": study.runs > 1, "networks": study.training is not None}
    known["paper"] = study.published is not None
    told = captions["figures"] | {
        name: {"part": "inspection", "text": text} for name, text in captions["inspection"].items()
    }
    told |= {
        name: {"part": "workings", "text": f"{name.replace('_', ' ').capitalize()}."}
        for name in sorted(set(images) - set(told))
    }
    lead = next((name for name in LEADING if name in images), None)
    own = lead == "states"  # a picture of the record, and of no U
    parts: dict[str, list[ReportFigure]] = defaultdict(list)
    for name, caption in told.items():
        if (
            name in images
            and name not in LEADING[:2]
            and name != lead
            and all(known[one] for one in caption.get("only_with", ()))
        ):
            paper = f" In the paper: {caption['paper']}." if known["paper"] and "paper" in caption else ""
            figure = ReportFigure(
                caption["text"] + paper, caption["text"], images[name], "png", results.vectors.get(name)
            )
            parts[caption["part"]].append(figure)
    if lead is None:
        return parts, None
    one = results.landscape is not None and len(results.landscape.names) == 1
    kind = ("one_equation" if one else "equations") if given else "one_state" if one else ""
    text = captions["lead"][kind] if kind and not own else told[lead]["text"]
    return parts, ReportFigure(text, text, images[lead], "png", results.vectors.get(lead))


def _answer(results: StudyResults) -> list[str]:
    """The sentence, and what has to be known of it."""
    summary, outcomes = results.landscape, results.tables["outcomes"].fillna({"reason": ""})
    if results.system is not None and summary is None:
        reason = next((str(reason) for reason in outcomes["reason"] if reason), "there is no stable state")
        return sentences_without_landscape(reason, None)
    if results.system is None and (summary is None or not summary.wells):
        reason = why_no_landscape(
            Outcome(int(row["run"]), Step(row["step"]), Status(row["status"]), str(row["reason"]))
            for row in outcomes.to_dict("records")
        )
        return sentences_without_landscape(reason, results.seen)
    assert summary is not None
    return answer_lines(summary, seen=results.seen, rung=results.rung)


def answer_data(page: ReportContent, study: Study, results: StudyResults) -> dict[str, Any]:
    """The content of ``answer.json``, for a terminal or another program.

    ``title`` and ``sentence`` are as on the page. ``certified`` is whether the formulas of all runs, of some
    or of none passed their certificates; ``formulas``, how many runs ended with a refined formula (of
    equations: with a landscape), of how many ``runs``; in how many a step ``failed``.
    """
    outcomes = results.tables["outcomes"]
    if results.system is not None:
        certified = int(results.certificate is not None and bool(results.certificate["certified"]))
        formulas = int(results.landscape is not None and bool(results.landscape.wells))
        failed = int((outcomes["status"] == Status.FAILED).sum())
    else:
        rrmse = results.tables["rrmse"]
        certified = int(rrmse[rrmse["method"] == Method.REFINED]["certified"].sum())
        formulas = len(results.models.with_formula(Method.REFINED, "V", "wells"))
        failed = int(outcomes[outcomes["status"] == Status.FAILED]["run"].nunique())
    how = "none" if certified == 0 else "all" if certified >= study.runs else "some"
    return {
        "title": page.title, "sentence": page.answer[0], "certified": how, "formulas": formulas,
        "runs": study.runs, "failed": failed,
        "rung": results.rung,
        "states": len(results.seen.counts) if results.seen is not None and results.seen.supported else 0,
    }  # fmt: skip


def _states_table(seen: RecordStates, summary: LandscapeSummary | None = None) -> pd.DataFrame:
    """The states that a record shows by itself, a column for each, as the rungs answer them.

    Wells of one quantity are those of f and D, where they are as many as the states.
    """
    found, time_unit, digits = seen.dwell_times(), seen.time_unit or "1", seen.remark().values["digits"]
    law = {True: "exponential", False: "not exponential"}
    tops = [] if seen.profile is None or len(seen.columns) > 1 else seen.profile.tops.tolist()
    cells: dict[str, list[str]] = defaultdict(list)
    for number, row in enumerate(found.to_dict("records")):
        place = (value_text(x, digits=digits[k]) for k, x in enumerate(seen.places[number]))
        cells["place"].append(", ".join(place))
        cells["share of the time"].append(f"{100 * row['share']:.0f} %")
        cells["visits seen to end"].append(str(row["visits"]))
        stay = f"more than {value_text(row['lowest'], digits=2)}"
        if row["visits"]:
            stay = f"{value_text(row['mean_time'], digits=3)} ({range_text(row['lowest'], row['highest'])})"
        cells[with_unit("mean stay, counted", time_unit)].append(stay)
        cells["stays are"].append(law.get(row["exponential"], "too few to tell"))
        if tops:
            ways = [tops[number - 1][2:]] if number else []
            ways += [tops[number][:2]] if number < len(tops) else []
            cells["tops beside it, −log p"].append(" and ".join(value_text(*one) for one in ways))
        if seen.markov is not None:
            limits = range_text(row["markov_lowest"], row["markov_highest"])
            model = f"{value_text(row['markov_time'], digits=3)} ({limits})"
            cells[with_unit("mean stay, Markov model", time_unit)].append(model)
            apart = row["markov_lowest"] > row["highest"] or row["markov_highest"] < row["lowest"]
            cells["counted and model agree"].append("no" if apart else "within their intervals")
    same = summary is not None and len(summary.wells) == len(found) and len(summary.names) == 1
    if summary is not None and same:
        for well in sorted(summary.wells, key=lambda one: float(one.position[0])):
            ratio, error = well.relative_depth(summary.noise)
            cells["place, f and D"].append(value_text(well.position[0], well.position_errors[0]))
            cells["depth ΔU/ε, f and D"].append(value_text(ratio, error) if np.isfinite(ratio) else "")
            visits = "" if well.visits is None else predicted_text(well.visits)
            cells[with_unit("mean visit, f and D", time_unit)].append(
                visits or time_text(well.time(summary.noise))
            )
    names = [f"state {number + 1}" for number in range(len(found))]
    return pd.DataFrame([(name, *one) for name, one in cells.items()], columns=["", *names])


def _formulas(results: StudyResults) -> list[FormulaRow]:
    """Formulas and D of the run that is shown; f and D alone where no formula was found."""
    words = texts("formulas")
    if (system := results.system) is not None:
        formulas = () if results.landscape is None else results.landscape.formulas
        wells = tuple(well for well in formulas if well is not None)
        found = SymbolicDecomposition(system.symbols, None, (), system.formulas, wells)
        rows = _formula_rows(found, None, results.landscape)
        rows[-1] = replace(rows[-1], note=words["given"])
        return [*rows, FormulaRow("D", _diffusion_mathml(system.diffusion), words["D"]["given"])]
    rows, record = _formulas_by(results, results.shown[1]), results.record
    if record is None:
        return rows
    if not rows:
        rows.append(FormulaRow("f", array_mathml(record.dynamics.formulas), words["f"]))
    noise, note = record.diffusion, words["D"][record.diffusion_source]
    note = note if noise.constant else f"{note} {words['by_state']}"
    return [*rows, FormulaRow("D", _diffusion_mathml(noise), note)]


def _diffusion_mathml(noise: Diffusion) -> Markup:
    """D, typeset."""
    return array_mathml(noise.matrix.tolist() if noise.constant else noise.formulas)


def _formulas_by(results: StudyResults, method: Method) -> list[FormulaRow]:
    """The formulas of the run that is shown, as a method found them; none where it found none."""
    run = results.shown[0]
    found = {} if run is None else results.models.formulas(run)
    return _formula_rows(found[method], results.exact, results.landscape) if method in found else []


def _formula_rows(
    found: SymbolicDecomposition, exact: SymbolicDecomposition | None, summary: LandscapeSummary | None
) -> list[FormulaRow]:
    """U, g and f of one method, beside the exact ones; U about each well where no single formula holds.

    A constant of U far below the depth of the deepest well is what rounding left of zero.
    """
    places = [] if summary is None else [well.position for well in summary.wells]
    barriers = [] if summary is None else [way.barrier for way in summary.ways if np.isfinite(way.barrier)]

    def typeset(one: SymbolicDecomposition, depth: float = 0.0) -> dict[str, Markup]:
        formulas = {}
        if one.potential is not None:
            whole = one.quasipotential
            constant, rest = whole.as_coeff_Add()
            rounded = rest != 0 and abs(float(constant)) < ROUNDED_CONSTANT * depth
            formulas = {
                "U": formula_mathml(rest if rounded else whole), "g": array_mathml(one.circulatory),
            }  # fmt: skip
        return formulas | {"f": array_mathml(one.vector_field)}

    truths, notes = {} if exact is None else typeset(exact), texts("formulas")
    rows = [
        FormulaRow(name, formula, notes[name], truths.get(name))
        for name, formula in typeset(found, max(barriers, default=0.0)).items()
    ]
    return [*(_well_row(well, places) for well in found.wells if found.potential is None), *rows]


def _well_row(well: Well, places: Sequence[np.ndarray]) -> FormulaRow:
    """U about one attractor in offsets from it: the terms that count, and the whole formula."""
    basis, coefficients = well.basis, well.coefficients[: len(well.basis.exponents)]  # units would fill pages
    label = "(" + ", ".join(value_text(value) for value in well.attractor) + ")"
    if len(places):
        away = [np.abs((np.asarray(place) - well.attractor) / basis.scale).max() for place in places]
        label = well_name(int(np.argmin(away)))
    size = np.abs(coefficients)
    if len(well.points):
        size = size * np.abs(basis.values(well.points)).max(axis=0)[: len(size)]
    kept = size > NEGLIGIBLE_TERM * well.level
    if kept.sum() == 0 or len(kept) <= SHORT_FORMULA:
        kept = coefficients != 0
    left_out = int(((coefficients != 0) & ~kept).sum())
    center = np.where(np.abs(basis.center) < 1e-12 * np.maximum(basis.scale, 1e-300), 0.0, basis.center)
    (note,) = paragraphs(
        "well_formula.j2", level=well.level, label=label, left_out=left_out, units=basis.size - len(size),
        offsets=[(symbol.name, value) for symbol, value in zip(basis.symbols, center, strict=True)],
    )  # fmt: skip
    offsets = [sympy.Symbol(f"Δ{symbol}", real=True) for symbol in basis.symbols]

    def typeset(chosen: np.ndarray) -> Markup:
        terms = []
        for exponents, coefficient in zip(basis.exponents[chosen], coefficients[chosen], strict=True):
            value = 2 * float(coefficient) / float(np.prod(basis.scale**exponents))
            powers = [offset ** int(n) for offset, n in zip(offsets, exponents, strict=True) if n]
            terms += [sympy.Mul(sympy.Float(value), *powers)] if value else []
        return formula_mathml(sympy.Add(*terms))

    whole = typeset(np.ones(len(kept), dtype=bool)) if left_out else None
    return FormulaRow(f"U about {label}", typeset(kept), note, whole=whole)


def _coefficients(results: StudyResults) -> tuple[pd.DataFrame, pd.DataFrame] | None:
    """Coefficients of U and f with their errors, and as numbers those of g; None where there are none.

    Those of g follow from the others, and stand in the download alone.
    """
    coefficients, (run, method) = results.table("coefficients"), results.shown
    if coefficients is None:
        return None
    mine = coefficients[(coefficients["run"] == run) & (coefficients["method"] == str(method))]
    of_potential = mine["component"] == "U"
    largest = mine[of_potential]["estimate"].abs().max()
    rounded = of_potential & (mine["term"] == "1") & (mine["estimate"].abs() < ROUNDED_COEFFICIENT * largest)
    mine = mine[~rounded & (mine["estimate"] != 0)]
    chosen = mine[mine["component"].str.match("U$|f_")]
    if chosen.empty:
        return None
    summary = results.landscape
    units = {} if summary is None else dict(zip(summary.names, summary.units, strict=True))
    time = "" if summary is None else unit_text(summary.time_unit)

    def component(name: str) -> str:
        kind, _, state = name.partition("_")
        if kind != "f":
            return f"{kind}, {state}" if state else kind
        unit = unit_text(units.get(state, ""))
        return with_unit(f"d{state}/dt", f"{unit or '1'}/{time}" if time else unit)

    table = pd.DataFrame(
        {
            "in": [component(str(name)) for name in chosen["component"]],
            "term": [term_text(str(name)) for name in chosen["term"]],
            "coefficient": list(map(value_text, chosen["estimate"], chosen["standard_error"])),
            "exact": chosen["exact"].to_numpy(),
        }
    )
    return table, mine[mine["component"].str.match("U$|g_|f_")].drop(columns=["run", "method"])


def _remarks(results: StudyResults) -> list[str]:
    """What has to be known of steps that went well, each once; where D is from stands beside D."""
    if results.system is not None:
        return [] if results.landscape is None else list(results.landscape.remarks)
    outcomes = results.tables["outcomes"]
    known = {source.note for source in DiffusionSource}
    reasons = outcomes[outcomes["status"] == Status.OK]["reason"].dropna()
    return [text for text in dict.fromkeys(reasons) if text and text not in known]


def _troubled(study: Study, results: StudyResults) -> pd.DataFrame | None:
    """Steps that failed, and refined formulas that are not certified; the run where there are several."""
    if results.system is not None:
        return None
    outcomes, rrmse = results.tables["outcomes"], results.tables["rrmse"]
    certificates = results.tables["certificates"]
    troubled = outcomes[outcomes["status"].isin([Status.FAILED, Status.WARNING])]
    # A warning of `refine` is a formula that is not certified: which tests refused it is said once, below.
    troubled = troubled[~((troubled["step"] == Step.REFINE) & (troubled["status"] == Status.WARNING))]
    refused = certificates[(certificates["method"] == Method.REFINED) & ~certificates["passed"]]
    reasons = refused.groupby("run")["reason"].agg(lambda texts: "; ".join(dict.fromkeys(texts)))
    runs = rrmse[(rrmse["method"] == Method.REFINED) & ~rrmse["certified"]]["run"]
    without = pd.DataFrame(
        {
            "run": runs, "step": "certify", "status": "not certified",
            "reason": runs.map(reasons).fillna(texts("tables")["no_formula"]),
        }
    )  # fmt: skip
    rows = pd.concat([troubled, without])[["run", "step", "status", "reason"]].sort_values(["run", "step"])
    return rows.drop(columns="run") if study.runs == 1 else rows


def _without_landscape(tables: Mapping[str, pd.DataFrame]) -> tuple[str, int, int] | None:
    """Why runs have no landscape whose f was followed, in how many, of how many; None where all have one."""
    landscape, outcomes = tables["landscape"], tables["outcomes"]
    asked = outcomes[
        (outcomes["step"] == Step.LANDSCAPE) & outcomes["status"].isin([Status.WARNING, Status.FAILED])
    ]
    without = asked[~asked["run"].isin(landscape[landscape["kind"] == "attractor"]["run"])]
    if without.empty:
        return None
    return str(without["reason"].iloc[0]), len(without), int(outcomes["run"].nunique())


def _run_figures(tables: Mapping[str, pd.DataFrame], *, runs: int, method: str) -> dict[str, Any]:
    """What all runs of a study say together of a method, for `templates/runs.j2`.

    How many ``runs`` were asked for, ``failed``, are ``certified``, have exactly the right terms
    (``correct``); the errors that certificates state (``stated``), of the coefficients of U (``errors``)
    and of U of the ``networks``; ``terms`` of U in most runs with mean and standard deviation, and ``rare``
    ones; the ``published`` error of the coefficients, NaN where there is none; mean and median error of
    predictions (``prediction``), None where nothing was predicted.
    """
    nothing = pd.Series(dtype=float)
    outcomes, rrmse, summary = tables["outcomes"], tables.get("rrmse"), tables.get("summary")
    if rrmse is None or summary is None:
        return {
            "runs": runs, "failed": 0, "certified": 0, "correct": 0, "stated": nothing, "errors": nothing,
            "networks": nothing, "terms": (), "rare": (), "published": np.nan, "prediction": None,
        }  # fmt: skip
    mine = rrmse[rrmse["method"] == method]
    summary = summary[summary["method"] == method].set_index("quantity")
    terms = summary[summary.index.str.startswith("U:")]
    often = terms[(terms["inclusion_frequency"] >= 0.5) & (terms.index != "U:1")]
    rare = terms[(terms["inclusion_frequency"] > 0) & (terms["inclusion_frequency"] < 0.5)]
    predicted = summary[summary.index == "prediction_error"]
    published = summary[summary.index == "rrmse"]["published"]
    return {
        "runs": runs,
        "failed": int(outcomes[outcomes["status"] == Status.FAILED]["run"].nunique()),
        "certified": int(mine["certified"].sum()),
        "correct": int(mine["support_correct"].fillna(False).sum()),
        "stated": mine[mine["certified"].astype(bool)]["stated_error"].dropna(),
        "errors": mine["rrmse"].dropna(),
        "networks": mine["network_error"].dropna(),
        "terms": [
            (str(name).removeprefix("U:"), float(row["mean"]), float(row["standard_deviation"]))
            for name, row in often.iterrows()
        ],
        "rare": [str(name).removeprefix("U:") for name in rare.index],
        "published": float(published.iloc[0]) if len(published) else np.nan,
        "prediction": tuple(predicted.iloc[0][["mean", "median"]]) if len(predicted) else None,
    }


def _tests_table(certificates: pd.DataFrame, run: int, method: Method) -> pd.DataFrame:
    """The claims of a certificate: what was asked and found, the verdict, and what would refute it."""
    mine = certificates[(certificates["run"] == run) & (certificates["method"] == method)]
    words = texts("certificate")
    asks, refutes, verdicts = words["asks"], words["refutes"], words["verdicts"]
    columns = {
        "test": [str(name).replace("_", " ") for name in mine["test"]],
        "what it asks": [asks.get(str(name), "") for name in mine["test"]],
        "found": mine["value"].to_numpy(),
        "limit": mine["limit"].to_numpy(),
        "verdict": [
            verdicts["passed" if passed else "failed" if tested else "not_tested"]
            for passed, tested in zip(mine["passed"], mine["tested"], strict=True)
        ],
        "what would refute it": [refutes.get(str(name), "") for name in mine["test"]],
        "in words": mine["reason"].to_numpy(),
    }
    return pd.DataFrame(columns)


def _control_counts(certificates: pd.DataFrame) -> dict[str, int] | None:
    """Of how many ``runs`` networks with weights in random order were ``refused``; None without control."""
    mine = certificates[certificates["method"] == Method.CONTROL]
    passed = mine.groupby("run")["passed"].all()
    return {"runs": len(passed), "refused": int((~passed).sum())} if len(mine) else None


def _counted_over_runs(table: pd.DataFrame, by: str | list[str], **columns: tuple[str, str]) -> pd.DataFrame:
    """A table over all runs, a row for each group, with its columns as `pandas.DataFrame.agg` takes them."""
    counted = table.groupby(by, sort=False).agg(**columns).reset_index()
    return counted.rename(columns=lambda name: "way" if name == "item" else name.replace("_", " "))


def _method_tables(
    tables: Mapping[str, pd.DataFrame], methods: tuple[str, ...]
) -> tuple[pd.DataFrame, pd.DataFrame, pd.DataFrame, pd.DataFrame]:
    """Of some methods: figures over the runs, shown and as numbers, tests passed, and errors by run."""
    summary, certificates, rrmse = (
        tables[name][tables[name]["method"].isin(methods)] for name in ("summary", "certificates", "rrmse")
    )
    passed = _counted_over_runs(
        certificates, ["method", "test"], passed=("passed", "sum"), runs=("passed", "size"),
        median=("value", "median"), worst=("value", "max"),
    )  # fmt: skip
    passed["test"] = [str(name).replace("_", " ") for name in passed["test"]]
    shown = summary[~summary["quantity"].str.match("V:|f_")]
    if shown["method"].nunique() == 1:
        shown = shown.drop(columns="method")

    def quantity(name: str) -> str:
        component, colon, term = name.partition(":")
        return f"{component.replace('_', ', ')}: {term_text(term)}" if colon else name.replace("_", " ")

    columns = [name for name in SUMMARY_COLUMNS if name in shown and shown[name].notna().any()]
    shown = shown[columns].assign(quantity=[quantity(str(name)) for name in shown["quantity"]])
    words = {name: name.replace("_", " ") for name in (*shown.columns, *rrmse.columns)}
    return shown.rename(columns=words), summary, passed, rrmse.rename(columns=words)


def errors_over_runs(errors: pd.DataFrame) -> pd.DataFrame:
    """Relative L2 errors of U over the runs, by source and region."""
    return _counted_over_runs(
        errors, ["source", "region"], runs=("error", "size"), mean_error=("error", "mean"),
        worst_error=("error", "max"), least_covered=("covered", "min"),
        worst_everywhere=("error_everywhere", "max"),
    )  # fmt: skip


def _bifurcations(
    system: Dynamics, options: SweepOptions | None, found: pd.DataFrame | None
) -> pd.DataFrame | None:
    """Where equilibria or cycles meet and vanish, begin to oscillate, or cross."""
    if options is None or found is None:
        return None
    unit = next(each.unit for each in system.parameters if each.name == options.parameter)
    rows = []
    for one in found.itertuples():
        states = zip(system.states, ast.literal_eval(str(one.position)), strict=True)
        rows.append(
            {
                "what": one.kind,
                with_unit(options.parameter, unit): f"{one.value:.10g}",
                "state": ", ".join(f"{name} = {x:.5g}" for name, x in states),
                "frequency": f"{float(str(one.frequency)):.6g}" if one.frequency else "",
            }
        )
    return pd.DataFrame(rows)
