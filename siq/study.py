"""Studies: what is asked, of which data, with which parameters at every step.

A study (``config/studies/NAME.yaml``) is checked against this schema before any job starts; what it leaves
out takes the schema's defaults. The options of a step stand beside the step (`siq.simulate`,
`siq.decomposition`, `siq.regression`), so that neither can drift from the other.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from siq.certificate import CertificateOptions
from siq.decomposition.options import TrainingOptions
from siq.documents import read_document, validate
from siq.errors import InputError
from siq.expressions import FormulaError
from siq.identification import IdentificationOptions
from siq.landscape.options import LandscapeOptions
from siq.library import candidate_library
from siq.refinement import RefinementOptions
from siq.regression import RegressionOptions
from siq.simulate import SimulationOptions, sampling_stride
from siq.systems import Diffusion, Name, System, diffusion_matrix, load_system

NAME = r"^[A-Za-z0-9][A-Za-z0-9_.-]*$"


class RecordingsOptions(BaseModel):
    """Recordings in the place of a simulation.

    Attributes
    ----------
    file
        Parquet, CSV, HDF5 or MATLAB file with columns ``recording``, ``t`` and the states; a relative
        path starts from the folder in which the workflow runs, or else from ``SIQ_RESOURCES``.
    states
        The columns that are states, in order; by default the system's, or all of the file's.
    pair_step
        Consecutive samples no further apart than this are pairs; by default all are.
    diffusion
        D, in the recordings' units, where no system gives it; by default the identity.
    integrator_step
        Step of the Euler–Maruyama simulation that made the recordings, where one did: its increments are
        those of a map, from which the continuous process is then found. Leave it out for measurements.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    file: str
    states: Annotated[tuple[Name, ...], Field(min_length=1)] | None = None
    pair_step: Annotated[float, Field(gt=0)] | None = None
    diffusion: Diffusion | None = None
    integrator_step: Annotated[float, Field(gt=0)] | None = None

    @field_validator("states")
    @classmethod
    def _distinct(cls, states: tuple[str, ...] | None) -> tuple[str, ...] | None:
        if states is not None and len(set(states)) < len(states):
            raise ValueError("a state is named twice; name each once")
        return states


class Study(BaseModel):
    """The schema of a study.

    Attributes
    ----------
    name
        Names the folder of the results.
    title
        What the report is headed.
    system
        Name of a system card, or path of one. Simulated, unless there are recordings; then it only lends
        its states, units, D and exact answers.
    recordings
        Measured trajectories in the place of a simulation.
    runs
        Number of independent runs: fresh initial states, or resampled recordings, and fresh networks.
    seed
        Seed of everything random.
    published
        Name of a file of published figures to be set beside the results.
    simulation, identification, training, regression, refinement, certificate
        The parameters of the steps.
    invariant
        Noise intensities ε for which the invariant distribution is computed, and simulated.
    landscape
        How the landscape is found: equilibria, a formula for each well, barriers, paths and escape times;
        ``{}`` takes the defaults. Left out: none is found.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str = Field(pattern=NAME)
    title: str = ""
    system: str | None = None
    recordings: RecordingsOptions | None = None
    runs: Annotated[int, Field(ge=1, le=10_000)] = 50
    seed: Annotated[int, Field(ge=0)] = 0
    published: str | None = None
    simulation: SimulationOptions = SimulationOptions()
    identification: IdentificationOptions = IdentificationOptions()
    training: TrainingOptions = TrainingOptions()
    regression: RegressionOptions = RegressionOptions()
    refinement: RefinementOptions = RefinementOptions()
    certificate: CertificateOptions = CertificateOptions()
    invariant: tuple[Annotated[float, Field(gt=0)], ...] = ()
    landscape: LandscapeOptions | None = None

    @field_validator("published")
    @classmethod
    def _plain_name(cls, value: str | None) -> str | None:
        if value is not None and not value.replace("-", "").replace("_", "").isalnum():
            raise ValueError(f"'{value}' is no name of published figures; use letters, digits, '-' and '_'")
        return value

    @model_validator(mode="after")
    def _has_data(self) -> Study:
        if self.system is None and self.recordings is None:
            raise ValueError("the study names no data; add 'system: NAME' or 'recordings: {file: ...}'")
        if self.system is not None and self.recordings is not None and self.recordings.diffusion is not None:
            raise ValueError("the diffusion is the system's; remove 'recordings.diffusion'")
        sampling_stride(self.simulation)
        return self


class PublishedFigure(BaseModel):
    """A number that somebody published, to be set beside ours; it is never an input of any method.

    Attributes
    ----------
    mean, standard_deviation
        As published.
    rounding
        Half a unit of the last digit that was printed, where that matters.
    source
        Where it stands, and how many runs it is of.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    mean: float
    standard_deviation: float | None = None
    rounding: Annotated[float, Field(ge=0)] = 0.0
    source: str


