"""What the page of a diagnosis is made from, and how its numbers read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import pandas as pd

from siq.dynamics.dynamics import Dynamics
from siq.mismatch.dictionary import Mechanism
from siq.numerics.number_text import number_text

DIGITS = 3


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
        Columns ``label shapes gain stage``.
    figures
        SVG files by the names of `siq.report.mismatch_sections.CAPTIONS`.
    wells, escape, notes
        See `siq.mismatch.consequences.Consequences`.
    scores
        Columns ``simulation score output rms unit published``, of public benchmarks only.
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
    folder: str = "tables"


def mechanisms_said(findings: Findings) -> list[Mapping[str, Any]]:
    """What was named, or what describes a mismatch that has no name."""
    description = findings.verdict.get("description") or {}
    return [*findings.verdict["mechanisms"], *description.get("by", [])]


def sizes(mechanism: Mapping[str, Any]) -> str:
    """Its parameters with their errors, in a line."""
    return ", ".join(
        f"{name} = {_with_error(entry)}" for name, entry in mechanism.get("parameters", {}).items()
    )


def _with_error(entry: Mapping[str, Any]) -> str:
    error = entry.get("standard_error")
    text = number(entry["estimate"]) + (f" ± {number(error)}" if error is not None else "")
    unit = entry.get("unit", "1")
    return text if unit in ("1", "") else f"({text}) {unit}" if error is not None else f"{text} {unit}"


def number(value: float | None) -> str:
    """A number in words: few digits, and none of what ran away."""
    return "ran away" if value is None else number_text(float(value), decimals=DIGITS)
