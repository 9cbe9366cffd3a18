"""Functions without a name, as formulas: sums of powers. And how any function is built into a simulation."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import sympy

from siq.dynamics.dynamics import Dynamics, Parameter
from siq.dynamics.parametric import symbol
from siq.mismatch.building import MechanismCandidate
from siq.mismatch.function_places import Place
from siq.mismatch.units import unit_of, units_of

FORMULA = "formula"


def described_name(place: Place) -> str:
    """What a function without a name is called, such as ``a function of x and v``."""
    return f"a function of {' and '.join(place.words)}"


def with_formula(model: Dynamics, place: Place, terms: Sequence[Power]) -> MechanismCandidate:
    """The simulation with a sum of terms in a place, whose coefficients are the amplitudes."""
    names = fresh_names("c", len(terms), model)
    formula = sympy.Add(*(symbol(name) * term.formula for name, term in zip(names, terms, strict=True)))
    units = [unit_in(place, model, term.first, term.second) for term in terms]
    return built(model, _without_factor(place), formula, names, units)


def simplest(place: Place, terms: Sequence[Power]) -> tuple[Place, tuple[Power, ...]]:
    """The same terms as a function of the second coordinate alone, where the first is in none of them."""
    if len(place.words) == 1 or any(term.first for term in terms):
        return place, tuple(terms)
    alone = replace(
        _without_factor(place), coordinate=second_coordinate(place), words=place.words[1:], knots=np.empty(0)
    )
    return alone, tuple(Power(term.formula, term.second) for term in terms)


def _without_factor(place: Place) -> Place:
    """The same place, but that a function is not multiplied by the second coordinate."""
    factor = second_coordinate(place)
    return replace(place, equations=tuple((name, each / factor) for name, each in place.equations))


@dataclass(frozen=True)
class Power:
    """A term of a formula: what it is, and how often either coordinate is a factor of it."""

    formula: sympy.Expr
    first: int
    second: int = 0


def powers(place: Place, *, degree: int) -> list[Power]:
    """Monomials of a place's coordinates up to a degree.

    Of a single coordinate there are the odd functions of even degree beside them, such as z∣z∣; a second
    coordinate stands in every term.
    """
    z = place.coordinate
    if len(place.words) > 1:
        factor = second_coordinate(place)
        return [
            Power(z**i * factor**j, i, j)
            for i, j in itertools.product(range(degree + 1), range(1, degree + 1))
            if i + j <= degree
        ]
    smooth = [Power(z**power, power) for power in range(degree + 1)]
    if place.words[0] in ("amplitude", "t"):
        return smooth
    return [*smooth, *(Power(z ** (power - 1) * sympy.Abs(z), power) for power in range(2, degree + 1, 2))]


def fresh_names(stem: str, count: int, model: Dynamics) -> list[str]:
    """So many numbered names that the model does not have."""
    used = set(model.names)
    free = (f"{stem}_{number}" for number in itertools.count(1) if f"{stem}_{number}" not in used)
    return list(itertools.islice(free, count))


def second_coordinate(place: Place) -> sympy.Expr:
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
    label = f"{described_name(place)} in {', '.join(place.targets)}"
    if place.outputs:
        label = f"{described_name(place)} in the measurement of {', '.join(place.targets)}"
    return MechanismCandidate(
        name=described_name(place),
        label=label,
        model=augmented,
        amplitudes=tuple(names),
        shapes=(),
        positive=frozenset(),
        searches=(),
        scales=(),
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
