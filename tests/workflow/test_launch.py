"""How the workflow is found and asked, without running it."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest

from siq.numerics.files import case_folders
from siq.workflow.launch import PLUGINS, Request, _known_studies, _workflow_folder

ROOT = Path(__file__).resolve().parents[2]


def test_a_checkout_uses_its_own_workflow() -> None:
    assert _workflow_folder() == ROOT
    assert "archetype3d" in _known_studies()


def test_no_option_can_take_the_target(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    request = Request(
        ("results/a/report.html",), Path("a.yaml"), ("origin=a.csv",), "3", further=("--forceall",)
    )
    words = request.command()
    assert words[-3:] == ["--forceall", "--", "results/a/report.html"]
    assert words[words.index("--directory") + 1] == str(tmp_path)
    place = words.index("--configfile")
    assert words[place + 1 : place + 3] == [str(ROOT / "config" / "config.yaml"), str(tmp_path / "a.yaml")]


def test_a_folder_is_a_case_or_has_cases(tmp_path: Path) -> None:
    for name in ("b", "a", "notes"):
        (tmp_path / name).mkdir()
    (tmp_path / "a" / "system.yaml").touch()
    (tmp_path / "b" / "recordings.csv").touch()
    assert list(case_folders(tmp_path)) == ["a", "b"]
    assert list(case_folders(tmp_path / "a")) == ["a"]


@pytest.fixture(scope="module")
def plugin() -> ModuleType:
    """The logger plugin, which Snakemake finds by its name."""
    pytest.importorskip("snakemake_interface_logger_plugins")
    file = ROOT / PLUGINS / "snakemake_logger_plugin_siq" / "__init__.py"
    spec = importlib.util.spec_from_file_location("plugin_of_siq", file)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(
    ("arguments", "better"),
    [
        (
            "--cores 2 --configfile a.yaml results/a/report.html",
            "results/a/report.html --cores 2 --configfile a.yaml",
        ),
        ("--configfile a.yaml statistics -n", "statistics -n --configfile a.yaml"),
        ("results/a/report.html --configfile a.yaml", None),
        ("--configfile a.yaml b.json --cores 2 target", None),
        ("--configfile a.yaml -- target", None),
    ],
)
def test_a_target_behind_a_configuration_is_told(
    plugin: ModuleType, arguments: str, better: str | None
) -> None:
    said = plugin.swallowed_target(arguments.split())
    assert said == (None if better is None else f"snakemake {better}")
