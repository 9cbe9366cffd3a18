"""Where are samples evenly spaced, and how do what neighbours leave go together over lags?

Statistics of lags need samples one after the other, a step apart. Recordings are cut where a sample is
missing or a recording ends; what is told of a lag comes from whole stretches alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from siq.data.recordings import Recordings

EVEN = 0.01  # of a step: stretches end where a step differs by more


@dataclass(frozen=True)
class Stretches:
    """Steps between neighbouring samples, numbered by the stretch of even steps that they belong to.

    Attributes
    ----------
    number
        Shape ``(n - 1,)`` for n samples: the stretch of the step from sample k to sample k + 1, -1 where it
        belongs to none.
    step
        The usual time between neighbouring samples, in the unit of time; 0 where there are none.
    """

    number: np.ndarray
    step: float

    def within(self, lag: int) -> np.ndarray:
        """The first of `lag` + 1 steps that belong to one stretch, as indices of steps."""
        count = len(self.number) - lag
        if count <= 0:
            return np.zeros(0, dtype=int)
        one, other = self.number[:count], self.number[lag:]
        return np.flatnonzero((one >= 0) & (one == other))


def even_stretches(recordings: Recordings) -> Stretches:
    """Cut recordings into stretches of even steps."""
    gap = np.diff(recordings.t)
    inside = np.diff(recordings.recording) == 0
    if not inside.any():
        return Stretches(np.full(len(gap), -1), 0.0)
    usual = float(np.quantile(gap[inside], 0.5, method="lower"))
    # Times such as 0.1·k, or seconds since 1970, carry rounding errors into their differences.
    even = inside & (np.abs(gap - usual) <= EVEN * usual + 4 * np.spacing(np.abs(recordings.t[1:])))
    return Stretches(np.where(even, np.cumsum(~even), -1), usual)


def lagged_covariances(rest: np.ndarray, number: np.ndarray, most: int) -> np.ndarray:
    """Covariances of what is left of steps with what is left of later ones.

    Parameters
    ----------
    rest
        Shape ``(n, d)``: what is left of each step, with mean zero.
    number
        Shape ``(n,)``: the stretch of each step, -1 for none. Steps of a stretch follow each other.
    most
        The longest lag.

    Returns
    -------
    numpy.ndarray
        Shape ``(most + 1, d, d)``: ``C[k, i, j]`` is the mean of ``rest[m, i] rest[m + k, j]``; zero where no
        two steps are so far apart.
    """
    d = rest.shape[1]
    covariances = np.zeros((most + 1, d, d))
    for lag in range(min(most, len(rest) - 1) + 1):
        count = len(rest) - lag
        both = (number[:count] == number[lag:]) & (number[:count] >= 0)
        if both.any():
            covariances[lag] = (rest[:count] * both[:, None]).T @ rest[lag:] / both.sum()
    return covariances


def long_run_covariance(covariances: np.ndarray, lag: int) -> np.ndarray:
    """``C_0 + Σ_k (C_k + C_kᵀ)`` up to a lag: what sums of many steps have, per step; shape ``(d, d)``."""
    later = covariances[1 : lag + 1].sum(axis=0)
    return np.asarray(covariances[0] + later + later.T)
