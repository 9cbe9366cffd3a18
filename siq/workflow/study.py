"""Studies: what is asked, of which data, with which parameters; and the settings of all steps.

A study (``config/studies/NAME.yaml``) is checked against `Study` before any job starts; what it leaves out
takes the schema's defaults. The options of a step stand beside the step, so that neither can drift from the
other. `PipelineSettings` is one object for all steps, and `settings_of` says how it follows from a study
and its card.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from decimal import Decimal
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    TypeAdapter,
    field_validator,
    model_validator,
)
from pydantic.dataclasses import dataclass as pydantic_dataclass

from siq.data.layout import read_heading, usable_name
from siq.errors import Fault, InputError, NumericalFailure, suggestion
from siq.inference.library import IdentificationOptions, candidate_library
from siq.inference.observation import velocity_names
from siq.networks.decomposition import TrainingOptions
from siq.networks.regression import RegressionOptions
from siq.numerics.files import read_document, validate
from siq.quasipotential.certificate_tests import CertificateOptions
from siq.quasipotential.landscape import LandscapeOptions
from siq.quasipotential.landscape_assembly import fault_for_landscape
from siq.quasipotential.refinement import RefinementOptions
from siq.systems.cards import DiffusionEntry, FileName, Name, Number, SystemCard, build_system, diffusion_rows
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics, symbol
from siq.systems.formulas import FormulaError
from siq.systems.simulation import SimulationEntry, SimulationOptions
from siq.workflow.tables import METHODS, Method

MOST_POINTS = 10_000  # values of one parameter, or of two together: a slip of the step would ask for more


class SweptParameter(BaseModel):
    """The values of one parameter."""

    model_config = ConfigDict(extra="forbid", frozen=True, populate_by_name=True)

    #: Name of a parameter of the card
    parameter: Name
    #: The first value, in Python `first`
    first: Annotated[Number | None, Field(alias="from")] = None
    #: The last value, in Python `last`
    last: Annotated[Number | None, Field(alias="to")] = None
    #: How far the values are apart
    step: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = None
    #: The values one by one, in the place of these three
    values: Annotated[tuple[Number, ...], Field(min_length=1)] | None = None

    @model_validator(mode="after")
    def _said_once(self) -> SweptParameter:
        ends = (self.first, self.last, self.step)
        if self.values is not None and any(one is not None for one in ends):
            raise Fault("values are given twice", "write either 'values' or 'from', 'to' and 'step'")
        if self.values is None and any(one is None for one in ends):
            raise Fault(
                f"the values of {self.parameter} are not known", "write 'from', 'to' and 'step', or 'values'"
            )
        if self.first is not None and self.last is not None and not self.first < self.last:
            raise Fault("'from' does not lie below 'to'", "exchange them")
        if self.first is not None and self.last is not None and self.step is not None:
            if self.step > self.last - self.first:
                raise Fault("the step is longer than the range", "shorten it")
            if (self.last - self.first) / self.step > MOST_POINTS:
                raise Fault(f"these are more than {MOST_POINTS} values", "lengthen the step")
        return self

    @property
    def numbers(self) -> tuple[float, ...]:
        """The values in rising order, each as one would write it: 8.1, and not 8.100000000000001."""
        if self.values is not None:
            return tuple(sorted(set(self.values)))
        first, last, step = (Decimal(repr(one)) for one in (self.first, self.last, self.step))
        return tuple(float(first + k * step) for k in range(int((last - first) / step) + 1))


class SweepOptions(SweptParameter):
    """One parameter, or two for a map."""

    #: A second parameter: then every value of the first one is combined with every value of this one, and
    #: there is a map in the place of branches
    second: SweptParameter | None = None

    @model_validator(mode="after")
    def _two(self) -> SweepOptions:
        if self.second is None:
            return self
        if self.second.parameter == self.parameter:
            raise Fault(f"'{self.parameter}' is swept twice", "name another parameter as the second")
        if len(self.numbers) * len(self.second.numbers) > MOST_POINTS:
            raise Fault(f"the map has more than {MOST_POINTS} points", "lengthen a step")
        return self

    @property
    def names(self) -> tuple[str, ...]:
        """Of the parameters."""
        return (self.parameter,) if self.second is None else (self.parameter, self.second.parameter)

    @property
    def points(self) -> tuple[tuple[float, ...], ...]:
        """The values of all parameters at every point."""
        if self.second is None:
            return tuple((one,) for one in self.numbers)
        return tuple((one, other) for one in self.numbers for other in self.second.numbers)

    @property
    def point_names(self) -> list[str]:
        """How the file of each point is called: ``K=8.1``, or ``K=8.1,h=0.5``."""
        pairs = (zip(self.names, values, strict=True) for values in self.points)
        return [",".join(f"{name}={value:.12g}" for name, value in each) for each in pairs]

    @staticmethod
    def of_point(name: str) -> tuple[tuple[str, ...], tuple[float, ...]]:
        """Names and values of the parameters at a point, from the name of its file."""
        parts = [one.partition("=") for one in name.split(",")]
        return tuple(part[0] for part in parts), tuple(float(part[2]) for part in parts)


Entrance = Literal["trajectories", "equations"]


def _usable_path(text: str) -> str:
    if any(each in text for each in "{}\n\0"):
        raise Fault(f"the name of the file '{text}' holds braces or a line break", "rename the file")
    return text


FilePath = Annotated[str, AfterValidator(_usable_path)]
"""Of a file; to the workflow braces are a blank that is filled in."""


class RecordingsOptions(BaseModel):
    """Recordings in the place of a simulation."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    #: Parquet, CSV, HDF5, MATLAB or NumPy file with columns ``recording``, ``t`` and the states, or a folder
    #: with one such file for each recording; a relative path starts from the folder of the study, or else
    #: from the folder in which you work, or from the one that the environment variable ``SIQ_RESOURCES``
    #: names
    file: FilePath
    #: The columns that are states, in order, by their headings or by their names in formulas; by default the
    #: system's, or all of the file's
    states: Annotated[tuple[Name, ...], Field(min_length=1)] | None = None
    #: The unit of each state, and of the time as ``t``, where the file does not say; nothing is converted,
    #: and another unit in the file is refused
    units: dict[str, str] | None = None
    #: Consecutive samples no further apart than this are pairs; by default those no further apart than one
    #: and a half of their median distance, since what is longer is a gap
    pair_step: Annotated[float, Field(gt=0)] | None = None
    #: D, in the recordings' units, where no system gives it, in numbers or formulas of the states; by default
    #: as the noise of the recordings shows it, or else the identity, which states of different units refuse.
    #: See `siq.inference.field_estimate`.
    diffusion: DiffusionEntry | None = None
    #: Step of the Euler–Maruyama simulation that made the recordings, where one did: its increments are those
    #: of a map, from which the continuous process is then found. Leave it out for measurements.
    integrator_step: Annotated[float, Field(gt=0)] | None = None
    #: Whether slow drift of a single recording, the baselines of several that hop and differ in them, and
    #: what only a sensor or a file can have added are taken off: hum, samples that stand apart, and values
    #: that were filled in. It is noted.
    background: bool = True

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
            raise Fault("a state is named twice", "name each once")
        return states


