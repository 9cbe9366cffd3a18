"""The search for missing mechanisms: screen, fit the best, accept what stands every test.

White errors, errors clustered by recording, and the Bayesian information criterion all have to say so; what
cannot be told from the best is kept as its class of indistinguishables. One that leads to better parameters
of the simulation itself is held against these, and one on trial has to stand with what came after it.
Mechanisms are added one at a time, each on top of those before it.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from siq.diagnosis.dictionary import Roles
from siq.diagnosis.evidence import (
    BUDGET_SPENT,
    NUMERICAL_ERRORS,
    FittedCandidate,
    NotFitted,
    probability_by_chance,
)
from siq.diagnosis.mechanisms import MechanismCandidate
from siq.diagnosis.residual_structure import has_structure
from siq.diagnosis.screening import Probe, Ranked, screen_all
from siq.diagnosis.study import MismatchStudy, SearchOptions
from siq.errors import NumericalFailure
from siq.inference.budget import Budget, BudgetSpent
from siq.inference.maximum_likelihood import Fit
from siq.inference.measurements import Measurements
from siq.inference.recalibration import fit_with_process_noise_as_needed, least_to_believe
from siq.inference.trajectories import sharpened
from siq.systems.dynamics import Dynamics

LOGGER = logging.getLogger(__name__)
PROMISING_GAIN = 0.2  # of the best gain so far; a candidate that promises less is not fitted
SHARPENED_GAIN = 0.6  # of the best gain, from which on jumps are sharpened: that gains up to a quarter
ROUNDING = 1e-3  # numerical, of what counts as the same: optima are found to this at least
BUDGET_FOR_FUNCTIONS = 0.4  # of the budget, for functions without a name: a choice
Standing = Literal["same", "needless", "less"]


@dataclass(frozen=True)
class FitContext:
    """A case, and by which means it is explained."""

    model: Dynamics  #: the simulation as its author believes it
    data: Measurements  #: the recordings
    roles: Roles  #: of the states
    candidates: tuple[MechanismCandidate, ...] = ()  #: the mechanisms that may be named
    study: MismatchStudy = field(default_factory=MismatchStudy)  #: what counts as found
    #: Charged for the work; what it does not reach is left undone.
    budget: Budget = field(default_factory=Budget)
    #: What forecasts found and took back: fits of whole trajectories begin there, too.
    leads: tuple[FittedCandidate, ...] = ()


@dataclass(frozen=True)
class AcceptedMechanism:
    """A mechanism that stood the tests, and what else was fitted in its place, by how it compares.

    It explains the recordings as well (``same``); as much, but with further parameters that do not earn their
    place (``needless``); or less (``less``).
    """

    best: FittedCandidate
    others: Mapping[Standing, tuple[FittedCandidate, ...]]


@dataclass(frozen=True)
class Search:
    """What a search ended with."""

    recalibrated: Fit  #: the simulation with its own parameters fitted, and nothing else
    found: tuple[AcceptedMechanism, ...]  #: each judged with those before it in place
    fit: Fit  #: of the simulation with all of them
    screened: tuple[Ranked[Probe], ...]  #: the last screening: every probe with what it would gain
    #: Candidates whose fit gave nothing that could be judged, with the reason.
    untried: tuple[NotFitted, ...] = ()
    #: Labels of the mechanisms that were in place for the screening, not the last one where nothing was left
    #: to be explained.
    screened_with: tuple[str, ...] = ()
    fruitless: frozenset[str] = frozenset()  #: of those that were fitted and gained nothing, the labels


def _accepted(
    trials: Sequence[FittedCandidate], probes: int, chance: float, *, options: SearchOptions
) -> AcceptedMechanism | None:
    """The best of the trials that stand every test, with what cannot be told from it."""
    significant = [
        trial
        for trial in trials
        if trial.p_white < options.false_alarms / max(probes, 1)
        and trial.p_cluster < chance
        and trial.delta_bic < 0
    ]
    if not significant:
        return None
    # By Schwarz's criterion with what is known beforehand: twice the logarithm of a weight is as good as χ².
    # Of fits that are equal but for rounding, what is in an equation leads.
    costs = np.array([each.delta_bic - 2 * np.log(each.candidate.weight) for each in significant])
    near = costs <= costs.min() + ROUNDING * options.same
    equal = [each for each, leads in zip(significant, near, strict=True) if leads]
    best = max(equal, key=lambda each: (each.candidate.weight, bool(each.candidate.equations)))
    if best.fit.has_process_noise:
        # What is left is no noise, and white errors mean little: of equals, what all recordings ask for, but
        # no general form whose special case is one of them.
        equals = [each for each in significant if each.delta_bic < best.delta_bic + options.same]
        plain = [e for e in equals if not any(_special_case(o.candidate, e.candidate) for o in equals)]
        best = min(plain, key=lambda each: each.p_cluster)
    least = best.delta_chi2 - options.same

    def standing(other: FittedCandidate) -> Standing:
        """Less, the same, or needless: it needs more parameters than the best, and does not earn them.

        One that fits better by as much as its further parameters would bring by chance twice over (Akaike) is
        not ruled out, although the simpler is preferred (Bayes).
        """
        if not other.delta_chi2 > least:
            return "less"
        more = len(other.candidate.new) - len(best.candidate.new)
        return "needless" if more > 0 and other.delta_chi2 - best.delta_chi2 < 2 * more else "same"

    stands = [(standing(other), other) for other in trials if other is not best]
    names: tuple[Standing, ...] = ("same", "needless", "less")
    return AcceptedMechanism(best, {name: tuple(o for each, o in stands if each == name) for name in names})


def _better_without(trial: FittedCandidate, current: Fit, context: FitContext) -> Fit | None:
    """The simulation alone, fitted from where a mechanism led it, if that explains as much as with it.

    A mechanism may seem to explain much only because its fit found parameters of the simulation that its own
    fit had missed. Nothing is called missing before the simulation has begun there, too.
    """
    fit, model, least = trial.fit, context.model, context.study.search.same
    known = {each.name: each.value for each in fit.model.parameters}
    begun = model.with_values(np.array([known[each.name] for each in model.parameters]))
    d = model.dimension
    begin = replace(fit, noise=replace(fit.noise, process=fit.noise.process[:d]))
    try:
        again = fit_with_process_noise_as_needed(
            begun, context.data, begin, x=fit.x[:, :d], budget=context.budget
        )
    except (*NUMERICAL_ERRORS, BudgetSpent):
        return None
    gained = 2 * (again.log_likelihood - current.log_likelihood)
    return again if again.converged and gained > max(least, trial.delta_chi2 - least) else None


def _fit_most_promising(
    context: FitContext, current: Fit, screened: Sequence[Ranked[Probe]]
) -> tuple[list[FittedCandidate], list[NotFitted]]:
    """Fit the candidates that promise most, each from its best probe."""
    data, budget, options = context.data, context.budget, context.study.search
    most, least_gain, blocks = options.fitted, options.same, options.blocks
    best = best_probes(screened)
    ranked = sorted(best.values(), key=lambda each: -each.gain)
    trials: dict[str, FittedCandidate] = {}
    failed: dict[str, NotFitted] = {}
    begun: list[Ranked[Probe]] = []

    def attempt(promised: Ranked[Probe], begin: Fit, reached: Mapping[str, float] | None = None) -> None:
        """Fit and judge a candidate; one that leads away, or has a sign that it cannot have, has failed."""
        candidate = promised.term.candidate
        try:
            start, x = promised.term.begin(current, data, begin.x[:, : current.model.dimension])
            start = dict(reached or start)
            # Linearised amplitudes can be far off, and a fit that begins there may diverge: they are a start
            # only where shapes need one.
            if not reached and candidate.amplitudes and candidate.shapes and promised.amplitudes.any():
                start |= dict(zip(candidate.amplitudes, map(float, promised.amplitudes), strict=True))
            model = candidate.begun(begin.model, start)
            fit = fit_with_process_noise_as_needed(
                model, data, begin, level=promised.level, x=x, budget=budget
            )
            if not fit.converged:
                raise NumericalFailure(fit.fault or "its fit does not settle")
            # With no effect it would be what it is compared with, but for forces that are not believed.
            if 2 * (current.log_likelihood - fit.log_likelihood) > least_to_believe(current.noise):
                raise NumericalFailure("its fit leads away, to less than without it")
            if not candidate.admits(fit, data):
                raise NumericalFailure("its best parameters have a sign or a period that it cannot have")
            trial = FittedCandidate.of(fit, current, data, candidate, blocks=blocks)
        except BudgetSpent:
            failed.setdefault(candidate.label, NotFitted.of(candidate, BUDGET_SPENT))
            return
        except NUMERICAL_ERRORS as error:
            LOGGER.info("%s cannot be fitted: %s", candidate.label, error)
            failed[candidate.label] = NotFitted.of(candidate, error)
            return
        known = trials.get(candidate.label)
        if known is None or trial.fit.log_likelihood > known.fit.log_likelihood:
            trials[candidate.label] = trial

    # What the recordings themselves show is fitted as well as the others, and in the place of none of them.
    most_promised = ranked[0].gain if ranked else 0.0
    shown = sum(each.term.recorded and each.gain >= most_promised for each in ranked)
    for place, promised in enumerate(ranked[: shown + 2 * most], start=-shown):
        # Against what screening predicted of those that did gain it: some promise much and gain nothing, and
        # of others the first order shows little.
        gained = max((min(each.delta_chi2, best[name].gain) for name, each in trials.items()), default=0.0)
        if promised.gain < max(least_gain, PROMISING_GAIN * gained):
            break
        if place >= most and promised.gain < gained - least_gain:
            break  # no alternative to the best, which the class of indistinguishables must have
        begun.append(promised)
        budget.says(
            f"candidate {place + shown + 1} of at most {min(shown + 2 * most, len(ranked))}:"
            f" {promised.term.candidate.label}"
        )
        attempt(promised, current)
    for promised in begun:  # once more, what led nowhere, or to less than a special case of it
        candidate = promised.term.candidate
        own = trials.get(candidate.label)
        better_ones = [
            each
            for each in trials.values()
            if own is None or (_special_case(each.candidate, candidate) and each.delta_chi2 > own.delta_chi2)
        ]
        if better_ones:
            better = max(better_ones, key=lambda each: each.delta_chi2)
            budget.says(f"once more: {candidate.label}")
            if candidate.shapes and _special_case(better.candidate, candidate):
                # With the shapes that promise most on top of the special case; alone they may all be that.
                on_top = replace(candidate.rebased(current.model, better.fit.model), positive=frozenset())
                again, _ = screen_all(data, better.fit, [on_top], budget=budget)
                if again:
                    values = [value for _, value in max(again, key=lambda each: each.gain).term.shapes]
                    shapes = tuple(zip(candidate.shapes, values, strict=True))
                    promised = replace(promised, term=Probe(candidate, shapes))
            attempt(promised, better.fit)
    # From where forecasts led them: steps from the simulation alone may never come there.
    probes = {(each.term.candidate.label, *each.term.candidate.model.arguments): each for each in screened}
    for lead in context.leads:
        if (probe := probes.get((lead.candidate.label, *lead.candidate.model.arguments))) is not None:
            attempt(probe, lead.fit, {each.name: each.value for each in lead.fit.model.parameters})
    most_gained = max((each.delta_chi2 for each in trials.values()), default=0.0)
    for label, trial in trials.items():
        near = trial.delta_chi2 >= SHARPENED_GAIN * most_gained
        if near and trial.candidate.scales:  # a state of its own makes several maxima of the likelihood
            for other in screened:
                if other.term.candidate.label == label and other.gain > 0 and other is not best[label]:
                    attempt(other, current)
        if near and trial.fit.model.edges:
            try:
                budget.says(f"following the jumps of {label}")
                sharp = sharpened(trial.fit, data, budget=budget)
                trials[label] = FittedCandidate.of(sharp, current, data, trial.candidate, blocks=blocks)
            except (*NUMERICAL_ERRORS, BudgetSpent) as error:
                LOGGER.info("%s stays as sharp as it is: %s", label, error)
    return list(trials.values()), [each for label, each in failed.items() if label not in trials]


def _special_case(one: MechanismCandidate, of: MechanismCandidate) -> bool:
    return one.name in of.generalises and one.equations == of.equations


def best_probes(screened: Sequence[Ranked[Probe]]) -> dict[str, Ranked[Probe]]:
    """Of each candidate the probe that promises most, by label; none that promises nothing."""
    best: dict[str, Ranked[Probe]] = {}
    for each in screened:
        label = each.term.candidate.label
        if each.gain > 0 and (label not in best or each.gain > best[label].gain):
            best[label] = each
    return best


def _stands_together(
    progress: Search, before: Search, context: FitContext, *, chance: float
) -> Search | None:
    """A search in which a mechanism was taken on trial, if it stands the clustered test in the final fit."""
    place, data, blocks = len(before.found), context.data, context.study.search.blocks
    if len(progress.found) < place + 2:
        return None
    on_trial, fit = progress.found[place], progress.fit
    candidate, without = on_trial.best.candidate, None
    if candidate.amplitudes and set(candidate.new) <= {each.name for each in fit.model.parameters}:
        model = fit.model.held(candidate.new, zero=candidate.amplitudes)
        refit = fit_with_process_noise_as_needed(model, data, fit)
        without = refit if refit.converged else None
    p_cluster = probability_by_chance(fit, without, data, candidate, blocks=blocks)
    LOGGER.info("%s on trial: p %.1e clustered", candidate.label, p_cluster)
    if p_cluster >= chance:
        return None
    stands = replace(on_trial, best=replace(on_trial.best, p_cluster=p_cluster))
    return replace(progress, found=(*progress.found[:place], stands, *progress.found[place + 1 :]))


def _last_alone(search: Search, context: FitContext) -> Search:
    """A search with the last of its mechanisms only, if that explains as much by itself."""
    last, fit, options = search.found[-1], search.fit, context.study.search
    (candidate,) = (each for each in context.candidates if each.label == last.best.candidate.label)
    known = {each.name: each.value for each in fit.model.parameters}
    known |= {new: known[old] for new, old in zip(candidate.new, last.best.candidate.new, strict=True)}
    begun = candidate.begun(context.model, known)
    again = fit_with_process_noise_as_needed(begun, context.data, fit, x=fit.x, budget=context.budget)
    if not again.converged or 2 * (fit.log_likelihood - again.log_likelihood) > options.same:
        return search
    best = FittedCandidate.of(again, search.recalibrated, context.data, candidate, blocks=options.blocks)
    return replace(search, found=(replace(last, best=best),), fit=again)


def search_mechanisms(progress: Search, context: FitContext, *, on_trial: bool = True) -> Search:
    """A search carried on until nothing more is found.

    Where recordings are few, what is still missing may make all errors so large that the best candidate does
    not stand the clustered test alone. It is then taken on trial, once: another is looked for on top of it,
    and both count as found if both stand the test together. Where a mechanism leads to better parameters of
    the simulation itself, the search begins anew from there, once.
    """
    model, data, options = context.model, context.data, context.study.search
    begun_anew = False
    while True:
        found, current = progress.found, progress.fit
        base = current.model
        if found and (len(found) == options.mechanisms or not has_structure(current, data)):
            return progress
        if base.dimension > model.dimension:
            return progress  # nothing is sought on top of a mechanism that has states of its own
        if found and context.budget.stopped_by is not None:
            return progress
        labels = [each.best.candidate.label for each in found]
        remaining = [
            each.rebased(model, base) if found else each
            for each in context.candidates
            if not any(each.repeats(other.best.candidate) for other in found)
        ]
        screened, unscreened = screen_all(
            data, current, remaining, fruitless=progress.fruitless, budget=context.budget
        )
        trials, failed = _fit_most_promising(context, current, screened)
        # All that could never be judged, each once, with the last reason.
        reasons = {each.label: each for each in (*progress.untried, *unscreened, *failed)}
        judged_ones = {each.candidate.label for each in trials}
        untried = tuple(each for label, each in reasons.items() if label not in judged_ones)
        fruitless = {each.candidate.label for each in trials if each.delta_chi2 < options.same}
        progress = replace(
            progress, screened=tuple(screened), untried=untried, screened_with=tuple(labels),
            fruitless=progress.fruitless | fruitless,
        )  # fmt: skip
        for trial in trials:
            LOGGER.info(
                "%s: chi2 better by %.1f, BIC %.1f, p %.1e white, %.1e clustered",
                trial.candidate.label, trial.delta_chi2, trial.delta_bic, trial.p_white, trial.p_cluster,
            )  # fmt: skip
        chance = 5 * options.false_alarms / max(len(remaining), 1)
        stands = _accepted(trials, len(screened), chance, options=options)
        best = _accepted(trials, len(screened), 1.0, options=options)
        if not (found or begun_anew) and best is not None:
            begun_anew = True
            better = _better_without(best.best, current, context)
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
            begun = replace(progress, found=(*found, best), fit=best.best.fit)
            together = _stands_together(
                search_mechanisms(begun, context, on_trial=False), progress, context, chance=chance
            )
            if together is not None:
                return together
            on_trial = False
        if stands is None:
            return progress
        LOGGER.info("found %s, chi2 better by %.1f", stands.best.candidate.label, stands.best.delta_chi2)
        progress = replace(progress, found=(*found, stands), fit=stands.best.fit)
        if len(found) == 1 and found[0].best.candidate.idle(progress.fit, all):
            progress = _last_alone(progress, context)
