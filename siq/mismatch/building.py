"""What a mechanism becomes in a system: the simulation with the mechanism built in.

A mechanism is written for roles (`siq.mismatch.dictionary`). Beside the roles its formulas may use what the
simulation itself says of them: `v_rate`, the equation of the state v; `p_with_q`, the part of the equation of
p in which q stands as well; `y_rate` and `y_curvature`, the first and second time derivative of the output y,
inputs being held.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
import sympy

from siq.dynamics.dynamics import Dynamics, Parameter
from siq.dynamics.formulas import parse_formula
from siq.dynamics.parametric import TIME, symbol
from siq.mismatch.dictionary import Form, Mechanism, Shape
from siq.mismatch.roles import meetings
from siq.mismatch.units import unit_of


@dataclass(frozen=True)
class MechanismCandidate:
    """One way in which a mechanism may be at work in a system.

    Attributes
    ----------
    name
        Of the mechanism.
    label
        The same, told apart from its other forms and places: what is added where.
    model
        The simulation with the mechanism built in; amplitudes are zero, shapes not yet set.
    amplitudes, shapes
        Names of the new parameters, those that the mechanism depends on linearly and the others.
    positive
        Those that must not be negative.
    searches
        For each shape how it is looked for.
    scales, begins
        For each further state a formula of its size, and one of where it begins.
    equations
        States in whose equations something changes.
    coordinate
        Along which coordinate it acts, in words of the system.
    changes
        What is added to equations, by state; where something is replaced, the new equation or output; and
        the equations of further states.
    generalises
        Mechanisms that are special cases of it.
    variant
        What tells its form from others, in words.
    """

    name: str
    label: str
    model: Dynamics
    amplitudes: tuple[str, ...]
    shapes: tuple[str, ...]
    positive: frozenset[str]
    searches: tuple[Shape, ...]
    scales: tuple[sympy.Expr, ...]
    equations: tuple[str, ...]
    coordinate: str
    changes: tuple[tuple[str, sympy.Expr], ...] = ()
    generalises: tuple[str, ...] = ()
    begins: tuple[sympy.Expr, ...] = ()
    variant: str = ""

    @property
    def new(self) -> tuple[str, ...]:
        """All new parameters, in the order of the model's."""
        return tuple(p.name for p in self.model.parameters if p.name in {*self.amplitudes, *self.shapes})


