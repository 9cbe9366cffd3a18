"""Naming: which mechanisms may be named, and what models the rest.

**Odds.** A mechanism and a smooth function in its place are compared as whole explanations of what is
missing, by their marginal likelihoods (`siq.diagnosis.evidence`): along the trajectories of the fit with the
mechanism everything is linear, and amplitudes, shapes and functions have normal priors whose size is drawn
evenly on a logarithmic scale. A name takes the odds that keep wrong names as rare as is asked for.

**Where process noise stands in** for what is missing, forecasts are asked first (`siq.diagnosis.forecasts`),
and tests with these odds only where they name nothing.

**One cause or two.** A name that leaves something says that two things are missing. Where one without a name
leaves nothing, name and rest together have to be likelier, by the odds that a name takes.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.special

from siq.data.correlation import correlation_time_of
from siq.diagnosis.evidence import (
    NUMERICAL_ERRORS,
    FittedCandidate,
    averaged_evidence,
    evidence_of_function,
    log_evidences,
    orthonormal,
    sizes_of_effects,
)
from siq.diagnosis.forecasts import Horizon, climb
from siq.diagnosis.mechanisms import MECHANISM, MechanismCandidate
from siq.diagnosis.residual_structure import Remainder, has_structure
from siq.diagnosis.screening import linearised_with, portions
from siq.diagnosis.search import FitContext, Search
from siq.diagnosis.study import MismatchVerdict
from siq.diagnosis.terms import places_in, products_in
from siq.diagnosis.unnamed_models import (
    AugmentedModel,
    exact_fit,
    fit_models_of_remainder,
    fit_unnamed_models,
)
from siq.inference.budget import UNLIMITED, Account
from siq.inference.kalman_filter import Whitened, solve, whiten
from siq.inference.maximum_likelihood import Fit
from siq.inference.recalibration import fit_with_process_noise_as_needed
from siq.inference.trajectories import sharpened
from siq.remarks import Remark

LOGGER = logging.getLogger(__name__)


class _MissingEffect:
    """What is missing, as a linear problem: innovations without some mechanisms, and what could explain them.

    The innovations are those of the fit with the mechanisms, with columns of its parameters.
    """

    def __init__(self, white: Whitened, fit: Fit, candidates: Sequence[MechanismCandidate]) -> None:
        names = [fit.model.parameters[place].name for place in fit.model.free]
        own = white.columns[:, : len(names)]
        change, _ = solve(own, white.innovations)
        values = fit.model.values[list(fit.model.free)] + change
        linear = [n for each in candidates for n in (each.amplitudes or each.shapes) if n in names]
        others = [n for each in candidates for n in each.shapes if n in names and n not in linear]
        tested = [names.index(name) for name in (*linear, *others)]
        self._linear, self._values = len(linear), values[tested]
        self._basis = orthonormal(np.delete(own, tested, axis=1))
        effect = own[:, tested[: len(linear)]] @ values[tested[: len(linear)]]
        left = white.innovations - own @ change
        self.correlated = correlation_time_of(left, white.recording, outputs=len(fit.model.outputs))
        self.target = self.projected((left + effect)[:, None])[:, 0]
        self.freedom = (white.degrees_of_freedom - len(names) + len(tested)) / self.correlated
        self._columns = self.projected(own[:, tested])

    def projected(self, columns: np.ndarray) -> np.ndarray:
        """Columns without what the other parameters can do, weighed as so many independent errors are."""
        return (columns - self._basis @ (self._basis.T @ columns)) / np.sqrt(self.correlated)

    def log_evidence_of_mechanisms(self) -> float:
        """Log-likelihood of the mechanisms, averaged over their amplitudes and shapes, to that of nothing.

        An amplitude has the size that the effect has; a shape may be off by as much as it is.
        """
        total = float(self.target @ self.target)
        gram = self._columns.T @ self._columns
        own = np.diag(gram)[: self._linear]
        unit, wide = np.zeros(len(gram)), np.zeros(len(gram))
        unit[: self._linear] = 1.0 / np.where(own > 0, own, np.inf) / self._linear
        wide[self._linear :] = self._values[self._linear :] ** 2
        priors = [np.diag(size * unit + wide) for size in sizes_of_effects(total)]
        return averaged_evidence(gram, self._columns.T @ self.target, priors, total, self.freedom)


def _log_odds_of_a_name(fit: Fit, candidates: Sequence[MechanismCandidate], context: FitContext) -> float:
    """Logarithm of the odds that what is missing is the mechanism, rather than a function without a name."""
    model, data, unnamed = context.model, context.data, context.study.search.unnamed
    ours, theirs = -np.inf, []
    single = places_in(model, context.roles, data, fit.x)
    there = {name for each in candidates for name in each.equations}
    products = products_in([each for each in single if there & set(each.targets)], model, data, fit.x)
    for some in portions(fit, data, (*single, *products)):
        response, groups = linearised_with(fit, data, some)
        white = whiten(response, data, fit.noise)
        problem = _MissingEffect(white, fit, candidates)
        ours = problem.log_evidence_of_mechanisms()
        further = white.columns[:, len(fit.model.free) :]
        theirs += [
            evidence_of_function(
                problem.projected(further[:, group]), problem.target, place.knots, freedom=problem.freedom
            )
            for place, group in zip(some, groups, strict=True)
            if np.isfinite(further[:, group]).all()
        ]
    if not theirs:
        return np.inf
    forms = Counter(each.name for each in context.candidates)
    chosen = sum(np.log(len(forms) * forms[each.name]) for each in candidates if forms[each.name])
    named = ours + np.log1p(-unnamed) - chosen
    return float(named - (scipy.special.logsumexp(theirs) + np.log(unnamed) - np.log(len(theirs))))


@dataclass(frozen=True)
class Investigation:
    """What was found out about a simulation and recordings of the system, with all fits that it rests on."""

    context: FitContext  #: the simulation, the recordings, and the mechanisms that were considered
    #: Recalibration, mechanisms that are named, or that describe what has no name, and the final fit.
    search: Search
    #: What the recalibrated simulation and the final fit leave, and the share of the excess explained.
    remainder: Remainder
    verdict: MismatchVerdict  #: one of four
    least_squares: Fit  #: the recalibration whose trajectories follow the equations exactly
    p_shift: float = float("nan")  #: p-value of the test that the parameters of the card are the true ones
    #: For each mechanism, that it is this rather than a function without a name, as a logarithm.
    log_odds: tuple[float, ...] = ()
    #: Whether what was found explains enough, and is not named since a function is nearly as likely.
    too_faint: bool = False
    remarks: tuple[Remark, ...] = ()  #: reservations
    #: Of what has no name, be it all that is missing or what names leave, the likeliest first.
    models: tuple[AugmentedModel, ...] = ()
    #: The final fit whose trajectories follow the equations, where process noise stands in for a remainder.
    exact: Fit | None = None
    account: Account = UNLIMITED  #: the work that it took, and whether something was left undone
    #: Whether a name was given, and misled on recordings held out (`siq.diagnosis.diagnosis`).
    withdrawn: bool = False
    #: The simulation alone, fitted at each horizon (`siq.diagnosis.forecasts`).
    recalibrations: tuple[Horizon, ...] = ()
    finals: tuple[Horizon, ...] = ()  #: the same with what is named

    @property
    def process_noise(self) -> bool:
        """Whether process noise is all that is missing."""
        return self.verdict.names and not self.search.found

    @property
    def final(self) -> Fit:
        """The fit that the verdict stands on: with mechanisms only where they are physics."""
        return self.search.fit if self.verdict.names else self.search.recalibrated

    @property
    def quiet_verdict(self) -> MismatchVerdict:
        """The verdict where nothing is missing, by the probability that the card's parameters are right."""
        shifted = self.p_shift < self.context.study.search.false_alarms
        return MismatchVerdict.PARAMETER_SHIFT if shifted else MismatchVerdict.NO_MISMATCH


