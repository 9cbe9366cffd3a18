"""Figures of predicted trajectories, residuals, and the record itself."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from string import ascii_lowercase
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, LogLocator

from siq.data.correlation import markov_lag
from siq.data.recordings import Recordings, snapshot_pairs
from siq.data.stationarity import lagged_covariances, long_run_covariance
from siq.inference.field_estimate import NOISE_FREE
from siq.inference.regression import lagged_pairs
from siq.numerics.integration import runge_kutta_step
from siq.numerics.text import unit_text
from siq.quasipotential.landscape import Landscape
from siq.report.plots.diagnosis import draw_errors
from siq.report.plots.errors import scaled_label
from siq.report.plots.quasipotential import add_legend, new_axes
from siq.report.plots.style import (
    BLACK,
    BLUE,
    COLUMN_WIDTH,
    GREEN,
    GREY,
    ORANGE,
    PAGE_WIDTH,
    PURPLE,
    VERMILLION,
    axis_label,
    counted,
    drawn_in_style,
    magnitude_label,
    mean_and_spread,
    name_label,
    unit_label,
)
from siq.systems.dynamics import Dynamics

TRAJECTORIES_SHOWN = 6
BINS = 40
OBSERVED: dict[str, Any] = {"color": ORANGE, "linewidth": 2.6, "alpha": 0.7}
PREDICTED: dict[str, Any] = {"color": BLACK, "linewidth": 0.9, "linestyle": "--"}
LINE_STYLES = ("-", "--", "-.", ":")


@drawn_in_style
def plot_prediction(
    observed: Sequence[np.ndarray],
    predicted: Sequence[np.ndarray],
    errors: pd.DataFrame,
    *,
    states: Sequence[str],
    units: Sequence[str],
    published: tuple[float, float] | None = None,
) -> Figure | None:
    """Draw held-out trajectories beside predicted ones, and the distribution of the errors.

    Parameters
    ----------
    observed, predicted
        Held-out trajectories and those of the identified f from the same initial states, each of shape
        ``(k, d)``; the first six are drawn, projected on the first two states.
    errors
        Columns ``method error`` (further ones are ignored), one row per trajectory and run:
        ``E_k = ‖X̂_k(t) - X_k(t)‖ / ‖X_k(t)‖``. Missing where a prediction ran to infinity; such are counted.
    states, units
        Names and units of the d states.
    published
        Mean and standard deviation of a published result, drawn as a band.

    Returns
    -------
    matplotlib.figure.Figure
        Two panels, one above the other; the errors by method on a logarithmic axis, medians as vertical
        lines. None where no prediction has an error.
    """
    known = errors["error"].to_numpy(float)
    if not len(observed) or not len(predicted) or not (np.isfinite(known) & (known > 0)).any():
        return None
    figure = Figure(figsize=(COLUMN_WIDTH, 7.8))
    left, right = figure.subplots(2, 1, height_ratios=[1.2, 1])
    _draw_trajectories(left, observed, predicted)
    labels = [axis_label(name, unit) for name, unit in zip(states, units, strict=True)]
    left.set_xlabel("number of the sample" if len(states) == 1 else labels[0])
    left.set_ylabel(labels[0] if len(states) == 1 else labels[1])
    shown = min(len(observed), len(predicted), TRAJECTORIES_SHOWN)
    noun = "trajectory" if shown == 1 else "trajectories"
    left.set_title(f"(a) {shown} held-out {noun}, • start", loc="left")
    _draw_errors(right, errors, published)
    right.set_title("(b) errors of the predictions, with medians", loc="left")
    return figure


def _draw_trajectories(axes: Axes, observed: Sequence[np.ndarray], predicted: Sequence[np.ndarray]) -> None:
    pairs = list(zip(observed, predicted, strict=False))[:TRAJECTORIES_SHOWN]
    for truth, prediction in pairs:
        # The observed curve is wide and pale: a prediction that lies on it leaves its rims visible.
        for path, style in ((truth, OBSERVED), (prediction, PREDICTED)):
            points = np.asarray(path)
            curve = (np.arange(len(points)), points[:, 0]) if points.shape[1] == 1 else points[:, :2].T
            axes.plot(*curve, **style)
            axes.plot(curve[0][0], curve[1][0], marker="o", markersize=3, color=BLACK)
    axes.legend(
        handles=[
            Line2D([], [], label="observed", **OBSERVED),
            Line2D([], [], label="identified $f$", **PREDICTED),
        ],
        loc="best",
    )


def _draw_errors(axes: Axes, errors: pd.DataFrame, published: tuple[float, float] | None) -> None:
    values = errors["error"].to_numpy(float)
    positive = values[np.isfinite(values) & (values > 0)]
    notes = []
    axes.set_xscale("log")
    lowest, highest = positive.min(), positive.max()
    spread = max(highest / lowest, 1.1)  # errors that are all alike have no width of their own
    edges = np.geomspace(lowest / spread**0.02, highest * spread**0.02, BINS + 1)
    colours = (BLUE, VERMILLION, GREEN, PURPLE)
    handles = []
    for place, (method, rows) in enumerate(errors.groupby("method", sort=False)):
        all_of = rows["error"].to_numpy(float)
        found = all_of[np.isfinite(all_of)]
        lost, zero = int((~np.isfinite(all_of)).sum()), int((found == 0).sum())
        notes += [f"{method}: {counted(lost, 'prediction')} without an error"] if lost else []
        notes += [f"{method}: {counted(zero, 'prediction')} with no error at all"] if zero else []
        if not (found > 0).any():
            continue
        colour, style = colours[place % len(colours)], LINE_STYLES[place % len(LINE_STYLES)]
        shares = np.histogram(found[found > 0], edges)[0] / len(all_of)
        axes.stairs(shares, edges, color=colour, linestyle=style, linewidth=1.2)
        axes.axvline(float(np.median(found)), color=colour, linestyle=style, linewidth=0.8)
        text = f"{method}, {counted(len(all_of), 'prediction')}: "
        text += f"median {magnitude_label(float(np.median(found)))},\nmean "
        text += mean_and_spread(found.mean(), found.std(ddof=1) if found.size > 1 else float("nan"))
        handles.append(Line2D([], [], color=colour, linestyle=style, label=text))
    if published is not None:
        handles.append(_draw_published(axes, *published))
    axes.set_xlabel("relative error of a trajectory")
    axes.set_ylabel("share of the predictions")
    axes.set_ylim(bottom=0)
    handles += [Line2D([], [], linestyle="none", label=note) for note in notes]
    axes.figure.legend(handles=handles, loc="outside lower center", ncols=1)


def _draw_published(axes: Axes, mean: float, spread: float) -> Line2D:
    lowest = axes.get_xlim()[0]
    # Where the deviation exceeds the mean, the band has no lower end on a logarithmic axis.
    axes.axvspan(mean - spread if mean > spread else min(lowest, mean / 10), mean + spread,
                 color=GREY, alpha=0.25, linewidth=0, zorder=0)  # fmt: skip
    label = f"published mean:\n{mean_and_spread(mean, spread, digits=3)}"
    return axes.axvline(mean, color=GREY, linewidth=1.0, linestyle=(0, (1, 1)), label=label, zorder=0.5)


if TYPE_CHECKING:
    from siq.diagnosis.diagnosis import Diagnosis

RESIDUALS_BINS = 24
FEWEST = 8  # increments in a bin: a mean of fewer has no error worth the name
PAIRS = 60_000  # drawn from; more would only take longer
ACCURACY = 0.01  # of an integrator's step, times the norm of the Jacobian


@dataclass(frozen=True)
class BinnedResiduals:
    """What f leaves of one state's increments, per time, in bins along that state.

    Attributes
    ----------
    at, mean, standard_error
        Of each bin: its middle, the mean of what is left, and the standard error of that mean.
    share
        Root mean square of what is left, as a share of that of the increments.
    """

    at: np.ndarray
    mean: np.ndarray
    standard_error: np.ndarray
    share: float


def plot_residuals(
    found: Landscape | Diagnosis,
    recordings: Recordings | None = None,
    *,
    state: str | None = None,
    legend: bool = True,
    ax: Axes | None = None,
) -> Axes:
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

    Examples
    --------
    >>> from matplotlib.figure import Figure
    >>> t, starts = np.linspace(0, 3, 61), np.random.default_rng(0).uniform(-1.5, 1.5, 60)
    >>> x = starts / np.sqrt(starts**2 + (1 - starts**2) * np.exp(-2 * t[:, None]))  # dx/dt = x - x³
    >>> recordings = Recordings.from_arrays(t, x.T[:, :, None], names=["x"])
    >>> axes = plot_residuals(Landscape.from_recordings(recordings), recordings, ax=Figure().add_subplot())
    >>> axes.get_xlabel()
    '$x$'
    """
    if not isinstance(found, Landscape):
        axes = new_axes() if ax is None else ax
        handles = draw_errors(axes, found, output=state)
        if legend:
            add_legend(axes, handles)
        return axes
    dynamics = found.dynamics
    if recordings is None or recordings.names != dynamics.states:
        have = "none are given" if recordings is None else f"these have {', '.join(recordings.names)}"
        raise ValueError(f"give recordings of {', '.join(dynamics.states)}; {have}")
    if state is not None and state not in dynamics.states:
        raise ValueError(f"there is no state {state}; name one of {', '.join(dynamics.states)}")
    place = 0 if state is None else dynamics.states.index(state)
    axes = new_axes() if ax is None else ax
    time_unit = recordings.time_unit or dynamics.time_unit
    handles = _draw(axes, binned_residuals(dynamics, recordings, place), dynamics.states[place],
                    (dynamics.units[place], time_unit))  # fmt: skip
    if legend:
        add_legend(axes, handles)
    return axes


