"""Smooth functions without a name, fitted: as smooth as the recordings ask for, of one coordinate or of two.

What a fit leaves says how smooth a function is, along the trajectories of that fit. Those with the function
are better, and say it better; so it is asked for again. Functions of two coordinates are asked for where
something is left of the likeliest functions of one.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Iterator, Sequence

import numpy as np

from siq.estimation.estimation import Fit
from siq.mismatch.fitted_parts import fitted_part
from siq.mismatch.function_places import coordinates_of
from siq.mismatch.likely_places import FITTED
from siq.mismatch.nameless_models import Material, Model, Part, weighed
from siq.mismatch.search import something_left
from siq.mismatch.smooth_functions import (
    Ground,
    Smooth,
    ground_of_two,
    smooth_function,
    with_smooth_function,
)
from siq.mismatch.smoothness import likeliest_product, smoothness_of

LOGGER = logging.getLogger(__name__)
ROUNDS = 4  # of fits, each along the trajectories of the one before: a choice
WORTH = 1.0  # of a logarithm of odds, below which another round is not worth its time


def with_a_smooth_function(
    before: tuple[Part, ...],
    fit: Fit,
    ground: Ground,
    cost: float,
    material: Material,
    *,
    like: Model | None = None,
    product: bool = False,
) -> list[Model]:
    """The likeliest model with a smooth function on a ground; none where none can be fitted.

    Parameters
    ----------
    before, fit
        What was added already, and the fit with it.
    ground
        Where the function stands.
    cost
        Logarithm of the number of functions that it was chosen among.
    material
        What models are made from.
    like
        A model with a function in its stead that explains a part, if there is one.
    product
        Whether it is to be a product of two functions of one coordinate each.
    """
    data = material.data
    if not ground.usable:
        return []
    likeliest: Model | None = None
    current, known = (fit, None) if like is None else (like.fit, like.parts[-1])
    for _ in range(ROUNDS):
        here = ground.along(current.model, data, current.x)
        asked = smoothness_of(current, data, here, known=known)
        if asked is None:
            break
        function: Smooth = (
            likeliest_product(asked, here)
            if product
            else smooth_function(here, asked.shares, deviation=asked.deviation)
        )
        candidate = with_smooth_function(fit.model, function)
        price = cost + float(np.log(asked.considered))
        parts = fitted_part(
            candidate, asked.told.level, ground.place, fit, price, material, smooth=function, begin=current
        )
        if not parts:
            break
        found = Model((*before, parts[0]), parts[0].trial.fit)
        LOGGER.info(
            "%s, %d bumps: log-likelihood %.1f",
            candidate.label, function.width, found.fit.log_likelihood,
        )  # fmt: skip
        if likeliest is not None:
            both = {id(each.fit): each.log_evidence for each in weighed([likeliest, found], fit, data)}
            if both[id(found.fit)] < both[id(likeliest.fit)] + WORTH:
                break
        likeliest, current, known = found, found.fit, parts[0]
    return [] if likeliest is None else [likeliest]


def with_surfaces(fit: Fit, models: Sequence[Model], material: Material) -> list[Model]:
    """Models with a smooth function of two coordinates.

    Parameters
    ----------
    fit
        Of the simulation without functions.
    models
        Those with functions of one coordinate, or of one times another, the likeliest first: one of two is
        asked for where the first ones have theirs.
    material
        What models are made from.
    """
    material.budget.says("comparing functions of two coordinates")
    data = material.data
    asked: list[tuple[float, Ground, Model]] = []
    for model, ground in _grounds(fit, models, material):
        if ground.usable:
            smooth = smoothness_of(model.fit, data, ground, known=model.parts[-1], alike=True)
            if smooth is not None:
                asked.append((smooth.log_evidence, ground, model))
    before = max((part.cost for model in models for part in model.parts), default=0.0)
    cost = float(np.logaddexp(before, np.log(max(len(asked), 1))))
    ranked = sorted((each for each in asked if each[0] > cost), key=lambda each: -each[0])
    found: list[Model] = []
    for _, ground, model in ranked[:FITTED]:
        for product in (True, False):
            some = with_a_smooth_function((), fit, ground, cost, material, like=model, product=product)
            found += some
            if some and not something_left(some[0].fit, data):
                break
    return found


def _grounds(fit: Fit, models: Sequence[Model], material: Material) -> Iterator[tuple[Model, Ground]]:
    """A coordinate of each of the likeliest functions and any other, with the model of the function."""
    done = set()
    names = [name for name in coordinates_of(fit.model) if name != "t"]
    single = [each for each in models if len(each.parts) == 1 and each.parts[0].place is not None]
    for model in single[:FITTED]:
        place = model.parts[0].place
        if place is None or len(place.equations) != 1:  # of a rotating frame, or in a sensor
            continue
        for words in itertools.combinations(names, 2):
            if set(words) & set(place.words) and (place.targets, words) not in done:
                done.add((place.targets, words))
                yield model, ground_of_two(place.targets[0], words, fit.model, material.data, model.fit.x)
