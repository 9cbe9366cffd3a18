"""What is asked of a landscape: how its formulas are found, and what is said of transitions."""

from __future__ import annotations

from typing import Annotated

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

Degree = Annotated[int, Field(ge=2, le=16)]


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class LandscapeOptions:
    """How local formulas are found, and what is said of transitions.

    Attributes
    ----------
    degrees
        Highest powers that are tried, one after the other.
    reach
        Level up to which formulas are sought, as a share of the lowest barrier by least action.
    tolerance
        Largest relative Hamilton–Jacobi residual at a point where a formula is believed.
    compare_below
        U below which formulas are compared with the references, where there is a card; by default 1.1 of the
        highest saddle.
    noise_intensities
        ε of √ε dW for which mean escape times are given, in the units of U, and held against a simulation
        where there is a card.
    """

    degrees: Annotated[tuple[Degree, ...], Field(min_length=1)] = (4, 6, 8, 10, 12)
    reach: Annotated[float, Field(gt=0, le=3)] = 1.2
    tolerance: Annotated[float, Field(gt=0, lt=1)] = 0.05
    compare_below: Annotated[float, Field(gt=0)] | None = None
    noise_intensities: tuple[Annotated[float, Field(gt=0)], ...] = ()