OF_TRAJECTORIES = (
    "recordings", "runs", "published", "simulation", "identification", "regression", "training",
    "beside_equations",
)  # fmt: skip
"""Keys of a study that equations have no use for."""


class Study(BaseModel):
    """The schema of a study."""

    model_config = ConfigDict(extra="forbid", frozen=True, populate_by_name=True)

    #: Names the folder of the results
    name: FileName
    #: What the report is headed
    title: str = ""
    #: Name of a system card, or path of one. Simulated, unless there are recordings; then it only lends its
    #: states, units, D and exact answers.
    system: FilePath | None = None
    #: Where the landscape comes from, in Python `entrance`. ``trajectories``: recordings, or a simulation of
    #: the system. ``equations``: the system's equations alone; nothing is simulated, identified or trained.
    entrance: Annotated[Entrance, Field(alias="from")] = "trajectories"
    #: Measured trajectories in the place of a simulation
    recordings: RecordingsOptions | None = None
    #: Number of independent runs: fresh initial states, or resampled recordings, and fresh networks. One is
    #: an answer; what the answer varies by is seen in several.
    runs: Annotated[int, Field(ge=1, le=10_000)] = 1
    #: Seed of everything random
    seed: Annotated[int, Field(ge=0)] = 0
    #: Published figures to be set beside the results: name of a file in ``config/published``, or path of one
    published: str | None = None
    #: The parameters of the steps
    simulation: SimulationEntry = SimulationEntry()
    #: The parameters of the steps
    identification: IdentificationOptions = IdentificationOptions()
    #: How two networks are trained; ``{}`` takes the defaults. Left out, no networks take part: V comes from
    #: the local route alone, and the published regression of networks is not made.
    training: TrainingOptions | None = None
    #: The parameters of the steps
    regression: RegressionOptions = RegressionOptions()
    #: The parameters of the steps
    refinement: RefinementOptions = RefinementOptions()
    #: The parameters of the steps
    certificate: CertificateOptions = CertificateOptions()
    #: Noise intensities ε for which the invariant distribution is computed, and simulated
    invariant: tuple[Annotated[float, Field(gt=0)], ...] = ()
    #: How the landscape is found: equilibria, a formula for each well, barriers, paths and escape times; by
    #: default with the options' own defaults. ``false`` finds none, but for the run that the page shows.
    landscape: LandscapeOptions | None = LandscapeOptions()
    #: Whether the landscape of the card's own equations is found, too, and stands beside that of the
    #: trajectories: barriers, prefactors and mean times. It scores, and is no input of the method.
    beside_equations: bool = False
    #: A control parameter against which the landscape of equations is found, too, or two of them
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
            raise Fault(f"'{value}' is no name of published figures", "use letters, digits, '-' and '_'")
        return value

    @model_validator(mode="after")
    def _has_data(self) -> Study:
        if self.system is None and self.recordings is None:
            raise Fault("the study names no data", "add 'system: NAME' or 'recordings: {file: ...}'")
        if self.system is not None and self.recordings is not None and self.recordings.diffusion is not None:
            raise Fault("the diffusion is the system's", "remove 'recordings.diffusion'")
        if self.identification.hidden_velocities is True and (
            self.recordings is None or self.training is not None
        ):
            raise Fault(
                "'identification.hidden_velocities' is of recordings, and networks know recorded states only",
                "remove it, or give 'recordings' and leave 'training' out",
            )
        if self.training is None and "network" in (self.refinement.routes or ()):
            raise Fault(
                "'refinement.routes' names the network route, but no networks are asked for",
                "add 'training: {}', or leave the routes out",
            )
        if self.beside_equations and (self.system is None or self.landscape is None):
            remedy = "add 'system: NAME'" if self.system is None else "remove 'landscape: false'"
            raise Fault(
                "'beside_equations' compares the landscape of every run with that of the equations, and one"
                " of both is missing",
                f"{remedy}, or remove it",
            )
        if self.entrance == "equations":  # nothing that only trajectories can give
            if self.system is None:
                raise Fault("'from: equations' needs equations", "add 'system: NAME'")
            if self.landscape is None:
                raise Fault(
                    "'from: equations' finds a landscape and nothing else", "remove 'landscape: false'"
                )
            for key in OF_TRAJECTORIES:
                if getattr(self, key) != type(self).model_fields[key].get_default():
                    remedy = "remove it, or 'from: equations'"
                    raise Fault(f"'{key}' belongs to studies of trajectories", remedy)
        elif self.sweep is not None:
            raise Fault("'sweep' belongs to studies of equations", "add 'from: equations', or remove it")
        if self.simulation.pair_step is not None and self.simulation.interval is not None:
            self.simulation.options()
        return self