def _judge_mechanisms(whole: Search, left: Sequence[Remainder], context: FitContext) -> Investigation:
    """Judge the mechanisms of a search, as far as they explain by themselves what is missing."""
    options = context.study.search

    def convincing(number: int, left: Remainder) -> bool:
        """Whether the first so many mechanisms leave nothing."""
        return not (left.doubtful or whole.found[number - 1].best.fit.has_process_noise)

    search = whole
    if len(whole.found) > 1 and convincing(1, left[0]):
        # Those after the first stay as long as each is likely and leaves less; others are patches of them.
        kept = 1
        while (
            kept < len(left)
            and left[kept].share > left[kept - 1].share
            and _log_odds(whole, kept + 1, [kept], context) >= options.least_log_odds
        ):
            kept += 1
        search = replace(whole, found=whole.found[:kept], fit=whole.found[kept - 1].best.fit)
        left = left[:kept]
    convinces = convincing(len(search.found), left[-1])
    every = range(len(search.found))
    odds = tuple(_log_odds(whole, len(every), [place], context) for place in every)
    together = odds[0] if len(odds) == 1 else _log_odds(whole, len(every), every, context)
    least = min(*odds, together)
    certain = least >= options.least_log_odds
    remarks = (_not_certain(search, least, context),) if convinces and not certain else ()
    verdict = MismatchVerdict.MISSING_PHYSICS if convinces and certain else MismatchVerdict.UNEXPLAINED
    return Investigation(
        context, search, left[-1], verdict, whole.recalibrated,
        log_odds=odds, too_faint=convinces and not certain, remarks=remarks,
    )  # fmt: skip


