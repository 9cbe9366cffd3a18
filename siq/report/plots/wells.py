"""Figures of wells, paths and barriers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from scipy.interpolate import PchipInterpolator

from siq.numerics.text import unit_text
from siq.quasipotential.landscape import Landscape
from siq.quasipotential.wells import Well
from siq.report.plots.quasipotential import (
    CURVE_POINTS,
    MOST_POINTS,
    POINTS,
    SADDLE,
    add_legend,
    as_drawn,
    draw_equilibria,
    energy_axis_label,
    highest_shown,
    in_blocks,
    name_axes,
    new_axes,
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
from siq.report.summary import ExitSummary, LandscapeSummary, chosen_states

if TYPE_CHECKING:
    from siq.data.recordings import Recordings

COLOURS = (BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY_BLUE)


def plot_wells(
    landscape: Landscape | LandscapeSummary,
    *,
    recordings: Recordings | None = None,
    states: Sequence[str] | None = None,
    legend: bool = True,
    ax: Axes | None = None,
) -> Axes:
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
        those that lie below its lowest pass. A state is the well's whose formula holds there and gives the
        lowest U; one where no formula holds is grey.

    Examples
    --------
    >>> from matplotlib.figure import Figure
    >>> from siq.data.recordings import Recordings
    >>> t, starts = np.linspace(0, 3, 61), np.random.default_rng(0).uniform(-1.5, 1.5, 60)
    >>> x = starts / np.sqrt(starts**2 + (1 - starts**2) * np.exp(-2 * t[:, None]))  # dx/dt = x - x³
    >>> recordings = Recordings.from_arrays(t, x.T[:, :, None], names=["x"])
    >>> axes = plot_wells(Landscape.from_recordings(recordings), ax=Figure().add_subplot())
    >>> [text.get_text() for text in axes.get_legend().get_texts()]
    ['well A', 'well B', 'saddle']
    """
    shown = as_drawn(landscape, recordings)
    axes = new_axes() if ax is None else ax
    known = [(place, well) for place, well in enumerate(shown.formulas) if well is not None]
    handles = [
        Line2D(
            [],
            [],
            color=_colour(place),
            marker=MARKERS[place % len(MARKERS)],
            label=f"well {shown.wells[place].label}",
        )
        for place, _ in known
    ]
    if len(shown.names) == 1:
        _draw_curves(axes, shown, known)
        handles.append(Line2D([], [], label="saddle", **SADDLE))
    else:
        plane = chosen_states(shown, states)
        handles += _draw_states(axes, shown, known, plane)
        handles += [one for one in draw_equilibria(axes, shown, plane) if one.get_label() == "saddle"]
        name_axes(axes, shown, plane)
        axes.set_xlim(*shown.box[plane[0]])
        axes.set_ylim(*shown.box[plane[1]])
    if legend:
        add_legend(axes, handles)
    return axes


