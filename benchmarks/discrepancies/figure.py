"""Held-out errors of every case, and what was said rightly, as a picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.discrepancies.scores import CARD, CONCEALING
from benchmarks.discrepancies.summary import GENERATORS, quartiles, summary_of
from siq.numerics.files import whole_file
from siq.report.plots.style import BLACK, BLUE, GREEN, GREY, ORANGE, VERMILLION, WIDTH, drawn_to_be_read
from workflow.files import read_table

WIDEST = 100.0  # times the oracle's error: what is worse, or runs away, stands at the edge
LEAST = 0.7
MARKS = {"concealment": ("o", BLUE), "foreign": ("^", VERMILLION)}
SHARES = (
    ("detected", "knowable", "detected", GREY, ""),
    ("places_right", "knowable", "place right", GREEN, "////"),
    ("names_right", "nameable", "name right", BLUE, ""),
    ("false_alarms", "quiet", "false alarm", ORANGE, "xxxx"),
)
SHORT = {
    "universal differential equation": "universal\ndiff. equation",
    "Gaussian process": "Gaussian\nprocess",
}


def draw(path: Path, picture: Path) -> None:
    """Read the scores and write the picture."""
    figure = plot(read_table(path))
    assert figure is not None
    with whole_file(picture) as partial:
        figure.savefig(partial, dpi=200, format="png")


@drawn_to_be_read
def plot(scores: pd.DataFrame) -> Figure:
    """Draw errors above, shares below."""
    methods = [CARD, *(each for each in scores["method"].unique() if each != CARD)]
    figure = Figure(figsize=(WIDTH, 7.6))
    upper, lower = figure.subplots(2, 1, height_ratios=[1, 1.25])
    _errors(upper, scores, methods)
    _shares(lower, scores, methods[1:])
    return figure


def _errors(axes: Axes, scores: pd.DataFrame, methods: list[str]) -> None:
    draws = np.random.default_rng(0)
    axes.axvline(1, color=GREY, linewidth=0.8, linestyle=":")
    for generator, (mark, colour) in MARKS.items():
        own = scores[(scores["generator"] == generator) & scores["kind"].isin(CONCEALING)]
        shift = -0.18 if generator == "concealment" else 0.18
        for place, method in enumerate(methods):
            ratios = own.loc[own["method"] == method, "error_ratio"].to_numpy(float)
            height = place + shift
            axes.plot(
                np.clip(ratios, LEAST, WIDEST), height + draws.uniform(-0.1, 0.1, len(ratios)), mark,
                color=colour, markersize=4, alpha=0.55, markeredgewidth=0, clip_on=False,
                label=GENERATORS[generator] if place == 0 else None,
            )  # fmt: skip
            low, middle, high = np.clip(quartiles(ratios), LEAST, WIDEST)
            axes.plot([low, high], [height, height], color=BLACK, linewidth=1)
            axes.plot([middle], [height], "|", color=BLACK, markersize=10, markeredgewidth=2)
    axes.set_xscale("log")
    ticks = [1, 2, 5, 10, 20, 50, WIDEST]
    axes.set_xticks(ticks, [*map(str, ticks[:-1]), "≥100"])
    axes.minorticks_off()
    axes.set(
        xlim=(LEAST, WIDEST), yticks=range(len(methods)),
        yticklabels=[SHORT.get(each, each) for each in methods],
        xlabel="held-out error, in errors of the oracle (1)",
    )  # fmt: skip
    axes.invert_yaxis()
    axes.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=2)


def _shares(axes: Axes, scores: pd.DataFrame, methods: list[str]) -> None:
    """Both generators together: of how many cases that could be told is it told."""
    counts = summary_of(scores).groupby("method", sort=False).sum(numeric_only=True)
    for number, (what, of, label, colour, hatch) in enumerate(SHARES):
        for place, method in enumerate(methods):
            count, total = int(counts[what][method]), int(counts[of][method])
            height = place + 0.2 * (number - 1.5)
            share = 100 * count / total if total else 0.0
            axes.barh(
                height, share, 0.17, color="white" if hatch else colour, edgecolor=colour, hatch=hatch,
                linewidth=0.8, label=label if place == 0 else None,
            )  # fmt: skip
            axes.text(share + 1.5, height, f"{count} of {total}", va="center", fontsize=8)
    axes.set(
        xlim=(0, 118), xticks=[0, 25, 50, 75, 100], yticks=range(len(methods)),
        yticklabels=[SHORT.get(each, each) for each in methods],
        xlabel="share of the cases that could be told, %",
    )  # fmt: skip
    axes.invert_yaxis()
    axes.legend(loc="lower left", bbox_to_anchor=(-0.3, 1), ncols=4, columnspacing=1.0, handlelength=1.4)
