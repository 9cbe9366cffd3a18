"""Figures of the proofs: verdicts on concealed cases, and functions that no dictionary holds."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.proof.scoring import EXPECTED, FAILED
from siq.report.plots.style import (
    BLUE,
    COLUMN_WIDTH,
    GREEN,
    GREY,
    PAGE_WIDTH,
    VERMILLION,
    counted,
    drawn_in_style,
    say,
)

VERDICTS = ("no mismatch", "parameter shift", "missing physics", "modelled", "unexplained", FAILED)
EDGES = np.array([-np.inf, 10.0, 30.0, 100.0, 300.0, 1000.0, 10_000.0, np.inf])
MARKERS = {40.0: ("o", BLUE), 30.0: ("s", VERMILLION), 20.0: ("^", GREEN)}


@drawn_in_style
def plot_proof(scores: pd.DataFrame, *, strong: float = 100.0) -> Figure:
    """Draw what was said of concealed cases.

    Parameters
    ----------
    scores
        Columns ``kind verdict noise_db oracle_delta_chi2 truth_in_class``, one row a case.
    strong
        Oracle Δχ² that is marked.

    Returns
    -------
    matplotlib.figure.Figure
        Left how many cases of each kind had each verdict, the right one framed; right the share of
        mechanisms within the reported class, against the oracle's Δχ², by noise level.
    """
    if scores.empty:
        return sentence_figure("There is no case to show.")
    figure = Figure(figsize=(PAGE_WIDTH, 3.2), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=[1.25, 1])
    _verdicts(left, scores)
    _named(right, scores[scores["kind"] == "mechanism"], strong)
    return figure


def _verdicts(axes: Axes, scores: pd.DataFrame) -> None:
    kinds = [kind for kind in EXPECTED if (scores["kind"] == kind).any()]
    verdicts = [each for each in VERDICTS if each != FAILED or (scores["verdict"] == each).any()]
    counts = np.array(
        [
            [((scores["kind"] == kind) & (scores["verdict"] == each)).sum() for each in verdicts]
            for kind in kinds
        ]
    )
    shares = counts / counts.sum(axis=1, keepdims=True).clip(min=1)
    axes.imshow(shares, cmap="Blues", vmin=0, vmax=1.6, aspect="auto")
    for (row, column), count in np.ndenumerate(counts):
        axes.text(column, row, str(count), ha="center", va="center", color="black" if count else GREY)
    for row, column in ((kinds.index(k), verdicts.index(each)) for k in kinds for each in EXPECTED[k]):
        axes.plot(
            column + np.array([-0.46, 0.46, 0.46, -0.46, -0.46]),
            row + np.array([-0.44, -0.44, 0.44, 0.44, -0.44]),
            color=GREEN,
            linewidth=1.6,
        )
    axes.set_xticks(range(len(verdicts)), verdicts, rotation=30, ha="right")
    axes.set_yticks(range(len(kinds)), kinds)
    axes.tick_params(length=0)
    axes.set_xlabel("verdict (the right one framed)")
    axes.set_ylabel("what is concealed")
    axes.set_title(counted(len(scores), "case"))
    axes.spines[:].set_visible(False)


def _named(axes: Axes, mechanisms: pd.DataFrame, strong: float) -> None:
    known = mechanisms[mechanisms["oracle_delta_chi2"].notna()]
    if known.empty:
        say(axes, "No mechanism was concealed.")
        return
    labels = [
        f"<{EDGES[1]:g}", *(f"{a:g}–{b:g}" for a, b in pairwise(EDGES[1:-1])),
        f">{EDGES[-2]:g}",
    ]  # fmt: skip
    for shift, (level, (marker, colour)) in zip((-0.12, 0.0, 0.12), MARKERS.items(), strict=True):
        own = known[known["noise_db"] == level]
        place = np.digitize(own["oracle_delta_chi2"], EDGES[1:-1])
        bins = np.unique(place)
        shares = [own["truth_in_class"].to_numpy(bool)[place == each].mean() for each in bins]
        axes.plot(
            bins + shift, shares, marker=marker, markersize=4, color=colour, linewidth=0.8,
            label=f"{level:g} dB ({counted(len(own), 'case')})",
        )  # fmt: skip
    axes.axvline(np.searchsorted(EDGES[1:], strong) + 0.5, color=GREY, linewidth=0.8, linestyle="--")
    axes.set_xticks(range(len(labels)), labels, rotation=30, ha="right")
    axes.set_xlim(-0.5, len(labels) - 0.5)
    axes.set_ylim(-0.03, 1.03)
    axes.set_xlabel(r"$\Delta\chi^2$ that the oracle gains")
    axes.set_ylabel("share of mechanisms\nwithin the reported class")
    axes.set_title("mechanisms, by noise")
    axes.legend(loc="lower right")


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
    for level, (marker, colour) in MARKERS.items():
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


def sentence_figure(sentence: str) -> Figure:
    """Make a figure that says in words why there is nothing to draw."""
    figure = Figure(figsize=(COLUMN_WIDTH, 1.2))
    say(figure.add_subplot(), sentence)
    return figure
