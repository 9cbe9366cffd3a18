"""Smooth functions without a name, fitted: as smooth as the recordings ask for, of one coordinate or of two.

What a fit leaves says how smooth a function is, along the trajectories of that fit. Those with the function
are better, and say it better; so it is asked for again. Functions of two coordinates are fitted where they
are likelier than the likeliest functions of one, along the trajectories of these.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Iterator, Sequence

import numpy as np

from siq.dynamics.dynamics import Dynamics
from siq.estimation.fit import Fit
from siq.estimation.measurements import Measurements
from siq.mismatch.fitted_parts import fitted_part
from siq.mismatch.function_places import Place, coordinates_of
from siq.mismatch.grounds import Ground, ground_of, ground_of_two
from siq.mismatch.likely_places import FITTED, likely_places
from siq.mismatch.nameless_models import Material, Model, Part, weighed
from siq.mismatch.remainder import something_left
from siq.mismatch.smooth_functions import Smooth, smooth_function, with_smooth_function
from siq.mismatch.smoothness import Smoothness, likeliest_product, smoothness_of
from siq.mismatch.tried import UNFORESEEN

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
        asked = _asked(current, data, here, known=known)
        if asked is None:
            break
        price = cost + float(np.log(asked.considered))
        parts: list[Part] = []
        # What promises to be rough and to need hardly any random forces may be what no fit can follow.
        for times, level in ((1.0, asked.told.level), (2.0, 1.0)):
            if parts:
                break
            try:
                function = _function(asked, here, product=product, times=times)
            except UNFORESEEN as error:
                LOGGER.info("no function of %s can be worked out: %s", " and ".join(here.words), error)
                break
            candidate = with_smooth_function(fit.model, function)
            parts = fitted_part(
                candidate, level, ground.place, fit, price, material, smooth=function, begin=current
            )
        if not parts:
            break
        found = Model((*before, parts[0]), parts[0].trial.fit)
        LOGGER.info(
            "%s, %d bumps: log-likelihood %.1f",
            candidate.label, function.width, found.fit.log_likelihood,
        )  # fmt: skip
        if likeliest is not None:
            new = {
                each.fit is found.fit: each.log_evidence for each in weighed([likeliest, found], fit, data)
            }
            if new[True] < new[False] + WORTH:
                break
        likeliest, current, known = found, found.fit, parts[0]
    return [] if likeliest is None else [likeliest]


def _asked(
    fit: Fit, data: Measurements, ground: Ground, *, known: Part | None, alike: bool = False
) -> Smoothness | None:
    """See `siq.mismatch.smoothness.smoothness_of`; what is beyond all numbers ends a function, not a case."""
    try:
        return smoothness_of(fit, data, ground, known=known, alike=alike)
    except UNFORESEEN as error:
        LOGGER.info("no function of %s can be worked out: %s", " and ".join(ground.words), error)
        return None


def _function(asked: Smoothness, ground: Ground, *, product: bool, times: float) -> Smooth:
    """The function that is asked for, its lengths multiplied."""
    if product:
        return likeliest_product(asked, ground, times=times)
    shares = tuple(times * share for share in asked.shares)
    return smooth_function(ground, shares, deviation=asked.deviation, weight=asked.told.correlated)


def with_surfaces(fit: Fit, models: Sequence[Model], material: Material) -> list[Model]:
    """Models with a smooth function of two coordinates, where the recordings tell both.

    Parameters
    ----------
    fit
        Of the simulation without functions.
    models
        Those with functions of one coordinate, or of one times another, the likeliest first: one of two is
        asked for where the first ones have theirs, and has to be likelier there.
    material
        What models are made from.
    """
    material.budget.says("comparing functions of two coordinates")
    data = material.data
    begins = _begins(fit, models, material)
    asked: list[tuple[float, Ground, Model | None]] = []
    done = set()
    for place, like in begins:
        current, known = (fit, None) if like is None else (like.fit, like.parts[-1])
        alone = 0.0
        if known is not None:
            one = _asked(current, data, ground_of(place, current.model, data, current.x), known=known)
            alone = -np.inf if one is None else one.log_evidence
        for words in _pairs(fit.model, place):
            if (place.targets, words) in done:
                continue
            done.add((place.targets, words))
            ground = ground_of_two(place.targets[0], words, current.model, data, current.x)
            if not ground.usable:
                continue
            both = _asked(current, data, ground, known=known, alike=True)
            if both is not None:
                asked.append((both.log_evidence - alone, ground, like))
    cost = float(np.log(max(len(asked), 1)))
    ranked = sorted((each for each in asked if each[0] > cost), key=lambda each: -each[0])
    price = max((part.cost for model in models for part in model.parts), default=0.0) + cost
    found: list[Model] = []
    for _, ground, like in ranked[:FITTED]:
        for product in (True, False):
            some = with_a_smooth_function((), fit, ground, price, material, like=like, product=product)
            found += some
            if some and not something_left(some[0].fit, data):
                return found  # nothing is left for a surface, nor for a less likely pair
    return found


def _begins(fit: Fit, models: Sequence[Model], material: Material) -> list[tuple[Place, Model | None]]:
    """Where functions of two coordinates are asked for, and the models that have one of one there.

    Where there are none, one of two may tell so little of either coordinate alone.
    """
    single = [each for each in models if len(each.parts) == 1]
    known = [(each.parts[0].place, each) for each in single[:FITTED]]
    found: list[tuple[Place, Model | None]] = [(place, each) for place, each in known if place is not None]
    if not single:
        try:
            likely = likely_places(fit, material.data, material.roles)
        except UNFORESEEN as error:
            LOGGER.info("no function can be screened: %s", error)
            return []
        found = [(each.place, None) for each in likely[:FITTED]]
    # Not in a rotating frame, nor in a sensor.
    return [(place, model) for place, model in found if len(place.equations) == 1]


def _pairs(model: Dynamics, place: Place) -> Iterator[tuple[str, str]]:
    """A coordinate of a place, and any other state or input."""
    names = [name for name in coordinates_of(model) if name != "t"]
    return (each for each in itertools.combinations(names, 2) if set(each) & set(place.words))
