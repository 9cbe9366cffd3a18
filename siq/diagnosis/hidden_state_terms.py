"""Models with hidden states, beside those of functions.

A body that warms up, a store that fills, a prey that takes time to become a predator: what such a thing does
depends on a hidden state that follows a coordinate late, ``z' = (x - z)/τ``, or that the coordinate makes
ring, ``τ² z'' + kτ z' + z = x``. A function of what is measured now can only imitate it, mostly as one of the
time. Such forms have no name of their own; they describe what is missing where they are likelier than any
function.

Functions (`siq.diagnosis.unnamed_models`) compete with mechanisms that were found and are not certain enough
for their names. A function may be one of two coordinates, and where it leaves something there may be another.
What mechanisms with a name leave is described by functions of one coordinate on top of them.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import sympy

from siq.diagnosis.dictionary import Form, FurtherState, Mechanism, MechanismParameter, Role, Roles, Shape
from siq.diagnosis.evidence import FITTED
from siq.diagnosis.mechanisms import MechanismCandidate, candidates_of
from siq.diagnosis.residual_structure import something_left
from siq.diagnosis.screening import Probe, Screened, screen_all, with_further_states
from siq.diagnosis.search import Search, best_probes
from siq.diagnosis.significance import UNFORESEEN, admissible
from siq.diagnosis.unnamed_models import (
    LARGEST_PART,
    MECHANISM,
    Material,
    Model,
    Part,
    fitted_part,
    runs_freely,
    weighed,
    with_a_function,
    with_surfaces,
)
from siq.inference.maximum_likelihood import Fit
from siq.inference.measurements import Measurements
from siq.inference.recalibration import fit_with_and_without_process_noise
from siq.systems.dynamics import Dynamics

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


DESCRIBED_MOST = 2  # functions that are put on top of each other: more are no description


def models_of_the_nameless(
    search: Search, material: Material, *, functions: Sequence[Model] | None = None
) -> tuple[Model, ...]:
    """Models of what is missing, the likeliest first; none where none is likelier than the simulation alone.

    Parameters
    ----------
    search
        What was found; mechanisms among it are one of the models.
    material
        What models are made from.
    functions
        Those without mechanisms, where they are fitted already.
    """
    base, data = search.recalibrated, material.data
    models = list(with_a_function((), base, material) if functions is None else functions)
    if search.found and np.isfinite(search.fit.log_likelihood):
        models.append(Model(parts_of(search, material.considered), search.fit))
    models = weighed(models, base, data)
    if functions is None:
        models = weighed([*models, *with_surfaces(base, models, material)], base, data)
        if memory_suspected(models, data):
            models = weighed([*models, *with_memories(base, models, material)], base, data)
    best = models[0] if models else None
    if (
        best is not None
        and best.fit.model.dimension == base.model.dimension
        and len(best.parts) < DESCRIBED_MOST
        and (functions is None or best.parts[0].kind == MECHANISM)
        and something_left(best.fit, data)
    ):
        models += with_a_function(best.parts, best.fit, material)
    return likeliest(models, base, data)


def models_beside_names(
    named: Search, whole: Search, material: Material, *, functions: Sequence[Model] | None = None
) -> tuple[Model, ...]:
    """Models of what mechanisms with a name leave, the likeliest first; none where none is likelier.

    They are what was found beside the names, not certain enough for one itself, and functions on top of all
    that was found.

    Parameters
    ----------
    named, whole
        The search with what is named, and with all that was found.
    material
        What models are made from.
    functions
        Those on top of the names alone, where they are fitted already.
    """
    base, data = named.fit, material.data

    def on_top(parts: tuple[Part, ...], fit: Fit) -> list[Model]:
        if fit.model.dimension > named.recalibrated.model.dimension or not something_left(fit, data):
            return []
        return with_a_function(parts, fit, material)

    models = list(functions or ())
    parts = parts_of(whole, material.considered)[len(named.found) :]
    fits = [each.best.fit for each in whole.found[len(named.found) :]]
    models += [Model(parts[: place + 1], fit) for place, fit in enumerate(fits)]
    if parts:
        models += on_top(parts, whole.fit)
    elif functions is None:
        models += on_top((), base)
    names = [each.best.candidate for each in named.found]
    allowed = [
        each
        for each in models
        if np.isfinite(each.fit.log_likelihood) and all(admissible(each.fit, name) for name in names)
    ]
    return likeliest(allowed, base, data)


def parts_of(search: Search, considered: int) -> tuple[Part, ...]:
    """The mechanisms of a search as parts of a model, each chosen among so many."""
    cost = float(np.log(max(considered, 1)))
    return tuple(Part(each.best, MECHANISM, cost) for each in search.found)


def likeliest(models: Sequence[Model], alone: Fit, data: Measurements) -> tuple[Model, ...]:
    """The few models that are likelier than the simulation without them, the likeliest first."""
    likelier = (
        each
        for each in weighed(models, alone, data)
        if each.log_evidence > 0 and runs_freely(each.fit, alone, data)
    )
    return tuple(_followed(each, data) for each in itertools.islice(likelier, FITTED))


def _followed(model: Model, data: Measurements) -> Model:
    """A model with its estimates of least squares, where random forces are part of its fit."""
    if not model.fit.has_process_noise:
        return model
    still = replace(model.fit, noise=model.fit.noise.without_process())
    followed = fit_with_and_without_process_noise(model.fit.model, data, still)[1]
    return replace(model, exact=followed) if followed.converged else model
