"""The import contract: which package may import which, and what no module of `siq` may know of.

Every import counts, those within functions too; only what stands under ``if TYPE_CHECKING`` does not, since
it is never run.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

# From the ground up: a package imports those before it, and none after it (docs/decisions).
ORDER = (
    "errors",
    "numerics",
    "remarks",
    "data",
    "systems",
    "inference",
    "networks",
    "validation",
    "quasipotential",
    "diagnosis",
    "workflow",
    "report",
    "sklearn",
    "__main__",
)

# Thin methods that call what stands above them, when they are called: (who, whom).
UPWARDS: frozenset[tuple[str, str]] = frozenset(
    {
        ("siq.data.inspection", "siq.report.plots.recordings"),
        ("siq.diagnosis.diagnosis", "siq.report.diagnosis_page"),
        ("siq.diagnosis.statement", "siq.report.diagnosis_page"),
        ("siq.quasipotential.landscape", "siq.report.landscape"),
        ("siq.quasipotential.landscape", "siq.report.plots.quasipotential"),
        ("siq.quasipotential.landscape", "siq.workflow.pipeline"),
        ("siq.workflow.sweep", "siq.report.plots.sweep"),
        ("siq.workflow.tipping", "siq.report.plots.sweep"),
    }
)


# Thin methods of a class that call, within its package, what is made of it.
WITHIN: frozenset[tuple[str, str]] = frozenset(
    {
        ("siq.quasipotential.landscape", "siq.quasipotential.landscape_assembly"),
        ("siq.quasipotential.landscape", "siq.quasipotential.landscape_comparison"),
        ("siq.data.recordings", "siq.data.tables"),
        ("siq.systems.dynamics", "siq.systems.cards"),
    }
)


def module_name(file: Path) -> str:
    parts = file.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_name(file): file for file in sorted((ROOT / "siq").rglob("*.py"))}


def executed(node: ast.AST, *, called: bool = False) -> Iterator[tuple[ast.AST, bool]]:
    """This node and every one in it that may run, and whether that is only when a function is called."""
    yield node, called
    inner = called or isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
    of_type_checkers = isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING")
    for child in node.orelse if of_type_checkers else ast.iter_child_nodes(node):
        yield from executed(child, called=inner)


def imports(tree: ast.AST) -> Iterator[tuple[str, bool]]:
    """The modules of `siq` that are imported, and whether only when a function is called."""
    for node, called in executed(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0 and node.module, "modules are imported by their full names"
            inner = [f"{node.module}.{alias.name}" for alias in node.names]
            names = [name if name in MODULES else node.module for name in inner]
        else:
            continue
        yield from ((name, called) for name in names if name.partition(".")[0] == "siq")


@cache
def arrows_of_modules() -> dict[str, list[tuple[str, bool]]]:
    """What each module imports, and whether only when a function is called."""
    return {
        module: sorted(set(imports(ast.parse(file.read_text(encoding="utf-8")))))
        for module, file in MODULES.items()
    }


def package(module: str) -> str:
    return module.split(".")[1]


def test_the_order_names_every_package() -> None:
    found = {module.split(".")[1] for module in MODULES if "." in module}
    assert found <= set(ORDER), f"place {found - set(ORDER)} in the order"


def test_imports_go_downwards_only() -> None:
    upwards = set()
    for module, arrows in arrows_of_modules().items():
        if module == "siq":
            continue  # it names what users need, and loads it when they do: see test_public_names
        for target, called in arrows:
            if target == "siq":
                upwards.add((module, target))
            elif ORDER.index(package(target)) > ORDER.index(package(module)):
                assert called or (module, target) not in UPWARDS, (
                    f"{module} imports {target} when it is loaded"
                )
                upwards.add((module, target))
    assert upwards == UPWARDS


def test_modules_do_not_import_each_other_in_a_circle() -> None:
    """At load time none does; when called, only the thin methods may."""
    graph = {
        module: {
            target
            for target, called in arrows
            if (module, target) not in UPWARDS and not (called and (module, target) in WITHIN)
        }
        for module, arrows in arrows_of_modules().items()
    }
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(" -> ".join(error.args[1]))


@pytest.mark.parametrize("words", ["snakemake", "results/"])
def test_only_the_command_line_knows_of_the_workflow(words: str) -> None:
    """Neither of Snakemake nor of its folder of results: who has only Python has all of `siq`."""
    of_the_command = {f"siq.workflow.{name}" for name in ("answers", "command", "examples", "launch")}
    knowing = {module for module, file in MODULES.items() if words in file.read_text("utf-8").lower()}
    assert knowing <= of_the_command


def test_what_only_a_type_checker_reads_does_not_count() -> None:
    tree = ast.parse(
        "from typing import TYPE_CHECKING\n"
        "if TYPE_CHECKING:\n    from siq.report import page\nelse:\n    import siq.errors\n"
        "def late():\n    from siq.errors import InputError\n"
    )
    assert list(imports(tree)) == [("siq.errors", False), ("siq.errors", True)]
