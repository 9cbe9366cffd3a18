"""The page of a diagnosis, its report as text or for a notebook, and its answer for a terminal.

All read `siq.diagnosis.statement.Statement`; sentences stand in `templates/diagnosis.j2`, and what is about
them in `diagnosis_page.j2` and `diagnosis_report.j2`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from html import escape
from typing import Any

import numpy as np
import pandas as pd
import sympy
from markupsafe import Markup, escape as markup_escape

from siq.diagnosis.dictionary import Mechanism
from siq.diagnosis.holdout import HeldOutErrors
from siq.diagnosis.mechanisms import PROCESS_NOISE
from siq.diagnosis.residual_structure import DOUBTFUL
from siq.diagnosis.statement import METRIC, Recalibrated, StatedTerm, Statement
from siq.diagnosis.study import MismatchVerdict
from siq.numerics.text import (
    LARGEST_PLAIN_NUMBER,
    SMALLEST_SHARE,
    number_text,
    p_equation,
    p_text,
    value_text,
)
from siq.remarks import sentence
from siq.report.formatting import environment, formula_mathml, percent_text, texts, with_unit
from siq.report.page import FormulaRow, ReportFigure, compose, render_report
from siq.systems.dynamics import Dynamics, symbol
from siq.systems.formulas import FormulaError, parse_formula

DIGITS = 3
LARGEST_LOG_ODDS = math.log(1e6)  # beyond which odds are not told
SENTENCE_END = "¶"


@dataclass(frozen=True)
class Findings:
    """What the page is made from.

    Of the tables, `candidates` has the columns ``label shapes gain stage beside``, `scores` of public
    benchmarks ``simulation score output rms unit published``, and `held_out` a row for each sample with
    ``output measured before recalibrated augmented scored``; for `wells`, `escape` and `notes` see
    `workflow.consequences.compare_landscapes`.
    """

    statement: Statement  #: the content of verdict.json
    before: Dynamics  #: the simulation of the card
    after: Dynamics  #: the one that the verdict ends with
    dictionary: Sequence[Mechanism]  #: the mechanisms that could be named
    candidates: pd.DataFrame
    figures: Mapping[str, bytes]  #: SVG files by the names of their captions
    wells: pd.DataFrame = field(default_factory=pd.DataFrame)
    escape: pd.DataFrame = field(default_factory=pd.DataFrame)
    notes: Sequence[str] = ()
    scores: pd.DataFrame = field(default_factory=pd.DataFrame)
    held_out: pd.DataFrame = field(default_factory=pd.DataFrame)
    folder: str = "tables"  #: where the whole tables are

    @property
    def named(self) -> list[StatedTerm]:
        """What was named, or what describes a mismatch that has no name."""
        description = self.statement.description
        return [*self.statement.mechanisms, *(description.by if description else ())]

    def entry(self, name: str) -> Mechanism | None:
        """A mechanism of the dictionary by its name."""
        return next((entry for entry in self.dictionary if entry.name == name), None)

    def pictures(self, name: str, caption: str = "") -> list[ReportFigure]:
        """A figure with its caption; none where there was nothing to draw."""
        image, caption = self.figures.get(name), caption or texts("captions")["diagnosis"][name]
        return [] if image is None else [ReportFigure(caption, caption, image, "svg")]


def mismatch_answer(statement: Statement, *, title: str) -> dict[str, Any]:
    """The content of ``answer.json``: the sentence that the page opens with, and the number beside it.

    It is false that errors are ``compared`` where no fit of the simulation has a result. ``held_out_before``
    is of the simulation as given, ``held_out_after`` of the one that the verdict ends with. The errors are
    root mean squares on recordings held out, as a share of the spread of what was measured; null where a
    simulation ran away.
    """
    errors = statement.errors
    return {
        "title": title, "sentence": statement.sentence, "verdict": str(statement.verdict),
        "outcome": statement.outcome, "compared": errors.noise_floor is not None,
        "held_out_before": errors.before, "held_out_after": getattr(errors, statement.final_simulation),
        "held_out_noise": errors.noise_floor,
    }  # fmt: skip


@cache
def _templates() -> Any:
    """The macros of the templates, each of which writes sentences."""
    made = environment()
    made.globals |= {"PROCESS_NOISE": PROCESS_NOISE, "DOUBTFUL": DOUBTFUL}
    made.globals |= {"SMALLEST_SHARE": SMALLEST_SHARE}
    further: dict[str, Any] = {
        "p_equation": p_equation,
        "error": _error_text,
        "estimate": lambda entry, digits=4, error=True: value_text(
            entry.estimate, entry.standard_error if error else None, unit=entry.unit, digits=digits
        ),
        "after": lambda each: value_text(each.after, each.standard_error, unit=each.unit),
        "before": lambda each: (
            number_text(each.before)  # as a card has it
            if "e" in (text := f"{each.before:.6g}")
            else text.replace("-", "−")
        ),
        "changes": _changes,
    }
    made.filters |= further
    return made.get_template("diagnosis.j2").module


def _written(text: str) -> list[str]:
    """The sentences of a template's text; how that is broken into lines is of no matter."""
    lines = (re.sub(r"[ \n]+", " ", line).strip() for line in text.split(SENTENCE_END))
    return [line for line in lines if line]


