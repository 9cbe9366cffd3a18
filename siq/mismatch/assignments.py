"""Who fills the roles of a mechanism: all ways, for the states, inputs, outputs and parameters at hand."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence

from siq.dynamics.dynamics import Dynamics
from siq.mismatch.dictionary import Form
from siq.mismatch.roles import Roles


def assignments(form: Form, model: Dynamics, roles: Roles) -> Iterator[dict[str, str]]:
    """Every way of filling a form's roles.

    Position (or displacement, or angle) and velocity, the two quadratures of a rotating frame, prey and
    predator, and upper and lower level are filled in pairs where the form names them one after the other.
    Nothing fills two roles, and of a symmetric form's ways only one is kept.

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
        pairs = _pairs(kinds[place : place + 2], roles)
        if pairs is not None:
            choices.append([{names[place]: one, names[place + 1]: other} for one, other in pairs])
            place += 2
        else:
            choices.append([{names[place]: name} for name in _of_kind(kinds[place], model, roles)])
            place += 1
    units = dict(zip(model.states, model.units, strict=True))
    for combination in itertools.product(*choices):
        filled = [name for part in combination for name in part.values()]
        if len(set(filled)) < len(filled) or (form.symmetric and filled != sorted(filled, key=_order(model))):
            continue
        found = {units.get(name, "1") for name in filled} if form.one_unit else set()
        if len(found) > 1 or "1" in found:
            continue
        yield {role: name for part in combination for role, name in part.items()}


def _pairs(kinds: Sequence[str], roles: Roles) -> tuple[tuple[str, str], ...] | None:
    """What fills two roles together; None where they are filled one by one."""
    match kinds:
        case ["position", "velocity"]:
            return roles.motions
        case ["displacement", "velocity"]:
            return tuple(pair for pair in roles.motions if pair[0] not in roles.angles)
        case ["angle", "velocity"]:
            return tuple(pair for pair in roles.motions if pair[0] in roles.angles)
        case ["amplitude", "amplitude"]:
            return roles.amplitudes
        case ["prey", "predator"]:
            return roles.feeding
        case ["upper level", "lower level"]:
            return roles.cascades
    return None


def _order(model: Dynamics) -> Callable[[str], int]:
    places = {name: place for place, name in enumerate(model.states)}
    return lambda name: places.get(name, -1)


def _of_kind(kind: str, model: Dynamics, roles: Roles) -> tuple[str, ...]:
    return {
        "position": tuple(x for x, _ in roles.motions),
        "displacement": tuple(x for x, _ in roles.motions if x not in roles.angles),
        "angle": roles.angles,
        "velocity": tuple(v for _, v in roles.motions),
        "amplitude": tuple(name for pair in roles.amplitudes for name in pair),
        "population": roles.populations,
        "prey": tuple(prey for prey, _ in roles.feeding),
        "predator": tuple(predator for _, predator in roles.feeding),
        "level": roles.levels,
        "upper level": tuple(upper for upper, _ in roles.cascades),
        "lower level": tuple(lower for _, lower in roles.cascades),
        "store": roles.stores,
        "stock": (*roles.populations, *roles.levels, *roles.stores),
        "state": roles.states,
        "input": tuple(entry.name for entry in model.inputs),
        "parameter": tuple(entry.name for entry in model.parameters),  # what is known at first may drift, too
        "output": model.output_names,
    }[kind]
