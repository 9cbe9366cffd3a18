"""Projection: a decomposition on a plane of its first two states, for drawing."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from siq.plots import ComponentFields
from siq.symbolic import SymbolicDecomposition


def project(
    identified: SymbolicDecomposition,
    *,
    exact: SymbolicDecomposition | None,
    domain: np.ndarray,
    at: np.ndarray,
    trajectories: Sequence[np.ndarray],
    resolution: int = 81,
) -> ComponentFields:
    """Fields of a decomposition on the plane of the first two states.

    Parameters
    ----------
    identified, exact
        The formulas, and the exact ones where known.
    domain
        Shape ``(d, 2)``: the plane's limits are the first two rows.
    at
        Shape ``(d,)``: where the plane cuts the other states.
    trajectories
        States along some trajectories, each of shape ``(k, d)``.
    resolution
        Points along each axis.

    Returns
    -------
    siq.plots.ComponentFields
        With the exact U missing where it is not known.
    """
    dimension = len(domain)
    shown = min(dimension, 2)
    axes = [np.linspace(domain[axis, 0], domain[axis, 1], resolution) for axis in range(shown)]
    x1 = axes[0]
    x2 = axes[1] if shown == 2 else np.array([at[0]])
    mesh = np.meshgrid(x1, x2)
    points = np.broadcast_to(np.asarray(at)[:, None, None], (dimension, len(x2), len(x1))).copy()
    for axis in range(shown):
        points[axis] = mesh[axis]
    values = identified.evaluate(points)
    gradient = identified.evaluate_gradient(points)
    return ComponentFields(
        x1=x1,
        x2=x2,
        minus_gradient=-gradient[:shown],
        circulatory=values[1 : 1 + shown],
        quasipotential=2 * values[0],
        exact_quasipotential=None if exact is None else 2 * exact.evaluate(points)[0],
        trajectories=[path[:, :shown] for path in trajectories],
    )
