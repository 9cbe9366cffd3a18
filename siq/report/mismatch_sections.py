"""The sections of a diagnosis' page: where it sits, what is missing, how sure that is, and what follows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import pandas as pd
import sympy
from markupsafe import Markup

from siq.dynamics.dynamics import Dynamics
from siq.dynamics.formulas import FormulaError, parse_formula
from siq.report.formatting import formula_mathml
from siq.report.mismatch_findings import DIGITS, Findings, mechanisms_said, number
from siq.report.page import ReportFigure, ReportTable

CANDIDATES_SHOWN = 12
CAPTIONS = {
    "curves": "What is missing in an equation against a coordinate: in the recalibrated simulation, and in"
    " the one that the verdict ends with. What the simulation's own parameters can do is taken off; where a"
    " band leaves zero, something is missing there.",
    "map": "The missing part over the two states along which most of it can be seen, averaged over cells;"
    " grey where there are no recordings.",
    "candidates": "How much what was found explains, and how much further mechanisms of the dictionary would"
    " explain on top of it, beside the simulation's own parameters.",
    "held_out": "Held-out recordings with free runs of the three simulations, and the errors of these. A free"
    " run knows the recording's first part and its inputs only; of long recordings the end is shown.",
    "escapes": "Mean escape times from well to well by the law of Eyring and Kramers: without what was found,"
    " and with it.",
}


@dataclass(frozen=True)
class MismatchSection:
    """A section of the page.

    Attributes
    ----------
    heading
        Its heading.
    text
        Paragraphs.
    formulas
        Typeset formulas with their names.
    tables, figures
        Below the text, in this order.
    """

    heading: str
    text: Sequence[str] = ()
    formulas: Sequence[tuple[str, Markup | str]] = ()
    tables: Sequence[ReportTable] = ()
    figures: Sequence[ReportFigure] = ()


def sections(findings: Findings) -> list[MismatchSection | None]:
    """Every section that has something to say."""
    return [
        _where(findings),
        _what(findings),
        _how_sure(findings),
        _what_else(findings),
        _fit(findings),
        _recalibration(findings),
        _excluded(findings),
        _wells(findings),
        _remarks(findings),
    ]


def _figure(findings: Findings, name: str) -> list[ReportFigure]:
    image = findings.figures.get(name)
    return [] if image is None else [ReportFigure(CAPTIONS[name], CAPTIONS[name], image, "svg")]


def _where(findings: Findings) -> MismatchSection | None:
    place = findings.verdict["location"]
    figures = [*_figure(findings, "curves"), *_figure(findings, "map")]
    if place is None:
        text = ["There is no mismatch that could sit anywhere."]
        return MismatchSection("Where it sits", text, figures=_figure(findings, "curves"))
    text = [place["sentence"]]
    if place["time"] is not None:
        begin, end = place["time"]
        unit = findings.before.time_unit
        after = "" if unit == "1" else f" {unit}"
        text.append(f"It is seen from t = {number(begin)} to {number(end)}{after}.")
    if place["recordings"]:
        text.append(f"It shows in the recordings {', '.join(place['recordings'])}.")
    shares = pd.DataFrame(
        [{"equation": name, "share of the excess": share} for name, share in place["equations"].items()]
    )
    tables = []
    if len(shares):
        caption = "Share of what the recalibrated simulation leaves beyond noise that one function of one"
        tables = [ReportTable(f"{caption} coordinate can explain, by equation.", shares)]
    return MismatchSection("Where it sits", text, tables=tables, figures=figures)


def _what(findings: Findings) -> MismatchSection | None:
    named = mechanisms_said(findings)
    if not named:
        return None
    known = {entry.name: entry for entry in findings.dictionary}
    text, formulas, rows = [], [], []
    if findings.verdict["verdict"] == "unexplained":
        share = number((findings.verdict.get("description") or {}).get("share_described", 0.0))
        text.append(f"Nothing accounts for the whole; what follows describes a share of {share} of it.")
    for each in named:
        entry = known.get(each["name"])
        sentence = entry.sentence if entry is not None else "A term that has no name of its own."
        reference = f" ({entry.reference})" if entry is not None and entry.reference else ""
        text.append(f"{each['label'][:1].upper()}{each['label'][1:]}. {sentence}{reference}")
        formulas += [
            (f"{each['label']}: {name}", _typeset(formula, findings.after))
            for name, formula in each["terms"].items()
        ]
        rows += [
            {
                "mechanism": each["label"], "parameter": name, "estimate": value["estimate"],
                "standard error": value["standard_error"], "unit": value["unit"],
            }
            for name, value in each["parameters"].items()
        ]  # fmt: skip
    formulas += [
        (f"d{name}/d{'t'}", _mathml(formula))
        for name, formula in zip(findings.after.states, findings.after.equations, strict=True)
        if findings.verdict["verdict"] == "missing physics"
    ]
    tables = [ReportTable("Parameters of what is missing.", pd.DataFrame(rows))] if rows else []
    return MismatchSection("What is missing", text, formulas, tables)


def _typeset(text: str, model: Dynamics) -> Markup | str:
    """A formula of the verdict, typeset; as text where it cannot be read as one."""
    try:
        formula = parse_formula(text, model.names, inputs=tuple(entry.name for entry in model.inputs))
    except FormulaError:
        return text
    return _mathml(formula)


def _mathml(formula: sympy.Expr) -> Markup | str:
    try:
        return formula_mathml(formula, decimals=DIGITS)
    except (AttributeError, NotImplementedError, TypeError, ValueError):  # an unknown function, in words
        return str(formula)


def _how_sure(findings: Findings) -> MismatchSection:
    rows = [
        {"mechanism": each["label"], **each["evidence"], "share of excess": each["share_of_excess"]}
        for each in mechanisms_said(findings)
    ]
    tables = []
    text = []
    if rows:
        names = {
            "delta_chi2": "Δχ²", "delta_bic": "ΔBIC", "p_white": "p, white errors",
            "p_cluster": "p, clustered errors",
        }  # fmt: skip
        frame = pd.DataFrame(rows).rename(columns=names)
        for column in names.values():
            frame[column] = frame[column].astype(float)
        tables.append(
            ReportTable(
                "Evidence. Each mechanism was judged with those before it in place.",
                frame,
                {
                    "Δχ²": "by how much twice the log-likelihood rises with it",
                    "ΔBIC": "change of the Bayesian information criterion, negative where it pays",
                    "p, white errors": "probability of as much by chance, if errors are independent",
                    "p, clustered errors": "the same, if only recordings are independent of each other",
                    "share of excess": "of what the recalibrated simulation leaves beyond noise",
                },
            )
        )
    else:
        text.append("No mechanism stood the tests, so that none is named.")
    description = findings.verdict.get("description")
    if description:
        chance = number(description["p_residuals_random"])
        text.append(f"That what is left is random has the probability {chance}.")
    return MismatchSection("How sure that is", text, tables=tables, figures=_figure(findings, "candidates"))


def _what_else(findings: Findings) -> MismatchSection:
    known = {entry.name: entry for entry in findings.dictionary}
    text = []
    for each in mechanisms_said(findings):
        others = each.get("indistinguishable_from", [])
        if others:
            text.append(f"The recordings cannot tell {each['name']} from {_listed(others)}.")
        else:
            text.append(f"No other mechanism explains the recordings as well as {each['name']}.")
        entry = known.get(each["name"])
        alike = [name for name in (entry.look_alikes if entry is not None else ()) if name not in others]
        if alike:
            text.append(f"It is often mistaken for {_listed(alike)}; the figure tells how far these are.")
    text += [
        f"{each['label'][:1].upper()}{each['label'][1:]} could not be judged: {each['reason']}."
        for each in findings.verdict.get("not_fitted", [])
    ]
    table = findings.candidates
    tables = []
    if len(table):
        words = {"found": "found", "same": "not to be told from it", "further": "on top of what was found"}
        best = table.loc[table.groupby("label")["gain"].idxmax()].sort_values("gain", ascending=False)
        best = best[best["gain"] > 0].assign(as_what=best["stage"].map(words))
        shown = best[["label", "as_what", "shapes", "gain"]]
        shown = shown.rename(columns={"as_what": "as what", "gain": "gain in χ²"})
        tables.append(
            ReportTable(
                "Candidates by what they explain.",
                shown.reset_index(drop=True),
                {"shapes": "where a parameter was tried that the mechanism does not depend on linearly"},
                f"{findings.folder}/candidates.csv",
                CANDIDATES_SHOWN,
            )
        )
    return MismatchSection("What else it could be", text, tables=tables)


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else ", ".join(names[:-1]) + " or " + names[-1]


def _fit(findings: Findings) -> MismatchSection:
    fit = findings.verdict["fit"]
    words = {
        "before": "as the card has it", "recalibrated": "its own parameters fitted",
        "augmented": "with what was found", "noise_floor": "noise alone",
    }  # fmt: skip
    frame = pd.DataFrame([{"simulation": word, "error": number(fit[name])} for name, word in words.items()])
    tables = [ReportTable(f"The fit: {fit['metric']}.", frame)]
    if len(findings.scores):
        caption = "Scores of the public benchmark: root mean square errors on held-out recordings."
        tables.append(ReportTable(caption, findings.scores, {}, f"{findings.folder}/real_recordings.csv"))
    return MismatchSection("The fit before and after", tables=tables, figures=_figure(findings, "held_out"))


def _recalibration(findings: Findings) -> MismatchSection | None:
    units = {entry.name: entry.unit for entry in findings.before.parameters}
    rows = [
        {
            "parameter": name, "on the card": entry["before"], "fitted": entry["after"],
            "standard error": entry["standard_error"], "unit": units.get(name, "1"),
            "change, in standard errors": (entry["after"] - entry["before"]) / entry["standard_error"]
            if entry["standard_error"] else float("nan"),
        }
        for name, entry in findings.verdict["recalibration"].items()
    ]  # fmt: skip
    if not rows:
        return None
    table = ReportTable(
        "The simulation's own parameters, in the simulation that the verdict ends with.", pd.DataFrame(rows)
    )
    return MismatchSection("Its own parameters", tables=[table])


def _excluded(findings: Findings) -> MismatchSection | None:
    bounds = findings.verdict["excluded"]
    if not bounds:
        return None
    rows = [
        {
            "mechanism": label, "parameter": entry.get("parameter", ""),
            "at most (95 %)": entry["upper_bound_95"], "unit": entry["unit"],
        }
        for label, entry in bounds.items()
    ]  # fmt: skip
    text = ["What was looked for and not found can be at most so large and still agree with the recordings."]
    table = ReportTable("Upper bounds of mechanisms that were not found.", pd.DataFrame(rows), {}, "", 60)
    return MismatchSection("What is excluded", text, tables=[table])


def _wells(findings: Findings) -> MismatchSection:
    text = list(findings.notes)
    tables = []
    if len(findings.wells):
        text.insert(0, "U is the quasipotential for the noise of the card; equal names are the same well.")
        shown = findings.wells.replace("", None).dropna(axis=1, how="all")
        tables.append(
            ReportTable(
                "Wells and ways out of them, without what was found and with it.",
                shown,
                {"prefactor": "of the mean escape time prefactor · exp(barrier/ε)", "barrier": "of U"},
                f"{findings.folder}/wells.csv",
            )
        )
    figures = []
    if len(findings.escape):
        pivot = findings.escape.pivot_table(
            index=["transition", "intensity"], columns="simulation", values="time", sort=False
        ).reset_index()
        names = [name for name in pivot.columns if name not in ("transition", "intensity")]
        if len(names) == 2:
            pivot["changed by a factor"] = pivot[names[1]] / pivot[names[0]]
        pivot.columns.name = None
        unit = "" if findings.before.time_unit == "1" else f", in {findings.before.time_unit}"
        tables.append(
            ReportTable(
                f"Mean escape times by intensity ε{unit}.", pivot, {}, f"{findings.folder}/escape.csv", 12
            )
        )
        figures = _figure(findings, "escapes")
    return MismatchSection("What it does to wells and escape times", text, tables=tables, figures=figures)


def _remarks(findings: Findings) -> MismatchSection | None:
    remarks = list(findings.verdict["remarks"])
    return MismatchSection("Remarks", remarks) if remarks else None