def sentences_of(statement: Statement) -> dict[str, Any]:
    """All sentences of a statement.

    Returns
    -------
    dict
        ``sentence``, with which the page opens: the verdict, how large, and what it does to the error.
        ``words``: the ``alternatives``, what cannot be told apart, and whether anything else would do; how
        much of the difference is ``explained``; what that leaves (``left``). ``remarks``. ``location``: in
        which equation a mismatch sits, along which coordinate and where, in how many recordings; empty
        where there is none.
    """
    description, templates = statement.description, _templates()
    mechanisms = statement.mechanisms if description is None else description.by
    return {
        "sentence": " ".join(_written(templates.verdict(statement))),
        "words": {
            "alternatives": [line for each in mechanisms for line in _written(templates.alternatives(each))],
            "explained": _written(templates.explained(mechanisms)),
            "left": [] if description is None else _written(templates.left(description)),
        },
        "remarks": [sentence(each) for each in statement.remarks],
        "location": "" if statement.location is None else _written(templates.location(statement.location))[0],
    }


def _changes(recalibration: Mapping[str, Recalibrated]) -> list[tuple[str, Recalibrated, float]]:
    """Parameters that differ from those on the card, with how many standard errors; the surest first."""
    sizes = (
        (name, each, abs(each.after - each.before), each.standard_error)
        for name, each in recalibration.items()
    )
    found = [(name, each, size / error if error > 0 else np.inf) for name, each, size, error in sizes if size]
    return sorted(found, key=lambda each: -each[2])


def _error_text(value: float | None, errors: HeldOutErrors) -> str:
    """An error in the unit of what is measured, or as a share of the recordings' spread."""
    if value is None:
        return "unknown"
    if errors.spread is not None:
        return value_text(value * errors.spread, unit=errors.unit, digits=3)
    share = 100 * value
    if share >= 1e3 or 0 < share < 1e-3:
        text = f"{share:.0f}" if 1e3 <= share < LARGEST_PLAIN_NUMBER else number_text(share, decimals=2)
    else:
        text = f"{share:#.3g}".rstrip(".")
    return f"{text} %"


def diagnosis_text(statement: Statement, system: Dynamics) -> str:
    """The report as text; units are those of the simulation that was diagnosed."""
    units = {entry.name: entry.unit for entry in system.parameters}
    template = environment().get_template("diagnosis_report.j2")
    text = template.render(sentences_of(statement), st=statement, units=units, metric=METRIC)
    return "\n".join(line for line in text.splitlines() if line.strip())


def diagnosis_html(statement: Statement, system: Dynamics) -> str:
    """The report as HTML, a heading and a list for each section."""
    parts: list[str] = []
    for line in map(str.strip, diagnosis_text(statement, system).splitlines()):
        if line.startswith("[["):
            heading = escape(line.removeprefix("[[").removesuffix("]]"))
            parts.append(f"{'</ul>' if parts else ''}<h4>{heading}</h4><ul>")
        else:
            parts.append(f"<li>{escape(line)}</li>")
    return f"<div>{''.join(parts)}</ul></div>"


