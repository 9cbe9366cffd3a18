"""The sentences of a diagnosis, from the templates in `siq/report/templates/diagnosis.j2`."""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import cache
from typing import Any

from siq.diagnosis.holdout import HeldOutErrors
from siq.diagnosis.mechanisms import PROCESS_NOISE
from siq.diagnosis.residual_structure import DOUBTFUL
from siq.diagnosis.statement import Recalibrated, Statement
from siq.numerics.text import LARGEST_PLAIN_NUMBER, SMALLEST_SHARE, number_text, p_equation, value_text
from siq.remarks import sentence
from siq.report.formatting import environment

SENTENCE_END = "¶"


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
        "before": lambda each: _card_value(each.before),
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
    found = []
    for name, each in recalibration.items():
        change, error = abs(each.after - each.before), each.standard_error
        if change:
            found.append((name, each, change / error if error > 0 else float("inf")))
    return sorted(found, key=lambda each: -each[2])


def _card_value(value: float) -> str:
    """A value as a card has it."""
    text = f"{value:.6g}"
    return number_text(value) if "e" in text else text.replace("-", "−")


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
