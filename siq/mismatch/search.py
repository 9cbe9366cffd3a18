"""The search for what is missing: screen, fit the best, accept only what stands every test, and once more.

Mechanisms are added one at a time, each on top of those before it.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

from siq.dynamics.dynamics import Dynamics
from siq.estimation.budget import Budget
from siq.estimation.fit import Fit
from siq.estimation.measurements import Measurements
from siq.mismatch.acceptance import accepted, better_without, tried_together
from siq.mismatch.building import MechanismCandidate
from siq.mismatch.found import Found, Search
from siq.mismatch.on_top import once_more, rebased
from siq.mismatch.promises import screen_all
from siq.mismatch.remainder import something_left
from siq.mismatch.search_options import SearchOptions
from siq.mismatch.trials import fit_most_promising
from siq.mismatch.tried import TriedMechanism, UntriedMechanism

LOGGER = logging.getLogger(__name__)
FOR_FUNCTIONS = 0.4  # of the budget, for functions without a name: a choice


def search(
    model: Dynamics,
    data: Measurements,
    recalibrated: Fit,
    candidates: Sequence[MechanismCandidate],
    *,
    options: SearchOptions,
    budget: Budget | None = None,
) -> Search:
    """Look for mechanisms, one after the other, until nothing is found or its part of the budget is spent."""
    begin, budget = Search(recalibrated, (), recalibrated, ()), budget or Budget()
    with budget.keeping(FOR_FUNCTIONS):
        return _extended(begin, model, data, candidates, options=options, budget=budget, on_trial=True)


def _extended(
    progress: Search,
    model: Dynamics,
    data: Measurements,
    candidates: Sequence[MechanismCandidate],
    *,
    options: SearchOptions,
    budget: Budget,
    on_trial: bool,
) -> Search:
    """A search carried on until nothing more is found.

    Where recordings are few, what is still missing may make all errors so large that the best candidate does
    not stand the clustered test alone. It is then taken on trial, once: another is looked for on top of it,
    and both count as found if both stand the test together. Where a mechanism leads to better parameters of
    the simulation itself, the search begins anew from there, once.
    """
    begun_anew = False
    while True:
        found, current = progress.found, progress.fit
        base = current.model
        if found and (len(found) == options.mechanisms or not something_left(current, data)):
            return progress
        if base.dimension > model.dimension:
            return progress  # nothing is sought on top of a mechanism that has states of its own
        if found and budget.stopped_by is not None:
            return progress
        labels = [each.best.candidate.label for each in found]
        remaining = [
            rebased(each, model, base) if found else each
            for each in candidates
            if not any(once_more(each, other.best.candidate) for other in found)
        ]
        screened, unscreened = screen_all(
            base, data, current, remaining, fruitless=progress.fruitless, budget=budget
        )
        trials, failed = fit_most_promising(
            data, current, base, screened,
            most=options.fitted, least_gain=options.same, blocks=options.blocks,
            budget=budget,
        )  # fmt: skip
        untried = _together(progress.untried, (*unscreened, *failed), trials)
        fruitless = {each.candidate.label for each in trials if each.delta_chi2 < options.same}
        progress = replace(
            progress, screened=tuple(screened), untried=untried, screened_beside=tuple(labels),
            fruitless=progress.fruitless | fruitless,
        )  # fmt: skip
        for trial in trials:
            LOGGER.info(
                "%s: chi2 better by %.1f, BIC %.1f, p %.1e white, %.1e clustered",
                trial.candidate.label, trial.delta_chi2, trial.delta_bic, trial.p_white, trial.p_cluster,
            )  # fmt: skip
        chance = 5 * options.false_alarms / max(len(remaining), 1)
        stands = accepted(trials, len(screened), chance, options=options)
        best = accepted(trials, len(screened), 1.0, options=options)
        if not (found or begun_anew) and best is not None:
            begun_anew = True
            better = better_without(best.best, current, model, data, least=options.same, budget=budget)
            if better is not None:
                LOGGER.info("%s led to better parameters, without it", best.best.candidate.label)
                progress = replace(progress, recalibrated=better, fit=better, fruitless=frozenset())
                continue
        if (
            on_trial
            and len(found) + 1 < options.mechanisms
            and best is not None
            and (stands is None or best.best.delta_bic < stands.best.delta_bic - options.same)
        ):
            LOGGER.info("%s is on trial", best.best.candidate.label)
            further = _extended(
                _with(progress, best), model, data, candidates,
                options=options, budget=budget, on_trial=False,
            )  # fmt: skip
            together = tried_together(further, progress, data, chance=chance, options=options)
            if together is not None:
                return together
            on_trial = False
        if stands is None:
            return progress
        LOGGER.info("found %s, chi2 better by %.1f", stands.best.candidate.label, stands.best.delta_chi2)
        progress = _with(progress, stands)


def _together(
    before: Sequence[UntriedMechanism], now: Sequence[UntriedMechanism], trials: Sequence[TriedMechanism]
) -> tuple[UntriedMechanism, ...]:
    """All that could never be judged, each once, with the last reason."""
    reasons = {each.candidate.label: each for each in (*before, *now)}
    for trial in trials:
        reasons.pop(trial.candidate.label, None)
    return tuple(reasons.values())


def _with(progress: Search, found: Found) -> Search:
    return replace(progress, found=(*progress.found, found), fit=found.best.fit)
