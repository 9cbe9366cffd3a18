"""Trials: the candidates that promise most are fitted; how much do they explain in earnest?"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from siq.dynamics.dynamics import Dynamics
from siq.errors import NumericalFailure
from siq.estimation.budget import Budget, BudgetSpent
from siq.estimation.fit import Fit
from siq.estimation.jumps import sharpened
from siq.estimation.measurements import Measurements
from siq.estimation.process_noise import fit_with_process_noise_as_needed, least_to_believe
from siq.mismatch.building import MechanismCandidate
from siq.mismatch.on_top import rebased
from siq.mismatch.probes import Probe, with_further_states
from siq.mismatch.promises import screen_all
from siq.mismatch.screening import Screened
from siq.mismatch.tried import (
    BUDGET_SPENT,
    UNFORESEEN,
    TriedMechanism,
    UntriedMechanism,
    admissible,
    in_words,
    judged,
)

LOGGER = logging.getLogger(__name__)
PROMISING = 0.2  # of the best gain so far; a candidate that promises less is not fitted
RIVALS = 0.6  # of the best gain, from which on a candidate's jumps are sharpened: that gains up to a quarter


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
    best = best_probes(screened)
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
            failed[candidate.label] = UntriedMechanism(candidate, in_words(error))
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
            attempt(_with_shapes_on_top(probe, better, base_model, data, budget), result, better.fit)
    sharp = _with_jumps_followed(list(trials.values()), current, data, blocks=blocks, budget=budget)
    return sharp, [each for label, each in failed.items() if label not in trials]


def best_probes(
    screened: Sequence[tuple[Probe, Screened]],
) -> dict[str, tuple[Probe, Screened]]:
    """Of each candidate the probe that promises most, by label; none that promises nothing."""
    best: dict[str, tuple[Probe, Screened]] = {}
    for probe, result in screened:
        label = probe.candidate.label
        if result.gain > 0 and (label not in best or result.gain > best[label][1].gain):
            best[label] = (probe, result)
    return best


def _with_jumps_followed(
    trials: Sequence[TriedMechanism], current: Fit, data: Measurements, *, blocks: int, budget: Budget
) -> list[TriedMechanism]:
    """The same trials, those sharper whose f jumps and which rival the best."""
    most_gained = max((each.delta_chi2 for each in trials), default=0.0)
    result = []
    for trial in trials:
        better, label = trial, trial.candidate.label
        if trial.fit.model.edges and trial.delta_chi2 >= RIVALS * most_gained:
            try:
                budget.says(f"following the jumps of {label}")
                sharp = sharpened(trial.fit, data, budget=budget)
                better = judged(sharp, current, data, trial.candidate, blocks=blocks)
            except (*UNFORESEEN, BudgetSpent) as error:
                LOGGER.info("%s stays as sharp as it is: %s", label, error)
        result.append(better)
    return result


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
    x = with_further_states(
        probe, base_model, data, begin.x[:, : base_model.dimension],
        substeps=current.substeps, values=current.model.values,
    )  # fmt: skip
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


def _better_start(
    candidate: MechanismCandidate, trials: Mapping[str, TriedMechanism]
) -> TriedMechanism | None:
    """Where a candidate is begun once more: one that led nowhere, or to less than a special case of it."""
    own = trials.get(candidate.label)
    if own is None:
        rivals = list(trials.values())
    else:
        rivals = [
            each
            for each in trials.values()
            if _special_case(each.candidate, candidate) and each.delta_chi2 > own.delta_chi2
        ]
    return max(rivals, key=lambda each: each.delta_chi2) if rivals else None


def _special_case(one: MechanismCandidate, of: MechanismCandidate) -> bool:
    return one.name in of.generalises and one.equations == of.equations


def _with_shapes_on_top(
    probe: Probe, better: TriedMechanism, base_model: Dynamics, data: Measurements, budget: Budget
) -> Probe:
    """A candidate's probe with the shapes that promise most on top of a special case of it.

    Beside the simulation alone they may all promise the same: the special case. Where the fit is that of
    another mechanism, and where nothing can be screened, the shapes stay as they are.
    """
    candidate = probe.candidate
    if not (candidate.shapes and _special_case(better.candidate, candidate)):
        return probe
    on_top = replace(rebased(candidate, base_model, better.fit.model), positive=frozenset())
    screened, _ = screen_all(better.fit.model, data, better.fit, [on_top], budget=budget)
    if not screened:
        return probe
    best, _ = max(screened, key=lambda each: each[1].gain)
    values = [value for _, value in best.shapes]
    return replace(probe, shapes=tuple(zip(candidate.shapes, values, strict=True)))


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
