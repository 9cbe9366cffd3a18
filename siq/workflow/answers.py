"""What came of a study or a diagnosis, in one sentence, and the exit code that says the same."""

from __future__ import annotations

import json
from collections.abc import Mapping
from enum import IntEnum
from pathlib import Path
from typing import Any


class Exit(IntEnum):
    """Codes with which ``siq`` ends.

    ``ANSWERED``: there is an answer; that a formula is not certified is one, too. ``FAULT``: a file cannot be
    used, something is not installed, or a step stopped. ``USAGE``: the command line was not understood.
    ``NO_ANSWER``: everything ran, and there is a page that says why, but it has no formula, or the
    simulation cannot be compared. ``INTERRUPTED``: it was stopped, and goes on where it stopped.
    """

    ANSWERED = 0
    FAULT = 1
    USAGE = 2
    NO_ANSWER = 3
    INTERRUPTED = 130


CERTIFIED = {
    "all": "Every formula passed its certificate.",
    "some": "Some of the formulas passed their certificates; the page says which.",
    "none": "No formula passed its certificate: read on the page why, before you rely on the numbers.",
}


def answer_of_page(page: Path) -> tuple[list[str], Exit]:
    """What to say of a page and how to end, from the file ``answer.json`` beside it.

    Parameters
    ----------
    page
        ``results/NAME/report.html`` or ``results/mismatch/NAME/report.html``.
    """
    try:
        answer = json.loads((page.parent / "answer.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):  # a page of an earlier version: it is there, and that is all we know
        return [], Exit.ANSWERED
    if "verdict" not in answer:
        return _of_study(answer)
    return [str(answer["sentence"])], Exit.ANSWERED if answer.get("compared", True) else Exit.NO_ANSWER


def _of_study(answer: Mapping[str, Any]) -> tuple[list[str], Exit]:
    sentence = str(answer["sentence"])
    lines = [sentence] if sentence else []
    if not answer["formulas"] and answer.get("states"):
        return [*lines, "No formula was found: the states and their times are the answer."], Exit.ANSWERED
    if not answer["formulas"]:
        why = "No formula was found; the page says at which step, and what to do."
        return [*lines, why], Exit.NO_ANSWER
    if answer["runs"] == 1 and answer["certified"] == "all":
        lines.append("The formula passed its certificate.")
    else:
        lines.append(CERTIFIED[answer["certified"]])
    if answer["failed"]:
        lines.append(f"{answer['failed']} of {answer['runs']} runs failed at some step.")
    return lines, Exit.ANSWERED
