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
    from siq.diagnosis.diagnosis import Diagnosis, diagnose, solve_case
    from siq.diagnosis.study import MismatchStudy, read_case
    from siq.errors import InputError, MissingExtra, NumericalFailure
    from siq.inference.library import candidate_library
    from siq.networks.decomposition import TrainingOptions
    from siq.networks.regression import RegressionOptions, sparse_decomposition
    from siq.networks.training import train
    from siq.quasipotential.formulas import SymbolicDecomposition, read_model
    from siq.quasipotential.landscape import Landscape, NoLandscape
    from siq.quasipotential.landscape_assembly import EquationSettings
    from siq.report.plots.diagnosis import plot_diagnosis
    from siq.report.plots.prediction import plot_residuals
    from siq.report.plots.quasipotential import plot_quasipotential
    from siq.report.plots.wells import plot_barriers, plot_paths, plot_wells
    from siq.systems.cards import load_system
    from siq.systems.diffusion import Diffusion
    from siq.systems.dynamics import Dynamics
    from siq.systems.formulas import Formula, parse_formula
    from siq.systems.simulation import SimulationOptions, simulate_snapshots
    from siq.validation.reference_systems import reference_systems, reference_table
    from siq.workflow.pipeline import PipelineSettings
    from siq.workflow.study import Study, load_study
    from siq.workflow.sweep import Sweep, sweep
    from siq.workflow.tipping import probability_of_tipping

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
    "Diagnosis": "siq.diagnosis.diagnosis",
    "Diffusion": "siq.systems.diffusion",
    "Dynamics": "siq.systems.dynamics",
    "EquationSettings": "siq.quasipotential.landscape_assembly",
    "Formula": "siq.systems.formulas",
    "InputError": "siq.errors",
    "Landscape": "siq.quasipotential.landscape",
    "MismatchStudy": "siq.diagnosis.study",
    "MissingExtra": "siq.errors",
    "NoLandscape": "siq.quasipotential.landscape",
    "NumericalFailure": "siq.errors",
    "PipelineSettings": "siq.workflow.pipeline",
    "Recordings": "siq.data.recordings",
    "RegressionOptions": "siq.networks.regression",
    "SimulationOptions": "siq.systems.simulation",
    "Study": "siq.workflow.study",
    "Sweep": "siq.workflow.sweep",
    "SymbolicDecomposition": "siq.quasipotential.formulas",
    "TrainingOptions": "siq.networks.decomposition",
    "candidate_library": "siq.inference.library",
    "diagnose": "siq.diagnosis.diagnosis",
    "inspect": "siq.data.inspection",
    "load_study": "siq.workflow.study",
    "load_system": "siq.systems.cards",
    "parse_formula": "siq.systems.formulas",
    "plot_barriers": "siq.report.plots.wells",
    "plot_diagnosis": "siq.report.plots.diagnosis",
    "plot_paths": "siq.report.plots.wells",
    "plot_quasipotential": "siq.report.plots.quasipotential",
    "plot_residuals": "siq.report.plots.prediction",
    "plot_wells": "siq.report.plots.wells",
    "probability_of_tipping": "siq.workflow.tipping",
    "read_case": "siq.diagnosis.study",
    "read_model": "siq.quasipotential.formulas",
    "read_recordings": "siq.data.recordings",
    "reference_systems": "siq.validation.reference_systems",
    "reference_table": "siq.validation.reference_systems",
    "simulate_snapshots": "siq.systems.simulation",
    "snapshot_pairs": "siq.data.recordings",
    "solve_case": "siq.diagnosis.diagnosis",
    "sparse_decomposition": "siq.networks.regression",
    "sweep": "siq.workflow.sweep",
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
