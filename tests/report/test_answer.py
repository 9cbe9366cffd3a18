"""The answer of a study as plain data, for a terminal."""

import json
from pathlib import Path

import pytest

from siq.report.page import ReportContent
from siq.report.study_page import StudyResults, answer_data
from siq.workflow.study import Study
from siq.workflow.tables import Method, as_table


def answer(certified: list[bool], *, failed: list[int] | None = None):
    rows = [{"run": run, "method": "refined", "certified": one} for run, one in enumerate(certified)]
    # What the published method's certificate says does not count.
    rows += [{"run": run, "method": "regression", "certified": True} for run in range(len(certified))]
    outcomes = [
        {"run": run, "step": "refine", "status": "failed" if run in (failed or []) else "ok", "reason": ""}
        for run in range(len(certified))
    ]
    tables = {"rrmse": as_table("rrmse", rows), "outcomes": as_table("outcomes", outcomes)}
    results = StudyResults(tables, Path("tables"), images={}, vectors={}, shown=(None, Method.REFINED))
    study = Study.model_validate({"name": "mine", "runs": len(certified), "recordings": {"file": "mine.csv"}})
    return answer_data(ReportContent("A study", ["Two wells."]), study, results)


@pytest.mark.parametrize(
    "certified, said", [([True, True], "all"), ([True, False], "some"), ([False], "none"), ([True], "all")]
)
def test_how_many_runs_are_certified_is_one_word(certified, said):
    assert answer(certified)["certified"] == said


def test_the_file_says_what_a_terminal_needs():
    assert json.loads(json.dumps(answer([True, False], failed=[1]))) == {
        "title": "A study", "sentence": "Two wells.", "certified": "some", "formulas": 0, "runs": 2,
        "failed": 1, "rung": 0, "states": 0,
    }  # fmt: skip