def _not_certain(search: Search, log_odds: float, context: FitContext) -> Remark:
    names = " and ".join(each.best.candidate.name for each in search.found)
    odds, needed = (float(np.exp(each)) for each in (log_odds, context.study.search.least_log_odds))
    return Remark("diagnosis.not_certain", {"names": names, "odds": odds, "needed": needed})


def decide_naming(whole: Search, left: Sequence[Remainder], context: FitContext) -> Investigation:
    """Decide about the names of a search that found something, and fit models of the rest.

    Parameters
    ----------
    whole
        The search.
    left
        What is left with the first mechanism, the first two, and so on.
    context
        What models are made from, and what could be named.
    """
    return _with_models(_judge_mechanisms(whole, left, context), whole, context)


def _with_models(decision: Investigation, whole: Search, context: FitContext) -> Investigation:
    """With models of what has no name, be it all that is missing, or what names leave of a whole search."""
    search = decision.search
    if not decision.verdict.names:
        return replace(decision, models=fit_unnamed_models(search, context))
    if len(whole.found) > len(search.found) or decision.remainder.doubtful or search.fit.has_process_noise:
        models = fit_models_of_remainder(search, whole, context)
        decision = replace(decision, models=models)
        # What forecasts named has been held against functions without a name on parts left out.
        if models and not (models[0].fit.has_process_noise or decision.finals):
            decision = _one_cause_or_two(decision, context)
            if not decision.verdict.names:
                return decision
    with context.budget.exempt():
        exact = exact_fit(search.fit, context.data, context.budget)
    if exact is not None:
        remarks = (*decision.remarks, Remark("diagnosis.least_squares"))
        decision = replace(decision, exact=exact, remarks=remarks)
    return decision


