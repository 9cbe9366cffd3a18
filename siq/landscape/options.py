"""What is asked of a landscape: comparisons, and escape times."""

from __future__ import annotations

from typing import Annotated

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class LandscapeOptions:
    """With what formulas are compared, and what is said of transitions.

    Attributes
    ----------
    compare_below
        U below which formulas are compared with the references, where there is a card; by default 1.1 of the
        highest saddle.
    noise_intensities
        ε of √ε dW for which mean escape times are given, in the units of U, and held against a simulation
        where there is a card.
    """

    compare_below: Annotated[float, Field(gt=0)] | None = None
    noise_intensities: tuple[Annotated[float, Field(gt=0)], ...] = ()
