"""Withdrawal: does a name mislead?

A mechanism may explain the recordings that it was found in, and nothing else: it stands in for something that
goes on differently elsewhere. Where the simulation with it foresees recordings held out worse than without
it, by more than appears by chance, it keeps no name.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

from siq.estimation.budget import Budget
from siq.mismatch.case import Comparison
from siq.mismatch.described import models_of_the_nameless
from siq.mismatch.held_out import HeldOutRuns
from siq.mismatch.investigation import Investigation
from siq.mismatch.nameless_models import MECHANISM, Material, Model
from siq.mismatch.possible_verdicts import MismatchVerdict, quiet_verdict
from siq.mismatch.remainder import what_is_left

REFUTED = (
    "It would be explained a little better with {}. The prediction of recordings held out becomes worse with"
    " that, and nothing else speaks of a mismatch, so that it is taken for chance."
)
LOGGER = logging.getLogger(__name__)


def misleads(found: Investigation, shown: HeldOutRuns) -> bool:
    """Whether the mechanisms that are named make predictions of recordings held out worse.

    Parameters
    ----------
    found
        What was found.
    shown
        Its free runs of the recordings held out; tests of somebody else may not be among them, since they
        decide nothing.
    """
    named = found.verdict is MismatchVerdict.MISSING_PHYSICS and not found.process_noise
    return named and shown.errors.change("without", "augmented") == "worse"


def anything_else(found: Investigation, models: Sequence[Model], case: Comparison) -> bool:
    """Whether anything but mechanisms that recordings held out refute speaks of a mismatch.

    Random forces that are needed do, and so does structure that the recalibrated simulation leaves, or a
    function without a name that is certain by the odds that a name takes.

    Parameters
    ----------
    found
        What was found.
    models
        Of what has no name, the likeliest first.
    case
        The recordings and the settings.
    """
    recalibrated = found.search.recalibrated
    if recalibrated.has_process_noise:
        return True
    functions = [each for each in models if all(part.kind != MECHANISM for part in each.parts)]
    if any(each.log_evidence >= case.settings.search.least_log_odds for each in functions):
        return True
    return what_is_left(found.model, case.learn, recalibrated, recalibrated, found.roles).structured


def withdrawn(found: Investigation, case: Comparison, budget: Budget) -> Investigation:
    """An investigation without its names, and with models of what has none.

    Where nothing else speaks of a mismatch there is none: evidence that recordings held out refute is no
    evidence.

    Parameters
    ----------
    found
        What was found.
    case
        The recordings and the settings.
    budget
        Charged for the models; those that it does not reach are left out.
    """
    names = [each.best.candidate.label for each in found.search.found]
    LOGGER.info("%s: not named, since held-out recordings are foreseen worse", names)
    settings = case.settings
    material = Material(
        case.learn, found.roles, settings.degree, settings.search.blocks, len(found.candidates), budget
    )
    models = models_of_the_nameless(found.search, material)
    if not anything_else(found, models, case):
        recalibrated = found.search.recalibrated
        return replace(
            found,
            verdict=quiet_verdict(found.p_shift, settings.search),
            search=replace(found.search, found=(), fit=recalibrated),
            naming=None,
            remarks=(*found.remarks, REFUTED.format(" and ".join(names))),
            account=budget.account(),
        )
    return replace(
        found, verdict=MismatchVerdict.UNEXPLAINED, models=models, withdrawn=True, account=budget.account()
    )
