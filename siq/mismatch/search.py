"""The search for what is missing: recalibrate, screen, fit the best, accept only what stands every test.

Mechanisms are added one at a time. A candidate counts as found when white errors, errors clustered by
recording, and the Bayesian information criterion all say so; what cannot be told from the best is kept as its
class of indistinguishables.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
import scipy.stats
import sympy
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass as checked

from siq.mismatch.candidates import Candidate
from siq.mismatch.estimation import Fit, fit, whiten
from siq.mismatch.linearisation import Grid, spread_edges
from siq.mismatch.measurements import Measurements
from siq.mismatch.model import Model, symbol
from siq.mismatch.probes import Probe, ProbeColumns, probes_of
from siq.mismatch.roles import roles_of
from siq.mismatch.screening import Screened, cluster_test, probe_response, screen
from siq.mismatch.structure import structure_of

LOGGER = logging.getLogger(__name__)
PROBE_SUBSTEPS = 2  # what a little of a mechanism does need not be known to many digits
LEFT = 0.01  # probability that residuals are random, above which no further mechanism is sought
PROMISING = 0.2  # of the best gain so far; a candidate that promises less is not fitted
EDGE_SUBSTEPS = 12  # between samples, for models whose f jumps


@checked(frozen=True, config=ConfigDict(extra="forbid"))
class SearchOptions:
    """What counts as found.

    Attributes
    ----------
    false_alarms
        Probability of a mechanism where none is missing, over all candidates together, for each test.
    same
        Candidates whose χ² is within this of the best are indistinguishable from it.
    fitted
        Most candidates that are fitted after each screening.
    mechanisms
        Most mechanisms that are looked for.
    blocks
        Blocks into which recordings are cut for clustered errors, where there are fewer recordings.
    """

    false_alarms: Annotated[float, Field(gt=0, lt=1)] = 0.002
    same: Annotated[float, Field(gt=0)] = 10.0
    fitted: Annotated[int, Field(ge=1)] = 6
    mechanisms: Annotated[int, Field(ge=1, le=5)] = 2
    blocks: Annotated[int, Field(ge=4)] = 10


@dataclass(frozen=True)
class Trial:
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

    candidate: Candidate
    fit: Fit
    delta_chi2: float
    delta_bic: float
    p_white: float
    p_cluster: float


@dataclass(frozen=True)
class Found:
    """A mechanism that stood the tests, and what cannot be told from it."""

    best: Trial
    indistinguishable: tuple[Trial, ...]


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
    """

    recalibrated: Fit
    found: tuple[Found, ...]
    fit: Fit
    screened: tuple[tuple[Probe, Screened], ...]


def best_fit(
    model: Model, data: Measurements, begin: Fit, *, level: float = 1.0, x: np.ndarray | None = None
) -> Fit:
    """Fit with process noise estimated, and without; the simpler unless the data speak against it."""
    return simpler(*both_fits(model, data, begin, level=level, x=x))


def simpler(loose: Fit | None, strict: Fit) -> Fit:
    """The fit without process noise, unless the data speak against it."""
    return strict if loose is None or not process_noise_needed(loose, strict) else loose


def both_fits(
    model: Model, data: Measurements, begin: Fit, *, level: float = 1.0, x: np.ndarray | None = None
) -> tuple[Fit | None, Fit]:
    """Fit with process noise estimated, where that was begun with, and without.

    Parameters
    ----------
    model
        With the parameters' values to begin with.
    data
        The recordings.
    begin
        A fit whose states and noise are begun with.
    level
        Factor on its process noise.
    x
        States, where the model has more of them.
    """
    states = begin.x if x is None else x
    substeps = begin.substeps
    if any("sign(" in str(formula) for formula in model.equations):
        substeps = max(substeps, EDGE_SUBSTEPS)
        model = spread_edges(model, data, states, substeps=substeps)
    noise = begin.noise
    if len(noise.process) < model.dimension:  # what a mechanism brings is driven by no noise of its own
        noise = replace(
            noise, process=np.append(noise.process, np.zeros(model.dimension - len(noise.process)))
        )
    if noise.process.any():
        loose = fit(
            model,
            data,
            x=states,
            noise=noise.scaled(max(level, 1e-6)),
            estimate_process=True,
            substeps=substeps,
        )
    else:
        loose = None
    start = loose if loose is not None and loose.converged else None
    strict = fit(
        model if start is None else start.model,
        data,
        x=states if start is None else start.x,
        noise=(noise if start is None else start.noise).without_process(),
        estimate_process=False,
        substeps=substeps,
    )
    return loose, strict


