"""Figures of wells, paths and barriers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from scipy.interpolate import PchipInterpolator

from siq.numerics.text import unit_text
from siq.quasipotential.landscape import Landscape
from siq.quasipotential.transitions import Transition
from siq.quasipotential.wells import Well
from siq.report.plots.quasipotential import (
    CURVE_POINTS,
    MOST_POINTS,
    POINTS,
    SADDLE,
    draw_equilibria,
    name_axes,
    name_energy,
    new_axes,
    with_legend,
)
from siq.report.plots.style import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    LINE_STYLES,
    MARKERS,
    ORANGE,
    PURPLE,
    SKY_BLUE,
    VERMILLION,
    magnitude_label,
    mean_and_spread,
)
from siq.report.summary import LandscapeSummary, summarise

if TYPE_CHECKING:
    from siq.data.recordings import Recordings

_Join = tuple[tuple[int, ...], tuple[int, ...], float]  # the wells on both sides of a saddle, and U at it

COLOURS = (BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY_BLUE)


def plot_wells(
    landscape: Landscape | LandscapeSummary, *, recordings: Recordings | None = None,
    states: Sequence[str] | None = None, legend: bool = True, ax: Axes | None = None,
) -> Axes:  # fmt: skip
    """Draw which recorded states belong to which well, and how far each well reaches.

    Main arguments
    --------------
    landscape
        The landscape.
    recordings
        What it was found from; by default the states to which its formulas were fitted are drawn.

    Other arguments
    ---------------
    states
        Names of two states that make the plane, where there are more than two.
    legend
        Whether to say below the axes what the colours mean.
    ax
        Where; by default new axes of pyplot.

    Returns
    -------
    matplotlib.axes.Axes
        A colour for each well. Of one state its curve of U; of two and more its states, and a line around
        those that lie below its lowest saddle. A state is the well's whose formula holds there and gives the
        lowest U; one where no formula holds is grey.
    """
    shown = summarise(landscape, recordings)
    axes = new_axes() if ax is None else ax
    known = [(place, well) for place, well in enumerate(shown.formulas) if well is not None]
    handles = [
        Line2D([], [], **_look(place, "color", "marker"), label=f"well {shown.wells[place].label}")
        for place, _ in known
    ]
    if len(shown.names) == 1:
        _draw_curves(axes, shown, known)
        handles.append(Line2D([], [], label="saddle", **SADDLE))
    else:
        plane = shown.plane(states)
        handles += _draw_states(axes, shown, known, plane)
        handles += [one for one in draw_equilibria(axes, shown, plane) if one.get_label() == "saddle"]
        name_axes(axes, shown, plane)
        axes.set_xlim(*shown.box[plane[0]])
        axes.set_ylim(*shown.box[plane[1]])
    return with_legend(axes, handles, legend=legend)


def plot_paths(
    landscape: Landscape | LandscapeSummary, *, legend: bool = True, ax: Axes | None = None
) -> Axes:
    """Draw U along the most probable way out of each well, over its saddle, and down into the next.

    Parameters
    ----------
    landscape
        The landscape, of any number of states.
    legend
        Whether to name the ways below the axes.
    ax
        Where; by default new axes of pyplot.

    Returns
    -------
    matplotlib.axes.Axes
        U against the distance from the saddle along the way. Of two wells the one that comes first in the
        tables is on the left, so that a way and the way back lie on one another where they are the same.
        Where the states have different units the distance is a share of the region that is shown.

    Raises
    ------
    ValueError
        When no way out of any well is known.
    """
    shown = summarise(landscape)
    ways = [way for way in shown.ways if len(way.uphill)]
    if not ways:
        raise ValueError("no way out of any well is known: there is no path to draw")
    axes = new_axes() if ax is None else ax
    one_unit = len(set(shown.units)) == 1
    scale = np.ones(len(shown.names)) if one_unit else np.ptp(shown.box, axis=1)
    seen: set[tuple[str, bool]] = set()
    for place, way in enumerate(ways):
        along, values = _profile(shown, way, scale)
        end = "outside" if way.end is None else shown.wells[way.end].label
        axes.plot(
            along, values, **_look(place, "color", "linestyle"), linewidth=2.2 - 0.6 * (place % 2),
            label=f"{shown.wells[way.start].label} to {end}",
        )  # fmt: skip
        mirrored = way.end is not None and way.end < way.start
        ends = [(along[-1 if mirrored else 0], shown.wells[way.start])]
        ends += [] if way.end is None else [(along[0 if mirrored else -1], shown.wells[way.end])]
        for where, well in ends:
            key = (well.label, bool(where > 0))
            if key not in seen:
                _letter(axes, well.label, (float(where), well.height), -5)
            seen.add(key)
    axes.axvline(0.0, color=GREY, linewidth=0.8, linestyle=(0, (2, 2)), zorder=0)
    axes.margins(y=0.15)
    name_energy(axes, shown, max(abs(limit) for limit in axes.get_ylim()), "$U$ along the way")
    unit = shown.units[0] if one_unit else ""
    what = "distance from the saddle" if one_unit else "distance from the saddle / size of the region"
    axes.set_xlabel(f"{what} ({unit_text(unit)})" if unit not in ("", "1") else what)
    return with_legend(axes, axes.get_legend_handles_labels()[0], legend=legend)


def _profile(
    landscape: LandscapeSummary, way: Transition, scale: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Distance along a way, zero at the saddle, and U: by the action uphill, by the formulas downhill."""
    up, down = way.uphill, way.downhill[1:]
    points = np.concatenate([up, down])
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points / scale, axis=0), axis=1))])
    along = along - along[len(up) - 1]
    values = landscape.potential(points)
    bottom, beyond = landscape.wells[way.start].height, None if way.end is None else landscape.wells[way.end]
    if np.isfinite(bottom) and np.isfinite(way.barrier):
        share = _share_of_action(landscape, up)
        values[: len(up)] = values[: len(up)] if share is None else bottom + way.barrier * share
        values[0], values[len(up) - 1] = bottom, bottom + way.barrier
    if beyond is not None and np.isfinite(beyond.height):
        values[-1] = beyond.height
    known = np.isfinite(values) & (np.diff(along, prepend=-np.inf) > 0)
    if known.sum() > 1:
        values = PchipInterpolator(along[known], values[known], extrapolate=False)(along)
    mirrored = way.end is not None and way.end < way.start
    return (-along[::-1], values[::-1]) if mirrored else (along, values)


