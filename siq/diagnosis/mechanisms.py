"""Mechanisms built into a simulation, and which of them are no more than a recalibration.

A mechanism is written for roles (`siq.diagnosis.dictionary`); here it becomes models, one for each way of
filling the roles. Besides the roles its formulas may use what the simulation itself says of them: `v_rate`,
the equation of the state v; `p_with_q`, the part of the equation of p in which q stands as well; `p_births`,
the terms of it that are positive; `y_rate` and `y_curvature`, the first and second time derivative of the
output y, inputs being held. What a mechanism does not depend on linearly is looked for about sizes, times and
frequencies of the recorded motion; what the values themselves show of a sensor, its steps and the ends of its
range, is read off them.

Where a simulation has a free damping rate, linear damping is another value of it: no recording can tell the
two apart, and a mechanism of that kind would only stand in the way of the parameter. To first order a
mechanism adds the derivatives of f and h by its amplitudes; it is something new where these are linearly
independent, as functions of states, inputs and time, of the derivatives by the free parameters, and of what
other units and zeros of the states do.
"""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np
import scipy.linalg
import sympy
from scipy.signal import argrelmax, lombscargle

from siq.data.correlation import resolution_step
from siq.diagnosis.dictionary import (
    ANYWHERE,
    Form,
    Mechanism,
    Roles,
    Shape,
    assignments,
    births,
    meetings,
    trial_points,
    unit_of,
    units_of,
)
from siq.errors import InputError
from siq.inference.maximum_likelihood import Fit
from siq.inference.measurements import Measurements
from siq.numerics.randomness import positive
from siq.systems.dynamics import TIME, Dynamics, Parameter, Signals, symbol
from siq.systems.formulas import FormulaError, compile_values, parse_formula
from siq.systems.simulation import Simulated

if TYPE_CHECKING:
    from siq.diagnosis.smooth_functions import SmoothFunction
    from siq.diagnosis.terms import Place

Kind = Literal["formula", "curve", "surface", "mechanism"]
FORMULA: Final = "formula"
CURVE: Final = "curve"
SURFACE: Final = "surface"
MECHANISM: Final = "mechanism"


LINES, MOST_PRODUCTS = 8, 20_000_000  # of a spectrum, that are frequencies to begin with; of work for it
LASTING = 1000.0  # a choice: radians of the lowest frequency, eighty recordings; what lasts longer stays


