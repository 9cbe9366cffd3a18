"""Studies: what is asked, of which data, with which parameters at every step.

A study (``config/studies/NAME.yaml``) is checked against this schema before any job starts; what it leaves
out takes the schema's defaults. The options of a step stand beside the step (`siq.dynamics.simulation`,
`siq.networks`, `siq.networks.regression`), so that neither can drift from the other.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from siq.certificate.tests import CertificateOptions
from siq.data.headings import read_heading, usable_name
from siq.dynamics.cards import DiffusionEntry, Name
from siq.dynamics.dynamics import Dynamics
from siq.dynamics.sampling import SimulationEntry, complete
from siq.files.documents import read_document, validate
from siq.identify.identification import IdentificationOptions
from siq.landscape.options import LandscapeOptions
from siq.networks.options import TrainingOptions
from siq.networks.regression import RegressionOptions
from siq.potential.refinement import RefinementOptions
from siq.study.sweep import SweepOptions

Entrance = Literal["trajectories", "equations"]

NAME = r"^[A-Za-z0-9][A-Za-z0-9_.-]*$"


class RecordingsOptions(BaseModel):
    """Recordings in the place of a simulation.

    Attributes
    ----------
    file
        Parquet, CSV, HDF5, MATLAB or NumPy file with columns ``recording``, ``t`` and the states, or a
        folder with one such file for each recording; a relative path starts from the folder of the study, or
        else from the folder in which you work, or from the one that the environment variable
        ``SIQ_RESOURCES`` names.
    states
        The columns that are states, in order, by their headings or by their names in formulas; by default the
        system's, or all of the file's.
    units
        The unit of each state, and of the time as ``t``, where the file does not say; nothing is converted,
        and another unit in the file is refused.
    pair_step
        Consecutive samples no further apart than this are pairs; by default those no further apart than
        one and a half of their median distance, since what is longer is a gap.
    diffusion
        D, in the recordings' units, where no system gives it, in numbers or formulas of the states; by
        default as the noise of the recordings shows it, or else the identity, which states of different units
        refuse. See `siq.identify.diffusion`.
    integrator_step
        Step of the Euler–Maruyama simulation that made the recordings, where one did: its increments are
        those of a map, from which the continuous process is then found. Leave it out for measurements.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    file: str
    states: Annotated[tuple[Name, ...], Field(min_length=1)] | None = None
    units: dict[str, str] | None = None
    pair_step: Annotated[float, Field(gt=0)] | None = None
    diffusion: DiffusionEntry | None = None
    integrator_step: Annotated[float, Field(gt=0)] | None = None

    @field_validator("states", mode="before")
    @classmethod
    def _as_in_formulas(cls, states: object) -> object:
        # Somebody who copies "bead x (µm)" from the file means the state that is called bead_x in formulas.
        if not isinstance(states, list | tuple) or not all(isinstance(each, str) for each in states):
            return states
        return [
            each if each in ("t", "recording") else usable_name(read_heading(each).title) for each in states
        ]

    @field_validator("states")
    @classmethod
    def _distinct(cls, states: tuple[str, ...] | None) -> tuple[str, ...] | None:
        if states is not None and len(set(states)) < len(states):
            raise ValueError("a state is named twice; name each once")
        return states


