"""Sparse identification of quasipotentials.

From trajectories of a system with several metastable states to its energy landscape as a formula: the
orthogonal decomposition ``f = -D∇V + g`` with ``∇V·g = 0`` by two networks, and sparse formulas of V, g and
f by constrained regression. U = 2V is the quasipotential. And from a simulation and recordings that differ
to the physics that was left out.

The names below are what users need. Each is loaded when it is first used, since torch takes seconds to
import; ``_MODULES`` says from where. Type checkers read the same names from the block beneath it.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from siq.data.inspection import inspect
    from siq.data.recordings import Recordings, read_recordings, snapshot_pairs, write_recordings
    from siq.dynamics.cards import load_system
    from siq.dynamics.diffusion import Diffusion
    from siq.dynamics.dynamics import Dynamics
    from siq.dynamics.exports import Formula
    from siq.dynamics.formulas import parse_formula
    from siq.dynamics.simulation import SimulationOptions, simulate_snapshots
    from siq.errors import InputError, MissingExtra, NumericalFailure
    from siq.identify.library import candidate_library
    from siq.landscape.landscape import Landscape
    from siq.landscape.refusal import NoLandscape
    from siq.mismatch.case import read_case
    from siq.mismatch.diagnosis import Diagnosis, diagnose, solve_case
    from siq.mismatch.study import MismatchStudy
    from siq.networks.options import TrainingOptions
    from siq.networks.regression import RegressionOptions, sparse_decomposition
    from siq.networks.training import train
    from siq.potential.storage import read_model
    from siq.potential.symbolic import SymbolicDecomposition
    from siq.reference.system_table import reference_table
    from siq.reference.systems import reference_systems
    from siq.report.plots.barriers import plot_barriers
    from siq.report.plots.diagnosis import plot_diagnosis
    from siq.report.plots.quasipotential import plot_quasipotential
    from siq.report.plots.residuals import plot_residuals
    from siq.report.plots.wells import plot_paths, plot_wells
    from siq.steps.equations import EquationSettings
    from siq.steps.pipeline import PipelineSettings
    from siq.steps.sweep import Sweep, sweep
    from siq.steps.tipping import probability_of_tipping
    from siq.study.study import Study, load_study

    __version__: str

__all__ = [
    "Diagnosis",
    "Diffusion",
    "Dynamics",
    "EquationSettings",
    "Formula",
    "InputError",
    "Landscape",
    "MismatchStudy",
    "MissingExtra",
    "NoLandscape",
    "NumericalFailure",
    "PipelineSettings",
    "Recordings",
    "RegressionOptions",
    "SimulationOptions",
    "Study",
    "Sweep",
    "SymbolicDecomposition",
    "TrainingOptions",
    "candidate_library",
    "diagnose",
    "inspect",
    "load_study",
    "load_system",
    "parse_formula",
    "plot_barriers",
    "plot_diagnosis",
    "plot_paths",
    "plot_quasipotential",
    "plot_residuals",
    "plot_wells",
    "probability_of_tipping",
    "read_case",
    "read_model",
    "read_recordings",
    "reference_systems",
    "reference_table",
    "simulate_snapshots",
    "snapshot_pairs",
    "solve_case",
    "sparse_decomposition",
    "sweep",
    "train",
    "write_recordings",
]

_MODULES = {
    "Diagnosis": "siq.mismatch.diagnosis",
    "Diffusion": "siq.dynamics.diffusion",
    "Dynamics": "siq.dynamics.dynamics",
    "EquationSettings": "siq.steps.equations",
    "Formula": "siq.dynamics.exports",
    "InputError": "siq.errors",
    "Landscape": "siq.landscape.landscape",
    "MismatchStudy": "siq.mismatch.study",
    "MissingExtra": "siq.errors",
    "NoLandscape": "siq.landscape.refusal",
    "NumericalFailure": "siq.errors",
    "PipelineSettings": "siq.steps.pipeline",
    "Recordings": "siq.data.recordings",
    "RegressionOptions": "siq.networks.regression",
    "SimulationOptions": "siq.dynamics.simulation",
    "Study": "siq.study.study",
    "Sweep": "siq.steps.sweep",
    "SymbolicDecomposition": "siq.potential.symbolic",
    "TrainingOptions": "siq.networks.options",
    "candidate_library": "siq.identify.library",
    "diagnose": "siq.mismatch.diagnosis",
    "inspect": "siq.data.inspection",
    "load_study": "siq.study.study",
    "load_system": "siq.dynamics.cards",
    "parse_formula": "siq.dynamics.formulas",
    "plot_barriers": "siq.report.plots.barriers",
    "plot_diagnosis": "siq.report.plots.diagnosis",
    "plot_paths": "siq.report.plots.wells",
    "plot_quasipotential": "siq.report.plots.quasipotential",
    "plot_residuals": "siq.report.plots.residuals",
    "plot_wells": "siq.report.plots.wells",
    "probability_of_tipping": "siq.steps.tipping",
    "read_case": "siq.mismatch.case",
    "read_model": "siq.potential.storage",
    "read_recordings": "siq.data.recordings",
    "reference_systems": "siq.reference.systems",
    "reference_table": "siq.reference.system_table",
    "simulate_snapshots": "siq.dynamics.simulation",
    "snapshot_pairs": "siq.data.recordings",
    "solve_case": "siq.mismatch.diagnosis",
    "sparse_decomposition": "siq.networks.regression",
    "sweep": "siq.steps.sweep",
    "train": "siq.networks.training",
    "write_recordings": "siq.data.recordings",
}


def __getattr__(name: str) -> Any:
    if name == "__version__":
        value: Any = importlib.import_module("siq.version").version()
    elif name in _MODULES:
        value = getattr(importlib.import_module(_MODULES[name]), name)
    else:
        raise AttributeError(f"module 'siq' has no attribute '{name}'")
    globals()[name] = value  # found once
    return value


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
