"""Tipping: the probability that a well has been left while a parameter drifts, and early warning by a record.

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

**From a record alone** that drifts, `early_warning` estimates the equation

    dx = (Σ_k c_k xᵏ + t Σ_k d_k xᵏ) dt + √Q dW + measurement noise

by the likelihood of the record, and goes on with it to later times. About a fold every f is of second order
in x, with a constant that moves; the third order and a slope that moves allow for what is farther away, and
how much of them is believed is left to their evidence. The distribution of the estimates is drawn from, and
for each draw the Fokker–Planck equation in f(x, t) is solved from the last state on, absorbed beyond the
saddle. So it needs no law of small noise, and holds where the barrier is low and where the well has ended.

References
----------
N. Berglund, B. Gentz, Noise-Induced Phenomena in Slow–Fast Dynamical Systems (2006), chapter 3.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pandas as pd
import scipy.special
from scipy.integrate import cumulative_simpson
from scipy.interpolate import PchipInterpolator
from scipy.linalg import solve_banded

from siq.data.recordings import Recordings
from siq.data.stationarity import relaxation_samples, runs_of, usual_step
from siq.errors import Fault, NumericalFailure
from siq.inference.kalman_filter import whiten
from siq.inference.maximum_likelihood import first_noise, fit_by_filter, noise_uncertainty
from siq.inference.measurements import first_states, measurements
from siq.numerics.text import listed
from siq.quasipotential.fokker_planck import exchange_rates
from siq.quasipotential.rates import MIN_BARRIER_OVER_NOISE
from siq.remarks import Remark, sentence
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import TIME, Dynamics, Parameter, symbol
from siq.workflow.sweep import Sweep

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WITHIN = 32  # steps of the integral between two times: Simpson's error falls as their fourth power

ORDERS, MOVING = 4, 2  # powers of x in f, and those of them, the lowest, that change in time
FAMILIES = ((4, 2), (4, 1), (3, 2), (3, 1))  # how many of each, of the equations that are averaged over
PER_RELAXATION = 10  # samples used in a relaxation time: more tell little more of f
REPLICAS = 60  # records that the fit makes: its bias is then known to an eighth of a standard error
DRAWS = 300  # of the distribution of the estimates: ends of an interval are then good to 1.3 % of probability
CELLS = 300  # in three times the range of the record
DATES, SUBSTEPS = 60, 4  # of the continuation; steps of the equation between two
BEHIND = 3.0  # of U/ε that a state is below the saddle, and does not return (5 %)
MOMENTS = 25  # along the record at which barrier and mean time are stated
LONGEST = 1e12  # numerical: relaxation times, beyond which a mean time is not told from infinity
LEVEL = 0.9  # of the intervals
LAGS = 20  # samples, within which residuals are asked for a memory
REFUSED = 0.01  # probability with which each claim is refused of a record for which it holds


def probability_of_tipping(
    found: Sweep, course: Callable[[np.ndarray], np.ndarray] | np.ndarray, times: np.ndarray, *, well: int,
    noise: float,
) -> pd.DataFrame:  # fmt: skip
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
        (ended, Remark("workflow.well_has_ended")),
        (unknown & ~ended, Remark("workflow.rate_unknown")),
        (~valid & (law > drift), Remark("workflow.left_without_law", {"ratio": MIN_BARRIER_OVER_NOISE})),
        (~valid & (drift >= law), Remark("workflow.drift_faster_than_relaxation")),
    ]
    at = np.searchsorted(fine, times)
    columns = {
        "time": times, "value": value[at], "rate": np.where(ended | unknown, np.nan, rate)[at],
        "probability": -np.expm1(-integral[at]), "law_error": law[at], "drift_error": drift[at],
        "error": error[at], "valid": valid[at],
        "note": [next((sentence(remark) for holds, remark in reasons if holds[k]), "") for k in at],
    }  # fmt: skip
    return pd.DataFrame(columns)


def _regimes(
    found: Sweep, well: int, noise: float, value: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Where no way leads out of a well, no law holds, no rate is known or was before, and it has ended.

    Between two values of the sweep both have a say. Between one without a way out and one with a rate, this
    rate is taken, which is too high.
    """
    mine = found.table[found.table["well"] == well].sort_values("value")
    at = mine["value"].to_numpy(float)
    ways = found.ways[found.ways["well"] == well]
    lowest = ways.groupby("value")["barrier"].min().reindex(at).to_numpy(float)
    rated = ways["barrier"].notna() & ways["prefactor"].notna()
    known = rated.groupby(ways["value"]).all().reindex(at, fill_value=False).to_numpy(bool)
    alone = np.isposinf(mine["barrier"].to_numpy(float))
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
    return (
        -np.inf if low <= whole.min() else float(below.max()) if len(below) else low,
        np.inf if high >= whole.max() else float(above.min()) if len(above) else high,
    )


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


