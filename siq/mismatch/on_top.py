"""Can a mechanism be added on top of those that were found, and what does it become there?"""

from __future__ import annotations

from dataclasses import replace

import sympy

from siq.dynamics.dynamics import Dynamics
from siq.dynamics.parametric import symbol
from siq.mismatch.building import MechanismCandidate


def once_more(candidate: MechanismCandidate, found: MechanismCandidate) -> bool:
    """Whether a candidate is what was found already: the same, or in another form at the same place.

    A second threshold beside the first, or a second spring in the same place, is no further physics.
    """
    same_place = candidate.coordinate == found.coordinate and set(candidate.equations) & set(found.equations)
    return candidate.label == found.label or (
        candidate.name == found.name and candidate.coordinate in found.model.states and bool(same_place)
    )


def rebased(candidate: MechanismCandidate, before: Dynamics, now: Dynamics) -> MechanismCandidate:
    """A candidate on top of a model that has grown since."""
    names = {parameter.name for parameter in now.parameters}
    model = candidate.model
    renamed = {name: name for name in candidate.new}
    for name in candidate.new:
        if name in names:
            stem, _, number = name.rpartition("_")
            k = int(number)
            while f"{stem}_{k}" in names or f"{stem}_{k}" in renamed.values():
                k += 1
            renamed[name] = f"{stem}_{k}"
    change = {symbol(old): symbol(new) for old, new in renamed.items() if old != new}

    def merge(theirs: sympy.Expr, old: sympy.Expr, ours: sympy.Expr) -> sympy.Expr:
        return ours + (theirs - old).xreplace(change)

    count = len(before.parameters)
    equations = [
        merge(t, o, n)
        for t, o, n in zip(model.equations[: before.dimension], before.equations, now.equations, strict=True)
    ]
    outputs = [
        (name, merge(t, o, n))
        for (name, t), (_, o), (_, n) in zip(model.outputs, before.outputs, now.outputs, strict=True)
    ]
    new = tuple(replace(p, name=renamed[p.name]) for p in model.parameters[count:])
    return replace(
        candidate,
        model=replace(
            model,
            equations=(*equations, *(each.xreplace(change) for each in model.equations[before.dimension :])),
            outputs=tuple(outputs),
            parameters=(*now.parameters, *new),
        ),
        changes=tuple((name, formula.xreplace(change)) for name, formula in candidate.changes),
        amplitudes=tuple(renamed[name] for name in candidate.amplitudes),
        shapes=tuple(renamed[name] for name in candidate.shapes),
        positive=frozenset(renamed[name] for name in candidate.positive),
    )
