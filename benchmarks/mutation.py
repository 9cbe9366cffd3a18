"""Mutation testing of the modules that decide: do their tests see a fault that is put into them?

    python -m benchmarks.mutation selection --sample 20
    python -m benchmarks.mutation --sample 5             # of each module

A mutant is the module with one operator, comparison or number changed. It is killed where one of the module's
own tests fails, or takes five times as long. What survives is printed with its line: either no test asks for
it, or it makes no difference. The sources stay as they are; a mutant exists in the memory of the process that
tests it.

Of samples with the seed 0, in November 2026, were killed: selection 75 of 100, verify 78 of 100, holdout 67
of 80, certificate 58 of 70 (36 before). What survives there are numbers of a choice (how many curves, how far
apart), and comparisons whose two sides are never equal.
"""

from __future__ import annotations

import argparse
import ast
import importlib.abc
import importlib.machinery
import importlib.util
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import ModuleType

import numpy as np

ROOT = Path(__file__).parents[1]
MODULES = {
    "certificate": (
        "siq.quasipotential.certificate",
        "tests/quasipotential/test_certificate.py tests/quasipotential/test_certificate_tests.py",
    ),
    "selection": (
        "siq.inference.selection",
        "tests/inference/test_selection.py tests/inference/test_triangle.py tests/inference/test_stability.py"
        " tests/inference/test_model_average.py",
    ),
    "holdout": (
        "siq.diagnosis.holdout",
        "tests/diagnosis/test_holdout.py tests/diagnosis/test_verdict.py tests/diagnosis/test_naming.py",
    ),
    "verify": ("siq.workflow.verification", "tests/workflow/test_verification.py"),
}
"""The modules, and the tests that are theirs."""
MUTANT = "SIQ_MUTANT"  # of a process: module and number of the mutant
PATIENCE = 5.0  # times what the tests take without a fault

OTHERS: dict[type[ast.AST], list[type[ast.AST]]] = {
    ast.Lt: [ast.LtE, ast.Gt], ast.LtE: [ast.Lt, ast.Gt], ast.Gt: [ast.GtE, ast.Lt],
    ast.GtE: [ast.Gt, ast.Lt], ast.Eq: [ast.NotEq], ast.NotEq: [ast.Eq], ast.In: [ast.NotIn],
    ast.NotIn: [ast.In], ast.Is: [ast.IsNot], ast.IsNot: [ast.Is], ast.Add: [ast.Sub], ast.Sub: [ast.Add],
    ast.Mult: [ast.Div], ast.Div: [ast.Mult], ast.Pow: [ast.Mult], ast.And: [ast.Or], ast.Or: [ast.And],
    ast.BitAnd: [ast.BitOr], ast.BitOr: [ast.BitAnd],
}  # fmt: skip
NAMES = {"min": "max", "max": "min", "any": "all", "all": "any", "argmin": "argmax", "argmax": "argmin"}


def _executed(node: ast.AST) -> Iterator[ast.AST]:
    """Every node but annotations and type checks."""
    yield node
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list"):
            continue
        for each in value if isinstance(value, list) else [value]:
            if isinstance(each, ast.AST):
                yield from _executed(each)


def _changes(node: ast.AST) -> Iterator[tuple[str, object, str]]:
    """Field of a node, what else may stand there, and what that is in words."""
    if isinstance(node, ast.Compare) and len(node.ops) == 1:
        for other in OTHERS.get(type(node.ops[0]), []):
            yield "ops", [other()], f"{type(node.ops[0]).__name__} → {other.__name__}"
    elif isinstance(node, ast.BinOp | ast.BoolOp | ast.AugAssign):
        for other in OTHERS.get(type(node.op), []):
            yield "op", other(), f"{type(node.op).__name__} → {other.__name__}"
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not | ast.USub):
        replaced = ast.UAdd() if isinstance(node.op, ast.USub) else None
        if replaced is not None:
            yield "op", replaced, "sign"
        else:
            yield "operand", ast.UnaryOp(ast.Not(), node.operand), "not → itself"
    elif isinstance(node, ast.Constant) and isinstance(node.value, bool):
        yield "value", not node.value, f"{node.value} → {not node.value}"
    elif isinstance(node, ast.Constant) and isinstance(node.value, int | float):
        # One more of a few is a fault; one more of a hundred draws is none that a test should see.
        few = isinstance(node.value, int) and abs(node.value) < 10
        number = node.value + 1 if few else node.value * 2 or 1.0
        yield "value", number, f"{node.value} → {number}"
    elif isinstance(node, ast.Name) and node.id in NAMES:
        yield "id", NAMES[node.id], f"{node.id} → {NAMES[node.id]}"
    elif isinstance(node, ast.Attribute) and node.attr in NAMES:
        yield "attr", NAMES[node.attr], f"{node.attr} → {NAMES[node.attr]}"


