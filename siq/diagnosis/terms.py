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
from typing import Protocol

import numpy as np
import scipy.interpolate
import sympy

from siq.data.correlation import correlation_time_of
from siq.diagnosis.dictionary import Roles, unit_of, units_of
from siq.diagnosis.evidence import evidence_of_function
from siq.diagnosis.mechanisms import FORMULA, MechanismCandidate, added, along, coordinates_of, fresh_names
from siq.diagnosis.screening import (
    Entry,
    Evaluated,
    Probe,
    Projection,
    Ranked,
    Trajectories,
    linearised_with,
    rank,
)
from siq.inference.kalman_filter import whiten
from siq.inference.maximum_likelihood import Fit
from siq.inference.measurements import Measurements
from siq.systems.dynamics import Dynamics, Parameter, symbol
from siq.systems.formulas import compile_values, exact_number

FUNCTIONS_FITTED = 3  # places in which functions are fitted, the most likely ones: a choice
SPLINE_KNOTS = 17  # enough for the shortest length of `siq.diagnosis.evidence.SMOOTH_LENGTHS`, two for each
HAT_KNOTS = 9  # of piecewise linear functions: a choice
TINY_AMPLITUDE = sympy.Float(1e-300)  # so that a system at rest has a direction, which is none
ONE = sympy.Integer(1)
Power = tuple[sympy.Expr, int, int]
"""A term of a formula, and how often the first and the second coordinate are factors of it."""


class Basis(Protocol):
    """A function with linear coefficients, such as values at knots."""

    @property
    def width(self) -> int:
        """The number of its coefficients."""

    def values(self, courses: np.ndarray) -> np.ndarray:
        """What a unit of each does along courses ``(c, n)`` of the coordinates, shape ``(width, n)``."""


@dataclass(frozen=True)
class Place:
    """Where a function may stand, and of what: a `siq.diagnosis.screening.Term`."""

    equations: tuple[tuple[str, sympy.Expr], ...]  #: what the function is multiplied by in each, ...
    outputs: tuple[tuple[str, sympy.Expr], ...]  #: ... or in each output
    coordinates: tuple[sympy.Expr, ...]  #: what it is a function of: one formula, or two
    words: tuple[str, ...]  #: these in words of the system; one word more is that of a factor
    #: Of the spline: quantiles of the coordinate, shape ``(k,)``.
    knots: np.ndarray = field(default_factory=lambda: np.empty(0))
    linear: bool = False  #: whether the spline is piecewise linear, rather than a natural cubic one
    basis: Basis | None = None  #: of the function, in the place of the spline

    @property
    def width(self) -> int:
        """The number of its values."""
        return len(self.knots) if self.basis is None else self.basis.width

    def values(self, courses: np.ndarray) -> np.ndarray:
        """Splines that are one at one knot and zero at the others, shape ``(k, n)``.

        What lies beyond the knots has the value at the last one.
        """
        if self.basis is not None:
            return self.basis.values(courses)
        unit = np.eye(len(self.knots))
        if self.linear:
            return np.stack([np.interp(courses[0], self.knots, each) for each in unit])
        course = np.clip(courses[0], self.knots[0], self.knots[-1])
        return scipy.interpolate.make_interp_spline(self.knots, unit, bc_type="natural")(course).T

    def columns(self, trajectories: Trajectories) -> Evaluated:
        """See `siq.diagnosis.screening.Term`."""
        model, grid = trajectories.model, trajectories.grid
        targets = (*self.equations, *self.outputs)  # it has either
        formulas = [*self.coordinates, *(factor for _, factor in targets)]
        compiled = compile_values(formulas, list(coordinates_of(model).values()))

        def evaluated(x: np.ndarray, values: np.ndarray, node: int | None) -> Iterator[Entry]:
            if bool(self.outputs) is (node is None):
                signals = grid.at_samples(()) if node is None else grid.signals(node, ())
                known = compiled(*x, *signals.inputs, signals.t)
                count, names = len(self.coordinates), model.output_names if node is None else model.states
                basis = self.values(np.stack([np.broadcast_to(each, x.shape[1]) for each in known[:count]]))
                for (name, _), factor in zip(targets, known[count:], strict=True):
                    yield names.index(name), slice(None), basis * factor

        return evaluated

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
        return replace(self, equations=tuple((name, each / self.factor) for name, each in self.equations))

    def added_to(
        self, model: Dynamics, formula: sympy.Expr, names: Sequence[str], units: Sequence[str]
    ) -> MechanismCandidate:
        """A simulation with a formula here, whose amplitudes have names and units."""
        parameters = [Parameter(name, 0.0, unit) for name, unit in zip(names, units, strict=True)]
        name = f"a function of {' and '.join(self.words)}"
        return added(
            model, {name: formula * factor for name, factor in self.equations},
            {name: formula * factor for name, factor in self.outputs}, parameters, name=name,
            label=f"{name} in {'the measurement of ' if self.outputs else ''}{', '.join(self.targets)}",
            coordinate="measurement" if self.outputs else ", ".join(self.words), kind=FORMULA, place=self,
        )  # fmt: skip

    def unit(self, model: Dynamics, first: int, second: int) -> str:
        """Unit of the coefficient of a term with so many factors of either coordinate."""
        known, (word, *further) = units_of(model), self.words
        target = self.targets[0] if self.equations else word
        if len(self.equations) > 1:  # of a rotating frame: it is multiplied by the states themselves
            whole, first_unit = "1", known.get(word, known[target])
        else:
            whole, first_unit = known.get(target, "1"), known.get(word, "1")
        factor = target if further == ["amplitude"] else "".join(further)
        units = {"_t": model.time_unit, "_w": whole, "_1": first_unit, "_2": known.get(factor, "1")}
        return unit_of(f"_w{'/_t' if self.equations else ''}/_1**{first}/_2**{second}", units)


