"""How wrong the coefficients of U are, run by run (paper, Fig. stat)."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from siq.report.plots.style import (
    BLACK,
    BLUE,
    COLUMN_WIDTH,
    GREY,
    PAGE_WIDTH,
    VERMILLION,
    counted,
    drawn_in_style,
    magnitude_label,
    mean_and_spread,
)

GOLDEN_RATIO = (5**0.5 - 1) / 2


@drawn_in_style
def plot_error_distribution(
    rrmse: pd.DataFrame, *, published: tuple[float, float] | None = None
) -> Figure | None:
    """Draw the error of the coefficients of U, one dot a run.

    Parameters
    ----------
    rrmse
        Columns ``run method rrmse support_correct certified network_error``, one row per run × method.
        Runs without an error are counted in a note.
    published
        Mean and standard deviation of a published result, drawn as a band.

    Returns
    -------
    matplotlib.figure.Figure
        Relative root-mean-square error on a logarithmic axis, by method. Shape and colour tell whether the
        terms are exactly the right ones, a hollow mark that the run is not certified. None where fewer than
        two runs have an error.
    """
    if rrmse["run"].nunique() < 2 or not (rrmse["rrmse"] > 0).any():
        return None
    methods = list(dict.fromkeys(rrmse["method"]))
    figure = Figure(figsize=(COLUMN_WIDTH if len(methods) <= 2 else PAGE_WIDTH, 4.8))
    axes = figure.add_subplot()
    axes.set_yscale("log")
    labels = []
    notes = []
    for place, method in enumerate(methods):
        rows = rrmse[rrmse["method"] == method]
        measured = rows[rows["rrmse"] > 0].sort_values(["rrmse", "run"])
        _draw_runs(axes, place, measured)
        labels.append(f"{method}\n" + _summary(measured["rrmse"].to_numpy(float)))
        missing, zero = int(rows["rrmse"].isna().sum()), int((rows["rrmse"] == 0).sum())
        notes += [f"{method}: {counted(missing, 'run')} without an error"] if missing else []
        notes += [f"{method}: {counted(zero, 'run')} with no error at all"] if zero else []
    if published is not None:
        _draw_published(axes, *published)
    axes.set_xticks(range(len(methods)), labels)
    axes.set_xlim(-0.6, len(methods) - 0.4)
    axes.set_ylabel("relative error of the coefficients\nof $U$ (RRMSE, dimensionless)")
    axes.grid(axis="y", linewidth=0.3, color="#CCCCCC")
    axes.set_axisbelow(True)
    handles = _legend(rrmse, axes)
    figure.legend(handles=handles, loc="outside upper left", ncols=1)
    if notes:
        figure.supxlabel("\n".join(notes))
    return figure


def _is_true(column: pd.Series) -> np.ndarray:
    # The column holds missing values where nothing is known; those do not count as true.
    return np.array(
        [value is True or value is np.True_ or value == 1 for value in column.tolist()], dtype=bool
    )


def _draw_runs(axes: Axes, place: int, rows: pd.DataFrame) -> None:
    # Multiples of the golden ratio spread neighbours in size far apart, the same way every time.
    offsets = (
        0.56 * ((np.arange(len(rows)) * GOLDEN_RATIO) % 1 - 0.5) if len(rows) > 1 else np.zeros(len(rows))
    )
    values = rows["rrmse"].to_numpy(float)
    correct, certified = _is_true(rows["support_correct"]), _is_true(rows["certified"])
    for right in (True, False):
        for sure in (True, False):
            chosen = (correct == right) & (certified == sure)
            colour, marker = (BLUE, "o") if right else (VERMILLION, "^")
            axes.plot(
                place + offsets[chosen],
                values[chosen],
                linestyle="none",
                marker=marker,
                markersize=4,
                markeredgecolor=colour,
                markerfacecolor=colour if sure else "white",
                markeredgewidth=0.8,
            )
    if len(values):
        median = float(np.median(values))
        axes.plot([place - 0.36, place + 0.36], [median, median], color=BLACK, linewidth=1.2)


def _summary(values: np.ndarray) -> str:
    if values.size == 0:
        return "no run measured"
    if values.size == 1:
        return f"1 run\n{magnitude_label(float(values[0]), digits=3)}"
    spread = values.std(ddof=1)
    median = magnitude_label(float(np.median(values)))
    return f"{counted(values.size, 'run')}\nmedian {median}\n{mean_and_spread(values.mean(), spread)}"


def _draw_published(axes: Axes, mean: float, spread: float) -> None:
    lowest = axes.get_ylim()[0]
    bottom = mean - spread if mean > spread else min(lowest, mean / 10)
    axes.axhspan(bottom, mean + spread, color=GREY, alpha=0.25, linewidth=0, zorder=0)
    label = f"published: {mean_and_spread(mean, spread, digits=3)}"
    axes.axhline(mean, color=GREY, linewidth=1.0, linestyle="--", label=label, zorder=0.5)


def _legend(rrmse: pd.DataFrame, axes: Axes) -> list[Line2D]:
    measured = rrmse[rrmse["rrmse"] > 0]
    correct, certified = _is_true(measured["support_correct"]), _is_true(measured["certified"])
    entries = [
        (bool(correct.any()), "o", BLUE, BLUE, "exactly the right terms"),
        (bool((~correct).any()), "^", VERMILLION, VERMILLION, "terms missing or too many"),
        (bool((~certified).any()), "s", GREY, "white", "hollow: not certified"),
    ]
    handles = [
        Line2D(
            [],
            [],
            linestyle="none",
            marker=marker,
            markersize=4,
            markeredgecolor=edge,
            markerfacecolor=face,
            label=text,
        )
        for present, marker, edge, face, text in entries
        if present
    ]
    handles.append(
        Line2D([], [], color=BLACK, linewidth=1.2, label="median (last line: mean ± standard deviation)")
    )
    return handles + [line for line in axes.get_lines() if str(line.get_label()).startswith("published")]
