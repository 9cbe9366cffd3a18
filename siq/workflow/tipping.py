"""How likely has a well been left, by some time, while a parameter drifts?

As long as the parameter changes slowly, a well is left at the rate r of the moment, and

    P(t) = 1 - exp(-∫₀ᵗ r(λ(t')) dt'),    r(λ) = Σ over its ways out of exp(-ΔU/ε)/K,

with barrier ΔU and prefactor K of every way out, between the values of a sweep by monotone interpolation. Two
things are asked of that, and both are said for every time:

- *the law*: of r the leading order for small ε is known, with a relative error of about ε/ΔU. Where a barrier
  is not above the noise there is no law; the next rate of which there is one is kept, with an error of one;
- *the drift*: noise leads out of the well along a path that takes some relaxation times of the well. While
  one passes, r changes by the share ``|d ln r/dt|/relaxation``, which r of the moment does not know of.

Both count as far as the integral has collected r with them. Where its error reaches a third, P is no more
than an order of magnitude, and `valid` is False. A well that has ended, as at a fold, has been left.

References
----------
N. Berglund, B. Gentz, Noise-Induced Phenomena in Slow–Fast Dynamical Systems (2006), chapter 3.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pandas as pd
from scipy.integrate import cumulative_simpson
from scipy.interpolate import PchipInterpolator

from siq.errors import Fault
from siq.quasipotential.rates import MIN_BARRIER_OVER_NOISE
from siq.workflow.sweep import ALONE, Sweep

WITHIN = 32  # steps of the integral between two times: Simpson's error falls as their fourth power


def probability_of_tipping(
    found: Sweep,
    course: Callable[[np.ndarray], np.ndarray] | np.ndarray,
    times: np.ndarray,
    *,
    well: int,
    noise: float,
) -> pd.DataFrame:
    """The probability that a well has been left by each of some times; returns to it are not counted.

    Parameters
    ----------
    found
        A sweep of one parameter.
    course
        The parameter at times, as a function of an array of times; or its values at `times`, linear between
        them.
    times
        Shape ``(n,)``, rising; at the first one the system is in the well.
    well
        Number of the well at the beginning, as in `Sweep.table`.
    noise
        ε, in the unit of U.

    Returns
    -------
    pandas.DataFrame
        One row for every time, ``time value rate probability law_error drift_error error valid note``: the
        value of the parameter, r, P, the two relative errors of r, that of the integral of r, whether P is
        more than an order of magnitude, and why not.

    Raises
    ------
    ValueError
        When the well has no ways out in the sweep, when times do not rise, and when the noise is not
        positive.

    Examples
    --------
    >>> import sympy
    >>> from siq.systems.dynamics import Dynamics
    >>> from siq.workflow.sweep import sweep
    >>> h, x = sympy.symbols("h x", real=True)
    >>> cusp = Dynamics.of((x,), (h + x - x**3,), domain=[(-2, 2)], parameters={h: 0.0})
    >>> found = sweep(cusp, "h", np.linspace(0, 0.6, 7))
    >>> times = np.array([0, 400.0, 3000.0])
    >>> slow = probability_of_tipping(found, lambda t: t / 5000, times, well=0, noise=0.05)
    >>> slow[["value", "probability", "valid"]].round(3)
       value  probability  valid
    0   0.00        0.000   True
    1   0.08        0.025   True
    2   0.60        1.000  False
    """
    if not noise > 0:
        raise Fault(f"the noise is {noise:g}", "give the positive ε of √ε dW")
    times = np.asarray(times, dtype=float)
    if times.ndim != 1 or len(times) < 2 or not (np.diff(times) > 0).all():
        raise ValueError("the times have to rise, and there have to be two of them at least")
    fine = np.unique(np.concatenate([np.linspace(one, other, WITHIN + 1) for one, other in pairwise(times)]))
    value = np.asarray(course(fine) if callable(course) else np.interp(fine, times, course), dtype=float)
    table = _rates(found.ways, well, noise)
    low, high = table["value"].iloc[[0, -1]]
    within = np.clip(value, low, high)
    log_rate = _interpolated(table, "log_rate", within)
    shut, lawless, unknown, ended = _regimes(found, well, noise, value)
    rate = np.where(shut, 0.0, np.exp(log_rate))
    law = np.where(lawless, 1.0, _interpolated(table, "law_error", within))
    drift = np.abs(np.gradient(log_rate, fine)) / _interpolated(table, "relaxation", within)
    integral, wrong = (
        cumulative_simpson(each, x=fine, initial=0.0) for each in (rate, rate * np.hypot(law, drift))
    )
    error = np.where(unknown | ended, np.inf, wrong / np.where(integral > 0, integral, np.inf))
    integral = np.where(ended, np.inf, integral)
    valid = error < 1 / MIN_BARRIER_OVER_NOISE
    reasons = [
        (ended, "the well has ended"),
        (unknown & ~ended, "the sweep knows no rate of this well here, or knew none before"),
        (
            ~valid & (law > drift),
            f"it was left where its barrier is below {MIN_BARRIER_OVER_NOISE:g} times the noise",
        ),
        (~valid & (drift >= law), "the parameter changes faster than the well relaxes"),
    ]
    at = np.searchsorted(fine, times)
    return pd.DataFrame(
        {
            "time": times,
            "value": value[at],
            "rate": np.where(ended | unknown, np.nan, rate)[at],
            "probability": -np.expm1(-integral[at]),
            "law_error": law[at],
            "drift_error": drift[at],
            "error": error[at],
            "valid": valid[at],
            "note": [next((text for holds, text in reasons if holds[k]), "") for k in at],
        }
    )


def _regimes(
    found: Sweep, well: int, noise: float, value: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Where no way leads out of a well, no law holds, nobody knows the rate or did before, and it has ended.

    Between two values of the sweep both have a say. Between one without a way out and one with a rate, this
    rate is taken, which is too high.
    """
    mine = found.table[found.table["well"] == well].sort_values("value")
    at = mine["value"].to_numpy(float)
    ways = found.ways[found.ways["well"] == well]
    lowest = ways.groupby("value")["barrier"].min().reindex(at).to_numpy(float)
    rated = ways["barrier"].notna() & ways["prefactor"].notna()
    known = rated.groupby(ways["value"]).all().reindex(at, fill_value=False).to_numpy(bool)
    alone = (mine["note"] == ALONE).to_numpy(bool)
    left = np.clip(np.searchsorted(at, value, side="right") - 1, 0, len(at) - 1)
    right = np.where((value < at[0]) | (value > at[-1]), left, np.minimum(left + 1, len(at) - 1))
    right = np.where(value == at[left], left, right)
    whole = found.table["value"]
    outside = (value < whole.min()) | (value > whole.max())
    lawless, unknown = lowest <= noise, ~known & ~alone & ~(lowest <= noise)
    first, last = _extent(found, well)
    return (
        alone[left] & alone[right],
        lawless[left] | lawless[right],
        np.logical_or.accumulate(unknown[left] | unknown[right] | outside),
        np.logical_or.accumulate((value < first) | (value > last)),
    )


