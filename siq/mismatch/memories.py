"""Memories: does what is missing depend on what a coordinate was, and not only on what it is?

A body that warms up, a store that fills, a prey that takes time to become a predator: what such a thing does
depends on a hidden state that follows a coordinate late, ``z' = (x - z)/τ``, or that the coordinate makes
ring, ``τ² z'' + kτ z' + z = x``. A function of what is measured now can only imitate it, mostly as one of the
time. Such forms have no name of their own; they describe what is missing where they are likelier than any
function.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import sympy

from siq.dynamics.dynamics import Dynamics
from siq.estimation.fit import Fit
from siq.estimation.measurements import Measurements
from siq.mismatch.building import MechanismCandidate
from siq.mismatch.candidates import candidates_of
from siq.mismatch.dictionary import Form, FurtherState, Mechanism, MechanismParameter, Role, Shape
from siq.mismatch.fitted_parts import LARGEST_PART, fitted_part
from siq.mismatch.nameless_models import Material, Model, Part
from siq.mismatch.probes import Probe, with_further_states
from siq.mismatch.promises import screen_all
from siq.mismatch.remainder import something_left
from siq.mismatch.roles import Roles
from siq.mismatch.screening import Screened
from siq.mismatch.trials import best_probes
from siq.mismatch.tried import UNFORESEEN, admissible

LOGGER = logging.getLogger(__name__)
# Times τ that are tried, in units of the time in which the coordinate changes; the best of them is then
# fitted. A much shorter memory cannot be told from none, nor a much longer one from a constant of each
# recording.
TIMES = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)
DAMPINGS = (0.1, 1.0)  # k of what rings, tried and then fitted: over many turns, and over hardly one
MOST = 6  # memories that are fitted, the most promising ones: a choice


def memory_suspected(models: Sequence[Model], data: Measurements) -> bool:
    """Whether models leave room for a memory: all but a function of one coordinate that leaves nothing.

    The time is no such coordinate, since nothing but the time itself knows it: what seems to depend on it may
    have been brought about before.

    Parameters
    ----------
    models
        Of what has no name, the likeliest first.
    data
        The recordings.
    """
    if not models:
        return True
    best = models[0]
    place = best.parts[0].place
    told = len(best.parts) == 1 and place is not None and len(place.words) == 1 and place.words[0] != "t"
    return not told or something_left(best.fit, data)


def with_memories(fit: Fit, models: Sequence[Model], material: Material) -> list[Model]:
    """Models with a hidden state that follows a coordinate late, or that it makes ring.

    Parameters
    ----------
    fit
        Of the simulation without them.
    models
        Others: the equations in which these have something come first, should work be scarce.
    material
        What models are made from.
    """
    likely = {name for each in models for part in each.parts for name in part.trial.candidate.equations}
    candidates = sorted(
        memories_of(fit.model, material.roles), key=lambda each: not likely & set(each.equations)
    )
    if not candidates:
        return []
    cost = float(np.log(len(candidates)))
    # Nobody knows what was remembered when a recording began: what was there already, or nothing.
    begun = [
        each
        for one in candidates
        for each in (one, replace(one, begins=(sympy.Integer(0),) * len(one.begins)))
    ]
    with material.budget.part(LARGEST_PART):
        screened, _ = screen_all(fit.model, material.data, fit, begun, budget=material.budget)
    found: list[Model] = []
    ranked = sorted(best_probes(screened).values(), key=lambda each: -each[1].gain)
    for probe, result in ranked[:MOST]:
        if result.gain < 2 * cost:
            break
        found += [Model((part,), part.trial.fit) for part in _fitted(probe, result, fit, cost, material)]
    return found


def _fitted(probe: Probe, result: Screened, fit: Fit, cost: float, material: Material) -> list[Part]:
    """A memory fitted from no effect on, with the τ that promises most."""
    candidate, model = probe.candidate, probe.candidate.model
    known = dict(probe.shapes)
    values = [known.get(each.name, each.value) for each in model.parameters]
    candidate = replace(candidate, model=model.with_values(np.array(values)))
    try:
        x = with_further_states(
            probe, fit.model, material.data, fit.x, substeps=fit.substeps, values=fit.model.values
        )
    except UNFORESEEN as error:
        LOGGER.info("%s cannot be fitted: %s", candidate.label, error)
        return []
    begin = replace(fit, x=x)
    parts = fitted_part(candidate, result.level, None, fit, cost, material, begin=begin)
    for each in parts:
        LOGGER.info("%s: chi2 better by %.1f", candidate.label, each.trial.delta_chi2)
    return [each for each in parts if admissible(each.trial.fit, candidate)]


def memories_of(model: Dynamics, roles: Roles) -> list[MechanismCandidate]:
    """A memory of every coordinate in every equation that says more than a definition."""
    what = Mechanism(name="memory", sentence="What is missing follows a coordinate late.", forms=FORMS)
    return [_named(each) for each in candidates_of(model, roles, (what,))]


def _named(candidate: MechanismCandidate) -> MechanismCandidate:
    name = f"a memory of {candidate.coordinate}"
    variant = f", {candidate.variant}" if candidate.variant else ""
    return replace(candidate, name=name, label=f"{name} in {', '.join(candidate.equations)}{variant}")


def _late(of: str) -> Shape:
    return Shape(time_of=of, at=TIMES)


def _form(
    roles: dict[str, Role],
    of: str,
    terms: dict[str, str],
    unit: str,
    variant: str = "",
    *,
    own_unit: str | None = None,
    coordinate: str | None = None,
) -> Form:
    """A form in which z follows a coordinate, or a formula with a unit and a word, and acts with c."""
    return Form(
        roles=roles,
        states={"z": FurtherState(equation=f"({of} - z)/tau", begin=of, unit=own_unit or of, scale=of)},
        terms=terms,
        parameters={
            "c": MechanismParameter(unit=unit),
            "tau": MechanismParameter(sign="positive", unit="T", shape=_late(of)),
        },
        coordinate=coordinate or of,
        variant=variant,
    )


def _forms_of(roles: dict[str, Role], of: str) -> tuple[Form, ...]:
    """What is remembered as a force, and as a rate at which the state grows; and what rings."""
    ringing = Form(
        roles=roles,
        states={
            "z": FurtherState(equation="y", begin=of, unit=of, scale=of),
            "y": FurtherState(equation=f"({of} - z)/tau**2 - k*y/tau", unit=f"{of}/T", scale=of),
        },
        terms={"q": "c*z"},
        parameters={
            "c": MechanismParameter(unit=f"q/T/{of}"),
            "tau": MechanismParameter(sign="positive", unit="T", shape=_late(of)),
            "k": MechanismParameter(sign="positive", shape=Shape(scale_of="1", at=DAMPINGS)),
        },
        coordinate=of,
        variant="that rings",
    )
    return (
        _form(roles, of, {"q": "c*z"}, f"q/T/{of}"),
        _form(roles, of, {"q": "c*z*q"}, f"1/T/{of}", "as a rate"),
        ringing,
    )


def _intensity(terms: dict[str, str], variant: str) -> Form:
    """In a rotating frame what is remembered is the intensity, which shifts the frequency, or damps."""
    return _form(
        {"p": "amplitude", "q": "amplitude"}, "p**2 + q**2", terms, "1/T/p**2", variant,
        own_unit="p**2", coordinate="amplitude",
    )  # fmt: skip


FORMS = (
    *_forms_of({"q": "state"}, "q"),
    *_forms_of({"x": "state", "q": "state"}, "x"),
    *_forms_of({"x": "position", "q": "state"}, "x"),
    *_forms_of({"x": "input", "q": "state"}, "x"),
    _intensity({"p": "c*z*q", "q": "-c*z*p"}, "across the state"),
    _intensity({"p": "c*z*p", "q": "c*z*q"}, "along the state"),
)