def completed(study: Study, system: Dynamics | None) -> Study:
    """A study with what follows from its system where it says nothing: how this is simulated."""
    if system is None or study.recordings is not None or study.entrance == "equations":
        return study
    return study.model_copy(update={"simulation": study.simulation.completed(system)})


def load_study(path: str | Path) -> Study:
    """Read and check a study file; an `InputError` has the file, the line and the remedy."""
    return validate(read_document(path), Study)


def load_study_system(study: Study, card: str | Path | None, *, file: str) -> Dynamics | None:
    """The system of a study, checked together with what the study asks of it; None where it names no card.

    Fails with `InputError` when the card is missing or refused, inputs or the time drive the system, or the
    study's library or D does not fit the states. The file of the study is for messages.
    """
    system = None
    if card is not None:
        document = read_document(card)
        system = build_system(document, validate(document, SystemCard))
        fault = fault_for_landscape(system, directly=study.entrance != "equations")
        if fault is not None:
            keys, what, remedy = fault
            raise InputError(document.file, document.place(keys), what, remedy)
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
    if study.sweep is not None and system is not None:
        known = [each.name for each in system.parameters]
        otherwise = f"use one of {', '.join(known)}" if known else "write it on the card as a parameter"
        for name, place in zip(study.sweep.names, ("parameter", "second.parameter"), strict=False):
            if name not in known:
                lacking = f"the card of '{system.name}' has no parameter '{name}'"
                remedy = suggestion(name, known, otherwise=otherwise)
                raise InputError(file, f"sweep.{place}", lacking, remedy)
    return system