def build_candidate(
    model: Dynamics, mechanism: Mechanism, form: Form, assignment: Mapping[str, str]
) -> MechanismCandidate | None:
    """Build a mechanism into a model, for one assignment of names to roles; None where it changes nothing."""
    fresh: dict[str, str] = {}
    for name in (*form.parameters, *form.states):
        fresh[name] = fresh_name(name, model, set(fresh.values()))
    names = _vocabulary(model, form, assignment, fresh)
    equations = dict(zip(model.states, model.equations, strict=True))
    outputs = dict(model.outputs)
    delayed = [assignment[role] for role, kind in form.roles.items() if kind == "input"]

    def parse(text: object, **other: sympy.Expr) -> sympy.Expr:
        return parse_formula(str(text), names | other, inputs=delayed)

    changes = list(_built_in(form, assignment, parse, equations, outputs))
    if tuple(equations.values()) == model.equations and outputs == dict(model.outputs):
        return None
    units = _units(model, assignment)
    parameters = tuple(
        Parameter(
            fresh[name],
            0.0,
            unit_of(entry.unit, units),
            fixed=entry.shape is not None and entry.shape.lattice_of is not None,
        )
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
    shapes = {name: entry.shape for name, entry in form.parameters.items() if entry.shape is not None}
    return MechanismCandidate(
        name=mechanism.name,
        label=label_of(mechanism.name, form.variant, model, augmented),
        model=augmented,
        amplitudes=tuple(fresh[name] for name in form.parameters if name not in shapes),
        shapes=tuple(fresh[name] for name in shapes),
        positive=frozenset(
            fresh[name] for name, entry in form.parameters.items() if entry.sign == "positive"
        ),
        searches=tuple(_in_names(shape, names, assignment) for shape in shapes.values()),
        scales=tuple(parse(entry.scale) for entry in form.states.values()),
        begins=tuple(parse(entry.begin) for entry in form.states.values()),
        equations=tuple(
            name
            for name, before in zip(model.states, model.equations, strict=True)
            if equations[name] != before
        ),
        coordinate=_in_words(form.coordinate, assignment),
        changes=(*changes, *further),
        generalises=mechanism.generalises,
        variant=form.variant,
    )


def fresh_name(name: str, model: Dynamics, taken: set[str] | None = None) -> str:
    """A name as in the dictionary, numbered so that it collides with none of the card."""
    used = set(model.names) | (taken or set())
    return next(f"{name}_{k}" for k in itertools.count(1) if f"{name}_{k}" not in used)


def _built_in(
    form: Form,
    assignment: Mapping[str, str],
    parse: Callable[..., sympy.Expr],
    equations: dict[str, sympy.Expr],
    outputs: dict[str, sympy.Expr],
) -> Iterator[tuple[str, sympy.Expr]]:
    """Change equations and outputs as a form says, and tell what is added, or else the new formula."""
    before = dict(equations)
    put = {symbol(assignment[role]): parse(text) for role, text in form.replace.items()}
    for formulas in (equations, outputs):
        for name in formulas:
            formulas[name] = formulas[name].subs(put, simultaneous=True)
    for role, texts in form.within.items():
        name = assignment[role]
        put = {symbol(assignment[other]): parse(text) for other, text in texts.items()}
        equations[name] = equations[name].subs(put, simultaneous=True)
    yield from ((name, formula) for name, formula in equations.items() if formula != before[name])
    for role, text in form.terms.items():
        added = parse(text)
        equations[assignment[role]] += added
        yield assignment[role], added
    for role, text in form.outputs.items():
        outputs[assignment[role]] = parse(text, **{role: outputs[assignment[role]]})
        yield assignment[role], outputs[assignment[role]]


def _vocabulary(
    model: Dynamics, form: Form, assignment: Mapping[str, str], fresh: Mapping[str, str]
) -> dict[str, sympy.Expr]:
    """What every name in a form's formulas stands for."""
    equations = dict(zip(model.states, model.equations, strict=True))
    names: dict[str, sympy.Expr] = {role: symbol(name) for role, name in assignment.items()}
    wanted = _words(form)  # the others are not worked out: formulas of many terms take their time
    for role in (role for role, kind in form.roles.items() if kind == "output"):
        names[role] = dict(model.outputs)[assignment[role]]
        if {f"{role}_rate", f"{role}_curvature"} & wanted:
            names[f"{role}_rate"] = rate_of(names[role], model)
            names[f"{role}_curvature"] = rate_of(names[f"{role}_rate"], model)
    states = [role for role, kind in form.roles.items() if kind not in ("input", "parameter", "output")]
    for one in states:
        names[f"{one}_rate"] = equations[assignment[one]]
    for one, other in itertools.permutations(states, 2):
        if f"{one}_with_{other}" in wanted:
            names[f"{one}_with_{other}"] = meetings(
                equations[assignment[one]], assignment[one], assignment[other]
            )
    return names | {name: symbol(new) for name, new in fresh.items()} | {"t": TIME}


def _words(form: Form) -> set[str]:
    """The names that a form's formulas use."""
    within = (text for texts in form.within.values() for text in texts.values())
    states = (text for each in form.states.values() for text in (each.equation, each.scale, each.begin))
    texts = (*form.terms.values(), *form.replace.values(), *form.outputs.values(), *within, *states)
    return set(re.findall(r"[A-Za-z_]\w*", " ".join(map(str, texts))))


def rate_of(formula: sympy.Expr, model: Dynamics) -> sympy.Expr:
    """Time derivative of a formula of states along the equations, inputs being held."""
    along = zip(model.states, model.equations, strict=True)
    return formula.diff(TIME) + sum(formula.diff(symbol(name)) * equation for name, equation in along)


def _in_names(shape: Shape, names: Mapping[str, sympy.Expr], assignment: Mapping[str, str]) -> Shape:
    """A search with the system's own names in its formulas."""
    texts: dict[str, str | None] = {
        key: None if text is None else str(parse_formula(text, names))
        for key, text in (
            ("scale_of", shape.scale_of),
            ("inverse_scale_of", shape.inverse_scale_of),
            ("quantiles_of", shape.quantiles_of),
            ("time_of", shape.time_of),
        )
    }
    for key in ("lattice_of", "top_of", "bottom_of"):
        if (role := getattr(shape, key)) is not None:
            texts[key] = assignment[role]
    return shape.model_copy(update=texts)


def _in_words(coordinate: str, assignment: Mapping[str, str]) -> str:
    return " ".join(assignment.get(word, word) for word in coordinate.split())


def _units(model: Dynamics, assignment: Mapping[str, str]) -> dict[str, str]:
    known = dict(zip(model.states, model.units, strict=True))
    known |= {entry.name: entry.unit for entry in model.inputs}
    known |= {entry.name: entry.unit for entry in model.parameters}
    for name, formula in model.outputs:
        known.setdefault(name, known.get(str(formula), "1"))
    return {role: known.get(name, "1") for role, name in assignment.items()} | {"T": model.time_unit}


def label_of(name: str, variant: str, model: Dynamics, augmented: Dynamics) -> str:
    """A mechanism's name, with its variant, and where it changes a simulation."""
    places = [
        state
        for state, before, after in zip(model.states, model.equations, augmented.equations, strict=False)
        if before != after
    ]
    measured = [
        output
        for (output, before), (_, after) in zip(model.outputs, augmented.outputs, strict=True)
        if before != after
    ]
    new = ", ".join(entry.name for entry in augmented.parameters[len(model.parameters) :])
    whole = f"{name} {variant}" if variant else name
    if places or variant:
        return f"{whole} in {', '.join(places or measured)}"
    return f"{whole} in {', '.join(measured)}, by {new}"
