"""Settings of the analysis: one object for all steps, and how it follows from a study and its card."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Annotated, Any, TypeVar

import numpy as np
from pydantic import ConfigDict, Field, TypeAdapter
from pydantic.dataclasses import dataclass as pydantic_dataclass

from siq.errors import NumericalFailure
from siq.inference.identification import IdentificationOptions
from siq.networks.decomposition import TrainingOptions
from siq.networks.regression import RegressionOptions
from siq.numerics.files import read_document, validate
from siq.quasipotential.certificate_tests import CertificateOptions, PredictionLimits
from siq.quasipotential.landscape import LandscapeOptions
from siq.quasipotential.refinement import RefinementOptions
from siq.systems.cards import DiffusionEntry, SystemCard, diffusion_rows, read_diffusion
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics, symbol
from siq.systems.simulation import SimulationOptions, complete
from siq.workflow.outcomes import METHODS, Method
from siq.workflow.study import Study

STRICT = ConfigDict(extra="forbid")
"""Of every settings class: a key that it does not know is a mistake."""


@pydantic_dataclass(frozen=True, config=STRICT)
class Sampling:
    """How samples make pairs.

    Attributes
    ----------
    pair_step
        Largest time between the two samples of a pair; left out, all neighbours are pairs.
    integrator_step
        Step of the Euler–Maruyama simulation that made the recordings; None where none did.
    """

    pair_step: Annotated[float, Field(gt=0)] | None = None
    integrator_step: Annotated[float, Field(gt=0)] | None = None


@pydantic_dataclass(frozen=True, config=STRICT)
class StateSpace:
    """The states of a study, and D.

    Attributes
    ----------
    names
        Of the states, in order; None where the recordings tell.
    units
        Unit of each state by name, and of the time as ``t``; None where nobody said.
    diffusion
        D: ``identity``, its diagonal, or the matrix, of numbers or formulas of the states, in their units
        squared per unit of time; None where nobody said, see `siq.inference.field_estimate`.
    """

    names: tuple[str, ...] | None = None
    units: dict[str, str] | None = None
    diffusion: DiffusionEntry | None = None

    def noise(self, states: Sequence[str]) -> Diffusion | None:
        """D of the states by their names in formulas, None where nobody said."""
        if self.diffusion is None:
            return None
        return read_diffusion(self.diffusion, [symbol(name) for name in states], None)

    def constant_noise(self, dimension: int) -> Diffusion | None:
        """D of so many states where it is the same everywhere, None where nobody said.

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


Settings = TypeVar("Settings")


@pydantic_dataclass(frozen=True, config=STRICT)
class PipelineSettings:
    """What the analysis of recordings depends on; the defaults need no networks.

    A task of the workflow is told the parts that it names and nothing else: only their change makes
    its results anew; the rest keeps its default.

    Attributes
    ----------
    seed
        Of everything random.
    space
        The states, and D.
    sampling
        How samples make pairs.
    identification, regression, refinement, certificate
        The parameters of the steps.
    training
        How two networks are trained; None trains none, and V comes from the local route alone.
    published_method
        Whether the published regression is made of the networks, beside the refined formulas.
    landscape
        How the landscape is found; None finds none.
    simulation
        What is simulated; None of recordings.
    invariant
        Noise intensities ε for which the invariant distribution is computed.
    """

    seed: int = 0
    space: StateSpace = StateSpace()
    sampling: Sampling = Sampling()
    identification: IdentificationOptions = IdentificationOptions()
    training: TrainingOptions | None = None
    published_method: bool = True
    regression: RegressionOptions = RegressionOptions()
    refinement: RefinementOptions = RefinementOptions()
    certificate: CertificateOptions = CertificateOptions()
    landscape: LandscapeOptions | None = LandscapeOptions()
    simulation: SimulationOptions | None = None
    invariant: tuple[Annotated[float, Field(gt=0)], ...] = ()

    def __post_init__(self) -> None:
        if self.training is not None and self.identification.hidden_velocities:
            raise ValueError(
                "networks know recorded states only, and velocities are hidden; leave 'training' out"
            )

    @property
    def prediction(self) -> PredictionLimits:
        """The certificate's limits for f."""
        return self.certificate.of_f

    @property
    def methods(self) -> tuple[Method, ...]:
        """Whose formulas a run has: without networks there is nothing to regress."""
        return METHODS if self.published_method else (Method.REFINED,)

    def of(self, cls: type[Settings]) -> Settings:
        """The settings of one step that has a class of its own for them."""
        fields = dataclasses.fields(cls)  # type: ignore[arg-type]
        return cls(**{field.name: getattr(self, field.name) for field in fields})

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
        sampling = Sampling(recordings.pair_step, recordings.integrator_step)
    elif system is not None and study.entrance == "trajectories":
        simulation = complete(study.simulation, system).options()
        noisy = simulation.noise_intensity > 0
        step = simulation.pair_step
        sampling = Sampling(step, step / simulation.substeps if noisy else None)
    if system is not None:
        units = dict(zip(system.states, system.units, strict=True)) | {"t": system.time_unit}
        space = StateSpace(system.states, units, system.diffusion.rows)
    else:
        assert recordings is not None  # the schema asks for one of the two
        space = StateSpace(recordings.states, recordings.units, recordings.diffusion)
    networks = study.training is not None
    return PipelineSettings(
        seed=study.seed, space=space, sampling=sampling, identification=study.identification,
        training=study.training, published_method=networks, regression=study.regression,
        refinement=study.refinement.with_routes(networks=networks), certificate=study.certificate,
        landscape=study.landscape, simulation=simulation, invariant=study.invariant,
    )  # fmt: skip


def card_content_beside(card: str | None, names: Sequence[str]) -> list[Any] | None:
    """What a sweep takes from a card, as plain data: all but titles and the values of what is swept."""
    if card is None:
        return None
    said = validate(read_document(card), SystemCard)
    values = {name: entry.value for name, entry in said.parameters.items() if name not in names}
    states = {name: entry.domain for name, entry in said.states.items()}
    return [states, said.equations, said.diffusion, values, list(said.parameters)]


def card_content(system: Dynamics | None) -> list[Any] | None:
    """What a simulation takes from a card, as plain data: states, domain, formulas, D.

    A change of the card's title, or of its exact answer, changes nothing of it.
    """
    if system is None:
        return None
    formulas = [str(equation) for equation in system.formulas]
    domain = None if system.domain is None else system.domain.tolist()
    return [list(system.states), domain, formulas, system.diffusion.rows]
