"""The investigation of a case, from its recalibration to what it lacks, and its runs of held-out data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from siq.data.correlation import correlation_time_of
from siq.diagnosis.dictionary import Mechanism, Roles, roles_of, units_of
from siq.diagnosis.evidence import NotFitted, residuals
from siq.diagnosis.forecasts import Horizon
from siq.diagnosis.holdout import (
    HeldOutErrors,
    errors_left_out,
    predicts_better,
    preferred_model,
    preferred_recalibration,
    simulated,
)
from siq.diagnosis.mechanisms import MECHANISM, MechanismCandidate, candidates_of
from siq.diagnosis.naming import Investigation, decide_naming, named_by_forecasts
from siq.diagnosis.residual_structure import (
    RANDOM_RESIDUALS,
    STRUCTURED,
    Remainder,
    explained_by_quantisation,
)
from siq.diagnosis.search import BUDGET_FOR_FUNCTIONS, FitContext, Search, search_mechanisms
from siq.diagnosis.study import Comparison, MismatchVerdict
from siq.diagnosis.unnamed_models import AugmentedModel, fit_unnamed_models
from siq.errors import NumericalFailure
from siq.inference.budget import Budget
from siq.inference.maximum_likelihood import Fit
from siq.inference.measurements import Measurements, first_states, with_expectations
from siq.inference.recalibration import (
    covariance_with_unknown_process_noise,
    noise_nonstationarity,
    recalibrate,
    wald_probability,
)
from siq.inference.trajectories import scored_rows, squared_errors
from siq.numerics.randomness import positive
from siq.remarks import Remark
from siq.systems.dynamics import Dynamics

RARE = 0.2  # weight of what few systems have, as in the dictionary
TURNED = 0.01  # share of a path that is gone back, from which on it is no error of the first velocities


def investigate(case: Comparison, *, budget: Budget | None = None) -> Investigation:
    """Say whether, where and in which way a simulation differs from the recordings of a case to learn from.

    The budget is charged for the work; what it does not reach is left undone, and the answer is that of the
    rest.

    Raises
    ------
    NumericalFailure
        When not even the recalibrated simulation with process noise can be fitted.
    """
    study, data, dictionary = case.settings, case.learn, case.dictionary
    model = with_expectations(case.system)
    roles = roles_of(model)
    candidates = candidates_of(model, roles, dictionary)
    # No path that is never gone back tells whether a force depends on it.
    x, begins = first_states(model, data), data.first[:-1]
    moved, net = np.abs(x).sum(axis=0), np.abs(np.add.reduceat(x, begins)).sum(axis=0)
    turns = dict(zip(model.states, moved - net > 2 * TURNED * moved, strict=True))
    candidates = [each for each in candidates if not each.turning or turns[each.coordinate]]
    # The time since a recording was begun is no clock: what goes by it would begin anew with each of them.
    if len(begins) > 1 and np.ptp(data.t[begins]) <= np.median(data.step[data.begins]):
        candidates = [
            replace(each, weight=min(each.weight, RARE)) if each.coordinate == "t" else each
            for each in candidates
        ]
    if study.search.prior == "flat":
        candidates = [replace(each, weight=1.0) for each in candidates]
    budget = budget or Budget()
    context = FitContext(model, data, roles, tuple(candidates), study, budget)
    budget.says("fitting the simulation's own parameters")
    with budget.exempt():
        recalibrated, least_squares = recalibrate(model, data, budget=budget)
    named, recalibrations = None, tuple[Horizon, ...]()
    # The steps of a sensor look like forces, too, and so like physics that explains them.
    if recalibrated.has_process_noise and (
        explained_by_quantisation(data, least_squares, roles, budget=budget) is None
    ):
        with budget.keeping(BUDGET_FOR_FUNCTIONS):
            named, recalibrations, leads = named_by_forecasts(recalibrated, least_squares, context)
            context = replace(context, leads=tuple(leads))
    if named is None:
        result = _by_tests(recalibrated, least_squares, context, dictionary)
        result = replace(result, recalibrations=recalibrations)
    else:
        result = replace(named, p_shift=_shift_probability(model, recalibrated))
    budget.says("working out how well parameters are known")
    with budget.exempt():
        covariance = covariance_with_unknown_process_noise(result.search.fit, data, budget=budget)
    search = replace(result.search, fit=replace(result.search.fit, covariance=covariance))
    return replace(result, search=search, account=budget.account())


def _by_tests(
    recalibrated: Fit, least_squares: Fit, context: FitContext, dictionary: Sequence[Mechanism]
) -> Investigation:
    """What is missing by tests that suppose that with it nothing is left but noise."""
    model, data, roles, budget = context.model, context.data, context.roles, context.budget
    options = context.study.search
    with budget.keeping(BUDGET_FOR_FUNCTIONS):
        found = search_mechanisms(Search(recalibrated, (), recalibrated, ()), context)
    recalibrated = found.recalibrated  # from where a mechanism led it, if that is better
    if not (recalibrated.has_process_noise or recalibrated.log_likelihood < least_squares.log_likelihood):
        least_squares = recalibrated
    # What is left with each mechanism that was found. One whose remainder has no finite size, such as one
    # that makes the simulation run away without process noise, is taken back, with those after it.
    by_each: list[Remainder] = []
    for place, each in enumerate(found.found):
        try:
            by_each.append(Remainder.of(data, recalibrated, each.best.fit, roles))
        except NumericalFailure as error:
            fit = found.found[place - 1].best.fit if place else recalibrated
            untried = (*found.untried, NotFitted.of(each.best.candidate, error))
            found = replace(found, found=found.found[:place], fit=fit, untried=untried)
            break
    tried = bool(found.found)
    if tried:
        result = replace(decide_naming(found, by_each, context), least_squares=least_squares)
    else:
        left = Remainder.of(data, recalibrated, recalibrated, roles)
        result = Investigation(context, found, left, MismatchVerdict.NO_MISMATCH, least_squares)
    rounded = None
    doubtful = not tried and (found.fit.has_process_noise or result.remainder.structured)
    if doubtful or result.verdict is MismatchVerdict.UNEXPLAINED:
        budget.says("asking whether the sensors' steps explain it")
        with budget.exempt():
            # What a mechanism has found already has to be gone more clearly.
            least = RANDOM_RESIDUALS if tried else STRUCTURED
            rounded = explained_by_quantisation(data, least_squares, roles, least=least, budget=budget)
    if rounded is not None:
        fit, left, outputs = rounded
        remarks = (Remark("diagnosis.quantised", {"outputs": ", ".join(outputs)}),)
        search = replace(result.search, recalibrated=fit, found=(), fit=fit)
        result = Investigation(context, search, left, MismatchVerdict.NO_MISMATCH, fit, remarks=remarks)
    result = replace(result, p_shift=_shift_probability(model, result.search.recalibrated))
    if rounded is not None or not (tried or doubtful):
        result = replace(result, verdict=result.quiet_verdict)
    elif not tried:
        result = replace(result, verdict=MismatchVerdict.UNEXPLAINED)
    if not tried and rounded is None and found.fit.has_process_noise:
        # Process noise explains any recordings. It is named where nothing else is likelier, neither a
        # function instead of it nor one on top of it: noise does not know where a system is, so that no
        # function of the states takes a part of it over.
        steady = noise_nonstationarity(found.fit, data) < 2 * options.least_log_odds
        knows_noise = any(form.noise for mechanism in dictionary for form in mechanism.forms)
        if not steady:
            result = replace(result, remarks=(Remark("diagnosis.noise_follows_motion"),))
        elif knows_noise and not result.remainder.doubtful:
            models = fit_unnamed_models(found, context)
            if not models or models[0].log_evidence < options.least_log_odds:
                result = replace(result, verdict=MismatchVerdict.MISSING_PHYSICS)
            else:
                result = replace(result, models=models)
    if result.verdict is MismatchVerdict.UNEXPLAINED and not (result.models or result.search.found):
        result = replace(result, models=fit_unnamed_models(result.search, context))
    return result


def _shift_probability(model: Dynamics, recalibrated: Fit) -> float:
    """p-value of the test that the card's parameters are the true ones, given the recalibrated ones."""
    free = list(model.free)
    return wald_probability(recalibrated.model.values[free] - model.values[free], recalibrated.covariance)


