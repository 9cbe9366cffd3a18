"""How well can a laboratory's barriers be known at best?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.laboratories.information import information, information_of_states
from benchmarks.laboratories.models import Laboratory
from benchmarks.laboratories.records import generator, recorded
from benchmarks.laboratories.truths import Truth, truth

SIMULATED = 6  # sets of records over which the information is averaged
SUBSTEPS = 2  # of the filter: the bound then is known to some per mille
OTHER_SEEDS = 1_000_000  # from here on: those of the records that bounds are taken from


@dataclass(frozen=True)
class Bound:
    """The Cramér–Rao bound of a laboratory that knows which terms f and q have, and nothing else.

    Attributes
    ----------
    barriers
        The least standard errors of the barriers, shape ``(k,)``.
    parameters
        Those of the coefficients of f and q, shape ``(p,)``.
    """

    barriers: np.ndarray
    parameters: np.ndarray


def bound(laboratory: Laboratory, known: Truth | None = None, *, simulated: int = SIMULATED) -> Bound:
    """By the information of simulated records, averaged; barriers follow by their derivatives."""
    known = known or truth(laboratory)
    seeds = range(OTHER_SEEDS, OTHER_SEEDS + simulated)
    matrix = np.mean([_of_seed(laboratory, seed) for seed in seeds], axis=0)
    covariance = inverse(matrix)
    count = known.slopes.shape[1]
    of_parameters = covariance[:count, :count]
    return Bound(
        np.sqrt(np.einsum("ki,ij,kj->k", known.slopes, of_parameters, known.slopes)),
        np.sqrt(np.diag(of_parameters)),
    )


def _of_seed(laboratory: Laboratory, seed: int) -> np.ndarray:
    seen = recorded(laboratory, generator(laboratory, seed))
    if laboratory.averaged or (laboratory.sensor > 0).any():
        return information(laboratory, seen, substeps=SUBSTEPS).matrix
    return information_of_states(laboratory, seen)


def inverse(matrix: np.ndarray) -> np.ndarray:
    """Of an information matrix whose parameters have units far apart."""
    unit = np.sqrt(np.diag(matrix))
    return np.linalg.inv(matrix / np.outer(unit, unit)) / np.outer(unit, unit)
