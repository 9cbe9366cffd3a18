"""U over both wells of systems in which it is known."""

from __future__ import annotations

import functools

import numpy as np
from known_systems import KnownSystem, double_well, maier_stein, portrait_of, potential_values

from siq.quasipotential.global_formula import GlobalQuasipotential, heights_of_attractors
from siq.quasipotential.refinement import RefinementOptions
from siq.quasipotential.wells import local_well


def stationary(rates: np.ndarray) -> np.ndarray:
    """The stationary distribution of a Markov chain, by Grassmann, Taksar and Heyman's elimination."""
    rates = rates.copy()  # nothing is subtracted from them, so that tiny ones do no harm
    for k in range(len(rates) - 1, 0, -1):
        rates[:k, k] /= rates[k, :k].sum()
        rates[:k, :k] += np.outer(rates[:k, k], rates[k, :k])
        np.fill_diagonal(rates, 0.0)
    shares = np.ones(len(rates))
    for k in range(1, len(rates)):
        shares[k] = shares[:k] @ rates[:k, k]
    return shares / shares.sum()


@functools.cache
def matched(which: str) -> tuple[KnownSystem, GlobalQuasipotential]:
    """The global U of a system, from local formulas and the exact barriers."""
    known = {"double well": double_well(2), "Maier-Stein": maier_stein(1)}[which]
    found = portrait_of(known, 400, share=0.8)
    options = RefinementOptions(degrees=(4,))
    local = [local_well(known.dynamics, found, index, options=options) for index in range(2)]
    (saddle,) = found.saddles[0]
    top = potential_values(known, saddle.position[None])[0]
    bottoms = potential_values(known, np.stack([one.position for one in found.attractors]))
    barriers = np.full((2, 2), np.inf)
    barriers[0, 1], barriers[1, 0] = 2 * (top - bottoms)
    return known, GlobalQuasipotential(tuple(local), heights_of_attractors(barriers))
