"""What may a diagnosis end with, and which of it where nothing is missing?"""

from __future__ import annotations

from enum import StrEnum

import numpy as np
import scipy.stats

from siq.dynamics.dynamics import Dynamics
from siq.estimation.fit import Fit
from siq.mismatch.search_options import SearchOptions


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
