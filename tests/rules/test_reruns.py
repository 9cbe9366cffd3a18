"""What runs again after a change, and what does not; what an interruption costs."""

import json
import os
import re
import shutil
import signal
import time
from pathlib import Path

import pandas as pd
import pytest

from benchmarks import faults
from siq.remarks import sentence
from siq.workflow.verification import verify

pytestmark = pytest.mark.workflow

ROOT = Path(__file__).resolve().parents[2]

DATA = "results/mini/runs/000/recordings.parquet"
NETWORKS = "results/mini/training/000-000/networks.npz"
MODEL = "results/mini/runs/000/model.json"


def append(path, text="\n# edited\n"):
    path.write_text(path.read_text() + text)


def would_run(project, *paths, change):
    """The rules that would make the model of a run again if files had changed; they are put back."""
    before = [(path, path.read_text(), path.stat()) for path in paths]
    change()
    planned = project.make("--dry-run", MODEL)
    for path, text, seen in before:
        path.write_text(text)
        os.utime(path, ns=(seen.st_atime_ns, seen.st_mtime_ns))
    table = planned.partition("Job stats:")[2].partition("total")[0]
    return {line.split()[0] for line in table.splitlines() if line and line.split()[-1].isdigit()}


def test_only_what_depends_on_a_change_runs_again(finished, tmp_path):
    project = finished.copied(tmp_path / "project")
    shutil.copytree(ROOT / "siq", project.path("siq"))
    study, card = project.path("study.yaml"), project.path("config/systems/archetype3d.yaml")
    versions = project.path("workflow/versions.json")
    regression = project.path("siq/networks/regression.py")
    dynamics = project.path("siq/systems/simulation.py")
    page = project.path("siq/report/study_page.py")

    def what_no_model_depends_on():
        append(page)
        card.write_text(card.read_text().replace("Archetypal model", "Renamed model"))
        append(regression)  # what its results are is said by the version of its task alone
        os.utime(dynamics)

    def raise_regress():
        known = json.loads(versions.read_text())
        known["regress"]["version"] += 1
        versions.write_text(json.dumps(known))

    unchanged = (page, card, dynamics, regression)
    assert would_run(project, *unchanged, change=what_no_model_depends_on) == set()
    assert would_run(project, versions, change=raise_regress) == {"regress", "refine"}
    steps = would_run(project, study, change=lambda: project.write_study(runs=2, steps=130))
    assert steps == {"train", "regress", "refine"}
    threshold = would_run(project, study, change=lambda: project.write_study(runs=2, threshold=0.2))
    assert threshold == {"regress", "refine"}


@pytest.mark.slow
def test_a_training_without_a_check_goes_on_when_its_steps_are_raised(finished, tmp_path):
    project = finished.copied(tmp_path / "project")
    study, kept = project.path("study.yaml"), (DATA, "results/mini/runs/000/vector_field.json")
    before, trained = project.modified(*kept), []
    for steps in (4, 6):
        project.write_study(runs=2, steps=steps)
        checked = "check: {first: 120, attempts: 1}\n  output_weights: 200\n"
        study.write_text(study.read_text().replace(checked, "check: null\n"))
        project.make(NETWORKS)
        log = project.path("results/mini/logs/000-000/train.log").read_text()
        trained.append([int(step) for step in re.findall(r"step (\d+) of", log)])
    assert trained == [[1, 2, 3, 4], [5, 6]]
    assert project.modified(*kept) == before


@pytest.mark.slow
def test_what_a_plan_says_a_run_does(finished, tmp_path):
    project = finished.copied(tmp_path / "project")
    before = project.modified(DATA, NETWORKS, MODEL)
    project.write_study(runs=2, threshold=0.2)
    project.make(MODEL)
    after = project.modified(DATA, NETWORKS, MODEL)
    assert [new != old for new, old in zip(after, before, strict=True)] == [False, False, True]


def test_damaged_results_are_found_and_made_again(finished, tmp_path):
    project = finished.copied(tmp_path / "project")
    results, page = project.path("results/mini"), "results/mini/report.html"
    assert "differs" not in [kind for kind, _ in verify(results)]
    whole = project.path(MODEL).read_bytes()
    place = whole.index(b'"coefficients"') + 25
    project.path(MODEL).write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
    project.path(page).write_text("")
    told = [sentence(remark) for kind, remark in verify(results) if kind == "differs"]
    assert told == [f"{project.path(name)} is not as it was written" for name in (MODEL, page)]
    output = project.make(MODEL)
    for name in (MODEL, page):
        assert f"{name} is not as it was written; it is made again." in output
    assert project.path(MODEL).read_bytes() == whole
    assert not project.path(page).exists()  # nobody asked for it


@pytest.mark.skipif(not Path("/proc/self/environ").exists(), reason="processes are found under /proc")
def test_no_process_outlives_siq(tmp_path):
    faults.recordings(tmp_path / "record.csv")
    process = faults.start(tmp_path, tmp_path.name)
    deadline = time.monotonic() + 300
    while not (tmp_path / "results/record/logs/000/draw.log").exists():
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.02)
    assert len(faults.processes(tmp_path.name)) > 2
    process.kill()
    process.communicate()
    deadline = time.monotonic() + faults.PATIENCE
    while faults.processes(tmp_path.name) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert faults.processes(tmp_path.name) == {}


def wait_for(pattern, process, *, within, seconds=600):
    deadline = time.monotonic() + seconds
    while not any(within.glob(pattern)):
        assert process.returncode is None and time.monotonic() < deadline, f"{pattern} never appeared"
        time.sleep(0.02)


@pytest.mark.parametrize("how", [signal.SIGKILL, pytest.param(signal.SIGINT, marks=pytest.mark.slow)])
def test_an_interrupted_workflow_resumes_and_gives_the_same_tables(finished, tmp_path, how):
    """Interrupted while it trains one of two runs; the other has ended."""
    project = finished.copied(tmp_path / "project")
    for folder in ("training/000-000", "tables"):
        shutil.rmtree(project.path(f"results/mini/{folder}"))
    for name in ("regression", "model"):
        project.path(f"results/mini/runs/000/{name}.json").unlink()
    process = project.start("results/mini/tables/summary.parquet")
    wait_for("results/mini/training/000-000/kept-*.npz", process, within=project.folder)
    os.killpg(process.pid, how)
    process.output(timeout=60)
    assert process.returncode != 0
    project.make("results/mini/tables/summary.parquet")
    for name in ("coefficients", "rrmse", "outcomes", "training", "summary"):
        path = f"results/mini/tables/{name}.parquet"
        pd.testing.assert_frame_equal(
            pd.read_parquet(project.path(path)), pd.read_parquet(finished.path(path)), check_exact=True
        )
        assert project.path(path).read_bytes() == finished.path(path).read_bytes()


@pytest.mark.slow
def test_a_second_snakemake_waits_for_nobody_and_says_so(fresh_project):
    project = fresh_project
    project.write_study()
    process = project.start(DATA)
    wait_for("results/mini/logs/000/draw.log", process, within=project.folder)
    # Held where it is, or on a busy machine it may have ended before the second has begun.
    process.send_signal(signal.SIGSTOP)
    try:
        second = project.run(MODEL)
    finally:
        process.send_signal(signal.SIGCONT)
    assert second.returncode != 0 and "Another snakemake is at work" in second.stdout
    process.output(timeout=120)
    assert process.returncode == 0