def mismatch_page(findings: Findings, *, title: str, commands: Sequence[str], origin: str = "") -> str:
    """Write the page as HTML: the recording that differs most, the verdict, the number, and the rest.

    `commands` make it again; `origin` says what it came from.
    """
    statement, before = findings.statement, findings.before
    units = dict(zip(before.states, before.units, strict=True))
    of_outputs = {name: units.get(str(formula), "1") for name, formula in before.outputs}
    own_units = {entry.name: entry.unit for entry in before.parameters}
    largest = None
    if not findings.held_out.empty:
        largest = largest_difference(findings.held_out, after=statement.final_simulation)
    known = [(each, entry) for each in findings.named if (entry := findings.entry(each.name)) is not None]
    less = {each.name: {one.name for one in each.rivals if one.standing == "less"} for each, _ in known}
    alike = [
        (each.name, [name for name in entry.look_alikes if name in less[each.name]]) for each, entry in known
    ]
    named = [(each, entry) for each, entry in known if each in statement.mechanisms]
    formulas = [row for each in findings.named for row in _rows_of(each, findings)]
    if formulas and statement.outcome == "named":  # the whole new equations, too
        equations = zip(findings.after.states, findings.after.equations, strict=True)
        formulas += [FormulaRow(_rate_of(name), _typeset(formula)) for name, formula in equations]
    compared = (MismatchVerdict.MISSING_PHYSICS, MismatchVerdict.UNEXPLAINED)
    told = len(statement.explanations) > 1 and statement.verdict in compared
    content = compose(
        "diagnosis_page.j2", title=title, **sentences_of(statement), st=statement, d=findings,
        commands=commands, origin=origin, largest=largest, units=of_outputs,
        mechanism_sentences=[
            (each.name, entry.sentence) for each, entry in named if not statement.random_forces
        ],
        errors=_errors_table(findings, of_outputs), formulas=formulas,
        mechanism_parameters=_parameters_of(findings.named, of=True),
        references=list(
            dict.fromkeys((each.name, entry.reference) for each, entry in known if entry.reference)
        ),
        described_formulas=[row for each in statement.described for row in _rows_of(each, findings)],
        described_tables=[
            (each, _parameters_of([each]) if each.curve is None else _curve(each))
            for each in statement.described
        ],
        look_alikes=[(name, names) for name, names in alike if names],
        evidence=pd.DataFrame([
            {
                "mechanism": part.label, "gain in χ²": round(evidence.delta_chi2),
                "ΔBIC": round(evidence.delta_bic or 0), "odds of the name": _odds_text(evidence.log_odds),
                "p, independent errors": p_text(evidence.p_white or 0),
                "p, errors of a recording together": p_text(evidence.p_cluster or 0),
            }
            for part in findings.named
            if (evidence := part.evidence).delta_chi2 is not None
        ]),
        explanations=pd.DataFrame([
            {"explanation": what, "log-evidence": round(value, 1)}
            for what, value in (statement.explanations.items() if told else ())
        ]),
        wells=None
        if findings.wells.empty
        else findings.wells.replace({"": None})
        .replace({"simulation": texts("tables")["simulations"]})
        .dropna(axis=1, how="all"), escape=_escape_times(findings.escape),
        bounds=pd.DataFrame([
            {
                "mechanism": label, "parameter": bound.parameter,
                "at most (95 %)": value_text(bound.upper_bound_95, unit=bound.unit, digits=2),
            }
            for label, bound in statement.excluded.items()
        ]),
        parameters=pd.DataFrame(
            [
                {
                    "parameter": name,
                    "on the card": value_text(one.before, unit=own_units.get(name, "1"), digits=4),
                    "fitted": value_text(one.after, one.standard_error, unit=own_units.get(name, "1")),
                    "change, in standard errors": (one.after - one.before) / one.standard_error
                    if one.standard_error
                    else math.nan,
                }
                for name, one in statement.recalibration.items()
            ]
        ),
        candidates=_candidates(findings),
    )  # fmt: skip
    return render_report(content)


