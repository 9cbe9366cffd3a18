"""Terms: unknown functions in an equation, where they may stand and of what.

A function of one coordinate - a state, an input, time, the amplitude of a rotating frame - may be missing
in an equation or in what is measured, alone or as the coefficient of another coordinate. At every place it is
offered as a natural cubic spline, of which the data are asked for the values at the knots; the places are
compared by the evidence of a smooth function (`siq.diagnosis.evidence`). At the likeliest a formula of a few
powers becomes part of the simulation.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal, Protocol

import numpy as np
import scipy.interpolate
import sympy

from siq.diagnosis.dictionary import Roles, unit_of, units_of
from siq.diagnosis.evidence import correlation_time_of, evidence_of_function, orthonormal
from siq.diagnosis.mechanisms import MechanismCandidate
from siq.diagnosis.screening import PROBE_SUBSTEPS, Probe, ProbeColumns, levels_of, probe_response, projected
from siq.errors import NumericalFailure
from siq.inference.kalman_filter import Grid, Linearisation, profile_likelihood, whiten
from siq.inference.maximum_likelihood import Fit
from siq.inference.measurements import Measurements
from siq.systems.dynamics import Dynamics, Parameter, Signals, symbol
from siq.systems.formulas import compile_values, exact_number

Kind = Literal["formula", "curve", "surface", "mechanism"]
FORMULA: Final = "formula"
FUNCTIONS_FITTED = 3  # places in which functions are fitted, the most likely ones: a choice
SPLINE_KNOTS = 17  # enough for the shortest length of `siq.diagnosis.evidence.SMOOTH_LENGTHS`, two for each
LARGEST_LINEARISATION = 40_000_000  # numbers held at a time, which is a third of a gigabyte


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
        """Natural cubic splines that are one at one knot and zero at the others, shape ``(k, n)``.

        What lies beyond the knots has the value at the last one.
        """
        course = np.clip(courses[0], self.knots[0], self.knots[-1])
        unit = np.eye(len(self.knots))
        return scipy.interpolate.make_interp_spline(self.knots, unit, bc_type="natural")(course).T

    @property
    def targets(self) -> tuple[str, ...]:
        """Names of the states or outputs that it changes."""
        return tuple(name for name, _ in (*self.equations, *self.outputs))


class Basis(Protocol):
    """A function with linear parameters, such as values at knots, with its place; see `Place`."""

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
    """Functions in many places, as `siq.inference.kalman_filter.linearise` wants them."""

    def __init__(self, model: Dynamics, grid: Grid, places: Sequence[Basis]) -> None:
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
        """See `siq.inference.kalman_filter.Columns`."""
        return self._filled(x, self._grid.signals(node, ()), measured=False)

    def outputs(self, x: np.ndarray, values: np.ndarray) -> np.ndarray:
        """See `siq.inference.kalman_filter.Columns`."""
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
    found = []
    for place in places:
        factors = {name: formula for name, formula in coordinates_of(model).items() if name != "t"}
        if len(place.equations) > 1:  # in a rotating frame only the amplitude
            first, second = (symbol(name) for name in place.targets)
            factors = {"amplitude": sympy.sqrt(first**2 + second**2)}
        for name, formula in factors.items():
            if place.equations and name not in place.words:
                equations = tuple((target, factor * formula) for target, factor in place.equations)
                found.append(replace(place, equations=equations, words=(*place.words, name)))
    return tuple(_with_knots(found, model, data, x))


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
                np.unique(np.quantile(finite, np.linspace(0, 1, SPLINE_KNOTS)))
                if len(finite)
                else np.empty(0)
            )
        if len(known[each.coordinate]) > 3:
            yield replace(each, knots=known[each.coordinate])


def courses_of(
    coordinates: tuple[sympy.Expr, ...], model: Dynamics, data: Measurements, x: np.ndarray
) -> np.ndarray:
    """What formulas of states, inputs and time are along recordings, shape ``(c, n)``."""
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
    room = LARGEST_LINEARISATION // (len(data.t) * (model.dimension + len(model.outputs))) - own
    at_once = max(room // SPLINE_KNOTS, 1)
    grid = Grid(data, min(fit.substeps, PROBE_SUBSTEPS))
    for begin in range(0, len(places), at_once):
        some = places[begin : begin + at_once]
        yield probe_response(model, grid, fit, PlaceColumns(model, grid, some)), some


@dataclass(frozen=True)
class RankedPlace:
    """A place, the logarithm of its evidence, and the level of process noise at which it is best.

    The evidence is that of a smooth function there over that of none, each at its best level.
    """

    place: Place
    log_evidence: float
    level: float


def rank_places(fit: Fit, data: Measurements, roles: Roles) -> list[RankedPlace]:
    """All places, the one in which a smooth function is likeliest first.

    Functions of one coordinate are tried everywhere, and as coefficients of other coordinates in the
    equations in which they do best.
    """
    single = places_in(fit.model, roles, data, fit.x)
    ranked = _compared(fit, data, single)
    if not ranked:
        return []
    equations = {each.place.targets for each in ranked[:FUNCTIONS_FITTED] if each.place.equations}
    products = products_in([each for each in single if each.targets in equations], fit.model, data, fit.x)
    return sorted((*ranked, *_compared(fit, data, products)), key=lambda each: -each.log_evidence)


def _compared(fit: Fit, data: Measurements, places: Sequence[Place]) -> list[RankedPlace]:
    parameters = len(fit.model.free)
    found: dict[int, RankedPlace] = {}
    alone = -np.inf
    for response, some in linearised_with_places(fit, data, places):
        for level in levels_of(fit):
            try:
                white = whiten(response, data, fit.noise.scaled(level))
                left, columns = projected(white, parameters)
            except NumericalFailure:  # without process noise an unstable simulation does not follow
                continue
            freedom = white.degrees_of_freedom - parameters
            base = profile_likelihood(float(left @ left), freedom, white.log_determinant)
            alone = max(alone, base)
            begin = 0
            for place in some:
                own = columns[:, begin : begin + len(place.knots)]
                begin += len(place.knots)
                value = base + evidence_of_function(own, left, place.knots, freedom=freedom)
                known = found.get(id(place))
                if own.any() and (known is None or value > known.log_evidence):
                    found[id(place)] = RankedPlace(place, value, level)
    ranked = sorted(found.values(), key=lambda each: -each.log_evidence)
    return [replace(each, log_evidence=each.log_evidence - alone) for each in ranked]


def few_powers(likely: RankedPlace, fit: Fit, data: Measurements, *, degree: int) -> tuple[_Power, ...]:
    """The powers that a formula needs: each added as long as it earns its place (Schwarz).

    Errors count as correlated as all of the powers leave them (`siq.diagnosis.evidence`).
    """
    terms = _powers(likely.place, degree=degree)
    probe = Probe(with_formula(fit.model, likely.place, terms), ())
    grid = Grid(data, min(fit.substeps, PROBE_SUBSTEPS))
    columns = ProbeColumns(fit.model, grid, [probe], fit.x, fit.model.values)
    white = whiten(probe_response(fit.model, grid, fit, columns), data, fit.noise.scaled(likely.level))
    left, own = projected(white, len(fit.model.free))
    basis = orthonormal(own)
    rest = left - basis @ (basis.T @ left)
    correlated = correlation_time_of(rest, white.recording, outputs=len(fit.model.outputs))
    count = max(float(white.known.sum()) / correlated, 2.0)  # errors that count as independent
    chosen: list[int] = []
    total = float(left @ left)
    while len(chosen) < len(terms):
        sums = {}
        for place in range(len(terms)):
            if place not in chosen and own[:, place].any():
                some = own[:, [*chosen, place]]
                some = some / np.sqrt((some**2).sum(axis=0))
                sums[place] = float(((left - some @ np.linalg.lstsq(some, left, rcond=1e-9)[0]) ** 2).sum())
        if not sums:
            break
        best = min(sums, key=lambda place: sums[place])
        if count * np.log(total / max(sums[best], 1e-300)) < np.log(count):
            break
        chosen.append(best)
        total = sums[best]
    return tuple(terms[place] for place in sorted(chosen))


def with_formula(model: Dynamics, place: Place, terms: Sequence[_Power]) -> MechanismCandidate:
    """The simulation with a sum of terms in a place, whose coefficients are the amplitudes."""
    names = fresh_names("c", len(terms), model)
    formula = sympy.Add(*(symbol(name) * term.formula for name, term in zip(names, terms, strict=True)))
    units = [unit_in(place, model, term.first, term.second) for term in terms]
    return built(model, _without_factor(place), formula, names, units)


def simplest(place: Place, terms: Sequence[_Power]) -> tuple[Place, tuple[_Power, ...]]:
    """The same terms as a function of the second coordinate alone, where the first is in none of them."""
    if len(place.words) == 1 or any(term.first for term in terms):
        return place, tuple(terms)
    alone = replace(
        _without_factor(place), coordinate=_second_coordinate(place), words=place.words[1:], knots=np.empty(0)
    )
    return alone, tuple(_Power(term.formula, term.second) for term in terms)


def _without_factor(place: Place) -> Place:
    """The same place, but that a function is not multiplied by the second coordinate."""
    factor = _second_coordinate(place)
    return replace(place, equations=tuple((name, each / factor) for name, each in place.equations))


@dataclass(frozen=True)
class _Power:
    """A term of a formula: what it is, and how often either coordinate is a factor of it."""

    formula: sympy.Expr
    first: int
    second: int = 0


def _powers(place: Place, *, degree: int) -> list[_Power]:
    """Monomials of a place's coordinates up to a degree.

    Of a single coordinate there are the odd functions of even degree beside them, such as z∣z∣; a second
    coordinate stands in every term.
    """
    z = place.coordinate
    if len(place.words) > 1:
        factor = _second_coordinate(place)
        return [
            _Power(z**i * factor**j, i, j)
            for i, j in itertools.product(range(degree + 1), range(1, degree + 1))
            if i + j <= degree
        ]
    smooth = [_Power(z**power, power) for power in range(degree + 1)]
    if place.words[0] in ("amplitude", "t"):
        return smooth
    return [*smooth, *(_Power(z ** (power - 1) * sympy.Abs(z), power) for power in range(2, degree + 1, 2))]


def fresh_names(stem: str, count: int, model: Dynamics) -> list[str]:
    """So many numbered names that the model does not have."""
    used = set(model.names)
    free = (f"{stem}_{number}" for number in itertools.count(1) if f"{stem}_{number}" not in used)
    return list(itertools.islice(free, count))


def _second_coordinate(place: Place) -> sympy.Expr:
    """What the function of the first coordinate is multiplied by: the second, or 1."""
    if len(place.words) == 1:
        return sympy.Integer(1)
    if place.words[1] == "amplitude":
        first, second = (symbol(name) for name in place.targets)
        return sympy.sqrt(first**2 + second**2)
    return symbol(place.words[1])


def built(
    model: Dynamics, place: Place, formula: sympy.Expr, names: Sequence[str], units: Sequence[str]
) -> MechanismCandidate:
    """The simulation with a formula in a place, whose amplitudes have names and units."""
    added = {name: formula * factor for name, factor in place.equations}
    read = {name: formula * factor for name, factor in place.outputs}
    augmented = replace(
        model,
        parameters=(
            *model.parameters,
            *(Parameter(name, 0.0, unit) for name, unit in zip(names, units, strict=True)),
        ),
        equations=tuple(
            before + added.get(name, sympy.Integer(0))
            for name, before in zip(model.states, model.equations, strict=True)
        ),
        outputs=tuple((name, before + read.get(name, sympy.Integer(0))) for name, before in model.outputs),
    )
    name = f"a function of {' and '.join(place.words)}"
    where = f"{'the measurement of ' if place.outputs else ''}{', '.join(place.targets)}"
    return MechanismCandidate(
        name=name,
        label=f"{name} in {where}",
        model=augmented,
        amplitudes=tuple(names),
        equations=tuple(name for name, _ in place.equations),
        coordinate="measurement" if place.outputs else ", ".join(place.words),
        changes=tuple({**added, **read}.items()),
    )


def unit_in(place: Place, model: Dynamics, first: int, second: int) -> str:
    """Unit of the coefficient of a term with so many factors of either coordinate, in a place."""
    known = units_of(model)
    units = {"_t": model.time_unit}
    if len(place.equations) > 1:  # of a rotating frame: the function is multiplied by the states themselves
        first_unit = known.get(place.words[0], known[place.targets[0]])
        units |= {"_whole": "1", "_first": first_unit}
    else:
        target = place.targets[0] if place.equations else place.words[0]
        units |= {"_whole": known.get(target, "1"), "_first": known.get(place.words[0], "1")}
    factor = place.words[1] if len(place.words) > 1 else ""
    units["_second"] = known.get(place.targets[0] if factor == "amplitude" else factor, "1")
    per = "/_t" if place.equations else ""
    return unit_of(f"_whole{per}/_first**{first}/_second**{second}", units)


@dataclass(frozen=True)
class FunctionSite:
    """A place where a smooth function may stand, and where the recordings have been there.

    Attributes
    ----------
    place
        In which equation, or output; what it is multiplied by there.
    coordinates
        What it is a function of: one formula, or two.
    words
        The same in words.
    courses
        Their values along the recordings, shape ``(c, n)``.
    """

    place: Place
    coordinates: tuple[sympy.Expr, ...]
    words: tuple[str, ...]
    courses: np.ndarray

    @classmethod
    def of(
        cls, place: Place, words: tuple[str, ...], model: Dynamics, data: Measurements, x: np.ndarray
    ) -> FunctionSite:
        """The site of a function of one coordinate of a place, or of two states or inputs.

        A word of the place that is not among these is a factor of the function.
        """
        coordinates = (place.coordinate,) if len(words) == 1 else tuple(map(symbol, words))
        return cls(place, coordinates, words, courses_of(coordinates, model, data, x))

    @property
    def ranges(self) -> np.ndarray:
        """Of each coordinate, shape ``(c,)``."""
        return np.ptp(self.courses, axis=1)

    @property
    def usable(self) -> bool:
        """Whether every coordinate takes several values, all of them finite."""
        return bool(np.isfinite(self.courses).all() and (self.ranges > 0).all())

    def along(self, model: Dynamics, data: Measurements, x: np.ndarray) -> FunctionSite:
        """The site with the courses of other states, shape ``(n, d)``."""
        return replace(self, courses=courses_of(self.coordinates, model, data, x))
