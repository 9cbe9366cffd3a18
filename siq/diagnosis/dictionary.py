"""The dictionary of mechanisms, and which states, inputs and parameters may take part in each.

Mechanisms are written for roles - a position, a velocity, the two quadratures of a rotating frame, a
population, a level, a store - and roles are read off equations and units, never off names. In a system of
mere numbers functions without a name describe what is missing: a power of a state is no physics.
"""

from __future__ import annotations

import itertools
import re
import string
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import as_file, files
from typing import Annotated, Literal

import numpy as np
import sympy
from pydantic import BaseModel, ConfigDict, Field, model_validator

from siq.errors import Fault, InputError
from siq.numerics.files import read_document, validate
from siq.numerics.randomness import positive
from siq.systems.cards import Formula, Name
from siq.systems.dynamics import Dynamics, Signals, symbol
from siq.systems.formulas import FormulaError, compile_values, parse_formula
from siq.systems.simulation import Simulated

Role = Literal[
    "position", "displacement", "angle", "velocity", "amplitude", "population", "prey", "predator",
    "susceptible", "infectious", "level", "upper level", "lower level", "store", "stock", "state", "input",
    "parameter", "output",
]  # fmt: skip


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Shape(_Part):
    """Where a parameter is looked for that the mechanism does not depend on linearly.

    Give one way of looking.
    """

    #: Multiples, or probabilities for `quantiles_of`, that are tried
    at: tuple[float, ...] = (1.0,)
    #: A formula: multiples of its root mean square along the recordings are tried
    scale_of: str | None = None
    #: The same of its inverse
    inverse_scale_of: str | None = None
    #: A formula: its quantiles at these probabilities are tried
    quantiles_of: str | None = None
    #: A formula: multiples of the time in which it changes by its own spread are tried
    time_of: str | None = None
    #: An output: the step of the lattice on which its recorded values lie. It is known from the recordings
    #: and not fitted; where they lie on none that holds zero, the mechanism is not tried.
    lattice_of: str | None = None
    #: An output: where its recorded values end in a plateau above. Without one the mechanism is not tried.
    top_of: str | None = None
    #: The same below
    bottom_of: str | None = None
    #: An output whose recorded values have lost their sign: one. Without one the mechanism is not tried.
    magnitude_of: str | None = None
    #: Multiples of the time between samples are tried; a single one is not fitted
    samples: bool = False
    #: So many angular frequencies that the recordings can resolve are tried
    frequencies: Annotated[int, Field(ge=2, le=2000)] | None = None

    @model_validator(mode="after")
    def _one(self) -> Shape:
        if sum(value not in (None, False) for name, value in self if name != "at") != 1:
            raise Fault("a shape is looked for in one way", "give one of scale_of, quantiles_of, ...")
        return self

    @property
    def recorded(self) -> str | None:
        """The output whose recorded values tell the shape by themselves."""
        return self.lattice_of or self.top_of or self.bottom_of or self.magnitude_of


class MechanismParameter(_Part):
    """A parameter that a mechanism brings: an amplitude, or a shape."""

    #: In terms of the roles and the time T: ``v/T/x**3``
    unit: str = "1"
    #: ``positive`` where passivity, or the meaning of the word, demands it
    sign: Literal["any", "positive"] = "any"
    #: Where to look for it. Left out, it is an amplitude, which is zero where the mechanism is absent.
    shape: Shape | None = None


class FurtherState(_Part):
    """A state that a mechanism brings."""

    #: Its time derivative
    equation: Formula
    #: In terms of the roles
    unit: str = "1"
    #: A formula of its size
    scale: str
    #: A formula of the roles: where it is taken to begin in every recording, until a fit tells
    begin: Formula = 0