def mutants(source: str) -> list[str]:
    """All mutants of a source, each as its line and what is changed."""
    nodes = _executed(ast.parse(source))
    return [f"{getattr(n, 'lineno', 0)}: {told}" for n in nodes for *_, told in _changes(n)]


def mutated(source: str, number: int) -> ast.Module:
    """The mutant of this number."""
    tree = ast.parse(source)
    places = [(node, field, other) for node in _executed(tree) for field, other, _ in _changes(node)]
    node, field, other = places[number]
    setattr(node, field, other)
    return ast.fix_missing_locations(tree)


class _Faulty(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Loads one module as a mutant, all others as they are."""

    def __init__(self, module: str, number: int) -> None:
        self.module, self.number = module, number
        self.file = ROOT.joinpath(*module.split(".")).with_suffix(".py")

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        """Of this module alone."""
        if fullname != self.module:
            return None
        return importlib.util.spec_from_file_location(fullname, self.file, loader=self)

    def exec_module(self, module: ModuleType) -> None:
        """Run the source of the mutant."""
        tree = mutated(self.file.read_text(encoding="utf-8"), self.number)
        exec(compile(tree, str(self.file), "exec"), module.__dict__)


if MUTANT in os.environ:  # as a plugin of pytest, before anything of siq is imported
    _name, _, _number = os.environ[MUTANT].partition(":")
    sys.meta_path.insert(0, _Faulty(_name, int(_number)))


def passed(module: str, tests: str, number: int | None, *, limit: float | None = None) -> bool:
    """Whether the tests of a module pass, of a mutant or without a fault."""
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", "-p", "no:xdist"]
    command += [*(["-p", "benchmarks.mutation"] if number is not None else []), *tests.split()]
    environment = os.environ | ({} if number is None else {MUTANT: f"{module}:{number}"})
    try:
        done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, timeout=limit)
    except subprocess.TimeoutExpired:
        return False
    if done.returncode not in (0, 1, 2):  # 2: the mutant cannot even be imported
        raise SystemExit(done.stdout.decode() + done.stderr.decode())
    return done.returncode == 0


def main() -> None:
    """A line for each survivor, and the score of each module."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("modules", nargs="*", help="certificate, selection, holdout, verify; by default all")
    parser.add_argument("--sample", type=int, default=20, help="mutants of each module")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, help="go on after so many mutants of this seed")
    parser.add_argument("--limit", type=float, help="seconds for the tests of a mutant; by default measured")
    arguments = parser.parse_args()
    if unknown := set(arguments.modules) - set(MODULES):
        parser.error(f"there is no {', '.join(unknown)}; name some of {', '.join(MODULES)}")
    for name in arguments.modules or MODULES:
        module, tests = MODULES[name]
        file = ROOT.joinpath(*module.split(".")).with_suffix(".py")
        every = mutants(file.read_text(encoding="utf-8"))
        chosen = np.random.default_rng(arguments.seed).permutation(len(every))
        chosen = chosen[arguments.first :][: arguments.sample]
        limit, killed, begin = arguments.limit, 0, time.monotonic()
        if limit is None:
            if not passed(module, tests, None):
                raise SystemExit(f"the tests of {name} fail without a fault: {tests}")
            limit = PATIENCE * (time.monotonic() - begin)
        for done, number in enumerate(map(int, chosen), start=1):
            alive = passed(module, tests, number, limit=limit)
            killed += not alive
            told = "survives" if alive else "killed"
            print(f"{name} {done}/{len(chosen)} {told} {file.name}:{every[number]}", flush=True)
        print(f"{name}: {killed} of {len(chosen)} killed, of {len(every)} mutants", flush=True)


if __name__ == "__main__":
    main()
