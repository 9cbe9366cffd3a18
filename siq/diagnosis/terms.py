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
from dataclasses import dataclass, field, replace
from typing import Final, Literal

import numpy as np
import scipy.interpolate
import sympy

from siq.diagnosis.dictionary import Roles, unit_of, units_of
from siq.diagnosis.evidence import correlation_time_of, evidence_of_function, orthonormal
from siq.diagnosis.mechanisms import MechanismCandidate, along, fresh_names, with_added
from siq.diagnosis.screening import (
    PROBE_SUBSTEPS,
    Basis,
    Probe,
    ProbeColumns,
    levels_of,
    probe_response,
    projected,
    slices_of,
)
from siq.errors import NumericalFailure
from siq.inference.kalman_filter import Grid, Linearisation, profile_likelihood, whiten
from siq.inference.maximum_likelihood import Fit
from siq.inference.measurements import Measurements
from siq.systems.dynamics import Dynamics, Parameter, Signals, symbol
from siq.systems.formulas import compile_values, exact_number

Kind = Literal["formula", "curve", "surface", "mechanism"]
FORMULA: Final = "formula"
CURVE: Final = "curve"
SURFACE: Final = "surface"
MECHANISM: Final = "mechanism"
FUNCTIONS_FITTED = 3  # places in which functions are fitted, the most likely ones: a choice
SPLINE_KNOTS = 17  # enough for the shortest length of `siq.diagnosis.evidence.SMOOTH_LENGTHS`, two for each
HAT_KNOTS = 9  # of piecewise linear functions: a choice
TINY_AMPLITUDE = sympy.Float(1e-300)  # so that a system at rest has a direction, which is none
LARGEST_LINEARISATION = 40_000_000  # numbers held at a time, which is a third of a gigabyte
ONE = sympy.Integer(1)
Power = tuple[sympy.Expr, int, int]
"""A term of a formula, and how often the first and the second coordinate are factors of it."""


@dataclass(frozen=True)
class Place:
    """Where a function may stand, and of what; of one coordinate it is a basis of splines.

    Attributes
    ----------
    equations, outputs
        What the function is multiplied by, in each equation, or each output, in which it stands.
    coordinates
        What it is a function of: one formula, or two.
    words
        The coordinates in words of the system. One more than there are coordinates is that of a factor.
    knots
        Of the spline: quantiles of the coordinate, shape ``(k,)``.
    linear
        Whether the spline is piecewise linear, rather than a natural cubic one.
    log_evidence, level
        Logarithm of the evidence of a smooth function here over that of none, each at its best level of
        process noise; and that level (`rank_places`).
    """

    equations: tuple[tuple[str, sympy.Expr], ...]
    outputs: tuple[tuple[str, sympy.Expr], ...]
    coordinates: tuple[sympy.Expr, ...]
    words: tuple[str, ...]
    knots: np.ndarray = field(default_factory=lambda: np.empty(0))
    linear: bool = False
    log_evidence: float = float("nan")
    level: float = 1.0

    @property
    def width(self) -> int:
        """The number of its values."""
        return len(self.knots)

    def values(self, courses: np.ndarray) -> np.ndarray:
        """Splines that are one at one knot and zero at the others, shape ``(k, n)``.

        What lies beyond the knots has the value at the last one.
        """
        unit = np.eye(len(self.knots))
        if self.linear:
            return np.stack([np.interp(courses[0], self.knots, each) for each in unit])
        course = np.clip(courses[0], self.knots[0], self.knots[-1])
        return scipy.interpolate.make_interp_spline(self.knots, unit, bc_type="natural")(course).T

    @property
    def targets(self) -> tuple[str, ...]:
        """Names of the states or outputs that it changes."""
        return tuple(name for name, _ in (*self.equations, *self.outputs))

    @property
    def across(self) -> bool:
        """Whether it is a force across the amplitude of a rotating frame, rather than along it."""
        return len(self.equations) > 1 and self.equations[1][1].could_extract_minus_sign()

    @property
    def factor(self) -> sympy.Expr:
        """The second coordinate, where a function of the first is multiplied by it; else 1."""
        if len(self.words) == 1:
            return ONE
        if self.words[1] == "amplitude":
            return _amplitude(*self.targets)
        return symbol(self.words[1])

    @property
    def without_factor(self) -> Place:
        """The same place, but that a function is not multiplied by the second coordinate."""
        divided = tuple((name, each / self.factor) for name, each in self.equations)
        return replace(self, equations=divided)

    def added_to(
        self, model: Dynamics, formula: sympy.Expr, names: Sequence[str], units: Sequence[str]
    ) -> MechanismCandidate:
        """A simulation with a formula here, whose amplitudes have names and units."""
        added = {name: formula * factor for name, factor in self.equations}
        read = {name: formula * factor for name, factor in self.outputs}
        parameters = [Parameter(name, 0.0, unit) for name, unit in zip(names, units, strict=True)]
        name = f"a function of {' and '.join(self.words)}"
        where = f"{'the measurement of ' if self.outputs else ''}{', '.join(self.targets)}"
        return MechanismCandidate(
            name=name,
            label=f"{name} in {where}",
            model=with_added(model, added, read, parameters),
            amplitudes=tuple(names),
            equations=tuple(name for name, _ in self.equations),
            coordinate="measurement" if self.outputs else ", ".join(self.words),
            changes=tuple({**added, **read}.items()),
        )

    def unit(self, model: Dynamics, first: int, second: int) -> str:
        """Unit of the coefficient of a term with so many factors of either coordinate."""
        known = units_of(model)
        units = {"_t": model.time_unit}
        if (
            len(self.equations) > 1
        ):  # of a rotating frame: the function is multiplied by the states themselves
            first_unit = known.get(self.words[0], known[self.targets[0]])
            units |= {"_whole": "1", "_first": first_unit}
        else:
            target = self.targets[0] if self.equations else self.words[0]
            units |= {"_whole": known.get(target, "1"), "_first": known.get(self.words[0], "1")}
        factor = self.words[1] if len(self.words) > 1 else ""
        units["_second"] = known.get(self.targets[0] if factor == "amplitude" else factor, "1")
        per = "/_t" if self.equations else ""
        return unit_of(f"_whole{per}/_first**{first}/_second**{second}", units)