@drawn_in_style
def residuals_figure(
    dynamics: Dynamics, recordings: Recordings, *, units: Sequence[str], time_unit: str = "1"
) -> Figure | None:
    """The figure of a page: what f leaves of the recorded increments, a panel for each state.

    None of recordings without noise, where nothing is left but rounding.
    """
    every = [binned_residuals(dynamics, recordings, place) for place in range(dynamics.dimension)]
    if all(one.share < NOISE_FREE for one in every):
        return None
    figure = Figure(figsize=(COLUMN_WIDTH, 2.3 * len(every) + 0.5))
    panels = figure.subplots(len(every), squeeze=False)[:, 0]
    handles: dict[str, Any] = {}
    for axes, binned, name, unit in zip(panels, every, dynamics.states, units, strict=True):
        handles |= {one.get_label(): one for one in _draw(axes, binned, name, (unit, time_unit))}
    figure.legend(handles=list(handles.values()), loc="outside lower center", ncols=1)
    return figure


def rate_unit(unit: str, time_unit: str) -> str:
    """The unit of a state per time, empty where both are plain numbers."""
    plain, timeless = unit in ("", "1"), time_unit in ("", "1")
    if timeless:
        return "" if plain else f"{unit} per time"
    return f"1/{time_unit}" if plain else f"{unit}/{time_unit}"


