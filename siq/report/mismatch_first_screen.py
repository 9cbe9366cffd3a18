"""The first screen of a diagnosis: the sentence, what it rests on, the picture, and the number."""

from __future__ import annotations

import numpy as np
import pandas as pd

from siq.numerics.measured_text import unit_text, value_text
from siq.numerics.word_text import capital
from siq.report.largest_difference import largest_difference
from siq.report.mismatch_findings import SIMULATIONS, Findings, described, mechanisms_said
from siq.report.page import Badge, ReportFigure, ReportTable

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
