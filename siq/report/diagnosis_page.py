"""The page of a diagnosis, and its report as text or for a notebook."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from siq.diagnosis.statement import METRIC, Estimate, StatedFunction, StatedMechanism, Statement
from siq.numerics.text import p_text, value_text
from siq.report.diagnosis_sections import (
    Findings,
    answer,
    badge,
    final_simulation,
    numbers,
    picture,
    sections,
)
from siq.report.diagnosis_text import location_sentence, words_of
from siq.report.page import ReportContent, render_report
from siq.report.remarks import sentence
from siq.systems.dynamics import Dynamics


def mismatch_page(findings: Findings, *, title: str, commands: Sequence[str]) -> str:
    """Write the page as HTML: the recording that differs most, the verdict, the number, and the rest."""
    content = ReportContent(
        title=title,
        answer=answer(findings),
        badge=badge(findings),
        figure=picture(findings),
        figure_first=True,
        table=numbers(findings),
        sections=sections(findings, commands=commands),
    )
    return render_report(content)


DIGITS = 4
Section = tuple[str, list[str]]


def diagnosis_text(statement: Statement, system: Dynamics) -> str:
    """The report as text.

    Parameters
    ----------
    statement
        What the diagnosis states.
    system
        The simulation that was diagnosed, for units.
    """
    return "\n".join(
        line
        for heading, lines in _sections(statement, system)
        for line in (f"[[{heading}]]", *(f"    {each}" for each in lines))
    )


def diagnosis_html(statement: Statement, system: Dynamics) -> str:
    """The same as HTML, a heading and a list for each section."""
    parts = []
    for heading, lines in _sections(statement, system):
        rows = "".join(f"<li>{escape(each.strip())}</li>" for each in lines)
        parts.append(f"<h4>{escape(heading)}</h4><ul>{rows}</ul>")
    return f"<div>{''.join(parts)}</div>"


def _sections(statement: Statement, system: Dynamics) -> list[Section]:
    """Every section that has something to say."""
    closest = () if statement.description is None else statement.description.by
    found = [
        (f"Verdict: {statement.verdict}", [statement.sentence, *map(sentence, statement.remarks)]),
        ("Mechanisms", [line for each in statement.mechanisms for line in _mechanism(each)]),
        ("What comes closest", [line for each in closest for line in _mechanism(each)]),
        ("A model of it", [line for each in statement.described for line in _mechanism(each)]),
        ("How sure it is", [line for lines in words_of(statement).values() for line in lines]),
        ("Location", _location(statement)),
        ("Parameters", _parameters(statement, system)),
        (f"Error ({METRIC})", _errors(statement)),
        ("Could not be judged", [f"{each.label}: {each.reason}" for each in statement.not_fitted]),
        ("At most (95 %)", _excluded(statement)),
    ]
    return [(heading, lines) for heading, lines in found if lines]


def with_error(entry: Estimate) -> str:
    """A value with its error and unit, and the error in per cent."""
    text = value_text(entry.estimate, entry.standard_error, unit=entry.unit)
    if not entry.standard_error or not entry.estimate:
        return text
    return f"{text} ({100 * entry.standard_error / abs(entry.estimate):.2g} %)"


def _mechanism(mechanism: StatedMechanism | StatedFunction) -> list[str]:
    lines = [mechanism.label]
    lines += [f"  {name}: {formula}" for name, formula in mechanism.terms.items()]
    lines += [f"  {name} = {with_error(entry)}" for name, entry in mechanism.parameters.items()]
    evidence = mechanism.evidence
    if evidence.delta_chi2 is not None and evidence.delta_bic is not None:
        lines.append(
            f"  gain in χ² {evidence.delta_chi2:.0f}, ΔBIC {evidence.delta_bic:.0f},"
            f" p = {_p(evidence.p_white)} (independent errors), {_p(evidence.p_cluster)} (errors of a"
            " recording together)"
        )
    return lines


def _p(value: float | None) -> str:
    return "unknown" if value is None else p_text(value)


def _location(statement: Statement) -> list[str]:
    place = statement.location
    if place is None:
        return []
    some = 0 < len(place.recordings) < place.recordings_total
    return [location_sentence(place), *([f"recordings: {', '.join(place.recordings)}"] if some else [])]


def _parameters(statement: Statement, system: Dynamics) -> list[str]:
    units = {entry.name: entry.unit for entry in system.parameters}
    return [
        f"{name} = {with_error(Estimate(each.after, each.standard_error, units.get(name, '1')))}"
        f"  (on the card: {each.before:.{DIGITS}g})"
        for name, each in (statement.recalibration or {}).items()
    ]


def _errors(statement: Statement) -> list[str]:
    errors = statement.errors
    shown = {
        "as it is": errors.before,
        "recalibrated": errors.recalibrated,
        "with what was found": errors.augmented,
        "noise alone": errors.noise_floor,
    }
    if all(value is None for value in shown.values()):
        return []
    return [f"{name}: {'ran away' if value is None else f'{value:.3g}'}" for name, value in shown.items()]


def _excluded(statement: Statement) -> list[str]:
    return [
        f"{label}: {bound.parameter} = {value_text(bound.upper_bound_95, unit=bound.unit, digits=2)}"
        for label, bound in (statement.excluded or {}).items()
    ]


def mismatch_answer(verdict: Mapping[str, Any], *, title: str) -> dict[str, Any]:
    """The content of ``answer.json``: the sentence that the page opens with, and the number beside it.

    Parameters
    ----------
    verdict
        The content of ``verdict.json``.
    title
        What the page is headed.

    Returns
    -------
    dict
        ``title``, ``sentence``, ``verdict``, ``compared`` (false where no fit of the simulation has a
        result), ``held_out_before`` (the simulation as given), ``held_out_after`` (the one that the verdict
        ends with) and ``held_out_noise``. The errors are root mean squares on recordings held out, as a share
        of the spread of what was measured; null where a simulation ran away.
    """
    fit = verdict["fit"]
    return {
        "title": title,
        "sentence": verdict["sentence"],
        "verdict": verdict["verdict"],
        "compared": fit["noise_floor"] is not None,
        "held_out_before": fit["before"],
        "held_out_after": fit[final_simulation(verdict)],
        "held_out_noise": fit["noise_floor"],
    }