def _extent(found: Sweep, well: int) -> tuple[float, float]:
    """The values between which a well exists; infinite where it goes on at the end of the sweep."""
    mine = found.branches[found.branches["well"] == well]
    whole = found.branches["value"]
    if mine.empty:
        return -np.inf, np.inf
    low, high = float(mine["value"].min()), float(mine["value"].max())
    own = found.bifurcations[found.bifurcations["branch"].isin(mine["branch"])]["value"].to_numpy(float)
    # The next point of the branch lies before the fold, by a step at most.
    below, above = own[own <= low], own[own >= high]
    ends = (
        -np.inf if low <= whole.min() else float(below.max()) if len(below) else low,
        np.inf if high >= whole.max() else float(above.min()) if len(above) else high,
    )
    return ends


def _rates(ways: pd.DataFrame, well: int, noise: float) -> pd.DataFrame:
    """The rate at which a well is left at each value where a law holds, with what its errors follow from."""
    mine = ways[ways["well"] == well]
    if mine.empty:
        raise ValueError(
            f"the well {well} has no way out; the sweep has the wells {sorted(set(ways['well']))}"
        )
    rows = []
    for value, some in mine.groupby("value"):
        height = some["barrier"].to_numpy(float) / noise
        rate = np.exp(-height) / some["prefactor"].to_numpy(float)
        if np.isfinite(rate).all() and (height > 1).all():
            law_error = float((rate / height).sum() / rate.sum())
            rows.append((value, float(np.log(rate.sum())), law_error, float(some["relaxation"].iloc[0])))
    if not rows:
        raise ValueError(
            f"no barrier of the well {well} is above the noise {noise:g}, and no law gives a rate"
        )
    return pd.DataFrame(rows, columns=["value", "log_rate", "law_error", "relaxation"]).sort_values("value")


def _interpolated(table: pd.DataFrame, column: str, value: np.ndarray) -> np.ndarray:
    """A column between the values of the parameter; the same everywhere where there is only one."""
    if len(table) == 1:
        return np.full(len(value), table[column].iloc[0])
    return np.asarray(PchipInterpolator(table["value"], table[column])(value))
