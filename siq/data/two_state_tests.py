"""Is a record pushed apart between two places, or could a single state show as much?

Two tests. *The first one* regresses increments over a lag on polynomials of the state in stretches of forty
local relaxation times, each with a level of its own, which takes with it whatever drifts slowly. With the
polynomial of the state, ``E[x(t + 2l) - x(t + l) | x(t)] = l·f(x(t))``, every difference f(b) - f(a) with
a < b would be negative if a single state attracted; the sensor's noise in x(t) is not that of the increment.
The largest of them in standard errors counts, with Scheffé's bound for having looked at all pairs.

*The second one* asks for a valley of the histogram, deeper than in surrogates of the record with the same
spectrum and random phases, which are what a linear system could have shown; of both, every such stretch is
taken less a straight line.
"""

from __future__ import annotations

import numpy as np
from scipy import stats

from siq.data.stationarity import stretches_of

SURROGATES = 999  # for each state that is looked at: fewer could not be rare enough for all of them
ENOUGH = 20  # as deep as the record: the probability is then known to a fifth
MOST_POINTS = 8192  # of a series that surrogates are made of
BINS = 40  # of a histogram with a valley
DEGREE = 5  # of f in the test: two attractors that differ in depth and width need more than a cubic
STRETCH = 40  # local relaxation times: shorter ones bias f towards one state, longer ones let drifts in
FEWEST, SHORTEST = 6, 10  # stretches, at least, for which they may be as short as ten relaxation times
LAG = 0.1  # of the local relaxation time: over it a state hardly changes what pushes it
PLACES = 25  # at which f is compared with itself, between the quantiles
INNER = 0.02  # the quantile from which on f is known well enough


def pushed_apart(values: np.ndarray, runs: list[slice], relaxation: float) -> tuple[float, float] | None:
    """By how many standard errors f rises somewhere, and how probable that is where a single state attracts.

    Parameters
    ----------
    values
        Shape ``(n,)``.
    runs
        See `siq.data.stationarity.runs_of`.
    relaxation
        The local relaxation time in samples.

    Returns
    -------
    tuple or None
        The largest ``(f(b) - f(a)) / error`` with a < b, and its probability by Scheffé's bound; None where
        there are too few stretches.
    """
    lag = max(int(LAG * relaxation), 1)
    longest = sum(run.stop - run.start for run in runs) / (lag * FEWEST) - 2
    rows = int(min(np.ceil(STRETCH * relaxation / lag), longest))
    begins = stretches_of(runs, (rows + 2) * lag) if rows * lag >= SHORTEST * relaxation else np.zeros(0)
    if len(begins) < FEWEST - 2:  # gaps cost some
        return None
    low, high = np.quantile(values, [0.001, 0.999])
    if not high > low:
        return None
    scaled = 2 * (values - low) / (high - low) - 1
    at = begins[:, None] + lag * np.arange(rows)
    now = np.clip(scaled[at], -1.2, 1.2)  # a polynomial has no business beyond
    increments = scaled[at + 2 * lag] - scaled[at + lag]
    terms = np.polynomial.legendre.legvander(now, DEGREE)[..., 1:]
    design = (terms - terms.mean(axis=1, keepdims=True)).reshape(-1, DEGREE)
    goal = (increments - increments.mean(axis=1, keepdims=True)).ravel()
    normal = design.T @ design
    if np.linalg.cond(normal) > 1e12:  # numerical: a record of hardly any different values
        return None
    inverse = np.linalg.inv(normal)
    coefficients = inverse @ design.T @ goal
    rest = goal - design @ coefficients
    # Each stretch is one draw: its residuals may depend on each other and on the state as they like.
    scores = (design * rest[:, None]).reshape(len(begins), rows, DEGREE).sum(axis=1)
    freedom = goal.size - len(begins) - DEGREE
    covariance = inverse * float(rest @ rest) / freedom
    if len(begins) >= 4 * DEGREE:
        robust = inverse @ (scores.T @ scores) @ inverse * len(begins) / (len(begins) - 1)
        covariance = _larger(covariance, robust)
    places = np.linspace(np.quantile(now, INNER), np.quantile(now, 1 - INNER), PLACES)
    at_places = np.polynomial.legendre.legvander(places, DEGREE)[:, 1:]
    first, second = np.triu_indices(PLACES, k=1)
    contrasts = at_places[second] - at_places[first]
    errors = np.sqrt(np.einsum("ij,jk,ik->i", contrasts, covariance, contrasts))
    largest = float(np.max(contrasts @ coefficients / errors))
    return largest, float(stats.f.sf(max(largest, 0.0) ** 2 / DEGREE, DEGREE, freedom))


