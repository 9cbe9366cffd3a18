"""`siq` itself, with the settings of every user but for its time; held-out recordings choose nothing."""

from __future__ import annotations

import time
from dataclasses import replace

from benchmarks.discrepancies.answers import Answer
from benchmarks.proof.foreign_scores.scores import said_place
from benchmarks.proof.scoring import NOTHING
from siq.diagnosis.diagnosis import solve_case
from siq.diagnosis.study import Allowance, Comparison
from siq.diagnosis.verdict import statement_of_failure
from siq.errors import NumericalFailure

SEARCHING = 0.6  # of the time allowed: what follows the search is not cut short


def diagnosed(case: Comparison, seconds: float) -> Answer:
    """The diagnosis within a time.

    Held-out recordings are called ``tests``: other methods choose nothing by them either.
    """
    settings = case.settings.model_copy(
        update={"budget": Allowance(seconds=SEARCHING * seconds), "tests": case.kept.labels}
    )
    try:
        found = solve_case(replace(case, settings=settings), clock=time.process_time)
    except NumericalFailure as error:
        return Answer(
            fault=str(error), card=case.system.to_card(), verdict=statement_of_failure(str(error)).as_data()
        )
    verdict = found.statement.as_data()
    equations, coordinates = said_place(verdict)
    return Answer(
        detected=verdict["verdict"] not in NOTHING,
        equations=tuple(sorted(equations)),
        coordinates=tuple(sorted(coordinates)),
        card=found.to_card(),
        verdict=verdict,
    )
