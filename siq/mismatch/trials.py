"""Trials: the candidates that promise most, screened and then fitted, each with its evidence."""

from __future__ import annotations

import logging
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.stats

from siq.dynamics.dynamics import Dynamics
from siq.errors import NumericalFailure
from siq.estimation.budget import Budget, BudgetSpent, evaluation
from siq.estimation.estimation import Fit
from siq.estimation.jumps import EDGE_SUBSTEPS, sharpened, spread_edges
from siq.estimation.linearisation import Grid
from siq.estimation.measurements import Measurements
from siq.estimation.process_noise import fit_with_process_noise_as_needed, least_to_believe
from siq.mismatch.candidates import MechanismCandidate
from siq.mismatch.clusters import probability_by_chance
from siq.mismatch.probes import Probe, ProbeColumns, probes_of
from siq.mismatch.screening import Screened, in_portions, probe_response, screen

LOGGER = logging.getLogger(__name__)
PROBE_SUBSTEPS = 2  # what a little of a mechanism does need not be known to many digits
PROMISING = 0.2  # of the best gain so far; a candidate that promises less is not fitted
UNFORESEEN = (ArithmeticError, ValueError, np.linalg.LinAlgError)
"""What ends a candidate, never the search: an overflow, a division by zero, a singular matrix."""
OVERFLOWS = "its effect along the recorded motion is beyond all numbers"
BUDGET_SPENT = "the budget was spent before it was tried"
LARGEST_PORTION = (
    20_000_000  # numbers that are worked out at once in a screening: with copies about a gigabyte
)
LEAST_PORTION = 10  # columns
RIVALS = 0.6  # of the best gain, from which on a candidate's jumps are sharpened: that gains up to a quarter


@dataclass(frozen=True)
class TriedMechanism:
    """A candidate, fitted.

    Attributes
    ----------
    candidate
        The mechanism.
    fit
        Of the simulation with it.
    delta_chi2
        Twice the increase of the log-likelihood over the simulation without it.
    delta_bic
        Change of the Bayesian information criterion; negative where the mechanism is worth its parameters.
    p_white, p_cluster
        Probabilities of as much by chance.
    """

    candidate: MechanismCandidate
    fit: Fit
    delta_chi2: float
    delta_bic: float
    p_white: float
    p_cluster: float


@dataclass(frozen=True)
class UntriedMechanism:
    """A candidate that promised something, and whose fit gave nothing that could be judged.

    Attributes
    ----------
    candidate
        The mechanism.
    reason
        Why, in words.
    """

    candidate: MechanismCandidate
    reason: str


def screen_all(
    model: Dynamics,
    data: Measurements,
    current: Fit,
    candidates: Sequence[MechanismCandidate],
    *,
    fruitless: Collection[str] = (),
    budget: Budget | None = None,
) -> tuple[list[tuple[Probe, Screened]], list[UntriedMechanism]]:
    """Screen every candidate, with its shapes at all places where they are looked for.

    One whose shape the recordings themselves show promises as much as the best, unless it was fitted before
    and gained nothing: see `Probe.recorded`.

    Parameters
    ----------
    model, data, current
        The simulation, the recordings, and the fit that is to be improved.
    candidates
        What may be missing.
    fruitless
        Labels of those that gained nothing when they were fitted.
    budget
        Charged for the work; what it does not reach is not screened.

    Returns
    -------
    list of (Probe, Screened), list of UntriedMechanism
        What each probe would gain; and candidates of which no probe could be screened, with the reason.
    """
    budget = budget or Budget()
    substeps = current.substeps
    untried: dict[str, UntriedMechanism] = {}
    probes = []
    for candidate in candidates:
        try:
            sharp = max(substeps, EDGE_SUBSTEPS)
            spread = replace(candidate, model=spread_edges(candidate.model, data, current.x, substeps=sharp))
            probes += probes_of(spread, data, model, current.x)
        except UNFORESEEN as error:
            untried[candidate.label] = UntriedMechanism(candidate, _in_words(error))
    grid = Grid(data, min(substeps, PROBE_SUBSTEPS))
    screened: list[tuple[Probe, Screened]] = []
    for portion in in_portions([probe.width for probe in probes], model, data):
        some = probes[portion]
        columns = sum(probe.width for probe in some)
        try:
            budget.says(f"screening {len(candidates)} candidates")
            budget.charge(grid.substeps * evaluation(model, data, columns=columns))
            screened += _screened(model, data, current, grid, some)
        except BudgetSpent:
            break
        except UNFORESEEN as error:
            for probe in some:
                reason = _in_words(error)
                untried[probe.candidate.label] = UntriedMechanism(probe.candidate, reason)
    most = max((result.gain for _, result in screened), default=0.0)
    screened = [
        (probe, replace(result, gain=max(most, result.gain)))
        if probe.recorded and result.finite and probe.candidate.label not in fruitless
        else (probe, result)
        for probe, result in screened
    ]
    finite = {probe.candidate.label for probe, result in screened if result.finite}
    seen = {probe.candidate.label for probe, _ in screened}
    for candidate in (probe.candidate for probe in probes):  # some have no place where they could be
        if candidate.label not in finite:
            why = OVERFLOWS if candidate.label in seen else BUDGET_SPENT
            untried.setdefault(candidate.label, UntriedMechanism(candidate, why))
    return screened, [each for label, each in untried.items() if label not in finite]


