"""Figures of predictions: held-out trajectories (paper, Fig. 4a), and the visits of a record."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from string import ascii_lowercase
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, LogLocator

from siq.numerics.text import unit_text
from siq.report.plots.style import (
    BLACK,
    BLUE,
    COLUMN_WIDTH,
    GREY,
    ORANGE,
    PAGE_WIDTH,
    axis_label,
    counted,
    drawn_in_style,
    look,
    magnitude_label,
    mean_and_spread,
    unit_label,
)

TRAJECTORIES_SHOWN = 6
BINS = 40
OBSERVED: dict[str, Any] = {"color": ORANGE, "linewidth": 2.6, "alpha": 0.7}
PREDICTED: dict[str, Any] = {"color": BLACK, "linewidth": 0.9, "linestyle": "--"}


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
    handles = []
    for place, (method, rows) in enumerate(errors.groupby("method", sort=False)):
        all_of = rows["error"].to_numpy(float)
        found = all_of[np.isfinite(all_of)]
        lost, zero = int((~np.isfinite(all_of)).sum()), int((found == 0).sum())
        notes += [f"{method}: {counted(lost, 'prediction')} without an error"] if lost else []
        notes += [f"{method}: {counted(zero, 'prediction')} with no error at all"] if zero else []
        if not (found > 0).any():
            continue
        colour, style, _ = look(place)
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
