"""Effects: functions that are drawn, of one coordinate or two, at a place that is drawn.

Each has one amplitude; its shape is part of the formula. None is taken from any list of physics.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

from benchmarks.proof.cases import rounded

AMPLITUDE = "amp"
IN_SENSOR = 0.15  # share of the effects that sit in a sensor
OF_TWO = 0.25  # share of those in an equation that depend on two coordinates

Range = tuple[float, float]
Law = Callable[[str, Range, np.random.Generator], str]


@dataclass(frozen=True)
class Effect:
    """A function that a card lacks.

    Attributes
    ----------
    law
        Which kind of function.
    place
        The state in whose equation it stands, or the output that a sensor distorts.
    in_sensor
        Which of the two.
    coordinates
        What it depends on.
    text
        The function without its amplitude.
    amplitude
        Its factor.
    """

    law: str
    place: str
    in_sensor: bool
    coordinates: tuple[str, ...]
    text: str
    amplitude: float = 1.0

    @property
    def equations(self) -> tuple[str, ...]:
        """The state in whose equation it stands; none of a sensor."""
        return () if self.in_sensor else (self.place,)

    @property
    def term(self) -> str:
        """What is added, amplitude and function."""
        return f"{AMPLITUDE}*({self.text})"

    def formulas(self) -> dict[str, Any]:
        """What the key says of it."""
        said: dict[str, Any] = {"parameters": {AMPLITUDE: self.amplitude}}
        if self.in_sensor:
            return said | {"outputs": {self.place: f"{self.place} + {self.term}"}}
        return said | {"terms": {self.place: self.term}}


def _at(value: float) -> str:
    return f"({rounded(value)!r})"


def spline(name: str, limits: Range, rng: np.random.Generator) -> str:
    """A natural cubic spline through random values at five to eight knots."""
    knots = np.linspace(*limits, int(rng.integers(5, 9)))
    curve = CubicSpline(knots, rng.normal(size=len(knots)), bc_type="natural")
    jumps = np.diff(np.append(curve.c[0], 0.0), prepend=0.0)
    linear = f"{_at(curve.c[3, 0])} + {_at(curve.c[2, 0])}*({name} - {_at(knots[0])})"
    cubes = [
        f"{_at(jump)}*Max({name} - {_at(knot)}, 0)**3"
        for jump, knot in zip(jumps, knots, strict=True)
        if jump
    ]
    return " + ".join([linear, *cubes])


def bumps(name: str, limits: Range, rng: np.random.Generator) -> str:
    """One to three bumps."""
    width = limits[1] - limits[0]
    parts = [
        f"{_at(rng.choice([-1, 1]) * rng.uniform(0.5, 1.0))}*exp(-(({name} - {_at(rng.uniform(*limits))})"
        f"/{_at(width * rng.uniform(0.08, 0.25))})**2)"
        for _ in range(int(rng.integers(1, 4)))
    ]
    return " + ".join(parts)


def step(name: str, limits: Range, rng: np.random.Generator) -> str:
    """A step that is neither sudden nor in the middle."""
    width = limits[1] - limits[0]
    middle = limits[0] + width * rng.uniform(0.2, 0.8)
    return f"tanh(({name} - {_at(middle)})/{_at(width * rng.uniform(0.03, 0.2))})"


def power(name: str, limits: Range, rng: np.random.Generator) -> str:
    """A power that is no whole number, of the distance from somewhere; odd or even."""
    width = limits[1] - limits[0]
    middle = limits[0] + width * rng.uniform(0.0, 0.6)
    distance = f"(({name} - {_at(middle)})/{_at(width / 2)})"
    odd = f"sign{distance}*" if rng.random() < 0.5 else ""
    exponent = rounded(float(rng.integers(1, 4)) + rng.uniform(0.25, 0.75), 3)
    return f"{odd}Abs{distance}**{exponent!r}"


LAWS: Mapping[str, Law] = {"spline": spline, "bumps": bumps, "step": step, "power": power}


def draw_effect(
    law: str,
    *,
    ranges: Mapping[str, Range],
    acceptors: tuple[str, ...],
    outputs: tuple[str, ...],
    rng: np.random.Generator,
) -> Effect:
    """Draw a function of a kind, its coordinates and its place.

    Parameters
    ----------
    law
        A name of `LAWS`.
    ranges
        Where states, inputs and outputs lie, by name.
    acceptors
        States in whose equations something can be missing.
    outputs
        What sensors measure.
    rng
        Draws.
    """
    if rng.random() < IN_SENSOR:
        place = str(rng.choice(outputs))
        return Effect(law, place, True, (place,), LAWS[law](place, ranges[place], rng))
    place, coordinates = str(rng.choice(acceptors)), list(ranges)
    if rng.random() < OF_TWO and len(coordinates) > 1:
        first, second = map(str, rng.choice(coordinates, 2, replace=False))
        other = str(rng.choice(list(LAWS)))
        shapes = LAWS[law](first, ranges[first], rng), LAWS[other](second, ranges[second], rng)
        return Effect(f"{law} x {other}", place, False, (first, second), f"({shapes[0]})*({shapes[1]})")
    coordinate = str(rng.choice(coordinates))
    return Effect(law, place, False, (coordinate,), LAWS[law](coordinate, ranges[coordinate], rng))