def _screened(
    model: Dynamics, data: Measurements, current: Fit, grid: Grid, probes: Sequence[Probe]
) -> list[tuple[Probe, Screened]]:
    columns = ProbeColumns(model, grid, probes, current.x, current.model.values)
    response = probe_response(model, grid, current, columns)
    ends = np.cumsum([probe.width for probe in probes])
    groups = [slice(end - probe.width, end) for probe, end in zip(probes, ends, strict=True)]
    positive = [
        np.array([name in probe.candidate.positive for name in probe.candidate.amplitudes] or [True])
        for probe in probes
    ]
    return list(zip(probes, screen(response, data, current, groups, positive=positive), strict=True))


def fit_most_promising(
    data: Measurements,
    current: Fit,
    base_model: Dynamics,
    screened: Sequence[tuple[Probe, Screened]],
    *,
    most: int,
    least_gain: float,
    blocks: int,
    budget: Budget | None = None,
) -> tuple[list[TriedMechanism], list[UntriedMechanism]]:
    """Fit the candidates that promise most, each from its best probe.

    Parameters
    ----------
    data
        The recordings.
    current, base_model
        The fit that is to be improved, and its model.
    screened
        Every probe with what it would gain.
    most
        So many candidates at most, but for rivals of the best.
    least_gain
        Twice the increase of the log-likelihood that a candidate must promise.
    blocks
        For clustered errors; see `siq.mismatch.clusters.probability_by_chance`.
    budget
        Charged for the work; what it does not reach is not fitted.

    Returns
    -------
    list of TriedMechanism, list of UntriedMechanism
        Those whose fit settled, with signs that their mechanism allows; and the others, with the reason.
    """
    budget = budget or Budget()
    best: dict[str, tuple[Probe, Screened]] = {}
    for probe, result in screened:
        label = probe.candidate.label
        if result.gain > 0 and (label not in best or result.gain > best[label][1].gain):
            best[label] = (probe, result)
    ranked = sorted(best.values(), key=lambda each: -each[1].gain)
    trials: dict[str, TriedMechanism] = {}
    failed: dict[str, UntriedMechanism] = {}
    begun: list[tuple[Probe, Screened]] = []

    def attempt(probe: Probe, result: Screened, begin: Fit) -> None:
        candidate = probe.candidate
        try:
            trial = _tried(probe, result, begin, current, base_model, data, blocks=blocks, budget=budget)
        except BudgetSpent:
            failed.setdefault(candidate.label, UntriedMechanism(candidate, BUDGET_SPENT))
            return
        except UNFORESEEN as error:
            LOGGER.info("%s cannot be fitted: %s", candidate.label, error)
            failed[candidate.label] = UntriedMechanism(candidate, _in_words(error))
            return
        known = trials.get(candidate.label)
        if known is None or trial.fit.log_likelihood > known.fit.log_likelihood:
            trials[candidate.label] = trial

    # What the recordings themselves show is fitted beside the others, and in the place of none of them.
    most_promised = ranked[0][1].gain if ranked else 0.0
    shown = sum(probe.recorded and result.gain >= most_promised for probe, result in ranked)
    for place, (probe, result) in enumerate(ranked[: shown + 2 * most], start=-shown):
        # Against what screening foresaw of those that did gain it: some promise much and gain nothing, and
        # of others the first order shows little.
        gained = max((min(each.delta_chi2, best[name][1].gain) for name, each in trials.items()), default=0.0)
        if result.gain < max(least_gain, PROMISING * gained):
            break
        if place >= most and result.gain < gained - least_gain:
            break  # no rival of the best, which the class of indistinguishables must have
        begun.append((probe, result))
        budget.says(
            f"candidate {place + shown + 1} of at most {min(shown + 2 * most, len(ranked))}:"
            f" {probe.candidate.label}"
        )
        attempt(probe, result, current)
    for probe, result in begun:
        better = _better_start(probe.candidate, trials)
        if better is not None:
            budget.says(f"once more: {probe.candidate.label}")
            attempt(probe, result, better)
    most_gained = max((each.delta_chi2 for each in trials.values()), default=0.0)
    for label, trial in trials.items():
        if trial.fit.model.edges and trial.delta_chi2 >= RIVALS * most_gained:
            try:
                budget.says(f"following the jumps of {label}")
                sharp = sharpened(trial.fit, data, budget=budget)
                trials[label] = judged(sharp, current, data, trial.candidate, blocks=blocks)
            except (*UNFORESEEN, BudgetSpent) as error:
                LOGGER.info("%s stays as sharp as it is: %s", label, error)
    return list(trials.values()), [each for label, each in failed.items() if label not in trials]