def places_of(search: Shape, data: Measurements, model: Dynamics, x: np.ndarray) -> np.ndarray:
    """The values of a shape that a search begins with."""
    factors = np.array(search.at)
    steps = np.diff(data.t)[np.diff(data.recording) == 0]
    if search.samples:
        return factors * np.median(steps)
    if search.frequencies is not None:
        # From two periods in the longest recording to four samples a period. Recordings on one clock, far
        # from each other, tell a frequency better than that: lines in what was measured show where.
        limits = _lowest_frequency(data), np.pi / (2 * np.median(steps))
        count = min(int(np.ptp(data.t) / np.median(steps)), MOST_PRODUCTS // len(data.t)) + 2
        fine = np.linspace(*limits, count)
        power = np.zeros(len(fine))
        for column in data.outputs.T:
            known = np.isfinite(column)
            with np.errstate(all="ignore"):
                power += lombscargle(
                    data.t[known], column[known] - column[known].mean(), fine, normalize=True
                )
        lines = argrelmax(power)[0]
        strongest = fine[lines[np.argsort(-power[lines])[:LINES]]]
        return np.append(np.linspace(*limits, search.frequencies), strongest)
    if search.recorded is not None:
        place = model.output_names.index(search.recorded)
        values = data.outputs[:, place]
        if search.lattice_of is not None:
            found = resolution_step(values)
        elif search.magnitude_of is not None:
            found = 1.0
        else:
            side = 1.0 if search.top_of is not None else -1.0
            top = _plateau(side * values, data.recording, noise=float(np.sqrt(data.roughness[place])))
            found = None if top is None else side * top
        return np.zeros(0) if found is None else np.array([found])
    text = search.scale_of or search.inverse_scale_of or search.quantiles_of or search.time_of
    (course,) = along([parse_formula(str(text), model.names)], model, data, x)
    if search.time_of is not None:
        rows = data.begins
        rates = (course[rows + 1] - course[rows]) / (data.t[rows + 1] - data.t[rows])
        rate = float(np.sqrt(np.mean(rates**2)))
        return factors * (float(course.std()) / rate if rate > 0 else float(np.median(steps)))
    return _sized(search, factors, course)


def _lowest_frequency(data: Measurements) -> float:
    """Angular frequency of two periods in the longest recording; fewer do not show that it comes back."""
    return float(4 * np.pi / (data.t[data.first[1:] - 1] - data.t[data.first[:-1]]).max())


def _sized(search: Shape, factors: np.ndarray, course: np.ndarray) -> np.ndarray:
    """Quantiles of a course, or multiples of its root mean square, or of the inverse of that."""
    if search.quantiles_of is not None:
        known = course[np.isfinite(course)]
        return np.quantile(known if len(known) else [1.0], factors)
    size = float(np.sqrt(np.mean(course**2))) or 1.0
    return factors * size if search.scale_of is not None else factors / size


def _plateau(values: np.ndarray, recording: np.ndarray, *, noise: float) -> float | None:
    """Where recorded values end, if they stay there for a while; None where they only turn."""
    ends = values >= np.nanmax(values) - 4 * noise
    same = recording[2:] == recording[:-2]
    stays = ends[2:] & ends[1:-1] & ends[:-2] & same  # a parabola has two points of one height, not three
    if not stays.any():
        return None
    rows = np.flatnonzero(stays)
    return float(np.median(values[np.unique(np.concatenate([rows, rows + 1, rows + 2]))]))


def coordinates_of(model: Dynamics) -> dict[str, sympy.Expr]:
    """States, inputs and the time, by name."""
    return {name: symbol(name) for name in (*model.states, *(each.name for each in model.inputs), "t")}


def along(formulas: Sequence[sympy.Expr], model: Dynamics, data: Measurements, x: np.ndarray) -> np.ndarray:
    """Formulas ``(c,)`` of parameters, states, inputs and time at all samples, shape ``(c, n)``."""
    known = {symbol(each.name): each.value for each in model.parameters}
    signals = data.signals(data.t, data.recording, delays=())
    compiled = compile_values([each.subs(known) for each in formulas], list(coordinates_of(model).values()))
    values = compiled(*x.T[: model.dimension], *signals.inputs, signals.t)
    return np.stack([np.broadcast_to(each, data.t.shape) for each in values])


def fresh_names(stem: str, count: int, used: Collection[str]) -> list[str]:
    """So many numbered names that are not used yet."""
    free = (f"{stem}_{number}" for number in itertools.count(1) if f"{stem}_{number}" not in used)
    return list(itertools.islice(free, count))


@dataclass(frozen=True)
class MechanismCandidate:
    """One way in which a mechanism may be at work in a system, or a function without a name."""

    name: str  #: of the mechanism
    label: str  #: the same, told apart from its other forms and places
    model: Dynamics  #: the simulation with it built in; amplitudes are zero, shapes not yet set
    amplitudes: tuple[str, ...]  #: names of the new parameters that it depends on linearly
    equations: tuple[str, ...]  #: states in whose equations something changes
    coordinate: str  #: along which it acts, in words of the system
    #: What is added to equations, by state; where something is replaced, the new equation or output; and
    #: the equations of further states.
    changes: tuple[tuple[str, sympy.Expr], ...] = ()
    shapes: tuple[str, ...] = ()  #: names of the other new parameters
    positive: frozenset[str] = frozenset()  #: parameters that must not be negative
    searches: tuple[Shape, ...] = ()  #: how its shapes are looked for
    scales: tuple[sympy.Expr, ...] = ()  #: for each further state a formula of its size, ...
    begins: tuple[sympy.Expr, ...] = ()  #: ... and one of where it begins
    generalises: tuple[str, ...] = ()  #: mechanisms that are special cases of it
    variant: str = ""  #: of its form
    family: str = ""  #: of its kind
    weight: float = 1.0  #: how likely it is beforehand
    turning: bool = False  #: whether it shows only where the velocity that is its coordinate takes both signs
    kind: Kind = MECHANISM  #: ``mechanism``, one of the dictionary; ``formula``, ``curve`` or ``surface``
    log_cost: float = 0.0  #: logarithm of the number of places, or mechanisms, that it was chosen among
    place: Place | None = None  #: where a function stands
    #: What a curve or a surface is made of: the amplitudes are the heights of its bumps.
    smooth: SmoothFunction | None = None

    @property
    def unsigned(self) -> bool:
        """Whether it takes the sign from what is measured."""
        return any(search.magnitude_of for search in self.searches)

    @property
    def new(self) -> tuple[str, ...]:
        """All new parameters, in the order of the model's."""
        return tuple(p.name for p in self.model.parameters if p.name in {*self.amplitudes, *self.shapes})

    @property
    def terms(self) -> frozenset[tuple[str, sympy.Expr]]:
        """What is added to which equation for each amplitude, whatever the signs of these."""
        units = {(n, f.diff(symbol(one))) for n, f in self.changes for one in self.amplitudes}
        return frozenset((n, -unit if unit.could_extract_minus_sign() else unit) for n, unit in units if unit)

    def begun(self, base: Dynamics, known: Mapping[str, float]) -> Dynamics:
        """Its model with values to begin with: those of a simulation, no effect, and what else is known."""
        values = {each.name: each.value for each in base.parameters}
        values |= dict.fromkeys(self.amplitudes, 0.0) | dict(known)
        own = [values.get(each.name, each.value) for each in self.model.parameters]
        return self.model.with_values(np.array(own))

    def rebased(self, before: Dynamics, now: Dynamics) -> MechanismCandidate:
        """It on top of a model that has grown since."""
        model, d = self.model, before.dimension
        further = model.states[d:]
        renamed, taken = {name: name for name in (*self.new, *further)}, set(now.names)
        for name in (each for each in renamed if each in taken):
            (renamed[name],) = fresh_names(name.rpartition("_")[0], 1, {*taken, *renamed.values()})
        change = {symbol(old): symbol(new) for old, new in renamed.items() if old != new}

        def merged(theirs: sympy.Expr, old: sympy.Expr, ours: sympy.Expr) -> sympy.Expr:
            return ours + (theirs - old).xreplace(change)

        rows = zip(model.equations[:d], before.equations, now.equations[:d], strict=True)
        measured = zip(model.outputs, before.outputs, now.outputs, strict=True)
        new = (replace(p, name=renamed[p.name]) for p in model.parameters[len(before.parameters) :])
        grown = replace(
            model, states=(*now.states, *(renamed[name] for name in further)),
            units=(*now.units, *model.units[d:]), domain=np.concatenate([now.limits, model.limits[d:]]),
            diffusion=now.diffusion.extended(len(further)),
            equations=(
                *(merged(*each) for each in rows), *now.equations[d:],
                *(each.xreplace(change) for each in model.equations[d:]),
            ),
            outputs=tuple((name, merged(t, o, n)) for (name, t), (_, o), (_, n) in measured),
            parameters=(*now.parameters, *new),
        )  # fmt: skip
        changes = ((renamed.get(name, name), formula.xreplace(change)) for name, formula in self.changes)
        return replace(
            self, model=grown, changes=tuple(changes),
            amplitudes=tuple(renamed[name] for name in self.amplitudes),
            shapes=tuple(renamed[name] for name in self.shapes),
            positive=frozenset(renamed[name] for name in self.positive),
        )  # fmt: skip

    def columns(self, model: Dynamics) -> list[tuple[int, int, sympy.Expr]]:
        """What a unit of each amplitude, none being there yet, does to the equations and outputs of a model.

        Of a mechanism without an amplitude it is the whole change. Returned are the row, equations before
        outputs; the amplitude; and the formula, where it is not zero.
        """
        after = [*self.model.equations[: model.dimension], *dict(self.model.outputs).values()]
        before = [*model.equations, *dict(model.outputs).values()]
        zero = dict.fromkeys(map(symbol, self.amplitudes), 0)
        found = []
        for row, (new, old) in enumerate(zip(after, before, strict=True)):
            if new != old:
                formula = self.model.evaluable(new)
                columns = [formula.diff(name).subs(zero) for name in zero] or [formula - model.evaluable(old)]
                found += [(row, column, each) for column, each in enumerate(columns) if each != 0]
        return found

    def places(self, fit: Fit, *, linear: bool) -> list[int]:
        """Where its parameters stand among the free ones of a fit: all, or the linear ones if it has any."""
        names = [fit.model.parameters[place].name for place in fit.model.free]
        chosen = (self.amplitudes or self.shapes) if linear else self.new
        return [names.index(name) for name in chosen if name in names]

    def admits(self, fit: Fit, data: Measurements) -> bool:
        """Whether a fit has signs that its parameters may have, within errors, and times that can be seen."""
        value_of, errors = {each.name: each.value for each in fit.model.parameters}, fit.error_of
        signs = (value_of[name] >= -2 * errors[name] for name in self.positive & errors.keys())
        searched = [each for each in zip(self.shapes, self.searches, strict=False) if each[0] in errors]
        periodic = [name for name, each in searched if each.frequencies is not None]
        slowest = min((abs(value_of[name]) + 2 * errors[name] for name in periodic), default=np.inf)
        lasting = max(
            (value_of[name] for name, each in searched if each.time_of or each.samples), default=0.0
        )
        lowest = _lowest_frequency(data)
        return all(signs) and bool(slowest >= lowest and lasting * lowest <= LASTING)

    def idle(self, fit: Fit, of: Callable[[Iterable[bool]], bool] = any) -> bool:
        """Whether any amplitude of a fit, or all, is zero within errors: a special case of itself, then.

        Where shapes stay without an amplitude, what stays is no special case: friction that falls to nothing
        as the speed grows is no dry friction.
        """
        value_of, errors = {each.name: each.value for each in fit.model.parameters}, fit.error_of
        shapes, asked = set(map(symbol, self.shapes)), set(self.amplitudes) & errors.keys()
        kept = {
            name
            for name in asked
            if any(change.subs(symbol(name), 0).free_symbols & shapes for _, change in self.changes)
        }
        return of(abs(value_of[name]) < 2 * errors[name] for name in (asked if of is all else asked - kept))

    def repeats(self, found: MechanismCandidate) -> bool:
        """Whether it is what was found already: the same, or in another form at the same place.

        A second threshold beside the first, or a second spring in the same place, is no further physics.
        """
        same_place = self.coordinate == found.coordinate and set(self.equations) & set(found.equations)
        return self.label == found.label or (
            self.name == found.name and self.coordinate in found.model.states and bool(same_place)
        )


def added(
    model: Dynamics, equations: Mapping[str, sympy.Expr], outputs: Mapping[str, sympy.Expr],
    parameters: Sequence[Parameter], **about: Any,
) -> MechanismCandidate:  # fmt: skip
    """A candidate that adds formulas to equations and outputs, by name; its parameters are amplitudes."""
    rows = zip(model.states, model.equations, strict=True)
    return MechanismCandidate(
        model=replace(
            model,
            parameters=(*model.parameters, *parameters),
            equations=tuple(before + equations.get(name, 0) for name, before in rows),
            outputs=tuple((name, before + outputs.get(name, 0)) for name, before in model.outputs),
        ),
        amplitudes=tuple(each.name for each in parameters),
        equations=tuple(equations),
        changes=tuple({**equations, **outputs}.items()),
        **about,
    )


def _build_candidate(
    model: Dynamics, mechanism: Mechanism, form: Form, assignment: Mapping[str, str]
) -> MechanismCandidate | None:
    """Build a mechanism into a model, for one assignment of names to roles; None where it changes nothing."""
    fresh: dict[str, str] = {}
    for name in (*form.parameters, *form.states):
        (fresh[name],) = fresh_names(name, 1, {*model.names, *fresh.values()})
    names = _vocabulary(model, form, assignment, fresh)
    equations = dict(zip(model.states, model.equations, strict=True))
    outputs = dict(model.outputs)
    delayed = [assignment[role] for role, kind in form.roles.items() if kind == "input"]

    def parse(text: object, **other: sympy.Expr) -> sympy.Expr:
        return parse_formula(str(text), names | other, inputs=delayed)

    # Equations and outputs change as the form says; told is what is added, or else the new formula.
    put = {symbol(assignment[role]): parse(text) for role, text in form.replace.items()}
    for formulas in (equations, outputs):
        for name in formulas:
            formulas[name] = formulas[name].subs(put, simultaneous=True)
    for role, texts in form.within.items():
        name = assignment[role]
        put = {symbol(assignment[other]): parse(text) for other, text in texts.items()}
        equations[name] = equations[name].subs(put, simultaneous=True)
    before = dict(zip(model.states, model.equations, strict=True))
    changes = [(name, formula) for name, formula in equations.items() if formula != before[name]]
    for role, text in form.terms.items():
        equations[assignment[role]] += parse(text)
        changes.append((assignment[role], parse(text)))
    for role, text in form.outputs.items():
        outputs[assignment[role]] = parse(text, **{role: outputs[assignment[role]]})
        changes.append((assignment[role], outputs[assignment[role]]))
    if tuple(equations.values()) == model.equations and outputs == dict(model.outputs):
        return None
    known = units_of(model) | {entry.name: entry.unit for entry in model.parameters}
    units = {role: known.get(name, "1") for role, name in assignment.items()} | {"T": model.time_unit}
    shapes = {name: entry.shape for name, entry in form.parameters.items() if entry.shape is not None}
    held = {name for name, each in shapes.items() if each.lattice_of or (each.samples and len(each.at) == 1)}
    values = {symbol(each.name): each.value for each in model.parameters}  # as they are to begin with
    parameters = tuple(
        Parameter(fresh[name], 0.0, unit_of(entry.unit, units), name in held)
        for name, entry in form.parameters.items()
    )
    further = tuple((fresh[name], parse(entry.equation)) for name, entry in form.states.items())
    augmented = replace(
        model,
        states=(*model.states, *(name for name, _ in further)),
        units=(*model.units, *(unit_of(entry.unit, units) for entry in form.states.values())),
        diffusion=model.diffusion.extended(len(further)),
        domain=np.concatenate([model.limits, np.full((len(further), 2), np.nan)]),  # until a fit tells it
        parameters=(*model.parameters, *parameters),
        equations=(*equations.values(), *(formula for _, formula in further)),
        outputs=tuple(outputs.items()),
    )
    recorded = ("lattice_of", "top_of", "bottom_of", "magnitude_of")
    searches = []  # with the system's own names in their formulas
    for shape in shapes.values():
        update = dict[str, str]()
        for key, text in shape.model_dump().items():
            if isinstance(text, str):
                formula = symbol(assignment[text]) if key in recorded else parse_formula(text, names)
                if formula.has(Simulated):  # what only values tell has no text
                    return None
                update[key] = str(formula.subs(values))
        searches.append(shape.model_copy(update=update))
    candidate = MechanismCandidate(
        name=mechanism.name,
        label="",
        model=augmented,
        amplitudes=tuple(fresh[name] for name in form.parameters if name not in shapes),
        shapes=tuple(fresh[name] for name in shapes),
        positive=frozenset(
            fresh[name] for name, entry in form.parameters.items() if entry.sign == "positive"
        ),
        searches=tuple(searches),
        scales=tuple(parse(entry.scale) for entry in form.states.values()),
        begins=tuple(parse(entry.begin) for entry in form.states.values()),
        equations=(),
        coordinate=" ".join(assignment.get(word, word) for word in form.coordinate.split()),
        changes=(*changes, *further),
        generalises=form.generalises or mechanism.generalises,
        turning=form.turning,
        variant=form.variant.format_map(assignment),
        family=form.family or mechanism.family or mechanism.name,
        weight=mechanism.weight,
    )
    return _labelled(candidate, model)


def _vocabulary(
    model: Dynamics, form: Form, assignment: Mapping[str, str], fresh: Mapping[str, str]
) -> dict[str, sympy.Expr]:
    """What every name in a form's formulas stands for."""
    equations = dict(zip(model.states, model.equations, strict=True))
    names: dict[str, sympy.Expr] = {role: symbol(name) for role, name in assignment.items()}
    within = (text for texts in form.within.values() for text in texts.values())
    states_of = (text for each in form.states.values() for text in (each.equation, each.scale, each.begin))
    texts = (*form.terms.values(), *form.replace.values(), *form.outputs.values(), *within, *states_of)
    # The others are not worked out: formulas of many terms take their time.
    wanted = set(re.findall(r"[A-Za-z_]\w*", " ".join(map(str, texts))))
    for role in (role for role, kind in form.roles.items() if kind == "output"):
        names[role] = dict(model.outputs)[assignment[role]]
        if {f"{role}_rate", f"{role}_curvature"} & wanted:
            names[f"{role}_rate"] = _rate_of(names[role], model)
            names[f"{role}_curvature"] = _rate_of(names[f"{role}_rate"], model)
    states = [role for role, kind in form.roles.items() if kind not in ("input", "parameter", "output")]
    for one in states:
        names[f"{one}_rate"] = equations[assignment[one]]
        if f"{one}_births" in wanted:
            names[f"{one}_births"] = births(model, assignment[one])
    others = [role for role, kind in form.roles.items() if kind == "input"]
    for one, other in (*itertools.permutations(states, 2), *itertools.product(states, others)):
        if f"{one}_with_{other}" in wanted:
            names[f"{one}_with_{other}"] = meetings(
                equations[assignment[one]], assignment[one], assignment[other]
            )
    return names | {name: symbol(new) for name, new in fresh.items()} | {"t": TIME}


def _rate_of(formula: sympy.Expr, model: Dynamics) -> sympy.Expr:
    """Time derivative of a formula of states along the equations, inputs being held."""
    along = zip(model.states, model.equations, strict=True)
    return formula.diff(TIME) + sum(formula.diff(symbol(name)) * equation for name, equation in along)


def _labelled(candidate: MechanismCandidate, model: Dynamics) -> MechanismCandidate:
    """A candidate with the equations that it changes in a model, which its label tells with its variant."""
    augmented = candidate.model
    rows = zip(model.states, model.equations, augmented.equations, strict=False)
    places = tuple(state for state, before, after in rows if before != after)
    rows = zip(model.output_names, model.outputs, augmented.outputs, strict=True)
    label = f"{candidate.name} {candidate.variant}".rstrip() + " in "
    label += ", ".join(places or [output for output, before, after in rows if before != after])
    if not (places or candidate.variant):
        label += f", by {', '.join(entry.name for entry in augmented.parameters[len(model.parameters) :])}"
    return replace(candidate, label=label, equations=places)


# Of a column's length, left by others: between rounding and what any shape leaves.
INDEPENDENCE_TOLERANCE = 1e-6


def _beyond_parameters(
    model: Dynamics, candidates: Sequence[MechanismCandidate]
) -> list[MechanismCandidate | None]:
    """Candidates less what the simulation's own parameters can do; None for those of which nothing is left.

    Other units and zeros of the states are no parameters, and can do as little: a sensor's gain beside a free
    inertia and a free damping is another unit of the angle.

    Of several amplitudes those are taken out that the parameters, together with those before, stand for. Of
    a general form nothing may be left beside a special case of it.
    """
    d = model.dimension
    count = 2 * (len(model.free) + (d + 1) ** 2)
    x, signals = trial_points(model, count, either_sign=True)
    # A parameter that happens to be zero hides what others do in the same term.
    nonzero = np.random.default_rng(0).uniform(*ANYWHERE, size=len(model.parameters))
    values = np.where(model.values == 0, nonzero, model.values)
    slopes = model.functions.slopes(x, signals, values), model.functions.output_slopes(x, signals, values)
    by_state, own = (np.concatenate(each) for each in zip(*slopes, strict=True))
    # States x + ε(A x + b) obey f + ε([A x + b] f' - A f), and show h + ε[A x + b] h': nobody sees units.
    moved, rates = np.ones((d + 1, count)), np.zeros((d + 1, count))
    moved[1:], rates[1:] = x, model.functions.rates(x, signals, values)
    seen_otherwise = by_state[:, :, None] * moved
    seen_otherwise[range(d), range(d)] -= rates
    own = np.concatenate([own, seen_otherwise.reshape(len(own), -1, count)], axis=1)
    own = own.swapaxes(1, 2).reshape(len(own) * count, -1)
    result: list[MechanismCandidate | None] = []
    shown = [any(search.recorded for search in each.searches) for each in candidates]
    columns = [  # none of those of which only recordings tell where they act
        np.empty((len(own), 0)) if recorded else _columns(model, each, x, signals, values)
        for each, recorded in zip(candidates, shown, strict=True)
    ]
    for each, recorded, change in zip(candidates, shown, columns, strict=True):
        new = [True] if recorded else _new_columns(own, change)
        named = zip(columns, candidates, strict=True)
        special = [np.hstack([own, by]) for by, other in named if other.name in each.generalises]
        if not (recorded or all(any(_new_columns(one, change)) for one in special)):
            new = [False]
        needless = {name for name, is_new in zip(each.amplitudes, new, strict=False) if not is_new}
        if not any(new):
            result.append(None)
        else:
            result.append(_without_amplitudes(each, model, needless) if needless else each)
    return result


def _new_columns(own: np.ndarray, columns: np.ndarray) -> list[bool]:
    """Which columns are independent of others and of those before; rows that are no numbers tell nothing.

    Where too few rows are left to tell, all count as new: screening says what is the matter with them.
    """
    whole = np.isfinite(own).all(axis=1) & np.isfinite(columns).all(axis=1)
    if whole.sum() <= own.shape[1] + columns.shape[1]:
        return [True] * columns.shape[1]
    own, columns = _of_unit_length(own[whole]), _of_unit_length(columns[whole])
    basis = scipy.linalg.orth(own, INDEPENDENCE_TOLERANCE) if own.shape[1] else own
    new = []
    for column in columns.T:
        rest = column - basis @ (basis.T @ column)
        size = float(np.linalg.norm(rest))
        new.append(size > INDEPENDENCE_TOLERANCE)
        if new[-1]:
            basis = np.column_stack([basis, rest / size])
    return new


def _of_unit_length(columns: np.ndarray) -> np.ndarray:
    columns = columns / positive(np.abs(columns).max(axis=0, initial=0.0))  # first: squares may overflow
    return columns / positive(np.sqrt((columns**2).sum(axis=0)))


def _columns(
    model: Dynamics, candidate: MechanismCandidate, x: np.ndarray, signals: Signals, values: np.ndarray
) -> np.ndarray:
    """What a little of a mechanism does to f and h at points, shape ``((d + m) n, amplitudes)``.

    Of a mechanism without an amplitude it is the whole change, for a shape such as a search begins with.
    """
    augmented, count = candidate.model, x.shape[1]
    generator = np.random.default_rng(1)
    # Its further states and delayed inputs may be anything: no parameter of the simulation acts by them.
    further = generator.normal(size=(augmented.dimension - model.dimension, count)) * np.abs(x).mean()
    delayed = generator.normal(size=(len(augmented.delays), count))
    for place, each in enumerate(augmented.delays):
        if each in model.delays:
            delayed[place] = signals.delayed[model.delays.index(each)]
    at = (*x, *further, *signals.inputs, *delayed, *delayed, signals.t)
    shapes = dict(zip(candidate.shapes, candidate.searches, strict=True))
    new = []
    for each in augmented.parameters[len(model.parameters) :]:
        # A shape for which a mechanism is what its name says: in the middle of the search.
        shape = shapes.get(each.name)
        typical = 0.0 if shape is None else shape.at[len(shape.at) // 2] or 1.0
        text = shape and (shape.scale_of or shape.inverse_scale_of or shape.quantiles_of)
        if shape and text:
            formula, arguments = parse_formula(text, model.names), list(coordinates_of(model).values())
            (course,) = compile_values([formula], arguments)(*x, *signals.inputs, signals.t)
            typical = float(_sized(shape, np.array(typical), np.broadcast_to(course, x.shape[1:])))
        new.append(typical)
    entries = candidate.columns(model)
    result = np.zeros((model.dimension + len(model.outputs), count, max(len(candidate.amplitudes), 1)))
    functions = compile_values([each for _, _, each in entries], augmented.arguments)
    with np.errstate(all="ignore"):
        found = functions(*at, *values, *new)
    for (row, column, _), value in zip(entries, found, strict=True):
        result[row, :, column] = value
    return result.reshape(-1, result.shape[2])


def _without_amplitudes(
    candidate: MechanismCandidate, model: Dynamics, names: Collection[str]
) -> MechanismCandidate:
    """A candidate less some of its amplitudes, which a simulation's own parameters stand for.

    What is left adds to these, so that it may have either sign.
    """
    zero, whole = dict.fromkeys(map(symbol, names), 0), candidate.model

    def less(formula: sympy.Expr, before: sympy.Expr | None) -> sympy.Expr:
        left = formula.subs(zero)
        return before if before is not None and sympy.expand(left - before) == 0 else left

    rows = itertools.zip_longest(whole.equations, model.equations)
    measured = zip(whole.outputs, model.outputs, strict=True)
    reduced = replace(
        whole,
        parameters=tuple(each for each in whole.parameters if each.name not in names),
        equations=tuple(less(*each) for each in rows),
        outputs=tuple((name, less(formula, before)) for (name, formula), (_, before) in measured),
    )
    changes = ((name, formula.subs(zero)) for name, formula in candidate.changes)
    left = replace(
        candidate,
        model=reduced,
        amplitudes=tuple(name for name in candidate.amplitudes if name not in names),
        positive=candidate.positive & set(candidate.shapes),
        changes=tuple((name, formula) for name, formula in changes if formula != 0),
    )
    return _labelled(left, model)


PROCESS_NOISE = "process noise"


def candidates_of(model: Dynamics, roles: Roles, dictionary: Sequence[Mechanism]) -> list[MechanismCandidate]:
    """Every place at which a mechanism of the dictionary may be at work in a system.

    Process noise is not among them: it changes no equation. Nor is what the simulation's own parameters can
    do, which no recording could tell from other values of these.

    Raises
    ------
    InputError
        For a formula that the whitelist refuses.
    """
    found: list[tuple[MechanismCandidate, str]] = []
    for mechanism in dictionary:
        for form in mechanism.forms:
            if form.noise is not None:
                continue
            for assignment in assignments(form, model, roles):
                try:
                    candidate = _build_candidate(model, mechanism, form, assignment)
                except FormulaError as error:
                    raise InputError("the dictionary", mechanism.name, error.fault, error.remedy) from None
                if candidate is not None:
                    found.append((candidate, ", ".join(assignment.values())))
    reduced = _beyond_parameters(model, [each for each, _ in found])
    # Ways of filling the roles of a mechanism that end in one model are one.
    models: dict[tuple[object, ...], tuple[MechanismCandidate, str]] = {}
    for each, (_, filled) in zip(reduced, found, strict=True):
        if each is not None:
            key = (each.name, each.model.equations, each.model.outputs, each.begins)
            models.setdefault(key, (each, filled))
    # Labels occur once, where needed with what fills the roles, and then with what is added: two parameters
    # of one equation may drift, each of two species be satiated, and a coupling have two forms.
    by_label = Counter(each.label for each, _ in models.values())
    by_roles = Counter((each.label, filled) for each, filled in models.values())
    result = []
    for each, filled in models.values():
        label = each.label
        if by_label[label] > 1:
            formulas = "; ".join(str(formula) for _, formula in each.changes)
            label = f"{label} ({filled if by_roles[label, filled] == 1 else formulas})"
        result.append(replace(each, label=label))
    return result