class Form(_Part):
    """How a mechanism shows in one kind of system."""

    #: What each name in the formulas stands for. Several roles are filled by different states.
    roles: dict[Name, Role]
    #: Formulas that are added to the equation of the state in that role
    terms: dict[Name, Formula] = {}
    #: Formulas that take the place of an input or a parameter, wherever it stands
    replace: dict[Name, Formula] = {}
    #: Formulas that take the place of a state in the equation of another: ``{q: {p: z}}`` puts z in the place
    #: of p in the equation of q
    within: dict[Name, dict[Name, Formula]] = {}
    #: Formulas of what a sensor reads instead; ``y`` stands for what it read before
    outputs: dict[Name, Formula] = {}
    #: Further states, by name
    states: dict[Name, FurtherState] = {}
    #: The state on which process noise acts
    noise: Name | None = None
    #: What the mechanism's formulas need to know, by name
    parameters: dict[Name, MechanismParameter]
    #: Along which role the mechanism acts
    coordinate: str
    #: What tells the form from others of the same roles, in words that follow the name: ``from above``; roles
    #: in braces are what fills them
    variant: str = ""
    #: Whether exchanging the roles gives the same mechanism
    symmetric: bool = False
    #: Regular expressions of the units that fill a role
    units: dict[Name, str] = {}
    #: Whether the states and inputs that fill the roles must have one unit, and not be mere numbers
    one_unit: bool = False
    #: Where it is a member of another family than the mechanism's other forms
    family: str = ""
    #: Mechanisms that are special cases of this form, but not of the others
    generalises: tuple[str, ...] = ()
    #: Whether it shows only where the motion turns back: the coordinate is a velocity, and has both signs
    turning: bool = False

    @model_validator(mode="after")
    def _about_roles(self) -> Form:
        changed = [
            *self.terms, *self.replace, *self.outputs, *self.within,
            *(name for put in self.within.values() for name in put), *([self.noise] if self.noise else []),
        ]  # fmt: skip
        if not changed:
            raise Fault("a form changes nothing", "give terms, replace, within, outputs or noise")
        for name in (each for each in changed if each not in self.roles):
            raise Fault(f"'{name}' has no role", f"add 'roles: {{{name}: state}}' or another role")
        told = {role for _, role, *_ in string.Formatter().parse(self.variant) if role is not None}
        for name in sorted(told.difference(self.roles)):
            raise Fault(f"the variant names '{name}', which has no role", f"add 'roles: {{{name}: state}}'")
        return self


class Mechanism(_Part):
    """An entry of the dictionary."""

    #: What pages and tables call it
    name: Annotated[str, Field(min_length=1)]
    #: What it means, in a sentence
    sentence: str
    #: One for each kind of system in which it shows
    forms: Annotated[tuple[Form, ...], Field(min_length=1)]
    #: Mechanisms that are special cases of it
    generalises: tuple[str, ...] = ()
    #: The kind of physics that it is a member of, by default itself: what recordings tell first
    family: str = ""
    #: How likely it is beforehand, beside one of weight 1. What nearly every system of its kind has weighs 5,
    #: what few have weighs 0.2. A family weighs as much as its likeliest member.
    weight: Annotated[float, Field(gt=0)] = 1.0
    #: Mechanisms that are easily taken for it
    look_alikes: tuple[str, ...] = ()
    #: Where it is described
    reference: str = ""


class _Dictionary(_Part):
    """The schema of a file of mechanisms."""

    mechanisms: tuple[Mechanism, ...]


@cache
def standard_dictionary() -> tuple[Mechanism, ...]:
    """The mechanisms that come with the library."""
    with as_file(files("siq.diagnosis") / "mechanisms.yaml") as path:
        return validate(read_document(path), _Dictionary).mechanisms


def dictionary_of(
    *, without: Collection[str], further: Sequence[Mechanism], file: str
) -> tuple[Mechanism, ...]:
    """The standard mechanisms, less some by name, and with further ones; an equal name replaces.

    Raises
    ------
    InputError
        For a name to leave out that there is none of.
    """
    known = {each.name: each for each in standard_dictionary()}
    for name in without:
        if name not in known:
            raise InputError(
                file, "without", f"no mechanism is called '{name}'", f"use one of {', '.join(known)}"
            )
        del known[name]
    return tuple((known | {each.name: each for each in further}).values())


def units_of(model: Dynamics) -> dict[str, str]:
    """Units of everything that a coordinate may be: states, inputs, the time and outputs, by name."""
    units = dict(zip(model.states, model.units, strict=True))
    units |= {entry.name: entry.unit for entry in model.inputs} | {"t": model.time_unit}
    known = units | {entry.name: entry.unit for entry in model.parameters}
    for name, formula in model.outputs:
        _, term = sympy.Add.make_args(sympy.expand(formula))[0].as_coeff_Mul()
        units.setdefault(name, unit_of(str(term), known) if term.is_rational_function() else "1")
    return units


def unit_of(formula: str, units: Mapping[str, str]) -> str:
    """The unit of a formula of quantities, such as ``"v/T/x**2"``, whose units are known: ``"1/(m*s)"``.

    A number has the unit ``"1"``. What cannot be read as a product of powers (``"°C"``) is kept as one word.
    """
    return _unit_of(formula, tuple(each for each in units.items() if re.search(rf"\b{each[0]}\b", formula)))


