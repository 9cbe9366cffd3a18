"""Candidates: what each mechanism would change in the simulation at hand.

A mechanism is written for roles (`siq.mismatch.dictionary`); here it becomes models: the simulation with the
mechanism built in, its parameters at the end of the list. Generic monomials become candidates of the same
kind, for systems whose states have no roles.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import sympy

from siq.dynamics.dynamics import Dynamics, Parameter
from siq.dynamics.formulas import FormulaError, parse_formula
from siq.dynamics.parametric import symbol
from siq.errors import InputError
from siq.mismatch.assignments import assignments
from siq.mismatch.dictionary import Form, Mechanism, Shape
from siq.mismatch.roles import Roles
from siq.mismatch.units import unit_of

GENERIC = "generic monomial"
PROCESS_NOISE = "process noise"


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
    scales
        For each further state a formula of its size.
    equations
        States in whose equations something changes.
    coordinate
        Along which coordinate it acts, in words of the system.
    changes
        What is added to equations, by state; where something is replaced, the new equation or output; and
        the equations of further states.
    generalises
        Mechanisms that are special cases of it.
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

    @property
    def new(self) -> tuple[str, ...]:
        """All new parameters, in the order of the model's."""
        return tuple(p.name for p in self.model.parameters if p.name in {*self.amplitudes, *self.shapes})


