"""`siq.validation` checks the library: neither may import the other, directly or by way of a third."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
CHECKED = ("quasipotential", "inference", "diagnosis", "networks")


def imported(path: Path) -> set[str]:
    """Modules and packages of `siq` that a file imports, wherever the statement stands."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {each.name for each in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            found |= {node.module, *(f"{node.module}.{each.name}" for each in node.names)}
    return {each for each in found if each.startswith("siq.")}


def reached(path: Path, known: set[Path]) -> set[Path]:
    """Files of `siq` that come with a file when it is imported, itself included."""
    known.add(path)
    for name in imported(path):
        file = ROOT / Path(*name.split("."))
        for one in (file.with_suffix(".py"), file / "__init__.py"):
            if one.exists() and one not in known:
                reached(one, known)
    return known


@pytest.mark.parametrize(
    "path", sorted((ROOT / "siq" / "validation").glob("*.py")), ids=lambda each: each.stem
)
def test_validation_imports_nothing_that_it_checks(path: Path) -> None:
    packages = {each.relative_to(ROOT / "siq").parts[0] for each in reached(path, set())}
    assert not packages & set(CHECKED)


@pytest.mark.parametrize("package", CHECKED)
def test_nothing_that_is_checked_imports_validation(package: str) -> None:
    for path in (ROOT / "siq" / package).rglob("*.py"):
        assert not {each for each in imported(path) if each.startswith("siq.validation")}, path
