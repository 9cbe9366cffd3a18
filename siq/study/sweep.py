"""Which values does a study give a control parameter?"""

from __future__ import annotations

from decimal import Decimal
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, model_validator

from siq.dynamics.cards import Name, Number

MOST_POINTS = 10_000  # values of one parameter, or of two together: a slip of the step would ask for more


class SweptParameter(BaseModel):
    """The values of one parameter.

    Attributes
    ----------
    parameter
        Name of a parameter of the card.
    from, to, step
        The first and the last value, and how far they are apart; in Python `first` and `last`.
    values
        The values one by one, in the place of these three.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, populate_by_name=True)

    parameter: Name
    first: Annotated[Number | None, Field(alias="from")] = None
    last: Annotated[Number | None, Field(alias="to")] = None
    step: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = None
    values: Annotated[tuple[Number, ...], Field(min_length=1)] | None = None

    @model_validator(mode="after")
    def _said_once(self) -> SweptParameter:
        ends = (self.first, self.last, self.step)
        if self.values is not None and any(one is not None for one in ends):
            raise ValueError("values are given twice; write either 'values' or 'from', 'to' and 'step'")
        if self.values is None and any(one is None for one in ends):
            raise ValueError(
                f"the values of {self.parameter} are not known; write 'from', 'to' and 'step', or 'values'"
            )
        if self.first is not None and self.last is not None and not self.first < self.last:
            raise ValueError("'from' does not lie below 'to'; exchange them")
        if self.first is not None and self.last is not None and self.step is not None:
            if self.step > self.last - self.first:
                raise ValueError("the step is longer than the range; shorten it")
            if (self.last - self.first) / self.step > MOST_POINTS:
                raise ValueError(f"these are more than {MOST_POINTS} values; lengthen the step")
        return self

    @property
    def numbers(self) -> tuple[float, ...]:
        """The values in rising order, each as somebody would write it: 8.1, and not 8.100000000000001."""
        if self.values is not None:
            return tuple(sorted(set(self.values)))
        first, last, step = (Decimal(repr(one)) for one in (self.first, self.last, self.step))
        return tuple(float(first + k * step) for k in range(int((last - first) / step) + 1))


class SweepOptions(SweptParameter):
    """One parameter, or two for a map.

    Attributes
    ----------
    second
        A second parameter: then every value of the first one is combined with every value of this one, and
        there is a map in the place of branches.
    """

    second: SweptParameter | None = None

    @model_validator(mode="after")
    def _two(self) -> SweepOptions:
        if self.second is None:
            return self
        if self.second.parameter == self.parameter:
            raise ValueError(f"'{self.parameter}' is swept twice; name another parameter as the second")
        if len(self.numbers) * len(self.second.numbers) > MOST_POINTS:
            raise ValueError(f"the map has more than {MOST_POINTS} points; lengthen a step")
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


def point_name(names: tuple[str, ...], values: tuple[float, ...]) -> str:
    """How the file of a point is called: ``K=8.1``, or ``K=8.1,h=0.5``."""
    return ",".join(f"{name}={value:.12g}" for name, value in zip(names, values, strict=True))


def point_values(name: str) -> tuple[tuple[str, ...], tuple[float, ...]]:
    """Names and values of a point from the name of its file."""
    parts = [one.partition("=") for one in name.split(",")]
    return tuple(part[0] for part in parts), tuple(float(part[2]) for part in parts)
