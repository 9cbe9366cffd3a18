"""Projection, for drawing: a decomposition on the plane of two states, or a landscape of two or of one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from siq.landscape.global_quasipotential import GlobalQuasipotential
from siq.potential.symbolic import SymbolicDecomposition
from siq.report.plots import ComponentFields


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
    siq.report.plots.ComponentFields
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


def project_landscape(
    potential: GlobalQuasipotential,
    *,
    domain: np.ndarray,
    trajectories: Sequence[np.ndarray],
    resolution: int = 161,
) -> ComponentFields:
    """Fields of the formulas of all wells, for two states or one; NaN where none is believed.

    Parameters
    ----------
    potential
        U over all wells. At each point the formula counts that gives U there.
    domain
        Shape ``(d, 2)``: the limits of the states.
    trajectories
        States along some trajectories, each of shape ``(k, d)``.
    resolution
        Points along each axis.
    """
    axes = [np.linspace(low, high, resolution) for low, high in domain]
    x = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, len(axes))
    x1, x2 = (*axes, np.zeros(0))[:2]
    by_well = potential.by_well(x)
    values = np.where(np.isfinite(by_well), by_well, np.inf)
    least, which = values.min(axis=0), values.argmin(axis=0)
    gradient, circulatory = np.full(x.shape, np.nan), np.full(x.shape, np.nan)
    for index, one in enumerate(potential.wells):
        mine = np.isfinite(least) & (which == index)
        gradient[mine] = one.gradients(x[mine])
        circulatory[mine] = one.dynamics.drift(x[mine]) + one.dynamics.diffusion.push(x[mine], gradient[mine])
    shape = (resolution if len(axes) > 1 else 1, resolution)
    return ComponentFields(
        x1=x1,
        x2=x2,
        minus_gradient=-gradient.T.reshape(len(axes), *shape),
        circulatory=circulatory.T.reshape(len(axes), *shape),
        quasipotential=np.where(np.isfinite(least), least, np.nan).reshape(shape),
        trajectories=list(trajectories),
    )
