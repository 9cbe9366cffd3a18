"""The figure of official tests."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from siq.report.formatting import with_unit
from siq.report.plots.style import BLACK, BLUE, VERMILLION, WIDTH, drawn_to_be_read

FINE = 2000  # points of a curve that can be told apart on a page


@drawn_to_be_read
def plot_official_tests(runs: pd.DataFrame, *, unit: str, time_unit: str) -> Figure:
    """Draw every test of a benchmark: the course above, simulation minus recording below.

    Parameters
    ----------
    runs
        Columns ``test output t measured scored recalibrated augmented``; see
        `benchmarks.publication.official_scores.official_tables`.
    unit, time_unit
        Of the outputs, and of ``t``.
    """
    pairs = list(runs.groupby(["test", "output"], sort=False))
    figure = Figure(figsize=(WIDTH, 3.2 * len(pairs)))
    axes = figure.subplots(2 * len(pairs), 1, squeeze=False, height_ratios=[1.4, 1] * len(pairs))[:, 0]
    for place, ((test, output), rows) in enumerate(pairs):
        upper, lower = axes[2 * place], axes[2 * place + 1]
        t = rows["t"].to_numpy(float)
        measured = rows["measured"].to_numpy(float)
        upper.set_title(str(test), loc="left")
        upper.plot(*envelope(t, measured), color=BLACK, linewidth=0.8)
        upper.plot(
            *envelope(t, rows["augmented"].to_numpy(float)), color=VERMILLION, linewidth=0.8, linestyle="--"
        )  # fmt: skip
        for name, colour in (("recalibrated", BLUE), ("augmented", VERMILLION)):
            error = np.where(rows["scored"], rows[name].to_numpy(float) - measured, np.nan)
            lower.plot(*envelope(t, error), color=colour, linewidth=0.8)
        upper.set_ylabel(with_unit(str(output), unit))
        lower.set_ylabel(with_unit("off by", unit))
        lower.set_xlabel(with_unit("$t$", time_unit))
    handles = [
        Line2D([], [], color=BLACK, label="measured"),
        Line2D([], [], color=BLUE, label="its own parameters refitted"),
        Line2D([], [], color=VERMILLION, label="with what was found"),
    ]
    figure.legend(handles=handles, loc="outside upper left", ncols=3, columnspacing=1.2)
    return figure


def envelope(t: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A curve of few points that looks the same on a page: least and greatest value of every stretch."""
    if len(values) <= FINE:
        return t, values
    parts = np.array_split(np.arange(len(values)), FINE // 2)
    filled = np.where(np.isfinite(values), values, 0.0)
    chosen = np.array([place for part in parts for place in _ends(part, filled)])
    return t[chosen], values[chosen]


def _ends(part: np.ndarray, values: np.ndarray) -> list[int]:
    low, high = part[values[part].argmin()], part[values[part].argmax()]
    return sorted((int(low), int(high)))
