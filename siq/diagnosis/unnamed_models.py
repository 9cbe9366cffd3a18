"""Models of effects that have no name: smooth functions, formulas, products and memories, fitted and judged.

What explains the recordings best as a whole describes them, be it a function or a mechanism that was found
and is not certain enough for its name. At the likeliest places (`siq.diagnosis.terms`) a formula of a few
powers and a smooth curve are fitted in earnest. What a fit leaves says how smooth a function is, along the
trajectories of that fit; those with the function are better, and say it better, so that it is asked for
again. Functions of two coordinates are fitted where they are likelier than the likeliest of one, and where a
function leaves something there may be another. What mechanisms with a name leave is described on top of them.

A body that warms up, a store that fills, a prey that takes time to become a predator depend on a hidden state
that follows a coordinate late, ``z' = (x - z)/τ``, or that it makes ring, ``τ² z'' + kτ z' + z = x``. A
function of what is measured now can only imitate such a memory, mostly as one of the time. A memory describes
what is missing where it is likelier than any function.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import sympy

from siq.diagnosis.dictionary import Form, FurtherState, Mechanism, MechanismParameter, Role, Roles, Shape
from siq.diagnosis.evidence import NUMERICAL_ERRORS, FittedCandidate, log_evidences
from siq.diagnosis.holdout import simulated
from siq.diagnosis.mechanisms import FORMULA, MECHANISM, MechanismCandidate, candidates_of, coordinates_of
from siq.diagnosis.residual_structure import has_structure
from siq.diagnosis.screening import Ranked, screen_all
from siq.diagnosis.search import FitContext, Search, best_probes
from siq.diagnosis.smooth_functions import Smoothness
from siq.diagnosis.terms import FUNCTIONS_FITTED, ONE, Place, formula_in, rank_places
from siq.errors import NumericalFailure
from siq.inference.budget import Budget, BudgetSpent
from siq.inference.kalman_filter import substeps_needed
from siq.inference.maximum_likelihood import Fit
from siq.inference.measurements import Measurements
from siq.inference.recalibration import (
    fit_with_and_without_process_noise,
    fit_with_process_noise_as_needed,
    preferred_fit,
)
from siq.inference.trajectories import fit_trajectories, normalised_rms
from siq.systems.dynamics import Dynamics, symbol

LOGGER = logging.getLogger(__name__)
LARGEST_PART = 0.25  # of the work left, that a single fit may take: a choice
SMOOTH_ROUNDS = 4  # of fits, each along the trajectories of the one before: a choice
LEAST_GAIN = 1.0  # of a logarithm of odds, below which another round is not worth its time
DESCRIBED_MOST = 2  # functions that are put on top of each other: more are no description
# Times τ that are tried, in units of the time in which the coordinate changes; the best of them is then
# fitted. A much shorter memory cannot be told from none, nor a much longer one from a constant of each
# recording.
MEMORY_TIMES = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)
MEMORY_DAMPINGS = (0.1, 1.0)  # k of what rings, tried and then fitted: over many turns, and over hardly one
MEMORIES_FITTED = 6  # the most promising ones: a choice


@dataclass(frozen=True)
class AugmentedModel:
    """A simulation that describes what has no name."""

    parts: tuple[FittedCandidate, ...]  #: what was added, in the order in which it was found
    fit: Fit  #: of the simulation with all of it
    #: Over that of the simulation without its parts, less the costs of these; see `_weighed`.
    log_evidence: float = float("nan")
    #: The fit whose trajectories follow the equations, if process noise is part of `fit`.
    exact: Fit | None = None

    @property
    def cost(self) -> float:
        """Logarithm of how many combinations of parts this one was chosen among."""
        return sum(part.candidate.log_cost for part in self.parts)


def _weighed(models: Sequence[AugmentedModel], alone: Fit, data: Measurements) -> list[AugmentedModel]:
    """Models with their evidence over that of a simulation without their parts, the likeliest first."""
    without, *evidences = log_evidences([alone, *(each.fit for each in models)], data)
    known = [
        replace(each, log_evidence=evidence - each.cost - without)
        for each, evidence in zip(models, evidences, strict=True)
    ]
    return sorted(known, key=lambda each: -each.log_evidence)


def _runs_freely(fit: Fit, alone: Fit, data: Measurements) -> bool:
    """Whether a fit without process noise runs along the recordings, and nearer to them than one without it.

    A fit that holds on to every sample may not: where it is steeper than any step of an integration, it runs
    away from where it was held.
    """
    if fit.has_process_noise or alone.has_process_noise:
        return True
    # Steps twice as fine: what depends on them is no property of the simulation.
    one, other = (
        normalised_rms(simulated(each, data, noise=each.noise, substeps=2 * each.substeps), data)
        for each in (fit, alone)
    )
    return one is not None and (other is None or one < other)


def _fitted_term(
    candidate: MechanismCandidate, level: float, fit: Fit, context: FitContext, *, begin: Fit | None = None
) -> list[FittedCandidate]:
    """A function as part of a model, or nothing where it cannot be fitted."""
    kind, data, budget = candidate.kind, context.data, context.budget
    try:
        budget.says(f"a {kind}: {candidate.label}")
        with budget.part(LARGEST_PART):
            begun = fit if begin is None else begin
            new = candidate.new
            own = {each.name: each.value for each in candidate.model.parameters if each.name in new}
            model = candidate.begun(begun.model, own)
            if not begun.has_process_noise:  # a function that was nearly right may lead no further
                begun = replace(begun, noise=replace(begun.noise, process=fit.noise.process))
            trial = fit_with_process_noise_as_needed(model, data, begun, level=level, budget=budget)
            # A function may be steeper than the simulation, whose steps are then too long to follow it.
            needed = substeps_needed(trial.model, data, trial.model.values, trial.x)
            if trial.converged and needed > trial.substeps:
                finer = replace(trial, substeps=needed)
                trial = fit_with_process_noise_as_needed(trial.model, data, finer, budget=budget)
            forced = trial.has_process_noise or fit.has_process_noise
            if not forced and trial.log_likelihood < fit.log_likelihood:
                # Nothing added is as likely as that: steps of all samples at once have led away.
                damped = fit_trajectories(
                    model, data, begin=begun.x[data.first[:-1]],
                    noise=begun.noise.of_states(model.dimension), substeps=trial.substeps, budget=budget,
                )  # fmt: skip
                trial = preferred_fit(trial, damped)
            if not trial.converged:
                raise NumericalFailure(trial.fault or "its fit does not settle")
            return [FittedCandidate.of(trial, fit, data, candidate, blocks=context.study.search.blocks)]
    except (*NUMERICAL_ERRORS, BudgetSpent) as error:
        LOGGER.info("%s as a %s cannot be fitted: %s", candidate.label, kind, error)
        return []


def _asked(
    fit: Fit, data: Measurements, place: Place, *, known: FittedCandidate | None, alike: bool = False
) -> Smoothness | None:
    """See `Smoothness.of`; what is beyond all numbers ends a function, not a case."""
    try:
        return Smoothness.of(fit, data, place, known=known, alike=alike)
    except NUMERICAL_ERRORS as error:
        LOGGER.info("no function of %s can be worked out: %s", " and ".join(place.words), error)
        return None


def _with_smooth_term(
    before: tuple[FittedCandidate, ...], fit: Fit, place: Place, cost: float, context: FitContext, *,
    like: AugmentedModel | None = None, product: bool = False,
) -> list[AugmentedModel]:  # fmt: skip
    """The likeliest model with a smooth function in a place; none where none can be fitted."""
    data = context.data
    likeliest: AugmentedModel | None = None
    current, known = (fit, None) if like is None else (like.fit, like.parts[-1])
    for _ in range(SMOOTH_ROUNDS):
        asked = _asked(current, data, place, known=known)
        if asked is None:
            break
        price = cost + float(np.log(asked.considered))
        parts: list[FittedCandidate] = []
        # What promises to be rough and to need hardly any process noise may be what no fit can follow.
        for times, level in ((1.0, asked.level), (2.0, 1.0)):
            if parts:
                break
            try:
                function = asked.function(product=product, times=times)
            except NUMERICAL_ERRORS as error:
                LOGGER.info("no function of %s can be worked out: %s", " and ".join(place.words), error)
                break
            candidate = replace(function.added_to(fit.model), log_cost=price)
            parts = _fitted_term(candidate, level, fit, context, begin=current)
        if not parts:
            break
        found = AugmentedModel((*before, parts[0]), parts[0].fit)
        LOGGER.info(
            "%s, %d bumps: log-likelihood %.1f", candidate.label, function.width, found.fit.log_likelihood,
        )  # fmt: skip
        if likeliest is not None:
            new = {
                each.fit is found.fit: each.log_evidence for each in _weighed([likeliest, found], fit, data)
            }
            if new[True] < new[False] + LEAST_GAIN:
                break
        likeliest, current, known = found, found.fit, parts[0]
    return [] if likeliest is None else [likeliest]


def _with_surfaces(fit: Fit, models: Sequence[AugmentedModel], context: FitContext) -> list[AugmentedModel]:
    """Models with a smooth function of two coordinates, where the recordings tell both."""
    context.budget.says("comparing functions of two coordinates")
    data = context.data
    # Where functions of one coordinate are, or would be; not in a rotating frame, nor in a sensor.
    single = [each for each in models if len(each.parts) == 1]
    likely = [(each.parts[0].candidate.place, each) for each in single[:FUNCTIONS_FITTED]]
    begins: list[tuple[Place, AugmentedModel | None]] = [(at, one) for at, one in likely if at is not None]
    if not single:  # one of two may tell so little of either coordinate alone
        begins = [(each.term, None) for each in rank_places(fit, data, context.roles)[:FUNCTIONS_FITTED]]
    names = [name for name in coordinates_of(fit.model) if name != "t" and not name.startswith("_")]
    asked: list[tuple[float, Place, AugmentedModel | None]] = []
    done = set()
    for place, like in begins:
        if len(place.equations) != 1:
            continue
        current, known = (fit, None) if like is None else (like.fit, like.parts[-1])
        alone = 0.0
        if known is not None:
            one = _asked(current, data, place, known=known)
            alone = -np.inf if one is None else one.log_evidence
        for words in itertools.combinations(names, 2):  # a coordinate of the place, and any other
            if not set(words) & set(place.words) or (place.targets, words) in done:
                continue
            done.add((place.targets, words))
            pair = Place(((place.targets[0], ONE),), (), tuple(map(symbol, words)), words)
            both = _asked(current, data, pair, known=known, alike=True)
            if both is not None:
                asked.append((both.log_evidence - alone, pair, like))
    cost = float(np.log(max(len(asked), 1)))
    ranked = sorted((each for each in asked if each[0] > cost), key=lambda each: -each[0])
    price = max((part.candidate.log_cost for model in models for part in model.parts), default=0.0) + cost
    found: list[AugmentedModel] = []
    for _, pair, like in ranked[:FUNCTIONS_FITTED]:
        for product in (True, False):
            some = _with_smooth_term((), fit, pair, price, context, like=like, product=product)
            found += some
            if some and not has_structure(some[0].fit, data):
                return found  # nothing is left for a surface, nor for a less likely pair
    return found


def _with_function(
    before: tuple[FittedCandidate, ...], fit: Fit, context: FitContext
) -> list[AugmentedModel]:
    """Models with one function more on top of a fit, that earns it, the likeliest first.

    The evidence is that over the fit with what was added before.
    """
    data = context.data
    context.budget.says("comparing functions without a name")
    ranked = rank_places(fit, data, context.roles)
    cost = float(np.log(max(len(ranked), 1)))  # a function is chosen among so many places
    ranked = [each for each in ranked if each.gain > cost]
    if not ranked:
        return []
    models = _formulas(before, fit, ranked, cost, context)
    single = (each for each in ranked if len(each.term.words) == 1)
    # Along one recording coordinates go together, and the likeliest to first order may be the wrong one.
    likeliest = (*ranked[:FUNCTIONS_FITTED], *itertools.islice(single, FUNCTIONS_FITTED))
    chosen = {id(each): each for each in likeliest}
    for one in chosen.values():
        models += _with_smooth_term(before, fit, one.term, cost, context)
    given = sum(part.candidate.log_cost for part in before)
    found = [replace(each, log_evidence=each.log_evidence + given) for each in _weighed(models, fit, data)]
    for each in found:
        last = each.parts[-1]
        LOGGER.info(
            "%s as a %s: log-evidence better by %.1f",
            last.candidate.label, last.candidate.kind, each.log_evidence,
        )  # fmt: skip
    return [each for each in found if each.log_evidence > 0]


def _formulas(
    before: tuple[FittedCandidate, ...], fit: Fit, ranked: Sequence[Ranked[Place]], cost: float,
    context: FitContext,
) -> list[AugmentedModel]:  # fmt: skip
    """Formulas in the likeliest places, each once."""
    knots = {(each.term.targets, each.term.words): each.term.knots for each in ranked}
    done: set[frozenset[tuple[str, sympy.Expr]]] = set()
    models: list[AugmentedModel] = []
    for likely in ranked[:FUNCTIONS_FITTED]:
        candidate = formula_in(
            likely.term, fit, context.data, level=likely.level, degree=context.study.degree
        )
        if candidate is None or (place := candidate.place) is None:
            continue
        place = replace(place, knots=knots.get((place.targets, place.words), likely.term.knots))
        candidate = replace(candidate, place=place, log_cost=cost)
        # A sum of x²v and xv² is the same function, whichever coordinate comes first.
        if candidate.terms not in done:
            parts = _fitted_term(candidate, likely.level, fit, context)
            models += [AugmentedModel((*before, each), each.fit) for each in parts]
        done.add(candidate.terms)
    return models


def _memory_suspected(models: Sequence[AugmentedModel], data: Measurements) -> bool:
    """Whether models leave room for a memory: all but a function of one coordinate that leaves nothing.

    The time is no such coordinate, since nothing but the time itself knows it: what seems to depend on it may
    have been brought about before.
    """
    if not models:
        return True
    best = models[0]
    place = best.parts[0].candidate.place
    told = len(best.parts) == 1 and place is not None and len(place.words) == 1 and place.words[0] != "t"
    return not told or has_structure(best.fit, data)


def _with_memories(fit: Fit, models: Sequence[AugmentedModel], context: FitContext) -> list[AugmentedModel]:
    """Models with a hidden state that follows a coordinate late, or that it makes ring."""
    likely = {name for each in models for part in each.parts for name in part.candidate.equations}
    candidates = sorted(
        _memories_of(fit.model, context.roles), key=lambda each: not likely & set(each.equations)
    )
    if not candidates:
        return []
    cost = float(np.log(len(candidates)))
    # Nobody knows what the hidden state was when a recording began: what was there already, or nothing.
    begun = [
        each
        for one in candidates
        for each in (one, replace(one, begins=(sympy.Integer(0),) * len(one.begins)))
    ]
    with context.budget.part(LARGEST_PART):
        screened, _ = screen_all(context.data, fit, begun, budget=context.budget)
    found: list[AugmentedModel] = []
    ranked = sorted(best_probes(screened).values(), key=lambda each: -each.gain)
    for each in ranked[:MEMORIES_FITTED]:
        if each.gain < 2 * cost:
            break
        # Fitted from no effect on, with the τ that promises most.
        candidate = each.term.candidate
        begun_model = candidate.begun(candidate.model, dict(each.term.shapes))
        candidate = replace(candidate, model=begun_model, log_cost=cost)
        try:
            _, x = each.term.begin(fit, context.data, fit.x)
        except NUMERICAL_ERRORS as error:
            LOGGER.info("%s cannot be fitted: %s", candidate.label, error)
            continue
        for part in _fitted_term(candidate, each.level, fit, context, begin=replace(fit, x=x)):
            LOGGER.info("%s: chi2 better by %.1f", candidate.label, part.delta_chi2)
            if candidate.admits(part.fit, context.data):
                found.append(AugmentedModel((part,), part.fit))
    return found


def _memories_of(model: Dynamics, roles: Roles) -> list[MechanismCandidate]:
    """A memory of every coordinate in every equation that says more than a definition."""
    what = Mechanism(name="memory", sentence="What is missing follows a coordinate late.", forms=MEMORY_FORMS)
    found = []
    for each in candidates_of(model, roles, (what,)):
        name = f"a memory of {each.coordinate}"
        variant = f", {each.variant}" if each.variant else ""
        label = f"{name} in {', '.join(each.equations)}{variant}"
        found.append(replace(each, name=name, label=label, kind=FORMULA))
    return found


def _memory_forms() -> Iterator[Form]:
    """What follows a coordinate late acts as a force or as a rate at which the state grows; and what rings.

    In a rotating frame it is the intensity that is followed, which shifts the frequency, or damps.
    """

    def form(of: str, terms: dict[str, str], unit: str, variant: str = "", **changed: Any) -> Form:
        state = FurtherState(equation=f"({of} - z)/tau", begin=of, unit=changed.pop("own_unit", of), scale=of)
        parameters = {
            "c": MechanismParameter(unit=unit),
            "tau": MechanismParameter(sign="positive", unit="T", shape=Shape(time_of=of, at=MEMORY_TIMES)),
            **changed.pop("parameters", {}),
        }
        usual = {"states": {"z": state}, "coordinate": of} | changed
        return Form(terms=terms, parameters=parameters, variant=variant, **usual)

    pairs: tuple[dict[str, Role], ...] = (
        {"q": "state"}, {"x": "state", "q": "state"}, {"x": "position", "q": "state"},
        {"x": "input", "q": "state"},
    )  # fmt: skip
    for roles in pairs:
        of = next(iter(roles))
        yield form(of, {"q": "c*z"}, f"q/T/{of}", roles=roles)
        yield form(of, {"q": "c*z*q"}, f"1/T/{of}", "as a rate", roles=roles)
        ringing = {
            "z": FurtherState(equation="y", begin=of, unit=of, scale=of),
            "y": FurtherState(equation=f"({of} - z)/tau**2 - k*y/tau", unit=f"{of}/T", scale=of),
        }
        damping = MechanismParameter(sign="positive", shape=Shape(scale_of="1", at=MEMORY_DAMPINGS))
        yield form(
            of, {"q": "c*z"}, f"q/T/{of}", "that rings",
            roles=roles, states=ringing, parameters={"k": damping},
        )  # fmt: skip
    across, along = {"p": "c*z*q", "q": "-c*z*p"}, {"p": "c*z*p", "q": "c*z*q"}
    for terms, variant in ((across, "across the state"), (along, "along the state")):
        yield form(
            "p**2 + q**2", terms, "1/T/p**2", variant,
            roles={"p": "amplitude", "q": "amplitude"}, own_unit="p**2", coordinate="amplitude",
        )  # fmt: skip


MEMORY_FORMS = tuple(_memory_forms())


def fit_unnamed_models(
    search: Search, context: FitContext, *, most: int = DESCRIBED_MOST
) -> tuple[AugmentedModel, ...]:
    """Models of what is missing, the likeliest first; none where none is likelier than the simulation alone.

    Mechanisms that a search found are one of the models; at most so many functions stand on each other.
    """
    base, data = search.recalibrated, context.data
    models = _with_function((), base, context)
    if search.found and np.isfinite(search.fit.log_likelihood):
        models.append(AugmentedModel(_terms_of(search, context), search.fit))
    models = _weighed(models, base, data)
    models = _weighed([*models, *_with_surfaces(base, models, context)], base, data)
    if _memory_suspected(models, data):
        models = _weighed([*models, *_with_memories(base, models, context)], base, data)
    best = models[0] if models else None
    if (
        best is not None
        and best.fit.model.dimension == base.model.dimension
        and len(best.parts) < most
        and has_structure(best.fit, data)
    ):
        models += _with_function(best.parts, best.fit, context)
    return _likeliest(models, base, data)


def fit_models_of_remainder(named: Search, whole: Search, context: FitContext) -> tuple[AugmentedModel, ...]:
    """Models of what mechanisms with a name leave, the likeliest first; none where none is likelier.

    They are what was found on top of the names, not certain enough for one itself, and functions on top of
    all that was found.

    Parameters
    ----------
    named, whole
        The search with what is named, and with all that was found.
    context
        What models are made from.
    """
    base, data = named.fit, context.data

    def on_top(parts: tuple[FittedCandidate, ...], fit: Fit) -> list[AugmentedModel]:
        return _with_function(parts, fit, context) if has_structure(fit, data) else []

    parts = _terms_of(whole, context)[len(named.found) :]
    fits = [each.best.fit for each in whole.found[len(named.found) :]]
    models = [AugmentedModel(parts[: place + 1], fit) for place, fit in enumerate(fits)]
    models += on_top(parts, whole.fit if parts else base)
    names = [each.best.candidate for each in named.found]
    allowed = [
        each
        for each in models
        if np.isfinite(each.fit.log_likelihood) and all(name.admits(each.fit, data) for name in names)
    ]
    return _likeliest(allowed, base, data)


def _terms_of(search: Search, context: FitContext) -> tuple[FittedCandidate, ...]:
    """The mechanisms of a search as parts of a model, each chosen among all that were considered."""
    cost = float(np.log(max(len(context.candidates), 1)))
    return tuple(
        replace(each.best, candidate=replace(each.best.candidate, log_cost=cost)) for each in search.found
    )


def exact_fit(fit: Fit, data: Measurements, budget: Budget | None = None) -> Fit | None:
    """Estimates of least squares, where process noise is part of a fit; None where they do not settle."""
    if not fit.has_process_noise:
        return None
    still = replace(fit, noise=fit.noise.without_process())
    _, exact = fit_with_and_without_process_noise(fit.model, data, still, budget=budget)
    return exact if exact.converged else None


def _likeliest(
    models: Sequence[AugmentedModel], alone: Fit, data: Measurements
) -> tuple[AugmentedModel, ...]:
    """The few models that are likelier than the simulation without them, the likeliest first."""
    likelier = (
        each
        for each in _weighed(models, alone, data)
        if each.log_evidence > 0 and _runs_freely(each.fit, alone, data)
    )
    known = list(likelier)
    # What a search named or nearly named stays, even where several functions without a name are likelier.
    chosen = known[:FUNCTIONS_FITTED] + [
        each
        for each in known[FUNCTIONS_FITTED:]
        if all(part.candidate.kind == MECHANISM for part in each.parts)
    ]
    return tuple(replace(each, exact=exact_fit(each.fit, data)) for each in chosen)
