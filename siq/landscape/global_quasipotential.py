"""The global landscape: local formulas matched at the saddles (Freidlin and Wentzell's minimum).

About each attractor i the quasipotential is ``U_i(x)``, zero there. The one that the invariant distribution
follows, ``p ~ exp(-U/ε)``, is

    U(x) = min_i (W_i + U_i(x)) - min_i W_i,

where W_i is the least total of barriers over all trees of transitions that end in i (M. Freidlin,
A. Wentzell, *Random Perturbations of Dynamical Systems*, chapter 6). For two wells this says that both local
formulas have the same value at the saddle between them.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from siq.errors import NumericalFailure
from siq.potential.well import Well

MOST_WELLS = 6  # of which all trees can be counted


@dataclass(frozen=True)
class GlobalQuasipotential:
    """U over all wells, where it is known.

    Attributes
    ----------
    wells
        V about the attractors.
    heights
        U at the attractors, shape ``(k,)``; the lowest is zero.
    """

    wells: tuple[Well, ...]
    heights: np.ndarray

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """U at points ``(n, d)``: shape ``(n,)``, NaN where it is not known."""
        return least_over_wells(self.by_well(x))

    def by_well(self, x: np.ndarray) -> np.ndarray:
        """``W_i + U_i`` at points, shape ``(k, n)``, NaN where the formula of a well is not believed."""
        return np.stack(
            [h + 2 * one.known_values(x) for h, one in zip(self.heights, self.wells, strict=True)]
        )


def least_over_wells(values: np.ndarray) -> np.ndarray:
    """The least of ``(k, n)`` values that are known, shape ``(n,)``; NaN where none is."""
    least = np.where(np.isfinite(values), values, np.inf).min(axis=0)
    return np.where(np.isfinite(least), least, np.nan)


def matched(wells: Sequence[Well | None], heights: np.ndarray) -> GlobalQuasipotential | None:
    """U over all wells, None where a well has no formula or no height."""
    known = tuple(one for one in wells if one is not None)
    if not known or len(known) < len(wells) or not np.isfinite(heights).all():
        return None
    return GlobalQuasipotential(known, heights)


def heights_of_attractors(barriers: np.ndarray) -> np.ndarray:
    """U at the attractors from the barriers between them.

    Parameters
    ----------
    barriers
        Shape ``(k, k)``: the lowest barrier of U on the way from i to j in one step, infinite where there
        is none.

    Returns
    -------
    numpy.ndarray
        Shape ``(k,)``, the lowest being zero.

    Raises
    ------
    NumericalFailure
        When transitions do not connect the attractors, or there are too many of them.
    """
    count = len(barriers)
    if count > MOST_WELLS:
        raise NumericalFailure(f"there are {count} attractors; heights are found for {MOST_WELLS} at most")
    totals = np.array([_least_tree(barriers, root) for root in range(count)])
    if not np.isfinite(totals).all():
        raise NumericalFailure(
            "no transitions over known saddles connect all attractors: their heights are not known"
        )
    return np.asarray(totals - totals.min())


def _least_tree(barriers: np.ndarray, root: int) -> float:
    """The least total of barriers over trees in which every attractor leads to the root."""
    others = [i for i in range(len(barriers)) if i != root]
    least = np.inf
    for targets in itertools.product(range(len(barriers)), repeat=len(others)):
        step = dict(zip(others, targets, strict=True))
        total = sum(barriers[i, j] for i, j in step.items())
        if total < least and all(_arrives(step, i, root) for i in others):
            least = float(total)
    return 0.0 if not others else least


def _arrives(step: dict[int, int], start: int, root: int) -> bool:
    seen: set[int] = set()
    while start != root:
        if start in seen:
            return False
        seen.add(start)
        start = step[start]
    return True


def global_quasipotential(wells: Sequence[Well], barriers: np.ndarray) -> GlobalQuasipotential:
    """Match local formulas; `barriers` as for `heights_of_attractors`."""
    return GlobalQuasipotential(tuple(wells), heights_of_attractors(barriers))
