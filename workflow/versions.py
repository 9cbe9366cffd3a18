"""Versions of tasks: what runs again when code has changed.

A job is made again when the version of its task is raised, and not when any line of code changes. So that
this cannot be forgotten, ``versions.json`` has beside each version a digest of all code that the task runs,
and a test compares them. After a change of code, say once which results it may change:

    python -m workflow.versions --raise train     # those of `train`, and all that follows from them
    python -m workflow.versions --same            # none
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import inspect
import json
import re
from functools import cache
from pathlib import Path

import siq
from workflow.places import BASE

FILE = BASE / "workflow" / "versions.json"
LIBRARY = BASE if (BASE / "siq").is_dir() else Path(siq.__file__).resolve().parents[1]
"""The folder that the package lies in: beside the workflow in a checkout, elsewhere when installed."""


@cache
def versions() -> dict[str, int]:
    """The version of every task."""
    return {task: entry["version"] for task, entry in json.loads(FILE.read_text(encoding="utf-8")).items()}


def imports_of_task(name: str) -> list[str]:
    """The modules that a task imports when it runs, and those that its own module loads."""
    from workflow.tasks import TASKS

    function = ast.parse(inspect.getsource(TASKS[name].run))
    return _imports(function) + _imports_of(inspect.getfile(TASKS[name].run), at_load=True)


def _closure(name: str) -> tuple[list[str], list[Path]]:
    """The code of a task with the helpers that it calls in its module, and every file that these import."""
    from workflow.tasks import TASKS

    run = TASKS[name].run
    parts, waiting = [_code(inspect.getsource(run))], imports_of_task(name)
    module = ast.parse(Path(inspect.getfile(run)).read_text(encoding="utf-8"))
    helpers = [node for node in module.body if isinstance(node, ast.FunctionDef) and not node.decorator_list]
    while called := [node for node in helpers if f"id='{node.name}'" in "".join(parts)]:
        for node in called:
            helpers.remove(node)
            parts.append(_code(ast.unparse(node)))
            waiting += _imports(node)
    seen: set[Path] = set()
    files = [file for module in waiting for file in _files(module)]
    while files:
        file = files.pop()
        if file not in seen:
            seen.add(file)
            files += _files_behind(file)
    return parts, sorted(seen)


@cache
def _files_behind(file: Path) -> list[Path]:
    """What a file imports, but for what only methods for users call above it, such as `Landscape.report`."""
    if file.is_relative_to(LIBRARY / "siq"):
        package = file.relative_to(LIBRARY).parts[1]
    else:  # what writes figures to files draws none of them
        package = "workflow" if file == BASE / "workflow" / "files.py" else "report"
    above = {"report": (), "workflow": ("siq.report",)}.get(package, ("siq.report", "siq.workflow"))
    modules = {module for module in _imports_of(str(file)) if not module.startswith(above)}
    return [each for module in modules for each in _files(module)]


def files_of_task(name: str) -> list[Path]:
    """Every file of this project that a task imports, directly or not, besides its own module."""
    return _closure(name)[1]


@cache
def digest(name: str) -> str:
    """A digest of all code that a task runs; comments and docstrings do not count."""
    parts, files = _closure(name)
    parts += [_named_code(file) for file in files]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]


def changed() -> list[str]:
    """Tasks whose code is not that of their digests."""
    from workflow.tasks import TASKS

    known = json.loads(FILE.read_text(encoding="utf-8")) if FILE.is_file() else {}
    return [name for name in TASKS if known.get(name, {}).get("code") != digest(name)]


def refresh(*, raised: list[str]) -> None:
    """Note the code as it is; versions are raised of the tasks that are named."""
    from workflow.tasks import TASKS

    known = json.loads(FILE.read_text(encoding="utf-8")) if FILE.is_file() else {}
    if unknown := sorted(set(raised) - set(TASKS)):
        raise SystemExit(f"there is no task {', '.join(unknown)}; there are {', '.join(TASKS)}")
    entries = {
        name: {"version": known.get(name, {}).get("version", 1) + (name in raised), "code": digest(name)}
        for name in TASKS
    }
    lines = ",\n".join(f"  {json.dumps(name)}: {json.dumps(entry)}" for name, entry in entries.items())
    FILE.write_text("{\n" + lines + "\n}\n", encoding="utf-8")


def _imports(tree: ast.AST, *, at_load: bool = False) -> list[str]:
    """The modules that code imports; what only a type checker reads does not count."""
    modules, waiting = [], [tree]
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.Import):
            modules += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            modules += [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
        elif isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING"):
            waiting += node.orelse
        elif not (at_load and isinstance(node, ast.FunctionDef)):
            waiting += ast.iter_child_nodes(node)
    return modules


@cache
def _imports_of(file: str, *, at_load: bool = False) -> list[str]:
    return _imports(ast.parse(Path(file).read_text(encoding="utf-8")), at_load=at_load)


def _code(text: str) -> str:
    """Code without comments and docstrings."""
    tree = ast.parse(text)
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):
            node.body = [  # type: ignore[attr-defined]
                one for one in body if not (isinstance(one, ast.Expr) and isinstance(one.value, ast.Constant))
            ]
    return ast.dump(tree)


@cache
def _named_code(file: Path) -> str:
    place = file.relative_to(BASE if file.is_relative_to(BASE) else LIBRARY).as_posix()
    text = file.read_text(encoding="utf-8")
    # What stands in a file beside the code counts as the code that reads it.
    read = (file.with_name(name) for name in re.findall(r'with_name\("([^"]+)"\)', text))
    parts = [_code(text), *(one.read_text(encoding="utf-8") for one in read if one.is_file())]
    return f"{place} {hashlib.sha256(''.join(parts).encode()).hexdigest()}"


@cache
def _files(module: str) -> list[Path]:
    """The files of a module of this project, and of the packages that it lies in."""
    parts, files = module.split("."), []
    if parts[0] not in ("siq", "workflow", "benchmarks"):
        return []
    folder = LIBRARY if parts[0] == "siq" else BASE
    for length in range(1, len(parts) + 1):
        place = folder.joinpath(*parts[:length])
        files += [path for path in (place.with_suffix(".py"), place / "__init__.py") if path.is_file()]
    return files


def main() -> None:
    """Note that code has changed."""
    parser = argparse.ArgumentParser(prog="python -m workflow.versions", description=__doc__)
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--same", action="store_true", help="no result changes")
    what.add_argument(
        "--raise", dest="raised", nargs="+", default=[], metavar="TASK", help="these may change"
    )
    refresh(raised=parser.parse_args().raised)


if __name__ == "__main__":
    main()
