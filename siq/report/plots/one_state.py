"""Figures of systems with one state: curves where there is no plane to draw."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from string import ascii_lowercase
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from siq.report.plots.landscape import UNKNOWN
from siq.report.plots.landscape_curves import COLOURS, LINE_STYLES, scaled_label
from siq.report.plots.style import (
    BLACK,
    BLUE,
    COLUMN_WIDTH,
    GREY,
    ORANGE,
    PAGE_WIDTH,
    counted,
    drawn_in_style,
    magnitude_label,
    name_label,
    say,
    unit_label,
)

if TYPE_CHECKING:  # to draw takes none of what it takes to compute
    from siq.numerics.density_comparison import ComparedDensity
    from siq.report.plots.dataset import Dataset

BINS = 60  # of histograms of recorded states
ENERGY = "unit of ε"
DECADES = 6  # of differences, below the largest one


def _draw_unknown(axes: Axes, x: np.ndarray, values: np.ndarray) -> list[Any]:
    edges = np.flatnonzero(np.diff(np.r_[False, np.isnan(values), False].astype(int)))
    for begin, end in edges.reshape(-1, 2):
        axes.axvspan(x[begin], x[min(end, len(x) - 1)], zorder=-1, **UNKNOWN)
    return [Patch(label="$U$ is not known", **UNKNOWN)] if len(edges) else []


@drawn_in_style
def plot_error_curves(
    x: np.ndarray, curves: Mapping[str, np.ndarray], *, name: str, unit: str, energy_unit: str = ""
) -> Figure | None:
    """Draw U of one state by several sources, and how far each is from the first one.

    Parameters
    ----------
    x
        States in ascending order, shape ``(n,)``.
    curves
        U by each source, shape ``(n,)``, NaN where it says nothing. The first one is the reference.
    name, unit
        Of the state.
    energy_unit
        Unit of U; empty where it is that of ε.

    Returns
    -------
    matplotlib.figure.Figure
        Above U; below the absolute difference as a share of the reference's highest value, on a
        logarithmic axis.
    """
    (reference_name, reference), *others = [
        (key, one) for key, one in curves.items() if np.isfinite(one).any()
    ] or [("the reference", np.zeros(0))]
    if not reference.size or not others:
        return None
    highest = float(np.nanmax(np.abs(reference))) or 1.0
    figure = Figure(figsize=(COLUMN_WIDTH, 5.4))
    left, right = figure.subplots(2, 1, sharex=True)
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
    left.set_ylabel(scaled_label(left.yaxis, "$U$", energy_unit or ENERGY, highest))
    right.set_ylabel(f"difference from\n{reference_name} / highest $U$")
    for axes in (left, right):
        axes.set_xlabel(scaled_label(axes.xaxis, f"${name_label(name)}$", unit, float(np.abs(x).max())))
    figure.legend(loc="outside upper center", ncols=2)
    return figure


@drawn_in_style
def plot_invariant_curves(panels: Sequence[ComparedDensity], *, state: str, unit: str) -> Figure:
    """Draw the invariant density of one state, with a long simulation's histogram: a panel for each ε."""
    rows = -(-len(panels) // 2)
    figure = Figure(figsize=(PAGE_WIDTH, 3.1 * rows + 0.4))
    every = figure.subplots(rows, min(len(panels), 2), squeeze=False).ravel()
    for axes in every[len(panels) :]:
        axes.remove()
    for place, (axes, panel) in enumerate(zip(every[: len(panels)], panels, strict=True)):
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
        if place % 2 == 0:
            axes.set_ylabel(f"density {'' if unit in ('1', '') else unit_label(f'per {unit}')}")
    handles: list[Any] = [Line2D([], [], color=BLUE, label=r"$Z^{-1}\exp(-U/\varepsilon)$")]
    if any(panel.comparison is not None for panel in panels):
        handles.append(Patch(color=ORANGE, alpha=0.5, label="a long simulation"))
    figure.legend(handles=handles, loc="outside lower center", ncols=2)
    return figure


@drawn_in_style
def plot_dataset_curves(data: Dataset, *, state: str, unit: str) -> Figure:
    """Draw trajectories of one state, histograms of what was recorded and of what the regression sees."""
    count = 2 if data.below is None else 3
    figure = Figure(figsize=(COLUMN_WIDTH, 2.3 * count))
    left, middle, *others = figure.subplots(count, 1)
    label = f"${name_label(state)}$ {unit_label('' if unit == '1' else unit)}".strip()
    for path in data.trajectories:
        left.plot(path[:, 0], linewidth=0.7)
    for path in data.without_noise:
        left.plot(path[:, 0], color=BLACK, linewidth=0.9, linestyle="--")
    left.set_xlabel("number of the sample")
    left.set_ylabel(label)
    dashed = "; dashed: no noise" if len(data.without_noise) else ""
    left.set_title(f"(a) {counted(len(data.trajectories), 'recording')}{dashed}", loc="left")
    x = data.points[:, 0]
    edges = np.linspace(x.min(), x.max(), BINS + 1)
    middle.hist(x, edges, color=GREY)
    middle.set_title(f"(b) recorded: {len(x)} pairs", loc="left")
    if data.below is not None:
        others[0].hist(x[data.below], edges, color=BLUE)
        others[0].set_title(f"(c) seen by the regression: {100 * data.below.mean():.3g} %", loc="left")
    for axes in (middle, *others):
        axes.set_xlabel(label)
        axes.set_ylabel("number of pairs")
    return figure
