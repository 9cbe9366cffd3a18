"""What runs again after a change, and what does not; what an interruption costs."""

import json
import os
import shutil
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
    study, card = project.path("study.yaml"), project.path("config/systems/archetype3d.yaml")
    regression = project.path("siq/networks/regression.py")
    dynamics = project.path("siq/systems/simulation.py")
    page = project.path("siq/report/study_page.py")

    def what_no_model_depends_on():
        append(page)
        card.write_text(card.read_text().replace("Archetypal model", "Renamed model"))
        os.utime(dynamics)

    assert would_run(project, page, card, dynamics, change=what_no_model_depends_on) == set()
    assert would_run(project, regression, change=lambda: append(regression)) == {"regress", "refine"}
    steps = would_run(project, study, change=lambda: project.write_study(runs=2, steps=130))
    assert steps == {"train", "regress", "refine"}
    threshold = would_run(project, study, change=lambda: project.write_study(runs=2, threshold=0.2))
    assert threshold == {"regress", "refine"}


@pytest.mark.slow
def test_what_a_plan_says_a_run_does(finished, tmp_path):
    project = finished.copied(tmp_path / "project")
    before = project.modified(DATA, NETWORKS, MODEL)
    project.write_study(runs=2, threshold=0.2)
    project.make(MODEL)
    after = project.modified(DATA, NETWORKS, MODEL)
    assert [new != old for new, old in zip(after, before, strict=True)] == [False, False, True]


# Each file is loaded once, and what it imports while it is loaded is noted: a script has loaded its own
# imports and, from one to the next, those of what it imports.
IMPORTS = """
import builtins, importlib, json, pathlib, runpy, sys
root, usual = pathlib.Path(sys.argv[1]), builtins.__import__
imported = {}

def noted(name, given=None, local=None, members=(), level=0):
    found = usual(name, given, local, members, level)
    whole = (given or {}).get("__package__") if level else name
    parts = [whole] if not level else [f"{whole}.{name}".rstrip(".")]
    parts += [f"{parts[0]}.{each}" for each in members or ()]
    imported.setdefault((given or {}).get("__file__"), []).extend(parts)
    return found

def files(name):
    parts = name.split(".")
    modules = [sys.modules.get(".".join(parts[: k + 1])) for k in range(len(parts))]
    return [module.__file__ for module in modules if getattr(module, "__file__", None)]

def loaded_by(file):
    seen, waiting = set(), [file]
    while waiting:
        file = waiting.pop()
        if file not in seen and pathlib.Path(file).is_relative_to(root):
            seen.add(file)
            waiting += [each for name in imported.get(file, ()) for each in files(name)]
    return sorted(str(pathlib.Path(file).relative_to(root)) for file in seen)

builtins.__import__ = noted
for script in sys.argv[2:]:
    path = str(root / "workflow" / "scripts" / script)
    runpy.run_path(path, run_name="imported")
    print(json.dumps([script, loaded_by(path)]), flush=True)
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
    process = project.start(DATA)
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
