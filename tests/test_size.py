"""The size of the library may fall and not rise: the numbers in `tests/size.json` are its ratchets.

Where a number has fallen, write the new one into the file. Where it has to rise, a record of decision says
why.
"""

from __future__ import annotations

import ast
import json
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]
LIMITS: dict[str, int] = json.loads((ROOT / "tests" / "size.json").read_text(encoding="utf-8"))
SLACK = 0.01  # a limit that is further above the size than this is out of date


def lines(*files: Path) -> int:
    return sum(len(file.read_text(encoding="utf-8").splitlines()) for file in files)


@cache
def sizes() -> dict[str, int]:
    modules = sorted((ROOT / "siq").rglob("*.py"))
    trees = [ast.parse(file.read_text(encoding="utf-8")) for file in modules]
    definitions = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)
    rules = [*(ROOT / "workflow").rglob("*.py"), *(ROOT / "workflow").rglob("*.smk"), ROOT / "Snakefile"]
    return {
        "lines": lines(*modules),
        "modules": len(modules),
        "dataclasses": sum(
            any("dataclass" in ast.unparse(each) for each in node.decorator_list)
            for tree in trees
            for node in ast.walk(tree)
            if isinstance(node, ast.ClassDef)
        ),
        "public_names": sum(
            isinstance(node, definitions) and not node.name.startswith("_")
            for tree in trees
            for node in tree.body
        ),
        "report_lines": lines(*(ROOT / "siq" / "report").rglob("*.py")),
        "workflow_lines": lines(*rules),
    }


def test_the_library_does_not_grow() -> None:
    found = sizes()
    assert {name: value for name, value in found.items() if value > LIMITS[name]} == {}


def test_the_limits_follow_where_it_shrinks() -> None:
    found = sizes()
    assert {name: value for name, value in found.items() if value < (1 - SLACK) * LIMITS[name]} == {}