def binned_residuals(dynamics: Dynamics, recordings: Recordings, place: int) -> BinnedResiduals:
    """What f leaves of the increments of one state, in bins along it.

    Where recordings remember, the present state tells which way their noise pushes: bins are then along the
    state so much earlier, which does not.
    """
    memory = markov_lag(recordings)
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
    width = np.where((span := np.ptp(x0, axis=0)) > 0, span, 1.0)
    jacobian = dynamics.jacobian(x0) * width / width[:, None]
    rate = float(np.quantile(np.linalg.norm(jacobian, axis=(1, 2)), 0.99))
    steps = int(np.clip(np.ceil(h.max() * rate / ACCURACY), 1, 200))
    x = np.ascontiguousarray(x0.T)
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(steps):
            x = runge_kutta_step(dynamics.drift_of_components, x, h / steps)
    left = (xh[:, place] - x[place]) / h
    together = 1.0 if lag is None else _together(left, given.number[some], lag)
    known = np.isfinite(left)
    left, along = left[known], along[known]
    low, high = float(along.min()), float(along.max())
    which = np.minimum(
        (RESIDUALS_BINS * (along - low) / ((high - low) or 1.0)).astype(int), RESIDUALS_BINS - 1
    )
    rows = [which == one for one in np.unique(which) if (which == one).sum() >= FEWEST]
    rows = rows or [np.ones(len(along), dtype=bool)]
    return BinnedResiduals(
        np.array([along[one].mean() for one in rows]),
        np.array([left[one].mean() for one in rows]),
        np.array([together * left[one].std(ddof=1) / np.sqrt(one.sum()) for one in rows]),
        float(np.sqrt(np.mean(left**2) / np.mean((xh - x0)[:, place] ** 2 / h**2))),
    )


def _together(left: np.ndarray, number: np.ndarray, lag: int) -> float:
    """By how much the error of a mean is larger, since neighbours go together."""
    rest = np.where(np.isfinite(left), left - left[np.isfinite(left)].mean(), 0.0)[:, None]
    covariances = lagged_covariances(rest, number, lag)
    share = float(long_run_covariance(covariances, lag)[0, 0] / covariances[0, 0, 0])
    return float(np.sqrt(max(share, 1.0)))


