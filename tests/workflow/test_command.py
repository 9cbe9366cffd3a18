"""What can be written after ``siq``, and what is said when it cannot be done."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path
from typing import Any

import pytest

from siq.errors import version
from siq.workflow.answers import Exit, answer_of_page
from siq.workflow.command import main

ROWS = "recording,t [s],x [nm]\n" + "".join(f"a,{k},{k % 3}\n" for k in range(12))
CARD = "name: well\ntime_unit: s\nstates: {x: {unit: m}}\nequations: {x: -x}\n"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder in which one works, which is no checkout."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_version_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["--version"])
    assert ended.value.code == 0 and capsys.readouterr().out == f"siq {version()}\n"


@pytest.mark.parametrize("arguments", [[], ["rum", "x.csv"], ["inspect", "x.csv", "--", "-n"]])
def test_what_is_not_understood_ends_with_the_code_of_usage(arguments: list[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == Exit.USAGE


@pytest.mark.parametrize(
    ("arguments", "files", "parts"),
    [
        (["run", "measured.csv"], {"measurd.csv": ROWS}, ("measured.csv", "perhaps you meant 'measurd.csv'")),
        (["run", "archetype3"], {}, ("perhaps you meant 'archetype3d",)),
        (["run", "{x}.csv"], {"{x}.csv": ROWS}, ("{x}.csv: the name has braces; rename the file",)),
        (["run", "~root.csv"], {"root.csv": ROWS}, ("~root.csv: there is no file", "'root.csv'")),
        (["verify", "results/mine"], {}, ("results/mine: there are no results; name a folder",)),
        (["run", "no/where.csv"], {}, ("there is no folder", "/no")),
        (["run", "card.yaml"], {"card.yaml": CARD}, ("the card of a system", "'system: card.yaml'")),
        (["run", "."], {"system.yaml": CARD}, ("siq diagnose .",)),
        (["run", "study.yaml"], {"study.yaml": "name: s\nrecodings: {}\n"}, ("line 2", "'recordings'")),
        (["run", "bad.csv"], {"bad.csv": "recording,t,x\na,0,one\n"}, ("bad.csv, row 1, column x",)),
        (["run", "good.csv", "--cores", "many"], {"good.csv": ROWS}, ("'many' is not a number of cores",)),
        (["diagnose", "nowhere"], {}, ("there is no file or folder",)),
        (["init", "study.yaml"], {"study.yaml": "name: s\n"}, ("a study already", "siq run study.yaml")),
        (["inspect", "nowhere.csv"], {}, ("nowhere.csv",)),
    ],
)
def test_a_fault_is_one_sentence_and_nothing_is_written(
    folder: Path,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    files: dict[str, str],
    parts: tuple[str, ...],
) -> None:
    for name, text in files.items():
        (folder / name).write_text(text)
    assert main(arguments) == Exit.FAULT
    said = capsys.readouterr()
    assert said.out == "" and said.err.count("\n") == 1
    for part in parts:
        assert part in said.err
    assert sorted(path.name for path in folder.iterdir()) == sorted(files)


def test_without_the_workflow_one_sentence_says_what_to_install(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (folder / "good.csv").write_text(ROWS)
    found = importlib.util.find_spec

    def without_snakemake(name: str, *rest: Any) -> Any:
        return None if name == "snakemake" else found(name, *rest)

    monkeypatch.setattr(importlib.util, "find_spec", without_snakemake)
    assert main(["run", "good.csv"]) == Exit.FAULT
    assert "pip install 'quasipotential[workflow]'" in capsys.readouterr().err
    assert main(["inspect", "good.csv"]) == Exit.ANSWERED


def test_a_file_is_inspected(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "good.csv").write_text(ROWS)
    assert main(["inspect", "good.csv"]) == Exit.ANSWERED
    said = capsys.readouterr().out
    assert "good.csv" in said and "1 recording" in said and "nm" in said


@pytest.mark.parametrize(
    ("answer", "code", "words"),
    [
        (
            {"formulas": 1, "runs": 1, "failed": 0, "certified": "all"},
            Exit.ANSWERED,
            "passed its certificate",
        ),
        ({"formulas": 1, "runs": 1, "failed": 0, "certified": "none"}, Exit.ANSWERED, "No formula passed"),
        ({"formulas": 2, "runs": 3, "failed": 1, "certified": "some"}, Exit.ANSWERED, "1 of 3 runs failed"),
        (
            {"formulas": 0, "runs": 1, "failed": 0, "certified": "none", "states": 3},
            Exit.ANSWERED,
            "the states and their times are the answer",
        ),
        (
            {"formulas": 0, "runs": 1, "failed": 1, "certified": "none"},
            Exit.NO_ANSWER,
            "No formula was found",
        ),
        ({"verdict": "no mismatch", "compared": True}, Exit.ANSWERED, "Two states."),
        ({"verdict": "unexplained", "compared": False}, Exit.NO_ANSWER, "Two states."),
    ],
)
def test_the_answer_beside_a_page_is_told_and_gives_the_code(
    tmp_path: Path, answer: dict[str, Any], code: Exit, words: str
) -> None:
    (tmp_path / "answer.json").write_text(json.dumps({"sentence": "Two states."} | answer))
    lines, told = answer_of_page(tmp_path / "report.html")
    assert told == code and words in " ".join(lines) and lines[0] == "Two states."
