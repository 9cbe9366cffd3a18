"""Functions of one coordinate without a name, fitted: in which places, with which powers, or how smooth.

In the likeliest places (`siq.mismatch.likely_places`) a formula of a few powers and a smooth curve are fitted
in earnest.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import sympy

from siq.dynamics.parametric import symbol
from siq.estimation.fit import Fit
from siq.mismatch.fitted_parts import fitted_part
from siq.mismatch.fitted_smooth import with_a_smooth_function
from siq.mismatch.functions import simplest, with_formula
from siq.mismatch.grounds import ground_of
from siq.mismatch.likely_places import FITTED, LikelyPlace, few_powers, likely_places
from siq.mismatch.nameless_models import Material, Model, Part, weighed
from siq.mismatch.tried import UNFORESEEN

LOGGER = logging.getLogger(__name__)


def with_a_function(before: tuple[Part, ...], fit: Fit, material: Material) -> list[Model]:
    """Models with one function more, in the likeliest places, that earn it.

    Parameters
    ----------
    before, fit
        What was added already, and the fit with it.
    material
        What models are made from.

    Returns
    -------
    list of Model
        The likeliest first, with the evidence over that of `fit`.
    """
    data, budget = material.data, material.budget
    budget.says("comparing functions without a name")
    try:
        ranked = likely_places(fit, data, material.roles)
    except UNFORESEEN as error:
        LOGGER.info("no function can be screened: %s", error)
        return []
    cost = float(np.log(max(len(ranked), 1)))  # a function is chosen among so many places
    ranked = [each for each in ranked if each.log_evidence > cost]
    if not ranked:
        return []
    models = _formulas(before, fit, ranked, cost, material)
    alone = (each for each in ranked if len(each.place.words) == 1)
    for likely in {id(each): each for each in (*ranked[:FITTED], *itertools.islice(alone, 1))}.values():
        ground = ground_of(likely.place, fit.model, data, fit.x)
        models += with_a_smooth_function(before, fit, ground, cost, material)
    given = sum(part.cost for part in before)
    found = [replace(each, log_evidence=each.log_evidence + given) for each in weighed(models, fit, data)]
    for each in found:
        last = each.parts[-1]
        LOGGER.info(
            "%s as a %s: log-evidence better by %.1f",
            last.trial.candidate.label, last.kind, each.log_evidence,
        )  # fmt: skip
    return [each for each in found if each.log_evidence > 0]


def _formulas(
    before: tuple[Part, ...], fit: Fit, ranked: Sequence[LikelyPlace], cost: float, material: Material
) -> list[Model]:
    """Formulas in the likeliest places, each once."""
    single = {(each.place.targets, each.place.words): each.place.knots for each in ranked}
    done: set[frozenset[tuple[str, sympy.Expr]]] = set()
    models: list[Model] = []
    for likely in ranked[:FITTED]:
        terms = few_powers(likely, fit, material.data, degree=material.degree)
        if not terms:
            continue
        place, terms = simplest(likely.place, terms)
        place = replace(place, knots=single.get((place.targets, place.words), likely.place.knots))
        candidate = with_formula(fit.model, place, terms)
        # A sum of x²v and xv² is the same function, whichever coordinate comes first.
        monomials = frozenset(
            (name, formula.diff(symbol(amplitude)))
            for name, formula in candidate.changes
            for amplitude in candidate.amplitudes
        )
        if monomials not in done:
            parts = fitted_part(candidate, likely.level, place, fit, cost, material)
            models += [Model((*before, each), each.trial.fit) for each in parts]
        done.add(monomials)
    return models
