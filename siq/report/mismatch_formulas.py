"""What does the page of a diagnosis say of what is missing, as formulas: named, or a model without a name?"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pandas as pd

from siq.mismatch.dictionary import Mechanism
from siq.numerics.measured_text import value_text
from siq.numerics.word_text import capital
from siq.report.mismatch_captions import CAPTIONS
from siq.report.mismatch_findings import Findings, described, mathml, mechanisms_said, rate_of, typeset
from siq.report.page import FormulaRow, ReportSection, ReportTable

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
    """What a formula of a mechanism is; see `siq.mismatch.building.MechanismCandidate.changes`."""
    measured = name in [output for output, _ in findings.before.outputs]
    if measured and entry is not None and any(form.outputs for form in entry.forms):
        return f"what is measured as {name}"
    if name not in findings.before.states:
        return f"the rate of change of {name}, which is new"
    replaced = entry is not None and any(form.replace for form in entry.forms)
    return f"in the equation of {name}" if replaced else f"added to the equation of {name}"


def _value(entry: Mapping[str, Any]) -> str:
    return value_text(entry["estimate"], entry.get("standard_error"), unit=entry.get("unit", "1"))
