"""A run that fails is shown as such: kept in every table, in no mean, and said in the report."""

import numpy as np
import pandas as pd
import pytest

pytestmark = [pytest.mark.workflow, pytest.mark.slow]


def test_a_study_whose_every_training_fails_still_ends_in_a_report_that_says_so(fresh_project):
    project = fresh_project
    project.write_study(steps=30)
    study = project.path("study.yaml")
    text = study.read_text().replace("  steps: 30\n", "  steps: 30\n  learning_rate: 1.0e+30\n")
    # With a check, output weights would be solved for without these networks.
    study.write_text(text.replace("check: {first: 120, attempts: 1}", "check: null"))
    project.make("results/mini/report.html")
    outcomes = pd.read_parquet(project.path("results/mini/tables/outcomes.parquet")).set_index("step")
    assert outcomes["status"].to_dict() == {
        "simulate": "ok",
        "identify": "ok",
        "train": "failed",
        "regress": "skipped",
        "refine": "warning",
        "score": "ok",
    }
    assert "no longer finite" in outcomes.loc["train", "reason"]
    assert "only one of the two routes" in outcomes.loc["refine", "reason"]
    rrmse = pd.read_parquet(project.path("results/mini/tables/rrmse.parquet")).set_index("method")
    assert np.isnan(rrmse["rrmse"]["regression"]) and not rrmse["certified"].any()
    assert rrmse["rrmse"]["refined"] < 1e-6  # V needs no networks, but the study asks for a second route
    page = project.path("results/mini/report.html").read_text(encoding="utf-8")
    assert "no longer finite" in page and "✗" in page and "✓" not in page
