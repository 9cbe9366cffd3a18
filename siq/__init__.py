"""Sparse identification of quasipotentials.

From trajectories of a system with several metastable states to its energy landscape as a formula: the
orthogonal decomposition ``f = -D∇V + g`` with ``∇V·g = 0`` by two networks, and sparse formulas of V, g and
f by constrained regression. U = 2V is the quasipotential. And from a simulation and recordings that differ
to the physics that was left out.

What users need stands in the stub beside this file, ``__init__.pyi``, which type checkers read. Each name is
loaded when it is first used, since torch takes seconds to import.
"""

from __future__ import annotations

import ast
import importlib
from pathlib import Path
from typing import Any

_MODULES = {
    alias.name: node.module
    for node in ast.parse(Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8")).body
    if isinstance(node, ast.ImportFrom) and node.module
    for alias in node.names
}
__all__ = sorted(_MODULES, key=lambda name: (name.islower(), name))


def __getattr__(name: str) -> Any:
    if name == "__version__":
        value: Any = importlib.import_module("siq.errors").version()
    elif name in _MODULES:
        value = getattr(importlib.import_module(_MODULES[name]), name)
    else:
        raise AttributeError(f"module 'siq' has no attribute '{name}'")
    globals()[name] = value  # found once
    return value


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