def _amplitude(first: str, second: str) -> sympy.Expr:
    return sympy.sqrt(symbol(first) ** 2 + symbol(second) ** 2)


class PlaceColumns:
    """Functions in many places, as `siq.inference.kalman_filter.linearise` wants them; splines by default."""

    def __init__(
        self, model: Dynamics, grid: Grid, places: Sequence[Place], bases: Sequence[Basis] | None = None
    ) -> None:
        self._model, self._grid, self._places = model, grid, places
        self._bases: Sequence[Basis] = places if bases is None else bases
        self.width = sum(each.width for each in self._bases)
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
        for place, basis, compiled in zip(self._places, self._bases, self._compiled, strict=True):
            end = begin + basis.width
            targets = place.outputs if measured else place.equations
            if targets:
                known = compiled(*x, *signals.inputs, signals.t)
                courses = [np.broadcast_to(each, x.shape[1]) for each in known[: len(place.coordinates)]]
                values = basis.values(np.stack(courses))
                for (name, _), factor in zip(targets, known[len(place.coordinates) :], strict=True):
                    result[names.index(name), begin:end] = values * factor
            begin = end
        return result


def places_in(
    model: Dynamics, roles: Roles, data: Measurements, x: np.ndarray, *, linear: bool = False
) -> tuple[Place, ...]:
    """Functions of one coordinate, in every equation that says more than a definition, and in every output.

    In a rotating frame they are also those of amplitude and time, along the state and across it.

    Parameters
    ----------
    model, roles
        The simulation, and the roles of its states.
    data, x
        The recordings and the states along them, shape ``(n, d)``: knots are quantiles of these.
    linear
        Whether they are piecewise linear, of few knots, and forces: in equations only, and in a rotating
        frame of the amplitude only, of which they have the direction and not the size.
    """
    found: list[Place] = []
    coordinates = coordinates_of(model)
    framed = {name for pair in roles.amplitudes for name in pair}
    for first, second in roles.amplitudes:
        a, b, size = symbol(first), symbol(second), ONE
        functions = {"amplitude": _amplitude(first, second)}
        if linear:
            size = sympy.sqrt(a**2 + b**2 + TINY_AMPLITUDE)
        else:
            functions["t"] = symbol("t")
        along_it, across = (
            ((first, a / size), (second, b / size)),
            ((first, b / size), (second, -a / size)),
        )
        found += [
            Place(equations, (), (formula,), (word,), linear=linear)
            for word, formula in functions.items()
            for equations in (along_it, across)
        ]
    for name in roles.states:
        found += [
            Place(((name, ONE),), (), (formula,), (word,), linear=linear)
            for word, formula in coordinates.items()
            if not (name in framed and word in framed)
        ]
    values = {symbol(each.name): exact_number(each.value) for each in model.parameters}
    for name, written in () if linear else model.outputs:
        formula = written.xreplace(values)  # an offset of the sensor is where the fit has it
        own = str(formula) if formula.is_Symbol else name
        found += [
            Place((), ((name, ONE),), (formula,), (own,)),
            Place((), ((name, ONE),), (symbol("t"),), ("t",)),
        ]
    return tuple(_with_knots(found, model, data, x, count=HAT_KNOTS if linear else SPLINE_KNOTS))


