"""At which two levels does a record stay, over which common background?

A hidden Markov model of two normal distributions finds the levels, and what both have in common is the
background; each in turn.
"""

from __future__ import annotations

import numpy as np

from siq.data.recordings import Recordings
from siq.data.stationarity import Background, background_of, stretches_of_all
from siq.numerics.machine_code import machine_code

WINDOW = 0.5  # of the local relaxation time, over which samples are averaged for the hidden Markov model
SWEEPS = 200  # of its estimation, at most


def two_levels(
    recordings: Recordings, values: np.ndarray, runs: list[slice], relaxation: float
) -> tuple[Background, tuple[float, float], tuple[float, float]]:
    """Two levels over a common background: each in turn, until neither changes."""
    width = max(int(WINDOW * relaxation), 1)
    background = Background(np.zeros(len(values)), 0)
    levels, spreads = (0.0, 0.0), (0.0, 0.0)
    for _ in range(5):
        flat = values - background.values
        begins = stretches_of_all(runs, width)
        means = flat[begins[:, None] + np.arange(width)].mean(axis=1)
        first = np.append(True, np.diff(begins) != width)
        centre, spread, weights = _two_normals(means, first)
        order = np.argsort(centre)
        levels = (float(centre[order[0]]), float(centre[order[1]]))
        spreads = (float(spread[order[0]]), float(spread[order[1]]))
        share = np.full(len(values), np.nan)
        share[begins[:, None] + np.arange(width)] = weights[:, order[1]][:, None]
        known = np.isfinite(share)
        share = np.interp(np.arange(len(share)), np.flatnonzero(known), share[known])
        found = background_of(recordings, values - (1 - share) * levels[0] - share * levels[1])
        unchanged = found.half_periods == background.half_periods and (
            np.abs(found.values - background.values).max() <= 0.01 * min(spreads)
        )
        background = found
        if unchanged:
            break
    return background, levels, spreads


def _two_normals(series: np.ndarray, first: np.ndarray) -> tuple[np.ndarray, ...]:
    """A hidden Markov model of two normal distributions: centres, spreads, and weights ``(n, 2)``."""
    centre = np.quantile(series, [0.1, 0.9])
    if not centre[1] > centre[0]:
        centre = np.array([series.min(), series.max()])
    spread = np.full(2, max(np.ptp(centre) / 4, 1e-12))
    transition = np.array([[0.95, 0.05], [0.05, 0.95]])
    smallest = 1e-3 * max(float(series.std()), 1e-300)  # a level of a single repeated value has no spread
    before = -np.inf
    weights = np.full((len(series), 2), 0.5)
    for _ in range(SWEEPS):
        logs = -0.5 * ((series[:, None] - centre) / spread) ** 2 - np.log(spread)
        highest = logs.max(axis=1, keepdims=True)
        weights, pairs, likelihood = _forward_backward(np.exp(logs - highest), transition, first)
        likelihood += float(highest.sum())
        total = weights.sum(axis=0) + 1e-12
        centre = weights.T @ series / total
        spread = np.sqrt(np.maximum((weights * (series[:, None] - centre) ** 2).sum(axis=0) / total, 0))
        spread = np.maximum(spread, smallest)
        transition = (pairs + 1e-6) / (pairs + 1e-6).sum(axis=1, keepdims=True)
        if likelihood - before < 1e-6 * len(series) ** 0.5:
            break
        before = likelihood
    return centre, spread, weights


@machine_code
def _forward_backward(
    density: np.ndarray, transition: np.ndarray, first: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Probabilities of the two states at each time, expected transitions, and the log-likelihood."""
    count = len(density)
    forward = np.empty((count, 2))
    scale = np.empty(count)
    weights = np.empty((count, 2))
    pairs = np.zeros((2, 2))
    likelihood = 0.0
    for k in range(count):
        for j in range(2):
            if first[k]:
                prior = 0.5
            else:
                prior = forward[k - 1, 0] * transition[0, j] + forward[k - 1, 1] * transition[1, j]
            forward[k, j] = prior * density[k, j]
        scale[k] = max(forward[k, 0] + forward[k, 1], 1e-300)
        forward[k, 0] /= scale[k]
        forward[k, 1] /= scale[k]
        likelihood += np.log(scale[k])
    after = np.ones(2)
    for k in range(count - 1, -1, -1):
        if k + 1 == count or first[k + 1]:
            after[0], after[1] = 1.0, 1.0
        else:
            low = density[k + 1, 0] * after[0] / scale[k + 1]
            high = density[k + 1, 1] * after[1] / scale[k + 1]
            for i in range(2):
                pairs[i, 0] += forward[k, i] * transition[i, 0] * low
                pairs[i, 1] += forward[k, i] * transition[i, 1] * high
            one = transition[0, 0] * low + transition[0, 1] * high
            two = transition[1, 0] * low + transition[1, 1] * high
            after[0], after[1] = one, two
        weights[k, 0] = forward[k, 0] * after[0]
        weights[k, 1] = forward[k, 1] * after[1]
    return weights, pairs, likelihood
