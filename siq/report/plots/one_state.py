"""Figures of systems with one state: curves where there is no plane to draw."""

from __future__ import annotations

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

from siq.report.plots.landscape import MARKS, UNKNOWN
from siq.report.plots.landscape_curves import COLOURS, LINE_STYLES, scaled_label
from siq.report.plots.style import (
    BLACK,
    BLUE,
    GREY,
    ORANGE,
    PAGE_WIDTH,
    drawn_in_style,
    magnitude_label,
    name_label,
    say,
    sentence_figure,
    unit_label,
)

if TYPE_CHECKING:  # to draw takes none of what it takes to compute
    from siq.numerics.density_comparison import ComparedDensity
    from siq.report.plots.dataset import Dataset

BINS = 60  # of histograms of recorded states
ENERGY = "in the unit of ε"
ROOM = 1.25  # of the highest saddle: what is shown of U
DECADES = 6  # of differences, below the largest one


@dataclass(frozen=True)
class DrawnBarrier:
    """A way out of a well: where its attractor and its saddle lie, and U at both."""

    attractor: float
    saddle: float
    bottom: float
    top: float


@drawn_in_style
def plot_landscape_curve(
    x: np.ndarray,
    values: np.ndarray,
    *,
    name: str,
    unit: str,
    equilibria: pd.DataFrame,
    barriers: Sequence[DrawnBarrier] = (),
) -> Figure:
    """Draw U of one state with its wells and barriers.

    Parameters
    ----------
    x, values
        States in ascending order, shape ``(n,)``, and U there, NaN where it is not known.
    name, unit
        Of the state.
    equilibria
        Columns ``kind x y label``: where each lies, and U there.
    barriers
        Of the ways out; each is an arrow from the well's bottom to the height of its saddle.

    Returns
    -------
    matplotlib.figure.Figure
        One panel, hatched where U is not known.
    """
    if not np.isfinite(values).any():
        return sentence_figure("U is known nowhere.")
    figure = Figure(figsize=(0.75 * PAGE_WIDTH, 3.4))
    axes = figure.add_subplot()
    axes.plot(x, values, color=BLUE, linewidth=1.4)
    tops = [one.top for one in barriers if np.isfinite(one.top)]
    lowest, highest = float(np.nanmin(values)), float(np.nanmax(values))
    reach = lowest + ROOM * (max(tops) - lowest) if tops else highest
    axes.set_ylim(lowest - 0.06 * (reach - lowest), reach)
    axes.set_xlim(x[0], x[-1])
    handles = _draw_unknown(axes, x, values) + _draw_equilibria(axes, equilibria)
    for one in barriers:
        if np.isfinite(one.top):
            _draw_barrier(axes, one)
    axes.set_xlabel(scaled_label(axes.xaxis, f"${name_label(name)}$", unit, float(np.abs(x).max())))
    axes.set_ylabel(scaled_label(axes.yaxis, "$U$", ENERGY, reach))
    figure.legend(handles=handles, loc="outside lower center", ncols=4)
    return figure


def _draw_unknown(axes: Axes, x: np.ndarray, values: np.ndarray) -> list[Any]:
    edges = np.flatnonzero(np.diff(np.r_[False, np.isnan(values), False].astype(int)))
    for begin, end in edges.reshape(-1, 2):
        axes.axvspan(x[begin], x[min(end, len(x) - 1)], zorder=-1, **UNKNOWN)
    return [Patch(label="$U$ is not known", **UNKNOWN)] if len(edges) else []


def _draw_equilibria(axes: Axes, equilibria: pd.DataFrame) -> list[Any]:
    handles = []
    for kind, style in MARKS.items():
        rows = equilibria[equilibria["kind"] == kind]
        for x, y, label in rows[["x", "y", "label"]].itertuples(index=False):
            axes.plot(x, y, linestyle="none", zorder=4, **style)
            if np.isfinite(y):
                axes.annotate(str(label), (x, y), xytext=(6, 3), textcoords="offset points", zorder=5)
        handles += [Line2D([], [], linestyle="none", label=kind, **style)] if len(rows) else []
    return handles


def _draw_barrier(axes: Axes, one: DrawnBarrier) -> None:
    axes.plot([one.attractor, one.saddle], [one.top] * 2, color=GREY, linewidth=0.8, linestyle="--")
    axes.annotate(
        "", (one.attractor, one.top), xytext=(one.attractor, one.bottom),
        arrowprops={"arrowstyle": "<->", "color": GREY, "shrinkA": 0, "shrinkB": 0},
    )  # fmt: skip
    axes.annotate(
        rf"$\Delta U$ = {magnitude_label(one.top - one.bottom, digits=4)}", (one.attractor, one.top),
        xytext=(0, 3), textcoords="offset points", ha="center",
    )  # fmt: skip


