"""V of a system with two states on a mesh: the ordered line integral method with the midpoint rule.

The quasipotential U = 2V of a state is the least geometric action of a curve that leads there from the
attractor,

    U(y) = inf ∫ (|f| |φ'| - f·φ') ds,

lengths and the product being those of ``D⁻¹``, which may depend on the state. The mesh is worked through as
by Dijkstra's algorithm, from the attractor upwards. What is known so far ends in a front. A node next to it
takes the least action over straight segments from the front within a reach of some mesh widths, from a node
or from between two neighbours,

    U(y) = min over λ of (1 - λ) U(x₀) + λ U(x₁) + |f_m| |y - x_λ| - f_m·(y - x_λ),

f_m being f in the middle of the segment, where D is taken, too. Of all such nodes the one with the lowest
value is known for good, and joins the front (D. Dahiya, M. Cameron, *Ordered line integral methods for
computing the quasi-potential*, J. Sci. Comput. 75, 2018). Where f turns fast, segments lead far along the
front, and the reach has to be large. A reach larger than that does harm: the longest segments have the
largest errors, and the minimum picks those that are too low.

Two differences from the published method, which is there as an option: along the front U is interpolated with
its second difference and not linearly, which raises the order from one to two; and a node tries all pairs of
neighbours within its reach, diagonal ones included, not only those at its best single node.

Nothing is shared with the characteristics, the series and the formulas of this library, neither equations nor
code; so that agreement with them means something. No derivative of f is needed, and V may have kinks.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from scipy.spatial import cKDTree

from siq.dynamics.diffusion import Diffusion
from siq.reference.mesh_march import FRONT, STOPS, UNKNOWN, Heap, Mesh, march
from siq.reference.mesh_start import (
    START,
    check_arguments,
    check_room,
    check_start,
    drift_values,
    metric_roots,
    square,
)
from siq.reference.mesh_values import MeshQuasipotential

STRAIGHT_REACH = 3.0  # mesh widths that suffice where f does not turn
FARTHEST = 60  # mesh widths, beyond which the reach is not set unasked
AT_ONCE = 1 << 18  # points at which f is evaluated in one call


def mesh_quasipotential(
    drift: Callable[[np.ndarray], np.ndarray],
    attractor: np.ndarray,
    *,
    hessian: np.ndarray,
    box: np.ndarray,
    shape: tuple[int, int],
    diffusion: Diffusion,
    reach: int | None = None,
    level: float | None = None,
    stop_at_boundary: bool = True,
    as_published: bool = False,
) -> MeshQuasipotential:
    """V with respect to an attractor, on a mesh.

    Parameters
    ----------
    drift
        f: points as rows, ``(n, 2)`` to ``(n, 2)``. It is evaluated at the nodes and half-way between them.
    attractor
        A, shape ``(2,)``, a stable equilibrium inside the box; it need not be a node.
    hessian
        M, shape ``(2, 2)``: the Hessian of V (not of U) at A, such as `siq.dynamics.equilibria.hessian_at`.
        Within an ellipse of a few mesh widths V is ``½ (x - A)·M (x - A)``.
    box
        Shape ``(2, 2)``: the ends of the mesh, a row for each state, in the states' units.
    shape
        Nodes along each state, ends included.
    diffusion
        D; where it depends on the state, positive definite in the whole box.
    reach
        Longest segment, in mesh widths. By default ``3 + r/2``, r being the ratio ``|f + 2D∇V| |∇V| /
        ((f + 2D∇V)·∇V)`` in mesh widths at its largest near A, 1 if f does not turn there: the least that
        sufficed in systems with known V. Where f turns faster elsewhere, give more. V falls as the reach
        grows: it is too high where the reach is too short, and too low, by its square, where it is too long.
    level
        V (not U) above which nothing is asked for.
    stop_at_boundary
        End when a node of the mesh's boundary is next, the usual rule. Beyond, values may be too high
        without notice, since the best curve may leave the box and come back. Switch it off to pass over a
        part of the boundary behind a saddle, where f leads out at no cost.
    as_published
        Linear interpolation along the front; pairs are tried at the best single node only, without
        diagonal ones; and by default the authors' reach, ``10 + 4 (log₂ N - 7)``.

    Returns
    -------
    MeshQuasipotential
        V, not U, in the unit of f·x/D.

    Raises
    ------
    ValueError
        When an argument has the wrong shape, D or M is not positive definite, A is not an equilibrium
        inside the box, M is not the Hessian of V there, or the mesh is too coarse for the start.
    NumericalFailure
        When f is not finite, or D not positive definite, everywhere in the box.

    Notes
    -----
    The error is of second order in the mesh width as long as the reach suffices and V is smooth; it grows
    with r, nearly as r². Beyond a saddle, where f leads down to another attractor, the true V is level;
    there the result is only as good as segments follow f.

    All work is done in mesh widths, and with powers of two as units: other units of the states, or of
    time, change rounding at most, and with it which of two equal nodes comes first. The first call of
    all compiles, which takes seconds; the code is kept for later sessions.
    """
    attractor, hessian, box = (np.asarray(one, dtype=float) for one in (attractor, hessian, box))
    check_arguments(attractor, hessian, box, shape, diffusion, reach, level)
    axes = tuple(np.linspace(low, high, count) for (low, high), count in zip(box, shape, strict=True))
    widths = (box[:, 1] - box[:, 0]) / (np.array(shape) - 1)
    form = hessian * np.outer(widths, widths)  # M, of displacements in mesh widths
    rim = START**2 * np.linalg.eigvalsh(form)[-1] / 2
    check_room(attractor, form, rim, box, widths, level)
    turning = check_start(drift, attractor, hessian, rim, widths, diffusion)
    if reach is None:
        published = max(round(10 + 4 * (math.log2(max(shape)) - 7)), 2)
        reach = published if as_published else min(math.ceil(STRAIGHT_REACH + turning / 2), FARTHEST)

    x = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1) - attractor
    start = np.einsum("abi,ij,abj->ab", x, hessian, x) / 2
    begin = np.where(start <= rim, start, np.inf)
    return _marched(
        drift,
        attractor,
        begin,
        axes,
        box,
        diffusion,
        reach,
        level,
        stop_at_boundary,
        refined=not as_published,
    )


def mesh_quasipotential_of_cycle(
    drift: Callable[[np.ndarray], np.ndarray],
    points: np.ndarray,
    *,
    hessians: np.ndarray,
    box: np.ndarray,
    shape: tuple[int, int],
    diffusion: Diffusion,
    reach: int,
    stop_at_boundary: bool = True,
) -> MeshQuasipotential:
    """V with respect to a stable limit cycle, on a mesh.

    Parameters
    ----------
    drift, box, shape, diffusion, reach, stop_at_boundary
        As for `mesh_quasipotential`.
    points
        Shape ``(n, 2)``: states along the cycle, closer to each other than mesh widths.
    hessians
        Shape ``(n, 2, 2)``: the Hessian of V (not of U) there. Within a few mesh widths of the cycle V is
        ``½ (x - x_k)·H_k (x - x_k)``, x_k being the next of the points.

    Raises
    ------
    NumericalFailure
        When f is not finite, or D not positive definite, everywhere in the box.
    """
    axes = tuple(np.linspace(low, high, count) for (low, high), count in zip(box, shape, strict=True))
    widths = (box[:, 1] - box[:, 0]) / (np.array(shape) - 1)
    x = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    away, which = cKDTree(points / widths).query(x / widths)
    offset = x - points[which]
    start = np.einsum("ni,nij,nj->n", offset, hessians[which], offset) / 2
    begin = np.where(away <= START, start, np.inf).reshape(shape)
    return _marched(
        drift, points[0], begin, axes, box, diffusion, reach, None, stop_at_boundary, refined=True
    )


def _marched(
    drift: Callable[[np.ndarray], np.ndarray],
    attractor: np.ndarray,
    begin: np.ndarray,
    axes: tuple[np.ndarray, ...],
    box: np.ndarray,
    diffusion: Diffusion,
    reach: int,
    level: float | None,
    stop_at_boundary: bool,
    *,
    refined: bool,
) -> MeshQuasipotential:
    """V on the mesh from where it is known, `begin` being infinite elsewhere."""
    shape = begin.shape
    widths = (box[:, 1] - box[:, 0]) / (np.array(shape) - 1)
    finer = tuple(np.linspace(low, high, 2 * n - 1) for (low, high), n in zip(box, shape, strict=True))
    if diffusion.constant:
        roots = metric_roots(diffusion, attractor[None])[None]
    else:
        roots = _by_rows(lambda x: metric_roots(diffusion, x), finer)
    roots = roots * widths[[0, 0, 1]]
    small = math.frexp(np.abs(roots).max())[1]
    roots = np.ldexp(roots, -small)
    flow = _by_rows(lambda x: drift_values(drift, x), finer)
    flow = (square(roots) @ (flow / widths)[..., None])[..., 0]
    fast = math.frexp(np.abs(flow).max())[1]
    flow = np.ldexp(flow, -fast)
    unit = math.ldexp(0.5, 2 * small + fast)  # V of one unit of U within the mesh
    known = np.isfinite(begin)
    values = begin / unit
    mesh = Mesh(
        values=values,
        status=np.where(known, FRONT, UNKNOWN).astype(np.int8),
        lowest=np.full(shape, np.inf),
        source=np.full(shape, -1),
        drift=flow,
        roots=roots,
        varies=int(not diffusion.constant),
        reach=reach,
        refined=refined,
    )
    heap = Heap(np.empty(values.size, dtype=int), np.empty(values.size, dtype=int), np.zeros(1, dtype=int))
    stop, highest = march(mesh, heap, math.inf if level is None else level / unit, stop_at_boundary)
    known = np.where(mesh.status >= FRONT, unit * values, np.nan)
    return MeshQuasipotential((axes[0], axes[1]), known, attractor, unit * highest, STOPS[stop], reach)


def _by_rows(function: Callable[[np.ndarray], np.ndarray], axes: Sequence[np.ndarray]) -> np.ndarray:
    """A function of points ``(n, 2)`` on a rectangular mesh, some rows of it at a time."""
    first, second = axes
    rows = max(AT_ONCE // len(second), 1)
    parts = []
    for row in range(0, len(first), rows):
        points = np.stack(np.meshgrid(first[row : row + rows], second, indexing="ij"), axis=-1)
        parts.append(function(points.reshape(-1, 2)).reshape(*points.shape[:2], -1))
    return np.concatenate(parts)
