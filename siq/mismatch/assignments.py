"""Who fills the roles of a mechanism: all ways, for the states, inputs, outputs and parameters at hand."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator

from siq.dynamics.dynamics import Dynamics
from siq.mismatch.dictionary import Form
from siq.mismatch.roles import Roles


def assignments(form: Form, model: Dynamics, roles: Roles) -> Iterator[dict[str, str]]:
    """Every way of filling a form's roles.

    Position and velocity, and the two quadratures of a rotating frame, are filled in pairs where the form
    names them one after the other. Nothing fills two roles, and of a symmetric form's ways only one is kept.

    Yields
    ------
    dict
        From each role to the name that fills it.
    """
    kinds = list(form.roles.values())
    names = list(form.roles)
    choices: list[list[dict[str, str]]] = []
    place = 0
    while place < len(names):
        kind, following = kinds[place], kinds[place + 1] if place + 1 < len(kinds) else None
        if kind == "position" and following == "velocity":
            choices.append([{names[place]: x, names[place + 1]: v} for x, v in roles.motions])
            place += 2
        elif kind == "amplitude" and following == "amplitude":
            choices.append([{names[place]: a, names[place + 1]: b} for a, b in roles.amplitudes])
            place += 2
        else:
            choices.append([{names[place]: name} for name in _of_kind(kind, model, roles)])
            place += 1
    for combination in itertools.product(*choices):
        filled = [name for part in combination for name in part.values()]
        if len(set(filled)) < len(filled) or (form.symmetric and filled != sorted(filled, key=_order(model))):
            continue
        yield {role: name for part in combination for role, name in part.items()}


def _order(model: Dynamics) -> Callable[[str], int]:
    places = {name: place for place, name in enumerate(model.states)}
    return lambda name: places.get(name, -1)


def _of_kind(kind: str, model: Dynamics, roles: Roles) -> tuple[str, ...]:
    return {
        "position": tuple(x for x, _ in roles.motions),
        "velocity": tuple(v for _, v in roles.motions),
        "amplitude": tuple(name for pair in roles.amplitudes for name in pair),
        "population": roles.populations,
        "level": roles.levels,
        "state": roles.states,
        "input": tuple(entry.name for entry in model.inputs),
        "parameter": tuple(entry.name for entry in model.parameters),  # what is known at first may drift, too
        "output": model.output_names,
    }[kind]
