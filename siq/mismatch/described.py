"""Described: a model of what has no name, from the place and the function that the recordings ask for.

Functions (`siq.mismatch.fitted_functions`) compete with mechanisms that were found and are not certain enough
for their names. A function may be one of two coordinates, and where it leaves something there may be another.
What mechanisms with a name leave is described by functions of one coordinate on top of them.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from siq.estimation.fit import Fit
from siq.estimation.measurements import Measurements
from siq.estimation.process_noise import fit_with_and_without_process_noise
from siq.mismatch.fitted_functions import with_a_function
from siq.mismatch.fitted_smooth import with_surfaces
from siq.mismatch.found import Search
from siq.mismatch.likely_places import FITTED
from siq.mismatch.memories import memory_suspected, with_memories
from siq.mismatch.nameless_models import MECHANISM, Material, Model, Part, runs_freely, weighed
from siq.mismatch.remainder import something_left
from siq.mismatch.tried import admissible

MOST = 2  # functions that are put on top of each other: more are no description


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
        and len(best.parts) < MOST
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
