"""Walkers in noise for a long time, to hold the invariant density over several wells against.

At small ε a walker stays in its well for longer than anyone can simulate. Walkers therefore start with the
wells' shares that the density itself says. Then the comparison tests the density within each well, and the
shares only as far as walkers change wells; how many do is counted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from siq.dynamics.dynamics import Dynamics
from siq.dynamics.simulation import noise_source
from siq.errors import NumericalFailure
from siq.landscape.density_of_wells import KnownDensity, SampledPotential
from siq.numerics.density_comparison import GROUPS
from siq.reference.escapes import heun_step

STEP = 0.1  # of the shortest time of f where the walkers are


def starting_states(
    density: KnownDensity, sampled: SampledPotential, count: int, *, generator: np.random.Generator
) -> np.ndarray:
    """States drawn from the density, the share of every well exact to one walker: shape ``(d, count)``.

    The walkers are ordered such that groups of neighbours, among which sampling errors are estimated, have
    the wells' shares too.
    """
    flat = density.probabilities.ravel()
    order = np.argsort(sampled.well.ravel(), kind="stable")
    # One draw in each of so many equal parts of the whole probability, well after well.
    quantiles = (np.arange(count) + generator.uniform(size=count)) / count
    cumulative = np.cumsum(flat[order])
    place = np.searchsorted(cumulative / cumulative[-1], quantiles, side="right")
    cells = order[np.minimum(place, flat.size - 1)]
    cells = np.concatenate([cells[group::GROUPS] for group in range(min(GROUPS, count))])
    index = np.stack(np.unravel_index(cells, sampled.values.shape))
    within = generator.uniform(size=index.shape)
    states: np.ndarray = sampled.box[:, :1] + (index + within) * sampled.widths[:, None]
    return states


def walk(
    dynamics: Dynamics,
    start: np.ndarray,
    *,
    intensity: float,
    burn_in: int,
    steps: int,
    thin: int,
    generator: np.random.Generator,
) -> np.ndarray:
    """Walkers in ``dx = f dt + sqrt(ε) D^(1/2) dW`` by Heun's rule, of weak order two where D is constant.

    f turns many times while it descends, and the rule of Euler and Maruyama would take part of the damping
    away.

    Parameters
    ----------
    dynamics
        f and D.
    start
        Shape ``(d, walkers)``.
    intensity
        ε.
    burn_in, steps, thin
        Steps before the first sample, steps from then on, and every how many a sample is kept.
    generator
        Source of the noise.

    Returns
    -------
    numpy.ndarray
        Shape ``(d, steps // thin, walkers)``.

    Raises
    ------
    NumericalFailure
        When walkers run to infinity.
    """
    rate = np.linalg.norm(dynamics.jacobian(start.T), axis=(1, 2))
    step = STEP / float(np.median(rate))
    function = dynamics.drift_of_components
    noise = noise_source(dynamics.diffusion, intensity=intensity, step=step, generator=generator)
    x = np.array(start, dtype=float)
    samples = np.empty((len(x), steps // thin, x.shape[1]))
    with np.errstate(over="ignore", invalid="ignore"):  # told below
        for index in range(1 - burn_in, samples.shape[1] * thin + 1):
            x = heun_step(function, x, step, noise(x))
            if index > 0 and index % thin == 0:
                samples[:, index // thin - 1] = x
    lost = int((~np.isfinite(x).all(axis=0)).sum())  # what once is not finite stays so
    if lost:
        raise NumericalFailure(f"{lost} of {x.shape[1]} walkers run to infinity; take a smaller step")
    return samples


@dataclass(frozen=True)
class WellShares:
    """Where walkers are, by well.

    Attributes
    ----------
    simulated
        The wells' shares of the samples at which U is known, shape ``(k,)``.
    changed
        Of the walkers that start in each well, the share that is in another at the end, shape ``(k,)``.
    """

    simulated: np.ndarray
    changed: np.ndarray


def simulated_shares(sampled: SampledPotential, start: np.ndarray, samples: np.ndarray) -> WellShares:
    """The wells in which walkers are: `start` of shape ``(d, walkers)``, samples ``(d, times, walkers)``."""

    def wells_of(x: np.ndarray) -> np.ndarray:
        index, inside = sampled.places(x)
        return np.where(inside, sampled.well[tuple(index)], -1)

    count = sampled.wells
    where = wells_of(samples)
    counted = np.bincount(where[where >= 0], minlength=count)
    first, last = wells_of(start), where[-1]
    told = (first >= 0) & (last >= 0)
    with np.errstate(invalid="ignore"):  # no walker started in a well of no probability
        changed = np.bincount(first[told & (first != last)], minlength=count) / np.bincount(
            first[told], minlength=count
        )
        return WellShares(counted / counted.sum(), changed)


def shares_by_rates(transitions: Sequence[Mapping[str, Any]], count: int, *, intensity: float) -> np.ndarray:
    """The wells' shares that the mean escape times imply, prefactors included; NaN where one is not known.

    Unlike the integral of exp(-U/ε) over a well this has the prefactor of the density in it.

    Parameters
    ----------
    transitions
        ``start end barrier prefactor`` of every way between wells, as `siq.landscape.storage` has them.
    count
        Number of wells, k.
    intensity
        ε.
    """
    ways = [way for way in transitions if way["end"] is not None]
    if any(way["barrier"] is None or way["prefactor"] is None for way in ways):
        return np.full(count, np.nan)
    rates = np.zeros((count, count))
    lowest = min((way["barrier"] for way in ways), default=0.0)  # or all rates would be zero at a small ε
    for way in ways:
        rates[way["start"], way["end"]] += np.exp((lowest - way["barrier"]) / intensity) / way["prefactor"]
    np.fill_diagonal(rates, 0.0)
    # Grassmann, Taksar and Heyman's elimination: nothing is subtracted from rates, so that tiny ones count.
    for k in range(count - 1, 0, -1):
        leaving = rates[k, :k].sum()
        if not leaving > 0:
            return np.full(count, np.nan)
        rates[:k, k] /= leaving
        rates[:k, :k] += np.outer(rates[:k, k], rates[k, :k])
        np.fill_diagonal(rates, 0.0)
    shares = np.ones(count)
    for k in range(1, count):
        shares[k] = shares[:k] @ rates[:k, k]
    return np.asarray(shares / shares.sum())
