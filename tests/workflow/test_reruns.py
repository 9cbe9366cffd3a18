"""What runs again after a change, and what does not; what an interruption costs."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pandas as pd
import pytest

from workflow.code_digest import code_digest

pytestmark = pytest.mark.workflow

ROOT = Path(__file__).resolve().parents[2]
SCRIPTS = sorted(path.name for path in (ROOT / "workflow" / "scripts").glob("*.py") if path.name != "step.py")
DATA = "results/mini/runs/000/recordings.parquet"
NETWORKS = "results/mini/training/000-000/networks.npz"
MODEL = "results/mini/runs/000/model.json"


def changed(project, edit):
    """Which of data, networks and model an edit makes again."""
    before = project.modified(DATA, NETWORKS, MODEL)
    edit()
    project.make(MODEL)
    return [new != old for new, old in zip(project.modified(DATA, NETWORKS, MODEL), before, strict=True)]


def append(path, text="\n# edited\n"):
    path.write_text(path.read_text() + text)


def test_only_what_depends_on_a_change_runs_again(fresh_project):
    project = fresh_project
    project.write_study()
    project.make(MODEL)
    assert changed(project, lambda: project.write_study(threshold=0.2)) == [False, False, True]
    assert changed(project, lambda: append(project.path("siq/networks/regression.py"))) == [
        False,
        False,
        True,
    ]
    assert changed(project, lambda: append(project.path("siq/report/sentences.py"))) == [False, False, False]
    card = project.path("config/systems/archetype3d.yaml")
    renamed = card.read_text().replace("Archetypal model", "Renamed model")
    assert changed(project, lambda: card.write_text(renamed)) == [False, False, False]
    assert changed(project, lambda: os.utime(project.path("siq/dynamics/simulation.py"))) == [
        False,
        False,
        False,
    ]
    assert changed(project, lambda: project.write_study(threshold=0.2, steps=130)) == [False, True, True]


# The libraries are imported once; each script then runs in a fork that says which files of ours it loaded.
IMPORTS = """
import json, os, pathlib, runpy, sys
import matplotlib.pyplot, numpy, pandas, pysindy, scipy, sympy, torch
root = pathlib.Path(sys.argv[1])
for script in sys.argv[2:]:
    if os.fork() == 0:
        runpy.run_path(str(root / "workflow" / "scripts" / script), run_name="imported")
        files = {getattr(module, "__file__", None) for module in list(sys.modules.values())}
        ours = [pathlib.Path(file).resolve() for file in files if file]
        ours = [str(file.relative_to(root)) for file in ours if file.is_relative_to(root)]
        print(json.dumps([script, ours]), flush=True)
        os._exit(0)
    if os.wait()[1]:
        sys.exit(f"{script} cannot be imported")
"""


@pytest.fixture(scope="module")
def imported():
    """The files of the project that each script imports, by the script's name."""
    done = subprocess.run(
        [sys.executable, "-c", IMPORTS, str(ROOT), *SCRIPTS],
        env=os.environ | {"PYTHONPATH": f"{ROOT}:{ROOT / 'workflow' / 'scripts'}"},
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    found = dict(json.loads(line) for line in done.stdout.splitlines())
    parts = ("siq", "workflow")
    return {name: {file for file in files if Path(file).parts[0] in parts} for name, files in found.items()}


@pytest.mark.xdist_group("imported")
@pytest.mark.parametrize("script", SCRIPTS)
def test_a_rule_names_every_module_that_its_script_imports(imported, script):
    assert imported[script], "the script imports nothing of the project"
    # How the interpreter was started changes nothing of what it computes.
    assert imported[script] - {"workflow/warm.py"} <= set(code_digest(ROOT, script))


def wait_for(pattern, process, *, within, seconds=120):
    deadline = time.monotonic() + seconds
    while not any(within.glob(pattern)):
        assert process.poll() is None and time.monotonic() < deadline, f"{pattern} never appeared"
        time.sleep(0.02)


@pytest.mark.parametrize("how", [signal.SIGKILL, pytest.param(signal.SIGINT, marks=pytest.mark.slow)])
def test_an_interrupted_workflow_resumes_and_gives_the_same_tables(fresh_project, finished, how):
    project = fresh_project
    project.write_study(runs=2)
    process = project.start("results/mini/report.html")
    wait_for("results/mini/training/000-000/kept-*.npz", process, within=project.folder)
    os.killpg(process.pid, how)
    process.communicate(timeout=60)
    assert process.returncode != 0
    project.make("results/mini/tables/summary.parquet")
    for name in ("coefficients", "rrmse", "outcomes", "training", "summary"):
        path = f"results/mini/tables/{name}.parquet"
        pd.testing.assert_frame_equal(
            pd.read_parquet(project.path(path)), pd.read_parquet(finished.path(path)), check_exact=True
        )
        assert project.path(path).read_bytes() == finished.path(path).read_bytes()


def test_a_second_snakemake_waits_for_nobody_and_says_so(fresh_project):
    project = fresh_project
    project.write_study()
    process = project.start(NETWORKS)
    wait_for("results/mini/logs/000/draw.log", process, within=project.folder)
    # Held where it is, or on a busy machine it may have ended before the second has begun.
    process.send_signal(signal.SIGSTOP)
    try:
        second = project.run(MODEL)
    finally:
        process.send_signal(signal.SIGCONT)
    assert second.returncode != 0 and "Another snakemake is at work" in second.stdout
    process.communicate(timeout=120)
    assert process.returncode == 0
