"""Withdrawal: does a name mislead?

A mechanism may explain the recordings that it was found in, and nothing else: it stands in for something that
goes on differently elsewhere. Where the simulation with it foresees recordings held out worse than without
it, by more than appears by chance, it keeps no name.
"""

from __future__ import annotations

import logging
from dataclasses import replace

from siq.estimation.budget import Budget
from siq.mismatch.case import Comparison
from siq.mismatch.described import models_of_the_nameless
from siq.mismatch.held_out import HeldOutRuns
from siq.mismatch.investigation import Investigation, MismatchVerdict
from siq.mismatch.nameless_models import Material

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


def withdrawn(found: Investigation, case: Comparison, budget: Budget) -> Investigation:
    """An investigation without its names, and with models of what has none.

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
    return replace(
        found, verdict=MismatchVerdict.UNEXPLAINED, models=models, withdrawn=True, account=budget.account()
    )