def plot_paths(
    landscape: Landscape | LandscapeSummary, *, legend: bool = True, ax: Axes | None = None
) -> Axes:
    """Draw U along the most probable way out of each well, over its pass, and down into the next.

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
        U against the distance from the pass along the way. Of two wells the one that comes first in the
        tables is on the left, so that a way and the way back lie on one another where they are the same.
        Where the states have different units the distance is a share of the region that is shown.

    Raises
    ------
    ValueError
        When no way out of any well is known.

    Examples
    --------
    >>> from matplotlib.figure import Figure
    >>> from siq.data.recordings import Recordings
    >>> t, starts = np.linspace(0, 3, 61), np.random.default_rng(0).uniform(-1.5, 1.5, 60)
    >>> x = starts / np.sqrt(starts**2 + (1 - starts**2) * np.exp(-2 * t[:, None]))  # dx/dt = x - x³
    >>> recordings = Recordings.from_arrays(t, x.T[:, :, None], names=["x"])
    >>> axes = plot_paths(Landscape.from_recordings(recordings), ax=Figure().add_subplot())
    >>> [line.get_label() for line in axes.lines][:2]
    ['A to B', 'B to A']
    """
    shown = as_drawn(landscape)
    ways = [way for way in shown.ways if len(way.uphill)]
    if not ways:
        raise ValueError("no way out of any well is known: there is no path to draw")
    axes = new_axes() if ax is None else ax
    one_unit = len(set(shown.units)) == 1
    scale = np.ones(len(shown.names)) if one_unit else np.ptp(shown.box, axis=1)
    for place, way in enumerate(ways):
        along, values = _profile(shown, way, scale)
        end = "outside" if way.end is None else shown.wells[way.end].label
        axes.plot(
            along, values, color=_colour(place), linestyle=LINE_STYLES[place % len(LINE_STYLES)],
            linewidth=2.2 - 0.6 * (place % 2), label=f"{shown.wells[way.start].label} to {end}",
        )  # fmt: skip
    seen: set[tuple[str, bool]] = set()
    for way in ways:
        along, _ = _profile(shown, way, scale)
        mirrored = way.end is not None and way.end < way.start
        ends = [(along[-1 if mirrored else 0], shown.wells[way.start])]
        ends += [] if way.end is None else [(along[0 if mirrored else -1], shown.wells[way.end])]
        for where, well in ends:
            key = (well.label, bool(where > 0))
            if key not in seen:
                axes.annotate(
                    well.label, (float(where), well.height), xytext=(0, -5), textcoords="offset points",
                    ha="center", va="top", fontweight="bold",
                )  # fmt: skip
            seen.add(key)
    axes.axvline(0.0, color=GREY, linewidth=0.8, linestyle=(0, (2, 2)), zorder=0)
    axes.margins(y=0.15)
    largest = max(abs(limit) for limit in axes.get_ylim())
    axes.set_ylabel(energy_axis_label(axes.yaxis, shown, largest, "$U$ along the way"))
    unit = shown.units[0] if one_unit else ""
    what = "distance from the saddle" if one_unit else "distance from the saddle / size of the region"
    axes.set_xlabel(f"{what} ({unit_text(unit)})" if unit not in ("", "1") else what)
    if legend:
        add_legend(axes, axes.get_legend_handles_labels()[0])
    return axes


