"""When does a record visit which state, and how long do visits last?

*Hops* are counted with two thresholds, the levels of the two states: a visit begins where the record reaches
the level of a state, and lasts until it reaches the level of the other one. The mean dwell time is the time
of all visits, those that the record cuts at its ends included, over the number of visits whose end was seen:
the best estimate for exponential times, with a relative error of ``1/√n``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

CONFIDENCE = 0.95  # of the intervals of mean dwell times


@dataclass(frozen=True)
class DwellCount:
    """How long a state lasts, as counted.

    Attributes
    ----------
    visits
        How many were seen to end, each by a hop.
    time
        Spent in the state by all visits, in the unit of time.
    """

    visits: int
    time: float

    @property
    def mean(self) -> float:
        """Mean dwell time; NaN where no visit ended."""
        return self.time / self.visits if self.visits else float("nan")

    @property
    def relative_error(self) -> float:
        """``1/√n``; infinite where no visit ended."""
        return float(1 / np.sqrt(self.visits)) if self.visits else float("inf")

    @property
    def limits(self) -> tuple[float, float]:
        """Interval of 95 % for exponential times; the upper end is infinite where no visit ended.

        The number of hops in a given time is Poisson's, so that ``2T/τ`` lies between quantiles of χ².
        """
        tail = (1 - CONFIDENCE) / 2
        upper = stats.chi2.ppf(1 - tail, 2 * self.visits + 2)
        lower = stats.chi2.ppf(tail, 2 * self.visits) if self.visits else 0.0
        return float(2 * self.time / upper), float(2 * self.time / lower) if lower > 0 else float("inf")


def counted_visits(values: np.ndarray, runs: list[slice], levels: tuple[float, float]) -> np.ndarray:
    """0 from where the lower level is reached, 1 from where the upper one is, -1 before: shape ``(n,)``."""
    core = np.full(len(values), -1)
    core[values <= levels[0]] = 0
    core[values >= levels[1]] = 1
    return continued_visits(core, runs)


def continued_visits(core: np.ndarray, runs: list[slice]) -> np.ndarray:
    """Which core was entered last, at every sample of a run; -1 before the first.

    Parameters
    ----------
    core
        Shape ``(n,)``: the core that a sample lies in, -1 between them.
    runs
        See `siq.data.stationarity.runs_of`.
    """
    visits = np.full(len(core), -1)
    for run in runs:
        part = core[run]
        last = np.maximum.accumulate(np.where(part >= 0, np.arange(len(part)), -1))
        visits[run] = np.where(last >= 0, part[np.maximum(last, 0)], -1)
    return visits


def dwell_counts(
    t: np.ndarray, visits: np.ndarray, runs: list[slice], *, states: int = 2
) -> tuple[DwellCount, ...]:
    """Time spent in each state, and visits that ended in another: one for each.

    The first and the last visit of a run count with the time that was seen of them; only the last has no end.
    """
    spent, ended = np.zeros(states), np.zeros(states, dtype=int)
    for run in runs:
        inside, gaps = visits[run], np.diff(t[run])
        before, known = inside[:-1], inside[:-1] >= 0
        spent += np.bincount(before[known], weights=gaps[known], minlength=states)
        hops = known & (inside[1:] != before)
        ended += np.bincount(before[hops], minlength=states)
    return tuple(DwellCount(int(n), float(time)) for n, time in zip(ended, spent, strict=True))
