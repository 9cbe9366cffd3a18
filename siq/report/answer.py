"""The answer of a study as plain data, for a terminal or another program."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import pandas as pd

from siq.files.whole import whole_file
from siq.steps.outcomes import Method, Status

Certified = Literal["all", "some", "none"]


@dataclass(frozen=True)
class Answer:
    """What a study ended with.

    Attributes
    ----------
    title
        What the study is headed.
    sentence
        The answer in one sentence, as the page opens with it.
    certified
        Whether the formulas of all runs, of some, or of none passed their certificates.
    formulas, runs, failed
        How many runs ended with a refined formula, how many there were, and in how many a step failed.
    """

    title: str
    sentence: str
    certified: Certified
    formulas: int
    runs: int
    failed: int


def answer_of(
    title: str, sentence: str, *, rrmse: pd.DataFrame, outcomes: pd.DataFrame, formulas: int, runs: int
) -> Answer:
    """The answer, counted over the runs.

    Parameters
    ----------
    title, sentence
        As on the page.
    rrmse, outcomes
        The tables of these names.
    formulas
        How many runs have a refined formula.
    runs
        How many the study asked for.
    """
    certified = int(rrmse[rrmse["method"] == Method.REFINED]["certified"].sum())
    failed = int(outcomes[outcomes["status"] == Status.FAILED]["run"].nunique())
    how: Certified = "none" if certified == 0 else "all" if certified >= runs else "some"
    return Answer(title, sentence, how, formulas, runs, failed)


def write_answer(path: str | Path, answer: Answer) -> None:
    """Write `answer.json` whole or not at all."""
    with whole_file(path) as partial:
        partial.write_text(json.dumps(asdict(answer), indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
