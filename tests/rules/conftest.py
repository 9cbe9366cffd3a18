"""A copy of the project in which workflows run, so that tests may edit it."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

import pytest
from forked import Snakemake

ROOT = Path(__file__).resolve().parents[2]
STUDY = """\
name: mini
title: A miniature
system: archetype3d
runs: {runs}
seed: 7
published: archetype3d
simulation: {{trajectories: 80, pairs: 20, pair_step: 0.01, interval: 0.1}}
training:
  widths: [12, 12]
  steps: {steps}
  batch_size: 64
  check: {{first: 120, attempts: 1}}
  output_weights: 200
  decay_steps: 1000
  orthogonality_weight: 10
  representative_share: 0
  relative_dynamics: false
  normalise_on: pairs
  potential_gain: 1
  precision: float32
  matching: symmetric
  thinning_distance: 0.2
regression:
  degree: 4
  threshold: {threshold}
  threshold_on: coefficient
  level: 2.0
landscape: false
"""


@dataclass(frozen=True)
class Project:
    """A checkout of its own."""

    folder: Path

    def write_study(self, *, runs: int = 1, steps: int = 120, threshold: float = 0.1) -> None:
        self.path("study.yaml").write_text(STUDY.format(runs=runs, steps=steps, threshold=threshold))

    def path(self, name: str) -> Path:
        return self.folder / name

    def copied(self, folder: Path) -> Project:
        """The same with all that it has made, to be changed."""
        return Project(Path(shutil.copytree(self.folder, folder)))

    def start(self, *arguments: str, study: str = "study.yaml") -> Snakemake:
        number, output = tempfile.mkstemp(suffix=".txt", dir=self.folder.parent)
        os.close(number)
        return Snakemake(
            ["--cores", "2", *arguments, "--configfile", study],
            folder=self.folder, path=[ROOT], output=Path(output),
        )  # fmt: skip

    def run(self, *arguments: str, study: str = "study.yaml") -> subprocess.CompletedProcess[str]:
        process = self.start(*arguments, study=study)
        output = process.output(timeout=600)
        assert process.returncode is not None
        return subprocess.CompletedProcess(process.args, process.returncode, output)

    def make(self, *arguments: str, study: str = "study.yaml") -> str:
        done = self.run(*arguments, study=study)
        assert done.returncode == 0, done.stdout[-4000:]
        return done.stdout

    def modified(self, *names: str) -> list[int]:
        return [self.path(name).stat().st_mtime_ns for name in names]


def copy_project(folder: Path) -> Project:
    folder.mkdir(parents=True)
    for name in ("Snakefile", "pyproject.toml"):  # the latter has the version that the page tells
        shutil.copy(ROOT / name, folder)
    # The library is that of the checkout, whose compiled loops are there already.
    for name in ("workflow", "benchmarks", "profiles", "config"):
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    return Project(folder)


@pytest.fixture
def fresh_project(tmp_path: Path) -> Project:
    """A project in which nothing has been run."""
    return copy_project(tmp_path / "project")


@pytest.fixture(scope="module")
def fresh_module_project(tmp_path_factory: pytest.TempPathFactory) -> Project:
    """A copy of the project that the tests of one file share."""
    return copy_project(tmp_path_factory.mktemp("module") / "project")


@pytest.fixture(scope="session")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Project:
    """A project whose miniature of two runs has ended; tests look at it and leave it as it is."""
    project = copy_project(tmp_path_factory.mktemp("finished") / "project")
    project.write_study(runs=2)
    project.make("results/mini/report.html")
    return project