@dataclass(frozen=True)
class HeldOutRuns:
    """Free runs of held-out recordings by the three simulations, and how far each is off."""

    before: np.ndarray  #: outputs ``(n, m)`` of the simulation as it is, ...
    recalibrated: np.ndarray  #: ... with its parameters refitted, ...
    augmented: np.ndarray  #: ... and with what was found
    #: Of the recalibrated simulation: where no refit foresees parts left out better, that of the card.
    recalibration: Fit
    fit: Fit  #: of the augmented simulation that was run
    errors: HeldOutErrors  #: of the three
    #: Whether the recordings are others than those that were learned from, rather than a later part.
    independent: bool = True
    #: The model of what has no name that is part of the new card, since it makes predictions better.
    described: AugmentedModel | None = None
    #: Whether shifted parameters that predict no better leave only noise when all recordings are fitted.
    together: bool = False


def held_out_runs(investigation: Investigation, data: Measurements) -> HeldOutRuns:
    """Run the simulations freely on recordings that had no part in anything.

    Of several models of what has no name one may be adopted (`siq.diagnosis.holdout`). Parts of the
    recordings to learn from, each left out in turn, choose it. It has to make the prediction better than that
    of the mechanisms with a name, where there are any, or else of the simulation: of recordings held out, or
    where all of these are tests of somebody else, of the parts left out. The recordings that something was
    found in decide which estimates run freely best.
    """
    search, learned, study = investigation.search, investigation.context.data, investigation.context.study
    noise, substeps = search.recalibrated.noise, max(search.fit.substeps, search.recalibrated.substeps)

    def run(fit: Fit, of: Measurements) -> np.ndarray:
        return simulated(fit, of, noise=noise, substeps=substeps)

    def errors_of(fit: Fit, of: Measurements) -> np.ndarray | None:
        return squared_errors(run(fit, of), of)

    def mean_error(squares: np.ndarray | None) -> float:
        """Infinite where a simulation ran away."""
        return float("inf") if squares is None else float(squares.mean())

    def best_of(*fits: Fit | None) -> Fit:
        """The fit that runs nearest to what was learned from; the first of those that are as near."""
        known = [each for each in fits if each is not None]
        return min(known, key=lambda fit: mean_error(errors_of(fit, learned))) if known[1:] else known[0]

    card = replace(search.recalibrated, model=investigation.context.model)
    # What fits best with process noise admitted need not be what runs best without.
    recalibrated = fitted_alike = search.recalibrated
    if recalibrated.has_process_noise:
        horizons = [(each.fit, each.data) for each in investigation.recalibrations]
        refits = [(investigation.least_squares, learned), *(horizons or [(recalibrated, learned)])]
        fitted_alike = best_of(*(fit for fit, _ in refits), recalibrated, card)
        recalibrated = preferred_recalibration(card, refits, learned, noise=noise)
    plain = best_of(investigation.exact, search.fit, *(each.fit for each in investigation.finals))
    # Where the likeliest leaves nothing but the sensors' noise, evidence rules other functions out.
    models, weakest = investigation.models, -np.inf
    if models and not models[0].fit.has_process_noise:
        weakest = models[0].log_evidence - study.search.least_log_odds
    choices = [
        (model, fit)
        for model in models
        for fit in (model.fit, model.exact)
        if fit is not None and (model.log_evidence >= weakest or model.parts[0].candidate.kind == MECHANISM)
    ]
    named = investigation.verdict.names
    judges = [place for place, label in enumerate(data.labels) if label not in study.tests]
    names = [each.best.candidate for each in search.found] if named else []

    def left_out(fit: Fit, parts: Sequence[MechanismCandidate] = ()) -> np.ndarray | None:
        """Errors of free runs of parts of what was learned from, each left out in turn."""
        return errors_left_out(fit, learned, noise=noise, candidates=[*names, *parts])

    # Of several models, and ways to fit them, parts of what was learned from choose, each left out in turn.
    foreseen = [left_out(fit, [part.candidate for part in model.parts]) for model, fit in choices]
    sizes = [sum(len(part.candidate.new) for part in model.parts) for model, _ in choices]
    best = chosen = preferred_model(foreseen, sizes) if choices else 0
    adopted, waiting = False, dict(enumerate(foreseen))
    if choices and judges:
        # What is not certain where it was found, or what names leave, has to be better by more than appears
        # by chance, what is certain better than the simulation fitted alike. A card whose values are right
        # predicts well, and tells nothing of a function whose fit had to find them, too. Where there is
        # process noise a free run is off by it, and a little may be chance.
        may_choose = data.select(judges)
        alone = [errors_of(each, may_choose) for each in ((plain,) if named else (card, fitted_alike))]
        least = min((each for each in alone if each is not None), key=np.mean, default=None)
        while waiting and not adopted:  # recordings held out may go where the best of them fails
            chosen = list(waiting)[preferred_model([*waiting.values()], [sizes[one] for one in waiting])]
            (model, fit), _ = choices[chosen], waiting.pop(chosen)
            certain = not named and model.log_evidence >= study.search.least_log_odds
            limit = mean_error(least if model.fit.has_process_noise else alone[-1]) if certain else 0.0
            adopted = predicts_better(least, errors_of(fit, may_choose), limit=limit)
        best = chosen if adopted else best
    elif choices:
        adopted = predicts_better(left_out(plain if named else search.recalibrated), foreseen[best])
    fit = choices[best][1] if adopted or (choices and not named) else plain
    described = choices[best][0] if adopted else None
    before, refitted, augmented = (run(each, data) for each in (card, recalibrated, fit))
    squares = {
        "before": squared_errors(before, data),
        "recalibrated": squared_errors(refitted, data),
        "augmented": squared_errors(augmented, data),
        "named": errors_of(plain, data) if named and adopted else None,
    }
    # What a fit leaves may be more than noise; the one that leaves least is nearest to it. Where there is
    # process noise, that takes a part of the sensor's noise over.
    spread = positive(np.nanvar(data.outputs[scored_rows(data)], axis=0))
    still = [each for each in (search.fit, fit) if not each.has_process_noise] or [search.fit, fit]
    least = np.min([learned.roughness, *(each.noise.measurement for each in still)], axis=0)
    floors = [learned.with_known_noise(least)]
    if described is not None and described.fit.has_process_noise:
        floors.append(_spread_of_free_runs(described.fit, learned, investigation.context.roles))
    noise_floor, *_, floor = [float(np.sqrt(np.mean(each / spread))) for each in (*floors, floors[-1])]
    unit = units_of(fit.model).get(str(fit.model.outputs[0][1]), "1") if len(spread) == 1 else "1"
    rungs = [errors_of(each.best.fit, data) for each in search.found[:-1]] if named else []
    errors = HeldOutErrors.of(
        squares, noise_floor=noise_floor, floor=floor, unit=unit,
        rungs=tuple(None if each is None else float(np.sqrt(each.mean())) for each in rungs),
        spread=None if unit == "1" else float(np.sqrt(spread[0])),
    )  # fmt: skip
    shifted = investigation.verdict is MismatchVerdict.PARAMETER_SHIFT
    unmended = not errors.at_noise("before") and errors.change("before", "recalibrated") != "better"
    return HeldOutRuns(
        before=before, recalibrated=refitted, augmented=augmented, recalibration=recalibrated, fit=fit,
        errors=errors, independent=not set(learned.labels) & set(data.labels), described=described,
        together=shifted and unmended and _one_set_of_parameters(investigation, data),
    )  # fmt: skip


