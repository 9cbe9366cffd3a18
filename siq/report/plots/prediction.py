"""Figures of predicted trajectories, residuals, and the record itself."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from siq.data.correlation import markov_lag
from siq.data.recordings import Recordings, snapshot_pairs
from siq.data.stationarity import lagged_covariances, long_run_covariance
from siq.inference.field_estimate import NOISE_FREE
from siq.inference.regression import lagged_pairs
from siq.numerics.integration import FlowMap
from siq.quasipotential.characteristics import fastest_rate
from siq.quasipotential.landscape import Landscape
from siq.report.plots.diagnosis import draw_errors
from siq.report.plots.quasipotential import new_axes, with_legend
from siq.report.plots.style import (
    BLUE,
    COLUMN_WIDTH,
    GREY,
    drawn_in_style,
    magnitude_label,
    name_label,
    scaled_label,
)
from siq.systems.dynamics import Dynamics

if TYPE_CHECKING:
    from siq.diagnosis.diagnosis import Diagnosis

RESIDUALS_BINS = 24
FEWEST = 8  # increments in a bin: a mean of fewer has no error worth the name
PAIRS = 60_000  # drawn from; more would only take longer
ACCURACY = 0.01  # of an integrator's step, times the norm of the Jacobian


def plot_residuals(
    found: Landscape | Diagnosis, recordings: Recordings | None = None, *, state: str | None = None,
    legend: bool = True, ax: Axes | None = None,
) -> Axes:  # fmt: skip
    """Draw what a vector field leaves of the recordings: noise about zero, if nothing is missing.

    Main arguments
    --------------
    found
        A landscape; or a diagnosis, of which the errors on the held-out recordings are drawn.
    recordings
        Of a landscape: what its f is held against, mostly what it was identified from.

    Other arguments
    ---------------
    state
        Which state is shown, or which output of a diagnosis; by default the first.
    legend
        Whether to say below the axes what is drawn.
    ax
        Where; by default new axes of pyplot.

    Returns
    -------
    matplotlib.axes.Axes
        Of a landscape: recorded increment minus the one that f predicts, per time, as means over bins of the
        state, with the band in which noise alone leaves 95 % of them. Of a diagnosis: simulation minus
        recording in the course of time.

    Raises
    ------
    ValueError
        When the recordings of a landscape are missing or have other states, or the state is unknown.
    """
    if not isinstance(found, Landscape):
        axes = new_axes() if ax is None else ax
        handles = draw_errors(axes, found, output=state)
        return with_legend(axes, handles, legend=legend)
    dynamics = found.dynamics
    if recordings is None or recordings.names != dynamics.states:
        have = "none are given" if recordings is None else f"these have {', '.join(recordings.names)}"
        raise ValueError(f"give recordings of {', '.join(dynamics.states)}; {have}")
    if state is not None and state not in dynamics.states:
        raise ValueError(f"there is no state {state}; name one of {', '.join(dynamics.states)}")
    place = 0 if state is None else dynamics.states.index(state)
    axes = new_axes() if ax is None else ax
    units = (dynamics.units[place], recordings.time_unit or dynamics.time_unit)
    handles = _draw(axes, *_binned_residuals(dynamics, recordings, place), dynamics.states[place], units)
    return with_legend(axes, handles, legend=legend)


@drawn_in_style
def residuals_figure(
    dynamics: Dynamics, recordings: Recordings, *, units: Sequence[str], time_unit: str = "1"
) -> Figure | None:
    """The figure of a page: what f leaves of the recorded increments, a panel for each state.

    None of recordings without noise, where nothing is left but rounding.
    """
    every = [_binned_residuals(dynamics, recordings, place) for place in range(dynamics.dimension)]
    if all(share < NOISE_FREE for _, share in every):
        return None
    figure = Figure(figsize=(COLUMN_WIDTH, 2.3 * len(every) + 0.5))
    panels = figure.subplots(len(every), squeeze=False)[:, 0]
    handles: dict[str, Any] = {}
    for axes, binned, name, unit in zip(panels, every, dynamics.states, units, strict=True):
        handles |= {one.get_label(): one for one in _draw(axes, *binned, name, (unit, time_unit))}
    figure.legend(handles=list(handles.values()), loc="outside lower center", ncols=1)
    return figure


def _binned_residuals(dynamics: Dynamics, recordings: Recordings, place: int) -> tuple[pd.DataFrame, float]:
    """What f leaves of one state's increments, per time, in bins along that state; and its share of them.

    A row for each bin: its middle, the mean of what is left, and the standard error of that mean. The share
    is one of root mean squares. Where recordings remember, the present state tells which way their noise
    pushes: bins are then along the state so much earlier, which does not.
    """
    turning = zip(dynamics.states, dynamics.limits, dynamics.periods, strict=True)
    memory = markov_lag(recordings, angles={name: ends for name, ends, period in turning if period})
    lag = memory.lag if memory.remembers else None
    if lag is None:
        pairs = snapshot_pairs(recordings)
        some = slice(None, None, max(len(pairs.h) // PAIRS, 1))
        along = pairs.x0[some, place]
    else:
        given = lagged_pairs(recordings, lag)
        pairs, some = given, slice(0, PAIRS)  # one after the other, as their noise is correlated
        along = given.earlier[some, place]
    x0, xh, h = pairs.x0[some], pairs.xh[some], pairs.h[some]
    steps = int(np.clip(np.ceil(h.max() * fastest_rate(dynamics, x0, np.ptp(x0, axis=0)) / ACCURACY), 1, 200))
    x = FlowMap(steps)(dynamics.drift_of_components, np.ascontiguousarray(x0.T), h)
    left = (xh[:, place] - x[place]) / h
    known, together = np.isfinite(left), 1.0
    if lag is not None:  # by how much the error of a mean is larger, since neighbours go together
        rest = np.where(known, left - left[known].mean(), 0.0)[:, None]
        covariances = lagged_covariances(rest, given.number[some], lag)
        whole = long_run_covariance(covariances, lag)
        together = float(np.sqrt(max(float(whole[0, 0] / covariances[0, 0, 0]), 1.0)))
    left, along = left[known], along[known]
    low, high = float(along.min()), float(along.max())
    which = np.minimum(
        (RESIDUALS_BINS * (along - low) / ((high - low) or 1.0)).astype(int), RESIDUALS_BINS - 1
    )
    rows = [which == one for one in np.unique(which) if (which == one).sum() >= FEWEST]
    rows = rows or [np.ones(len(along), dtype=bool)]
    binned = [
        (along[one].mean(), left[one].mean(), together * left[one].std(ddof=1) / np.sqrt(one.sum()))
        for one in rows
    ]
    share = float(np.sqrt(np.mean(left**2) / np.mean((xh - x0)[:, place] ** 2 / h**2)))
    return pd.DataFrame(binned, columns=["at", "mean", "standard_error"]), share


def _draw(axes: Axes, binned: pd.DataFrame, share: float, name: str, units: tuple[str, str]) -> list[Any]:
    """Draw residuals of a state on axes, with the units of the state and of time."""
    at, mean, error = binned.to_numpy().T
    quiet = share < NOISE_FREE  # rounding and the integrator are left, which no band is the measure of
    if not quiet:
        axes.fill_between(at, -2 * error, 2 * error, color=GREY, alpha=0.3, linewidth=0)
    axes.axhline(0.0, color=GREY, linewidth=0.8)
    axes.plot(at, mean, marker="o", markersize=4, linestyle="none", color=BLUE)
    largest = float(np.abs(at).max())
    axes.set_xlabel(scaled_label(axes.xaxis, f"${name_label(name)}$", units[0], largest))
    largest = max(abs(limit) for limit in axes.get_ylim())
    what = f"left of d${name_label(name)}$/d$t$"
    unit, per = ("" if each == "1" else each for each in units)
    rate = f"{unit or 1}/{per}" if per else unit and f"{unit} per time"
    axes.set_ylabel(scaled_label(axes.yaxis, what, rate, largest))
    within = int((np.abs(mean) <= 2 * error).sum())
    title = f"{within} of {len(binned)} bins within the band"
    if quiet:
        title = f"no noise: {magnitude_label(share, digits=1)} of the increments is left"
    axes.set_title(title, loc="left", fontsize="medium")
    handle = Line2D([], [], color=BLUE, marker="o", linestyle="none", label="mean of a bin")
    band = Patch(color=GREY, alpha=0.3, label="noise alone: ± 2 standard errors")
    return [handle] if quiet else [handle, band]
