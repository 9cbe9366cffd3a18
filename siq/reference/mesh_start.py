"""Does a mesh leave room for the start about its attractor, and is V its quadratic form there?

A mesh is worked through from an ellipse about the attractor, within which V is ``½ (x - A)·M (x - A)``. What
is refused here would lead to a wrong V and not to a fault.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from siq.dynamics.diffusion import Diffusion
from siq.errors import NumericalFailure

FEWEST = 16  # nodes along a state: fewer leave no room around the start
START = 2.5  # mesh widths: shortest half-axis of the ellipse within which V is its quadratic form
SLACK = 0.05  # by which f at the attractor, and M, may be off
SMALL = 1e-3  # of the starting ellipse: where f counts as linear
DIRECTIONS = 360  # numerical: of the starting ellipse, a degree apart


def check_arguments(
    attractor: np.ndarray,
    hessian: np.ndarray,
    box: np.ndarray,
    shape: tuple[int, int],
    diffusion: Diffusion,
    reach: int | None,
    level: float | None,
) -> None:
    """Refuse arguments of the wrong shape or sign."""
    for name, array, wanted in (
        ("attractor", attractor, (2,)),
        ("hessian", hessian, (2, 2)),
        ("box", box, (2, 2)),
    ):
        if array.shape != wanted or not np.isfinite(array).all():
            raise ValueError(f"the {name} must be finite numbers of shape {wanted}: the mesh has two states")
    if diffusion.dimension != 2:  # asked before D is evaluated, which takes a state of its own dimension
        raise ValueError(f"the diffusion is one of {diffusion.dimension} states: the mesh has two")
    if len(shape) != 2 or min(shape) < FEWEST:
        raise ValueError(f"a mesh of {shape} nodes is too coarse; give at least {FEWEST} along each state")
    scale = np.sqrt(np.abs(np.diag(hessian)))
    ratio = hessian / np.maximum(np.outer(scale, scale), np.finfo(float).tiny)
    if not np.allclose(ratio, ratio.T) or np.diag(hessian).min() <= 0 or np.linalg.eigvalsh(ratio)[0] <= 0:
        raise ValueError(f"the hessian {hessian.tolist()} is not symmetric and positive definite")
    noise = diffusion.frozen(attractor)
    if not noise.regular:
        raise ValueError(f"the diffusion {noise.matrix.tolist()} at the attractor is not positive definite")
    if np.any(box[:, 0] >= box[:, 1]):
        raise ValueError(f"the box {box.tolist()} needs a lower and an upper end for each state")
    if np.any((attractor <= box[:, 0]) | (attractor >= box[:, 1])):
        raise ValueError(f"the attractor {attractor.tolist()} is not inside the box {box.tolist()}")
    if reach is not None and reach < 2:
        raise ValueError(f"a reach of {reach} mesh widths is too short; give at least 2")
    if level is not None and not level > 0:
        raise ValueError(f"the level {level} must be positive: V is zero at the attractor")


def check_room(
    attractor: np.ndarray,
    form: np.ndarray,
    rim: float,
    box: np.ndarray,
    widths: np.ndarray,
    level: float | None,
) -> None:
    """Refuse a mesh whose starting ellipse does not fit into the box and below the level."""
    half = np.sqrt(2 * rim * np.diag(np.linalg.inv(form)))
    room = np.minimum(attractor - box[:, 0], box[:, 1] - attractor) / widths
    if np.any(half + 1 >= room):
        raise ValueError(
            f"the start around the attractor takes {np.ceil(half).tolist()} mesh widths, to the box's ends "
            f"there are {np.floor(room).tolist()}; take more nodes or a larger box"
        )
    if level is not None and rim >= level:
        raise ValueError(
            f"V is {rim:.3g} at the rim of the start, above the level {level:.3g}; take more nodes"
        )


def check_start(
    drift: Callable[[np.ndarray], np.ndarray],
    attractor: np.ndarray,
    hessian: np.ndarray,
    rim: float,
    widths: np.ndarray,
    diffusion: Diffusion,
) -> float:
    """Refuse a state that is no equilibrium, or an M that is not its own; r, how fast f turns there."""
    angles = np.linspace(0, 2 * np.pi, DIRECTIONS, endpoint=False)
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    # In mesh widths: states may differ in size by many orders.
    small = SMALL * np.sqrt(2 * rim) * circle
    offset = np.linalg.solve(np.linalg.cholesky(hessian * np.outer(widths, widths)).T, small.T).T * widths
    force = (drift_values(drift, attractor + offset) - drift_values(drift, attractor - offset)) / 2
    momentum = offset @ hessian
    push = diffusion.push(attractor + offset, momentum)
    # Of H = p·(f + Dp), which vanishes.
    energy = np.sum(momentum * (force + push), axis=1)
    root = square(metric_roots(diffusion, attractor[None]))[0]
    size = np.linalg.norm(momentum @ np.linalg.inv(root), axis=1) * np.linalg.norm(force @ root.T, axis=1)
    resting = np.linalg.norm(root @ drift_values(drift, attractor[None])[0]) * SMALL
    if resting > SLACK * np.linalg.norm(force @ root.T, axis=1).max():
        raise ValueError(f"the attractor {attractor.tolist()} is no equilibrium: f does not vanish there")
    if np.abs(energy).max() > SLACK * size.max():
        raise ValueError(
            f"{hessian.tolist()} is not the Hessian of V at the attractor;"
            " see siq.dynamics.equilibria.hessian_at, and mind that U = 2V has twice that"
        )
    velocity, slope = (force + 2 * push) / widths, momentum * widths
    lengths = np.linalg.norm(velocity, axis=1) * np.linalg.norm(slope, axis=1)
    return float((lengths / np.sum(velocity * slope, axis=1)).max())


def metric_roots(diffusion: Diffusion, x: np.ndarray) -> np.ndarray:
    """R with ``RᵀR = D⁻¹`` at points ``(n, 2)``, exact in powers of two: R₁₁, R₂₁, R₂₂, shape ``(n, 3)``.

    Raises
    ------
    NumericalFailure
        Where D is not positive definite.
    """
    root = diffusion.root_at(x)
    a, b, c = root[:, 0, 0], root[:, 1, 0], root[:, 1, 1]
    return np.stack([1 / a, -b / (a * c), 1 / c], axis=1)


def square(roots: np.ndarray) -> np.ndarray:
    """Lower triangular matrices of their three entries: ``(..., 3)`` to ``(..., 2, 2)``."""
    matrices = np.zeros((*roots.shape[:-1], 2, 2))
    matrices[..., 0, 0], matrices[..., 1, 0], matrices[..., 1, 1] = np.moveaxis(roots, -1, 0)
    return matrices


def drift_values(drift: Callable[[np.ndarray], np.ndarray], x: np.ndarray) -> np.ndarray:
    """F of points ``(n, 2)``, of the same shape and finite."""
    values = np.asarray(drift(x), dtype=float)
    if values.shape != x.shape:
        raise ValueError(f"f of points of shape {x.shape} has the shape {values.shape}; it must be the same")
    if not np.isfinite(values).all():
        raise NumericalFailure("f is not finite everywhere in the box; take a smaller one")
    return values