@cache  # the same few for every place at which a mechanism may act
def _unit_of(formula: str, units: tuple[tuple[str, str], ...]) -> str:
    words, known = dict[str, sympy.Symbol](), dict[str, sympy.Expr]()

    def stand_in(word: str) -> sympy.Symbol:
        return words.setdefault(word, sympy.Symbol(f"unit{len(words)}", positive=True))

    for name, unit in units:
        try:
            known[name] = parse_formula(unit, {w: stand_in(w) for w in re.findall(r"[A-Za-z_]\w*", unit)})
        except FormulaError:
            known[name] = stand_in(unit)
    text = str(sympy.powsimp(parse_formula(formula, known), force=True))
    for word, placeholder in words.items():
        text = re.sub(rf"\b{placeholder}\b", word, text)
    return text


FORMULA_TOLERANCE = 1e-9  # relative difference of values of formulas that are the same
TRIAL_POINTS = 12
SPEED = re.compile(r"([cdkmnuµμ]?m|m?rad|deg|°|rev|ft|in) ?/ ?([mnuµμ]?s|min|h)|rpm|1 ?/ ?(s|min)")  # units
ANYWHERE = (0.5, 1.5)  # where formulas of a state without a domain are compared, as those of inputs are


@dataclass(frozen=True)
class Roles:
    """Names by role."""

    #: Pairs of position and velocity, ``x' = v``; and positions that are angles: in radians, or within a sine
    #: or cosine of the equations.
    motions: tuple[tuple[str, str], ...] = ()
    angles: tuple[str, ...] = ()
    speeds: tuple[str, ...] = ()  #: velocities, by their unit (m/s, rad/s), of which no position is followed
    #: Pairs of quadratures: but for a constant drive, the equations look the same from every angle, and turn
    #: the state.
    amplitudes: tuple[tuple[str, str], ...] = ()
    #: States that stay zero once they are, and that do not only decay if they have a unit; pairs of prey and
    #: predator, whose meetings make the one fewer and the other more; and pairs in which the one becomes the
    #: other, and is not born of its like.
    populations: tuple[str, ...] = ()
    feeding: tuple[tuple[str, str], ...] = ()
    contagion: tuple[tuple[str, str], ...] = ()
    #: States whose own outflow goes with their square root; and pairs of which the first flows into the
    #: second.
    levels: tuple[str, ...] = ()
    cascades: tuple[tuple[str, str], ...] = ()
    #: All others that have a unit, or a domain from 0 on: a charge, a temperature, a concentration, a count.
    #: Of other mere numbers nothing is known that a mechanism could be written for.
    stores: tuple[str, ...] = ()
    #: All that are not mere derivatives; only in their equations can physics be missing.
    states: tuple[str, ...] = ()


def roles_of(model: Dynamics) -> Roles:
    """Read the roles of a model's states off its equations."""
    equations = dict(zip(model.states, model.equations, strict=True))
    definitions = {name for name, each in zip(model.states, model.kinematic, strict=True) if each}
    motions = tuple((name, str(equations[name])) for name in model.states if name in definitions)
    dynamic = tuple(name for name in model.states if name not in definitions)
    in_motion = {name for pair in motions for name in pair}
    others = [name for name in dynamic if name not in in_motion]
    amplitudes = tuple(pair for pair in itertools.combinations(others, 2) if _turns(model, *pair))
    in_pairs = {name for pair in amplitudes for name in pair}
    units = dict(zip(model.states, model.units, strict=True))
    amounts = {x for x, at in zip(model.states, model.limits, strict=True) if units[x] != "1" or not at[0]}
    speeds = tuple(name for name in others if name not in in_pairs and SPEED.fullmatch(units[name]))
    alone = [name for name in others if name not in in_pairs and name not in speeds]
    levels = tuple(name for name in alone if _has_root(equations[name], name))
    # What nothing makes more, and no other state less, only decays.
    mixed = {name for name in alone if len(equations[name].free_symbols & {*map(symbol, model.states)}) > 1}
    living = [name for name in alone if units[name] == "1" or births(model, name) != 0 or name in mixed]
    populations = tuple(name for name in living if name not in levels and _multiplies(model, name))
    feeding = tuple(pair for pair in itertools.permutations(populations, 2) if _feeds(model, *pair))
    formulas = (*model.equations, *dict(model.outputs).values())
    sines = {each for formula in formulas for each in formula.atoms(sympy.sin, sympy.cos)}
    turning = {name for each in sines for name in each.free_symbols}
    return Roles(
        motions=motions,
        angles=tuple(x for x, _ in motions if units[x] == "rad" or symbol(x) in turning),
        speeds=speeds,
        amplitudes=amplitudes,
        populations=populations,
        feeding=feeding,
        contagion=tuple(
            (one, other)
            for one, other in itertools.product(alone, populations)
            if not births(model, one).has(symbol(one))
            and _feeds(model, one, other)
            and sympy.expand(sum(meetings(equations[name], one, other) for name in (one, other))) == 0
        ),
        levels=levels,
        cascades=tuple(
            (upper, lower)
            for upper, lower in itertools.permutations(levels, 2)
            if _has_root(equations[lower], upper)
        ),
        stores=tuple(name for name in alone if name in amounts and name not in (*levels, *populations)),
        states=dynamic,
    )


