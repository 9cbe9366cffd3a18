"""Diagnoses as workflows: a folder of cases, and what is said of folders that cannot be used."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from siq.errors import InputError
from workflow.cases import CARD, STUDY, Cases
from workflow.files import read_table

CARD_TEXT = """\
name: spring
title: A mass on a spring
time_unit: s
states:
  x: {unit: mm, domain: [-2, 2]}
  v: {unit: mm/s, domain: [-2, 2]}
parameters:
  k: {value: 1.05, unit: 1/s**2}
  d: {value: 0.2, unit: 1/s}
equations:
  x: v
  v: -k*x - d*v
outputs: {x: x, v: v}
"""


def rows(recordings: int = 6, samples: int = 80) -> str:
    """Recordings of a spring with a cubic part, as a CSV file."""
    generator, step = np.random.default_rng(3), 0.02
    lines = ["recording,t [s],x [mm],v [mm/s]"]
    for label in range(recordings):
        x, v = generator.uniform(-1.5, 1.5, 2)
        for sample in range(samples):
            noise = generator.normal(scale=0.01, size=2)
            lines.append(f"r{label},{sample * 0.1:.1f},{x + noise[0]},{v + noise[1]}")
            for _ in range(5):
                v += step * (-x - 0.2 * v - 0.8 * x**3)
                x += step * v
    return "\n".join(lines) + "\n"


def write_case(folder: Path, *, card: str | None = CARD_TEXT, recordings: str | None = None) -> Path:
    folder.mkdir(parents=True)
    if card is not None:
        (folder / CARD).write_text(card)
    if recordings != "":
        (folder / "recordings.csv").write_text(recordings or rows())
    return folder


@pytest.mark.workflow
@pytest.mark.slow
def test_a_folder_of_cases_is_diagnosed(fresh_project, tmp_path):
    folder = write_case(tmp_path / "cases" / "spring")
    (folder / STUDY).write_text("title: A spring of mine\nheld_out: [r5]\n")
    (tmp_path / "cases" / "notes").mkdir()
    fresh_project.write_study()
    fresh_project.make("diagnose", "--config", f"cases={tmp_path / 'cases'}", study="config/config.yaml")
    results = fresh_project.path("results/mismatch/spring")
    verdict = json.loads((results / "verdict.json").read_text())
    assert verdict["verdict"] == "missing physics"
    assert [each["name"] for each in verdict["mechanisms"]] == ["cubic stiffness"]
    page = (results / "report.html").read_text()
    assert "A spring of mine" in page and "cubic stiffness" in page
    for name in ("curves", "candidates", "held_out", "forces", "noise", "wells", "escape"):
        read_table(results / "tables" / f"{name}.parquet")
        assert (results / "tables" / f"{name}.csv").exists()
    assert (results / "system.yaml").exists() and (results / "figures" / "map.svg").exists()
    # A new title draws a new page; it diagnoses nothing again.
    (folder / STUDY).write_text("title: Another title\nheld_out: [r5]\n")
    before = (results / "verdict.json").stat().st_mtime_ns
    fresh_project.make("diagnose", "--config", f"cases={tmp_path / 'cases'}", study="config/config.yaml")
    assert "Another title" in (results / "report.html").read_text()
    assert (results / "verdict.json").stat().st_mtime_ns == before


def test_who_asks_for_such_a_benchmark_is_told_what_to_get(monkeypatch):
    monkeypatch.delenv("SIQ_RECORDINGS", raising=False)
    with pytest.raises(InputError, match="SIQ_RECORDINGS"):
        Cases({"mismatch": ["silverbox"]}).raw_file("silverbox")


def test_no_folder_is_told_with_its_remedy():
    with pytest.raises(InputError, match="--config, cases: no folder is given; write --config cases=DIR"):
        Cases({}).in_folder()


@pytest.mark.workflow
def test_a_bad_folder_is_told_in_one_sentence(fresh_project):
    write_case(fresh_project.path("broken") / "a", card=CARD_TEXT.replace("-k*x", "-kappa*x"))
    parts = ("broken/a/system.yaml, line 12 (equations.v)", "'kappa' is not declared")
    done = fresh_project.run("diagnose", "--config", "cases=broken", study="config/config.yaml")
    assert done.returncode != 0
    assert "Traceback" not in done.stdout
    assert not fresh_project.path("results").exists()
    (line,) = [line for line in done.stdout.splitlines() if parts[0] in line]
    for part in parts:
        assert part in line


@pytest.mark.workflow
def test_a_benchmark_that_was_not_downloaded_is_told_and_the_rest_runs(fresh_project, monkeypatch):
    monkeypatch.delenv("SIQ_RECORDINGS", raising=False)
    done = fresh_project.run("mismatch", "--dry-run", study="config/config.yaml")
    assert done.returncode == 0, done.stdout[-2000:]
    assert "get SNLS80mV.csv of the Silverbox from nonlinearbenchmark.org" in done.stdout


@pytest.mark.parametrize(
    ("files", "study", "parts"),
    [
        ({"card": None}, None, ("it has no card of the simulation", "add system.yaml")),
        ({"recordings": ""}, None, ("it has no recordings", "recordings.csv")),
        ({"recordings": "recording,t,x\na,0,1\n"}, None, ("recordings.csv", "v")),
        ({}, "helt_out: [r1]\n", ("study.yaml, line 1 (helt_out)", "perhaps you meant 'held_out'")),
        ({}, "held_out: [r77]\n", ("study.yaml", "held_out", "no recording is called 'r77'")),
        ({}, "without: [friction]\n", ("study.yaml", "without", "no mechanism is called 'friction'")),
    ],
)
def test_a_bad_case_is_told_with_its_file_place_and_remedy(tmp_path, files, study, parts):
    folder = write_case(tmp_path / "a", **files)
    if study is not None:
        (folder / STUDY).write_text(study)
    with pytest.raises(ValueError) as refused:
        Cases({"cases": str(tmp_path)}).in_folder()
    for part in parts:
        assert part in str(refused.value)


@pytest.mark.parametrize(
    ("folder", "parts"),
    [
        ("nowhere", ("nowhere: there is no such folder",)),
        (".", (".: no folder in it is a case", "system.yaml")),
    ],
)
def test_a_folder_without_cases_is_told_with_its_remedy(tmp_path, monkeypatch, folder, parts):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError) as refused:
        Cases({"cases": folder}).in_folder()
    for part in parts:
        assert part in str(refused.value)


def test_folders_that_cannot_name_results_are_refused(tmp_path, monkeypatch):
    write_case(tmp_path / "my case")
    with pytest.raises(ValueError, match="cannot be the name of files; use letters"):
        Cases({"cases": str(tmp_path)}).in_folder()


def test_a_study_finds_recordings_in_the_folder_of_resources(tmp_path, monkeypatch):
    write_case(tmp_path / "data")
    project = tmp_path / "project"
    (project / "config" / "mismatch").mkdir(parents=True)
    (project / "config" / "mismatch" / "mine.yaml").write_text(
        f"system: {tmp_path}/data/system.yaml\nrecordings: data/recordings.csv\n"
    )
    monkeypatch.chdir(project)
    monkeypatch.setenv("SIQ_RECORDINGS", str(tmp_path))
    names, missing = Cases({"mismatch": ["mine"]}).listed()
    assert (names, missing) == (["mine"], [])
    assert Cases({"mismatch": ["mine"]})["mine"].recordings == str(tmp_path / "data" / "recordings.csv")


def test_a_study_without_its_system_is_refused(tmp_path, monkeypatch):
    (tmp_path / "config" / "mismatch").mkdir(parents=True)
    (tmp_path / "config" / "mismatch" / "mine.yaml").write_text("recordings: x.csv\n")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match="the key 'system' is missing"):
        Cases({"mismatch": ["mine"]}).listed()
