"""Places: where a function without a name may stand, and of which coordinates.

A function of one coordinate - a state, an input, time, the amplitude of a rotating frame - may be missing
in an equation or in what is measured, alone or as the coefficient of another coordinate. In every place it
is offered as a natural cubic spline, of which the data are asked for the values at the knots.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import scipy.interpolate
import sympy

from siq.dynamics.dynamics import Dynamics
from siq.dynamics.formulas import compile_values, exact_number
from siq.dynamics.parametric import Signals, symbol
from siq.estimation.fit import Fit
from siq.estimation.linearisation import Grid, Linearisation
from siq.estimation.measurements import Measurements
from siq.mismatch.roles import Roles
from siq.mismatch.screening import probe_response
from siq.mismatch.structure import SUBSTEPS

KNOTS = 17  # enough for the shortest length of `siq.mismatch.evidence.LENGTHS`, two for each
NUMBERS = 40_000_000  # of a linearisation held at a time, which is a third of a gigabyte


@dataclass(frozen=True)
class Place:
    """Where a function may stand, and of what.

    Attributes
    ----------
    equations, outputs
        What the function is multiplied by, in each equation, or each output, in which it stands.
    coordinate
        What it is a function of.
    words
        The coordinates in words of the system, the one that it is a function of first.
    knots
        Of the spline: quantiles of the coordinate, shape ``(k,)``.
    """

    equations: tuple[tuple[str, sympy.Expr], ...]
    outputs: tuple[tuple[str, sympy.Expr], ...]
    coordinate: sympy.Expr
    words: tuple[str, ...]
    knots: np.ndarray

    @property
    def coordinates(self) -> tuple[sympy.Expr, ...]:
        """What it is a function of: a single coordinate."""
        return (self.coordinate,)

    @property
    def width(self) -> int:
        """The number of its values."""
        return len(self.knots)

    def values(self, courses: np.ndarray) -> np.ndarray:
        """What a unit at each knot does along courses ``(1, n)`` of the coordinate, shape ``(k, n)``."""
        return cardinal_splines(self.knots, courses[0])

    @property
    def targets(self) -> tuple[str, ...]:
        """Names of the states or outputs that it changes."""
        return tuple(name for name, _ in (*self.equations, *self.outputs))


class PlacedFunction(Protocol):
    """A function with linear parameters, such as values at knots, in a place; see `Place`."""

    @property
    def equations(self) -> tuple[tuple[str, sympy.Expr], ...]:
        """What it is multiplied by in each equation."""

    @property
    def outputs(self) -> tuple[tuple[str, sympy.Expr], ...]:
        """What it is multiplied by in each output."""

    @property
    def coordinates(self) -> tuple[sympy.Expr, ...]:
        """What it is a function of."""

    @property
    def width(self) -> int:
        """The number of its parameters."""

    def values(self, courses: np.ndarray) -> np.ndarray:
        """What a unit of each does along courses ``(c, n)`` of the coordinates, shape ``(width, n)``."""


class PlaceColumns:
    """Functions in many places, as `siq.estimation.linearisation.linearise` wants them."""

    def __init__(self, model: Dynamics, grid: Grid, places: Sequence[PlacedFunction]) -> None:
        self._model, self._grid, self._places = model, grid, places
        self.width = sum(each.width for each in places)
        names = (*model.states, *(entry.name for entry in model.inputs), "t")
        arguments = [symbol(name) for name in names]
        self._compiled = [
            compile_values(
                [*each.coordinates, *(factor for _, factor in (*each.equations, *each.outputs))],
                arguments,
                common=False,
            )
            for each in places
        ]

    def rates(self, x: np.ndarray, values: np.ndarray, node: int) -> np.ndarray:
        """See `siq.estimation.linearisation.Columns`."""
        return self._filled(x, self._grid.signals(node, ()), measured=False)

    def outputs(self, x: np.ndarray, values: np.ndarray) -> np.ndarray:
        """See `siq.estimation.linearisation.Columns`."""
        return self._filled(x, self._grid.at_samples(()), measured=True)

    def _filled(self, x: np.ndarray, signals: Signals, *, measured: bool) -> np.ndarray:
        names = list(self._model.output_names if measured else self._model.states)
        result = np.zeros((len(names), self.width, x.shape[1]))
        begin = 0
        for place, compiled in zip(self._places, self._compiled, strict=True):
            end = begin + place.width
            targets = place.outputs if measured else place.equations
            if targets:
                known = compiled(*x, *signals.inputs, signals.t)
                courses = [np.broadcast_to(each, x.shape[1]) for each in known[: len(place.coordinates)]]
                values = place.values(np.stack(courses))
                for (name, _), factor in zip(targets, known[len(place.coordinates) :], strict=True):
                    result[names.index(name), begin:end] = values * factor
            begin = end
        return result


def cardinal_splines(knots: np.ndarray, course: np.ndarray) -> np.ndarray:
    """Natural cubic splines that are one at one knot and zero at the others, shape ``(k, n)``.

    What lies beyond the knots has the value at the last one.
    """
    course = np.clip(course, knots[0], knots[-1])
    return scipy.interpolate.make_interp_spline(knots, np.eye(len(knots)), bc_type="natural")(course).T


def places_in(model: Dynamics, roles: Roles, data: Measurements, x: np.ndarray) -> tuple[Place, ...]:
    """Functions of one coordinate, in every equation that says more than a definition, and in every output.

    In a rotating frame they are also those of amplitude and time, along the state and across it.

    Parameters
    ----------
    model, roles
        The simulation, and the roles of its states.
    data, x
        The recordings and the states along them, shape ``(n, d)``: knots are quantiles of these.
    """
    found: list[Place] = []
    one = sympy.Integer(1)
    coordinates = coordinates_of(model)
    framed = {name for pair in roles.amplitudes for name in pair}
    for first, second in roles.amplitudes:
        a, b = symbol(first), symbol(second)
        along, across = ((first, a), (second, b)), ((first, b), (second, -a))
        found += [
            Place(equations, (), formula, (word,), np.empty(0))
            for word, formula in (("amplitude", sympy.sqrt(a**2 + b**2)), ("t", symbol("t")))
            for equations in (along, across)
        ]
    for name in roles.states:
        found += [
            Place(((name, one),), (), formula, (word,), np.empty(0))
            for word, formula in coordinates.items()
            if not (name in framed and word in framed)
        ]
    values = {symbol(each.name): exact_number(each.value) for each in model.parameters}
    for name, written in model.outputs:
        formula = written.xreplace(values)  # an offset of the sensor is where the fit has it
        own = str(formula) if formula.is_Symbol else name
        found += [
            Place((), ((name, one),), formula, (own,), np.empty(0)),
            Place((), ((name, one),), symbol("t"), ("t",), np.empty(0)),
        ]
    return tuple(_with_knots(found, model, data, x))


def products_in(
    places: Sequence[Place], model: Dynamics, data: Measurements, x: np.ndarray
) -> tuple[Place, ...]:
    """The same functions as coefficients of each other coordinate but time, in the same equations.

    Parameters
    ----------
    places
        Functions of one coordinate.
    model, data, x
        See `places_in`.
    """
    found = [
        replace(
            place,
            equations=tuple((target, factor * formula) for target, factor in place.equations),
            words=(*place.words, name),
        )
        for place in places
        if place.equations
        for name, formula in factors_of(place, model).items()
        if name not in place.words
    ]
    return tuple(_with_knots(found, model, data, x))


def factors_of(place: Place, model: Dynamics) -> dict[str, sympy.Expr]:
    """What a function may be the coefficient of, by name: in a rotating frame only the amplitude."""
    if len(place.equations) > 1:
        first, second = (symbol(name) for name in place.targets)
        return {"amplitude": sympy.sqrt(first**2 + second**2)}
    return {name: formula for name, formula in coordinates_of(model).items() if name != "t"}


def coordinates_of(model: Dynamics) -> dict[str, sympy.Expr]:
    """States, inputs and the time, by name."""
    return {name: symbol(name) for name in (*model.states, *(each.name for each in model.inputs), "t")}


def _with_knots(
    drafts: Sequence[Place], model: Dynamics, data: Measurements, x: np.ndarray
) -> Iterator[Place]:
    """Places with their knots, but for those whose coordinate takes too few values for a function."""
    known: dict[sympy.Expr, np.ndarray] = {}
    for each in drafts:
        if each.coordinate not in known:
            (course,) = courses_of((each.coordinate,), model, data, x)
            finite = course[np.isfinite(course)]
            known[each.coordinate] = (
                np.unique(np.quantile(finite, np.linspace(0, 1, KNOTS))) if len(finite) else np.empty(0)
            )
        if len(known[each.coordinate]) > 3:
            yield replace(each, knots=known[each.coordinate])


def courses_of(
    coordinates: tuple[sympy.Expr, ...], model: Dynamics, data: Measurements, x: np.ndarray
) -> np.ndarray:
    """What formulas of states, inputs and time are along recordings, shape ``(c, n)``.

    Parameters
    ----------
    coordinates
        The formulas.
    model, data, x
        The simulation, the recordings, and the states along them, shape ``(n, d)``.
    """
    names = (*model.states, *(entry.name for entry in model.inputs), "t")
    compiled = compile_values(coordinates, [symbol(name) for name in names], common=False)
    signals = data.signals(data.t, data.recording, delays=())
    values = compiled(*x.T[: model.dimension], *signals.inputs, signals.t)
    return np.stack([np.broadcast_to(each, data.t.shape) for each in values])


def linearised_with_places(
    fit: Fit, data: Measurements, places: Sequence[Place]
) -> Iterator[tuple[Linearisation, Sequence[Place]]]:
    """The linearisation of a fit with the columns of places behind those of its parameters, in portions.

    Parameters
    ----------
    fit, data
        The fit along whose trajectories everything is linear, and what it was made for.
    places
        The functions.
    """
    model = fit.model
    own = len(model.free)
    room = NUMBERS // (len(data.t) * (model.dimension + len(model.outputs))) - own
    at_once = max(room // KNOTS, 1)
    grid = Grid(data, min(fit.substeps, SUBSTEPS))
    for begin in range(0, len(places), at_once):
        some = places[begin : begin + at_once]
        yield probe_response(model, grid, fit, PlaceColumns(model, grid, some)), some
