"""Figures of U: a curve of one state, a map of two, planes of more."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator

from siq.numerics.text import unit_text
from siq.quasipotential.landscape import Landscape
from siq.report.plots.style import (
    BLACK,
    BLUE,
    GREY,
    ORANGE,
    VERMILLION,
    drawn_in_style,
    name_label,
    power_of_ten,
    scaled_label,
)
from siq.report.summary import LandscapeSummary, summarise

if TYPE_CHECKING:
    from siq.data.recordings import Recordings

View = Literal["projection", "section"]

POINTS = 141  # along each axis, of two states
POINTS_OF_MORE = 61  # of a projection, which asks for many points behind each of these
BEHIND = 40  # states in the other directions that a projection tries at each point
SWEEPS = 3  # after which the lowest of them moves by less than a pixel


def _on_plane(
    landscape: LandscapeSummary, shown: tuple[int, int], view: View = "projection"
) -> tuple[np.ndarray, str]:
    """U on a grid over the plane of two states, and in words what it is of where there are more states."""
    if view not in ("projection", "section"):
        raise ValueError(f"view is '{view}'; it is 'projection' or 'section'")
    rest = [place for place in range(len(landscape.names)) if place not in shown]
    count = POINTS_OF_MORE if rest and view == "projection" else POINTS
    x1, x2 = (landscape.along(place, count) for place in shown)
    at = landscape.lowest_saddle
    grid = np.tile(at, (count * count, 1))
    grid[:, shown] = np.stack(np.meshgrid(x1, x2, indexing="ij"), axis=-1).reshape(-1, 2)
    sentence = ""
    if rest and view == "section":
        held = ", ".join(f"{landscape.names[place]} = {at[place]:.3g}" for place in rest)
        sentence = f"Section at {held}, through the lowest saddle"
    elif rest:
        sentence = f"Projection: the lowest $U$ over {', '.join(landscape.names[place] for place in rest)}"
    projected = rest and view == "projection"
    values = _lowest_behind(landscape, grid, rest) if projected else landscape.potential(grid)
    return values.reshape(count, count), sentence


def _lowest_behind(landscape: LandscapeSummary, grid: np.ndarray, rest: list[int]) -> np.ndarray:
    """The lowest U over the other states at each point of a plane.

    The best of some states seen anywhere is followed down, one direction after another, by parabolas.
    """
    seen = [np.stack([one.position for one in landscape.marks])] if landscape.marks else []
    seen += [way.uphill for way in landscape.ways if len(way.uphill)]
    fitted = [well.points for well in landscape.formulas if well is not None and len(well.points)]
    if not fitted and landscape.points is not None:
        fitted = [landscape.points]
    points = np.concatenate([np.zeros((0, len(landscape.names))), *fitted])
    places = np.concatenate([*seen, points[:: max(len(points) // 2000, 1)]])[:, rest]
    width = np.ptp(landscape.box, axis=1)[rest]
    behind = [places[0]]  # each as far as possible from those before it
    far = np.linalg.norm((places - behind[0]) / width, axis=1)
    while len(behind) < min(BEHIND, len(places)) and far.max() > 0:
        behind.append(places[far.argmax()])
        far = np.minimum(far, np.linalg.norm((places - behind[-1]) / width, axis=1))
    best, lowest = grid.copy(), np.full(len(grid), np.inf)
    for one in behind:
        tried = grid.copy()
        tried[:, rest] = one
        values = np.nan_to_num(landscape.potential(tried), nan=np.inf)
        better = values < lowest
        best[better], lowest[better] = tried[better], values[better]
    known = np.flatnonzero(np.isfinite(lowest))
    step = 0.5 * width / max(len(behind), 1) ** (1 / len(rest))
    for _ in range(SWEEPS):
        for place, size in zip(rest, step, strict=True):
            _descend(landscape.potential, best, lowest, known, place, float(size))
        step = step / 3
    return np.where(np.isfinite(lowest), lowest, np.nan)


def _descend(
    potential: Callable[[np.ndarray], np.ndarray], best: np.ndarray, lowest: np.ndarray, known: np.ndarray,
    place: int, size: float,
) -> None:  # fmt: skip
    """Move points along one state to the lowest place of a parabola, where U really is lower there."""
    middle, centre = lowest[known].copy(), best[known].copy()
    sides = []
    for sign in (-1, 1):
        moved = centre.copy()
        moved[:, place] += sign * size
        sides.append(potential(moved))
        _take(best, lowest, known, moved, sides[-1])
    left, right = sides
    with np.errstate(invalid="ignore", divide="ignore"):
        shift = 0.5 * size * (left - right) / (left + right - 2 * middle)
    moved = centre
    moved[:, place] += np.clip(np.nan_to_num(shift, nan=0.0, posinf=0.0, neginf=0.0), -size, size)
    _take(best, lowest, known, moved, potential(moved))


def _take(
    best: np.ndarray, lowest: np.ndarray, known: np.ndarray, moved: np.ndarray, values: np.ndarray
) -> None:
    better = np.nan_to_num(values, nan=np.inf) < lowest[known]
    best[known[better]], lowest[known[better]] = moved[better], values[better]


WIDTH = 4.5  # inches: on a phone of 400 pixels its letters are 11 pixels high
LEVELS = 12
MOST_POINTS = 2500  # recorded ones; more make a fog
CURVE_POINTS = 801
# Dark in the wells, light above them: also without colour, and black letters stand on the light part.
COLOURS = LinearSegmentedColormap.from_list("wells", ["#1B4F8A", "#4F8FC4", "#A3CBE5", "#CFE2EE", "#DFECF4"])
RIM: dict[str, Any] = {"path_effects": [withStroke(linewidth=2.5, foreground="white")]}
UPHILL: dict[str, Any] = {
    "color": VERMILLION, "linewidth": 1.8, "path_effects": [withStroke(linewidth=3.0, foreground="white")],
}  # fmt: skip
DOWNHILL: dict[str, Any] = {
    "color": BLACK, "linewidth": 1.2, "linestyle": (0, (3, 2)),
    "path_effects": [withStroke(linewidth=2.4, foreground="white")],
}  # fmt: skip
WELL: dict[str, Any] = {
    "marker": "o", "markersize": 7, "markerfacecolor": ORANGE, "markeredgecolor": BLACK, "linestyle": "none",
}  # fmt: skip
SADDLE: dict[str, Any] = {
    "marker": "X", "markersize": 8, "markerfacecolor": "white", "markeredgecolor": BLACK, "linestyle": "none",
}  # fmt: skip
CYCLE: dict[str, Any] = {"color": ORANGE, "linewidth": 2.6}
PARTING: dict[str, Any] = {"color": BLACK, "linewidth": 1.2, "linestyle": (0, (1, 1.2))}
RECORDED: dict[str, Any] = {
    "marker": ".", "markersize": 2.5, "color": "#222222", "alpha": 0.35, "markeredgewidth": 0,
    "linestyle": "none",
}  # fmt: skip


def plot_quasipotential(
    landscape: Landscape | LandscapeSummary, *, recordings: Recordings | None = None,
    states: Sequence[str] | None = None, view: View = "projection", legend: bool = True,
    ax: Axes | None = None,
) -> Axes:  # fmt: skip
    """Draw U with its wells, saddles and most probable paths, and the recorded states.

    Main arguments
    --------------
    landscape
        The landscape.
    recordings
        What it was found from: their states are drawn as faint points. By default those to which the formulas
        were fitted.

    Other arguments
    ---------------
    states
        Names of the two states that make the plane, where there are more than two; by default those along
        which the wells lie apart.
    view
        Of three states and more: ``projection`` draws the lowest U that the other states allow, on which
        wells and saddles keep their heights; ``section`` holds the others at the lowest saddle.
    legend
        Whether to say below the axes what the signs mean.
    ax
        Where; by default new axes of pyplot.

    Returns
    -------
    matplotlib.axes.Axes
        Of one state a curve, with a band of two standard errors where the error of f is known; of more a map.
        Where U is not known nothing is drawn.
    """
    shown = summarise(landscape, recordings)
    axes = new_axes() if ax is None else ax
    return with_legend(axes, _draw_quasipotential(axes, shown, states=states, view=view), legend=legend)


@drawn_in_style
def quasipotential_figure(landscape: LandscapeSummary) -> Figure | None:
    """The first picture of a page, None where U is known nowhere."""
    if not landscape.wells:
        return None
    one = len(landscape.names) == 1
    figure = Figure(figsize=(WIDTH, 3.6 if one else 4.5))
    handles = _draw_quasipotential(figure.add_subplot(), landscape)
    places = [one.position[None] for one in landscape.wells]
    if landscape.points is not None:
        places.append(landscape.points[:: max(len(landscape.points) // 500, 1)])
    # Places that are drawn tell whether U is known at all.
    if not np.isfinite(landscape.potential(np.concatenate(places))).any() and not landscape.cycles:
        return None
    figure.legend(handles=handles, loc="outside lower center", ncols=2)
    return figure


def new_axes(**options: Any) -> Axes:
    """New axes of pyplot, so that a notebook shows them."""
    from matplotlib import pyplot  # whose state is left alone where axes are given

    axes: Axes = pyplot.subplots(layout="constrained", **options)[1]
    return axes


def with_legend(axes: Axes, handles: Sequence[Any], *, legend: bool) -> Axes:
    """The axes, with a legend below them where one is asked for, beside nothing that is drawn."""
    if legend:
        axes.legend(
            handles=list(handles), loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2, frameon=False,
            fontsize="small",
        )  # fmt: skip
    return axes


def _draw_quasipotential(
    axes: Axes, landscape: LandscapeSummary, *, states: Sequence[str] | None = None, view: View = "projection"
) -> list[Any]:
    """Draw U on axes; what is returned belongs into their legend."""
    if len(landscape.names) == 1:
        return _draw_curve(axes, landscape)
    shown = landscape.plane(states)
    values, sentence = _on_plane(landscape, shown, view)
    handles = _draw_map(axes, landscape, shown, values.T)
    if (points := landscape.points) is not None and len(points):
        # As an image: so many points would make megabytes of vector graphics.
        some = points[:: max(len(points) // MOST_POINTS, 1), list(shown)]
        axes.plot(*some.T, rasterized=True, zorder=2, **RECORDED)
        look = RECORDED | {"markersize": 5, "alpha": 0.8}
        handles.append(Line2D([], [], label="recorded states", **look))
    handles += _draw_ways(axes, landscape, shown)
    handles += draw_equilibria(axes, landscape, shown)
    name_axes(axes, landscape, shown)
    if sentence:
        axes.set_title(sentence, fontsize="medium", loc="left")
    return handles


def _draw_curve(axes: Axes, landscape: LandscapeSummary) -> list[Any]:
    x = landscape.along(0, CURVE_POINTS)
    values = landscape.potential(x[:, None])
    handles: list[Any] = []
    error = landscape.standard_error(x)
    top = landscape.highest_shown(values)
    lowest = float(np.nanmin(values)) if np.isfinite(values).any() else 0.0
    if error is not None and np.nanmax(np.where(values < top, error, 0.0)) > 1e-3 * (top - lowest):
        axes.fill_between(x, values - 2 * error, values + 2 * error, color=BLUE, alpha=0.25, linewidth=0)
        handles.append(Patch(color=BLUE, alpha=0.25, label="± 2 standard errors"))
    axes.plot(x, values, color=BLUE, linewidth=1.8)
    axes.set_ylim(lowest - (3 if len(handles) else 1) * 0.06 * (top - lowest), top)
    axes.set_xlim(*landscape.box[0])
    if landscape.points is not None and len(landscape.points):
        thinned = landscape.points[:: max(len(landscape.points) // MOST_POINTS, 1), 0]
        axes.plot(
            thinned, np.full(len(thinned), 0.012), transform=axes.get_xaxis_transform(), marker="|",
            color=GREY, markersize=6, alpha=0.25, linestyle="none", rasterized=True,
        )  # fmt: skip
        handles.append(Line2D([], [], linestyle="none", marker="|", color=GREY, label="recorded states"))
    for way in landscape.ways:
        if np.isfinite(way.barrier):
            well, bottom = landscape.wells[way.start].position[0], landscape.wells[way.start].height
            top_of_way = [bottom + way.barrier] * 2
            axes.plot([well, way.place[0]], top_of_way, color=GREY, linewidth=0.9, linestyle=(0, (2, 2)))
            axes.annotate(
                "", (well, bottom + way.barrier), xytext=(well, bottom),
                arrowprops={"arrowstyle": "<->", "color": GREY, "shrinkA": 0, "shrinkB": 0},
            )  # fmt: skip
    marks = [(one, WELL) for one in landscape.wells] + [(one, SADDLE) for one in landscape.saddles]
    for one, style in marks:
        height = landscape.potential(one.position[None])[0]
        height = one.height if np.isnan(height) else height
        axes.plot(one.position, [height], zorder=4, **style)
        if one.label:
            axes.annotate(
                one.label, (one.position[0], height), xytext=(0, -7), textcoords="offset points", ha="center",
                va="top", fontweight="bold", zorder=5, **RIM,
            )  # fmt: skip
    axes.set_ylim(bottom=lowest - 0.2 * (top - lowest))  # room for the letters
    handles += _names_of_marks(landscape)
    name_axes(axes, landscape, (0,))
    name_energy(axes, landscape, max(abs(top), abs(lowest)))
    return handles


def _draw_map(
    axes: Axes, landscape: LandscapeSummary, shown: tuple[int, int], values: np.ndarray
) -> list[Any]:
    handles: list[Any] = []
    x1, x2 = (landscape.along(place, len(values)) for place in shown)
    if np.isfinite(values).any():
        top, lowest = landscape.highest_shown(values), float(np.nanmin(values))
        lowest = 0.0 if abs(lowest) < 1e-3 * abs(top - lowest) else lowest
        top = top if top > lowest else lowest + (abs(lowest) or 1.0)
        levels = np.asarray(MaxNLocator(LEVELS, steps=[1, 2, 2.5, 5, 10]).tick_values(lowest, top))
        norm = BoundaryNorm(levels, 256, extend="max")
        heights = np.maximum(values, levels[0])
        filled = axes.contourf(x1, x2, heights, levels=levels, norm=norm, cmap=COLOURS, extend="max")
        axes.contour(x1, x2, heights, levels=levels, colors=BLACK, linewidths=0.35, alpha=0.5)
        power = power_of_ten(float(np.abs(levels).max()))
        bar = axes.figure.colorbar(filled, ax=axes, pad=0.02, aspect=25, spacing="proportional")
        bar.set_ticks(levels[:: 2 if len(levels) > 7 else 1].tolist())
        bar.minorticks_off()
        bar.ax.set_yticklabels([f"{one / 10.0**power:.4g}".replace("-", "−") for one in bar.get_ticks()])
        unit = unit_text(landscape.energy_unit) or "unit of ε"
        bar.set_label(f"$U$ ($10^{{{power}}}$ {unit})" if power else f"$U$ ({unit})")
        if np.isnan(values).any():
            handles.append(Patch(facecolor="white", edgecolor="#B0B0B0", label="white: $U$ not known"))
    first, second = shown
    axes.set_xlim(*landscape.box[first])
    axes.set_ylim(*landscape.box[second])
    return handles


def _draw_ways(axes: Axes, landscape: LandscapeSummary, shown: tuple[int, int]) -> list[Any]:
    """Draw the paths: uphill those of least action, downhill those of f without noise."""
    handles = []
    for part, style, text in (
        ("uphill", UPHILL, "most probable way out"), ("downhill", DOWNHILL, "and on, without noise"),
    ):  # fmt: skip
        lines = [line for way in landscape.ways if len(line := getattr(way, part))]
        for line in lines:
            axes.plot(*line[:, list(shown)].T, zorder=3 if part == "uphill" else 3.1, **style)
        handles += [Line2D([], [], label=text, **style)] if lines else []
    return handles


def draw_equilibria(axes: Axes, landscape: LandscapeSummary, shown: tuple[int, int]) -> list[Any]:
    """Draw wells with their letters, and saddles."""
    low, high = landscape.box[list(shown)].T
    marks = [(one, SADDLE) for one in landscape.saddles] + [(one, WELL) for one in landscape.wells]
    for lines, drawn_as in ((landscape.cycles, CYCLE), (landscape.parting, PARTING)):
        for line in lines:
            axes.plot(*line[:, list(shown)].T, zorder=3.2, **drawn_as)
    for one, style in marks:
        place = one.position[list(shown)]
        if one.kind != "cycle":
            axes.plot(*place, zorder=4, **style)
        if one.label:
            upward = 1 if (place[1] - low[1]) < 0.8 * (high[1] - low[1]) else -1
            axes.annotate(
                one.label, tuple(place), xytext=(0, 8 * upward), textcoords="offset points", ha="center",
                va="bottom" if upward > 0 else "top", fontweight="bold", zorder=5, annotation_clip=True,
                **RIM,
            )  # fmt: skip
    return _names_of_marks(landscape)


def _names_of_marks(landscape: LandscapeSummary) -> list[Any]:
    points = any(one.kind != "cycle" for one in landscape.wells)
    handles = [Line2D([], [], label="stable state", **WELL)] if points else []
    handles += [Line2D([], [], label="limit cycle", **CYCLE)] if landscape.cycles else []
    handles += [Line2D([], [], label="unstable cycle", **PARTING)] if landscape.parting else []
    return handles + ([Line2D([], [], label="saddle", **SADDLE)] if landscape.saddles else [])


def name_energy(axes: Axes, landscape: LandscapeSummary, largest: float, what: str = "$U$") -> None:
    """U and its unit at the upright axis, with a power of ten where numbers are unwieldy."""
    axes.set_ylabel(scaled_label(axes.yaxis, what, landscape.energy_unit or "unit of ε", largest))


def name_axes(axes: Axes, landscape: LandscapeSummary, shown: Sequence[int]) -> None:
    """Names and units of states at the axes, with a power of ten where numbers are unwieldy."""
    for axis, place in zip((axes.xaxis, axes.yaxis), shown, strict=False):
        largest = float(np.abs(landscape.box[place]).max())
        label = scaled_label(axis, f"${name_label(landscape.names[place])}$", landscape.units[place], largest)
        axis.set_label_text(label)
