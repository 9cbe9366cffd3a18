"""How deep is each well, and over which height does it join the next?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes

from siq.landscape.landscape import Landscape
from siq.report.drawn_landscape import DrawnLandscape, DrawnWay
from siq.report.plots.quasipotential import as_drawn, energy_axis_label, new_axes
from siq.report.plots.style import BLACK, BLUE, GREY, VERMILLION, magnitude_label, mean_and_spread

NO_ERROR = 1e-4  # of a barrier: a smaller error is not written
SIDE_BY_SIDE = 3  # wells whose barriers stand beside each other with their errors
OPEN = 0.14  # of the height of the picture: how far a way out of the recorded region rises


@dataclass(frozen=True)
class Join:
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


def plot_barriers(landscape: Landscape | DrawnLandscape, *, ax: Axes | None = None) -> Axes:
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
    joins = joined(shown, heights) if shown.matched else []
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


def joined(landscape: DrawnLandscape, heights: list[float]) -> list[Join]:
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
            joins.append(Join(left, right, height))
            groups |= dict.fromkeys((*left, *right), (*left, *right))
    return joins


def _columns(count: int, joins: list[Join]) -> dict[int, float]:
    """Where each well stands, so that no two lines of the tree cross."""
    groups: dict[int, tuple[int, ...]] = {well: (well,) for well in range(count)}
    for join in joins:
        left, right = groups[join.left[0]], groups[join.right[0]]
        order = (*left, *right) if min(left) < min(right) else (*right, *left)
        groups |= dict.fromkeys(order, order)
    order = tuple(dict.fromkeys(well for start in range(count) for well in groups[start]))
    return {well: float(place) for place, well in enumerate(order)}


def _draw_joins(axes: Axes, joins: list[Join], places: dict[int, float]) -> dict[int, float]:
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


def _lowest_way(landscape: DrawnLandscape, well: int) -> DrawnWay | None:
    ways = [way for way in landscape.ways if way.start == well and np.isfinite(way.barrier)]
    return min(ways, key=lambda way: way.barrier, default=None)