def products_in(
    places: Sequence[Place], model: Dynamics, data: Measurements, x: np.ndarray
) -> tuple[Place, ...]:
    """Functions of one coordinate as coefficients of each other one but time, in the same equations."""
    found = []
    for place in places:
        factors = {name: formula for name, formula in coordinates_of(model).items() if name != "t"}
        if len(place.equations) > 1:  # in a rotating frame only the amplitude
            factors = {"amplitude": _amplitude(*place.targets)}
        for name, formula in factors.items():
            if place.equations and name not in place.words:
                equations = tuple((target, factor * formula) for target, factor in place.equations)
                found.append(replace(place, equations=equations, words=(*place.words, name)))
    return tuple(_with_knots(found, model, data, x))


def coordinates_of(model: Dynamics) -> dict[str, sympy.Expr]:
    """States, inputs and the time, by name."""
    return {name: symbol(name) for name in (*model.states, *(each.name for each in model.inputs), "t")}


def _with_knots(
    drafts: Sequence[Place], model: Dynamics, data: Measurements, x: np.ndarray, count: int = SPLINE_KNOTS
) -> Iterator[Place]:
    """Places with their knots, but for those whose coordinate takes too few values for a function."""
    known: dict[tuple[sympy.Expr, ...], np.ndarray] = {}
    for each in drafts:
        if each.coordinates not in known:
            (course,) = along(each.coordinates, model, data, x)
            finite = course[np.isfinite(course)]
            known[each.coordinates] = (
                np.unique(np.quantile(finite, np.linspace(0, 1, count))) if len(finite) else np.empty(0)
            )
        if len(known[each.coordinates]) > 3:
            yield replace(each, knots=known[each.coordinates])


