"""The command ``siq`` in a folder that is no checkout, from recordings to the page and to its exit code."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

pytestmark = pytest.mark.workflow
ROOT = Path(__file__).resolve().parents[2]


def siq(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "siq", *arguments],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=300,
    )


def two_wells() -> str:
    """Recordings of ``dx/dt = x - x³, dy/dt = -y`` as a CSV file, by its solution."""
    t, starts = np.linspace(0, 3, 61), np.random.default_rng(0).uniform(-1.5, 1.5, (60, 2))
    rows = ["recording,t,x,y"]
    for k, (first, second) in enumerate(starts):
        x = first / np.sqrt(first**2 + (1 - first**2) * np.exp(-2 * t))
        y = second * np.exp(-t)
        rows += [
            f"r{k},{at:.2f},{one!r},{two!r}" for at, one, two in zip(t, x.tolist(), y.tolist(), strict=True)
        ]
    return "\n".join(rows) + "\n"


def test_recordings_become_a_page_in_the_folder_in_which_one_works(tmp_path: Path) -> None:
    """Without a card and without networks, from a study beside the recordings."""
    work, data = tmp_path / "work", tmp_path / "my data"
    for folder in (work, data, work / "workflow", work / "config"):
        folder.mkdir()
    (work / "workflow" / "__init__.py").write_text("raise RuntimeError('another workflow')\n")
    (work / "config" / "config.yaml").write_text("samples: samples.tsv\n")
    (data / "wells.csv").write_text(two_wells())
    (data / "study.yaml").write_text("name: wells\nrecordings: {file: wells.csv}\n")
    done = siq(work, "run", "../my data/study.yaml", "--cores", "2")
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "The page to read: results/wells/report.html"
    assert (work / "results" / "wells" / "report.html").is_file()
    assert sorted(path.name for path in data.iterdir()) == ["study.yaml", "wells.csv"]
    assert "Reason:" not in done.stderr and len(done.stderr.splitlines()) < 10
    again = siq(work, "run", "../my data/study.yaml", "--dry-run")
    assert again.stdout == "Nothing would run: all is up to date.\n", again.stderr
    results = work / "results" / "wells"
    page = (results / "report.html").read_text(encoding="utf-8")
    assert "The recordings show two stable states" in page
    assert '<th scope="col">exact' not in page.lower()  # nobody knows it
    landscape = pd.read_parquet(results / "tables" / "landscape.parquet")
    assert list(landscape["kind"]) == ["attractor", "saddle", "attractor", "transition", "transition"]
    ways = landscape[landscape["kind"] == "transition"]
    np.testing.assert_allclose(ways["barrier"], 0.5, atol=1e-4)  # of U = x⁴/2 - x² + y² + 1/2
    np.testing.assert_allclose(ways["minimum_action"], 0.5, atol=1e-4)
    assert not (results / "tables" / "escape.parquet").exists()
    # Nobody asked for networks, and nothing says that they failed.
    assert not (results / "training").exists() and "published method" not in page
    outcomes = pd.read_parquet(results / "tables" / "outcomes.parquet")
    assert not set(outcomes["step"]) & {"train", "regress"}


def test_a_job_that_refuses_its_input_is_heard_and_nothing_else(tmp_path: Path) -> None:
    """Bad input that only the workflow sees: one sentence, and a code."""
    (tmp_path / "study.yaml").write_text("name: s\nsystem: archetype4\n")
    done = siq(tmp_path, "run", "study.yaml")
    assert done.returncode == 1 and done.stdout == ""
    assert "perhaps you meant 'archetype4d'" in done.stderr and "Traceback" not in done.stderr
    assert not (tmp_path / "results").exists()


@pytest.mark.slow  # CI has the exit codes from tests/cli
def test_a_run_without_a_formula_is_no_success(tmp_path: Path) -> None:
    """Growth without a stable state: there is a page, a sentence and a code, by the workflow itself, too."""
    rows = [f"r{k},{i / 20},{(k - 4.5) * 1.025**i!r}" for k in range(10) for i in range(60)]
    (tmp_path / "growth.csv").write_text("\n".join(["recording,t,x", *rows]) + "\n")
    done = siq(tmp_path, "run", "growth.csv", "--cores", "2")
    assert done.returncode == 3, done.stderr
    assert "No formula was found" in done.stderr + done.stdout
    again = siq(tmp_path, "run", "growth.csv")
    assert again.returncode == 3 and "No formula was found" in again.stdout
    assert again.stdout.endswith("The page to read: results/growth/report.html\n")
