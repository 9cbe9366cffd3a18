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
    axis_label,
    counted,
    drawn_in_style,
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
        Two panels on the first two states, and a third where something says what the regression sees. The
        closed curve is the level of V_θ. Of a single state trajectories against the number of the sample, and
        histograms.
    """
    if data.points.shape[1] < 2:
        return plot_dataset_curves(data, state=states[0], unit=units[0])
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
