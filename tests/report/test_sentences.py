from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from siq.report.formatting import paragraphs
from siq.report.study_page import _control_counts, _run_figures
from siq.workflow.tables import as_table
from workflow.published import PublishedFigure
from workflow.scoring import summary_table

PUBLISHED = {"rrmse": PublishedFigure(mean=1e-3, source="paper")}


def answer(errors: list[float | None], *, published: bool = True, certified: bool = False) -> str:
    """The answer of a study whose runs have these errors of U; None is a run that failed."""
    rrmse = as_table(
        "rrmse",
        [
            {
                "run": run,
                "method": "regression",
                "rrmse": np.nan if error is None else error,
                "support_correct": None if error is None else error < 0.01,
                "certified": certified and error is not None,
            }
            for run, error in enumerate(errors)
        ],
    )
    outcomes = as_table(
        "outcomes",
        [
            {"run": run, "step": "train", "status": "failed" if error is None else "ok", "reason": ""}
            for run, error in enumerate(errors)
        ],
    )
    rows = [
        {"run": run, "method": "regression", "component": "U", "term": term, "estimate": value, "exact": 1.0}
        for run, error in enumerate(errors)
        if error is not None
        for term, value in {"x**2": 1 + error, "x*y": 0.3 if run == 0 else 0.0, "1": 1.0}.items()
    ]
    summary = summary_table(
        as_table("coefficients", rows), rrmse, as_table("prediction", []), PUBLISHED if published else {}
    )
    tables = {"rrmse": rrmse, "outcomes": outcomes, "summary": summary}
    return " ".join(paragraphs("runs.j2", r=_run_figures(tables, runs=len(errors), method="regression")))


def test_it_says_how_many_runs_ended_with_formulas_and_how_many_failed() -> None:
    text = answer([1e-3, 2e-3, None, 3e-3])
    assert "3 of 4 independent runs ended with formulas" in text
    assert "1 failed" in text
    assert "failed" not in answer([1e-3, 2e-3, 3e-3])


def test_failed_runs_count_in_no_mean() -> None:
    text = answer([1e-3, None, 3e-3])
    assert "0.0020 ± 0.0014 (median 2.00 × 10⁻³, worst run 3.00 × 10⁻³)" in text
    assert "2 of 2 runs found exactly the right terms" in text


def test_runs_with_false_terms_are_told_apart() -> None:
    assert "2 of 3 runs found exactly the right terms" in answer([1e-3, 0.5, 3e-3])


def test_the_published_figure_stands_beside_ours() -> None:
    assert "The published figure is 1.00 × 10⁻³; ours is 2.00 times that" in answer([1e-3, 3e-3])
    assert "published" not in answer([1e-3, 3e-3], published=False)


def test_terms_of_most_runs_and_of_some_runs_are_told_apart() -> None:
    text = answer([1e-3, 2e-3, 3e-3])
    assert "In most runs U has the terms x² (1.0020 ± 0.0010)." in text
    assert "not to be relied on: x y" in text


def test_uncertified_runs_are_never_passed_over() -> None:
    assert "2 of 2 runs are not certified" in answer([1e-3, 3e-3])
    assert "1 of 2 runs are certified" in answer([1e-3, None], certified=True)
    assert "not certified" not in answer([1e-3, 3e-3], certified=True)


@pytest.mark.filterwarnings("error")
def test_a_study_of_which_every_run_failed_has_an_answer() -> None:
    text = answer([None, None])
    assert "0 of 2 independent runs ended with formulas" in text
    assert "nan" not in text.lower()


def test_a_study_without_any_answer_known_claims_no_error() -> None:
    rrmse = as_table("rrmse", [{"run": 0, "method": "regression", "certified": False}])
    outcomes = as_table("outcomes", [{"run": 0, "step": "train", "status": "ok", "reason": ""}])
    summary = summary_table(as_table("coefficients", []), rrmse, as_table("prediction", []), {})
    tables = {"rrmse": rrmse, "outcomes": outcomes, "summary": summary}
    assert paragraphs("runs.j2", r=_run_figures(tables, runs=1, method="regression")) == []


def test_one_run_is_not_counted() -> None:
    text = answer([1e-3])
    assert "runs" not in text and "1 of 1" not in text
    assert (
        "Against the exact U the coefficients are off by 0.1 %" in text and "exactly the right terms" in text
    )
    assert "wrong terms" in answer([0.5])


def test_the_control_is_counted_by_the_runs_in_which_it_was_refused() -> None:
    table = pd.DataFrame(
        {
            "run": [0, 1, 2],
            "method": "randomised network",
            "test": "agreement",
            "passed": [False, False, True],
        }
    )
    assert _control_counts(table) == {"runs": 3, "refused": 2}
    assert _control_counts(table[table["run"] < 2]) == {"runs": 2, "refused": 2}
    assert _control_counts(table.assign(method="refined")) is None
