"""A density on a plane of two states, or of the only one, and how far samples of a long simulation are."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.interpolate

GROUPS = 100  # of walkers, among which the sampling error is estimated
BINS = 40  # along each of the states


@dataclass(frozen=True)
class MarginalDensity:
    """The invariant density on a plane of two states, the others integrated out; or of a single state.

    Attributes
    ----------
    plane
        Indices of the two states, or of the only one.
    intensity
        ε.
    x1, x2
        The grid, shapes ``(n,)`` and ``(m,)``, evenly spaced: from edge to edge of the box, or, of a
        landscape, in the middles of its cells. With one state `x2` is empty.
    values
        Shape ``(m, n)``, ``(1, n)`` with one state: density per unit of the first state and unit of the
        second; its integral over the box is 1. NaN where it is not known.
    """

    plane: tuple[int, ...]
    intensity: float
    x1: np.ndarray
    x2: np.ndarray
    values: np.ndarray


@dataclass(frozen=True)
class DensityComparison:
    """The histogram of a long simulation beside a marginal density.

    Attributes
    ----------
    total_variation
        ``½ Σ |P_b - Q_b|`` over the bins, Q the samples' shares and P the density's probabilities: from 0
        to 1, the largest difference in the probability of any union of bins.
    sampling_floor
        What total variation to expect of these samples if the density were exact, from the spread among
        the walkers; NaN with one walker.
    outside
        Share of the samples outside the box, which counts as a further bin, of probability 0. Of a
        landscape: share of the samples where U is not known, which are left out.
    x1_edges, x2_edges
        Edges of the bins, shapes ``(n + 1,)`` and ``(m + 1,)``; with one state the latter is empty.
    histogram
        Shape ``(m, n)``, ``(1, n)`` with one state: the samples' density, in the marginal density's unit.
    """

    total_variation: float
    sampling_floor: float
    outside: float
    x1_edges: np.ndarray
    x2_edges: np.ndarray
    histogram: np.ndarray


@dataclass(frozen=True)
class ComparedDensity:
    """The density for one ε, with Z and a long simulation beside it.

    Attributes
    ----------
    density
        The density on a plane of two states, or of the only one.
    normalisation
        Z, None where it is not to be written.
    comparison
        A long simulation beside it, None where there is none.
    unknown
        The share of all probability that lies where the density is not known, at most; None where it is
        known everywhere.
    """

    density: MarginalDensity
    normalisation: float | None = None
    comparison: DensityComparison | None = None
    unknown: float | None = None


def total_variation(density: MarginalDensity, samples: np.ndarray, *, bins: int = BINS) -> DensityComparison:
    """Compare a marginal density with samples of a long stochastic simulation.

    Parameters
    ----------
    density
        The marginal density on a plane, from edge to edge of the box.
    samples
        Shape ``(d, ..., walkers)``, all d states: what `siq.dynamics.simulation.simulate_stationary`
        returns. Walkers count as independent of each other, the samples of one walker do not. Where walkers
        never leave their well, the floor includes a scatter between wells that the choice of initial states
        avoids.
    bins
        Bins along each of the states, over the box of the density.
    """
    axes = (density.x1, density.x2)[: len(density.plane)]
    edges = [np.linspace(axis[0], axis[-1], bins + 1) for axis in axes]
    chosen = samples[list(density.plane)].reshape(len(axes), -1, samples.shape[-1])
    places = [np.searchsorted(edge, x, side="right") - 1 for edge, x in zip(edges, chosen, strict=True)]
    inside = np.logical_and.reduce([(place >= 0) & (place < bins) for place in places])
    row_and_column = sum(place * bins**power for power, place in enumerate(places))
    bin_of = np.where(inside, row_and_column, bins ** len(places))
    return compare_shares(bin_of, np.append(_bin_probabilities(density, edges), 0.0), edges)


def compare_shares(
    bin_of: np.ndarray,
    expected: np.ndarray,
    edges: Sequence[np.ndarray],
    *,
    counted: np.ndarray | None = None,
) -> DensityComparison:
    """Compare the shares of samples in bins with their probabilities.

    Parameters
    ----------
    bin_of
        The bin of every sample, shape ``(times, walkers)``: row of the second state times the bins of the
        first, plus the column; the last bin is what lies outside the box.
    expected
        Probability of every bin, shape ``(bins + 1,)``.
    edges
        Of the bins along the first state and the second, if there is one.
    counted
        The samples that count, of the shape of `bin_of`; by default all.
    """
    walkers, width = bin_of.shape[-1], len(expected)
    groups = min(GROUPS, walkers)
    group_of = np.broadcast_to(np.arange(walkers) * groups // walkers, bin_of.shape)
    label = group_of * width + bin_of
    counts = np.bincount(label.ravel() if counted is None else label[counted], minlength=groups * width)
    counts = counts.reshape(groups, width)
    observed = counts.sum(axis=0) / max(counts.sum(), 1)
    shares = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    # The mean of |x| for a normal x is sqrt(2/π) times its standard deviation.
    errors = shares.std(axis=0, ddof=1) / math.sqrt(groups) if groups > 1 else np.full(width, np.nan)
    area = math.prod(one[1] - one[0] for one in edges)
    return DensityComparison(
        total_variation=float(np.abs(observed - expected).sum() / 2),
        sampling_floor=float(math.sqrt(2 / math.pi) * errors.sum() / 2),
        outside=float(observed[-1]) if counted is None else 1 - float(counted.mean()),
        x1_edges=edges[0],
        x2_edges=edges[1] if len(edges) > 1 else np.zeros(0),
        histogram=observed[:-1].reshape(-1, len(edges[0]) - 1) / area,
    )


def _bin_probabilities(density: MarginalDensity, edges: Sequence[np.ndarray]) -> np.ndarray:
    """Integrals of the density over the bins, the second state's bins by row, as one flat array."""
    if len(edges) == 1:
        curve = scipy.interpolate.InterpolatedUnivariateSpline(density.x1, density.values[0])
        return np.array([curve.integral(left, right) for left, right in itertools.pairwise(edges[0])])
    surface = scipy.interpolate.RectBivariateSpline(density.x1, density.x2, density.values.T)
    return np.array(
        [
            surface.integral(left, right, low, high)
            for low, high in itertools.pairwise(edges[1])
            for left, right in itertools.pairwise(edges[0])
        ]
    )
