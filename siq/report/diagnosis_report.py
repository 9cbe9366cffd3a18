"""The report of a diagnosis as text, and as HTML for a notebook: as a fit report, from the verdict down."""

from __future__ import annotations

from html import escape

from siq.dynamics.dynamics import Dynamics
from siq.mismatch.investigation import MismatchVerdict
from siq.mismatch.verdict import METRIC, Estimate, StatedMechanism, Statement

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
    found = [
        ("Verdict", [f"{statement.verdict}: {statement.sentence}"]),
        ("Mechanisms", [line for each in statement.mechanisms for line in _mechanism(each)]),
        ("Description", _description(statement)),
        ("Location", _location(statement)),
        ("Parameters", _parameters(statement, system)),
        (f"Error ({METRIC})", _errors(statement)),
        ("Could not be told apart", _alike(statement)),
        ("Could not be judged", [f"{each.label}: {each.reason}" for each in statement.not_fitted]),
        ("Excluded (95 %)", _excluded(statement)),
        ("Remarks", list(statement.remarks)),
    ]
    return [(heading, lines) for heading, lines in found if lines]


def with_error(entry: Estimate) -> str:
    """A value ± its error, the error in per cent, and the unit."""
    value = f"{entry.estimate:.{DIGITS}g}"
    if entry.standard_error is None:
        text = f"{value} (no error known)"
    else:
        share = f" ({100 * entry.standard_error / abs(entry.estimate):.2g} %)" if entry.estimate else ""
        text = f"{value} ± {entry.standard_error:.2g}{share}"
    return text if entry.unit in ("", "1") else f"{text} {entry.unit}"


def _mechanism(mechanism: StatedMechanism) -> list[str]:
    lines = [mechanism.label]
    lines += [f"  {name}: {formula}" for name, formula in mechanism.terms.items()]
    lines += [f"  {name} = {with_error(entry)}" for name, entry in mechanism.parameters.items()]
    evidence = mechanism.evidence
    if evidence.delta_chi2 is not None and evidence.delta_bic is not None:
        lines.append(
            f"  Δχ² = {evidence.delta_chi2:.{DIGITS}g}, ΔBIC = {evidence.delta_bic:.{DIGITS}g},"
            f" p = {evidence.p_white:.1e} (white errors), {evidence.p_cluster:.1e} (clustered errors)"
        )
    return lines


def _description(statement: Statement) -> list[str]:
    if statement.description is None or not statement.description.by:
        return []
    share = f"a share of {statement.description.share_described:.3g} is described by"
    return [share, *(f"  {line}" for each in statement.description.by for line in _mechanism(each))]


def _location(statement: Statement) -> list[str]:
    place = statement.location
    if place is None:
        return []
    shares = [f"{name}: {share:.3g} of the excess" for name, share in place.equations.items()]
    return [place.sentence, *shares, f"recordings: {', '.join(place.recordings)}"]


def _parameters(statement: Statement, system: Dynamics) -> list[str]:
    units = {entry.name: entry.unit for entry in system.parameters}
    return [
        f"{name} = {with_error(Estimate(each.after, each.standard_error, units.get(name, '1')))}"
        f"  (before: {each.before:.{DIGITS}g})"
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


def _alike(statement: Statement) -> list[str]:
    lines = [
        f"{each.name}: not to be told from {', '.join(each.indistinguishable_from)}"
        for each in statement.mechanisms
        if each.indistinguishable_from
    ]
    if statement.verdict is MismatchVerdict.MISSING_PHYSICS and not lines:
        return ["nothing: no other mechanism explains the recordings as well"]
    return lines


def _excluded(statement: Statement) -> list[str]:
    return [
        f"{label}: {bound.parameter} at most {bound.upper_bound_95:.2g}"
        + ("" if bound.unit in ("", "1") else f" {bound.unit}")
        for label, bound in (statement.excluded or {}).items()
    ]
