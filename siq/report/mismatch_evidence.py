"""How sure is a diagnosis: the evidence, the odds, and what is often confused with what was found?"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd

from siq.numerics.share_text import p_text
from siq.numerics.word_text import capital, listed
from siq.report.mismatch_findings import Findings, mechanisms_said
from siq.report.page import ReportSection, ReportTable

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
