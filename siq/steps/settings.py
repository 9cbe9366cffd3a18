"""What several steps are told alike: how samples make pairs, and what their states are."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from siq.dynamics.cards import DiffusionEntry, diffusion_rows, read_diffusion
from siq.dynamics.diffusion import Diffusion
from siq.dynamics.parametric import symbol
from siq.errors import NumericalFailure

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
        D: ``identity``, its diagonal, or the matrix, of numbers or formulas of the states, in their units
        squared per unit of time; None where nobody said, see `siq.identify.diffusion`.
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
