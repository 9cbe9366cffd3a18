"""The sections of a diagnosis' page: where it sits, what follows, and what else was tried."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd

from siq.numerics.measured_text import unit_text, value_text
from siq.numerics.share_text import percent
from siq.numerics.word_text import listed
from siq.report.mismatch_captions import CAPTIONS
from siq.report.mismatch_evidence import how_sure
from siq.report.mismatch_findings import SIMULATIONS, Findings, mechanisms_said
from siq.report.mismatch_formulas import formula_of_mechanisms, model_without_a_name
from siq.report.page import ReportSection, ReportTable

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