class PublishedMesh(BaseModel):
    """U of two states on the nodes of a rectangular mesh that somebody published.

    Attributes
    ----------
    file
        A MATLAB file with one matrix, the first state along its rows; sought in ``SIQ_RESOURCES``.
    box
        The first and the last node along each state.
    times
        U is so many times what the file holds, up to a constant.
    source
        Where it was published.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    file: str
    box: tuple[tuple[float, float], tuple[float, float]]
    times: float = 1.0
    source: str


class PublishedFigures(BaseModel):
    """Published figures by the quantity that they are of: ``rrmse``, ``U:x**2``, ``network_error``."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    title: str
    figures: dict[str, PublishedFigure]
    mesh: PublishedMesh | None = None


def load_study(path: str | Path) -> Study:
    """Read and check a study file.

    Raises
    ------
    InputError
        With the file, the line and the remedy, for whatever the schema refuses.
    """
    return validate(read_document(path), Study)


def load_published(path: str | Path) -> PublishedFigures:
    """Read and check a file of published figures; raises `InputError` as `load_study` does."""
    return validate(read_document(path), PublishedFigures)


def load_study_system(study: Study, *, file: str, systems: Path) -> System | None:
    """The system of a study, checked together with what the study asks of it.

    Parameters
    ----------
    study
        The study.
    file
        Its file, for messages.
    systems
        Folder of the cards that studies name.

    Raises
    ------
    InputError
        When the card is missing or refused, or the study's library or D does not fit the states.
    """
    system = None if study.system is None else load_system(system_path(study.system, systems=systems))
    states = system.states if system is not None else None
    if study.recordings is not None and study.recordings.states is not None:
        if system is not None and study.recordings.states != system.states:
            raise InputError(
                file, "recordings.states", f"the states are not those of the system '{system.name}'",
                f"name {', '.join(system.states)}, in this order, or leave them out",
            )  # fmt: skip
        states = study.recordings.states
    if states is not None:
        check_states(study, states, file=file)
    return system


def check_states(study: Study, states: Sequence[str], *, file: str) -> None:
    """Check what a study says of its states, once these are known.

    Raises
    ------
    InputError
        When the library's functions or D do not fit the states.
    """
    try:
        if study.recordings is not None and study.system is None:
            diffusion_matrix(study.recordings.diffusion or "identity", len(states))
    except ValueError as error:
        fault, remedy = str(error).split("; ", 1)
        raise InputError(file, "recordings.diffusion", fault, remedy) from None
    for step, functions in (
        ("identification", study.identification.functions),
        ("regression", study.regression.functions),
    ):
        try:
            candidate_library(states, degree=1, further=functions)
        except FormulaError as error:
            raise InputError(file, f"{step}.functions", error.fault, error.remedy) from None


def system_path(system: str, *, systems: Path) -> Path:
    """The card that a study means: a path as it stands, a name within the folder of cards."""
    if system.endswith((".yaml", ".yml")):
        return Path(system)
    return systems / f"{system}.yaml"