@drawn_in_style
def plot_error_curves(x: np.ndarray, curves: Mapping[str, np.ndarray], *, name: str, unit: str) -> Figure:
    """Draw U of one state by several sources, and how far each is from the first one.

    Parameters
    ----------
    x
        States in ascending order, shape ``(n,)``.
    curves
        U by each source, shape ``(n,)``, NaN where it says nothing. The first one is the reference.
    name, unit
        Of the state.

    Returns
    -------
    matplotlib.figure.Figure
        On the left U; on the right the absolute difference as a share of the reference's highest value, on a
        logarithmic axis.
    """
    (reference_name, reference), *others = [
        (key, one) for key, one in curves.items() if np.isfinite(one).any()
    ] or [("the reference", np.zeros(0))]
    if not reference.size or not others:
        return sentence_figure("There is no U to compare.")
    highest = float(np.nanmax(np.abs(reference))) or 1.0
    figure = Figure(figsize=(PAGE_WIDTH, 3.0))
    left, right = figure.subplots(1, 2)
    left.plot(x, reference, color=BLACK, linewidth=2.4, alpha=0.4, label=reference_name)
    right.set_yscale("log")
    shares = []
    for place, (key, values) in enumerate(others):
        look: dict[str, Any] = {
            "color": COLOURS[place % len(COLOURS)], "linestyle": LINE_STYLES[place % len(LINE_STYLES)],
        }  # fmt: skip
        left.plot(x, values, linewidth=1.2, label=key, **look)
        difference = np.abs(values - reference) / highest
        shares.append(float(np.nanmax(difference, initial=0.0)))
        right.plot(x, np.where(difference > 0, difference, np.nan), linewidth=1.0, **look)
    largest = max(shares)
    if largest > 0:
        right.set_ylim(largest / 10**DECADES, 2 * largest)
    else:
        say(right, "no difference at all")
    left.set_ylabel(scaled_label(left.yaxis, "$U$", ENERGY, highest))
    right.set_ylabel(f"difference from {reference_name} / highest $U$")
    for axes in (left, right):
        axes.set_xlabel(scaled_label(axes.xaxis, f"${name_label(name)}$", unit, float(np.abs(x).max())))
    figure.legend(loc="outside upper center", ncols=4)
    return figure


@drawn_in_style
def plot_invariant_curves(panels: Sequence[ComparedDensity], *, state: str, unit: str) -> Figure:
    """Draw the invariant density of one state, with a long simulation's histogram: a panel for each ε."""
    figure = Figure(figsize=(PAGE_WIDTH, 2.9))
    for place, (axes, panel) in enumerate(
        zip(figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True)
    ):
        density, comparison = panel.density, panel.comparison
        if comparison is not None:
            axes.stairs(comparison.histogram[0], comparison.x1_edges, color=ORANGE, fill=True, alpha=0.5)
        axes.plot(density.x1, density.values[0], color=BLUE, linewidth=1.2)
        _draw_unknown(axes, density.x1, density.values[0])
        axes.set_ylim(bottom=0)
        axes.set_xlabel(
            scaled_label(axes.xaxis, f"${name_label(state)}$", unit, float(np.abs(density.x1).max()))
        )
        title = f"({ascii_lowercase[place % 26]}) " + r"$\varepsilon$ = " + magnitude_label(density.intensity)
        if panel.normalisation is not None:
            title += "\n$Z$ = " + magnitude_label(panel.normalisation, digits=4)
        if panel.unknown is not None:
            title += f"\nhatched: at most {100 * panel.unknown:.2g} %"
        if comparison is not None:
            title += f"\ntotal variation {comparison.total_variation:.2g}"
            if np.isfinite(comparison.sampling_floor):
                title += f"\n(sampling alone: {comparison.sampling_floor:.2g})"
        axes.set_title(title, loc="left")
        if place == 0:
            axes.set_ylabel(f"density {unit_label('1' if unit in ('1', '') else f'per {unit}')}")
    handles: list[Any] = [Line2D([], [], color=BLUE, label=r"$Z^{-1}\exp(-U/\varepsilon)$")]
    if any(panel.comparison is not None for panel in panels):
        handles.append(Patch(color=ORANGE, alpha=0.5, label="a long simulation"))
    figure.legend(handles=handles, loc="outside lower center", ncols=2)
    return figure


@drawn_in_style
def plot_dataset_curves(data: Dataset, *, state: str, unit: str) -> Figure:
    """Draw trajectories of one state, histograms of what was recorded and of what the regression sees."""
    figure = Figure(figsize=(PAGE_WIDTH, 2.6))
    left, middle, right = figure.subplots(1, 3)
    label = f"${name_label(state)}$ {unit_label(unit)}"
    for path in data.trajectories:
        left.plot(path[:, 0], linewidth=0.7)
    for path in data.without_noise:
        left.plot(path[:, 0], color=BLACK, linewidth=0.9, linestyle="--")
    left.set_xlabel("number of the sample")
    left.set_ylabel(label)
    dashed = "; dashed: no noise" if len(data.without_noise) else ""
    left.set_title(f"(a) {len(data.trajectories)} trajectories{dashed}", loc="left")
    x = data.points[:, 0]
    edges = np.linspace(x.min(), x.max(), BINS + 1)
    middle.hist(x, edges, color=GREY)
    middle.set_title(f"(b) recorded: {len(x)} pairs", loc="left")
    if data.below is None:
        say(right, "no networks say\nwhat the regression sees")
    else:
        right.hist(x[data.below], edges, color=BLUE)
    seen = "" if data.below is None else f": {100 * data.below.mean():.3g} %"
    right.set_title(f"(c) seen by the regression{seen}", loc="left")
    for axes in (middle, right):
        axes.set_xlabel(label)
    middle.set_ylabel("number of pairs")
    return figure
