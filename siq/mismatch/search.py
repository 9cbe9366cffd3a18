"""The search for what is missing: recalibrate, screen, fit the best, accept only what stands every test.

Mechanisms are added one at a time. A candidate counts as found when white errors, errors clustered by
recording, and the Bayesian information criterion all say so; what cannot be told from the best is kept as its
class of indistinguishables.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import sympy

from siq.dynamics.dynamics import Dynamics
from siq.dynamics.parametric import symbol
from siq.errors import NumericalFailure
from siq.estimation.budget import Budget, BudgetSpent
from siq.estimation.estimation import Fit
from siq.estimation.measurements import Measurements
from siq.estimation.process_noise import fit_with_process_noise_as_needed
from siq.mismatch.candidates import MechanismCandidate
from siq.mismatch.clusters import clustered_probability, probability_by_chance
from siq.mismatch.probes import Probe
from siq.mismatch.roles import roles_of
from siq.mismatch.screening import Screened
from siq.mismatch.search_options import SearchOptions
from siq.mismatch.structure import structure_of
from siq.mismatch.trials import (
    UNFORESEEN,
    TriedMechanism,
    UntriedMechanism,
    fit_most_promising,
    screen_all,
)

LOGGER = logging.getLogger(__name__)
FOR_FUNCTIONS = 0.4  # of the budget, for functions without a name: a choice
LEFT = 0.01  # probability that residuals are random, above which no further mechanism is sought


@dataclass(frozen=True)
class Found:
    """A mechanism that stood the tests, and what else was fitted in its place.

    Attributes
    ----------
    best
        The mechanism.
    indistinguishable
        Those that explain the recordings as well.
    needless
        Those that explain as much, but with further parameters that do not earn their place.
    lesser
        Those that explain less.
    """

    best: TriedMechanism
    indistinguishable: tuple[TriedMechanism, ...]
    needless: tuple[TriedMechanism, ...] = ()
    lesser: tuple[TriedMechanism, ...] = ()


@dataclass(frozen=True)
class Search:
    """What a search ended with.

    Attributes
    ----------
    recalibrated
        The simulation with its own parameters fitted, and nothing else.
    found
        Mechanisms, in the order of their discovery; each was judged with those before it in place.
    fit
        Of the simulation with all of them.
    screened
        The last screening: every candidate with what it would gain.
    screened_beside
        Labels of the mechanisms that were in place for it. Where nothing was left to be explained, nothing
        was screened on top of the last mechanism.
    untried
        Candidates whose fit gave nothing that could be judged, with the reason.
    fruitless
        Labels of those that were fitted and gained nothing.
    """

    recalibrated: Fit
    found: tuple[Found, ...]
    fit: Fit
    screened: tuple[tuple[Probe, Screened], ...]
    untried: tuple[UntriedMechanism, ...] = ()
    screened_beside: tuple[str, ...] = ()
    fruitless: frozenset[str] = frozenset()


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
            rebased
            for each in candidates
            if not any(_once_more(each, other.best.candidate) for other in found)
            and (rebased := _rebased(each, model, base) if found else each) is not None
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


def _once_more(candidate: MechanismCandidate, found: MechanismCandidate) -> bool:
    """Whether a candidate is what was found already: the same, or in another form at the same place.

    A second threshold beside the first, or a second spring in the same place, is no further physics.
    """
    same_place = candidate.coordinate == found.coordinate and set(candidate.equations) & set(found.equations)
    return candidate.label == found.label or (
        candidate.name == found.name and candidate.coordinate in found.model.states and bool(same_place)
    )


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


def something_left(current: Fit, data: Measurements) -> bool:
    """Whether it is worth looking for something on top of a fit."""
    model = current.model
    if current.has_process_noise:
        return True
    try:
        return structure_of(model, data, current, roles_of(model)).p_value < LEFT
    except NumericalFailure:  # a simulation that runs away lacks something, whatever it is
        return True


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


def _rebased(candidate: MechanismCandidate, before: Dynamics, now: Dynamics) -> MechanismCandidate | None:
    """A candidate on top of a model that has grown since; None where both change the same thing."""
    names = {parameter.name for parameter in now.parameters}
    model = candidate.model
    renamed = {name: name for name in candidate.new}
    for name in candidate.new:
        if name in names:
            stem, _, number = name.rpartition("_")
            k = int(number)
            while f"{stem}_{k}" in names or f"{stem}_{k}" in renamed.values():
                k += 1
            renamed[name] = f"{stem}_{k}"
    change = {symbol(old): symbol(new) for old, new in renamed.items() if old != new}

    def merge(theirs: sympy.Expr, old: sympy.Expr, ours: sympy.Expr) -> sympy.Expr:
        return ours + (theirs - old).xreplace(change)

    count = len(before.parameters)
    equations = [
        merge(t, o, n)
        for t, o, n in zip(model.equations[: before.dimension], before.equations, now.equations, strict=True)
    ]
    outputs = [
        (name, merge(t, o, n))
        for (name, t), (_, o), (_, n) in zip(model.outputs, before.outputs, now.outputs, strict=True)
    ]
    new = tuple(replace(p, name=renamed[p.name]) for p in model.parameters[count:])
    return replace(
        candidate,
        model=replace(
            model,
            equations=(*equations, *(each.xreplace(change) for each in model.equations[before.dimension :])),
            outputs=tuple(outputs),
            parameters=(*now.parameters, *new),
        ),
        changes=tuple((name, formula.xreplace(change)) for name, formula in candidate.changes),
        amplitudes=tuple(renamed[name] for name in candidate.amplitudes),
        shapes=tuple(renamed[name] for name in candidate.shapes),
        positive=frozenset(renamed[name] for name in candidate.positive),
    )