def candidates_of(
    model: Dynamics, roles: Roles, dictionary: Sequence[Mechanism], *, file: str = "the dictionary"
) -> list[MechanismCandidate]:
    """Every place at which a mechanism of the dictionary may be at work in a system.

    Process noise is not among them: it changes no equation (`siq.estimation.noise` estimates it).

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
                    candidate = build_candidate(model, mechanism, form, assignment)
                except FormulaError as error:
                    raise InputError(file, mechanism.name, error.fault, error.remedy) from None
                if candidate is not None:
                    found.append((candidate, ", ".join(assignment.values())))
    return _told_apart(found)


def _told_apart(found: Sequence[tuple[MechanismCandidate, str]]) -> list[MechanismCandidate]:
    """Labels that occur once, where needed with what fills the roles, and then with what is added.

    Two parameters of one equation may drift, each of two species be satiated, and a coupling have two forms.
    """
    by_label = Counter(each.label for each, _ in found)
    by_roles = Counter((each.label, roles) for each, roles in found)
    result = []
    for each, roles in found:
        if by_label[each.label] > 1:
            added = "; ".join(str(formula) for _, formula in each.changes)
            known = roles if by_roles[each.label, roles] == 1 else added
            each = replace(each, label=f"{each.label} ({known})")
        result.append(each)
    return result


def generic_candidates(model: Dynamics, roles: Roles, *, degree: int) -> list[MechanismCandidate]:
    """Monomials of the states up to a degree in every equation that says more than a definition."""
    states = [symbol(name) for name in model.states]
    found = []
    for place, name in enumerate(model.states):
        if name not in roles.states:
            continue
        for powers in itertools.product(range(degree + 1), repeat=len(states)):
            if sum(powers) > degree:
                continue
            monomial = sympy.prod([s**p for s, p in zip(states, powers, strict=True)])
            new = _fresh("c", model)
            units = {f"_{k}": unit for k, unit in enumerate(model.units)}
            per = "*".join(f"_{k}**{power}" for k, power in enumerate(powers) if power)
            unit = unit_of(f"_{place}/_t" + (f"/({per})" if per else ""), {**units, "_t": model.time_unit})
            augmented = replace(
                model,
                parameters=(*model.parameters, Parameter(new, 0.0, unit)),
                equations=tuple(
                    formula + (symbol(new) * monomial if k == place else 0)
                    for k, formula in enumerate(model.equations)
                ),
            )
            found.append(
                MechanismCandidate(
                    name=GENERIC,
                    label=f"{GENERIC} {monomial} in {name}",
                    model=augmented,
                    amplitudes=(new,),
                    shapes=(),
                    positive=frozenset(),
                    searches=(),
                    scales=(),
                    equations=(name,),
                    coordinate=", ".join(s for s, p in zip(model.states, powers, strict=True) if p)
                    or "constant",
                    changes=((name, symbol(new) * monomial),),
                )
            )
    return found


def build_candidate(
    model: Dynamics, mechanism: Mechanism, form: Form, assignment: Mapping[str, str]
) -> MechanismCandidate | None:
    """Build a mechanism into a model, for one assignment of names to roles; None where it changes nothing."""
    fresh: dict[str, str] = {}
    known = model
    for name in (*form.parameters, *form.states):
        fresh[name] = _fresh(name, known, set(fresh.values()))
    names: dict[str, sympy.Expr] = {role: symbol(name) for role, name in assignment.items()}
    equations = dict(zip(model.states, model.equations, strict=True))
    for one, other in itertools.permutations(
        [role for role, kind in form.roles.items() if kind == "population"], 2
    ):
        names[f"{one}_with_{other}"] = _interaction(
            equations[assignment[one]], assignment[one], assignment[other]
        )
    names |= {name: symbol(new) for name, new in fresh.items()} | {"t": symbol("t")}
    inputs = tuple(role for role, kind in form.roles.items() if kind == "input")

    def parse(text: object) -> sympy.Expr:
        return parse_formula(str(text), names, inputs=[assignment[role] for role in inputs] if inputs else ())

    outputs = dict(model.outputs)
    if form.replace:
        put = {symbol(assignment[role]): parse(text) for role, text in form.replace.items()}
        equations = {name: formula.subs(put, simultaneous=True) for name, formula in equations.items()}
        outputs = {name: formula.subs(put, simultaneous=True) for name, formula in outputs.items()}
    changes: list[tuple[str, sympy.Expr]] = []
    for name, before in zip(model.states, model.equations, strict=True):
        if equations[name] != before:
            changes.append((name, equations[name]))
    for role, text in form.terms.items():
        added = parse(text)
        changes.append((assignment[role], added))
        equations[assignment[role]] = equations[assignment[role]] + added
    for role, text in form.outputs.items():
        names[role] = outputs[assignment[role]]
        outputs[assignment[role]] = parse(text)
        changes.append((assignment[role], outputs[assignment[role]]))
    if tuple(equations.values())[: model.dimension] == model.equations and outputs == dict(model.outputs):
        return None
    units = _units(model, assignment)
    parameters = tuple(
        Parameter(fresh[name], 0.0, unit_of(entry.unit, units)) for name, entry in form.parameters.items()
    )
    further = tuple(
        (fresh[name], unit_of(entry.unit, units), parse(entry.equation), parse(entry.scale))
        for name, entry in form.states.items()
    )
    augmented = replace(
        model,
        states=(*model.states, *(each[0] for each in further)),
        units=(*model.units, *(each[1] for each in further)),
        diffusion=model.diffusion.extended(len(further)),
        domain=np.concatenate([model.limits, np.full((len(further), 2), np.nan)]),  # until a fit tells it
        parameters=(*model.parameters, *parameters),
        equations=(*equations.values(), *(each[2] for each in further)),
        outputs=tuple(outputs.items()),
    )
    changed = tuple(
        name for name, before in zip(model.states, model.equations, strict=True) if equations[name] != before
    )
    searches = tuple(
        _in_names(entry.shape, names) for entry in form.parameters.values() if entry.shape is not None
    )
    return MechanismCandidate(
        name=mechanism.name,
        label=_label(mechanism.name, model, augmented),
        model=augmented,
        amplitudes=tuple(fresh[name] for name, entry in form.parameters.items() if entry.shape is None),
        shapes=tuple(fresh[name] for name, entry in form.parameters.items() if entry.shape is not None),
        positive=frozenset(
            fresh[name] for name, entry in form.parameters.items() if entry.sign == "positive"
        ),
        searches=searches,
        scales=tuple(each[3] for each in further),
        equations=changed,
        coordinate=_in_words(form.coordinate, assignment),
        changes=(*changes, *((each[0], each[2]) for each in further)),
        generalises=mechanism.generalises,
    )


def _fresh(name: str, model: Dynamics, taken: set[str] | None = None) -> str:
    """A name as in the dictionary, numbered so that it collides with none of the card."""
    used = set(model.names) | (taken or set())
    return next(f"{name}_{k}" for k in itertools.count(1) if f"{name}_{k}" not in used)


def _interaction(equation: sympy.Expr, one: str, other: str) -> sympy.Expr:
    """The part of an equation in which two states stand together."""
    terms = sympy.Add.make_args(sympy.expand(equation))
    both = {symbol(one), symbol(other)}
    return sympy.Add(*(term for term in terms if both <= term.free_symbols))


def _in_names(shape: Shape, names: Mapping[str, sympy.Expr]) -> Shape:
    """A search with the system's own names in its formulas."""
    texts = {
        key: None if text is None else str(parse_formula(text, names))
        for key, text in (
            ("scale_of", shape.scale_of),
            ("inverse_scale_of", shape.inverse_scale_of),
            ("quantiles_of", shape.quantiles_of),
        )
    }
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


def _label(name: str, model: Dynamics, augmented: Dynamics) -> str:
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
    return f"{name} in {', '.join(places)}" if places else f"{name} in {', '.join(measured)}, by {new}"