class _EarlyWarning(NamedTuple):
    """What a record that drifts tells of the barrier of its state, and of when it will be left."""

    state: str  #: name of the column
    #: Barrier and mean time along the record, each with its 90 % interval: ``time barrier_over_noise
    #: barrier_lower barrier_upper mean_time mean_time_lower mean_time_upper``. The mean time is that until
    #: the state would be left if nothing changed from then on.
    course: pd.DataFrame
    #: That the state has been left by later times, ``time probability lower upper``: a mean over all that the
    #: record leaves open, and an interval that holds 90 % of that.
    probability: pd.DataFrame
    #: Probability that the barrier is lower at the end of the record than at its start; where a draw has no
    #: saddle near the record at either, that the state relaxes more slowly.
    falling: float
    weights: dict[tuple[int, int], float]  #: of equations, by how many powers of x, and how many of them move
    remarks: tuple[Remark, ...]  #: which presuppositions the record contradicts
    time_unit: str | None  #: of the record, None where it does not say

    @property
    def notes(self) -> tuple[str, ...]:
        """`remarks` in words."""
        return tuple(map(sentence, self.remarks))

    def plot(self) -> Figure:
        """Barrier and mean time along the record, and the probability afterwards."""
        from siq.report.plots.sweep import plot_early_warning

        return plot_early_warning(self.course, self.probability, state=self.state, time_unit=self.time_unit)