def _share_of_action(landscape: LandscapeSummary, path: np.ndarray) -> np.ndarray | None:
    """Which share of the action is spent up to each point of a path; None where D has no inverse.

    It is ∫ (|f| |dφ| - f·dφ) in the metric of the noise, see `siq.quasipotential.paths`.
    """
    dynamics = landscape.dynamics
    if dynamics is None or not dynamics.diffusion.regular:
        return None
    middle, step, noise = (path[1:] + path[:-1]) / 2, np.diff(path, axis=0), dynamics.diffusion
    flow = dynamics.drift(middle)
    fast, far = noise.squared_speed(middle, flow), noise.squared_speed(middle, step)
    with_it = (noise.squared_speed(middle, flow + step) - fast - far) / 2
    spent = np.concatenate([[0.0], np.cumsum(np.maximum(np.sqrt(fast * far) - with_it, 0.0))])
    return np.asarray(spent / spent[-1]) if spent[-1] > 0 else None


def _look(place: int, *parts: str) -> dict[str, Any]:
    """Some of the ``color``, ``linestyle`` and ``marker`` of a well or a way."""
    looks = {"color": COLOURS, "linestyle": LINE_STYLES, "marker": MARKERS}
    return {part: looks[part][place % len(looks[part])] for part in parts}


def _letter(axes: Axes, label: str, place: tuple[float, float], below: float) -> None:
    axes.annotate(
        label, place, xytext=(0, below), textcoords="offset points", ha="center", va="top", fontweight="bold"
    )


