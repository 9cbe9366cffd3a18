"""The settings of a step, as a study and its card say them."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

from siq.certificate.tests import PredictionLimits
from siq.dynamics.cards import SystemCard
from siq.dynamics.dynamics import Dynamics
from siq.dynamics.sampling import complete
from siq.dynamics.simulation import SimulationOptions
from siq.dynamics.state_noise import diffusion_rows_of
from siq.files.documents import read_document, validate
from siq.potential.refinement import RefinementOptions
from siq.steps.outcomes import METHODS, Method
from siq.steps.settings import Sampling, StateSpace
from siq.study.study import Study

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
            return StateSpace(self.system.states, units, diffusion_rows_of(self.system.diffusion))
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
        A settings class, such as `siq.steps.identify.IdentifySettings`.
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
    return [list(system.states), domain, formulas, diffusion_rows_of(system.diffusion)]
