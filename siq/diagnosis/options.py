"""Options of the search, and the verdicts that a diagnosis may end with."""

from __future__ import annotations

import math
from enum import StrEnum
from typing import Annotated

import numpy as np
import scipy.stats
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from siq.inference.maximum_likelihood import Fit
from siq.systems.dynamics import Dynamics


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
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
    unnamed
        Probability beforehand that what a simulation lacks is not in the dictionary.
    wrong_names
        Most probability of a name that is wrong, since something without a name looks alike. What is less
        certain is detected, and described.
    blocks
        Least number of blocks into which recordings are cut for clustered errors, where there are fewer than
        half as many recordings.
    """

    false_alarms: Annotated[float, Field(gt=0, lt=1)] = 0.002
    same: Annotated[float, Field(gt=0)] = 10.0
    fitted: Annotated[int, Field(ge=1)] = 6
    mechanisms: Annotated[int, Field(ge=1, le=5)] = 3
    unnamed: Annotated[float, Field(gt=0, lt=1)] = 0.1
    wrong_names: Annotated[float, Field(gt=0, lt=0.5)] = 0.05
    blocks: Annotated[int, Field(ge=4)] = 10

    @property
    def least_log_odds(self) -> float:
        """Logarithm of the odds that a name takes."""
        return math.log((1 - self.wrong_names) / self.wrong_names)

    @property
    def most_alike(self) -> float:
        """Most probability that an effect without a name is explained as well, if a name is to stand.

        By Bayes' rule: where something is left, either the name is right and something without a name is
        missing beside it, (1 - unnamed) unnamed, or there is only the latter, and looks alike.
        """
        return math.exp(-self.least_log_odds) * (1 - self.unnamed)


class MismatchVerdict(StrEnum):
    """What a diagnosis ends with, as files have it."""

    NO_MISMATCH = "no mismatch"
    PARAMETER_SHIFT = "parameter shift"
    MISSING_PHYSICS = "missing physics"
    UNEXPLAINED = "unexplained"

    @property
    def mismatch(self) -> bool:
        """Whether the equations differ from the system, whatever their parameters."""
        return self in (MismatchVerdict.MISSING_PHYSICS, MismatchVerdict.UNEXPLAINED)


def quiet_verdict(p_shift: float, options: SearchOptions) -> MismatchVerdict:
    """The verdict where nothing is missing, by the probability that the card's parameters are right."""
    shifted = p_shift < options.false_alarms
    return MismatchVerdict.PARAMETER_SHIFT if shifted else MismatchVerdict.NO_MISMATCH


def shift_probability(model: Dynamics, recalibrated: Fit) -> float:
    """p-value of the test that the card's parameters are the true ones, given the recalibrated ones."""
    free = np.array(model.free, dtype=int)
    if not len(free):
        return 1.0
    difference = recalibrated.model.values[free] - model.values[free]
    scale = np.sqrt(np.diag(recalibrated.covariance))
    scale = np.where(scale > 0, scale, np.inf)
    correlation = recalibrated.covariance / np.outer(scale, scale)
    values, vectors = np.linalg.eigh(correlation)
    kept = values > 1e-9 * values[-1]
    along = vectors[:, kept].T @ (difference / scale) / np.sqrt(values[kept])
    return float(scipy.stats.chi2.sf(float(along @ along), int(kept.sum())))
