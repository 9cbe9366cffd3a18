"""Where noise leaves a system in the long run: the invariant distribution (paper, Fig. fig1b, b to d)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from string import ascii_lowercase
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm
from matplotlib.figure import Figure

from siq.plots.style import (
    PAGE_WIDTH,
    VERMILLION,
    drawn_in_style,
    magnitude_label,
    name_label,
    say,
    sentence_figure,
    unit_label,
)

if TYPE_CHECKING:  # to draw a density takes none of what it takes to compute one
    from siq.invariant_distribution import DensityComparison, MarginalDensity

COLOUR_MAP = "viridis"
LEVELS = 13  # filled, from zero to the peak
LINES = (0.1, 0.5, 0.9)  # shares of the peak at which the density's lines lie over the histogram


@dataclass(frozen=True)
class InvariantPanel:
    """What one column shows: the density for one ε.

    Attributes
    ----------
    density
        The density on a plane of two states.
    normalisation
        Z, None where it is not to be written.
    comparison
        A long simulation beside it, None where there is none.
    """

    density: MarginalDensity
    normalisation: float | None = None
    comparison: DensityComparison | None = None


@drawn_in_style
def plot_invariant_distribution(
    panels: Sequence[InvariantPanel], *, states: Sequence[str], units: Sequence[str]
) -> Figure:
    """Draw the invariant density on a plane of two states, one column for each ε.

    Parameters
    ----------
    panels
        The columns, three in the paper.
    states, units
        Names and units of all d states; the plane picks from them.

    Returns
    -------
    matplotlib.figure.Figure
        Above, ``p = Z⁻¹ exp(-U/ε)`` as filled contours. Below, where there is a simulation, its histogram in
        the same colours, with lines of the density above at 10, 50 and 90 % of its peak; the titles give
        the total variation distance and what the number of samples alone explains.
    """
    if not panels:
        return sentence_figure("There is no invariant distribution to show.")
    simulated = any(panel.comparison is not None for panel in panels)
    rows = 2 if simulated else 1
    width = PAGE_WIDTH * min(len(panels), 3) / 3
    figure = Figure(figsize=(max(width, PAGE_WIDTH / 2), 2.1 * rows + 0.7))
    all_axes = figure.subplots(rows, len(panels), squeeze=False, sharex=True, sharey=True)
    letters = iter(ascii_lowercase)
    for row in range(rows):
        for column, panel in enumerate(panels):
            axes = all_axes[row, column]
            colours = _colours(panel.density)
            draw = _draw_density if row == 0 else _draw_histogram
            axes.set_title(f"({next(letters, '')}) {draw(axes, panel, colours)}", loc="left")
    for column, panel in enumerate(panels):
        first, second = panel.density.plane
        all_axes[-1, column].set_xlabel(f"${name_label(states[first])}$ {unit_label(units[first])}")
        if column == 0:
            for axes in all_axes[:, 0]:
                axes.set_ylabel(f"${name_label(states[second])}$ {unit_label(units[second])}")
        bar = figure.colorbar(
            ScalarMappable(**_colours(panel.density)), ax=list(all_axes[:, column]), location="bottom",
            aspect=25, pad=0.02, label=f"density {_density_unit(units[first], units[second])}",
        )  # fmt: skip
        levels = _levels(panel.density)
        bar.set_ticks(levels[:: (LEVELS - 1) // 4].tolist())
        bar.minorticks_off()
        bar.ax.set_xticklabels([f"{level:.2g}" for level in levels[:: (LEVELS - 1) // 4]])
    if simulated:
        shares = ", ".join(f"{share:.0%}" for share in LINES).replace("%", " %")
        figure.suptitle(f"Below: a long simulation, with lines of the density above at {shares} of its peak",
                        fontsize=8)  # fmt: skip
    return figure


def _levels(density: MarginalDensity) -> np.ndarray:
    # They lie closer at the bottom, where the way from one well to the other is.
    return float(np.max(density.values)) * np.linspace(0, 1, LEVELS) ** 1.5


def _colours(density: MarginalDensity) -> dict[str, Any]:
    return {"cmap": COLOUR_MAP, "norm": BoundaryNorm(_levels(density), 256, extend="max")}


def _density_unit(first: str, second: str) -> str:
    parts = [unit for unit in (first, second) if unit not in ("1", "")]
    if not parts:
        return "(dimensionless)"
    return (
        f"(per {parts[0]}²)" if parts[0] == parts[-1] and len(parts) == 2 else f"(per {' per '.join(parts)})"
    )


def _draw_density(axes: Axes, panel: InvariantPanel, colours: dict[str, Any]) -> str:
    density = panel.density
    axes.contourf(
        density.x1, density.x2, density.values, levels=_levels(density), extend="max", **colours
    )  # fmt: skip
    title = rf"$\varepsilon = {density.intensity:g}$"
    if panel.normalisation is not None:
        title += ", $Z$ = " + magnitude_label(panel.normalisation, digits=4)
    return title


def _draw_histogram(axes: Axes, panel: InvariantPanel, colours: dict[str, Any]) -> str:
    comparison, density = panel.comparison, panel.density
    if comparison is None:
        say(axes, "not simulated")
        return ""
    # As an image: thousands of small rectangles would make a megabyte of vector graphics.
    axes.pcolormesh(
        comparison.x1_edges, comparison.x2_edges, comparison.histogram, rasterized=True, **colours
    )  # fmt: skip
    levels = float(np.max(density.values)) * np.array(LINES)
    axes.contour(density.x1, density.x2, density.values, levels=levels, colors=VERMILLION, linewidths=0.7)
    title = f"simulation; total variation\n{comparison.total_variation:.2g}"
    if np.isfinite(comparison.sampling_floor):
        title += f" (sampling alone: {comparison.sampling_floor:.2g})"
    return title
