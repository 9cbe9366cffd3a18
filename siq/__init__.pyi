"""The public names of `siq` and where they are; `siq/__init__.py` loads each when it is first used."""

from siq.data.inspection import inspect as inspect
from siq.data.recordings import (
    Recordings as Recordings,
    read_recordings as read_recordings,
    snapshot_pairs as snapshot_pairs,
    write_recordings as write_recordings,
)
from siq.diagnosis.diagnosis import Diagnosis as Diagnosis, diagnose as diagnose, solve_case as solve_case
from siq.diagnosis.study import MismatchStudy as MismatchStudy, read_case as read_case
from siq.errors import (
    InputError as InputError,
    MissingExtra as MissingExtra,
    NumericalFailure as NumericalFailure,
)
from siq.inference.library import candidate_library as candidate_library
from siq.networks.decomposition import TrainingOptions as TrainingOptions
from siq.networks.regression import (
    RegressionOptions as RegressionOptions,
    sparse_decomposition as sparse_decomposition,
)
from siq.networks.training import train as train
from siq.quasipotential.fokker_planck import Rotation as Rotation
from siq.quasipotential.formulas import (
    SymbolicDecomposition as SymbolicDecomposition,
    read_model as read_model,
)
from siq.quasipotential.landscape import Landscape as Landscape, NoLandscape as NoLandscape
from siq.quasipotential.landscape_assembly import EquationSettings as EquationSettings
from siq.report.plots.diagnosis import plot_diagnosis as plot_diagnosis
from siq.report.plots.prediction import plot_residuals as plot_residuals
from siq.report.plots.quasipotential import plot_quasipotential as plot_quasipotential
from siq.report.plots.wells import (
    plot_barriers as plot_barriers,
    plot_paths as plot_paths,
    plot_wells as plot_wells,
)
from siq.systems.cards import load_system as load_system
from siq.systems.diffusion import Diffusion as Diffusion
from siq.systems.dynamics import Dynamics as Dynamics
from siq.systems.formulas import Formula as Formula, parse_formula as parse_formula
from siq.systems.simulation import (
    SimulationOptions as SimulationOptions,
    simulate_snapshots as simulate_snapshots,
)
from siq.validation.reference_systems import (
    reference_systems as reference_systems,
    reference_table as reference_table,
)
from siq.workflow.pipeline import PipelineSettings as PipelineSettings
from siq.workflow.study import Study as Study, load_study as load_study
from siq.workflow.sweep import Sweep as Sweep, sweep as sweep
from siq.workflow.tipping import (
    early_warning as early_warning,
    probability_of_tipping as probability_of_tipping,
)

__all__: list[str]
__version__: str
_MODULES: dict[str, str]
