"""What the page of a diagnosis is made from, and how its numbers read."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import pandas as pd
import sympy
from markupsafe import Markup, escape

from siq.dynamics.dynamics import Dynamics
from siq.dynamics.formulas import FormulaError, parse_formula
from siq.dynamics.parametric import symbol
from siq.mismatch.candidates import PROCESS_NOISE
from siq.mismatch.dictionary import Mechanism
from siq.report.formatting import formula_mathml
from siq.report.page import ReportFigure

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
        SVG files by the names of `siq.report.mismatch_captions.CAPTIONS`, as far as there was something to
        draw.
    wells, escape, notes
        See `siq.mismatch.consequences.Consequences`.
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
        """Sentences of the verdict; see `siq.mismatch.sentences.words_of`."""
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
    """The model of what has no name; see `siq.mismatch.stated_parts.StatedFunction`."""
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
