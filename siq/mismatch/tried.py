"""What came of a candidate that was tried: how much does it explain, and could chance do as much?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.stats

from siq.errors import NumericalFailure
from siq.estimation.fit import Fit
from siq.estimation.measurements import Measurements
from siq.mismatch.building import MechanismCandidate
from siq.mismatch.clusters import probability_by_chance

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
