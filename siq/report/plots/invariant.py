"""Where noise leaves a system in the long run: the invariant distribution (paper, fig1b, fig2c: b to d)."""

from __future__ import annotations

from collections.abc import Sequence
from string import ascii_lowercase
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import MaxNLocator

from siq.report.plots.one_state import plot_invariant_curves
from siq.report.plots.style import (
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
    from siq.numerics.density_comparison import ComparedDensity, MarginalDensity

COLOUR_MAP = "viridis"
LEVELS = 13  # filled, from zero to the peak
MARGIN = 0.08  # of what is known: shown around it
UNKNOWN: dict[str, Any] = {"facecolor": "#F0F0F0", "edgecolor": "#C8C8C8", "hatch": "////", "linewidth": 0}
LINES = (0.1, 0.5, 0.9)  # shares of the peak at which the density's lines lie over the histogram


@drawn_in_style
def plot_invariant_distribution(
    panels: Sequence[ComparedDensity], *, states: Sequence[str], units: Sequence[str]
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
        the total variation distance and what the number of samples alone explains. Where the density is not
        known the plane is hatched, and the axes end not far from what is known. Of a single state curves over
        histograms.
    """
    if not panels:
        return sentence_figure("There is no invariant distribution to show.")
    if len(panels[0].density.plane) == 1:
        return plot_invariant_curves(panels, state=states[0], unit=units[0])
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
    _limit(all_axes[0, 0], [panel.density for panel in panels])
    for column, panel in enumerate(panels):
        first, second = panel.density.plane
        all_axes[-1, column].xaxis.set_major_locator(MaxNLocator(4))
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
        texts = [f"{level:.2g}".replace("e+0", "e") for level in levels[:: (LEVELS - 1) // 4]]
        bar.ax.set_xticklabels(texts)
    if simulated:
        shares = ", ".join(f"{share:.0%}" for share in LINES).replace("%", " %")
        figure.suptitle(f"Below: a long simulation, with lines of the density above at {shares} of its peak",
                        fontsize=8)  # fmt: skip
    return figure


def _levels(density: MarginalDensity) -> np.ndarray:
    # They lie closer at the bottom, where the way from one well to the other is.
    return float(np.nanmax(density.values)) * np.linspace(0, 1, LEVELS) ** 1.5


def _colours(density: MarginalDensity) -> dict[str, Any]:
    return {"cmap": COLOUR_MAP, "norm": BoundaryNorm(_levels(density), 256, extend="max")}


def _limit(axes: Axes, densities: Sequence[MarginalDensity]) -> None:
    """Leave out most of the plane in which no density is known."""
    known = [np.isfinite(one.values) for one in densities]
    if all(mask.all() for mask in known):
        return
    for limit, values, axis in ((axes.set_xlim, "x1", 0), (axes.set_ylim, "x2", 1)):
        seen = [getattr(one, values)[mask.any(axis=axis)] for one, mask in zip(densities, known, strict=True)]
        low, high = min(one.min() for one in seen), max(one.max() for one in seen)
        limit(low - MARGIN * (high - low), high + MARGIN * (high - low))


def _draw_unknown(axes: Axes, density: MarginalDensity) -> None:
    if not np.isfinite(density.values).all():
        axes.add_patch(Rectangle((0, 0), 1, 1, transform=axes.transAxes, zorder=0, **UNKNOWN))


def _density_unit(first: str, second: str) -> str:
    parts = [unit for unit in (first, second) if unit not in ("1", "")]
    if not parts:
        return "(dimensionless)"
    return (
        f"(per {parts[0]}²)" if parts[0] == parts[-1] and len(parts) == 2 else f"(per {' per '.join(parts)})"
    )


def _draw_density(axes: Axes, panel: ComparedDensity, colours: dict[str, Any]) -> str:
    density = panel.density
    _draw_unknown(axes, density)
    axes.contourf(
        density.x1, density.x2, density.values, levels=_levels(density), extend="max", **colours
    )  # fmt: skip
    title = r"$\varepsilon$ = " + magnitude_label(density.intensity)
    if panel.normalisation is not None:
        # The hatched region needs a line of its own, and so Z gets one too.
        title += ", " if panel.unknown is None else "\n"
        title += "$Z$ = " + magnitude_label(panel.normalisation, digits=4)
    if panel.unknown is not None:
        title += f"\nhatched: at most {100 * panel.unknown:.2g} %"
    return title


def _draw_histogram(axes: Axes, panel: ComparedDensity, colours: dict[str, Any]) -> str:
    comparison, density = panel.comparison, panel.density
    if comparison is None:
        say(axes, "not simulated")
        return ""
    _draw_unknown(axes, density)
    empty = np.isnan(density.values).any() & (comparison.histogram == 0)
    # As an image: thousands of small rectangles would make a megabyte of vector graphics.
    axes.pcolormesh(
        comparison.x1_edges, comparison.x2_edges, np.where(empty, np.nan, comparison.histogram),
        rasterized=True, **colours,
    )  # fmt: skip
    levels = float(np.nanmax(density.values)) * np.array(LINES)
    axes.contour(density.x1, density.x2, density.values, levels=levels, colors=VERMILLION, linewidths=0.7)
    title = f"simulation; total variation\n{comparison.total_variation:.2g}"
    if np.isfinite(comparison.sampling_floor):
        title += f" (sampling alone: {comparison.sampling_floor:.2g})"
    return title