def _amplitude(first: str, second: str) -> sympy.Expr:
    return sympy.sqrt(symbol(first) ** 2 + symbol(second) ** 2)


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
        along_it = ((first, a / size), (second, b / size))
        across = ((first, b / size), (second, -a / size))
        found += [
            Place(equations, (), (formula,), (word,), linear=linear)
            for word, formula in functions.items()
            for equations in (along_it, across)
        ]
    for name in roles.states:
        found += [
            Place(((name, ONE),), (), (formula,), (word,), linear=linear)
            for word, formula in coordinates.items()
            if not (name in framed and word in framed) and not word.startswith("_")  # of recordings
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
            if place.equations and name not in place.words and not name.startswith("_"):
                equations = tuple((target, factor * formula) for target, factor in place.equations)
                found.append(replace(place, equations=equations, words=(*place.words, name)))
    return tuple(_with_knots(found, model, data, x))


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


def rank_places(fit: Fit, data: Measurements, roles: Roles) -> list[Ranked[Place]]:
    """All places, by the evidence of a smooth function there, the likeliest first.

    Functions of one coordinate are tried everywhere, and as coefficients of other coordinates in the
    equations in which they do best.
    """
    single = places_in(fit.model, roles, data, fit.x)
    ranked = _ranked(fit, data, single)
    equations = {each.term.targets for each in ranked[:FUNCTIONS_FITTED] if each.term.equations}
    products = products_in([each for each in single if each.targets in equations], fit.model, data, fit.x)
    return sorted((*ranked, *_ranked(fit, data, products)), key=lambda each: -each.gain)


def _ranked(fit: Fit, data: Measurements, places: Sequence[Place]) -> list[Ranked[Place]]:
    ranked = rank(fit, data, places, judge=_by_evidence)[0]
    return sorted((each for each in ranked if each.finite), key=lambda each: -each.gain)


def _by_evidence(
    place: Place, problem: Projection, group: slice
) -> tuple[float, np.ndarray, np.ndarray] | None:
    """A `siq.diagnosis.screening.Judge`: the likelihood averaged over all smooth functions in a place."""
    own = problem.columns[:, group]
    if not own.any():
        return None
    gained = evidence_of_function(own, problem.left, place.knots, freedom=problem.freedom)
    return problem.likelihood(problem.total) + gained, np.zeros(0), np.zeros(0)


def formula_in(
    place: Place, fit: Fit, data: Measurements, *, level: float, degree: int
) -> MechanismCandidate | None:
    """The simulation of a fit with a formula in a place, of the powers that it needs; None if it needs none.

    Each earns its place, one after the other (Schwarz). Errors count as correlated as all of the powers leave
    them. Its place is that of a function of the second coordinate, where the first is in none of them.
    """
    terms = _powers(place, degree=degree)
    response, _ = linearised_with(fit, data, [Probe(_with_formula(fit.model, place, terms), ())])
    white = whiten(response, data, fit.noise.scaled(level))
    problem = Projection.of(white, len(fit.model.free))
    left, own = problem.left, problem.columns
    correlated = correlation_time_of(problem.unexplained, white.recording, outputs=len(fit.model.outputs))
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
    if not chosen:
        return None
    return _with_formula(fit.model, *_simplest(place, [terms[power] for power in sorted(chosen)]))


def _with_formula(model: Dynamics, place: Place, terms: Sequence[Power]) -> MechanismCandidate:
    """The simulation with a sum of terms in a place, whose coefficients are the amplitudes."""
    names = fresh_names("c", len(terms), model.names)
    formula = sympy.Add(*(symbol(name) * term for name, (term, _, _) in zip(names, terms, strict=True)))
    units = [place.unit(model, first, second) for _, first, second in terms]
    return replace(place.without_factor.added_to(model, formula, names, units), place=place)


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
