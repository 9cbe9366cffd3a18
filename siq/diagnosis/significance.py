"""Significance of a gain in likelihood, whatever errors within a recording are like.

White errors are those of a perfect simulation. Of one that lacks more than the mechanism in question, errors
hang together over a whole recording; only recordings, or blocks that are long compared with the correlations,
count as independent.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.stats

from siq.diagnosis.mechanisms import MechanismCandidate
from siq.errors import NumericalFailure
from siq.inference.kalman_filter import solve, whiten
from siq.inference.maximum_likelihood import Fit
from siq.inference.measurements import Measurements

LONG = 4.0  # correlation times in a block
CHANCE = 1.96  # standard deviations of an autocorrelation of white errors, which are 1/√n


def probability_by_chance(
    fit: Fit, before: Fit, data: Measurements, candidate: MechanismCandidate, *, blocks: int
) -> float:
    """Probability of a mechanism by chance, where errors of a recording hang together.

    Among many recordings each counts as one (`clustered_probability`). Of a few, blocks are too few to know a
    covariance from them; how long errors hang together is known all the same (`correlated_probability`).

    Parameters
    ----------
    fit, before
        With the mechanism and without it.
    data, candidate
        The recordings, and the mechanism.
    blocks
        Where there are fewer recordings than half of it, they are few.
    """
    if len(data.labels) >= blocks // 2 or fit.has_process_noise or before.has_process_noise:
        return clustered_probability(fit, data, candidate, blocks=blocks)
    gained = 2 * (fit.log_likelihood - before.log_likelihood)
    return correlated_probability(fit, data, candidate, gained=gained)


def correlated_probability(
    fit: Fit, data: Measurements, candidate: MechanismCandidate, *, gained: float
) -> float:
    """Probability by chance of a gain in likelihood, for errors that are correlated over time.

    Of n errors with an integral correlation time τ, n/τ are independent, and so much less does twice the
    logarithm of a ratio of likelihoods weigh. Places at which a shape was looked for are chances, too.

    Parameters
    ----------
    fit
        With the mechanism; it tells τ.
    data, candidate
        The recordings, and the mechanism.
    gained
        Twice the increase of the log-likelihood.
    """
    white = whiten(fit.linearisation, data, fit.noise)
    change, _ = solve(white.columns, white.innovations)
    left = white.innovations - white.columns @ change
    weights = np.bincount(white.recording)
    times = [correlation_time(left[white.recording == place]) for place in range(len(weights))]
    together = float(np.average(times, weights=weights))
    places = [each.frequencies or len(each.at) for each in candidate.searches]
    alone = float(scipy.stats.chi2.sf(max(gained, 0.0) / together, max(len(candidate.new), 1)))
    return min(1.0, float(np.prod(places)) * alone)


def clustered_probability(
    fit: Fit, data: Measurements, candidate: MechanismCandidate, *, blocks: int
) -> float:
    """Probability of a mechanism by chance, whatever errors within a recording are like.

    Where there are fewer recordings than half of `blocks` they are cut into at least that many, of several
    correlation times each.
    """
    white = whiten(fit.linearisation, data, fit.noise)
    names = [fit.model.parameters[place].name for place in fit.model.free]
    tested = [names.index(name) for name in (candidate.amplitudes or candidate.shapes)]
    values = fit.model.values[[fit.model.free[place] for place in tested]]
    change, _ = solve(white.columns, white.innovations)
    left = white.innovations - white.columns @ change
    owner = white.recording
    if len(data.labels) < blocks // 2:
        owner = blocks_of(owner, left, least=blocks)
    return cluster_test(white.columns, left, tested, values + change[tested], blocks=owner)


def blocks_of(recording: np.ndarray, left: np.ndarray, *, least: int) -> np.ndarray:
    """The block of each residual, numbered from 0, where recordings are cut into at least so many."""
    recordings = np.unique(recording)
    block = np.empty(len(recording), dtype=int)
    begun = 0
    for place in recordings:
        rows = np.flatnonzero(recording == place)
        parts = max(-(-least // len(recordings)), int(len(rows) / (LONG * correlation_time(left[rows]))))
        block[rows] = begun + (np.arange(len(rows)) * parts) // len(rows)
        begun += parts
    return block


def correlation_time(series: np.ndarray) -> float:
    """Integral correlation time in samples: one and twice the autocorrelations up to the first negative."""
    power = float(series @ series)
    total = 1.0
    for lag in range(1, len(series) // 4):
        correlation = float(series[lag:] @ series[:-lag]) / power if power > 0 else 0.0
        if correlation <= 0:
            break
        total += 2 * correlation
    return total


def correlation_time_of(left: np.ndarray, recording: np.ndarray, *, outputs: int) -> float:
    """Integral correlation time of all residuals in samples, at least 1; of white ones it is 1.

    Autocorrelations are means over recordings and outputs. The sum ends at the first that white errors would
    have by chance, so that noise does not lengthen it. Of n residuals, n over it count as independent.

    Parameters
    ----------
    left, recording
        Residuals, the outputs of a sample one behind the other, and the recording of each; shape ``(n·m,)``.
    outputs
        Their number m.
    """
    series = left.reshape(-1, outputs)
    owner = recording.reshape(-1, outputs)[:, 0]
    power = float((series**2).mean())
    total = 1.0
    for lag in range(1, len(series) // 4):
        same = owner[lag:] == owner[:-lag]
        pairs = int(same.sum()) * outputs
        if not pairs or power <= 0:
            break
        correlation = float((series[lag:] * series[:-lag])[same].sum()) / pairs / power
        if correlation <= CHANCE / np.sqrt(pairs):
            break
        total += 2 * correlation
    return total


def cluster_test(
    columns: np.ndarray,
    left: np.ndarray,
    parameters: Sequence[int],
    values: np.ndarray,
    *,
    blocks: np.ndarray,
) -> float:
    """Probability that columns explain as much by chance, whatever the errors within a block are like.

    A Wald test with the covariance of the scores of whole blocks in the place of that of white errors. The
    residuals are those with the columns included, so that a real effect does not inflate its own error.

    Parameters
    ----------
    columns, left
        Of all parameters, those to be tested included, shape ``(n, p)``, and the residuals with them,
        shape ``(n,)``.
    parameters
        Places of the columns to be tested.
    values
        The best values of these parameters, which would be zero by chance.
    blocks
        The block of each innovation, numbered from 0, shape ``(n,)``.
    """
    tested = np.array(parameters, dtype=int)
    others = np.setdiff1d(np.arange(columns.shape[1]), tested)
    nuisance, _ = np.linalg.qr(columns[:, others]) if len(others) else (np.zeros((len(left), 0)), None)
    columns = columns[:, tested] - nuisance @ (nuisance.T @ columns[:, tested])
    scale = np.sqrt((columns**2).sum(axis=0))
    scale = np.where(scale > 0, scale, 1.0)
    columns = columns / scale
    scores = np.stack([np.bincount(blocks, column * left) for column in columns.T], axis=1)
    count, width = len(scores), len(tested)
    if count <= width + 1:
        return 1.0
    gram = columns.T @ columns
    spread = scores.T @ scores * count / (count - 1)
    estimate = values * scale
    # Wald: a' (G⁻¹ S G⁻¹)⁻¹ a = (G a)' S⁻¹ (G a).
    weighted = gram @ estimate
    statistic = float(weighted @ np.linalg.lstsq(spread, weighted, rcond=1e-10)[0])
    factor = (count - width) / (width * (count - 1))
    return float(scipy.stats.f.sf(statistic * factor, width, count - width))


UNFORESEEN = (ArithmeticError, ValueError, np.linalg.LinAlgError)
"""What ends a candidate, never the search: an overflow, a division by zero, a singular matrix."""
BUDGET_SPENT = "the budget was spent before it was tried"


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


def in_words(error: Exception) -> str:
    """Why a candidate gave nothing, as a reader is told."""
    return str(error) if isinstance(error, NumericalFailure) else f"{type(error).__name__}: {error}"


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
