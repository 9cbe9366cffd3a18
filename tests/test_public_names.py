"""What a user imports from `siq`, and what a type checker sees of it."""

from __future__ import annotations

import ast
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import siq

ROOT = Path(__file__).parents[1]
DECLARATIONS = ast.parse((ROOT / "siq" / "__init__.pyi").read_text(encoding="utf-8"))


def test_every_public_name_can_be_called() -> None:
    assert siq.__all__ == sorted(siq.__all__, key=lambda name: (name.islower(), name))
    for name in siq.__all__:
        assert callable(getattr(siq, name)), name


def test_there_is_no_other() -> None:
    with pytest.raises(AttributeError, match="no attribute 'diagnosis_of'"):
        _ = siq.diagnosis_of


def test_a_type_checker_is_told_the_same_names_from_the_same_modules() -> None:
    declared = {
        alias.asname: node.module
        for node in DECLARATIONS.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert declared == siq._MODULES  # with `as`, without which a stub does not export
    assert sorted(siq._MODULES) == sorted(siq.__all__)


def test_importing_siq_loads_nothing_heavy() -> None:
    """``import siq`` is instant; what is asked for first decides what is loaded."""
    program = "import sys, siq; print(*{name.partition('.')[0] for name in sys.modules})"
    loaded = subprocess.run([sys.executable, "-c", program], check=True, capture_output=True, text=True)
    heavy = {"torch", "matplotlib", "pandas", "pyarrow", "numpy", "scipy", "sympy", "snakemake", "pysindy"}
    assert not heavy & set(loaded.stdout.split())


def test_the_version_stands_in_one_place() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert siq.__version__ == project["version"]
    assert f"\nversion: {siq.__version__}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert f"## [{siq.__version__}]" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
