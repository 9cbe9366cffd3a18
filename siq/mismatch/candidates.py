"""Candidates: what each mechanism would change in the simulation at hand.

A mechanism is written for roles (`siq.mismatch.dictionary`); here it becomes models, one for each way of
filling the roles (`siq.mismatch.building`). Generic monomials become candidates of the same kind, for systems
whose states have no roles.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import sympy

from siq.dynamics.dynamics import Dynamics, Parameter
from siq.dynamics.formulas import FormulaError
from siq.dynamics.parametric import symbol
from siq.errors import InputError
from siq.mismatch.assignments import assignments
from siq.mismatch.building import MechanismCandidate, build_candidate, fresh_name
from siq.mismatch.dictionary import Mechanism
from siq.mismatch.recalibrations import beyond_parameters
from siq.mismatch.roles import Roles
from siq.mismatch.units import unit_of

__all__ = ["GENERIC", "PROCESS_NOISE", "MechanismCandidate", "candidates_of", "generic_candidates"]

GENERIC = "generic monomial"
PROCESS_NOISE = "process noise"


def candidates_of(
    model: Dynamics, roles: Roles, dictionary: Sequence[Mechanism], *, file: str = "the dictionary"
) -> list[MechanismCandidate]:
    """Every place at which a mechanism of the dictionary may be at work in a system.

    Process noise is not among them: it changes no equation (`siq.estimation.noise` estimates it). Nor is what
    the simulation's own parameters can do (`siq.mismatch.recalibrations`), which no recording could tell from
    other values of these.

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
    reduced = beyond_parameters(model, [each for each, _ in found])
    result: list[tuple[MechanismCandidate, str]] = []
    for each, (_, filled) in zip(reduced, found, strict=True):
        if each is not None and not any(_same(each, other) for other, _ in result):
            result.append((each, filled))
    return _told_apart(result)


def _same(one: MechanismCandidate, other: MechanismCandidate) -> bool:
    """Whether two ways of filling the roles of a mechanism end in one model."""
    return (
        one.name == other.name
        and one.model.equations == other.model.equations
        and one.model.outputs == other.model.outputs
    )


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


def generic_candidates(
    model: Dynamics, roles: Roles, *, degree: int, named: Sequence[MechanismCandidate] = ()
) -> list[MechanismCandidate]:
    """Monomials of the states up to a degree in every equation that says more than a definition.

    Those that the simulation's own parameters can do are left out, and so are those that have a name.

    Parameters
    ----------
    model, roles
        The simulation.
    degree
        Highest degree.
    named
        Candidates of the dictionary.
    """
    states = [symbol(name) for name in model.states]
    found = []
    for place, name in enumerate(model.states):
        if name not in roles.states:
            continue
        for powers in itertools.product(range(degree + 1), repeat=len(states)):
            if sum(powers) > degree:
                continue
            monomial = sympy.prod([s**p for s, p in zip(states, powers, strict=True)])
            new = fresh_name("c", model)
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
    have_names = {_added_square(each) for each in named} - {None}
    found = [each for each in found if _added_square(each) not in have_names]
    return [each for each in beyond_parameters(model, found) if each is not None]


def _added_square(candidate: MechanismCandidate) -> tuple[str, sympy.Expr] | None:
    """Where and what a candidate of one term adds, whatever its sign; None for any other."""
    if candidate.shapes or len(candidate.amplitudes) != 1 or len(candidate.changes) != 1:
        return None
    place, formula = candidate.changes[0]
    if candidate.equations != (place,):
        return None  # it changes what is measured
    return place, formula.diff(symbol(candidate.amplitudes[0])) ** 2