def process_noise_needed(loose: Fit, strict: Fit, *, threshold: float = 1e-4) -> bool:
    """Whether the likelihood ratio speaks for process noise; its null distribution has half its mass at 0."""
    if not strict.converged:
        return True
    ratio = max(2 * (loose.log_likelihood - strict.log_likelihood), 0.0)
    driven = int((loose.noise.process > 0).sum())
    return driven > 0 and 0.5 * scipy.stats.chi2.sf(ratio, max(driven, 1)) < threshold


def search(
    model: Model,
    data: Measurements,
    recalibrated: Fit,
    candidates: Sequence[Candidate],
    *,
    options: SearchOptions,
) -> Search:
    """Look for mechanisms, one after the other."""
    current = recalibrated
    found: list[Found] = []
    base_model = recalibrated.model
    remaining = list(candidates)
    screened: list[tuple[Probe, Screened]] = []
    while True:
        if found and (len(found) == options.mechanisms or not _something_left(base_model, data, current)):
            break
        screened = screen_all(base_model, data, current, remaining)
        trials = _fit_best(data, current, base_model, screened, options=options)
        for trial in trials:
            LOGGER.info(
                "%s: chi2 better by %.1f, BIC %.1f, p %.1e white, %.1e clustered",
                trial.candidate.label, trial.delta_chi2, trial.delta_bic, trial.p_white, trial.p_cluster,
            )  # fmt: skip
        accepted = _accepted(trials, len(remaining), len(screened), options=options)
        if accepted is None:
            break
        LOGGER.info("found %s, chi2 better by %.1f", accepted.best.candidate.label, accepted.best.delta_chi2)
        found.append(accepted)
        current = accepted.best.fit
        base_model = current.model
        if base_model.dimension > model.dimension:
            break  # nothing is sought on top of a mechanism that has states of its own
        remaining = [
            rebased
            for each in candidates
            if each.label != accepted.best.candidate.label
            and (rebased := _rebased(each, model, base_model)) is not None
        ]
    return Search(recalibrated=recalibrated, found=tuple(found), fit=current, screened=tuple(screened))


def _something_left(model: Model, data: Measurements, current: Fit) -> bool:
    """Whether it is worth looking for another mechanism."""
    return current.has_process_noise or structure_of(model, data, current, roles_of(model)).p_value < LEFT


def screen_all(
    model: Model, data: Measurements, current: Fit, candidates: Sequence[Candidate]
) -> list[tuple[Probe, Screened]]:
    """Screen every candidate, with its shapes at all places where they are looked for."""
    substeps = current.substeps
    probes = []
    for candidate in candidates:
        spread = replace(
            candidate,
            model=spread_edges(candidate.model, data, current.x, substeps=max(substeps, EDGE_SUBSTEPS)),
        )
        probes += probes_of(spread, data, model, current.x)
    if not probes:
        return []
    grid = Grid(data, min(substeps, PROBE_SUBSTEPS))
    columns = ProbeColumns(model, grid, probes, current.x, current.model.values)
    response = probe_response(model, grid, current, columns)
    ends = np.cumsum([probe.width for probe in probes])
    groups = [slice(end - probe.width, end) for probe, end in zip(probes, ends, strict=True)]
    positive = [
        np.array([name in probe.candidate.positive for name in probe.candidate.amplitudes] or [True])
        for probe in probes
    ]
    return list(zip(probes, screen(response, data, current, groups, positive=positive), strict=True))