def meetings(equation: sympy.Expr, one: str, other: str) -> sympy.Expr:
    """The part of an equation in which two states stand together; of what a simulator does it is unknown."""
    terms = sympy.Add.make_args(sympy.expand(equation))
    both = {symbol(one), symbol(other)}
    return sympy.Add(*(term for term in terms if both <= term.free_symbols and not term.has(Simulated)))


def trial_points(
    model: Dynamics, count: int = TRIAL_POINTS, *, either_sign: bool = False
) -> tuple[np.ndarray, Signals]:
    """So many states ``(d, count)`` and signals at which formulas are compared; the same each time.

    They lie in the domain of a model. Where there is none they may be of either sign, and so may inputs.
    """
    generator = np.random.default_rng(0)
    known = np.isfinite(model.limits).all(axis=1)
    lower, upper = np.where(known[:, None], model.limits, ANYWHERE).T
    x = generator.uniform(lower[:, None], upper[:, None], size=(model.dimension, count))
    inputs = generator.uniform(*ANYWHERE, size=(len(model.inputs), count))
    delayed = generator.uniform(*ANYWHERE, size=(len(model.delays), count))
    if either_sign:
        x[~known] *= generator.choice([-1.0, 1.0], size=(int((~known).sum()), count))
        inputs *= generator.choice([-1.0, 1.0], size=inputs.shape)
    return x, Signals(
        inputs=inputs, delayed=delayed, slopes=np.zeros_like(delayed),
        t=generator.uniform(0.0, 1.0, size=count),
    )  # fmt: skip


def _feeds(model: Dynamics, prey: str, predator: str) -> bool:
    equations = dict(zip(model.states, model.equations, strict=True))
    lost, won = meetings(equations[prey], prey, predator), meetings(equations[predator], prey, predator)
    if lost == 0 or won == 0:
        return False
    losses, gains = _among_many(model, [lost, won])
    return bool(np.all(losses <= 0) and np.all(gains >= 0))


def births(model: Dynamics, population: str) -> sympy.Expr:
    """The terms of a population's equation that are positive wherever there is anybody."""
    equation = sympy.expand(dict(zip(model.states, model.equations, strict=True))[population])
    terms = sympy.Add.make_args(equation)
    values = _among_many(model, terms)
    return sympy.Add(*(term for term, value in zip(terms, values, strict=True) if np.all(value >= 0)))


def _among_many(model: Dynamics, formulas: Sequence[sympy.Expr]) -> list[np.ndarray]:
    """Values of formulas at trial points where no state is negative."""
    x, signals = trial_points(model)
    at = (*np.abs(x), *signals.inputs, *signals.delayed, *signals.slopes, signals.t, *model.values)
    written = [model.evaluable(each) for each in formulas]
    return [np.asarray(each) for each in compile_values(written, model.arguments)(*at)]


def _turns(model: Dynamics, one: str, other: str) -> bool:
    """Whether f commutes with rotations of two states, but for a constant, and itself turns them."""
    first, second = model.states.index(one), model.states.index(other)
    if model.units[first] != model.units[second]:
        return False
    x, signals = trial_points(model)
    angle = np.linspace(0.3, 5.9, TRIAL_POINTS)

    def turned(v: np.ndarray) -> np.ndarray:
        result = v.copy()
        result[first] = np.cos(angle) * v[first] - np.sin(angle) * v[second]
        result[second] = np.sin(angle) * v[first] + np.cos(angle) * v[second]
        return result

    still = x.copy()
    still[[first, second]] = 0.0
    at_rest = model.functions.rates(still, signals, model.values)
    free, after = (model.functions.rates(each, signals, model.values) - at_rest for each in (x, turned(x)))
    size = np.abs(free).max()
    if not (np.isfinite(free).all() and np.abs(after - turned(free)).max() <= FORMULA_TOLERANCE * size):
        return False
    turning = x[first] * free[second] - x[second] * free[first]
    return bool(np.abs(turning).max() > FORMULA_TOLERANCE * np.abs(x[[first, second]]).max() * size)