def _one_set_of_parameters(investigation: Investigation, data: Measurements) -> bool:
    """Whether all recordings together leave nothing but noise with other parameters."""
    both = (context := investigation.context).data.followed_by(data)
    with context.budget.exempt():
        try:
            fit, still = recalibrate(context.model, both, budget=context.budget)
            left = Remainder.of(both, fit, fit, context.roles)
        except NumericalFailure:
            return False
        rounded = explained_by_quantisation(both, still, context.roles, budget=context.budget)
    return not (fit.has_process_noise or left.structured) or rounded is not None


def _spread_of_free_runs(fit: Fit, learned: Measurements, roles: Roles) -> np.ndarray:
    """Variance of what free runs of a fit are off by, as the noises of the fit foresee it, shape ``(m,)``.

    The error of the model acts as process noise whose intensity over long times is that from one sample to
    the next, times its correlation time τ in samples. What a function of a coordinate finds in it is no
    process noise, and not counted. Where τ is not short beside the times of the system, this is too much.
    """
    white, _, left = residuals(fit, learned)
    correlated = correlation_time_of(left, white.recording, outputs=len(fit.model.outputs))
    after = Remainder.of(learned, fit, fit, roles).after
    found = max((each.gain - 2 * each.term.width for each in after.curves), default=0.0)
    random = 1 - np.clip(found / after.total, 0.0, 1.0)
    scored = scored_rows(learned)
    unseen = np.where(scored[:, None], np.nan, fit.linearisation.residual)
    run = replace(fit.linearisation, residual=unseen).filtered(
        learned.first, learned.step, fit.noise.scaled(correlated * random),
        begin_covariance=np.diag(np.ptp(fit.x, axis=0) ** 2), kept=True,
    )  # fmt: skip
    measured = fit.linearisation.measured
    return np.asarray(
        np.einsum("nmi,nij,nmj->nm", measured, run[7], measured)[scored].mean(axis=0) + fit.noise.measurement
    )