def _draw_curves(axes: Axes, landscape: LandscapeSummary, known: Sequence[tuple[int, Well]]) -> None:
    x = landscape.along(0, CURVE_POINTS)
    every = [landscape.wells[place].height + 2 * well.known_values(x[:, None]) for place, well in known]
    top = landscape.highest_shown(np.concatenate([np.zeros(0), *every]))
    for (place, _), values in zip(known, every, strict=True):
        shade = np.where(values < top, values, np.nan)
        well, colour = landscape.wells[place], _look(place, "color")
        axes.plot(x, shade, **colour, linewidth=2.0)
        axes.fill_between(x, shade, top, **colour, alpha=0.12, linewidth=0)
        axes.plot(
            well.position, [well.height], **_look(place, "color", "marker"), markeredgecolor=BLACK,
            linestyle="none",
        )  # fmt: skip
        _letter(axes, well.label, (well.position[0], well.height), -8)
    for one in landscape.saddles:
        axes.plot(one.position, [one.height], **SADDLE)
    axes.margins(y=0.15)
    name_axes(axes, landscape, (0,))
    name_energy(axes, landscape, abs(top))


def _draw_states(
    axes: Axes, landscape: LandscapeSummary, known: Sequence[tuple[int, Well]], plane: tuple[int, int]
) -> list[Any]:
    points = landscape.points
    points = np.zeros((0, len(landscape.names))) if points is None else points
    points = points[:: max(len(points) // MOST_POINTS, 1)]
    values = np.full((len(landscape.wells), len(points)), np.inf)
    for place, well in known:
        above = landscape.wells[place].height + 2 * well.known_values(points)
        values[place] = np.nan_to_num(above, nan=np.inf)
    owner = np.where(np.isfinite(values).any(axis=0), values.argmin(axis=0), -1)
    handles = []
    for place in [-1, *(place for place, _ in known)]:
        rows = owner == place
        look: dict[str, Any] = {"color": GREY, "alpha": 0.25, "marker": "."}
        look = look if place < 0 else _look(place, "color", "marker") | {"alpha": 0.5}
        axes.plot(
            *points[rows][:, list(plane)].T, linestyle="none", markersize=2.5, markeredgewidth=0,
            rasterized=True, **look,
        )  # fmt: skip
        if place < 0 and rows.any():
            handles.append(Line2D([], [], linestyle="none", marker=".", color=GREY, label="no formula holds"))
    if len(landscape.names) == 2:
        # Around each well the line of U at the height of its lowest saddle.
        x1, x2 = landscape.along(0, POINTS), landscape.along(1, POINTS)
        grid = np.stack(np.meshgrid(x1, x2, indexing="ij"), axis=-1).reshape(-1, 2)
        for place, well in known:
            level, heights = landscape.wells[place].depth, 2 * well.known_values(grid)
            level = level if np.isfinite(level) else 2 * well.level
            if np.nanmin(heights, initial=np.inf) < level:
                look = _look(place, "color", "linestyle")
                axes.contour(
                    x1, x2, heights.reshape(POINTS, POINTS).T, levels=[level], colors=look["color"],
                    linewidths=1.6, linestyles=look["linestyle"],
                )  # fmt: skip
        handles.append(Line2D([], [], color=GREY, linewidth=1.6, label="rim: height of the lowest saddle"))
    return handles


NO_ERROR = 1e-4  # of a barrier: a smaller error is not written
SIDE_BY_SIDE = 3  # wells whose barriers stand beside each other with their errors
OPEN = 0.14  # of the height of the picture: how far a way out of the recorded region rises


def plot_barriers(landscape: Landscape | LandscapeSummary, *, ax: Axes | None = None) -> Axes:
    """Draw the wells as a tree: each hangs as deep as it is, and joins the next at their saddle.

    Parameters
    ----------
    landscape
        The landscape.
    ax
        Where; by default new axes of pyplot.

    Returns
    -------
    matplotlib.axes.Axes
        A column for each well, from U at its bottom up to the lowest saddle that leads out of it, with ΔU and
        its standard error below, as a bar at the top too. A dashed column is left out of the recorded region.
        Where the heights of the wells are not known, each column begins at zero.

    Raises
    ------
    ValueError
        When no barrier is known.
    """
    shown = summarise(landscape)
    if not any(np.isfinite(way.barrier) for way in shown.ways):
        raise ValueError("no barrier of this landscape is known: there is nothing to draw")
    axes = new_axes() if ax is None else ax
    joins, order = _joined(shown)
    places = {well: float(place) for place, well in enumerate(order)}
    tops = _draw_joins(axes, joins, places)
    reach = max([*tops.values(), *(w.height + w.depth for w in shown.wells if np.isfinite(w.depth))])
    span = (reach - min(well.height for well in shown.wells)) or 1.0
    labels, many = [], len(order) > SIDE_BY_SIDE
    for number, well in enumerate(shown.wells):
        place, height = places[number], well.height
        axes.plot(place, height, marker="_", markersize=18, markeredgewidth=3, color=BLUE, zorder=3)
        if not np.isfinite(well.depth):
            labels.append(f"{well.label}\nno barrier\nknown")
            continue
        end = tops.get(number, height + well.depth)
        dashed = number not in tops and well.beyond is None
        end, style = (end + OPEN * span, (0, (3, 2))) if dashed else (end, "-")
        axes.plot([place] * 2, [height, end], color=BLACK, linewidth=1.4, linestyle=style, zorder=2)
        if np.isfinite(well.depth_error):
            axes.errorbar(
                place, height + well.depth, yerr=2 * well.depth_error, color=VERMILLION, marker="_",
                markersize=9, capsize=4, elinewidth=1.4, zorder=4,
            )  # fmt: skip
        barrier = magnitude_label(well.depth, digits=4)  # without digits that mean nothing
        if np.isfinite(well.depth_error) and well.depth_error > NO_ERROR * abs(well.depth):
            barrier = mean_and_spread(well.depth, well.depth_error)
            if many and "(" not in barrier:  # on two lines where there is no room
                barrier = barrier.replace(r" \pm ", "$\n$\\pm$ $")
        labels.append(f"{well.label}\n$\\Delta U$ =\n{barrier}")
    axes.set_xticks([places[number] for number in range(len(order))], labels)
    axes.tick_params(axis="x", length=0)
    axes.set_xlim(-0.6, len(order) - 0.4)
    axes.grid(axis="y", linewidth=0.4, color="#DDDDDD")
    axes.set_axisbelow(True)
    axes.margins(y=0.08)
    axes.spines["bottom"].set_visible(False)
    what = "$U$" if shown.matched else "$U$ above each bottom"
    name_energy(axes, shown, reach, what)
    axes.set_xlabel("bars: ± 2 standard errors of the lowest way out", color=GREY)
    return axes


def _joined(landscape: LandscapeSummary) -> tuple[list[_Join], tuple[int, ...]]:
    """How wells join into one, from the lowest saddle to the highest; their order, without crossings."""
    wells = landscape.wells
    groups: dict[int, tuple[int, ...]] = {well: (well,) for well in range(len(wells))}
    saddles = sorted(
        (wells[way.start].height + way.barrier, way.start, way.end)
        for way in landscape.ways
        if way.end is not None and np.isfinite(way.barrier) and landscape.matched
    )
    joins: list[_Join] = []
    for height, start, end in saddles:
        left, right = sorted((groups[start], groups[end]), key=min)
        if left != right:
            joins.append((left, right, height))
            groups |= dict.fromkeys((*left, *right), (*left, *right))
    return joins, tuple(dict.fromkeys(well for group in groups.values() for well in group))


def _draw_joins(axes: Axes, joins: list[_Join], places: dict[int, float]) -> dict[int, float]:
    """Draw the tree above its columns; what is returned is the height at which each well first joins."""
    tops: dict[int, float] = {}
    stems: dict[int, tuple[float, float]] = {}  # of the group of a well: where its stem stands, and begins
    for left, right, height in joins:
        ends = []
        for group in (left, right):
            place, bottom = stems.get(group[0], (places[group[0]], np.nan))
            if np.isnan(bottom):
                tops[group[0]] = height
            else:
                axes.plot([place] * 2, [bottom, height], color=BLACK, linewidth=1.4, zorder=2)
            ends.append(place)
        axes.plot(ends, [height] * 2, color=BLACK, linewidth=1.4, zorder=2)
        stems |= dict.fromkeys((*left, *right), (sum(ends) / 2, height))
    return tops
