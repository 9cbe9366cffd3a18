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

from siq.report.plots.quasipotential import plot_invariant_curves
from siq.report.plots.style import (
    COLUMN_WIDTH,
    PAGE_WIDTH,
    VERMILLION,
    axis_label,
    drawn_in_style,
    magnitude_label,
)

if TYPE_CHECKING:  # to draw a density takes none of what it takes to compute one
    from siq.quasipotential.invariant_density import StationaryDensity

COLOUR_MAP = "viridis"
LEVELS = 13  # filled, from zero to the peak
MARGIN = 0.08  # of what is known: shown around it
UNKNOWN: dict[str, Any] = {"facecolor": "#F0F0F0", "edgecolor": "#C8C8C8", "hatch": "////", "linewidth": 0}
LINES = (0.1, 0.5, 0.9)  # shares of the peak at which the density's lines lie over the histogram


@drawn_in_style
def plot_invariant_distribution(
    panels: Sequence[StationaryDensity], *, states: Sequence[str], units: Sequence[str]
) -> Figure | None:
    """Draw the invariant density on a plane of two states, one ε after the other.

    Parameters
    ----------
    panels
        The densities, three in the paper.
    states, units
        Names and units of all d states; the plane picks from them.

    Returns
    -------
    matplotlib.figure.Figure
        ``p = Z⁻¹ exp(-U/ε)`` as filled contours, a panel for each ε. Where there is a simulation, a row for
        each ε, on the right the simulation's histogram in the same colours, with lines of the density at 10,
        50 and 90 % of its peak; the titles give the total variation distance and what the number of samples
        alone explains. Where the density is not known the plane is hatched, and the axes end not far from
        what is known. Of a single state curves over histograms. None where there is no density.
    """
    if not panels:
        return None
    if len(panels[0].plane) == 1:
        return plot_invariant_curves(panels, state=states[0], unit=units[0])
    simulated = any(panel.comparison is not None for panel in panels)
    columns = 2 if simulated or len(panels) > 1 else 1
    rows = len(panels) if simulated else -(-len(panels) // columns)
    figure = Figure(figsize=(PAGE_WIDTH if columns > 1 else COLUMN_WIDTH, 3.1 * rows + 0.5))
    all_axes = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    letters = iter(ascii_lowercase)
    for place, panel in enumerate(panels):
        colours, (first, second) = _colours(panel), panel.plane
        row, column = (place, 0) if simulated else divmod(place, columns)
        drawn = [all_axes[row, column]]
        drawn[0].set_title(f"({next(letters, '')}) {_draw_density(drawn[0], panel, colours)}", loc="left")
        drawn[0].set_ylabel(axis_label(states[second], units[second]))
        if panel.comparison is not None:
            drawn.append(all_axes[row, 1])
            drawn[1].set_title(
                f"({next(letters, '')}) {_draw_histogram(drawn[1], panel, colours)}", loc="left"
            )
        for axes in drawn:
            axes.xaxis.set_major_locator(MaxNLocator(4))
            axes.set_xlabel(axis_label(states[first], units[first]))
            axes.tick_params(labelbottom=True)
        bar = figure.colorbar(
            ScalarMappable(**colours), ax=drawn, location="bottom", aspect=30, pad=0.02,
            label=f"density {_density_unit(units[first], units[second])}".strip(),
        )  # fmt: skip
        levels = _levels(panel)[:: (LEVELS - 1) // 4]
        bar.set_ticks(levels.tolist())
        bar.minorticks_off()
        bar.ax.set_xticklabels([f"{level:.2g}".replace("e+0", "e") for level in levels])
    _limit(all_axes[0, 0], panels)
    for axes in all_axes.ravel():
        if not axes.has_data():
            axes.remove()
    if simulated:
        shares = ", ".join(f"{share:.0%}" for share in LINES).replace("%", " %")
        figure.suptitle(
            f"Right: a long simulation, with lines of the density\non its left at {shares} of its peak"
        )
    return figure


def _levels(density: StationaryDensity) -> np.ndarray:
    # They lie closer at the bottom, where the way from one well to the other is.
    return float(np.nanmax(density.values)) * np.linspace(0, 1, LEVELS) ** 1.5


def _colours(density: StationaryDensity) -> dict[str, Any]:
    return {"cmap": COLOUR_MAP, "norm": BoundaryNorm(_levels(density), 256, extend="max")}


def _limit(axes: Axes, densities: Sequence[StationaryDensity]) -> None:
    """Leave out most of the plane in which no density is known."""
    known = [np.isfinite(one.values) for one in densities]
    if all(mask.all() for mask in known):
        return
    for limit, values, axis in ((axes.set_xlim, "x1", 0), (axes.set_ylim, "x2", 1)):
        seen = [getattr(one, values)[mask.any(axis=axis)] for one, mask in zip(densities, known, strict=True)]
        low, high = min(one.min() for one in seen), max(one.max() for one in seen)
        limit(low - MARGIN * (high - low), high + MARGIN * (high - low))


def _draw_unknown(axes: Axes, density: StationaryDensity) -> None:
    if not np.isfinite(density.values).all():
        axes.add_patch(Rectangle((0, 0), 1, 1, transform=axes.transAxes, zorder=0, **UNKNOWN))


def _density_unit(first: str, second: str) -> str:
    parts = [unit for unit in (first, second) if unit not in ("1", "")]
    if not parts:
        return ""
    return (
        f"(per {parts[0]}²)" if parts[0] == parts[-1] and len(parts) == 2 else f"(per {' per '.join(parts)})"
    )


def _draw_density(axes: Axes, density: StationaryDensity, colours: dict[str, Any]) -> str:
    _draw_unknown(axes, density)
    axes.contourf(
        density.x1, density.x2, density.values, levels=_levels(density), extend="max", **colours
    )  # fmt: skip
    title = r"$\varepsilon$ = " + magnitude_label(density.intensity)
    if density.normalisation is not None:
        # The hatched region needs a line of its own, and so Z gets one too.
        title += ", " if density.unknown is None else "\n"
        title += "$Z$ = " + magnitude_label(density.normalisation, digits=4)
    if density.unknown is not None:
        title += f"\nhatched: at most {100 * density.unknown:.2g} %"
    return title


def _draw_histogram(axes: Axes, density: StationaryDensity, colours: dict[str, Any]) -> str:
    comparison = density.comparison
    assert comparison is not None
    _draw_unknown(axes, density)
    empty = np.isnan(density.values).any() & (comparison.histogram == 0)
    # As an image: thousands of small rectangles would make a megabyte of vector graphics.
    axes.pcolormesh(
        comparison.x1_edges, comparison.x2_edges, np.where(empty, np.nan, comparison.histogram),
        rasterized=True, **colours,
    )  # fmt: skip
    levels = float(np.nanmax(density.values)) * np.array(LINES)
    axes.contour(density.x1, density.x2, density.values, levels=levels, colors=VERMILLION, linewidths=0.7)
    title = f"simulation; total\nvariation {comparison.total_variation:.2g}"
    if np.isfinite(comparison.sampling_floor):
        title += f"\n(sampling alone: {comparison.sampling_floor:.2g})"
    return title