def _draw(axes: Axes, binned: BinnedResiduals, name: str, units: tuple[str, str]) -> list[Any]:
    """Draw residuals of a state on axes, with the units of the state and of time."""
    quiet = binned.share < NOISE_FREE  # rounding and the integrator are left, which no band is the measure of
    if not quiet:
        band = 2 * binned.standard_error
        axes.fill_between(binned.at, -band, band, color=GREY, alpha=0.3, linewidth=0)
    axes.axhline(0.0, color=GREY, linewidth=0.8)
    axes.plot(binned.at, binned.mean, marker="o", markersize=4, linestyle="none", color=BLUE)
    largest = float(np.abs(binned.at).max())
    axes.set_xlabel(scaled_label(axes.xaxis, f"${name_label(name)}$", units[0], largest))
    largest = max(abs(limit) for limit in axes.get_ylim())
    what = f"left of d${name_label(name)}$/d$t$"
    axes.set_ylabel(scaled_label(axes.yaxis, what, rate_unit(*units), largest))
    within = int((np.abs(binned.mean) <= 2 * binned.standard_error).sum())
    title = f"{within} of {len(binned.at)} bins within the band"
    if quiet:
        title = f"no noise: {magnitude_label(binned.share, digits=1)} of the increments is left"
    axes.set_title(title, loc="left", fontsize="medium")
    mean = Line2D([], [], color=BLUE, marker="o", linestyle="none", label="mean of a bin")
    return [mean] if quiet else [mean, Patch(color=GREY, alpha=0.3, label="noise alone: ± 2 standard errors")]


MOST = 6  # histograms


@drawn_in_style
def plot_record(
    record: pd.DataFrame, density: pd.DataFrame, *, units: Mapping[str, str], time_unit: str = "1"
) -> Figure | None:
    """Draw mean visits to each well, counted and predicted, and the histograms beside the densities.

    Parameters
    ----------
    record, density
        Rows of one run of the tables `record` and `record_density`.
    units
        Of each state.
    time_unit
        Of the recordings.

    Returns
    -------
    matplotlib.figure.Figure
        None where there is no test.
    """
    if record.empty:
        return None
    groups = list(density.groupby(["attractor", "state"], sort=False))[:MOST]
    rows = 1 + math.ceil(len(groups) / 2)
    figure = Figure(figsize=(PAGE_WIDTH, 1.5 + 0.35 * len(record) + 2.1 * (rows - 1)))
    heights = [1.2 + 0.35 * len(record), *[2.1] * (rows - 1)]
    grid = figure.add_gridspec(rows, 2, height_ratios=heights)
    _visits(figure.add_subplot(grid[0, :]), record, time_unit)
    for place, ((attractor, state), rows_of) in enumerate(groups):
        axes = figure.add_subplot(grid[1 + place // 2, place % 2])
        _histogram(axes, rows_of)
        axes.set_title(f"({ascii_lowercase[place + 1]}) visits to the well about\n{attractor}", loc="left")
        axes.set_xlabel(axis_label(str(state), units.get(str(state), "1")))
        if place % 2 == 0:
            axes.set_ylabel("density")
    handles = [Patch(color=ORANGE, alpha=0.6, label="the record"), Patch(color=BLUE, label="by f, D and ε")]
    figure.legend(handles=handles, loc="outside lower center", ncols=2)
    return figure


def _visits(axes: Axes, record: pd.DataFrame, time_unit: str) -> None:
    for place, one in enumerate(record.to_dict("records")):
        low, high = float(one["lowest"]), float(one["highest"])
        if one["visits"]:
            axes.plot([low, high], [place + 0.12] * 2, color=ORANGE, linewidth=2)
            axes.plot(one["counted"], place + 0.12, "o", color=ORANGE)
        else:
            axes.plot(low, place + 0.12, ">", color=ORANGE)
        factor = math.exp(2 * one["predicted_error"] / one["predicted"])
        ends = [one["predicted"] / factor, one["predicted"] * factor]
        axes.plot(ends, [place - 0.12] * 2, color=BLUE, linewidth=2)
        axes.plot(one["predicted"], place - 0.12, "s", color=BLUE)
    axes.set_xscale("log")
    for each in (axes.xaxis.set_major_formatter, axes.xaxis.set_minor_formatter):
        each(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_locator(LogLocator(subs=(2, 5)))
    axes.set_ylim(-0.6, len(record) - 0.4)
    axes.set_yticks(range(len(record)), [str(one) for one in record["attractor"]])
    axes.invert_yaxis()
    unit = unit_label(time_unit) if unit_text(time_unit) else ""
    axes.set_xlabel(f"mean visit {unit}".strip())
    axes.set_title("(a) how long visits last, with intervals of 95 %", loc="left")
    axes.grid(axis="x", color=GREY, alpha=0.3, linewidth=0.5)


def _histogram(axes: Axes, rows: pd.DataFrame) -> None:
    edges = np.append(rows["lower"].to_numpy(), rows["upper"].to_numpy()[-1])
    axes.stairs(rows["counted"].to_numpy(), edges, color=ORANGE, fill=True, alpha=0.6)
    middles = (edges[1:] + edges[:-1]) / 2
    axes.plot(middles, rows["predicted"].to_numpy(), color=BLUE, linewidth=1.2)
    axes.set_ylim(bottom=0)
