"""The code of every step, by content: what runs again when a module has changed."""

from __future__ import annotations

import ast
import hashlib
from functools import cache
from pathlib import Path

import siq


@cache
def code_digest(base: Path, script: str) -> dict[str, str]:
    """The script and every module of this project that it imports, directly or not, by content.

    Snakemake reruns a job when its script or a parameter changes, but does not see a module that the
    script imports. As a parameter of the rule, this tells it.
    """
    digests = {}
    library = library_of(base)
    for file in imported_files(base, base / "workflow" / "scripts" / script, library=library):
        beside = base if file.is_relative_to(base) else library
        digests[file.relative_to(beside).as_posix()] = _digest(file)
    return digests


def library_of(base: Path) -> Path:
    """The folder that the package lies in: beside the workflow in a checkout, elsewhere when installed."""
    return base if (base / "siq").is_dir() else Path(siq.__file__).resolve().parents[1]


@cache
def _digest(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()[:12]


def imported_files(base: Path, script: Path, *, library: Path | None = None) -> list[Path]:
    """The Python files of this project that a script runs, itself included, found from its imports.

    Imports within functions count as well, and so do the packages that a module lies in. Imports for
    type checking alone, under ``if TYPE_CHECKING:``, are not made when the script runs and do not count. All
    are read as text, nothing is run. How a script is started changes nothing that it computes. The package
    is sought in `library` where it does not lie beside the workflow.
    """
    folders = dict.fromkeys((base, library or base))
    found: dict[Path, None] = {}
    waiting = [script]
    while waiting:
        file = waiting.pop()
        if file in found or file == base / "workflow" / "warm.py":
            continue
        found[file] = None
        for module in _imported_modules(file):
            # A script finds its neighbours by their bare names.
            places = (*(folders if module.partition(".")[0] == "siq" else (base,)), script.parent)
            waiting += [path for place in places for path in _module_files(place, module)]
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
