"""Sparse identification of quasipotentials.

From trajectories of a system with several metastable states to its energy landscape as a formula: the
orthogonal decomposition ``f = -D∇V + g`` with ``∇V·g = 0`` by two networks, and sparse formulas of V, g and
f by constrained regression. U = 2V is the quasipotential. And from a simulation and recordings that differ
to the physics that was left out.

The names below are what users need. Each is loaded when it is first used, since torch takes seconds to
import; ``_NAMES`` says from where. Type checkers read the same names from the block beneath it.
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
    from siq.quasipotential.fokker_planck import Rotation
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
    from siq.workflow.tipping import early_warning, probability_of_tipping

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
    "Rotation",
    "SimulationOptions",
    "Study",
    "Sweep",
    "SymbolicDecomposition",
    "TrainingOptions",
    "candidate_library",
    "diagnose",
    "early_warning",
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

_NAMES = {
    "siq.data.inspection": "inspect",
    "siq.data.recordings": "Recordings read_recordings snapshot_pairs write_recordings",
    "siq.diagnosis.diagnosis": "Diagnosis diagnose solve_case",
    "siq.diagnosis.study": "MismatchStudy read_case",
    "siq.errors": "InputError MissingExtra NumericalFailure",
    "siq.inference.library": "candidate_library",
    "siq.networks.decomposition": "TrainingOptions",
    "siq.networks.regression": "RegressionOptions sparse_decomposition",
    "siq.networks.training": "train",
    "siq.quasipotential.fokker_planck": "Rotation",
    "siq.quasipotential.formulas": "SymbolicDecomposition read_model",
    "siq.quasipotential.landscape": "Landscape NoLandscape",
    "siq.quasipotential.landscape_assembly": "EquationSettings",
    "siq.report.plots.diagnosis": "plot_diagnosis",
    "siq.report.plots.prediction": "plot_residuals",
    "siq.report.plots.quasipotential": "plot_quasipotential",
    "siq.report.plots.wells": "plot_barriers plot_paths plot_wells",
    "siq.systems.cards": "load_system",
    "siq.systems.diffusion": "Diffusion",
    "siq.systems.dynamics": "Dynamics",
    "siq.systems.formulas": "Formula parse_formula",
    "siq.systems.simulation": "SimulationOptions simulate_snapshots",
    "siq.validation.reference_systems": "reference_systems reference_table",
    "siq.workflow.pipeline": "PipelineSettings",
    "siq.workflow.study": "Study load_study",
    "siq.workflow.sweep": "Sweep sweep",
    "siq.workflow.tipping": "early_warning probability_of_tipping",
}
_MODULES = {name: module for module, names in _NAMES.items() for name in names.split()}


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