def evidence(
    trial: Fit, before: Fit, data: Measurements, candidate: Candidate, *, blocks: int
) -> tuple[float, float, float, float]:
    """Δχ², ΔBIC and the two probabilities of chance, of a candidate's fit over the fit without it."""
    extra = len(trial.model.free) - len(before.model.free)
    gained = 2 * (trial.log_likelihood - before.log_likelihood)
    count = trial.degrees_of_freedom + len(trial.model.free)
    white = whiten(trial.linearisation, data, trial.noise)
    names = [trial.model.parameters[place].name for place in trial.model.free]
    tested = [names.index(name) for name in (candidate.amplitudes or candidate.shapes)]
    values = trial.model.values[[trial.model.free[place] for place in tested]]
    return (
        gained,
        -gained + extra * np.log(count),
        float(scipy.stats.chi2.sf(max(gained, 0.0), extra)),
        cluster_test(white, tested, values, blocks=blocks_of(data, white.recording, most=blocks)),
    )


def blocks_of(data: Measurements, recording: np.ndarray, *, most: int) -> np.ndarray:
    """Blocks for clustered errors: recordings, or parts of them where there are fewer than `most`."""
    count = len(data.labels)
    if count >= most // 2:
        return recording
    parts = -(-most // count)
    block = np.empty(len(recording), dtype=int)
    for place in range(count):
        rows = np.flatnonzero(recording == place)
        block[rows] = place * parts + (np.arange(len(rows)) * parts) // max(len(rows), 1)
    return block


def _fit_best(
    data: Measurements,
    current: Fit,
    base_model: Model,
    screened: Sequence[tuple[Probe, Screened]],
    *,
    options: SearchOptions,
) -> list[Trial]:
    """Fit the candidates that promise most, each from its best probe."""
    best: dict[str, tuple[Probe, Screened]] = {}
    for probe, result in screened:
        label = probe.candidate.label
        if result.gain > 0 and (label not in best or result.gain > best[label][1].gain):
            best[label] = (probe, result)
    ranked = sorted(best.values(), key=lambda each: -each[1].gain)
    trials: list[Trial] = []
    for probe, result in ranked[: options.fitted]:
        # Against what fits have gained, not against what screening foresaw of one that gained nothing.
        gained = max((each.delta_chi2 for each in trials), default=0.0)
        if result.gain < max(options.same, PROMISING * gained):
            break
        model = with_start(probe, result, base_model)
        x = current.x
        if probe.candidate.scales:
            grid = Grid(data, current.substeps)
            own = ProbeColumns(base_model, grid, [probe], x, current.model.values)
            x = np.concatenate([x, own.further_states(0)], axis=1)
        trial = best_fit(model, data, current, level=result.level, x=x)
        if not trial.converged or not _admissible(trial, probe.candidate):
            continue
        candidate = probe.candidate
        trials.append(
            Trial(candidate, trial, *evidence(trial, current, data, candidate, blocks=options.blocks))
        )
    return trials


def with_start(probe: Probe, result: Screened, base: Model) -> Model:
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


def _accepted(
    trials: Sequence[Trial], candidates: int, probes: int, *, options: SearchOptions
) -> Found | None:
    significant = [
        trial
        for trial in trials
        if trial.p_white < options.false_alarms / max(probes, 1)
        and trial.p_cluster < options.false_alarms * 5 / max(candidates, 1)
        and trial.delta_bic < 0
    ]
    if not significant:
        return None
    best = min(significant, key=lambda each: each.delta_bic)
    alternatives = tuple(
        other
        for other in trials
        if other is not best
        and best.delta_chi2 - other.delta_chi2 < options.same
        and not _needless(other, best)
    )
    return Found(best, alternatives)


def _needless(other: Trial, best: Trial) -> bool:
    """Whether an alternative needs more parameters than the best, and does not earn them.

    One that fits better by as much as its further parameters would bring by chance twice over (Akaike) is not
    ruled out, although the simpler is preferred (Bayes).
    """
    more = len(other.candidate.new) - len(best.candidate.new)
    return more > 0 and other.delta_chi2 - best.delta_chi2 < 2 * more


def _admissible(trial: Fit, candidate: Candidate) -> bool:
    names = [trial.model.parameters[place].name for place in trial.model.free]
    for name in candidate.positive:
        if name in names:
            place = names.index(name)
            value = trial.model.values[trial.model.free[place]]
            if value < -2 * trial.standard_errors[place]:
                return False
    return True


def _rebased(candidate: Candidate, before: Model, now: Model) -> Candidate | None:
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