OF_TRAJECTORIES = (
    "recordings", "runs", "published", "simulation", "identification", "regression", "training",
    "beside_equations",
)  # fmt: skip
"""Keys of a study that equations have no use for."""


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
    from
        Where the landscape comes from, in Python `entrance`. ``trajectories``: recordings, or a simulation of
        the system. ``equations``: the system's equations alone; nothing is simulated, identified or trained.
    recordings
        Measured trajectories in the place of a simulation.
    runs
        Number of independent runs: fresh initial states, or resampled recordings, and fresh networks. One
        is an answer; what the answer varies by is seen in several.
    seed
        Seed of everything random.
    published
        Published figures to be set beside the results: name of a file in ``config/published``, or path of
        one.
    simulation, identification, regression, refinement, certificate
        The parameters of the steps.
    training
        How two networks are trained; ``{}`` takes the defaults. Left out, no networks take part: V comes
        from the local route alone, and the published regression of networks is not made.
    invariant
        Noise intensities ε for which the invariant distribution is computed, and simulated.
    landscape
        How the landscape is found: equilibria, a formula for each well, barriers, paths and escape times;
        by default with the options' own defaults. ``false`` finds none, but for the run that
        the page shows.
    beside_equations
        Whether the landscape of the card's own equations is found, too, and stands beside that of the
        trajectories: barriers, prefactors and mean times. It scores, and is no input of the method.
    sweep
        A control parameter against which the landscape of equations is found, too, or two of them.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, populate_by_name=True)

    name: str = Field(pattern=NAME)
    title: str = ""
    system: str | None = None
    entrance: Annotated[Entrance, Field(alias="from")] = "trajectories"
    recordings: RecordingsOptions | None = None
    runs: Annotated[int, Field(ge=1, le=10_000)] = 1
    seed: Annotated[int, Field(ge=0)] = 0
    published: str | None = None
    simulation: SimulationEntry = SimulationEntry()
    identification: IdentificationOptions = IdentificationOptions()
    training: TrainingOptions | None = None
    regression: RegressionOptions = RegressionOptions()
    refinement: RefinementOptions = RefinementOptions()
    certificate: CertificateOptions = CertificateOptions()
    invariant: tuple[Annotated[float, Field(gt=0)], ...] = ()
    landscape: LandscapeOptions | None = LandscapeOptions()
    beside_equations: bool = False
    sweep: SweepOptions | None = None

    @field_validator("training", "landscape", mode="before")
    @classmethod
    def _switched_off(cls, value: object) -> object:
        return None if value is False else value

    @field_validator("published")
    @classmethod
    def _plain_name(cls, value: str | None) -> str | None:
        if value is None or value.endswith((".yaml", ".yml")):
            return value
        if not value.replace("-", "").replace("_", "").isalnum():
            raise ValueError(f"'{value}' is no name of published figures; use letters, digits, '-' and '_'")
        return value

    @model_validator(mode="after")
    def _has_data(self) -> Study:
        if self.system is None and self.recordings is None:
            raise ValueError("the study names no data; add 'system: NAME' or 'recordings: {file: ...}'")
        if self.system is not None and self.recordings is not None and self.recordings.diffusion is not None:
            raise ValueError("the diffusion is the system's; remove 'recordings.diffusion'")
        if self.identification.hidden_velocities and (self.recordings is None or self.training is not None):
            raise ValueError(
                "'identification.hidden_velocities' is of recordings, and networks know recorded states only;"
                " remove it, or give 'recordings' and leave 'training' out"
            )
        if self.training is None and "network" in (self.refinement.routes or ()):
            raise ValueError(
                "'refinement.routes' names the network route, but no networks are asked for; add"
                " 'training: {}', or leave the routes out"
            )
        if self.beside_equations and (self.system is None or self.landscape is None):
            remedy = "add 'system: NAME'" if self.system is None else "remove 'landscape: false'"
            raise ValueError(
                "'beside_equations' compares the landscape of every run with that of the equations, and one"
                f" of both is missing; {remedy}, or remove it"
            )
        if self.entrance == "equations":
            self._check_equations()
        elif self.sweep is not None:
            raise ValueError("'sweep' belongs to studies of equations; add 'from: equations', or remove it")
        if self.simulation.pair_step is not None and self.simulation.interval is not None:
            self.simulation.options()
        return self

    def _check_equations(self) -> None:
        """Whether a study of equations asks for what only trajectories can give."""
        if self.system is None:
            raise ValueError("'from: equations' needs equations; add 'system: NAME'")
        if self.landscape is None:
            raise ValueError(
                "'from: equations' finds a landscape and nothing else; remove 'landscape: false'"
            )
        for key in OF_TRAJECTORIES:
            if getattr(self, key) != type(self).model_fields[key].get_default():
                raise ValueError(
                    f"'{key}' belongs to studies of trajectories; remove it, or 'from: equations'"
                )


def completed(study: Study, system: Dynamics | None) -> Study:
    """A study with what follows from its system where it says nothing: how this is simulated."""
    if system is None or study.recordings is not None or study.entrance == "equations":
        return study
    return study.model_copy(update={"simulation": complete(study.simulation, system)})


def load_study(path: str | Path) -> Study:
    """Read and check a study file.

    Raises
    ------
    InputError
        With the file, the line and the remedy, for whatever the schema refuses.
    """
    return validate(read_document(path), Study)
