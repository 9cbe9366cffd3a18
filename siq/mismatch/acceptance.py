"""Which of the mechanisms that were tried count as found?

White errors, errors clustered by recording, and the Bayesian information criterion all have to say so; what
cannot be told from the best is kept as its class of indistinguishables. One that leads to better parameters
of the simulation itself is held against these, and one on trial has to stand beside what came after it.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from siq.dynamics.dynamics import Dynamics
from siq.estimation.budget import Budget, BudgetSpent
from siq.estimation.fit import Fit
from siq.estimation.measurements import Measurements
from siq.estimation.process_noise import fit_with_process_noise_as_needed
from siq.mismatch.building import MechanismCandidate
from siq.mismatch.clusters import clustered_probability, probability_by_chance
from siq.mismatch.found import Found, Search
from siq.mismatch.search_options import SearchOptions
from siq.mismatch.tried import UNFORESEEN, TriedMechanism

LOGGER = logging.getLogger(__name__)


def accepted(
    trials: Sequence[TriedMechanism], probes: int, chance: float, *, options: SearchOptions
) -> Found | None:
    """The best of the trials that stand every test, with what cannot be told from it.

    Parameters
    ----------
    trials
        Candidates, fitted.
    probes
        How many were screened: the white test allows for them.
    chance
        Probability by which an effect clustered by recording may be one of chance.
    options
        Of the search.
    """
    significant = [
        trial
        for trial in trials
        if trial.p_white < options.false_alarms / max(probes, 1)
        and trial.p_cluster < chance
        and trial.delta_bic < 0
    ]
    if not significant:
        return None
    best = min(significant, key=lambda each: each.delta_bic)
    if best.fit.has_process_noise:
        # What is left is no noise, and white errors mean little: of equals, what all recordings ask for.
        equals = [each for each in significant if each.delta_bic < best.delta_bic + options.same]
        best = min(equals, key=lambda each: each.p_cluster)
    least = best.delta_chi2 - options.same
    others = [other for other in trials if other is not best]
    equals = [other for other in others if other.delta_chi2 > least]
    return Found(
        best,
        indistinguishable=tuple(other for other in equals if not _needless(other, best)),
        needless=tuple(other for other in equals if _needless(other, best)),
        lesser=tuple(other for other in others if not other.delta_chi2 > least),
    )


def _needless(other: TriedMechanism, best: TriedMechanism) -> bool:
    """Whether an alternative needs more parameters than the best, and does not earn them.

    One that fits better by as much as its further parameters would bring by chance twice over (Akaike) is not
    ruled out, although the simpler is preferred (Bayes).
    """
    more = len(other.candidate.new) - len(best.candidate.new)
    return more > 0 and other.delta_chi2 - best.delta_chi2 < 2 * more


def better_without(
    trial: TriedMechanism,
    current: Fit,
    model: Dynamics,
    data: Measurements,
    *,
    least: float,
    budget: Budget,
) -> Fit | None:
    """The simulation alone, fitted from where a mechanism led it, if that explains as much as with it.

    A mechanism may seem to explain much only because its fit found parameters of the simulation that its own
    fit had missed. Nothing is called missing before the simulation has begun there, too.

    Parameters
    ----------
    trial
        The mechanism.
    current
        The fit that it is held against.
    model, data
        The simulation without mechanisms, and the recordings.
    least
        Twice the difference of log-likelihoods, within which explanations cannot be told apart.
    budget
        Charged for the fit; None is the answer where it is spent.
    """
    fit = trial.fit
    known = {each.name: each.value for each in fit.model.parameters}
    begun = model.with_values(np.array([known[each.name] for each in model.parameters]))
    d = model.dimension
    begin = replace(fit, noise=replace(fit.noise, process=fit.noise.process[:d]))
    try:
        again = fit_with_process_noise_as_needed(begun, data, begin, x=fit.x[:, :d], budget=budget)
    except (*UNFORESEEN, BudgetSpent):
        return None
    gained = 2 * (again.log_likelihood - current.log_likelihood)
    return again if again.converged and gained > max(least, trial.delta_chi2 - least) else None


def tried_together(
    progress: Search, before: Search, data: Measurements, *, chance: float, options: SearchOptions
) -> Search | None:
    """A search in which a mechanism was taken on trial, if it stands the clustered test in the final fit.

    Parameters
    ----------
    progress, before
        The search with it, and as it was before.
    data
        The recordings.
    chance
        Probability of as much by chance, below which it stands.
    options
        Of the search.

    Returns
    -------
    Search or None
        With the probabilities of the final fit; None where nothing came on top of it, or it does not stand.
    """
    place = len(before.found)
    if len(progress.found) < place + 2:
        return None
    on_trial = progress.found[place]
    p_cluster = _probability_in_place(progress.fit, data, on_trial.best.candidate, options=options)
    LOGGER.info("%s on trial: p %.1e clustered", on_trial.best.candidate.label, p_cluster)
    if p_cluster >= chance:
        return None
    stands = replace(on_trial, best=replace(on_trial.best, p_cluster=p_cluster))
    return replace(progress, found=(*progress.found[:place], stands, *progress.found[place + 1 :]))


def _probability_in_place(
    fit: Fit, data: Measurements, candidate: MechanismCandidate, *, options: SearchOptions
) -> float:
    """Probability of a mechanism by chance beside those that were found after it."""
    names = [each.name for each in fit.model.parameters]
    if not candidate.amplitudes or not set(candidate.new) <= set(names):
        return clustered_probability(fit, data, candidate, blocks=options.blocks)
    absent = tuple(
        replace(each, value=0.0 if each.name in candidate.amplitudes else each.value, fixed=True)
        if each.name in candidate.new
        else each
        for each in fit.model.parameters
    )
    without = fit_with_process_noise_as_needed(replace(fit.model, parameters=absent), data, fit)
    if not without.converged:
        return clustered_probability(fit, data, candidate, blocks=options.blocks)
    return probability_by_chance(fit, without, data, candidate, blocks=options.blocks)
