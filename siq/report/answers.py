"""The answer of a study or a diagnosis as plain data, for a terminal or another program."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import pandas as pd

from siq.numerics.files import whole_file
from siq.report.diagnosis_sections import final_simulation
from siq.workflow.outcomes import Method, Status

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