def _profile(
    landscape: LandscapeSummary, way: ExitSummary, scale: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Distance along a way, zero at the pass, and U there: by the action uphill, by the formulas downhill."""
    up, down = way.uphill, way.downhill[1:]
    points = np.concatenate([up, down])
    steps = np.linalg.norm(np.diff(points / scale, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(steps)])
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


def _colour(place: int) -> str:
    return COLOURS[place % len(COLOURS)]


def _draw_curves(axes: Axes, landscape: LandscapeSummary, known: Sequence[tuple[int, Well]]) -> None:
    x = landscape.along(0, CURVE_POINTS)
    heights = [one.height if landscape.matched else 0.0 for one in landscape.wells]
    every = [heights[place] + 2 * well.known_values(x[:, None]) for place, well in known]
    top = highest_shown(landscape, np.concatenate(every) if every else np.zeros(0))
    for (place, _), values in zip(known, every, strict=True):
        shade = np.where(values < top, values, np.nan)
        axes.plot(x, shade, color=_colour(place), linewidth=2.0)
        axes.fill_between(x, shade, top, color=_colour(place), alpha=0.12, linewidth=0)
        well = landscape.wells[place]
        axes.plot(
            well.position, [heights[place]], marker=MARKERS[place % len(MARKERS)], color=_colour(place),
            markeredgecolor=BLACK, linestyle="none",
        )  # fmt: skip
        axes.annotate(
            well.label, (well.position[0], heights[place]), xytext=(0, -8), textcoords="offset points",
            ha="center", va="top", fontweight="bold",
        )  # fmt: skip
    for one in landscape.saddles:
        axes.plot(one.position, [one.height], **SADDLE)
    axes.margins(y=0.15)
    name_axes(axes, landscape, (0,))
    axes.set_ylabel(energy_axis_label(axes.yaxis, landscape, abs(top)))


def _draw_states(
    axes: Axes, landscape: LandscapeSummary, known: Sequence[tuple[int, Well]], plane: tuple[int, int]
) -> list[Any]:
    points = landscape.points
    points = np.zeros((0, len(landscape.names))) if points is None else points
    points = points[:: max(len(points) // MOST_POINTS, 1)]
    heights = [one.height if landscape.matched else 0.0 for one in landscape.wells]
    values = np.full((len(landscape.wells), len(points)), np.inf)
    for place, well in known:
        values[place] = np.nan_to_num(heights[place] + 2 * well.known_values(points), nan=np.inf)
    owner = np.where(np.isfinite(values).any(axis=0), values.argmin(axis=0), -1)
    handles = []
    for place in [-1, *(place for place, _ in known)]:
        rows = owner == place
        look: dict[str, Any] = (
            {"color": GREY, "alpha": 0.25} if place < 0 else {"color": _colour(place), "alpha": 0.5}
        )
        axes.plot(
            *points[rows][:, list(plane)].T, linestyle="none", markersize=2.5, markeredgewidth=0,
            rasterized=True,
            marker=MARKERS[place % len(MARKERS)] if place >= 0 else ".", **look,
        )  # fmt: skip
        if place < 0 and rows.any():
            handles.append(Line2D([], [], linestyle="none", marker=".", color=GREY, label="no formula holds"))
    if len(landscape.names) == 2:
        _draw_rims(axes, landscape, known, heights)
        handles.append(Line2D([], [], color=GREY, linewidth=1.6, label="rim: height of the lowest saddle"))
    return handles


def _draw_rims(
    axes: Axes, landscape: LandscapeSummary, known: Sequence[tuple[int, Well]], heights: Sequence[float]
) -> None:
    """Around each well the line of U at the height of its lowest pass."""
    x1, x2 = landscape.along(0, POINTS), landscape.along(1, POINTS)
    grid = np.stack(np.meshgrid(x1, x2, indexing="ij"), axis=-1).reshape(-1, 2)
    for place, well in known:
        barriers = [way.barrier for way in landscape.ways if way.start == place and np.isfinite(way.barrier)]
        level = min(barriers) if barriers else 2 * well.level
        values = in_blocks(lambda x, well=well: 2 * well.known_values(x), grid)  # type: ignore[misc]
        if np.nanmin(values, initial=np.inf) < level:
            axes.contour(
                x1, x2, values.reshape(POINTS, POINTS).T, levels=[level], colors=_colour(place),
                linewidths=1.6,
                linestyles=LINE_STYLES[place % len(LINE_STYLES)],
            )  # fmt: skip


NO_ERROR = 1e-4  # of a barrier: a smaller error is not written
SIDE_BY_SIDE = 3  # wells whose barriers stand beside each other with their errors
OPEN = 0.14  # of the height of the picture: how far a way out of the recorded region rises


@dataclass(frozen=True)
class _Join:
    """Two groups of wells that join at a height.

    Attributes
    ----------
    left, right
        Places of the wells in each.
    height
        U at the pass between them.
    """

    left: tuple[int, ...]
    right: tuple[int, ...]
    height: float


def plot_barriers(landscape: Landscape | LandscapeSummary, *, ax: Axes | None = None) -> Axes:
    """Draw the wells as a tree: each hangs as deep as it is, and joins the next at the height of their pass.

    Parameters
    ----------
    landscape
        The landscape.
    ax
        Where; by default new axes of pyplot.

    Returns
    -------
    matplotlib.axes.Axes
        A column for each well, from U at its bottom up to the lowest pass that leads out of it, with ΔU and
        its standard error below, as a bar at the top too. A dashed column is left out of the recorded region.
        Where the heights of the wells are not known, each column begins at zero.

    Raises
    ------
    ValueError
        When no barrier is known.

    Examples
    --------
    >>> from matplotlib.figure import Figure
    >>> from siq.data.recordings import Recordings
    >>> t, starts = np.linspace(0, 3, 61), np.random.default_rng(0).uniform(-1.5, 1.5, 60)
    >>> x = starts / np.sqrt(starts**2 + (1 - starts**2) * np.exp(-2 * t[:, None]))  # dx/dt = x - x³
    >>> recordings = Recordings.from_arrays(t, x.T[:, :, None], names=["x"])
    >>> axes = plot_barriers(Landscape.from_recordings(recordings), ax=Figure().add_subplot())
    >>> [label.get_text().splitlines()[0] for label in axes.get_xticklabels()]
    ['A', 'B']
    """
    shown = as_drawn(landscape)
    if not any(np.isfinite(way.barrier) for way in shown.ways):
        raise ValueError("no barrier of this landscape is known: there is nothing to draw")
    axes = new_axes() if ax is None else ax
    heights = [one.height if shown.matched else 0.0 for one in shown.wells]
    joins = _joined(shown, heights) if shown.matched else []
    places = _columns(len(heights), joins)
    tops = _draw_joins(axes, joins, places)
    lowest_ways = [_lowest_way(shown, well) for well in range(len(heights))]
    reach = max(
        [*tops.values(), *(heights[way.start] + way.barrier for way in lowest_ways if way is not None)]
    )
    span = (reach - min(heights)) or 1.0
    labels, many = [], len(heights) > SIDE_BY_SIDE
    for well, (height, way) in enumerate(zip(heights, lowest_ways, strict=True)):
        label = shown.wells[well].label
        if way is None:
            labels.append(f"{label}\nno barrier\nknown")
            axes.plot(places[well], height, marker="_", markersize=18, markeredgewidth=3, color=BLUE)
            continue
        top = tops.get(well, height + way.barrier)
        dashed = well not in tops and way.end is None
        style = (0, (3, 2)) if dashed else "-"
        end = top + OPEN * span if dashed else top
        axes.plot([places[well]] * 2, [height, end], color=BLACK, linewidth=1.4, linestyle=style, zorder=2)
        axes.plot(places[well], height, marker="_", markersize=18, markeredgewidth=3, color=BLUE, zorder=3)
        if np.isfinite(way.standard_error):
            axes.errorbar(
                places[well], height + way.barrier, yerr=2 * way.standard_error, color=VERMILLION, marker="_",
                markersize=9, capsize=4, elinewidth=1.4, zorder=4,
            )  # fmt: skip
        labels.append(f"{label}\n$\\Delta U$ =\n{_with_error(way.barrier, way.standard_error, broken=many)}")
    axes.set_xticks([places[well] for well in range(len(heights))], labels)
    axes.tick_params(axis="x", length=0)
    axes.set_xlim(-0.6, len(heights) - 0.4)
    axes.grid(axis="y", linewidth=0.4, color="#DDDDDD")
    axes.set_axisbelow(True)
    axes.margins(y=0.08)
    axes.spines["bottom"].set_visible(False)
    what = "$U$" if shown.matched else "$U$ above each bottom"
    axes.set_ylabel(energy_axis_label(axes.yaxis, shown, reach, what))
    axes.set_xlabel("bars: ± 2 standard errors of the lowest way out", color=GREY)
    return axes


def _with_error(value: float, error: float, *, broken: bool) -> str:
    """A barrier with its error, without the digits that nobody reads; on two lines where there is no room."""
    if not (np.isfinite(error) and error > NO_ERROR * abs(value)):
        return magnitude_label(value, digits=4)
    text = mean_and_spread(value, error)
    return text.replace(r" \pm ", "$\n$\\pm$ $") if broken and "(" not in text else text


def _joined(landscape: LandscapeSummary, heights: list[float]) -> list[_Join]:
    """The passes by which wells join into one, from the lowest to the highest."""
    passes = sorted(
        (heights[way.start] + way.barrier, way.start, way.end)
        for way in landscape.ways
        if way.end is not None and np.isfinite(way.barrier)
    )
    groups: dict[int, tuple[int, ...]] = {well: (well,) for well in range(len(heights))}
    joins = []
    for height, start, end in passes:
        left, right = groups[start], groups[end]
        if left != right:
            joins.append(_Join(left, right, height))
            groups |= dict.fromkeys((*left, *right), (*left, *right))
    return joins


def _columns(count: int, joins: list[_Join]) -> dict[int, float]:
    """Where each well stands, so that no two lines of the tree cross."""
    groups: dict[int, tuple[int, ...]] = {well: (well,) for well in range(count)}
    for join in joins:
        left, right = groups[join.left[0]], groups[join.right[0]]
        order = (*left, *right) if min(left) < min(right) else (*right, *left)
        groups |= dict.fromkeys(order, order)
    order = tuple(dict.fromkeys(well for start in range(count) for well in groups[start]))
    return {well: float(place) for place, well in enumerate(order)}


def _draw_joins(axes: Axes, joins: list[_Join], places: dict[int, float]) -> dict[int, float]:
    """Draw the tree above its columns; what is returned is the height at which each well first joins."""
    tops: dict[int, float] = {}
    stems: dict[int, tuple[float, float]] = {}  # of the group of a well: where its stem stands, and begins
    for join in joins:
        ends = []
        for group in (join.left, join.right):
            place, bottom = stems.get(group[0], (places[group[0]], np.nan))
            if np.isnan(bottom):
                tops[group[0]] = join.height
            else:
                axes.plot([place] * 2, [bottom, join.height], color=BLACK, linewidth=1.4, zorder=2)
            ends.append(place)
        axes.plot(ends, [join.height] * 2, color=BLACK, linewidth=1.4, zorder=2)
        stems |= dict.fromkeys((*join.left, *join.right), (sum(ends) / 2, join.height))
    return tops


def _lowest_way(landscape: LandscapeSummary, well: int) -> ExitSummary | None:
    ways = [way for way in landscape.ways if way.start == well and np.isfinite(way.barrier)]
    return min(ways, key=lambda way: way.barrier, default=None)
