"""What the trajectories, the two components of the field and the landscape look like (paper, Fig. 1a)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm
from matplotlib.contour import QuadContourSet
from matplotlib.figure import Figure, SubFigure

from siq.report.plots.style import (
    BLUE,
    PAGE_WIDTH,
    VERMILLION,
    drawn_in_style,
    name_label,
    say,
    unit_label,
)

TRAJECTORIES_SHOWN = 5
LEVELS = 14
COLOUR_MAP = "viridis"
NO_EXACT = "the exact quasipotential\nis not known"
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
    fields: ComponentFields, *, states: Sequence[str], units: Sequence[str], domain: np.ndarray
) -> Figure:
    """Draw trajectories, -∇V, g, the exact U and the identified U, projected on the first two states.

    Parameters
    ----------
    fields
        What to draw.
    states, units
        Names and units of the states.
    domain
        Shape ``(d, 2)``: the limits of the axes.

    Returns
    -------
    matplotlib.figure.Figure
        Five panels. The width of stream lines grows with speed; both contour plots share one colour scale.
        With one state, V and g are drawn as curves.
    """
    labels = [f"${name_label(name)}$ {unit_label(unit)}" for name, unit in zip(states, units, strict=True)]
    if len(states) == 1:
        return _plot_curves(fields, labels[0], np.asarray(domain))
    figure = Figure(figsize=(PAGE_WIDTH, 4.7))
    top, bottom = figure.subfigures(2, 1, squeeze=False)[:, 0]
    all_axes = [*top.subplots(1, 3), *bottom.subplots(1, 2)]
    _draw_trajectories(all_axes[0], fields.trajectories)
    _draw_streams(all_axes[1], fields, fields.minus_gradient, BLUE)
    _draw_streams(all_axes[2], fields, fields.circulatory, VERMILLION)
    _draw_contours(bottom, all_axes[3:], fields)
    titles = _titles(len(fields.trajectories))
    if len(fields.trajectories):
        titles[0] += ", • to ×"
    for axes, title in zip(all_axes, titles, strict=True):
        axes.set_title(title, loc="left")
        if axes.axison:
            axes.set_xlim(*domain[0])
            axes.set_ylim(*domain[1])
            axes.set_xlabel(labels[0])
            axes.set_ylabel(labels[1])
    if len(states) > 2:
        plane = f"${name_label(states[0])}$, ${name_label(states[1])}$"
        figure.suptitle(f"Projection on the plane of {plane}", fontsize=8)
    return figure


def _titles(trajectories: int) -> list[str]:
    shown = f"{min(trajectories, TRAJECTORIES_SHOWN)} " if trajectories else ""
    noun = "trajectory" if trajectories == 1 else "trajectories"
    return [
        f"(a) {shown}{noun}",
        r"(b) $-\nabla V$, identified",
        r"(c) $g$, identified",
        r"(d) $U$, exact",
        r"(e) $U$, identified",
    ]


def _is_missing(values: np.ndarray | None) -> bool:
    return values is None or not np.isfinite(values).any()


def _draw_trajectories(axes: Axes, trajectories: Sequence[np.ndarray]) -> None:
    if not len(trajectories):
        say(axes, "no trajectories")
    for path in trajectories[:TRAJECTORIES_SHOWN]:
        colour = axes.plot(path[:, 0], path[:, 1])[0].get_color()
        axes.plot(path[0, 0], path[0, 1], marker="o", markersize=3, color=colour)
        axes.plot(path[-1, 0], path[-1, 1], marker="x", markersize=4, color=colour)


def _draw_streams(axes: Axes, fields: ComponentFields, field: np.ndarray | None, colour: str) -> None:
    if field is None or _is_missing(field):
        say(axes, "not identified")
        return
    speed = np.hypot(field[0], field[1])
    fastest = float(np.nanmax(speed))
    if fastest == 0:
        say(axes, "zero everywhere")
        return
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


def _draw_contours(figure: SubFigure, panels: Sequence[Axes], fields: ComponentFields) -> None:
    landscapes = [fields.exact_quasipotential, fields.quasipotential]
    known = [landscape for landscape in landscapes if landscape is not None and not _is_missing(landscape)]
    drawn: QuadContourSet | None = None
    if known:
        # The exact landscape sets the scale where there is one: a wrong formula may fall to −∞ at the rim.
        # Levels lie closer at the bottom, where the wells and the saddle between them are.
        lowest, highest = float(np.nanmin(known[0])), float(np.nanmax(known[0]))
        levels = lowest + (highest - lowest or abs(lowest) or 1.0) * np.linspace(0, 1, LEVELS) ** 2
        below = any(np.nanmin(landscape) < levels[0] for landscape in known)
        above = any(np.nanmax(landscape) > levels[-1] for landscape in known)
        extend: Extend = "both" if below and above else "min" if below else "max" if above else "neither"
        options = {"levels": levels, "norm": BoundaryNorm(levels, 256, extend=extend), "extend": extend}
    absent = (NO_EXACT, "not identified")
    for axes, landscape, sentence in zip(panels, landscapes, absent, strict=True):
        if landscape is None or _is_missing(landscape):
            say(axes, sentence)
            continue
        drawn = axes.contourf(fields.x1, fields.x2, landscape, cmap=COLOUR_MAP, **options)
        axes.contour(fields.x1, fields.x2, landscape, levels=levels, colors="white", linewidths=0.3)
    if drawn is not None:
        bar = figure.colorbar(drawn, ax=list(panels), label="$U$ (in the unit of ε)", pad=0.02, aspect=25)
        bar.set_ticks(levels[::2].tolist())
        bar.minorticks_off()
        bar.ax.set_yticklabels([f"{level:.2g}" for level in levels[::2]])


def _plot_curves(fields: ComponentFields, label: str, domain: np.ndarray) -> Figure:
    figure = Figure(figsize=(PAGE_WIDTH, 4.0))
    panels = figure.subplots(2, 3).ravel()
    panels[5].remove()
    titles = _titles(len(fields.trajectories))
    titles[1:3] = [r"(b) $V$, identified", r"(c) $g$, identified"]
    potential = None if fields.quasipotential is None else np.asarray(fields.quasipotential) / 2
    curves = [
        (potential, "$V$ (in the unit of ε)", "not identified"),
        (fields.circulatory, "$g$ (state per time)", "not identified"),
        (fields.exact_quasipotential, "$U$ (in the unit of ε)", NO_EXACT),
        (fields.quasipotential, "$U$ (in the unit of ε)", "not identified"),
    ]
    for path in fields.trajectories[:TRAJECTORIES_SHOWN]:
        panels[0].plot(np.asarray(path)[:, 0])
    panels[0].set_xlabel("number of the sample")
    panels[0].set_ylabel(label)
    if not len(fields.trajectories):
        say(panels[0], "no trajectories")
    for axes, (curve, unit, sentence) in zip(panels[1:5], curves, strict=True):
        if curve is None or _is_missing(curve):
            say(axes, sentence)
            continue
        axes.plot(fields.x1, np.asarray(curve).reshape(-1)[: len(fields.x1)], color=BLUE)
        axes.set_xlim(*domain[0])
        axes.set_xlabel(label)
        axes.set_ylabel(unit)
    if panels[3].axison and panels[4].axison:
        lower, upper = zip(panels[3].get_ylim(), panels[4].get_ylim(), strict=True)
        for axes in panels[3:5]:
            axes.set_ylim(min(lower), max(upper))
    for axes, title in zip(panels[:5], titles, strict=True):
        axes.set_title(title, loc="left")
    return figure