def early_warning(
    recordings: Recordings | pd.DataFrame | str | Path, *, until: float, state: str | None = None,
    seed: int = 0,
) -> _EarlyWarning:  # fmt: skip
    """How soon will a state be left, by a record of it that drifts?

    Parameters
    ----------
    recordings
        A record that stays in one state and drifts, sampled several times in a relaxation time. Several
        recordings share their clock.
    until
        The last time asked for, after the end of the record, in its unit of time.
    state
        The column that tips, where there are several.
    seed
        Of the draws from the distribution of the estimates.

    Returns
    -------
    _EarlyWarning
        Its `remarks` say where the record contradicts what is presupposed: that the state is one number and
        has no memory, and that f changes evenly in time and goes on so.

    Raises
    ------
    InputError
        For recordings that cannot be read.
    Fault
        For a column that is not there, a time that is not after the record, and one that is too short.
    NumericalFailure
        When no equation can be fitted.

    Examples
    --------
    >>> import siq
    >>> warning = siq.early_warning("lake.csv", until=2040)  # doctest: +SKIP
    >>> warning.probability.iloc[-1]  # doctest: +SKIP
    """
    recordings = Recordings.of(recordings)
    if state is None and len(recordings.names) == 1:
        state = recordings.names[0]
    if state not in recordings.names:
        fault = f"the column '{state}' is not there" if state else "there are several columns"
        raise Fault(fault, f"name the one that tips, {listed(recordings.names)}, as 'state'")
    end = float(recordings.t.max())
    if not until > end:
        raise Fault(f"the time {until:g} is not after the record, which ends at {end:g}", "give a later one")
    values = recordings.values[:, recordings.names.index(state)]
    relaxation = relaxation_samples(values, runs_of(recordings))
    if relaxation is None:
        raise Fault("the record is too short to show how a deviation relaxes", "give a longer one")
    stride = max(int(relaxation / PER_RELAXATION), 1)
    parts = [
        np.flatnonzero(recordings.recording == k)[::-stride][::-1] for k in range(len(recordings.labels))
    ]
    used = np.concatenate(parts)
    # Time in relaxation times from the end of the record, x in standard deviations.
    unit, middle, spread = relaxation * usual_step(recordings), values[used].mean(), values[used].std()
    t, x = (recordings.t[used] - end) / unit, (values[used] - middle) / spread
    place = symbol("x")
    names = [f"c{k}" for k in range(ORDERS)] + [f"d{k}" for k in range(MOVING)]
    powers = [place**k for k in range(ORDERS)] + [TIME * place**k for k in range(MOVING)]
    model = Dynamics(
        ("x",), (sum(symbol(name) * one for name, one in zip(names, powers, strict=True)),),
        Diffusion.identity(1), outputs=(("x", place),),
        parameters=tuple(Parameter(name, -1.0 if name == "c1" else 0.0) for name in names),
    )  # fmt: skip
    bounds = np.cumsum([0, *map(len, parts)])
    cut = [slice(int(a), int(b)) for a, b in pairwise(bounds)]
    scaled = Recordings.from_arrays([t[one] for one in cut], [x[one, None] for one in cut], names=["x"])
    data = measurements(scaled, model)
    begin = first_states(model, data)
    fit = fit_by_filter(model, data, x=begin, noise=first_noise(model, data, begin))
    if fit.fault or not fit.has_process_noise:
        raise NumericalFailure(fit.fault or "the record shows no noise that drives the state")
    generator = np.random.default_rng(seed)
    _, noise_error, covariance, _ = noise_uncertainty(fit, data)
    fitted = fit.model.values - _bias(fit.model.values, fit.noise.process[0], t, x, bounds[:-1], generator)
    coefficients, weights = _drawn(fitted, covariance, generator)
    noise = fit.noise.process[0] * np.exp(min(noise_error[0], 1.0) * generator.normal(size=DRAWS))
    width = np.ptp(x)
    process = _DrawnProcess(np.linspace(x.min() - width, x.max() + width, CELLS), coefficients, noise)
    times = np.linspace(0.0, (until - end) / unit, DATES + 1)
    left = process.left_by(times, float(fit.x[np.argmax(t), 0]))
    moments = np.linspace(t.min(), 0.0, MOMENTS)
    nearest = [np.abs(t - one) <= np.ptp(t) / MOMENTS for one in moments]
    stated = np.array(
        [process.frozen(one, float(x[near].mean())) for one, near in zip(moments, nearest, strict=True)]
    )  # (moments, 3, draws)
    ends = [(1 - LEVEL) / 2, (1 + LEVEL) / 2]
    # Not interpolated between draws, of which some have no saddle, and so an infinite barrier.
    middles, lower, upper = np.quantile(stated, [0.5, *ends], axis=2, method="inverted_cdf")
    course = pd.DataFrame({"time": end + moments * unit})
    for k, (name, scale) in enumerate([("barrier", 1.0), ("mean_time", unit)]):
        course["barrier_over_noise" if k == 0 else name] = middles[:, k] * scale
        course[f"{name}_lower"], course[f"{name}_upper"] = lower[:, k] * scale, upper[:, k] * scale
    low, high = np.quantile(left, ends, axis=1)
    probability = pd.DataFrame(
        {"time": end + times * unit, "probability": left.mean(axis=1), "lower": low, "upper": high}
    )
    rest = whiten(fit.linearisation, data, fit.noise).innovations
    falls, slows = stated[-1, 0] < stated[0, 0], stated[-1, 2] < stated[0, 2]
    falling = float(np.where(np.isinf(stated[[0, -1], 0]).all(axis=0), slows, falls).mean())
    remarks = _contradictions(rest, x, t)
    return _EarlyWarning(state, course, probability, falling, weights, remarks, recordings.time_unit)


