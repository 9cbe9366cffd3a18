"""How far a landscape is from the references: in each well, over all wells, and at the barriers."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from siq.landscape.reference import ReferenceLandscape
from siq.potential.well import Well

WELL_SHARE = 0.9  # of its barrier: below it a well is compared
OVERALL = 1.1  # of the highest saddle of U

Potential = Callable[[np.ndarray], np.ndarray]
"""U at points ``(n, d)``, NaN where it is not known; up to a constant."""


@dataclass(frozen=True)
class ErrorInRegion:
    """One estimate of U against the reference in one region.

    Attributes
    ----------
    region
        In words.
    points
        Number of points of the region.
    covered
        Share of them at which the estimate says something.
    error
        Relative L2 error of U there.
    error_everywhere
        The same of the formula at every point, whether it is to be believed or not; NaN for other estimates.
    """

    region: str
    points: int
    covered: float
    error: float
    error_everywhere: float = float("nan")


def well_region(index: int) -> str:
    """What the region of a well is called in tables."""
    return f"A{index + 1}, below {WELL_SHARE:g} of its barrier"


def compare_wells(reference: ReferenceLandscape, wells: Mapping[int, Well]) -> list[ErrorInRegion]:
    """Formulas of wells against characteristics, each below a share of its barrier.

    Parameters
    ----------
    reference
        The references.
    wells
        Formulas by the index of the reference's attractor; a well without one counts as not covered.
    """
    rows = []
    for index in range(len(reference.attractors)):
        inside = reference.below(index, WELL_SHARE)
        exact = reference.characteristics[index][inside]
        if index not in wells:
            rows.append(ErrorInRegion(well_region(index), len(exact), 0.0, float("nan")))
            continue
        x = reference.points[inside]
        row = _compared(well_region(index), 2 * wells[index].known_values(x), exact)
        everywhere = relative_l2(2 * wells[index].values(x), exact)
        rows.append(ErrorInRegion(row.region, row.points, row.covered, row.error, everywhere))
    return rows


def compare_estimate(
    reference: ReferenceLandscape, potential: Potential, *, below: float | None
) -> list[ErrorInRegion]:
    """One estimate of U: in each well from its attractor upwards, and over all wells below a level.

    A constant means nothing to U. In a well the estimate is zero at the attractor; over all wells it is
    shifted by the median of its difference, so that no single point decides.
    """
    rows = []
    values = potential(reference.points)
    for index, attractor in enumerate(reference.attractors):
        inside = reference.below(index, WELL_SHARE)
        at = float(potential(attractor[None])[0])
        exact = reference.characteristics[index][inside]
        rows.append(_compared(well_region(index), values[inside] - at, exact))
    rows.append(compare_overall(reference, values, below=below, shifted=True))
    return rows


def compare_overall(
    reference: ReferenceLandscape, values: np.ndarray, *, below: float | None, shifted: bool = False
) -> ErrorInRegion:
    """Values of U at the reference's points, over all wells below a level."""
    exact = reference.values
    level = overall_level(reference) if below is None else below
    inside = np.nan_to_num(exact, nan=np.inf) < level
    own = values[inside]
    if shifted:
        own = own - np.nanmedian(own - exact[inside])
    return _compared(f"U < {level:.4g}", own, exact[inside])


def overall_level(reference: ReferenceLandscape) -> float:
    """The level below which landscapes are compared by default: somewhat above the highest saddle."""
    tops = reference.heights + reference.barriers
    return float(OVERALL * tops[np.isfinite(tops)].max(initial=0.0))


def relative_l2(values: np.ndarray, exact: np.ndarray) -> float:
    """``‖u - u*‖ / ‖u*‖``, NaN for no points."""
    size = float(np.linalg.norm(exact))
    return float(np.linalg.norm(values - exact)) / size if size > 0 else float("nan")


def _compared(region: str, values: np.ndarray, exact: np.ndarray) -> ErrorInRegion:
    known = np.isfinite(values)
    covered = float(known.mean()) if len(values) else 0.0
    return ErrorInRegion(region, len(exact), covered, relative_l2(values[known], exact[known]))
