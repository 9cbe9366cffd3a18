"""The record beside what was identified: how long visits last, and how states are spread."""

from __future__ import annotations

import math
from collections.abc import Mapping
from string import ascii_lowercase

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, LogLocator

from siq.numerics.measured_text import unit_text
from siq.report.plots.style import (
    BLUE,
    GREY,
    ORANGE,
    PAGE_WIDTH,
    axis_label,
    drawn_in_style,
    unit_label,
)

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
