"""Functions of two coordinates without a name, fitted: of which two, and how many bumps they need.

They are asked for where something is left of the likeliest function of one coordinate: first with wide bumps
on top of it, which is cheap, then in its stead and with bumps of all widths, again and again along the better
trajectories of every fit.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence

import numpy as np

from siq.estimation.estimation import Fit
from siq.estimation.innovations import profile_likelihood, whiten
from siq.mismatch.fitted_parts import fitted_part
from siq.mismatch.likely_places import FITTED, LikelyPlace, independent
from siq.mismatch.nameless_models import Material, Model, Part, weighed
from siq.mismatch.screening import LEVELS, projected
from siq.mismatch.surfaces import Surface, needed, response_with_surface, surfaces_in, with_surface
from siq.mismatch.trials import UNFORESEEN

LOGGER = logging.getLogger(__name__)
ROUNDS = 4  # of fits, each along the trajectories of the one before: later ones add next to nothing


def with_surfaces(
    before: tuple[Part, ...], fit: Fit, best: Fit, ranked: Sequence[LikelyPlace], material: Material
) -> list[Model]:
    """Models with a smooth function of two coordinates more.

    Parameters
    ----------
    before, fit
        What was added already, and the fit with it.
    best
        The fit with the likeliest function of one coordinate, or of one times another, on top.
    ranked
        The likeliest places of such functions first.
    material
        What models are made from.
    """
    data = material.data
    material.budget.says("comparing functions of two coordinates")
    places = [each.place for each in ranked[:FITTED]]
    asked: list[tuple[float, Surface]] = []
    tried = 0
    for wide, whole in surfaces_in(fit.model, data, fit.x, places):
        tried += 1
        _, odds, _ = _needed(best, wide, (1.0,), material)
        if odds > np.log(len(ranked) + tried):
            asked.append((odds, whole))
    asked.sort(key=lambda each: -each[0])
    cost = float(np.log(max(len(ranked) + tried, 1)))
    models: list[Model] = []
    for _, whole in asked[:FITTED]:
        models += _grown(before, fit, whole, cost, material)
    return models


def _grown(
    before: tuple[Part, ...], fit: Fit, whole: Surface, cost: float, material: Material
) -> list[Model]:
    """The likeliest model with a surface of some of the bumps; none where none can be fitted."""
    surface: Surface | None = None
    likeliest: Model | None = None
    current = fit
    for _ in range(ROUNDS):
        levels = LEVELS if current.has_process_noise else (1.0,)
        more, _, level = _needed(current, whole, levels, material)
        if more is None:
            break
        surface = more if surface is None else surface.with_bumps(more)
        price = len(surface.centres) * float(np.log(len(whole.centres)))  # each was chosen among so many
        candidate = with_surface(fit.model, surface)
        parts = fitted_part(candidate, level, surface.place, fit, cost + price, material, surface=surface)
        if not parts:
            break
        found = Model((*before, parts[0]), parts[0].trial.fit)
        if likeliest is not None and weighed([likeliest, found], fit, material.data)[0].fit is likeliest.fit:
            break
        likeliest, current = found, found.fit
    return [] if likeliest is None else [likeliest]


def _needed(
    fit: Fit, surface: Surface, levels: Sequence[float], material: Material
) -> tuple[Surface | None, float, float]:
    """The bumps that what a fit leaves asks for, the odds for them, and the level of random forces with them.

    The odds are those of `siq.mismatch.surfaces.needed`. A better function needs less random forces, so that
    the level is the one with which the recordings are likeliest.
    """
    data, parameters = material.data, len(fit.model.free)
    best: tuple[Surface | None, float, float] = None, 0.0, levels[0]
    likeliest = -np.inf
    response = response_with_surface(fit, data, surface)
    for level in levels:
        try:
            white = whiten(response, data, fit.noise.scaled(level))
            left, columns = projected(white, parameters)
        except UNFORESEEN as error:
            LOGGER.info("no surface of %s can be screened: %s", " and ".join(surface.words), error)
            continue
        chosen, odds = needed(left, columns, count=independent(left, columns, white, fit))
        freedom = white.degrees_of_freedom - parameters
        likelihood = profile_likelihood(float(left @ left), freedom, white.log_determinant) + odds / 2
        if likelihood > likeliest:
            likeliest = likelihood
            best = surface.some(chosen) if chosen else None, odds, level
    return best