def linearised_with_places(
    fit: Fit, data: Measurements, places: Sequence[Place]
) -> Iterator[tuple[Linearisation, list[tuple[Place, slice]]]]:
    """The linearisation of a fit with the columns of places behind those of its parameters, in portions.

    Parameters
    ----------
    fit, data
        The fit along whose trajectories everything is linear, and what it was made for.
    places
        The functions.

    Yields
    ------
    Linearisation, list of (Place, slice)
        Which of the further columns are those of which place.
    """
    model = fit.model
    room = LARGEST_LINEARISATION // (len(data.t) * (model.dimension + len(model.outputs))) - len(model.free)
    at_once = max(room // SPLINE_KNOTS, 1)
    grid = Grid(data, min(fit.substeps, PROBE_SUBSTEPS))
    for begin in range(0, len(places), at_once):
        some = places[begin : begin + at_once]
        groups = list(zip(some, slices_of(some), strict=True))
        yield probe_response(fit, grid, PlaceColumns(model, grid, some)), groups


def rank_places(fit: Fit, data: Measurements, roles: Roles) -> list[Place]:
    """All places with their evidence, the one in which a smooth function is likeliest first.

    Functions of one coordinate are tried everywhere, and as coefficients of other coordinates in the
    equations in which they do best.
    """
    single = places_in(fit.model, roles, data, fit.x)
    ranked = _compared(fit, data, single)
    if not ranked:
        return []
    equations = {each.targets for each in ranked[:FUNCTIONS_FITTED] if each.equations}
    products = products_in([each for each in single if each.targets in equations], fit.model, data, fit.x)
    return sorted((*ranked, *_compared(fit, data, products)), key=lambda each: -each.log_evidence)


def _compared(fit: Fit, data: Measurements, places: Sequence[Place]) -> list[Place]:
    parameters = len(fit.model.free)
    found: dict[int, Place] = {}
    alone = -np.inf
    for response, groups in linearised_with_places(fit, data, places):
        for level in levels_of(fit):
            try:
                white = whiten(response, data, fit.noise.scaled(level))
                left, columns = projected(white, parameters)
            except NumericalFailure:  # without process noise an unstable simulation does not follow
                continue
            freedom = white.degrees_of_freedom - parameters
            base = profile_likelihood(float(left @ left), freedom, white.log_determinant)
            alone = max(alone, base)
            for place, group in groups:
                own = columns[:, group]
                value = base + evidence_of_function(own, left, place.knots, freedom=freedom)
                known = found.get(id(place))
                if own.any() and (known is None or value > known.log_evidence):
                    found[id(place)] = replace(place, log_evidence=value, level=level)
    ranked = sorted(found.values(), key=lambda each: -each.log_evidence)
    return [replace(each, log_evidence=each.log_evidence - alone) for each in ranked]


def formula_in(
    place: Place, fit: Fit, data: Measurements, *, degree: int
) -> tuple[Place, MechanismCandidate] | None:
    """The simulation of a fit with a formula in a place, of the powers that it needs; None if it needs none.

    The place is that of a function of the second coordinate, where the first is in none of them.
    """
    if not (terms := _few_powers(place, fit, data, degree=degree)):
        return None
    place, terms = _simplest(place, terms)
    return place, _with_formula(fit.model, place, terms)


def _few_powers(place: Place, fit: Fit, data: Measurements, *, degree: int) -> tuple[Power, ...]:
    """Powers of which each earns its place, one after the other (Schwarz).

    Errors count as correlated as all of the powers leave them (`siq.diagnosis.evidence`).
    """
    terms = _powers(place, degree=degree)
    probe = Probe(_with_formula(fit.model, place, terms), ())
    grid = Grid(data, min(fit.substeps, PROBE_SUBSTEPS))
    response = probe_response(fit, grid, ProbeColumns(fit.model, grid, [probe], fit.x))
    white = whiten(response, data, fit.noise.scaled(place.level))
    left, own = projected(white, len(fit.model.free))
    basis = orthonormal(own)
    rest = left - basis @ (basis.T @ left)
    correlated = correlation_time_of(rest, white.recording, outputs=len(fit.model.outputs))
    count = max(float(white.known.sum()) / correlated, 2.0)  # errors that count as independent
    chosen: list[int] = []
    total = float(left @ left)
    while len(chosen) < len(terms):
        sums = {}
        for power in range(len(terms)):
            if power not in chosen and own[:, power].any():
                some = own[:, [*chosen, power]]
                some = some / np.sqrt((some**2).sum(axis=0))
                sums[power] = float(((left - some @ np.linalg.lstsq(some, left, rcond=1e-9)[0]) ** 2).sum())
        if not sums:
            break
        best = min(sums, key=lambda power: sums[power])
        if count * np.log(total / max(sums[best], 1e-300)) < np.log(count):
            break
        chosen.append(best)
        total = sums[best]
    return tuple(terms[power] for power in sorted(chosen))


def _with_formula(model: Dynamics, place: Place, terms: Sequence[Power]) -> MechanismCandidate:
    """The simulation with a sum of terms in a place, whose coefficients are the amplitudes."""
    names = fresh_names("c", len(terms), model.names)
    formula = sympy.Add(*(symbol(name) * term for name, (term, _, _) in zip(names, terms, strict=True)))
    units = [place.unit(model, first, second) for _, first, second in terms]
    return place.without_factor.added_to(model, formula, names, units)


def _simplest(place: Place, terms: Sequence[Power]) -> tuple[Place, tuple[Power, ...]]:
    """The same terms as a function of the second coordinate alone, where the first is in none of them."""
    if len(place.words) == 1 or any(first for _, first, _ in terms):
        return place, tuple(terms)
    alone = replace(
        place.without_factor, coordinates=(place.factor,), words=place.words[1:], knots=np.empty(0)
    )
    return alone, tuple((formula, second, 0) for formula, _, second in terms)


def _powers(place: Place, *, degree: int) -> list[Power]:
    """Monomials of a place's coordinates up to a degree.

    Of a single coordinate there are also odd functions of even degree, such as z∣z∣; a second
    coordinate stands in every term.
    """
    (z,) = place.coordinates
    if len(place.words) > 1:
        return [
            (z**i * place.factor**j, i, j)
            for i, j in itertools.product(range(degree + 1), range(1, degree + 1))
            if i + j <= degree
        ]
    smooth = [(z**power, power, 0) for power in range(degree + 1)]
    if place.words[0] in ("amplitude", "t"):
        return smooth
    return [*smooth, *((z ** (power - 1) * sympy.Abs(z), power, 0) for power in range(2, degree + 1, 2))]
