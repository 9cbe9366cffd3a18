"""Figures of the stationary density exp(-U/ε)/Z beside a long simulation (paper, fig1b, fig2c: b to d)."""

from __future__ import annotations

from collections.abc import Sequence
from string import ascii_lowercase
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from matplotlib.ticker import MaxNLocator

from siq.report.plots.style import (
    BLUE,
    COLUMN_WIDTH,
    ORANGE,
    PAGE_WIDTH,
    VERMILLION,
    axis_label,
    drawn_in_style,
    magnitude_label,
    name_label,
    scaled_label,
    unit_label,
)

if TYPE_CHECKING:  # to draw a density takes none of what it takes to compute one
    from siq.quasipotential.invariant_density import DensityComparison, StationaryDensity


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


def _density_unit(first: str, second: str) -> str:
    parts = [unit for unit in (first, second) if unit not in ("1", "")]
    if not parts:
        return ""
    return (
        f"(per {parts[0]}²)" if parts[0] == parts[-1] and len(parts) == 2 else f"(per {' per '.join(parts)})"
    )


def _draw_density(axes: Axes, density: StationaryDensity, colours: dict[str, Any]) -> str:
    if np.isnan(density.values).any():
        hatch_unknown(axes, zorder=0)
    axes.contourf(
        density.x1, density.x2, density.values, levels=_levels(density), extend="max", **colours
    )  # fmt: skip
    # The hatched region needs a line of its own, and so Z gets one too.
    return _title(density, ", " if density.unknown is None else "\n")


def _title(density: StationaryDensity, before_z: str) -> str:
    title = r"$\varepsilon$ = " + magnitude_label(density.intensity)
    if density.normalisation is not None:
        title += f"{before_z}$Z$ = " + magnitude_label(density.normalisation, digits=4)
    if density.unknown is not None:
        title += f"\nhatched: at most {100 * density.unknown:.2g} %"
    return title


def _distance(comparison: DensityComparison, words: str) -> str:
    title = f"{words} {comparison.total_variation:.2g}"
    if np.isfinite(comparison.sampling_floor):
        title += f"\n(sampling alone: {comparison.sampling_floor:.2g})"
    return title


def _draw_histogram(axes: Axes, density: StationaryDensity, colours: dict[str, Any]) -> str:
    comparison = density.comparison
    assert comparison is not None
    if np.isnan(density.values).any():
        hatch_unknown(axes, zorder=0)
    empty = np.isnan(density.values).any() & (comparison.histogram == 0)
    # As an image: thousands of small rectangles would make a megabyte of vector graphics.
    axes.pcolormesh(
        comparison.x1_edges, comparison.x2_edges, np.where(empty, np.nan, comparison.histogram),
        rasterized=True, **colours,
    )  # fmt: skip
    levels = float(np.nanmax(density.values)) * np.array(LINES)
    axes.contour(density.x1, density.x2, density.values, levels=levels, colors=VERMILLION, linewidths=0.7)
    return _distance(comparison, "simulation; total\nvariation")


@drawn_in_style
def plot_invariant_curves(panels: Sequence[StationaryDensity], *, state: str, unit: str) -> Figure:
    """Draw the invariant density of one state, with a long simulation's histogram: a panel for each ε."""
    rows = -(-len(panels) // 2)
    figure = Figure(figsize=(PAGE_WIDTH, 3.1 * rows + 0.4))
    every = figure.subplots(rows, min(len(panels), 2), squeeze=False).ravel()
    for axes in every[len(panels) :]:
        axes.remove()
    for place, (axes, panel) in enumerate(zip(every[: len(panels)], panels, strict=True)):
        comparison = panel.comparison
        if comparison is not None:
            axes.stairs(comparison.histogram[0], comparison.x1_edges, color=ORANGE, fill=True, alpha=0.5)
        axes.plot(panel.x1, panel.values[0], color=BLUE, linewidth=1.2)
        _hatch_stretches(axes, panel.x1, panel.values[0])
        axes.set_ylim(bottom=0)
        axes.set_xlabel(
            scaled_label(axes.xaxis, f"${name_label(state)}$", unit, float(np.abs(panel.x1).max()))
        )
        title = f"({ascii_lowercase[place % 26]}) " + _title(panel, "\n")
        if comparison is not None:
            title += "\n" + _distance(comparison, "total variation")
        axes.set_title(title, loc="left")
        if place % 2 == 0:
            axes.set_ylabel(f"density {'' if unit in ('1', '') else unit_label(f'per {unit}')}")
    handles: list[Any] = [Line2D([], [], color=BLUE, label=r"$Z^{-1}\exp(-U/\varepsilon)$")]
    if any(panel.comparison is not None for panel in panels):
        handles.append(Patch(color=ORANGE, alpha=0.5, label="a long simulation"))
    figure.legend(handles=handles, loc="outside lower center", ncols=2)
    return figure


def _hatch_stretches(axes: Axes, x: np.ndarray, values: np.ndarray) -> None:
    edges = np.flatnonzero(np.diff(np.r_[False, np.isnan(values), False].astype(int)))
    for begin, end in edges.reshape(-1, 2):
        axes.axvspan(x[begin], x[min(end, len(x) - 1)], zorder=-1, **UNKNOWN)


def hatch_unknown(axes: Axes, zorder: float = -1) -> None:
    """Hatch a whole panel, for what is drawn over it to leave out where nothing is known."""
    axes.add_patch(Rectangle((0, 0), 1, 1, transform=axes.transAxes, zorder=zorder, **UNKNOWN))
