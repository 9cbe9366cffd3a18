"""Functions of two coordinates without a name, fitted: of which two, and how many bumps they need.

They are asked for where something is left of the likeliest functions of one coordinate: first by the evidence
of one on top of them, then fitted in their stead, again and again along the better trajectories of every fit.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from siq.estimation.estimation import Fit
from siq.estimation.innovations import Whitened, profile_likelihood, whiten
from siq.mismatch.evidence import evidence_of_columns
from siq.mismatch.fitted_parts import fitted_part
from siq.mismatch.likely_places import FITTED, independent
from siq.mismatch.nameless_models import Material, Model, weighed
from siq.mismatch.screening import LEVELS, projected
from siq.mismatch.surfaces import Surface, needed, response_with_surface, surfaces_in, with_surface
from siq.mismatch.trials import UNFORESEEN

LOGGER = logging.getLogger(__name__)
ROUNDS = 4  # of fits, each along the trajectories of the one before: a choice


def with_surfaces(fit: Fit, best: Model, models: Sequence[Model], material: Material) -> list[Model]:
    """Models with a smooth function of two coordinates, or of one, in all its fineness.

    Parameters
    ----------
    fit
        Of the simulation without functions.
    best
        The likeliest model with functions of one coordinate, or of one times another.
    models
        All of these, the likeliest first: surfaces are asked for where the first ones have their functions.
    material
        What models are made from.
    """
    material.budget.says("comparing functions of two coordinates")
    known = [(part.place, part.cost) for model in models for part in model.parts if part.place is not None]
    places = [place for place, _ in known[:FITTED]]
    asked = [
        (_evidence(best.fit, whole, material), whole)
        for whole in surfaces_in(fit.model, material.data, fit.x, places)
    ]
    before = max((cost for _, cost in known), default=0.0)
    cost = float(np.logaddexp(before, np.log(max(len(asked), 1))))
    asked = sorted((each for each in asked if each[0] > cost), key=lambda each: -each[0])
    # What depends on one coordinate, and more finely than a spline has it, is not to pass for one of two.
    alone = [each for each in asked if len(each[1].words) == 1][:1]
    both = [each for each in asked if len(each[1].words) > 1][:FITTED]
    found: list[Model] = []
    for _, whole in (*alone, *both):
        found += _grown(fit, whole, cost, material)
    return found


def _grown(fit: Fit, whole: Surface, cost: float, material: Material) -> list[Model]:
    """The likeliest model with a surface of some of the bumps; none where none can be fitted."""
    surface: Surface | None = None
    likeliest: Model | None = None
    current = fit
    for _ in range(ROUNDS):
        asked = _needed(current, whole, material)
        if asked is None:
            break
        more, level = asked
        surface = more if surface is None else surface.with_bumps(more)
        price = len(surface.centres) * float(np.log(len(whole.centres)))  # each was chosen among so many
        candidate = with_surface(fit.model, surface)
        parts = fitted_part(candidate, level, surface.place, fit, cost + price, material, surface=surface)
        if not parts:
            break
        found = Model((parts[0],), parts[0].trial.fit)
        if likeliest is not None and weighed([likeliest, found], fit, material.data)[0].fit is likeliest.fit:
            break
        likeliest, current = found, found.fit
    return [] if likeliest is None else [likeliest]


@dataclass(frozen=True)
class _Screened:
    """What a fit leaves ``(n,)`` and what bumps do to it ``(n, b)``, at a level of random forces.

    The likelihood is that without the bumps.
    """

    level: float
    left: np.ndarray
    columns: np.ndarray
    white: Whitened
    freedom: int
    likelihood: float


def _screened(fit: Fit, surface: Surface, material: Material) -> Iterator[_Screened]:
    """A surface on top of a fit, at each level of random forces at which it can be worked out.

    A better function needs less random forces, so that the likelihoods with it and without it are compared
    each at its best level.
    """
    data, parameters = material.data, len(fit.model.free)
    response = response_with_surface(fit, data, surface)
    for level in LEVELS if fit.has_process_noise else (1.0,):
        try:
            white = whiten(response, data, fit.noise.scaled(level))
            left, columns = projected(white, parameters)
        except UNFORESEEN as error:
            LOGGER.info("no surface of %s can be screened: %s", " and ".join(surface.words), error)
            continue
        freedom = white.degrees_of_freedom - parameters
        likelihood = profile_likelihood(float(left @ left), freedom, white.log_determinant)
        yield _Screened(level, left, columns, white, freedom, likelihood)


def _evidence(fit: Fit, surface: Surface, material: Material) -> float:
    """Logarithm of the odds of bumps of any height for what a fit leaves."""
    alone = along = -np.inf
    for at in _screened(fit, surface, material):
        prior = np.eye(at.columns.shape[1])
        gain = evidence_of_columns([at.columns], at.left, [prior], freedom=at.freedom)
        alone, along = max(alone, at.likelihood), max(along, at.likelihood + gain)
    return along - alone if np.isfinite(alone) else -np.inf


def _needed(fit: Fit, surface: Surface, material: Material) -> tuple[Surface, float] | None:
    """The bumps that what a fit leaves asks for, and the level of random forces with them; None for none."""
    alone = along = -np.inf
    best: tuple[Surface, float] | None = None
    for at in _screened(fit, surface, material):
        count = independent(at.left, at.columns, at.white, fit)
        chosen, odds = needed(at.left, at.columns, count=count)
        alone = max(alone, at.likelihood)
        if chosen and at.likelihood + odds > along:
            along, best = at.likelihood + odds, (surface.some(chosen), at.level)
    return best if along > alone else None
