"""The command ``siq`` in a folder that is no checkout, from recordings to the page and to its exit code."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from siq.cli.examples import double_well_recordings

pytestmark = pytest.mark.workflow
ROOT = Path(__file__).resolve().parents[2]


def siq(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "siq.cli.main", *arguments],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=300,
    )


def test_a_study_becomes_a_page_in_the_folder_in_which_one_works(tmp_path: Path) -> None:
    work, data = tmp_path / "work", tmp_path / "my data"
    for folder in (work, data, work / "workflow", work / "config"):
        folder.mkdir()
    (work / "workflow" / "__init__.py").write_text("raise RuntimeError('another workflow')\n")
    (work / "config" / "config.yaml").write_text("samples: samples.tsv\n")
    (data / "traps.csv").write_text(double_well_recordings(2, 4000))
    (data / "study.yaml").write_text("name: traps\nrecordings: {file: traps.csv}\nlandscape: false\n")
    done = siq(
        work, "run", "../my data/study.yaml", "--cores", "2", "--", "--max-jobs-per-timespan", "100/1s"
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "The page to read: results/traps/report.html"
    assert (work / "results" / "traps" / "report.html").is_file()
    assert sorted(path.name for path in data.iterdir()) == ["study.yaml", "traps.csv"]
    assert "Reason:" not in done.stderr and len(done.stderr.splitlines()) < 10
    again = siq(work, "run", "../my data/study.yaml", "--dry-run")
    assert again.stdout == "Nothing would run: all is up to date.\n", again.stderr


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
    done = siq(tmp_path, "run", "growth.csv", "--cores", "2", "--", "--max-jobs-per-timespan", "100/1s")
    assert done.returncode == 3, done.stderr
    assert "No formula was found" in done.stderr + done.stdout
    again = siq(tmp_path, "run", "growth.csv")
    assert again.returncode == 3 and "No formula was found" in again.stdout
    assert again.stdout.endswith("The page to read: results/growth/report.html\n")
