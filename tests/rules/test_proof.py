"""The proof in miniature: concealed, diagnosed without the keys, opened and scored."""

import json

import pandas as pd
import pytest

from benchmarks.proof.concealment.cases import Design, make_case
from benchmarks.proof.scoring import COLUMNS

pytestmark = [pytest.mark.workflow, pytest.mark.slow]

SETTINGS = """\
proof: {{cases: {cases}, seed: {seed}, batch: 3, shares: {{"null": 0.4, shift: 0.2, mechanism: 0.4}}}}
proof_full: {{cases: 1, seed: 1, shares: {{"null": 1.0}}}}
"""


@pytest.fixture(scope="module")
def proven(fresh_module_project):
    project = fresh_module_project
    project.path("study.yaml").write_text("{}")
    project.path("config/proof.yaml").write_text(SETTINGS.format(cases=5, seed=3))
    project.make("proof", study="config/config.yaml")
    return project


def test_every_case_is_scored_and_the_page_says_so(proven):
    table = pd.read_parquet(proven.path("results/proof/proof/tables/score.parquet"))
    assert list(table.columns) == list(COLUMNS)
    assert sorted(table["kind"]) == ["mechanism", "mechanism", "null", "null", "shift"]
    assert not table["false_alarm"].any() and (table["verdict"] != "failed").all()
    assert "targets are met, in 5 cases" in proven.path("results/proof/proof/report.html").read_text()


def test_of_the_keys_only_digests_are_left(proven):
    folder = proven.path("results/proof/proof")
    digests = json.loads((folder / "digests.json").read_text())
    assert sorted(digests) == [f"case-{number:04d}" for number in range(1, 6)]
    assert all(len(digest) == 64 for digest in digests.values())
    assert not (folder / "keys").exists() or not list((folder / "keys").rglob("*.json"))
    cases = {path.name for path in (folder / "cases").rglob("*") if path.is_file()}
    assert cases - {".snakemake_timestamp"} == {"system.yaml", "study.yaml", "recordings.parquet"}


def test_other_keys_than_those_published_are_refused(proven):
    folder = proven.path("results/proof/proof")
    digests = json.loads((folder / "digests.json").read_text())
    (folder / "digests.json").write_text(json.dumps(digests | {"case-0002": "0" * 64}))
    # Only the keys are opened again: the diagnosis has ended.
    done = proven.run(
        "results/proof/proof/keys/000",
        "--allowed-rules", "open_keys", "--rerun-triggers", "mtime", "--force",
        study="config/config.yaml",
    )  # fmt: skip
    assert done.returncode != 0
    assert "case-0002: the key is not the one whose digest was published" in done.stdout


def test_cases_of_somebody_else_are_scored(proven):
    cases, keys = proven.path("theirs"), proven.path("their-keys")
    design = Design("mine", "oscillator", "mechanism", "cubic stiffness", True, 0.15, 40.0, (), 8)
    make_case(design).write(design.name, cases=cases, keys=keys)
    (keys / "mine.npz").unlink()  # arrays are welcome, not asked for
    proven.make("blind_test", "--config", f"cases={cases}", f"keys={keys}", study="config/config.yaml")
    table = pd.read_parquet(proven.path("results/blind-test/tables/score.parquet"))
    assert list(table["named"]) == ["cubic stiffness"] and table["truth_in_class"].all()
    assert "Blind test" in proven.path("results/blind-test/report.html").read_text()