def _multiplies(model: Dynamics, name: str) -> bool:
    """Whether nobody comes from nobody; or only from elsewhere, where those who are there make more."""
    (x, signals), place = trial_points(model, either_sign=True), model.states.index(name)
    moving = model.functions.rates(x, signals, model.values)[place]
    x[place] = 0.0
    rate = model.functions.rates(x, signals, model.values)[place]
    least, most = (each / positive(np.abs(moving).max()) for each in (rate.min(), rate.max()))
    own = births(model, name).has(symbol(name)) and not model.limits[place, 0] < 0
    return bool(least >= -FORMULA_TOLERANCE and (most <= FORMULA_TOLERANCE or own) and moving.any())


def _has_root(equation: sympy.Expr, name: str) -> bool:
    return any(
        power.exp == sympy.Rational(1, 2) and symbol(name) in power.base.free_symbols
        for power in equation.atoms(sympy.Pow)
    )


def assignments(form: Form, model: Dynamics, roles: Roles) -> Iterator[dict[str, str]]:
    """Every way of filling a form's roles: from each role to the name that fills it.

    Position (or displacement, or angle) and velocity, the two quadratures of a rotating frame, prey and
    predator, susceptible and infectious, and upper and lower level are filled in pairs where the form names
    them one after the other.
    Nothing fills two roles, and of a symmetric form's ways only one is kept.
    """
    kinds, names = list(form.roles.values()), list(form.roles)
    choices: list[list[dict[str, str]]] = []
    # What fills two kinds of roles together, and what fills each by itself.
    pairs: dict[tuple[str, ...], tuple[tuple[str, str], ...]] = {
        ("position", "velocity"): roles.motions,
        ("displacement", "velocity"): tuple(pair for pair in roles.motions if pair[0] not in roles.angles),
        ("angle", "velocity"): tuple(pair for pair in roles.motions if pair[0] in roles.angles),
        ("amplitude", "amplitude"): roles.amplitudes, ("prey", "predator"): roles.feeding,
        ("susceptible", "infectious"): roles.contagion, ("upper level", "lower level"): roles.cascades,
    }  # fmt: skip
    alone: dict[str, tuple[str, ...]] = {}
    for both, motions in pairs.items():
        for side, kind in enumerate(both):
            alone.setdefault(kind, tuple(pair[side] for pair in motions))
    alone |= {
        "amplitude": tuple(name for pair in roles.amplitudes for name in pair),
        "velocity": (*(velocity for _, velocity in roles.motions), *roles.speeds),
        "population": roles.populations,
        "level": roles.levels,
        "store": roles.stores,
        "stock": (*roles.populations, *roles.levels, *roles.stores),
        "state": roles.states,
        "input": tuple(entry.name for entry in model.inputs if not entry.name.startswith("_")),
        # What is known at first may drift, too.
        "parameter": tuple(entry.name for entry in model.parameters if not entry.name.startswith("_")),
        "output": model.output_names,
    }
    place = 0
    while place < len(names):
        together = tuple(kinds[place : place + 2])
        if together in pairs:
            choices.append([{names[place]: one, names[place + 1]: other} for one, other in pairs[together]])
            place += 2
        else:
            choices.append([{names[place]: name} for name in alone[kinds[place]]])
            place += 1
    units = units_of(model) | {entry.name: entry.unit for entry in model.parameters}
    order = {name: place for place, name in enumerate(model.states)}
    for combination in itertools.product(*choices):
        filled = [name for part in combination for name in part.values()]
        # An output may have the name of the state that it shows.
        apart = {(form.roles[role] == "output", name) for part in combination for role, name in part.items()}
        ordered = sorted(filled, key=lambda name: order.get(name, -1))
        if len(apart) < len(filled) or (form.symmetric and filled != ordered):
            continue
        alike = {units.get(name, "1") for name in filled} if form.one_unit else set()
        if len(alike) > 1 or "1" in alike:
            continue
        found = {role: name for part in combination for role, name in part.items()}
        fits = (
            re.fullmatch(form.units.get(role, ".*"), units.get(name, "1")) for role, name in found.items()
        )
        if all(fits):
            yield found
