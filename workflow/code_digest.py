"""The code of every step, by content: what runs again when a module has changed."""

from __future__ import annotations

import ast
import hashlib
from functools import cache
from pathlib import Path


@cache
def code_digest(base: Path, script: str) -> dict[str, str]:
    """The script and every module of this project that it imports, directly or not, by content.

    Snakemake reruns a job when its script or a parameter changes, but does not see a module that the
    script imports. As a parameter of the rule, this tells it.
    """
    digests = {}
    for file in imported_files(base, base / "workflow" / "scripts" / script):
        digests[str(file.relative_to(base))] = _digest(file)
    return digests


@cache
def _digest(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()[:12]


def imported_files(base: Path, script: Path) -> list[Path]:
    """The Python files of this project that a script runs, itself included, found from its imports.

    Imports within functions count as well, and so do the packages that a module lies in. Imports for
    type checking alone, under ``if TYPE_CHECKING:``, are not made when the script runs and do not count. All
    are read as text, nothing is run. How a script is started changes nothing that it computes.
    """
    found: dict[Path, None] = {}
    waiting = [script]
    while waiting:
        file = waiting.pop()
        if file in found or file == base / "workflow" / "warm.py":
            continue
        found[file] = None
        for module in _imported_modules(file):
            # A script finds its neighbours by their bare names.
            waiting += [*_module_files(base, module), *_module_files(script.parent, module)]
    return sorted(found)


@cache  # parsed once for all scripts: a start of the workflow would spend ten seconds on it otherwise
def _imported_modules(file: Path) -> list[str]:
    modules = []
    waiting: list[ast.AST] = [ast.parse(file.read_text(encoding="utf-8"))]
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.Import):
            modules += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            modules += [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
        elif isinstance(node, ast.If) and _for_type_checking(node.test):
            waiting += node.orelse
        else:
            waiting += ast.iter_child_nodes(node)
    return modules


def _for_type_checking(test: ast.expr) -> bool:
    """Whether a condition is ``TYPE_CHECKING`` or ``typing.TYPE_CHECKING``."""
    name = test.attr if isinstance(test, ast.Attribute) else getattr(test, "id", "")
    return name == "TYPE_CHECKING"


@cache
def _module_files(folder: Path, module: str) -> list[Path]:
    parts = module.split(".")
    files = []
    for length in range(1, len(parts) + 1):
        place = folder.joinpath(*parts[:length])
        files += [path for path in (place.with_suffix(".py"), place / "__init__.py") if path.is_file()]
    return files