def largest_difference(table: pd.DataFrame, *, after: str) -> dict[str, Any] | None:
    """The held-out recording to begin with; None where nothing was held out.

    The output is the one in which the simulation as given is off the furthest, in units of its spread, in
    the middle of all recordings, so that a single runaway does not decide. Of its recordings it is the one
    in which the difference is largest.

    The table is `Findings.held_out` with recordings, and `after` the simulation that the verdict ends with:
    ``"augmented"``, ``"recalibrated"``, or ``"before"``. The result has ``recording`` and ``output``; root
    mean square differences there, in the unit of the output, ``before`` and ``after``, infinite where a
    simulation runs away; and how many ``recordings`` there are.
    """
    scored = table[table["scored"].astype(bool) & table["measured"].notna()]
    if scored.empty:
        return None
    squares = {
        name: ((scored[name] - scored["measured"]) ** 2).fillna(np.inf)
        for name in dict.fromkeys(("before", after))
    }
    places = [scored["output"], scored["recording"].astype(str)]
    errors = {name: each.groupby(places, sort=False).mean() for name, each in squares.items()}
    spread = scored.groupby("output", sort=False)["measured"].var()
    middle = errors["before"].groupby(level="output", sort=False).median()
    output = str((middle / spread.where(spread > 0, 1.0)).idxmax())
    recording = str(errors["before"].loc[output].idxmax())
    root = {name: float(np.sqrt(each.loc[output, recording])) for name, each in errors.items()}
    return {
        "recording": recording, "output": output, "before": root["before"], "after": root[after],
        "recordings": scored["recording"].nunique(),
    }  # fmt: skip


def _errors_table(findings: Findings, units: Mapping[str, str]) -> pd.DataFrame | None:
    """The error on held-out recordings: in their own units, in per cent of their spread, and beside noise."""
    errors, statement, words = findings.statement.errors, findings.statement, texts("tables")["simulations"]
    floor = errors.noise_floor
    if floor is None:
        return None
    shown = ["before", "recalibrated", "augmented"]
    if not (findings.named or statement.described) or statement.random_forces:
        shown.remove("augmented")
    if errors.before == errors.recalibrated:  # no parameter was free, or none changed
        shown.remove("recalibrated")
    rows = []

    def row(words: str, error: float | None, **own: str) -> dict[str, str]:
        times = "" if error is None or not floor > 0 else value_text(error / floor, digits=2)
        spread = "ran away" if error is None else percent_text(error, digits=3)
        return {"simulation": words, **own, "of the spread": spread, "times noise": times}

    table = findings.held_out
    scored = table[table["scored"].astype(bool)] if len(table) else table
    for name in shown:
        own = {}
        for output, samples in scored.groupby("output", sort=False) if len(scored) else ():
            off = (samples[name] - samples["measured"])[samples["measured"].notna()].to_numpy(float)
            known = len(off) and np.isfinite(off).all()
            text = value_text(float(np.sqrt(np.mean(off**2))), digits=3) if known else "ran away"
            own[with_unit(str(output), units.get(str(output), "1"))] = text
        said = name
        if name == "augmented" and statement.outcome in ("unexplained", "modelled"):
            said = "described" if statement.described else "closest"
        if name == "augmented" and errors.named is not None:
            rows.append(row(words["named"], errors.named))
            said = "rest"
        rows.append(row(words[said], getattr(errors, name), **own))
    rows.append(row(words["noise"], floor) | {"times noise": "1"})
    return pd.DataFrame(rows).fillna("")


def _rows_of(part: StatedTerm, findings: Findings) -> list[FormulaRow]:
    """The formulas of a mechanism or of what has no name, and what each is; the simplest that it may be."""
    entry, words, kind = findings.entry(part.name), texts("tables")["smooth"], part.kind
    rows = [
        FormulaRow(
            part.label,
            words[kind] if kind in words else _typeset_text(formula, findings.after, part.parameters),
            _meaning(name, entry, findings),
            whole=formula if kind in words else None,
        )
        for name, formula in part.terms.items()
    ]
    if part.formula:
        what = texts("tables")["formula_of"]["coefficient" if part.coordinates[1:] else "simplest"]
        typeset = _typeset_text(part.formula, findings.after, part.sizes)
        rows.append(FormulaRow(part.shape, typeset, str(what).format(*part.coordinates)))
    return rows


def _meaning(name: str, entry: Mechanism | None, findings: Findings) -> str:
    """What a formula of a mechanism is; see `siq.diagnosis.mechanisms.MechanismCandidate.changes`."""
    words, forms = texts("tables")["formula_of"], () if entry is None else entry.forms
    if name in [output for output, _ in findings.before.outputs] and any(form.outputs for form in forms):
        return str(words["measured"]).format(name)
    if name not in findings.before.states:
        return str(words["new"]).format(name)
    return str(words["replaced" if any(form.replace for form in forms) else "added"]).format(name)