def _bias(
    values: np.ndarray, noise: float, t: np.ndarray, x: np.ndarray, first: np.ndarray,
    generator: np.random.Generator,
) -> np.ndarray:  # fmt: skip
    """Mean error of coefficients that are fitted to a record which stays in its state, shape ``(p,)``.

    Restoring forces come out too strong: a little from any finite record, since a step depends on the noise
    before (M. G. Kendall, Biometrika 41 (1954) 403), and more from one that could have left the state and has
    not. The fit makes records of its own; those that stay are fitted by least squares, and are off by as
    much. Zero where it makes hardly any that stays. Recordings begin at the rows `first`.
    """
    begins = np.isin(np.arange(1, len(t)), first)
    step = np.where(begins, 0.0, np.diff(t))
    low, high = x.min() - np.ptp(x) / 2, x.max() + np.ptp(x) / 2
    path = np.empty((len(t), REPLICAS))
    path[0], stays = x[0], np.ones(REPLICAS, dtype=bool)
    kicks = np.sqrt(noise * step)[:, None] * generator.normal(size=(len(step), REPLICAS))
    constant, moving = values[:ORDERS, None], values[ORDERS:, None]
    for k, dt in enumerate(step):
        powers = path[k] ** np.arange(ORDERS)[:, None]
        force = (constant * powers).sum(axis=0) + t[k] * (moving * powers[:MOVING]).sum(axis=0)
        state = x[k + 1] if begins[k] else path[k] + force * dt + kicks[k]
        stays &= (low < state) & (state < high)
        path[k + 1] = np.clip(state, low, high)
    if stays.sum() < REPLICAS / 4:
        return np.zeros(len(values))
    found = []
    for one in path[:, stays].T:
        columns = one[:-1, None] ** np.arange(ORDERS)
        columns = np.hstack([columns, t[:-1, None] * columns[:, :MOVING]])
        moved = np.where(begins, 0.0, np.diff(one))
        found.append(np.linalg.solve((columns * step[:, None]).T @ columns, columns.T @ moved))
    return np.asarray(np.mean(found, axis=0) - values)


def _drawn(
    values: np.ndarray, covariance: np.ndarray, generator: np.random.Generator
) -> tuple[np.ndarray, dict[tuple[int, int], float]]:
    """Coefficients drawn from their distribution ``(draws, p)``, and the weights of the families in it.

    The likelihood of a fit is normal in its coefficients. So those of an equation without some of them are
    what it is where these are zero, and what it is worth is, up to what all have in common,

        ``ln w = -½ zᵀ C_zz⁻¹ z - k``

    with the estimates z that are left out and k that are kept (H. Akaike, IEEE Trans. Autom. Control 19
    (1974) 716). None of the equations is the true one. And ``½ k ln n`` would expect coefficients as large as
    a single relaxation shows, where an f that bends over the distance to the saddle has such as are within
    their errors: the barrier would seem to be known.
    """
    found = []
    for orders, moving in FAMILIES:
        kept = np.array([*range(orders), *range(ORDERS, ORDERS + moving)])
        out = np.setdiff1d(np.arange(len(values)), kept)
        gain = np.linalg.solve(covariance[np.ix_(out, out)], covariance[np.ix_(out, kept)])
        mean = values[kept] - values[out] @ gain
        spread = covariance[np.ix_(kept, kept)] - covariance[np.ix_(kept, out)] @ gain
        misfit = float(values[out] @ np.linalg.solve(covariance[np.ix_(out, out)], values[out]))
        found.append((kept, mean, spread, -0.5 * misfit - len(kept)))
    weights = scipy.special.softmax([one[3] for one in found])
    family = generator.choice(len(found), size=DRAWS, p=weights)
    drawn = np.zeros((DRAWS, len(values)))
    for number, (kept, mean, spread, _) in enumerate(found):
        rows = np.flatnonzero(family == number)
        drawn[np.ix_(rows, kept)] = generator.multivariate_normal(mean, spread, size=len(rows), method="eigh")
    return drawn, dict(zip(FAMILIES, map(float, weights), strict=True))


