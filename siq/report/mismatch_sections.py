"""The sections of a diagnosis' page: how sure it is, where it sits, what follows, and what else was tried."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd

from siq.mismatch.dictionary import Mechanism
from siq.numerics.measured_text import unit_text, value_text
from siq.numerics.share_text import p_text, percent
from siq.numerics.word_text import capital, listed
from siq.report.mismatch_findings import (
    SIMULATIONS,
    Findings,
    described,
    mathml,
    mechanisms_said,
    rate_of,
    typeset,
)
from siq.report.page import FormulaRow, ReportSection, ReportTable

SMOOTH = {
    "curve": "a smooth curve (a sum of Gaussian bumps)",
    "surface": "a smooth function of two coordinates (sums of Gaussian bumps)",
}
CERTAIN = math.log(1e6)  # beyond which odds are not told
CANDIDATES_SHOWN = 12
RECORDINGS_LISTED = 12
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
        _formula(findings),
        _described(findings),
        _how_sure(findings),
        _where(findings),
        _wells(findings),
        _excluded(findings),
        _parameters(findings),
        _held_out(findings),
        _candidates(findings),
        ReportSection("How to run it again", listing="\n".join(commands), folded=True) if commands else None,
    ]
    return [section for section in found if section is not None]


def _formula(findings: Findings) -> ReportSection | None:
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


def _described(findings: Findings) -> ReportSection | None:
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
    """What a formula of a mechanism is; see `siq.mismatch.candidates.MechanismCandidate.changes`."""
    measured = name in [output for output, _ in findings.before.outputs]
    if measured and entry is not None and any(form.outputs for form in entry.forms):
        return f"what is measured as {name}"
    if name not in findings.before.states:
        return f"the rate of change of {name}, which is new"
    replaced = entry is not None and any(form.replace for form in entry.forms)
    return f"in the equation of {name}" if replaced else f"added to the equation of {name}"


def _value(entry: Mapping[str, Any]) -> str:
    return value_text(entry["estimate"], entry.get("standard_error"), unit=entry.get("unit", "1"))


def _how_sure(findings: Findings) -> ReportSection:
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
