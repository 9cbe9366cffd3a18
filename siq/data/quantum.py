"""How finely were the numbers of a column written?

A column whose values are all multiples of one step, 0.001 or the least step of a digitiser, was rounded to
that step. Each value is then off by up to half a step, with a standard deviation of step/√12.
"""

from __future__ import annotations

import numpy as np

MOST_DECIMALS = 12  # a double of size 1 has 15 to 16; what has as many as that was not rounded
FEWEST_VALUES = 8  # distinct values below which a step says nothing
SAMPLE = 2000  # distinct values that are looked at before all are


def quantum(values: np.ndarray) -> float | None:
    """The step of which all values are multiples, None where there is none.

    Parameters
    ----------
    values
        Shape ``(n,)``, finite.

    Returns
    -------
    float or None
        A power of ten where the values have so many decimals; else the least difference of two values, where
        all differences are multiples of it.

    Examples
    --------
    >>> quantum(np.round(np.sin(np.arange(100.0)), 3))
    0.001
    >>> quantum(np.sin(np.arange(100.0))) is None
    True
    """
    some = np.unique(values[:: max(len(values) // SAMPLE, 1)])
    if len(some) < FEWEST_VALUES:
        return None
    largest = float(np.abs(some).max())
    if largest == 0:
        return None
    most = MOST_DECIMALS - int(np.ceil(np.log10(largest)))
    for decimals in range(most - MOST_DECIMALS, most + 1):
        if _are_multiples(some, decimals) and _are_multiples(values, decimals):
            return float(f"1e{-decimals}")
    return _least_difference(values)


def decimals_of(step: float) -> int | None:
    """How many decimals a number has that was rounded to `step`; None where that is no power of ten."""
    decimals = round(-np.log10(step))
    return max(decimals, 0) if np.isclose(step, 10.0**-decimals, rtol=1e-9) else None


def rounding_error(step: float) -> float:
    """Standard deviation of what rounding to `step` does to a value."""
    return step / float(np.sqrt(12.0))


def _are_multiples(values: np.ndarray, decimals: int) -> bool:
    # Rounding as a writer does gives back the very number that was read, where it has no further decimals.
    return bool((np.round(values, decimals) == values).all() if decimals >= 0 else False) or bool(
        np.allclose(np.round(values, decimals), values, rtol=1e-14, atol=0.0)
    )


def _least_difference(values: np.ndarray) -> float | None:
    """The step of a digitiser: many equal values, all of them a whole number of steps apart."""
    levels = np.unique(values)
    if not FEWEST_VALUES <= len(levels) <= len(values) // 2:
        return None
    gaps = np.diff(levels)
    # Levels that differ by less than numbers are written with are one level.
    gaps = gaps[gaps > 1e-9 * np.ptp(levels)]
    if len(gaps) == 0:
        return None
    step = float(gaps.min())
    counts = (levels - levels[0]) / step
    if counts[-1] > 1e7 or np.abs(counts - np.round(counts)).max() > 0.05:
        return None
    return float(np.ptp(levels) / np.round(counts[-1]))
