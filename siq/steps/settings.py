"""What several steps are told alike: how samples make pairs, and what their states are."""

from __future__ import annotations

from typing import Annotated

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from siq.dynamics.cards import DiffusionEntry, diffusion_matrix
from siq.dynamics.diffusion import Diffusion

STRICT = ConfigDict(extra="forbid")
"""Of every settings class: a key that it does not know is a mistake."""


@dataclass(frozen=True, config=STRICT)
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


@dataclass(frozen=True, config=STRICT)
class StateSpace:
    """The states of a study, and D.

    Attributes
    ----------
    names
        Of the states, in order; None where the recordings tell.
    units
        Unit of each state by name, and of the time as ``t``; None where nobody said.
    diffusion
        D: ``identity``, its diagonal, or the matrix, in the states' units squared per unit of time; None
        where nobody said, see `siq.identify.diffusion`.
    """

    names: tuple[str, ...] | None = None
    units: dict[str, str] | None = None
    diffusion: DiffusionEntry | None = None

    def noise(self, dimension: int) -> Diffusion | None:
        """D of so many states, None where nobody said."""
        return None if self.diffusion is None else Diffusion(diffusion_matrix(self.diffusion, dimension))

    def unit(self, name: str, *, unknown: str = "") -> str:
        """Unit of a state, or of the time ``t``."""
        return (self.units or {}).get(name, unknown)
