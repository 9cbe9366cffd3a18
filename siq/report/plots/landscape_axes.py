"""U on a person's own axes: a curve of one state, contours of two, a plane of more."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from siq.landscape.landscape import Landscape
from siq.report.plots.landscape import DOWNHILL, MARKS, UPHILL

POINTS = 161  # along each state
MARGIN = 0.05  # of what is known: shown around it
LEVELS = 14


def draw_landscape(landscape: Landscape, axes: Axes | None = None) -> Axes:
    """Draw U with its equilibria and the paths of least action.

    Parameters
    ----------
    landscape
        The landscape.
    axes
        Where; by default new axes of pyplot.

    Returns
    -------
    matplotlib.axes.Axes
        Of one state U as a curve; of two contours of U, left white where U is not known; of more the plane of
        the first two states through the lowest saddle, without paths.
    """
    if axes is None:
        from matplotlib import pyplot  # so that a notebook shows it, and `pyplot.show`

        axes = pyplot.subplots(layout="constrained")[1]
    names = [
        name if unit == "1" else f"{name} [{unit}]"
        for name, unit in zip(landscape.dynamics.states, landscape.dynamics.units, strict=True)
    ]
    box = _shown(landscape)
    axes.set_xlabel(names[0])
    if len(names) == 1:
        _draw_curve(axes, landscape, box)
        axes.set_ylabel("U")
        return axes
    axes.set_ylabel(names[1])
    _draw_contours(axes, landscape, box)
    if len(names) > 2:
        rest = zip(landscape.dynamics.states[2:], _lowest_saddle(landscape)[2:], strict=True)
        axes.set_title(", ".join(f"{name} = {value:.3g}" for name, value in rest))
    return axes


def _shown(landscape: Landscape) -> np.ndarray:
    """Limits of each state, shape ``(d, 2)``: of the points of all wells, and of the equilibria."""
    points = [well.points for well in landscape.wells if well is not None]
    points += [one.position[None] for one in landscape.equilibria]
    together = np.concatenate([*points, np.zeros((0, landscape.dynamics.dimension))])
    if not len(together):
        raise ValueError("the landscape has neither wells nor equilibria: there is nothing to draw")
    low, high = together.min(axis=0), together.max(axis=0)
    margin = MARGIN * np.where(high > low, high - low, 1.0)
    return np.stack([low - margin, high + margin], axis=1)


def _lowest_saddle(landscape: Landscape) -> np.ndarray:
    """Where the barrier is lowest; the deepest attractor where no barrier is known."""
    known = [way for way in landscape.transitions if np.isfinite(way.barrier)]
    if known:
        lowest = min(known, key=lambda way: float(np.nan_to_num(landscape.heights[way.start])) + way.barrier)
        return lowest.saddle.position
    places = landscape.attractors or landscape.equilibria
    return places[int(np.argmin(np.nan_to_num(landscape.heights))) if landscape.attractors else 0].position


def _draw_curve(axes: Axes, landscape: Landscape, box: np.ndarray) -> None:
    x = np.linspace(box[0, 0], box[0, 1], 4 * POINTS)
    axes.plot(x, landscape.quasipotential(x[:, None]))
    for one in landscape.equilibria:
        height = landscape.quasipotential(one.position[None])
        axes.plot(one.position, height, linestyle="none", **MARKS[one.kind])


def _draw_contours(axes: Axes, landscape: Landscape, box: np.ndarray) -> None:
    first, second = (np.linspace(low, high, POINTS) for low, high in box[:2])
    mesh = np.stack(np.meshgrid(first, second, indexing="ij"), axis=-1).reshape(-1, 2)
    points = np.tile(_lowest_saddle(landscape), (len(mesh), 1))
    points[:, :2] = mesh
    values = landscape.quasipotential(points).reshape(POINTS, POINTS)
    if np.isfinite(values).any():
        contours = axes.contourf(first, second, values.T, levels=LEVELS)
        axes.figure.colorbar(contours, ax=axes, label="U")
    if len(box) == 2:
        for way in landscape.transitions:
            if way.path is not None:
                axes.plot(*way.path.uphill.points.T, **UPHILL)
                axes.plot(*way.path.downhill.T, **DOWNHILL)
    for one in landscape.equilibria:
        axes.plot(*one.position[:2], linestyle="none", **MARKS[one.kind])
    axes.set_xlim(box[0, 0], box[0, 1])
    axes.set_ylim(box[1, 0], box[1, 1])