def check_states(study: Study, states: Sequence[str], *, file: str) -> None:
    """Refuse functions of a study's library, or a D, that do not fit its states, once these are known."""
    try:
        if study.recordings is not None and study.recordings.diffusion is not None:
            rows = diffusion_rows(study.recordings.diffusion, len(states))
            if not Diffusion.of_rows([symbol(name) for name in states], rows).regular:
                raise Fault("the noise does not reach every state", "give a positive definite matrix")
    except Fault as error:
        raise error.at(file, "recordings.diffusion") from None
    for step, functions in (
        ("identification", study.identification.functions),
        ("regression", study.regression.functions),
    ):
        try:
            hidden = step == "identification" and study.identification.hidden_velocities is True
            known = (*states, *velocity_names(states)) if hidden else states
            candidate_library(known, degree=1, further=functions)
        except FormulaError as error:
            raise InputError(file, f"{step}.functions", error.fault, error.remedy) from None


STRICT = ConfigDict(extra="forbid")
"""Of every settings class: a key that it does not know is a mistake."""


@pydantic_dataclass(frozen=True, config=STRICT)
class Sampling:
    """How samples make pairs, and what is taken off them."""

    #: Largest time between the two samples of a pair; left out, all neighbours are pairs
    pair_step: Annotated[float, Field(gt=0)] | None = None
    #: Step of the Euler–Maruyama simulation that made the recordings; None where none did
    integrator_step: Annotated[float, Field(gt=0)] | None = None
    #: Whether slow drift, baselines of recordings that differ in them, and faults of sensors are taken off
    background: bool = True


@pydantic_dataclass(frozen=True, config=STRICT)
class StateSpace:
    """The states of a study, and D."""

    #: Of the states, in order; None where the recordings tell
    names: tuple[str, ...] | None = None
    #: Unit of each state by name, and of the time as ``t``; None where not given
    units: dict[str, str] | None = None
    #: D: ``identity``, its diagonal, or the matrix, of numbers or formulas of the states, in their units
    #: squared per unit of time; None where not given, see `siq.inference.field_estimate`
    diffusion: DiffusionEntry | None = None

    def noise(self, states: Sequence[str]) -> Diffusion | None:
        """D of the states by their names in formulas, None where not given."""
        if self.diffusion is None:
            return None
        return Diffusion.of_rows(
            [symbol(name) for name in states], diffusion_rows(self.diffusion, len(states))
        )

    def constant_noise(self, dimension: int) -> Diffusion | None:
        """D of so many states where it is the same everywhere, None where not given.

        Raises
        ------
        NumericalFailure
            Where it depends on the state.
        """
        if self.diffusion is None:
            return None
        rows = diffusion_rows(self.diffusion, dimension)
        if any(isinstance(entry, str) for row in rows for entry in row):
            raise NumericalFailure(
                "networks and their regression know only a noise that is the same everywhere; leave"
                " 'training' out, or give D in numbers"
            )
        return Diffusion(np.array(rows, dtype=float))

    def unit(self, name: str, *, unknown: str = "") -> str:
        """Unit of a state, or of the time ``t``."""
        return (self.units or {}).get(name, unknown)


