"""The sections of the page of a diagnosis."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd
import sympy
from markupsafe import Markup, escape

from siq.diagnosis.dictionary import Mechanism
from siq.diagnosis.mechanisms import PROCESS_NOISE
from siq.numerics.text import capital, listed, p_text, percent, unit_text, value_text
from siq.report.formatting import formula_mathml
from siq.report.page import Badge, FormulaRow, ReportFigure, ReportSection, ReportTable
from siq.report.plots.diagnosis import largest_difference
from siq.systems.dynamics import Dynamics, symbol
from siq.systems.formulas import FormulaError, parse_formula

DIGITS = 3
SIMULATIONS = {
    "before": "as given",
    "recalibrated": "its own parameters refitted",
    "augmented": "with what was found",
}


@dataclass(frozen=True)
class Findings:
    """What the page is made from.

    Attributes
    ----------
    verdict
        The content of ``verdict.json``.
    before, after
        The simulation of the card, and the one that the verdict ends with.
    dictionary
        The mechanisms that could be named.
    candidates
        Columns ``label shapes gain stage beside``.
    figures
        SVG files by the names of `CAPTIONS`, as far as there was something to
        draw.
    wells, escape, notes
        See `workflow.consequences.Consequences`.
    scores
        Columns ``simulation score output rms unit published``, of public benchmarks only.
    held_out
        Columns ``output measured before recalibrated augmented scored``, one row per sample.
    folder
        Where the whole tables are.
    """

    verdict: Mapping[str, Any]
    before: Dynamics
    after: Dynamics
    dictionary: Sequence[Mechanism]
    candidates: pd.DataFrame
    figures: Mapping[str, bytes]
    wells: pd.DataFrame = field(default_factory=pd.DataFrame)
    escape: pd.DataFrame = field(default_factory=pd.DataFrame)
    notes: Sequence[str] = ()
    scores: pd.DataFrame = field(default_factory=pd.DataFrame)
    held_out: pd.DataFrame = field(default_factory=pd.DataFrame)
    folder: str = "tables"

    @property
    def kind(self) -> str:
        """The verdict in two words, random forces being a kind of their own."""
        named = [each["name"] for each in self.verdict["mechanisms"]]
        return "random forces" if named == ["process noise"] else str(self.verdict["verdict"])

    @property
    def final(self) -> str:
        """Which of the three simulations the verdict ends with."""
        return final_simulation(self.verdict)

    def words(self, about: str) -> list[str]:
        """Sentences of the verdict; see `siq.diagnosis.statement.words_of`."""
        return list(self.verdict.get("words", {}).get(about, []))

    def figure(self, name: str, caption: str) -> list[ReportFigure]:
        """A figure as a list, which is empty where there was nothing to draw."""
        image = self.figures.get(name)
        return [] if image is None else [ReportFigure(caption, caption, image, "svg")]


def final_simulation(verdict: Mapping[str, Any]) -> str:
    """Which of the three simulations a verdict ends with, by the names of `SIMULATIONS`."""
    random_forces = [each["name"] for each in verdict["mechanisms"]] == [PROCESS_NOISE]
    if verdict["verdict"] == "no mismatch":
        return "before"
    if verdict.get("described") or (verdict["verdict"] == "missing physics" and not random_forces):
        return "augmented"
    return "recalibrated"


def mechanisms_said(findings: Findings) -> list[Mapping[str, Any]]:
    """What was named, or what describes a mismatch that has no name."""
    description = findings.verdict.get("description") or {}
    return [*findings.verdict["mechanisms"], *description.get("by", [])]


def described(findings: Findings) -> list[Mapping[str, Any]]:
    """The model of what has no name; see `siq.diagnosis.statement.StatedFunction`."""
    return list(findings.verdict.get("described") or [])


def typeset(text: str, model: Dynamics, further: Iterable[str] = ()) -> Markup | str:
    """A formula of the verdict, typeset; as text where it cannot be read as one.

    Parameters
    ----------
    text
        The formula.
    model
        Whose names it may use.
    further
        Names that the model does not have, such as parameters of what is only described.
    """
    names = {**model.names, **{name: symbol(name) for name in further}}
    try:
        formula = parse_formula(text, names, inputs=tuple(entry.name for entry in model.inputs))
    except FormulaError:
        return text
    return mathml(formula)


def mathml(formula: sympy.Expr) -> Markup | str:
    """A formula, typeset; as text where it has a function that is not known."""
    try:
        return formula_mathml(formula, decimals=DIGITS)
    except (AttributeError, NotImplementedError, TypeError, ValueError):
        return str(formula)


def rate_of(name: str) -> Markup:
    """The left side of an equation: dx/dt, typeset."""
    inner = formula_mathml(sympy.Symbol(name, real=True))
    inside = inner[inner.index(">") + 1 : inner.rindex("<")]
    spoken = escape(f"d{name}/dt")
    return Markup(
        '<math aria-label="{}"><mfrac><mrow><mi>d</mi>{}</mrow><mrow><mi>d</mi><mi>t</mi></mrow></mfrac>'
        "<mo>=</mo></math>"
    ).format(spoken, Markup(inside))


CERTAIN = math.log(1e6)  # beyond which odds are not told


def how_sure(findings: Findings) -> ReportSection:
    """Why what was found is believed, what else would do, and what could not be judged."""
    named = mechanisms_said(findings)
    rows = [
        {
            "mechanism": each["label"],
            "gain in χ²": round(evidence["delta_chi2"]),
            "ΔBIC": round(evidence["delta_bic"]),
            "odds of the name": odds_text(evidence.get("log_odds")),
            "p, independent errors": p_text(evidence["p_white"]),
            "p, errors of a recording together": p_text(evidence["p_cluster"]),
        }
        for each in named
        if (evidence := each["evidence"])["delta_chi2"] is not None
    ]
    text = [*findings.words("explained"), *findings.words("left"), *findings.words("alternatives")]
    text += _look_alikes(findings, named)
    if not named:
        text.append(NOTHING_FOUND[findings.kind])
    tables = []
    if rows:
        tables.append(
            ReportTable(
                "The evidence for each mechanism, with those above it in place.",
                pd.DataFrame(rows),
                {
                    "gain in χ²": "by how much twice the log-likelihood rises with it",
                    "ΔBIC": "change of the Bayesian information criterion; negative where the gain is worth"
                    " the further parameters",
                    "odds of the name": "how much likelier it is than a smooth function without a name",
                    "p, independent errors": "how often chance alone would gain as much, if all errors were"
                    " independent",
                    "p, errors of a recording together": "the same, if only errors of different recordings"
                    " (or distant parts of one) are independent",
                },
            )
        )
    whole = findings.verdict.get("explanations", [])
    if len(whole) > 1 and findings.verdict["verdict"] in ("missing physics", "unexplained"):
        tables.append(
            ReportTable(
                "Whole explanations of the recordings, the likeliest first.",
                pd.DataFrame(
                    [
                        {"explanation": each["what"], "log-evidence": round(each["log_evidence"], 1)}
                        for each in whole
                    ]
                ),
                {"log-evidence": "of its marginal likelihood, less that of the likeliest: 5 is 150 to 1"},
            )
        )
    notes = [
        f"{capital(each['label'])} could not be judged: {each['reason']}."
        for each in findings.verdict.get("not_fitted", [])
    ]
    return ReportSection("How sure it is", text, tables=tables, notes=notes)


def odds_text(log_odds: float | None) -> str:
    """Odds such as ``340 to 1``; empty where they are not known."""
    if log_odds is None:
        return ""
    if abs(log_odds) > CERTAIN:
        return "beyond 10⁶ to 1" if log_odds > 0 else "beyond 1 to 10⁶"
    odds = math.exp(abs(log_odds))
    return f"{_round(odds)} to 1" if log_odds >= 0 else f"1 to {_round(odds)}"


def _round(odds: float) -> str:
    digits = max(len(str(int(odds))) - 2, 0)
    return f"{round(odds, -digits):.0f}" if odds >= 10 else f"{odds:.1f}"


NOTHING_FOUND = {
    "no mismatch": "Every mechanism of the dictionary that could act in this system was tried, and none"
    " stood the tests against chance.",
    "parameter shift": "With the new parameters, no mechanism of the dictionary stood the tests against"
    " chance.",
    "missing physics": "",
    "random forces": "",
    "unexplained": "No mechanism of the dictionary stood the tests.",
}


def _look_alikes(findings: Findings, named: Sequence[Mapping[str, Any]]) -> list[str]:
    """What a mechanism is often confused with, where that was fitted and explains less."""
    known = {entry.name: entry for entry in findings.dictionary}
    lines = []
    for each in named:
        entry = known.get(each["name"])
        less = [other["name"] for other in each.get("rivals", []) if other["standing"] == "less"]
        alike = [name for name in (entry.look_alikes if entry else ()) if name in less]
        if alike:
            verb = "explains" if len(alike) == 1 else "explain"
            lines.append(
                f"{capital(each['name'])} is often confused with {listed(alike)}, which {verb} less here."
            )
    return lines


CAPTIONS = {
    "curves": "What is missing, as a function of one coordinate in each panel: before anything was added"
    " (blue) and after (orange, dashed). What the simulation's own parameters can do is taken off. Where a"
    " blue band stays clear of zero, something is missing. Bands are cut off at the edge of the panel, and"
    " left out where they would fill it.",
    "map": "What is missing, over the two states along which most of it can be seen, averaged over cells;"
    " one panel for each equation. Grey: no recordings.",
    "described": "What was added, as a function of one coordinate with a band of 95 % (dots: the values that"
    " were fitted, or where a formula was evaluated), or of two in colours (dotted: it may as well be zero).",
    "candidates": "How much each mechanism explains. Fitted: what was found, and what was fitted in its"
    " place. Grey bars are estimates for mechanisms that were not fitted.",
    "held_out": "Held-out recordings with all three simulations. For each recording above: the course in"
    " time; below: simulation minus recording. Of long recordings the last part is shown.",
    "escapes": "Mean escape times from well to well against the inverse noise intensity, by the law of Eyring"
    " and Kramers: without what was found (dashed) and with it (solid), one colour for each way out.",
}


SMOOTH = {
    "curve": "a smooth curve (a sum of Gaussian bumps)",
    "surface": "a smooth function of two coordinates (sums of Gaussian bumps)",
}


def formula_of_mechanisms(findings: Findings) -> ReportSection | None:
    """The mechanisms that were found, or come closest: their formulas, parameters and references."""
    named = mechanisms_said(findings)
    if not named:
        return None
    known = {entry.name: entry for entry in findings.dictionary}
    lines, rows, notes = [], [], []
    for each in named:
        entry = known.get(each["name"])
        lines += [
            FormulaRow(
                each["label"],
                typeset(formula, findings.after, each["parameters"]),
                _of_what(name, entry, findings),
            )
            for name, formula in each["terms"].items()
        ]
        rows += [
            {"of": each["label"], "parameter": name, "value": _value(value)}
            for name, value in each["parameters"].items()
        ]
        if entry is not None and entry.reference:
            notes.append(f"{capital(each['name'])}: {entry.reference}.")
    if findings.kind == "missing physics":
        lines += [
            FormulaRow(rate_of(name), mathml(formula))
            for name, formula in zip(findings.after.states, findings.after.equations, strict=True)
        ]
        notes.append("The simulation with what was found is a system card like any other: system.yaml.")
    heading = "What comes closest, as a formula" if findings.verdict["description"] else "The formula"
    if findings.kind == "random forces":
        heading = "The random forces"
    tables = [ReportTable("Parameters of what is missing.", pd.DataFrame(rows))] if rows else []
    return ReportSection(heading, (), lines, tables, notes=list(dict.fromkeys(notes)))


def model_without_a_name(findings: Findings) -> ReportSection | None:
    """The model of what has no name: its formulas, and its course with a band of 95 %."""
    parts = described(findings)
    if not parts:
        return None
    lines, tables = [], []
    known = {entry.name: entry for entry in findings.dictionary}
    for each in parts:
        lines += [
            FormulaRow(
                each["label"],
                SMOOTH.get(each["kind"]) or typeset(formula, findings.after, each["parameters"]),
                _of_what(name, known.get(each["name"]), findings),
                whole=formula if each["kind"] in SMOOTH else None,
            )
            for name, formula in each["terms"].items()
        ]
        curve = each.get("curve")
        if curve is not None:
            rows = [
                {curve["coordinate"]: value_text(at, digits=3), "value": value_text(value, error)}
                for at, value, error in zip(curve["at"], curve["value"], curve["standard_error"], strict=True)
            ]
            tables.append(ReportTable(f"{capital(each['label'])}, with standard errors.", pd.DataFrame(rows)))
        elif each["parameters"]:
            rows = [{"parameter": name, "value": _value(value)} for name, value in each["parameters"].items()]
            tables.append(ReportTable(f"Coefficients of {each['label']}.", pd.DataFrame(rows)))
    beside = findings.verdict["verdict"] == "missing physics"
    what = "What the named mechanisms leave" if beside else "What is missing"
    text = [
        f"{what} has no name that is certain enough. This model is part of the new card, since it makes the"
        " prediction better of recordings that it was not fitted to."
    ]
    notes = ["The simulation with it is a system card like any other: system.yaml."]
    figures = findings.figure("described", CAPTIONS["described"])
    return ReportSection("A model of what is missing", text, lines, tables, figures, notes)


def _of_what(name: str, entry: Mechanism | None, findings: Findings) -> str:
    """What a formula of a mechanism is; see `siq.diagnosis.mechanisms.MechanismCandidate.changes`."""
    measured = name in [output for output, _ in findings.before.outputs]
    if measured and entry is not None and any(form.outputs for form in entry.forms):
        return f"what is measured as {name}"
    if name not in findings.before.states:
        return f"the rate of change of {name}, which is new"
    replaced = entry is not None and any(form.replace for form in entry.forms)
    return f"in the equation of {name}" if replaced else f"added to the equation of {name}"


def _value(entry: Mapping[str, Any]) -> str:
    return value_text(entry["estimate"], entry.get("standard_error"), unit=entry.get("unit", "1"))


PANELS = (
    " Above: the course in time. Below: simulation minus recording; grey: two standard deviations of the"
    " sensor's noise. The recording had no part in the search. Each simulation is told how it begins, and"
    " runs freely from there."
)


PROMISES = {
    "no mismatch": (
        "What the simulation leaves of the recordings looks like the sensor's noise.",
        "This does not show that nothing is missing, only that it is too small to be seen here; how large it"
        " may be is listed below.",
    ),
    "parameter shift": (
        "With other parameters, what the simulation leaves of the recordings looks like the sensor's noise:"
        " nothing in its equations has to change.",
    ),
    "missing physics": (
        "No choice of the simulation's own parameters explains the recordings. What was found does, and stood"
        " three tests against chance.",
        "It is the best of the mechanisms that were compared. One that was not compared may look the same.",
    ),
    "random forces": (
        "The equations explain the recordings as soon as random forces act on the system, and what is left"
        " then looks like noise.",
        "These forces are as strong when the system rests as when it moves, as those of surroundings are.",
    ),
    "unexplained": (
        "The recordings show more than noise and wrong parameters, but nothing here is certain enough to be"
        " named as its cause.",
        "Below you find where the difference sits, and what describes it or comes closest.",
    ),
}


def badge(findings: Findings) -> Badge:
    """The verdict in two words, and what these mean."""
    kind = findings.kind
    return Badge(kind, kind == "no mismatch", PROMISES[kind])


def answer(findings: Findings) -> list[str]:
    """The sentence, what the mechanism is, and what has to be known with it."""
    lines = [str(findings.verdict["sentence"])]
    known = {entry.name: entry for entry in findings.dictionary}
    for each in findings.verdict["mechanisms"]:
        entry = known.get(each["name"])
        if entry is not None and findings.kind != "random forces":
            lines.append(f"{capital(each['name'])}: {entry.sentence[:1].lower()}{entry.sentence[1:]}")
    return [*lines, *findings.verdict["remarks"]]


def picture(findings: Findings) -> ReportFigure | None:
    """The held-out recording in which the difference is largest, before and after, and a sentence on it."""
    found = findings.figure("before_after", difference_said(findings) + PANELS)
    return found[0] if found else None


def difference_said(findings: Findings) -> str:
    """How far each simulation is off in the held-out recording in which the difference is largest."""
    largest = None
    if not findings.held_out.empty:
        largest = largest_difference(findings.held_out, after=findings.final)
    if largest is None:
        return "A recording that was held out."
    unit = units_of_outputs(findings).get(largest.output, "1")

    def off(error: float) -> str:
        return f"is off by {value_text(error, unit=unit, digits=2)}" if np.isfinite(error) else "runs away"

    where = f"In the held-out recording {largest.recording}"
    if largest.recordings > 1:
        where += f", of {largest.recordings} the one in which the difference is largest"
    said = f"{where}, {largest.output} as simulated {off(largest.before)} as given"
    if findings.final == "before":
        return f"{said} (root mean square)."
    return f"{said}, and {off(largest.after)} {SIMULATIONS[findings.final]} (root mean square)."


def numbers(findings: Findings) -> ReportTable | None:
    """The error on held-out recordings: in their own units, in per cent of their spread, and beside noise."""
    fit = findings.verdict["fit"]
    floor = fit["noise_floor"]
    if floor is None:
        return None
    own = errors_in_units(findings)
    shown = ["before", "recalibrated", "augmented"]
    if not (mechanisms_said(findings) or described(findings)) or findings.kind == "random forces":
        shown.remove("augmented")
    if fit["before"] == fit["recalibrated"]:  # no parameter was free, or none changed
        shown.remove("recalibrated")
    rows = []
    for name in shown:
        error = fit[name]
        words = SIMULATIONS[name]
        if name == "augmented" and findings.kind == "unexplained":
            words = "with what describes it" if described(findings) else "with what comes closest"
        if name == "augmented" and fit.get("named") is not None:
            named = {"simulation": "with what has a name only", "of the spread": _percent(fit["named"])}
            times = fit["named"] / floor if floor > 0 else None
            rows.append({**named, "times noise": "" if times is None else value_text(times, digits=2)})
            words = "with what describes the rest, too"
        row = {"simulation": words, **own.get(name, {})}
        row["of the spread"] = "ran away" if error is None else _percent(error)
        row["times noise"] = "" if error is None or not floor > 0 else value_text(error / floor, digits=2)
        rows.append(row)
    rows.append({"simulation": "noise alone", "of the spread": _percent(floor), "times noise": "1"})
    frame = pd.DataFrame(rows).fillna("")
    return ReportTable(
        "Error on held-out recordings, as root mean square.",
        frame,
        {
            "of the spread": "100 % would be a simulation that knows no more than the mean of the recordings",
            "times noise": "as a multiple of what the sensor's noise alone amounts to",
        },
    )


def errors_in_units(findings: Findings) -> dict[str, dict[str, str]]:
    """Errors of each simulation in the units of the outputs, by column heading."""
    table = findings.held_out
    if table.empty:
        return {}
    scored = table[table["scored"].astype(bool)]
    by_name = units_of_outputs(findings)
    found: dict[str, dict[str, str]] = {}
    for output, rows in scored.groupby("output", sort=False):
        unit = unit_text(by_name.get(str(output), "1"))
        for name in SIMULATIONS:
            off = (rows[name] - rows["measured"])[rows["measured"].notna()].to_numpy(float)
            text = (
                value_text(float(np.sqrt(np.mean(off**2))), digits=3)
                if np.isfinite(off).all() and len(off)
                else ""
            )
            found.setdefault(name, {})[f"{output} ({unit})" if unit else str(output)] = text or "ran away"
    return found


def units_of_outputs(findings: Findings) -> dict[str, str]:
    """The unit of each output that is a state as measured."""
    units = dict(zip(findings.before.states, findings.before.units, strict=True))
    return {name: units.get(str(formula), "1") for name, formula in findings.before.outputs}


def _percent(share: float) -> str:
    return f"{value_text(100 * share, digits=3)} %"


CANDIDATES_SHOWN = 12
RECORDINGS_LISTED = 12
STAGES = {
    "found": "found",
    "same": "explains as much",
    "needless": "explains as much, with more parameters",
    "less": "explains less",
    "further": "would add to what was found (estimate)",
    "instead": "in its place (rough estimate)",
}


def sections(findings: Findings, *, commands: Sequence[str] = ()) -> list[ReportSection]:
    """Every section that has something to say, in the order of the page."""
    found = [
        formula_of_mechanisms(findings),
        model_without_a_name(findings),
        how_sure(findings),
        _where(findings),
        _wells(findings),
        _excluded(findings),
        _parameters(findings),
        _held_out(findings),
        _candidates(findings),
        ReportSection("How to run it again", listing="\n".join(commands), folded=True) if commands else None,
    ]
    return [section for section in found if section is not None]


def _where(findings: Findings) -> ReportSection | None:
    place = findings.verdict["location"]
    if place is None:
        return None
    text = [place["sentence"]]
    if place["time"] is not None:
        begin, end = (value_text(limit, digits=3) for limit in place["time"])
        unit = unit_text(findings.before.time_unit)
        text.append(f"The recordings run from {begin} to {end}{f' {unit}' if unit else ''}.")
    total = place.get("recordings_total", 0)
    if 0 < len(place["recordings"]) < total and len(place["recordings"]) <= RECORDINGS_LISTED:
        text.append(f"It shows most clearly in {listed(place['recordings'], 'and')}.")
    for name, share in place["equations"].items():
        if share > 0:
            text.append(
                f"The best function of one coordinate, added to the equation of {name}, would explain"
                f" {percent(share)} of the difference."
            )
    figures = [*findings.figure("curves", CAPTIONS["curves"]), *findings.figure("map", CAPTIONS["map"])]
    return ReportSection("Where it sits", text, figures=figures)


def _wells(findings: Findings) -> ReportSection | None:
    if findings.kind in ("no mismatch", "unexplained"):
        return None
    text, tables, figures = list(findings.notes), [], []
    if len(findings.wells):
        text.insert(0, "U is the quasipotential for the noise of the card. Equal names are the same well.")
        shown = (
            findings.wells.replace({"": None}).replace({"simulation": SIMULATIONS}).dropna(axis=1, how="all")
        )
        tables.append(
            ReportTable(
                "Wells, and the ways out of them, without what was found and with it.",
                shown,
                {
                    "position": f"({', '.join(findings.before.states)})",
                    "prefactor": "of the mean escape time, prefactor · exp(barrier / ε)",
                    "barrier": "of U",
                },
                f"{findings.folder}/wells.csv",
            )
        )
    if len(findings.escape):
        pivot = findings.escape.pivot_table(
            index=["transition", "intensity"], columns="simulation", values="time", sort=False
        ).reset_index()
        names = [name for name in pivot.columns if name not in ("transition", "intensity")]
        if len(names) == 2:
            pivot["changed by a factor"] = pivot[names[1]] / pivot[names[0]]
        pivot.columns.name = None
        pivot = pivot.rename(columns={**SIMULATIONS, "transition": "way out", "intensity": "ε"})
        unit = unit_text(findings.before.time_unit)
        tables.append(
            ReportTable(
                f"Mean escape times{f' in {unit}' if unit else ''}, by noise intensity ε.",
                pivot, {}, f"{findings.folder}/escape.csv", 12,
            )
        )  # fmt: skip
        figures = findings.figure("escapes", CAPTIONS["escapes"])
    if not text and not tables:
        return None
    heading = "What it does to wells and escape times"
    return ReportSection(heading, text, tables=tables, figures=figures, folded=not tables)


def _excluded(findings: Findings) -> ReportSection | None:
    bounds = findings.verdict["excluded"]
    if not bounds:
        return None
    rows = [
        {
            "mechanism": label,
            "parameter": entry.get("parameter", ""),
            "at most (95 %)": value_text(entry["upper_bound_95"], unit=entry["unit"], digits=2),
        }
        for label, entry in bounds.items()
    ]
    text = ["What was looked for and not found may still be there, but no larger than this."]
    table = ReportTable("Upper bounds for mechanisms that were not found.", pd.DataFrame(rows), {}, "", 60)
    return ReportSection("How large could something missing be?", text, tables=[table])


def _parameters(findings: Findings) -> ReportSection | None:
    units = {entry.name: entry.unit for entry in findings.before.parameters}
    rows = [
        {
            "parameter": name,
            "on the card": value_text(entry["before"], unit=units.get(name, "1"), digits=4),
            "fitted": value_text(entry["after"], entry["standard_error"], unit=units.get(name, "1")),
            "change, in standard errors": (entry["after"] - entry["before"]) / entry["standard_error"]
            if entry["standard_error"]
            else float("nan"),
        }
        for name, entry in findings.verdict["recalibration"].items()
    ]
    if not rows:
        return None
    end = "with what was found" if findings.final == "augmented" else "with nothing added"
    table = ReportTable(
        f"The simulation's own parameters, on the card and fitted, {end}.", pd.DataFrame(rows)
    )
    return ReportSection("Its own parameters", tables=[table])


def _held_out(findings: Findings) -> ReportSection | None:
    tables = []
    if len(findings.scores):
        caption = (
            "The official tests of the public benchmark: root mean square errors, ours and published ones."
        )
        tables.append(ReportTable(caption, findings.scores, {}, f"{findings.folder}/official_tests.csv"))
    figures = findings.figure("held_out", CAPTIONS["held_out"])
    if not tables and not figures:
        return None
    return ReportSection("More held-out recordings", tables=tables, figures=figures)


def _candidates(findings: Findings) -> ReportSection | None:
    table = findings.candidates
    best = table[table["gain"] >= 1] if len(table) else table
    if not len(best):
        return None
    best = best.loc[best.groupby(["label", "stage"], sort=False)["gain"].idxmax()]
    best = best.assign(
        first=best["stage"] != "found", what=best["stage"].map(STAGES), gain=best["gain"].round().astype(int)
    )
    best = best.sort_values(["first", "gain"], ascending=[True, False], kind="stable")
    if not mechanisms_said(findings):
        best["what"] = "would explain (estimate)"
    shown = best[["label", "what", "gain", "beside", "shapes"]].rename(
        columns={"label": "mechanism", "what": "how it compares", "gain": "gain in χ²", "beside": "on top of"}
    )
    for column in ("on top of", "shapes"):
        if not shown[column].fillna("").astype(bool).any():
            shown = shown.drop(columns=column)
    whole = ReportTable(
        "All mechanisms by what they explain, those that were found first.",
        shown.fillna("").reset_index(drop=True),
        {
            "gain in χ²": "compared with the recalibrated simulation, or with what it stands on top of",
            "shapes": "where a parameter was tried that the mechanism does not depend on linearly",
        },
        f"{findings.folder}/candidates.csv",
        CANDIDATES_SHOWN,
    )
    figures = findings.figure("candidates", CAPTIONS["candidates"])
    return ReportSection("All that was tried", tables=[whole], figures=figures)
