"""Which states were recorded, and which of them the regression sees (paper, Figs. fig2a, fig1_noisy a)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from siq.report.plots.one_state import plot_dataset_curves
from siq.report.plots.style import (
    BLACK,
    BLUE,
    GREY,
    PAGE_WIDTH,
    VERMILLION,
    drawn_in_style,
    name_label,
    say,
    unit_label,
)

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
        Three panels on the first two states. The closed curve is the level of V_θ. Of a single state
        trajectories against the number of the sample, and histograms.
    """
    if data.points.shape[1] < 2:
        return plot_dataset_curves(data, state=states[0], unit=units[0])
    figure = Figure(figsize=(PAGE_WIDTH, 2.6))
    left, middle, right = figure.subplots(1, 3, sharex=True, sharey=True)
    for path in data.trajectories:
        left.plot(path[:, 0], path[:, 1], linewidth=0.6)
        left.plot(path[0, 0], path[0, 1], marker="o", markersize=3, color=BLACK)
    for path in data.without_noise:
        left.plot(path[:, 0], path[:, 1], color=BLACK, linewidth=0.9, linestyle="--")
    dashed = "; dashed: no noise" if len(data.without_noise) else ""
    left.set_title(f"(a) {len(data.trajectories)} trajectories{dashed}", loc="left")
    count = len(data.points)
    kept = np.arange(0, count, max(count // MOST_POINTS, 1))
    _scatter(middle, data.points[kept], GREY)
    _draw_level(middle, data)
    middle.set_title(f"(b) recorded: {count} pairs", loc="left")
    if data.below is None:
        say(right, "no networks say\nwhat the regression sees")
    else:
        _scatter(right, data.points[kept][data.below[kept]], BLUE)
        _draw_level(right, data)
    seen = "" if data.below is None else f": {100 * data.below.mean():.3g} %"
    right.set_title(f"(c) seen by the regression{seen}", loc="left")
    labels = [f"${name_label(name)}$ {unit_label(unit)}" for name, unit in zip(states, units, strict=True)]
    for axes in (left, middle, right):
        axes.set_xlabel(labels[0])
    left.set_ylabel(labels[1])
    return figure


def _scatter(axes: Axes, points: np.ndarray, colour: str) -> None:
    # As an image: so many points would make megabytes of vector graphics.
    axes.plot(*points.T, linestyle="none", marker=",", color=colour, rasterized=True)


def _draw_level(axes: Axes, data: Dataset) -> None:
    if data.axes is not None and data.potential is not None and np.isfinite(data.threshold):
        axes.contour(*data.axes, data.potential, levels=[data.threshold], colors=VERMILLION, linewidths=1.0)
