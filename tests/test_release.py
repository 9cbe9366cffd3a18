"""What surrounds the sources is complete: commands, schemas, workflows of CI, forms, papers of a release."""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from types import ModuleType
from typing import Any

import jsonschema
import pytest
import yaml
from coverage import Coverage

from benchmarks.mutation import MODULES
from siq.errors import InputError
from workflow.settings import Studies

ROOT = Path(__file__).parents[1]


def loaded(path: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(Path(path).stem, ROOT / path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def read(path: str) -> Any:
    return yaml.safe_load((ROOT / path).read_text(encoding="utf-8"))


# Commands.


@pytest.mark.parametrize("goals", [["help"], []], ids=["help", "plain"])
def test_make_says_of_every_command_what_it_does(goals: list[str]) -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    phony = re.search(r"^\.PHONY:((?:.*\\\n)*.*)$", makefile, flags=re.MULTILINE)
    assert phony is not None
    # As from a terminal: a make that tests run under says which folder it is in.
    alone = {name: value for name, value in os.environ.items() if not name.startswith(("MAKE", "MFLAGS"))}
    command = ["make", *goals]
    printed = subprocess.run(command, cwd=ROOT, env=alone, capture_output=True, text=True, check=True).stdout
    told = [line.split(maxsplit=2) for line in printed.splitlines()]
    assert [line[0] for line in told if line[0] != "make" or len(line) < 3] == []
    assert sorted(line[1] for line in told) == sorted(phony[1].replace("\\", " ").split())


def test_the_files_for_people_with_an_assistant_name_commands_that_there_are() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    targets = set(re.findall(r"^([a-z][a-z-]*):", makefile, flags=re.MULTILINE))
    for page in ("AGENTS.md", "CONTRIBUTING.md", ".github/pull_request_template.md"):
        text = (ROOT / page).read_text(encoding="utf-8")
        assert set(re.findall(r"(?:^|`)make ([a-z][a-z-]*)", text, flags=re.MULTILINE)) <= targets
        for link in re.findall(r"\]\((?!https?://|#)([^)#]+)", text):
            assert (ROOT / page).parent.joinpath(link).exists(), link
        paths = re.findall(r"`((?:siq|tests|workflow|benchmarks|config|docs|\.ci|\.test)/[\w/.-]*)`", text)
        made = ("NAME", "_build")
        assert [
            path for path in paths if not any(part in path for part in made) and not (ROOT / path).exists()
        ] == []


# Schemas of configuration.

SCHEMAS = loaded("docs/make/schemas.py")


@pytest.mark.parametrize("name", SCHEMAS.MODELS)
def test_schemas_are_those_of_the_classes(name: str) -> None:
    file = ROOT / "workflow" / "schemas" / f"{name}.schema.yaml"
    assert file.read_text(encoding="utf-8") == SCHEMAS.text(name), "run `make schemas`"


@pytest.mark.parametrize(
    ("name", "pattern"),
    [
        ("config", "config/config.yaml"),
        ("study", "config/studies/*.yaml"),
        ("system", "config/systems/*.yaml"),
        ("mismatch", "config/mismatch/*.yaml"),
        ("config", ".test/config/config.yaml"),
        ("study", ".test/config/studies/*.yaml"),
        ("system", ".test/config/systems/*.yaml"),
    ],
)
def test_schemas_take_what_the_classes_take(name: str, pattern: str) -> None:
    schema = read(f"workflow/schemas/{name}.schema.yaml")
    jsonschema.Draft202012Validator.check_schema(schema)
    files = sorted(ROOT.glob(pattern))
    assert files
    for file in files:
        jsonschema.validate(yaml.safe_load(file.read_text(encoding="utf-8")), schema)


def test_schemas_say_what_each_key_means_and_refuse_what_is_misspelt() -> None:
    for name in SCHEMAS.MODELS:
        schema = read(f"workflow/schemas/{name}.schema.yaml")
        assert [key for key, entry in schema["properties"].items() if not entry.get("description")] == []
    study = read("workflow/schemas/study.schema.yaml")
    jsonschema.validate({"name": "a", "system": "b", "training": False, "landscape": False}, study)
    with pytest.raises(jsonschema.ValidationError, match="sytem"):
        jsonschema.validate({"name": "a", "sytem": "b"}, study)


def test_the_configuration_is_checked_by_the_class_that_the_schema_is_of() -> None:
    assert set(read("config/config.yaml")) == set(read("workflow/schemas/config.schema.yaml")["properties"])
    assert Studies({"statistics": ["lake"]}, configfiles=[]).default_names() == ["lake"]
    for key, value in (("runs_per_training", 0), ("device", "gpu"), ("statistics", 3)):
        with pytest.raises(InputError, match=key):
            Studies({key: value}, configfiles=[])


@pytest.mark.workflow
def test_the_small_study_is_planned_from_a_folder_of_its_own(tmp_path: Path) -> None:
    shutil.copytree(ROOT / ".test" / "config", tmp_path / "config")
    command = [sys.executable, "-m", "snakemake", "-n", "--directory", str(tmp_path)]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    assert "results/two-wells/report.html" in run.stdout + run.stderr


# Where the project is kept.


def test_workflows_of_ci_call_what_people_call() -> None:
    for file in sorted((ROOT / ".github" / "workflows").glob("*.yml")):
        jobs = yaml.safe_load(file.read_text(encoding="utf-8"))["jobs"]
        runs = [step["run"] for job in jobs.values() for step in job["steps"] if "run" in step]
        assert runs and all((ROOT / run.split()[0]).stat().st_mode & 0o100 for run in runs), file.name


def test_ci_counts_branches_of_every_module_that_decides_and_has_a_floor() -> None:
    tools = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["coverage"]
    deciding = [module.replace(".", "/") + ".py" for module, _ in MODULES.values()]
    assert tools["run"]["branch"] and sorted(tools["run"]["include"]) == sorted(deciding)
    assert tools["report"]["fail_under"] > 90
    files = [ROOT / file for _, tests in MODULES.values() for file in tests.split()]
    assert [file for file in files if not file.exists()] == []
    suite = re.search(
        r"^suite:.*\n\t(.*)", (ROOT / "Makefile").read_text(encoding="utf-8"), flags=re.MULTILINE
    )
    assert suite is not None and "--cov" in suite[1].split()


def test_other_tests_are_not_slowed_down_by_it(request: pytest.FixtureRequest) -> None:
    if set(request.config.getoption("cov_source", None) or ()) - {True}:
        pytest.skip("`--cov=siq` counts in all tests")
    assert Coverage.current() is None  # this is none of those of a module that decides


def test_forms_ask_for_what_inspect_prints() -> None:
    forms = sorted((ROOT / ".github" / "ISSUE_TEMPLATE").glob("[0-9]*.yml"))
    assert forms
    for form in forms:
        content = yaml.safe_load(form.read_text(encoding="utf-8"))
        assert content["name"] and content["description"]
        fields = [field for field in content["body"] if field["type"] != "markdown"]
        assert len({field["id"] for field in fields}) == len(fields)
        assert any("siq inspect" in field["attributes"]["label"] for field in fields), form.name


# A release.


def test_the_papers_of_a_release_agree() -> None:
    checklist = loaded(".ci/release_check.py")
    for check in (checklist.versions, checklist.recipe, checklist.schemas):
        check()


def test_the_checklist_finds_what_was_forgotten(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    checklist = loaded(".ci/release_check.py")
    monkeypatch.setattr(checklist, "ROOT", tmp_path)
    papers = {
        "pyproject.toml": '[project]\nname = "a"\nversion = "0.2.0"\n',
        "CITATION.cff": 'version: 0.2.0\ndate-released: "2026-12-01"\n',
        "CHANGELOG.md": "## [0.2.0] - 2026-12-01\n",
    }
    for name, text in papers.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    checklist.versions(installed="0.2.0")
    checklist.dates()
    for name, old, new, said in (
        ("CITATION.cff", "0.2.0", "0.1.0", "CITATION.cff"),
        ("CHANGELOG.md", "0.2.0", "0.1.0", "CHANGELOG.md"),
    ):
        (tmp_path / name).write_text(papers[name].replace(old, new), encoding="utf-8")
        with pytest.raises(checklist.Missing, match=said):
            checklist.versions(installed="0.2.0")
        (tmp_path / name).write_text(papers[name], encoding="utf-8")
    with pytest.raises(checklist.Missing, match="installed"):
        checklist.versions(installed="0.1.0")
    (tmp_path / "CHANGELOG.md").write_text("## [0.2.0] - unreleased\n", encoding="utf-8")
    with pytest.raises(checklist.Missing, match="unreleased"):
        checklist.dates()
