"""Versions of tasks, and the digests of their code, which say when a version was forgotten."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from workflow import versions
from workflow.tasks import TASKS

ROOT = Path(__file__).resolve().parents[2]


def imported_by(task: str) -> set[str]:
    return {path.relative_to(ROOT).as_posix() for path in versions.files_of_task(task)}


def test_who_changes_code_says_which_results_it_changes() -> None:
    forgotten = versions.changed()
    assert not forgotten, (
        f"the code of {', '.join(forgotten)} has changed: run `python -m workflow.versions --raise TASK ...`"
        " for those whose results may change, or `python -m workflow.versions --same` where none does"
    )


def test_every_task_has_a_version_and_no_other() -> None:
    assert set(versions.versions()) == set(TASKS)


def test_versions_are_raised_by_name_and_kept_otherwise(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "versions.json"
    file.write_text(json.dumps({"train": {"version": 4, "code": "of before"}}))
    monkeypatch.setattr(versions, "FILE", file)
    assert "train" in versions.changed()
    versions.refresh(raised=["train"])
    known = json.loads(file.read_text())
    assert known["train"]["version"] == 5 and known["draw"]["version"] == 1 and versions.changed() == []
    versions.refresh(raised=[])
    assert json.loads(file.read_text()) == known
    with pytest.raises(SystemExit, match="there is no task trian"):
        versions.refresh(raised=["trian"])


def test_comments_docstrings_and_type_checking_do_not_count() -> None:
    code = "import a\nif TYPE_CHECKING:\n    import b\nelse:\n    import c\ndef f():\n    import d\n"
    told = code.replace("import c", "import c  # why").replace("def f():\n", 'def f():\n    """Words."""\n')
    assert (
        versions._code(code) == versions._code(told) != versions._code(code.replace("import d", "import e"))
    )
    assert sorted(versions._imports(versions.ast.parse(code))) == ["a", "c", "d"]
    assert sorted(versions._imports(versions.ast.parse(code), at_load=True)) == ["a", "c"]


def test_no_step_depends_on_pages() -> None:
    assert "siq/networks/training.py" in imported_by("train")
    for task in ("draw", "identify", "train", "regress", "refine", "score", "landscape"):
        assert not any(path.startswith("siq/report/") for path in imported_by(task))
