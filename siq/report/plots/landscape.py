"""What U looks like over all wells, and how far its estimates are from a reference."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm, LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator

from siq.report.plots.landscape_curves import plot_degrees, plot_escape, power_of_ten, scaled_label
from siq.report.plots.style import (
    BLACK,
    ORANGE,
    PAGE_WIDTH,
    drawn_in_style,
    magnitude_label,
    name_label,
    sentence_figure,
)

__all__ = ["plot_degrees", "plot_error_maps", "plot_escape", "plot_landscape"]

Extend = Literal["neither", "both", "min", "max"]

COLOUR_MAP = "viridis"
DIFFERENCE_MAP = "magma"
LEVELS = 14
DECADES = 4  # of differences, below the largest one
MARGIN = 0.06  # of what is known: shown around it
UNKNOWN: dict[str, Any] = {"facecolor": "#F0F0F0", "edgecolor": "#C8C8C8", "hatch": "////", "linewidth": 0}
# White with a black rim, and black with a white one: both are seen on every colour.
UPHILL: dict[str, Any] = {
    "color": "white", "linewidth": 1.2, "path_effects": [withStroke(linewidth=2.2, foreground=BLACK)],
}  # fmt: skip
DOWNHILL: dict[str, Any] = {
    "color": BLACK, "linewidth": 1.0, "linestyle": (0, (4, 2)),
    "path_effects": [withStroke(linewidth=2.0, foreground="white")],
}  # fmt: skip
RIM: dict[str, Any] = {"path_effects": [withStroke(linewidth=2.0, foreground="white")]}
# Marker and its look, for each kind of equilibrium.
MARKS: dict[str, dict[str, Any]] = {
    "attractor": {"marker": "o", "markersize": 6, "markerfacecolor": ORANGE, "markeredgecolor": BLACK},
    "saddle": {"marker": "x", "markersize": 6, "markeredgecolor": BLACK, "markeredgewidth": 1.4} | RIM,
    "repeller": {"marker": "o", "markersize": 6, "markerfacecolor": "none", "markeredgecolor": BLACK} | RIM,
    "degenerate": {"marker": "D", "markersize": 5, "markerfacecolor": "none", "markeredgecolor": BLACK} | RIM,
}


@drawn_in_style
def plot_landscape(
    axes_values: Sequence[np.ndarray],
    values: np.ndarray,
    *,
    names: Sequence[str],
    units: Sequence[str],
    energy_unit: str,
    equilibria: pd.DataFrame,
    paths: Sequence[tuple[np.ndarray, np.ndarray]] = (),
    level: float | None = None,
) -> Figure:
    """Draw U of two states with its equilibria and the paths of least action.

    Parameters
    ----------
    axes_values
        The grid, shapes ``(nx,)`` and ``(ny,)``, ascending, in the states' units.
    values
        Shape ``(nx, ny)``: U, not V, NaN where it is not known.
    names, units
        Of the two states.
    energy_unit
        Unit of U and ε; ``1`` and the empty text mean that of ε.
    equilibria
        Columns ``kind x y label``; the kind is ``attractor``, ``saddle``, ``repeller`` or ``degenerate``.
    paths
        Pairs of an uphill and a downhill part, of shapes ``(n, 2)``; each may be empty.
    level
        U of the top contour, by default the highest value.

    Returns
    -------
    matplotlib.figure.Figure
        Filled contours; what lies above the top contour has the colour of the bar's pointed end, and where U
        is not known the plane is hatched.
    """
    values = np.asarray(values, dtype=float)
    if not np.isfinite(values).any():
        return sentence_figure("U is known nowhere.")
    figure = Figure(figsize=(0.75 * PAGE_WIDTH, 4.4))
    axes = figure.add_subplot()
    shades = _shades(values, level)
    _draw_values(axes, axes_values, values, shades)
    ways = [[np.asarray(part, dtype=float).reshape(-1, 2) for part in pair] for pair in paths]
    places = np.concatenate(
        [equilibria[["x", "y"]].to_numpy(float), *(part for pair in ways for part in pair)]
    )
    _limit(axes, axes_values, values, places)
    handles = _draw_paths(axes, ways) + _draw_equilibria(axes, equilibria)
    handles += [Patch(label="$U$ is not known", **UNKNOWN)] if np.isnan(values).any() else []
    _name_axes(axes, axes_values, names, units)
    _add_bar(figure, [axes], shades, energy_unit)
    if handles:
        figure.legend(handles=handles, loc="outside lower center", ncols=3)
    return figure


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


def _draw_paths(axes: Axes, ways: Sequence[Sequence[np.ndarray]]) -> list[Any]:
    """Downhill parts lie above: where both coincide, dashes on the line show that they do."""
    handles = []
    for part, style, text in ((0, UPHILL, "least action, uphill"), (1, DOWNHILL, "downhill, without noise")):
        lines = [pair[part] for pair in ways if len(pair[part])]
        for line in lines:
            axes.plot(line[:, 0], line[:, 1], zorder=3 + 0.1 * part, **style)
        handles += [Line2D([], [], label=text, **style)] if lines else []
    return handles


def _draw_equilibria(axes: Axes, equilibria: pd.DataFrame) -> list[Any]:
    handles = []
    low, high = (np.array(limits) for limits in zip(axes.get_xlim(), axes.get_ylim(), strict=True))
    for kind, style in MARKS.items():
        rows = equilibria[equilibria["kind"] == kind]
        for x, y, label in rows[["x", "y", "label"]].itertuples(index=False):
            axes.plot(x, y, linestyle="none", zorder=4, **style)
            # Names lie towards the middle, where there is room for them.
            side = np.where(np.array([x, y]) > low + 0.85 * (high - low), -1, 1)
            axes.annotate(
                str(label), (x, y), xytext=(5 * side[0], 5 * side[1]), textcoords="offset points", zorder=5,
                ha="left" if side[0] > 0 else "right", va="bottom" if side[1] > 0 else "top",
                annotation_clip=True, **RIM,
            )  # fmt: skip
        handles += [Line2D([], [], linestyle="none", label=kind, **style)] if len(rows) else []
    return handles


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
    unit = [factor, "in the unit of ε"] if energy_unit in ("1", "") else [f"{factor} {energy_unit}".strip()]
    bar = figure.colorbar(
        ScalarMappable(norm=shades["norm"], cmap=shades["cmap"]), ax=list(panels), pad=0.02, aspect=25,
        label=f"$U$ ({', '.join(filter(None, unit))})", spacing="proportional",
    )  # fmt: skip
    shown = levels[:: 2 if len(levels) > 8 else 1]
    bar.set_ticks(shown.tolist())
    bar.minorticks_off()
    bar.ax.set_yticklabels([f"{one / 10.0**power:.4g}".replace("-", "−") for one in shown])


@drawn_in_style
def plot_error_maps(
    axes_values: Sequence[np.ndarray],
    maps: Mapping[str, np.ndarray],
    *,
    names: Sequence[str],
    units: Sequence[str],
    energy_unit: str,
) -> Figure:
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
        Above, U by each source in the colours of the reference; below, the absolute difference in units of
        the reference's highest value, on a logarithmic scale, with its root mean square.
    """
    if not maps:
        return sentence_figure("There is no U to compare.")
    fields = {name: np.asarray(values, dtype=float) for name, values in maps.items()}
    (reference_name, reference), *others = fields.items()
    if not np.isfinite(reference).any():
        return sentence_figure(f"U by {reference_name} is known nowhere: nothing can be compared with it.")
    highest = float(np.nanmax(np.abs(reference))) or 1.0
    figure = Figure(figsize=(PAGE_WIDTH, 3.8 if others else 2.2))
    panels = figure.subplots(2 if others else 1, len(fields), squeeze=False, sharex=True, sharey=True)
    shades = _shades(reference, None) | {"extend": "both"}
    shades["norm"] = BoundaryNorm(shades["levels"], 256, extend="both")
    for axes, (name, values) in zip(panels[0], fields.items(), strict=True):
        axes.set_title(name)
        if np.isfinite(values).any():
            _draw_values(axes, axes_values, values, shades, as_image=True)
        else:
            _draw_nothing(axes)
    _add_bar(figure, list(panels[0]), shades, energy_unit)
    if others:
        differences = [np.abs(values - reference) / highest for _, values in others]
        _draw_differences(figure, list(panels[1]), axes_values, differences, np.isfinite(reference).sum())
        corner = panels[1, 0]
        text = f"difference from\n{reference_name},\nin units of\nits highest $U$"
        corner.text(0.5, 0.6, text, transform=corner.transAxes, ha="center", va="center", fontsize=7)
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
            title += f"\nat {100 * found.size / compared:.3g} % of the points"
        axes.set_title(title, fontsize=7)
    bar = figure.colorbar(
        ScalarMappable(norm=norm, cmap=DIFFERENCE_MAP), ax=panels, label="difference / highest $U$",
        pad=0.02, aspect=25, extend="min",
    )  # fmt: skip
    bar.minorticks_off()
