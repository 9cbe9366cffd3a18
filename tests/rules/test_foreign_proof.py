"""The second proof in miniature: random systems drawn, diagnosed without the keys, opened and scored."""

import pandas as pd
import pytest

from benchmarks.proof.foreign_scores.scores import COLUMNS

pytestmark = [pytest.mark.workflow, pytest.mark.slow]

SETTINGS = """\
proof: {cases: 1, seed: 1, shares: {"null": 1.0}}
proof_full: {cases: 1, seed: 1, shares: {"null": 1.0}}
proof_foreign_small: {cases: 3, seed: 7, batch: 2, shares: {"null": 0.34, shift: 0.33, withheld: 0.33}}
"""


def test_random_systems_are_drawn_diagnosed_and_scored(fresh_module_project):
    project = fresh_module_project
    project.path("study.yaml").write_text("{}")
    project.path("config/proof.yaml").write_text(SETTINGS)
    project.make("proof_foreign_small", study="config/config.yaml")
    folder = project.path("results/proof/proof_foreign_small")
    table = pd.read_parquet(folder / "tables/score.parquet")
    assert list(table.columns) == list(COLUMNS)
    assert sorted(table["kind"]) == ["null", "shift", "withheld"]
    assert (table["verdict"] != "failed").all() and table["oracle_error"].notna().all()
    assert "targets are met, in 3 cases" in (folder / "report.html").read_text()
    assert not (folder / "keys").exists() or not list((folder / "keys").rglob("*.json"))
