"""How far are estimates of U from a reference?"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm, LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator

from siq.numerics.measured_text import unit_text
from siq.report.plots.landscape_curves import plot_degrees, plot_escape, power_of_ten, scaled_label
from siq.report.plots.style import (
    PAGE_WIDTH,
    drawn_in_style,
    magnitude_label,
    name_label,
)

__all__ = ["plot_degrees", "plot_error_maps", "plot_escape"]

Extend = Literal["neither", "both", "min", "max"]

COLOUR_MAP = "viridis"
DIFFERENCE_MAP = "magma"
LEVELS = 14
DECADES = 4  # of differences, below the largest one
MARGIN = 0.06  # of what is known: shown around it
UNKNOWN: dict[str, Any] = {"facecolor": "#F0F0F0", "edgecolor": "#C8C8C8", "hatch": "////", "linewidth": 0}
RIM: dict[str, Any] = {"path_effects": [withStroke(linewidth=2.0, foreground="white")]}


def _shades(values: np.ndarray, level: float | None) -> dict[str, Any]:
    """Round levels from the lowest value to the top, and what colours they have."""
    lowest = float(np.nanmin(values))
    top = float(np.nanmax(values)) if level is None else level
    top = top if top > lowest else lowest + (abs(lowest) or 1.0)  # a flat landscape has levels, too
    # The bottom is zero to rounding, and a level below it would have no meaning.
    levels = MaxNLocator(LEVELS).tick_values(0.0 if abs(lowest) < 1e-3 * (top - lowest) else lowest, top)
    extend: Extend = "max" if np.nanmax(values) > levels[-1] else "neither"
    norm = BoundaryNorm(levels, 256, extend=extend)
    return {"levels": levels, "norm": norm, "extend": extend, "cmap": COLOUR_MAP}


def _draw_values(
    axes: Axes,
    axes_values: Sequence[np.ndarray],
    values: np.ndarray,
    shades: dict[str, Any],
    *,
    as_image: bool = False,
) -> None:
    _draw_unknown(axes)
    heights = values.T if shades["extend"] == "both" else np.maximum(values, shades["levels"][0]).T
    drawn = [
        axes.contourf(*axes_values, heights, **shades),
        axes.contour(*axes_values, heights, levels=shades["levels"], colors="white", linewidths=0.25),
    ]
    for one in drawn:
        one.set_rasterized(as_image)


def _draw_unknown(axes: Axes) -> None:
    axes.add_patch(Rectangle((0, 0), 1, 1, transform=axes.transAxes, zorder=-1, **UNKNOWN))


def _limit(
    axes: Axes, axes_values: Sequence[np.ndarray], values: np.ndarray, places: np.ndarray | None = None
) -> None:
    """Show what is known, and some places, as far as the grid goes: the rest of it would only be hatched."""
    known = np.isfinite(values)
    limits = []
    for index, nodes in enumerate(axes_values):
        shown = nodes[known.any(axis=1 - index)]
        if places is not None:
            shown = np.concatenate([shown, places[:, index]])
        room = MARGIN * (shown.max() - shown.min())
        limits.append((max(shown.min() - room, nodes[0]), min(shown.max() + room, nodes[-1])))
    axes.set_xlim(*limits[0])
    axes.set_ylim(*limits[1])


def _name_axes(
    axes: Axes, axes_values: Sequence[np.ndarray], names: Sequence[str], units: Sequence[str]
) -> None:
    for axis, place, name, unit in zip((axes.xaxis, axes.yaxis), axes_values, names, units, strict=True):
        label = scaled_label(axis, f"${name_label(name)}$", unit, float(np.abs(place).max()))
        axis.set_label_text(label)


def _add_bar(figure: Figure, panels: Sequence[Axes], shades: dict[str, Any], energy_unit: str) -> None:
    levels = shades["levels"]
    power = power_of_ten(float(np.abs(levels).max()))
    factor = f"$10^{{{power}}}$" if power else ""
    unit = f"{factor} {unit_text(energy_unit) or 'unit of ε'}".strip()
    bar = figure.colorbar(
        ScalarMappable(norm=shades["norm"], cmap=shades["cmap"]), ax=list(panels), location="bottom",
        pad=0.02, aspect=25,
        label=f"$U$ ({unit})", spacing="proportional",
    )  # fmt: skip
    shown = levels[:: 4 if len(levels) > 8 else 2]
    bar.set_ticks(shown.tolist())
    bar.minorticks_off()
    bar.ax.set_xticklabels([f"{one / 10.0**power:.4g}".replace("-", "−") for one in shown])


@drawn_in_style
def plot_error_maps(
    axes_values: Sequence[np.ndarray],
    maps: Mapping[str, np.ndarray],
    *,
    names: Sequence[str],
    units: Sequence[str],
    energy_unit: str,
) -> Figure | None:
    """Draw U by several sources, and how far each is from the first one.

    Parameters
    ----------
    axes_values
        The grid, shapes ``(nx,)`` and ``(ny,)``, ascending, in the states' units.
    maps
        U by each source, shape ``(nx, ny)``, NaN where it says nothing. The first one is the reference.
    names, units
        Of the two states.
    energy_unit
        Unit of U and ε; ``1`` and the empty text mean that of ε.

    Returns
    -------
    matplotlib.figure.Figure
        A row for each source: on the left U in the colours of the reference; on the right the absolute
        difference as a share of the reference's highest value, on a logarithmic scale, with its root mean
        square. None where there is nothing to compare.
    """
    fields = {name: np.asarray(values, dtype=float) for name, values in maps.items()}
    fields = {name: values for name, values in fields.items() if np.isfinite(values).any()}
    if len(fields) < 2 or next(iter(fields)) != next(iter(maps)):
        return None
    reference_name, reference = next(iter(fields.items()))
    highest = float(np.nanmax(np.abs(reference))) or 1.0
    figure = Figure(figsize=(PAGE_WIDTH, 1.9 * len(fields) + 0.9))
    panels = figure.subplots(len(fields), 2, sharex=True, sharey=True)
    shades = _shades(reference, None) | {"extend": "both"}
    shades["norm"] = BoundaryNorm(shades["levels"], 256, extend="both")
    differences = [np.abs(values - reference) / highest for values in list(fields.values())[1:]]
    for axes, (name, values) in zip(panels[:, 0], fields.items(), strict=True):
        axes.set_title(name, loc="left")
        _draw_values(axes, axes_values, values, shades, as_image=True)
    _add_bar(figure, list(panels[:, 0]), shades, energy_unit)
    _draw_differences(figure, list(panels[:, 1]), axes_values, differences, np.isfinite(reference).sum())
    corner = panels[0, 1]
    corner.set_axis_off()
    text = f"right: difference\nfrom {reference_name}\n/ highest $U$"
    corner.text(0.5, 0.65, text, transform=corner.transAxes, ha="center", va="center")
    corner.legend(handles=[Patch(label="not known", **UNKNOWN)], loc="lower center", borderpad=0)
    _limit(panels[0, 0], axes_values, reference)
    for axes in panels.ravel().tolist():
        axes.xaxis.set_major_locator(MaxNLocator(3))
        axes.yaxis.set_major_locator(MaxNLocator(4))
        _name_axes(axes, axes_values, names, units)
        axes.label_outer()
    return figure


def _draw_nothing(axes: Axes) -> None:
    _draw_unknown(axes)
    axes.text(0.5, 0.5, "not known", transform=axes.transAxes, ha="center", va="center", **RIM)


def _draw_differences(
    figure: Figure,
    panels: Sequence[Axes],
    axes_values: Sequence[np.ndarray],
    differences: Sequence[np.ndarray],
    compared: int,
) -> None:
    known = [one[np.isfinite(one)] for one in differences]
    largest = max((float(one.max(initial=0.0)) for one in known), default=0.0) or 1.0
    norm = LogNorm(largest / 10**DECADES, largest)
    for axes, difference, found in zip(panels[1:], differences, known, strict=True):
        if not found.size:
            _draw_nothing(axes)
            continue
        _draw_unknown(axes)
        # As an image: thousands of small rectangles would make a megabyte of vector graphics. What is less
        # than the scale shows, zero included, has its lowest colour.
        axes.pcolormesh(
            *axes_values, np.maximum(difference, largest / 10**DECADES).T, norm=norm, cmap=DIFFERENCE_MAP,
            shading="nearest", rasterized=True,
        )  # fmt: skip
        title = f"rms {magnitude_label(float(np.sqrt((found**2).mean())))}"
        if found.size < compared:
            title += f", at {100 * found.size / compared:.3g} %"
        axes.set_title(title, loc="left")
    bar = figure.colorbar(
        ScalarMappable(norm=norm, cmap=DIFFERENCE_MAP), ax=panels, label="difference / highest $U$",
        location="bottom", pad=0.02, aspect=25, extend="min",
    )  # fmt: skip
    bar.minorticks_off()