@pydantic_dataclass(frozen=True, config=STRICT)
class PipelineSettings:
    """What the analysis of recordings depends on; the defaults need no networks.

    A task of the workflow is told the parts that it names and nothing else: only their change makes
    its results anew; the rest keeps its default.
    """

    seed: int = 0  #: of everything random
    space: StateSpace = StateSpace()
    sampling: Sampling = Sampling()  #: how samples make pairs
    identification: IdentificationOptions = IdentificationOptions()
    training: TrainingOptions | None = None  #: of two networks; None: V comes from the local route alone
    published_method: bool = True  #: whether the published regression is made of the networks, too
    regression: RegressionOptions = RegressionOptions()
    refinement: RefinementOptions = RefinementOptions()
    certificate: CertificateOptions = CertificateOptions()
    landscape: LandscapeOptions | None = LandscapeOptions()  #: how it is found; None finds none
    simulation: SimulationOptions | None = None  #: of a system; None of recordings
    invariant: tuple[Annotated[float, Field(gt=0)], ...] = ()  #: ε for which the distribution is computed

    def __post_init__(self) -> None:
        if self.training is None:
            return
        if self.identification.hidden_velocities is True:
            raise Fault(
                "networks know recorded states only, and velocities are hidden", "leave 'training' out"
            )
        object.__setattr__(self, "identification", replace(self.identification, hidden_velocities=False))

    @property
    def methods(self) -> tuple[Method, ...]:
        """Whose formulas a run has: without networks there is nothing to regress."""
        return METHODS if self.published_method else (Method.REFINED,)

    @property
    def noises(self) -> tuple[float, ...]:
        """Noise intensities ε of escape times, none where no landscape is asked for."""
        return () if self.landscape is None else self.landscape.noise_intensities

    def parts(self, names: Sequence[str]) -> dict[str, Any]:
        """Some parts as plain data, from which `PipelineSettings` is made again; ``a.b`` is b of a alone."""
        plain, chosen = TypeAdapter(PipelineSettings).dump_python(self, mode="json"), dict[str, Any]()
        for name in names:
            part, _, inner = name.partition(".")
            chosen[part] = plain[part] if not inner else chosen.get(part, {}) | {inner: plain[part][inner]}
        return chosen


def settings_of(study: Study, system: Dynamics | None) -> PipelineSettings:
    """What a checked study, and its system where it names one, say of every step.

    Of recordings nothing is simulated. States, units and D are those of the system where there is one.
    Pairs of samples are as the simulation had them, or as the study says of its recordings.
    """
    recordings, simulation, sampling = study.recordings, None, Sampling()
    if recordings is not None:
        sampling = Sampling(recordings.pair_step, recordings.integrator_step, recordings.background)
    elif system is not None and study.entrance == "trajectories":
        simulation = study.simulation.completed(system).options()
        noisy = simulation.noise_intensity > 0
        step = simulation.pair_step
        sampling = Sampling(step, step / simulation.substeps if noisy else None)
    if system is not None:
        units = dict(zip(system.states, system.units, strict=True)) | {"t": system.time_unit}
        space = StateSpace(system.states, units, system.diffusion.rows)
    else:
        assert recordings is not None  # the schema asks for one of the two
        space = StateSpace(recordings.states, recordings.units, recordings.diffusion)
    networks, identification = study.training is not None, study.identification
    if system is not None and system.periodic:
        ends = {name: system.limits[system.states.index(name)].tolist() for name in system.periodic}
        identification = replace(identification, angles=ends | identification.angles)
    return PipelineSettings(
        seed=study.seed, space=space, sampling=sampling, identification=identification,
        training=study.training, published_method=networks, regression=study.regression,
        refinement=study.refinement.with_routes(networks=networks), certificate=study.certificate,
        landscape=study.landscape, simulation=simulation, invariant=study.invariant,
    )  # fmt: skip


def card_content_but_for(card: str | None, names: Sequence[str]) -> list[Any] | None:
    """What a sweep takes from a card, as plain data: all but titles and the values of what is swept."""
    if card is None:
        return None
    said = validate(read_document(card), SystemCard)
    values = {name: entry.value for name, entry in said.parameters.items() if name not in names}
    states = {name: entry.model_dump(include={"domain", "periodic"}) for name, entry in said.states.items()}
    return [states, said.equations, said.diffusion, values, list(said.parameters)]


def card_content(system: Dynamics | None) -> list[Any] | None:
    """What a simulation takes from a card, as plain data: states, domain, formulas, D.

    A change of the card's title, or of its exact answer, changes nothing of it.
    """
    if system is None:
        return None
    formulas = [str(equation) for equation in system.formulas]
    domain = None if system.domain is None else system.domain.tolist()
    return [list(system.states), domain, formulas, system.diffusion.rows, *system.periodic]