def _typeset_text(text: str, model: Dynamics, further: Iterable[str] = ()) -> Markup | str:
    """A formula, typeset; as text where it cannot be read as one of the model's and these further names."""
    names = {**model.names, **{name: symbol(name) for name in further}}
    try:
        formula = parse_formula(text, names, inputs=tuple(entry.name for entry in model.inputs))
    except FormulaError:
        return text
    return _typeset(formula)


def _typeset(formula: sympy.Expr) -> Markup | str:
    """A formula, typeset; as text where it has a function that is not known."""
    try:
        return formula_mathml(formula, decimals=DIGITS)
    except (AttributeError, NotImplementedError, TypeError, ValueError):
        return str(formula)


def _rate_of(name: str) -> Markup:
    """The left side of an equation: dx/dt, typeset."""
    inner = formula_mathml(sympy.Symbol(name, real=True))
    inside = inner[inner.index(">") + 1 : inner.rindex("<")]
    spoken = markup_escape(f"d{name}/dt")
    return Markup(
        '<math aria-label="{}"><mfrac><mrow><mi>d</mi>{}</mrow><mrow><mi>d</mi><mi>t</mi></mrow></mfrac>'
        "<mo>=</mo></math>"
    ).format(spoken, Markup(inside))


def _parameters_of(parts: Sequence[StatedTerm], *, of: bool = False) -> pd.DataFrame:
    """Parameters with errors and units; with `of`, what each is of."""
    rows = [
        ({"of": part.label} if of else {})
        | {"parameter": name, "value": value_text(one.estimate, one.standard_error, unit=one.unit)}
        for part in parts
        for name, one in part.parameters.items()
    ]
    return pd.DataFrame(rows)


def _curve(part: StatedTerm) -> pd.DataFrame:
    curve = part.curve
    assert curve is not None
    values = list(map(value_text, curve.value, curve.standard_error))
    return pd.DataFrame({curve.coordinate: [value_text(at, digits=3) for at in curve.at], "value": values})


def _odds_text(log_odds: float | None) -> str:
    """Odds such as ``340 to 1``; empty where they are not known."""
    if log_odds is None:
        return ""
    if abs(log_odds) > LARGEST_LOG_ODDS:
        return "beyond 10⁶ to 1" if log_odds > 0 else "beyond 1 to 10⁶"
    odds = math.exp(abs(log_odds))
    digits = max(len(str(int(odds))) - 2, 0)
    text = f"{round(odds, -digits):.0f}" if odds >= 10 else f"{odds:.1f}"
    return f"{text} to 1" if log_odds >= 0 else f"1 to {text}"


def _escape_times(escape: pd.DataFrame) -> pd.DataFrame | None:
    """Mean escape times, a column for each simulation, and by which factor they differ."""
    if escape.empty:
        return None
    pivot = escape.pivot_table(
        index=["transition", "intensity"], columns="simulation", values="time", sort=False
    ).reset_index()
    names = [name for name in pivot.columns if name not in ("transition", "intensity")]
    if len(names) == 2:
        pivot["changed by a factor"] = pivot[names[1]] / pivot[names[0]]
    pivot.columns.name = None
    return pivot.rename(columns={**texts("tables")["simulations"], "transition": "way out", "intensity": "ε"})


def _candidates(findings: Findings) -> pd.DataFrame | None:
    """What was tried by what it explains, what was found first."""
    table, words = findings.candidates, texts("tables")["stages"]
    best = table[table["gain"] >= 1] if len(table) else table
    if not len(best):
        return None
    best = best.loc[best.groupby(["label", "stage"], sort=False)["gain"].idxmax()]
    best = best.assign(
        first=best["stage"] != "found", what=best["stage"].map(words), gain=best["gain"].round().astype(int)
    )
    best = best.sort_values(["first", "gain"], ascending=[True, False], kind="stable")
    if not findings.named:
        best["what"] = words["estimate"]
    shown = best[["label", "what", "gain", "beside", "shapes"]].rename(
        columns={"label": "mechanism", "what": "how it compares", "gain": "gain in χ²", "beside": "on top of"}
    )
    return shown.fillna("").reset_index(drop=True)
