"""Sparse identification of quasipotentials.

From trajectories of a system with several metastable states to its energy landscape as a formula: the
orthogonal decomposition ``f = -D∇V + g`` with ``∇V·g = 0`` by two networks, and sparse formulas of V, g and
f by constrained regression. U = 2V is the quasipotential. And from a simulation and recordings that differ
to the physics that was left out.

The names below are what users need; they are loaded when first used, since torch takes seconds to import.
"""

from __future__ import annotations

import importlib
from typing import Any

_WHERE = {
    "InputError": "siq.errors",
    "NumericalFailure": "siq.errors",
    "Recordings": "siq.recordings",
    "RegressionOptions": "siq.regression",
    "SimulationOptions": "siq.simulate",
    "Study": "siq.study",
    "SymbolicDecomposition": "siq.symbolic",
    "System": "siq.systems",
    "TrainingOptions": "siq.decomposition.options",
    "candidate_library": "siq.library",
    "load_study": "siq.study",
    "load_system": "siq.systems",
    "parse_formula": "siq.expressions",
    "read_case": "siq.mismatch.case",
    "read_model": "siq.model",
    "read_recordings": "siq.recordings",
    "simulate_snapshots": "siq.simulate",
    "snapshot_pairs": "siq.recordings",
    "solve_case": "siq.mismatch.case",
    "sparse_decomposition": "siq.regression",
    "train": "siq.decomposition.training",
    "write_recordings": "siq.recordings",
}

__all__ = list(_WHERE)


def __getattr__(name: str) -> Any:
    if name in _WHERE:
        return getattr(importlib.import_module(_WHERE[name]), name)
    raise AttributeError(f"module 'siq' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted(_WHERE)
