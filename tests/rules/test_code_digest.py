"""Which modules count as the code of a step."""

from pathlib import Path

from workflow.code_digest import imported_files

ROOT = Path(__file__).resolve().parents[2]


def imported_by(script: str) -> set[str]:
    found = imported_files(ROOT, ROOT / "workflow" / "scripts" / script)
    return {str(path.relative_to(ROOT)) for path in found}


def test_imports_for_type_checking_alone_do_not_count(tmp_path: Path) -> None:
    (tmp_path / "siq").mkdir()
    for name in ("read", "named", "called", "otherwise"):
        (tmp_path / "siq" / f"{name}.py").write_text("")
    script = tmp_path / "script.py"
    script.write_text(
        "import typing\nfrom typing import TYPE_CHECKING\nimport siq.read\n"
        "if TYPE_CHECKING:\n    import siq.named\nelse:\n    import siq.otherwise\n"
        "if typing.TYPE_CHECKING:\n    from siq import named\n"
        "def function():\n    from siq import called\n"
    )
    names = {path.stem for path in imported_files(tmp_path, script)}
    assert names == {"script", "read", "otherwise", "called"}


def test_a_step_depends_on_no_other_step_that_it_does_not_use() -> None:
    drawing, training, regressing = map(imported_by, ("draw.py", "train.py", "regress.py"))
    assert "siq/workflow/identification_step.py" not in drawing | regressing
    assert "siq/networks/regression.py" not in drawing | training
    assert "siq/networks/training.py" in training and "siq/networks/training.py" not in regressing
    for files in (drawing, training, regressing):
        assert not any(path.startswith("siq/report/") for path in files)
        assert "siq/workflow/study.py" not in files
