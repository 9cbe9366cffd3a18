"""The settings of a step, as a study and its card say them."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, TypeVar

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass as pydantic_dataclass

from siq.errors import NumericalFailure
from siq.numerics.files import read_document, validate
from siq.quasipotential.certificate_tests import PredictionLimits
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


@dataclass(frozen=True)
class StudyParts:
    """What a study says, by the names that the settings of steps have for it.

    Whatever is not listed here is the study's own key of that name.

    Attributes
    ----------
    study
        The checked study, as a whole.
    system
        Its system, where it names one.
    """

    study: Study
    system: Dynamics | None

    @property
    def simulation(self) -> SimulationOptions | None:
        """What is simulated; None of recordings, so that nothing runs again for it."""
        if self.study.recordings is not None or self.system is None:
            return None
        return complete(self.study.simulation, self.system).options()

    @property
    def sampling(self) -> Sampling:
        """How samples make pairs: as the simulation had it, or as the study says of its recordings."""
        if self.study.recordings is not None:
            return Sampling(self.study.recordings.pair_step, self.study.recordings.integrator_step)
        options = self.simulation
        assert options is not None  # what is not recorded is simulated
        noisy = options.noise_intensity > 0
        return Sampling(options.pair_step, options.pair_step / options.substeps if noisy else None)

    @property
    def space(self) -> StateSpace:
        """The states, their units and D, of the card where there is one."""
        if self.system is not None:
            units = dict(zip(self.system.states, self.system.units, strict=True))
            units["t"] = self.system.time_unit
            return StateSpace(self.system.states, units, self.system.diffusion.rows)
        recordings = self.study.recordings
        assert recordings is not None  # the schema asks for one of the two
        return StateSpace(recordings.states, recordings.units, recordings.diffusion)

    @property
    def hidden_velocities(self) -> bool:
        """Whether the recordings are positions, whose velocities are states, too."""
        return self.study.identification.hidden_velocities

    @property
    def refinement(self) -> RefinementOptions:
        """How V is refined, by the routes that there are."""
        return self.study.refinement.with_routes(networks=self.study.training is not None)

    @property
    def methods(self) -> tuple[Method, ...]:
        """Whose formulas a run has: without networks there is nothing to regress."""
        return METHODS if self.study.training is not None else (Method.REFINED,)

    @property
    def prediction(self) -> PredictionLimits:
        """The certificate's limits for f."""
        return self.study.certificate.of_f

    @property
    def domain(self) -> tuple[tuple[float, float], ...] | None:
        """The box that the card says, in the states' units."""
        if self.system is None or self.system.domain is None:
            return None
        return tuple((float(low), float(high)) for low, high in self.system.domain)

    def part(self, name: str) -> Any:
        """One part by its name."""
        return getattr(self, name) if hasattr(self, name) else getattr(self.study, name)


def settings_of(cls: type[Settings], study: Study, system: Dynamics | None) -> Settings:
    """The settings of a step, each field from the part of the study of the same name.

    Parameters
    ----------
    cls
        A settings class, such as `siq.workflow.identification_step.IdentifySettings`.
    study, system
        The checked study, and its system where it names one.
    """
    parts = StudyParts(study, system)
    named = {field.name: parts.part(field.name) for field in dataclasses.fields(cls)}  # type: ignore[arg-type]
    return cls(**named)


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