def _one_cause_or_two(decision: Investigation, context: FitContext) -> Investigation:
    """A decision, without its names where one cause explains what needs two with them."""
    search, data, unnamed = decision.search, context.data, context.study.search.unnamed
    models = fit_unnamed_models(search, context, most=1)
    alone, both = [each for each in models if each.parts[0].candidate.kind != MECHANISM], decision.models[0]
    if not alone or has_structure(alone[0].fit, data):
        return decision
    with_names, without = log_evidences([both.fit, alone[0].fit], data)
    chosen = len(search.found) * np.log(len(context.candidates)) + both.cost
    log_odds = with_names - chosen + np.log1p(-unnamed) - (without - alone[0].cost)
    LOGGER.info("two causes, one with a name, over one without: log-odds %.1f", log_odds)
    if log_odds >= context.study.search.least_log_odds:
        return decision
    verdict, remarks = MismatchVerdict.UNEXPLAINED, decision.remarks
    remarks += (_not_certain(search, log_odds, context),)
    return replace(decision, verdict=verdict, models=models, remarks=remarks, too_faint=True)


def named_by_forecasts(
    recalibrated: Fit, least_squares: Fit, context: FitContext
) -> tuple[Investigation | None, tuple[Horizon, ...], list[FittedCandidate]]:
    """What is missing by what foresees recordings best, where the recalibrated fit needs forces at random.

    Returned are what is named, or None; fits of the simulation alone at each horizon; what was taken back.
    """
    alone, rungs, untried, taken_back = climb(recalibrated, context)
    recalibrations, leads = tuple(alone), [each.accepted.best for each in taken_back]
    if not rungs:
        return None, recalibrations, leads
    fit = rungs[-1].accepted.best.fit
    try:
        with context.budget.exempt():  # without forces, where they are not needed any more
            fit = fit_with_process_noise_as_needed(fit.model, context.data, fit, budget=context.budget)
            if fit.model.edges:
                fit = sharpened(fit, context.data, budget=context.budget)
    except NUMERICAL_ERRORS as error:
        LOGGER.info("the fit at the shortest horizon stays: %s", error)
    left = Remainder.of(context.data, alone[0].fit, fit, context.roles)
    search = Search(recalibrated, tuple(each.accepted for each in rungs), fit, (), untried=tuple(untried))
    remarks = [
        Remark(
            "diagnosis.by_prior",
            {"name": each.accepted.best.candidate.label, "odds": np.exp(each.flat_log_odds)},
        )
        for each in rungs
        if each.flat_log_odds < context.study.search.least_log_odds
    ]
    if left.doubtful or fit.has_process_noise:
        # How much of the excess over noise is left by what was found, and whether it looks like noise.
        values = {"left": 1 - left.share, "doubtful": left.doubtful, "p": left.after.p_value, "unnamed": True}
        remarks.append(Remark("diagnosis.remainder", values))
    decision = Investigation(
        context, search, left, MismatchVerdict.MISSING_PHYSICS, least_squares,
        log_odds=tuple(each.log_odds for each in rungs), remarks=tuple(remarks),
        recalibrations=recalibrations, finals=rungs[-1].horizons,
    )  # fmt: skip
    return _with_models(decision, search, context), recalibrations, leads


def _log_odds(search: Search, number: int, chosen: Sequence[int], context: FitContext) -> float:
    """Logarithm of the odds of some mechanisms of a search, in the fit with the first so many."""
    found = [each.best for each in search.found]
    named = [found[place].candidate for place in chosen]
    try:
        odds = _log_odds_of_a_name(found[number - 1].fit, named, context)
    except NUMERICAL_ERRORS as error:
        LOGGER.info("the odds of a name are not known: %s", error)
        return -np.inf
    if len(chosen) == 1:  # what cannot be told apart is named as a class
        one = search.found[chosen[0]]
        same = [one.best.delta_bic, *(each.delta_bic for each in one.others["same"])]
        odds += float(scipy.special.logsumexp(-0.5 * (np.array(same) - one.best.delta_bic)))
    LOGGER.info("%s: log-odds of the name %.1f", [each.label for each in named], odds)
    return odds