def _tried(
    probe: Probe,
    result: Screened,
    begin: Fit,
    current: Fit,
    base_model: Dynamics,
    data: Measurements,
    *,
    blocks: int,
    budget: Budget,
) -> TriedMechanism:
    """A probe's candidate, fitted from a fit and judged.

    Raises
    ------
    NumericalFailure
        When the fit has no result, does not settle, or has a sign that the mechanism does not allow.
    BudgetSpent
        When nothing is left of what is allowed.
    """
    candidate = probe.candidate
    x = begin.x[:, : base_model.dimension]
    if candidate.scales:
        own = ProbeColumns(base_model, Grid(data, current.substeps), [probe], x, current.model.values)
        x = np.concatenate([x, own.further_states(0)], axis=1)
    start = with_start(probe, result, begin.model)
    trial = fit_with_process_noise_as_needed(start, data, begin, level=result.level, x=x, budget=budget)
    if not trial.converged:
        raise NumericalFailure(trial.fault or "its fit does not settle")
    # With no effect it would be what it is compared with, but for random forces that are not believed.
    if 2 * (current.log_likelihood - trial.log_likelihood) > least_to_believe(current.noise):
        raise NumericalFailure("its fit leads away, to less than without it")
    if not admissible(trial, candidate):
        raise NumericalFailure("its best parameters have a sign that the mechanism cannot have")
    return judged(trial, current, data, candidate, blocks=blocks)


def _in_words(error: Exception) -> str:
    return str(error) if isinstance(error, NumericalFailure) else f"{type(error).__name__}: {error}"


def _better_start(candidate: MechanismCandidate, trials: Mapping[str, TriedMechanism]) -> Fit | None:
    """Where a candidate is begun once more: one that led nowhere, or to less than a special case of it."""
    own = trials.get(candidate.label)
    if own is None:
        rivals = list(trials.values())
    else:
        rivals = [
            each
            for each in trials.values()
            if each.candidate.name in candidate.generalises
            and each.candidate.equations == candidate.equations
            and each.delta_chi2 > own.delta_chi2
        ]
    return max(rivals, key=lambda each: each.delta_chi2).fit if rivals else None


def with_start(probe: Probe, result: Screened, base: Dynamics) -> Dynamics:
    """The candidate's model with parameters to begin with: those of the base, and no effect yet.

    What screening found of the amplitudes is a start only where shapes need one: linearised amplitudes can be
    far off, and a fit that begins there may diverge.
    """
    candidate = probe.candidate
    known = {parameter.name: parameter.value for parameter in base.parameters}
    known |= dict.fromkeys(candidate.amplitudes, 0.0) | dict(probe.shapes)
    if candidate.amplitudes and candidate.shapes:
        known |= dict(zip(candidate.amplitudes, map(float, result.amplitudes), strict=True))
    return candidate.model.with_values(np.array([known[each.name] for each in candidate.model.parameters]))


def judged(
    trial: Fit, before: Fit, data: Measurements, candidate: MechanismCandidate, *, blocks: int
) -> TriedMechanism:
    """A candidate's fit with its evidence over the fit without it."""
    extra = len(trial.model.free) - len(before.model.free)
    gained = 2 * (trial.log_likelihood - before.log_likelihood)
    count = trial.degrees_of_freedom + len(trial.model.free)
    return TriedMechanism(
        candidate=candidate,
        fit=trial,
        delta_chi2=gained,
        delta_bic=-gained + extra * np.log(count),
        p_white=float(scipy.stats.chi2.sf(max(gained, 0.0), extra)),
        p_cluster=probability_by_chance(trial, before, data, candidate, blocks=blocks),
    )


def admissible(trial: Fit, candidate: MechanismCandidate) -> bool:
    """Whether parameters that a mechanism allows one sign only have it, or are zero within their errors."""
    names = [trial.model.parameters[place].name for place in trial.model.free]
    for name in candidate.positive:
        if name in names:
            place = names.index(name)
            value = trial.model.values[trial.model.free[place]]
            if value < -2 * trial.standard_errors[place]:
                return False
    return True