def valley_between(
    values: np.ndarray,
    runs: list[slice],
    relaxation: float,
    *,
    generator: np.random.Generator | None,
    surrogates: int = SURROGATES,
) -> tuple[float, float]:
    """How much of the record lies in the lesser peak of its histogram, and how probable that is.

    Parameters
    ----------
    values, runs, relaxation
        As of `pushed_apart`.
    generator
        Where the phases of the surrogates come from; None makes none.
    surrogates
        How many, unless `ENOUGH` of them are as deep before: then it is no rare thing (Besag and Clifford,
        Biometrika 78 (1991) 301).

    Returns
    -------
    tuple
        The share of the samples, and its probability among surrogates with random phases.
    """
    every = max(int(relaxation / 4), -(-len(values) // MOST_POINTS), 1)
    levelled = _less_lines(values, runs, max(int(STRETCH * relaxation), 2))
    parts = [levelled[run][::every] for run in runs if run.stop - run.start >= 4 * every]
    if not parts:
        return 0.0, 1.0
    seen = _valley(np.concatenate(parts))
    if seen <= 0 or generator is None:
        return seen, 1.0
    spectra = [(np.fft.rfft(part), len(part)) for part in parts]
    deeper = 0
    for number in range(surrogates):
        drawn = []
        for spectrum, size in spectra:
            turned = spectrum * np.exp(2j * np.pi * generator.random(len(spectrum)))
            turned[0] = spectrum[0]
            drawn.append(np.fft.irfft(turned, n=size))
        deeper += _valley(np.concatenate(drawn)) >= seen
        if deeper == ENOUGH:
            return seen, deeper / (number + 1)
    return seen, (1 + deeper) / (1 + surrogates)


def _less_lines(values: np.ndarray, runs: list[slice], length: int) -> np.ndarray:
    """The series less a straight line in every stretch of that many samples, the last of a run longer."""
    rest = values.copy()
    for run in runs:
        count = max((run.stop - run.start) // length, 1)
        for part in np.array_split(np.arange(run.start, run.stop), count):
            line = np.vander(np.linspace(-1, 1, len(part)), 2)
            rest[part] -= line @ np.linalg.lstsq(line, values[part], rcond=None)[0]
    return rest


def _valley(series: np.ndarray) -> float:
    low, high = np.quantile(series, [0.001, 0.999])
    if not high > low:
        return 0.0
    share = np.histogram(series, bins=BINS, range=(float(low), float(high)))[0] / len(series)
    above = np.maximum(share[:, None] - share, 0)  # bins by places of the valley
    left, right = np.tril(above.T, -1).sum(axis=1), np.triu(above.T, 1).sum(axis=1)
    return float(np.minimum(left, right).max())


def _larger(one: np.ndarray, two: np.ndarray) -> np.ndarray:
    """A covariance that is not smaller than either in any direction in which they differ."""
    root = np.linalg.cholesky(one)
    inverse = np.linalg.inv(root)
    values, vectors = np.linalg.eigh(inverse @ two @ inverse.T)
    turned = root @ vectors
    return (turned * np.maximum(values, 1.0)) @ turned.T
