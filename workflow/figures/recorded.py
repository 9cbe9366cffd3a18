"""Figures of recorded and predicted trajectories, and of the components of f (paper, Figs. 1 and 4a)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from string import ascii_lowercase
from typing import Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm
from matplotlib.figure import Figure

from siq.report.plots.style import (
    BLACK,
    BLUE,
    COLUMN_WIDTH,
    GREY,
    PAGE_WIDTH,
    VERMILLION,
    axis_label,
    counted,
    drawn_in_style,
    energy_label,
    name_label,
    unit_label,
)

BINS = 60  # of histograms of recorded states


def _draw_dataset_curves(data: Dataset, *, state: str, unit: str) -> Figure:
    """Draw trajectories of one state, histograms of what was recorded and of what the regression sees."""
    count = 2 if data.below is None else 3
    figure = Figure(figsize=(COLUMN_WIDTH, 2.3 * count))
    left, middle, *others = figure.subplots(count, 1)
    label = f"${name_label(state)}$ {unit_label('' if unit == '1' else unit)}".strip()
    for path in data.trajectories:
        left.plot(path[:, 0], linewidth=0.7)
    for path in data.without_noise:
        left.plot(path[:, 0], color=BLACK, linewidth=0.9, linestyle="--")
    left.set_xlabel("number of the sample")
    left.set_ylabel(label)
    dashed = "; dashed: no noise" if len(data.without_noise) else ""
    left.set_title(f"(a) {counted(len(data.trajectories), 'recording')}{dashed}", loc="left")
    x = data.points[:, 0]
    edges = np.linspace(x.min(), x.max(), BINS + 1)
    middle.hist(x, edges, color=GREY)
    middle.set_title(f"(b) recorded: {len(x)} pairs", loc="left")
    if data.below is not None:
        others[0].hist(x[data.below], edges, color=BLUE)
        others[0].set_title(f"(c) seen by the regression: {100 * data.below.mean():.3g} %", loc="left")
    for axes in (middle, *others):
        axes.set_xlabel(label)
        axes.set_ylabel("number of pairs")
    return figure


MOST_POINTS = 40_000  # drawn; more would only take longer


@dataclass(frozen=True)
class Dataset:
    """What the figure shows, of the first two states.

    Attributes
    ----------
    trajectories
        Some recorded ones, each of shape ``(k, 2)``.
    without_noise
        Where the recorded ones have noise, those without it from the same states; otherwise none.
    points
        All states at which pairs begin, shape ``(n, 2)``.
    below
        Mask of those that the regression sees; None where nothing says.
    axes, potential
        A grid and V_θ on it, shapes ``(n,)``, ``(m,)`` and ``(m, n)``, where there are two states.
    threshold
        V_θ below which the regression sees a state.
    """

    trajectories: Sequence[np.ndarray]
    without_noise: Sequence[np.ndarray]
    points: np.ndarray
    below: np.ndarray | None = None
    axes: tuple[np.ndarray, np.ndarray] | None = None
    potential: np.ndarray | None = None
    threshold: float = float("nan")


@drawn_in_style
def plot_dataset(data: Dataset, *, states: Sequence[str], units: Sequence[str]) -> Figure:
    """Draw trajectories, the recorded states, and those below the level of the regression.

    Parameters
    ----------
    data
        What to draw.
    states, units
        Names and units of all d states.

    Returns
    -------
    matplotlib.figure.Figure
        Two panels on the first two states, and a third where something says what the regression sees. The
        closed curve is the level of V_θ. Of a single state trajectories against the number of the sample, and
        histograms.
    """
    if data.points.shape[1] < 2:
        return _draw_dataset_curves(data, state=states[0], unit=units[0])
    count = 2 if data.below is None else 3
    figure = Figure(figsize=(PAGE_WIDTH, 2.9 if count == 2 else 5.4))
    every = figure.subplots(-(-count // 2), 2, sharex=True, sharey=True, squeeze=False).ravel()
    left, middle, *others = every
    for path in data.trajectories:
        left.plot(path[:, 0], path[:, 1], linewidth=0.6)
        left.plot(path[0, 0], path[0, 1], marker="o", markersize=3, color=BLACK)
    for path in data.without_noise:
        left.plot(path[:, 0], path[:, 1], color=BLACK, linewidth=0.9, linestyle="--")
    dashed = ";\ndashed: no noise" if len(data.without_noise) else ""
    left.set_title(f"(a) {counted(len(data.trajectories), 'recording')}{dashed}", loc="left")
    whole = len(data.points)
    kept = np.arange(0, whole, max(whole // MOST_POINTS, 1))
    _scatter(middle, data.points[kept], GREY)
    _draw_level(middle, data)
    middle.set_title(f"(b) recorded: {whole} pairs", loc="left")
    if data.below is not None:
        _scatter(others[0], data.points[kept][data.below[kept]], BLUE)
        _draw_level(others[0], data)
        others[0].set_title(f"(c) seen by the\nregression: {100 * data.below.mean():.3g} %", loc="left")
        others[1].remove()
        middle.tick_params(labelbottom=True)
    labels = [axis_label(name, unit) for name, unit in zip(states, units, strict=True)]
    for axes in every[:count]:
        axes.set_xlabel(labels[0])
    for axes in every[:count:2]:
        axes.set_ylabel(labels[1])
    return figure


def _scatter(axes: Axes, points: np.ndarray, colour: str) -> None:
    # As an image: so many points would make megabytes of vector graphics.
    axes.plot(*points.T, linestyle="none", marker=",", color=colour, rasterized=True)


def _draw_level(axes: Axes, data: Dataset) -> None:
    if data.axes is not None and data.potential is not None and np.isfinite(data.threshold):
        axes.contour(*data.axes, data.potential, levels=[data.threshold], colors=VERMILLION, linewidths=1.0)


TRAJECTORIES_SHOWN = 5
LEVELS = 14
ROUNDING = 1e-9  # of the largest slope
COLOUR_MAP = "viridis"
LANDSCAPES = ("exact", "identified")
Extend = Literal["neither", "both", "min", "max"]


@dataclass(frozen=True)
class ComponentFields:
    """Trajectories and fields on a grid of the first two states, the other states held fixed.

    Anything that is not there is None; of a system with one state, `x2` is empty or a single number, and the
    fields have one row.

    Attributes
    ----------
    x1, x2
        The grid, shapes ``(n,)`` and ``(m,)``, evenly spaced.
    minus_gradient, circulatory
        -∇V and g, their first two components, shape ``(2, m, n)`` (``(1, 1, n)`` with one state).
    quasipotential, exact_quasipotential
        The identified and the exact U, shape ``(m, n)``.
    trajectories
        The first two states of some trajectories, each of shape ``(k, 2)`` (``(k, 1)`` with one state).
    """

    x1: np.ndarray
    x2: np.ndarray
    minus_gradient: np.ndarray | None = None
    circulatory: np.ndarray | None = None
    quasipotential: np.ndarray | None = None
    exact_quasipotential: np.ndarray | None = None
    trajectories: Sequence[np.ndarray] = ()


@drawn_in_style
def plot_components(
    fields: ComponentFields,
    *,
    states: Sequence[str],
    units: Sequence[str],
    domain: np.ndarray,
    energy_unit: str = "",
) -> Figure | None:
    """Draw trajectories, -D∇V, g, the exact U and the identified U, projected on the first two states.

    Parameters
    ----------
    fields
        What to draw.
    states, units
        Names and units of the states.
    domain
        Shape ``(d, 2)``: the limits of the axes.
    energy_unit
        Unit of U; empty where it is that of ε.

    Returns
    -------
    matplotlib.figure.Figure
        A panel for each part that is known, two side by side. The width of stream lines grows with speed; the
        maps of U share one colour scale. With one state, V and g are drawn as curves. None where nothing but
        trajectories is known.
    """
    one_state = len(states) == 1
    known = _known(fields, one_state=one_state)
    if known in ([], ["trajectories"]):
        return None
    rows = -(-len(known) // 2)
    figure = Figure(figsize=(PAGE_WIDTH, 2.6 * rows + 0.5))
    panels = figure.subplots(rows, 2, squeeze=False).ravel()
    for axes in panels[len(known) :]:
        axes.remove()
    chosen = dict(zip(known, panels, strict=False))
    label = [axis_label(name, unit) for name, unit in zip(states, units, strict=True)]
    (_draw_curves if one_state else _draw_planes)(chosen, fields, label, np.asarray(domain))
    for letter, (name, axes) in zip(ascii_lowercase, chosen.items(), strict=False):
        axes.set_title(f"({letter}) {_title(name, fields, one_state=one_state)}", loc="left")
    maps = [axes for name, axes in chosen.items() if name in LANDSCAPES]
    if maps and not one_state:
        _draw_landscapes(
            figure, {name: chosen[name] for name in LANDSCAPES if name in chosen}, fields, energy_unit
        )
    elif maps:
        lower, upper = zip(*(axes.get_ylim() for axes in maps), strict=True)
        for axes in maps:
            axes.set_ylim(min(lower), max(upper))
            axes.set_ylabel(energy_label(energy_unit))
    if len(states) > 2:
        figure.suptitle(f"On the plane of ${name_label(states[0])}$ and ${name_label(states[1])}$")
    return figure


def _known(fields: ComponentFields, *, one_state: bool) -> list[str]:
    """Which panels there are."""
    gradient = fields.quasipotential if one_state else fields.minus_gradient
    circulates = False
    if fields.circulatory is not None and not _is_missing(fields.circulatory):
        # What is left of g in a gradient system is rounding.
        slope = fields.minus_gradient
        size = 0.0 if slope is None or _is_missing(slope) else float(np.nanmax(np.abs(slope)))
        circulates = bool(np.nanmax(np.abs(fields.circulatory)) > ROUNDING * size)
    parts = {
        "trajectories": bool(len(fields.trajectories)),
        "gradient": not _is_missing(gradient),
        "circulatory": circulates,
        "exact": not _is_missing(fields.exact_quasipotential),
        "identified": not _is_missing(fields.quasipotential),
    }
    return [name for name, there in parts.items() if there]


def _title(name: str, fields: ComponentFields, *, one_state: bool) -> str:
    shown = min(len(fields.trajectories), TRAJECTORIES_SHOWN)
    return {
        "trajectories": counted(shown, "recording") + ("" if one_state else ", • to ×"),
        "gradient": "$V$, identified" if one_state else r"$-\nabla V$, identified",
        "circulatory": "$g$, identified",
        "exact": "$U$, exact",
        "identified": "$U$, identified",
    }[name]


def _draw_planes(
    chosen: Mapping[str, Axes], fields: ComponentFields, label: Sequence[str], domain: np.ndarray
) -> None:
    for name, axes in chosen.items():
        if name == "trajectories":
            _draw_trajectories(axes, fields.trajectories)
        elif name == "gradient":
            _draw_streams(axes, fields, np.asarray(fields.minus_gradient), BLUE)
        elif name == "circulatory":
            _draw_streams(axes, fields, np.asarray(fields.circulatory), VERMILLION)
        axes.set_xlim(*domain[0])
        axes.set_ylim(*domain[1])
        axes.set_xlabel(label[0])
        axes.set_ylabel(label[1])


def _is_missing(values: np.ndarray | None) -> bool:
    return values is None or not np.isfinite(values).any()


def _draw_trajectories(axes: Axes, trajectories: Sequence[np.ndarray]) -> None:
    for path in trajectories[:TRAJECTORIES_SHOWN]:
        colour = axes.plot(path[:, 0], path[:, 1])[0].get_color()
        axes.plot(path[0, 0], path[0, 1], marker="o", markersize=3, color=colour)
        axes.plot(path[-1, 0], path[-1, 1], marker="x", markersize=4, color=colour)


def _draw_streams(axes: Axes, fields: ComponentFields, field: np.ndarray, colour: str) -> None:
    speed = np.hypot(field[0], field[1])
    fastest = float(np.nanmax(speed))
    fastest = fastest or 1.0
    # The square root keeps the slow flow between the wells visible beside the fast flow at the corners.
    width = 0.25 + 1.75 * np.sqrt(speed / fastest)
    streams = axes.streamplot(
        fields.x1,
        fields.x2,
        field[0],
        field[1],
        color=colour,
        linewidth=np.nan_to_num(width),
        density=0.9,
        arrowsize=0.6,
    )
    # Thousands of short pieces of every width would make a megabyte of vector graphics.
    streams.lines.set_rasterized(True)


def _draw_landscapes(
    figure: Figure, panels: Mapping[str, Axes], fields: ComponentFields, energy_unit: str
) -> None:
    values = {"exact": fields.exact_quasipotential, "identified": fields.quasipotential}
    maps = [(axes, np.asarray(values[name], dtype=float)) for name, axes in panels.items()]
    # The exact landscape sets the scale where there is one: a wrong formula may fall to −∞ at the rim.
    # Levels lie closer at the bottom, where the wells and the saddle between them are.
    lowest, highest = float(np.nanmin(maps[0][1])), float(np.nanmax(maps[0][1]))
    levels = lowest + (highest - lowest or abs(lowest) or 1.0) * np.linspace(0, 1, LEVELS) ** 2
    below = any(np.nanmin(landscape) < levels[0] for _, landscape in maps)
    above = any(np.nanmax(landscape) > levels[-1] for _, landscape in maps)
    extend: Extend = "both" if below and above else "min" if below else "max" if above else "neither"
    norm = BoundaryNorm(levels, 256, extend=extend)
    for axes, landscape in maps:
        drawn = axes.contourf(
            fields.x1, fields.x2, landscape, cmap=COLOUR_MAP, levels=levels, norm=norm, extend=extend
        )
        axes.contour(fields.x1, fields.x2, landscape, levels=levels, colors="white", linewidths=0.3)
    bar = figure.colorbar(
        drawn, ax=[axes for axes, _ in maps], label=energy_label(energy_unit), location="bottom", aspect=30
    )
    bar.set_ticks(levels[::3].tolist())
    bar.minorticks_off()
    bar.ax.set_xticklabels([f"{level:.2g}" for level in levels[::3]])


def _draw_curves(
    chosen: Mapping[str, Axes], fields: ComponentFields, label: Sequence[str], domain: np.ndarray
) -> None:
    potential = None if fields.quasipotential is None else np.asarray(fields.quasipotential) / 2
    curves = {
        "gradient": (potential, "$V$"),
        "circulatory": (fields.circulatory, "$g$"),
        "exact": (fields.exact_quasipotential, "$U$"),
        "identified": (fields.quasipotential, "$U$"),
    }
    for name, axes in chosen.items():
        if name == "trajectories":
            for path in fields.trajectories[:TRAJECTORIES_SHOWN]:
                axes.plot(np.asarray(path)[:, 0])
            axes.set_xlabel("number of the sample")
            axes.set_ylabel(label[0])
            continue
        curve, symbol = curves[name]
        axes.plot(fields.x1, np.asarray(curve).reshape(-1)[: len(fields.x1)], color=BLUE)
        axes.set_xlim(*domain[0])
        axes.set_xlabel(label[0])
        axes.set_ylabel(symbol)