def _contradictions(rest: np.ndarray, x: np.ndarray, t: np.ndarray) -> tuple[Remark, ...]:
    """What whitened residuals ``(n,)`` say against the equation: a memory, and a change that is not even."""
    rest = (rest - rest.mean()) / rest.std()
    n, found = len(rest), []
    correlations = np.array([rest[:-lag] @ rest[lag:] / n for lag in range(1, LAGS + 1)])
    memory = float(scipy.special.chdtrc(LAGS, n * (correlations**2).sum()))
    if memory < REFUSED:
        found.append(Remark("workflow.warning_with_memory", {"probability": memory}))
    # The next order in time, less what the equation has: curvature of the constant, and of the slope.
    time = np.linspace(-1, 1, n) if np.ptp(t) == 0 else 2 * (t - t.min()) / np.ptp(t) - 1
    known = np.column_stack([*(x**k for k in range(ORDERS)), time, time * x])
    curved = np.column_stack([time**2, time**2 * x])
    curved = curved - known @ np.linalg.lstsq(known, curved, rcond=None)[0]
    score = curved.T @ rest
    uneven = float(scipy.special.chdtrc(2, score @ np.linalg.solve(curved.T @ curved, score)))
    if uneven < REFUSED:
        found.append(Remark("workflow.warning_uneven", {"probability": uneven}))
    return tuple(found)


