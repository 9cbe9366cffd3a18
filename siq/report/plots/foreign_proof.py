"""What the diagnosis had of the gain that could be had, for functions that nobody had a name for."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from siq.report.plots.style import (
    BLUE,
    GREEN,
    GREY,
    PAGE_WIDTH,
    VERMILLION,
    counted,
    drawn_in_style,
    say,
    sentence_figure,
)

LEVELS = {40.0: ("o", BLUE), 30.0: ("s", VERMILLION), 20.0: ("^", GREEN)}
LEAST = -0.5  # shares of the gain below are drawn at the edge


@drawn_in_style
def plot_foreign_proof(scores: pd.DataFrame, *, enough: float = 0.9) -> Figure:
    """Draw what was had of the gain on held-out recordings, and whether places are right.

    Parameters
    ----------
    scores
        Columns ``noise_db told_effect told_equation share_of_gain gain_asked place_asked place_right``, one
        row a case.
    enough
        Share of the gain that is marked.

    Returns
    -------
    matplotlib.figure.Figure
        Left the share of the oracle's gain in each case, against what the recordings tell of the function;
        right the share of right places against what they tell of the place.
    """
    if scores.empty:
        return sentence_figure("There is no case to show.")
    figure = Figure(figsize=(PAGE_WIDTH, 2.9))
    left, right = figure.subplots(1, 2)
    _gains(left, scores[scores["gain_asked"]], enough)
    _places(right, scores[scores["place_asked"]])
    return figure


def _gains(axes: Axes, asked: pd.DataFrame, enough: float) -> None:
    if asked.empty:
        say(axes, "No gain could be had.")
        return
    for level, (marker, colour) in LEVELS.items():
        own = asked[asked["noise_db"] == level]
        share = own["share_of_gain"].fillna(LEAST).clip(lower=LEAST)
        axes.plot(
            own["told_effect"].clip(lower=1), share, marker, markersize=4, color=colour,
            label=f"{level:g} dB ({counted(len(own), 'case')})",
        )  # fmt: skip
    axes.axhline(enough, color=GREY, linewidth=0.8, linestyle="--")
    axes.set_xscale("log")
    axes.set_xlabel("$\\Delta\\chi^2$ of the function\n(dimensionless)")
    axes.set_ylabel("share of the oracle's gain\non held-out recordings")
    axes.set_title(counted(len(asked), "case"))
    axes.legend(loc="best")


def _places(axes: Axes, asked: pd.DataFrame) -> None:
    if asked.empty:
        say(axes, "No place could be told.")
        return
    told = np.log10(asked["told_equation"].clip(1, 1e12))
    edges = np.arange(np.floor(told.min()), np.ceil(told.max()) + 1)
    bins = np.digitize(told, edges) - 1
    for each in np.unique(bins):
        own = asked["place_right"].to_numpy(bool)[bins == each]
        axes.plot(edges[each] + 0.5, own.mean(), "o", color=BLUE)
        axes.annotate(
            str(len(own)), (edges[each] + 0.5, own.mean()), textcoords="offset points", xytext=(5, 5)
        )
    axes.set_xlim(edges[0], edges[-1] + 1)
    axes.set_ylim(-0.03, 1.1)
    axes.set_xlabel("$\\log_{10}\\,\\Delta\\chi^2$ of its place\n(dimensionless)")
    axes.set_ylabel("share of right places")
    axes.set_title(f"Places ({counted(len(asked), 'case')})")