class _DrawnProcess:
    """Fokker–Planck operators of drawn equations on the same cells, shape ``(draws, cells)``.

    Neighbouring cells exchange at Scharfetter and Gummel's rates, with ``z = -ΔU/ε`` and ``a = Q/2``.
    Tridiagonal systems of all draws are solved as one. Beyond both ends all is absorbed.
    """

    def __init__(self, x: np.ndarray, coefficients: np.ndarray, noise: np.ndarray) -> None:
        self.x, self.coefficients, self.noise = x, coefficients, noise
        self.cells, self.draws = np.arange(len(x)), np.arange(len(noise))
        self.integrals = np.stack([x ** (k + 1) / (k + 1) for k in range(ORDERS)])

    def heights(self, t: float) -> np.ndarray:
        """U/ε of each draw at each cell: ``-(2/Q) ∫ f dx``."""
        now = self.coefficients[:, :ORDERS].copy()
        now[:, :MOVING] += t * self.coefficients[:, ORDERS:]
        return np.asarray(-2 / self.noise[:, None] * (now @ self.integrals))

    def bottom(self, u: np.ndarray, start: np.ndarray) -> np.ndarray:
        """The cells to which f leads, shape ``(draws,)``: an end where there is no well on the way."""
        at, last = start.copy(), len(self.x) - 1
        for _ in self.cells:
            here, left, right = (u[self.draws, np.clip(at + k, 0, last)] for k in (0, -1, 1))
            step = np.where((right < here) & (right <= left), 1, np.where(left < here, -1, 0))
            if not step.any():
                break
            at = np.clip(at + step, 0, last)
        return at

    def rims(self, u: np.ndarray, well: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The first cells behind the saddles on both sides, the ends where there is none; and ΔU/ε."""
        barrier, behind = np.full(len(u), np.inf), []
        for side in (-1, 1):
            order = self.cells[::side]
            beyond = side * (order - well[:, None]) >= 0
            crest = np.maximum.accumulate(np.where(beyond, u[:, order], -np.inf), axis=1)
            below = beyond & (u[:, order] < crest - BEHIND)
            some, first = below.any(axis=1), below.argmax(axis=1)
            barrier = np.where(some, np.minimum(barrier, crest[self.draws, first]), barrier)
            behind.append(np.where(some, order[first], order[-1]))
        at_end = (well == 0) | (well == len(self.x) - 1)
        return behind[0], behind[1], np.where(at_end, 0.0, barrier - u[self.draws, well])

    def _solved(self, u: np.ndarray, inside: np.ndarray, right: np.ndarray, *, dt: float) -> np.ndarray:
        """Densities p, zero outside, with ``p - dt L p = right``; with an infinite dt, ``-L p = right``."""
        scale = self.noise[:, None] / (2 * (self.x[1] - self.x[0]) ** 2)
        up, down = exchange_rates(-np.diff(u, axis=1), scale)
        # Out of each cell to the right and to the left; nothing comes back from outside.
        up, down = inside * np.hstack([up, scale]), inside * np.hstack([scale, down])
        own, dt = (1.0, dt) if np.isfinite(dt) else (1.0 * ~inside, 1.0)
        above, below = np.pad(down[:, 1:], [(0, 0), (1, 0)]), np.pad(up[:, :-1], [(0, 0), (0, 1)])
        bands = np.stack([one.ravel() for one in (-dt * above, own + dt * (up + down), -dt * below)])
        solved = solve_banded((1, 1), bands, np.where(inside, right, 0.0).ravel(), check_finite=False)
        return np.where(inside, solved.reshape(u.shape), 0.0)

    def frozen(self, t: float, start: float) -> np.ndarray:
        """ΔU/ε, the mean time until a state near `start` is left, and the rate of relaxation; ``(3, draws)``.

        All of them if f stays as it is.
        """
        u, first = self.heights(t), np.full(len(self.draws), np.abs(self.x - start).argmin())
        well = self.bottom(u, first)
        lower, upper, barrier = self.rims(u, well)
        at_end = (well == 0) | (well == self.cells[-1])
        begin = np.where(at_end, first, well)[:, None] == self.cells
        inside = (self.cells > lower[:, None]) & (self.cells < upper[:, None])
        time = self._solved(u, inside, 1.0 * begin, dt=np.inf).sum(axis=1)
        near = np.clip(well + np.array([[-1], [0], [1]]), 0, self.cells[-1])
        curvature = np.diff(u[self.draws, near], n=2, axis=0)[0] / (self.x[1] - self.x[0]) ** 2
        return np.stack(
            [barrier, np.where((time >= 0) & (time < LONGEST), time, np.inf), self.noise / 2 * curvature]
        )

    def left_by(self, times: np.ndarray, start: float) -> np.ndarray:
        """The probability of each draw that the state has been left by times from 0 on, ``(n, draws)``.

        What counts as left lies behind the saddle wherever it comes to stand until the last of them.
        """
        first = np.full(len(self.draws), np.abs(self.x - start).argmin())
        p, left = 1.0 * (first[:, None] == self.cells), [np.zeros(len(first))]
        well, (lower, upper) = first, (np.full(len(first), end) for end in (len(self.x), -1))
        held = np.ones(len(first), dtype=bool)
        for t in times[:: max(len(times) // 10, 1)]:
            u = self.heights(t)
            bottom = self.bottom(u, well)
            if t > times[0]:  # a well that has ended leads elsewhere
                held &= (bottom > lower) & (bottom < upper)
            well = np.where(held, bottom, well)
            some = self.rims(u, well)
            lower = np.where(held, np.minimum(lower, some[0]), lower)
            upper = np.where(held, np.maximum(upper, some[1]), upper)
        inside = (self.cells > lower[:, None]) & (self.cells < upper[:, None])
        for begin, end in pairwise(times):
            dt = (end - begin) / SUBSTEPS
            for k in range(SUBSTEPS):
                p = self._solved(self.heights(begin + (k + 0.5) * dt), inside, p, dt=dt)
            left.append(1 - p.sum(axis=1))
        return np.clip(left, 0.0, 1.0)
