"""V of a system with two states on a mesh: the ordered line integral method with the midpoint rule.

The quasipotential U = 2V of a state is the least geometric action of a curve that leads there from the
attractor,

    U(y) = inf ∫ (|f| |φ'| - f·φ') ds,

lengths and the product being those of ``D⁻¹``, which may depend on the state. The mesh is worked through as
by Dijkstra's algorithm, from an ellipse about the attractor A upwards, within which V is ``½ (x - A)·M (x -
A)``. What is known so far ends in a front. A node next to it takes the least action over straight segments
from the front within a reach of some mesh widths, from a node or from between two neighbours,

    U(y) = min over λ of (1 - λ) U(x₀) + λ U(x₁) + |f_m| |y - x_λ| - f_m·(y - x_λ),

f_m being f in the middle of the segment, where D is taken, too. Of all such nodes the one with the lowest
value is known for good, and joins the front. Where f turns fast, segments lead far along the front, and the
reach has to be large. A larger one does harm: the longest segments have the largest errors, and the minimum
picks those that are too low.

Two differences from the published method, which is there as an option: along the front U is interpolated with
its second difference and not linearly, which raises the order from one to two; and a node tries all pairs of
neighbours within its reach, diagonal ones included, not only those at its best single node.

No equation and no code is shared with characteristics, series and formulas, so that agreement with them means
something. No derivative of f is needed, and V may have kinks. The compiled functions stand in one file: numba
keeps a function until *its own* file changes.

References
----------
D. Dahiya, M. Cameron, J. Sci. Comput. 75 (2018) 1351: ordered line integral methods.
"""

from __future__ import annotations

import heapq
import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from siq.errors import NumericalFailure
from siq.numerics.integration import machine_code
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics
from siq.systems.equilibria import hessian_at

LOGGER = logging.getLogger(__name__)

Stop = Literal["boundary", "level", "everywhere"]


@dataclass(frozen=True)
class _MeshQuasipotential:
    """V on the nodes of a rectangular mesh.

    The work ends where the boundary of the mesh is next, or a value above the level asked for, or no node is
    left. Unless a boundary was passed over, all states that are connected with A and have a V lower than the
    highest one have been reached.
    """

    axes: tuple[np.ndarray, np.ndarray]  #: nodes along each state, (nx,) and (ny,), in its unit
    values: np.ndarray  #: V, not U = 2V, shape (nx, ny); NaN where it was not reached
    attractor: np.ndarray  #: A, shape (2,), where V is zero
    level: float  #: the highest V reached, in the unit of f·x/D
    stop: Stop  #: why the work ended
    reach: int  #: longest segment, in mesh widths

    def evaluate(self, x: np.ndarray) -> np.ndarray:
        """V at points, interpolated: ``(n, 2)`` to ``(n,)``.

        By a cubic along each state, linear where not all nodes are known that a cubic needs; where not even
        those are, and outside the box, V is NaN.
        """
        where = np.stack([(x[:, k] - axis[0]) / (axis[1] - axis[0]) for k, axis in enumerate(self.axes)])
        last = np.array(self.values.shape)[:, None] - 1
        outside = ~((where > -1e-9) & (where < last + 1e-9)).all(axis=0)
        where = np.clip(np.where(outside, 0.0, where), 0, last)
        nearest = np.round(where)
        where = np.where(np.abs(where - nearest) < 1e-9, nearest, where)  # or rounding would ask a neighbour
        values, cubic = self._interpolated(where, 1), self._interpolated(where, 3)
        values = np.where(np.isfinite(cubic), cubic, values)
        return np.where(outside, np.nan, values)

    def _interpolated(self, where: np.ndarray, degree: int) -> np.ndarray:
        """Lagrange's polynomial through the nodes about a place, which is given in mesh widths."""
        offsets = np.arange(degree + 1)
        nodes, shares = [], []
        for place, count in zip(where, self.values.shape, strict=True):
            first = np.clip(np.floor(place).astype(int) - degree // 2, 0, count - 1 - degree)
            distance = (place - first)[:, None] - offsets
            share = np.ones((len(place), degree + 1))
            for k in offsets:
                for other in offsets[offsets != k]:
                    share[:, k] *= distance[:, other] / (k - other)
            nodes.append(first[:, None] + offsets)
            shares.append(share)
        around = self.values[nodes[0][:, :, None], nodes[1][:, None, :]]
        share = shares[0][:, :, None] * shares[1][:, None, :]
        return np.where(share == 0, 0.0, share * around).sum(axis=(1, 2))


MIN_NODES = 16  # nodes along a state: fewer leave no room around the start
START_HALF_AXIS = 2.5  # mesh widths: shortest half-axis of the ellipse within which V is its quadratic form
EQUILIBRIUM_TOLERANCE = 0.05  # by which f at the attractor, and M, may be off
LINEAR_RANGE = 1e-3  # of the starting ellipse: where f counts as linear
DIRECTIONS = 360  # numerical: of the starting ellipse, a degree apart


def _start(
    drift: Callable[[np.ndarray], np.ndarray], attractor: np.ndarray, hessian: np.ndarray, box: np.ndarray,
    widths: np.ndarray, diffusion: Diffusion,
) -> tuple[float, float]:  # fmt: skip
    """V at the rim of the starting ellipse, and r, how fast f turns there; wrong input is refused."""
    scale = np.sqrt(np.abs(np.diag(hessian)))
    ratio = hessian / np.maximum(np.outer(scale, scale), np.finfo(float).tiny)
    if not np.allclose(ratio, ratio.T) or np.diag(hessian).min() <= 0 or np.linalg.eigvalsh(ratio)[0] <= 0:
        raise ValueError(f"the hessian {hessian.tolist()} is not symmetric and positive definite")
    noise = diffusion.frozen(attractor)
    if not noise.regular:
        raise ValueError(f"the diffusion {noise.matrix.tolist()} at the attractor is not positive definite")
    if np.any((attractor <= box[:, 0]) | (attractor >= box[:, 1])):
        raise ValueError(f"the attractor {attractor.tolist()} is not inside the box {box.tolist()}")
    form = hessian * np.outer(widths, widths)  # M, of displacements in mesh widths
    rim = START_HALF_AXIS**2 * np.linalg.eigvalsh(form)[-1] / 2
    half = np.sqrt(2 * rim * np.diag(np.linalg.inv(form)))
    room = np.minimum(attractor - box[:, 0], box[:, 1] - attractor) / widths
    if np.any(half + 1 >= room):
        raise ValueError(
            f"the start around the attractor takes {np.ceil(half).tolist()} mesh widths, to the box's ends "
            f"there are {np.floor(room).tolist()}; take more nodes or a larger box"
        )
    angles = np.linspace(0, 2 * np.pi, DIRECTIONS, endpoint=False)
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    # In mesh widths: states may differ in size by many orders.
    small = LINEAR_RANGE * np.sqrt(2 * rim) * circle
    offset = np.linalg.solve(np.linalg.cholesky(hessian * np.outer(widths, widths)).T, small.T).T * widths
    force = (_drift_values(drift, attractor + offset) - _drift_values(drift, attractor - offset)) / 2
    momentum = offset @ hessian
    push = diffusion.push(attractor + offset, momentum)
    # Of H = p·(f + Dp), which vanishes.
    energy = np.sum(momentum * (force + push), axis=1)
    root = _square(_metric_roots(diffusion, attractor[None]))[0]
    size = np.linalg.norm(momentum @ np.linalg.inv(root), axis=1) * np.linalg.norm(force @ root.T, axis=1)
    resting = np.linalg.norm(root @ _drift_values(drift, attractor[None])[0]) * LINEAR_RANGE
    if resting > EQUILIBRIUM_TOLERANCE * np.linalg.norm(force @ root.T, axis=1).max():
        raise ValueError(f"the attractor {attractor.tolist()} is no equilibrium: f does not vanish there")
    if np.abs(energy).max() > EQUILIBRIUM_TOLERANCE * size.max():
        raise ValueError(
            f"{hessian.tolist()} is not the Hessian of V at the attractor;"
            " see siq.systems.equilibria.hessian_at, and mind that U = 2V has twice that"
        )
    velocity, slope = (force + 2 * push) / widths, momentum * widths
    lengths = np.linalg.norm(velocity, axis=1) * np.linalg.norm(slope, axis=1)
    return float(rim), float((lengths / np.sum(velocity * slope, axis=1)).max())


def _metric_roots(diffusion: Diffusion, x: np.ndarray) -> np.ndarray:
    """R with ``RᵀR = D⁻¹`` at points ``(n, 2)``, exact in powers of two: R₁₁, R₂₁, R₂₂, shape ``(n, 3)``."""
    root = diffusion.root_at(x)
    a, b, c = root[:, 0, 0], root[:, 1, 0], root[:, 1, 1]
    return np.stack([1 / a, -b / (a * c), 1 / c], axis=1)


def _square(roots: np.ndarray) -> np.ndarray:
    """Lower triangular matrices of their three entries: ``(..., 3)`` to ``(..., 2, 2)``."""
    matrices = np.zeros((*roots.shape[:-1], 2, 2))
    matrices[..., 0, 0], matrices[..., 1, 0], matrices[..., 1, 1] = np.moveaxis(roots, -1, 0)
    return matrices


def _drift_values(drift: Callable[[np.ndarray], np.ndarray], x: np.ndarray) -> np.ndarray:
    """f of points ``(n, 2)``, of the same shape and finite."""
    values = np.asarray(drift(x), dtype=float)
    if values.shape != x.shape:
        raise ValueError(f"f of points of shape {x.shape} has the shape {values.shape}; it must be the same")
    if not np.isfinite(values).all():
        raise NumericalFailure("f is not finite everywhere in the box; take a smaller one")
    return values


SHARE_TOLERANCE = 1e-6  # of λ: U is flat at its minimum, and off by the square of this
MAX_SECANTS = 60  # numerical, a guard: bisection alone reaches SHARE_TOLERANCE in 20

# A node has no value yet; a guess; its value, on the front; its value, behind the front.
UNKNOWN, CONSIDERED, FRONT, ACCEPTED = range(4)
STOPS: tuple[Stop, ...] = ("boundary", "level", "everywhere")


class _Mesh(NamedTuple):
    """The state of the march, for the compiled functions; displacements are in mesh widths."""

    # U, `UNKNOWN` and so on, and the lowest value from a single node with that node as i * ny + j: (nx, ny).
    # R f and R₁₁, R₂₁, R₂₂, with which lengths in D⁻¹ become plain ones, at the nodes and half-way:
    # (2 nx - 1, 2 ny - 1, 2 or 3), the latter (1, 1, 3) where D is the same everywhere, and varies is 0.
    values: np.ndarray
    status: np.ndarray
    lowest: np.ndarray
    source: np.ndarray
    drift: np.ndarray
    roots: np.ndarray
    varies: int
    reach: int
    refined: bool


@machine_code
def _march(mesh: _Mesh, top: float, stop_at_boundary: bool) -> tuple[int, float]:
    """Work through the mesh; the index in `STOPS`, and the highest U that is known."""
    nx, ny = mesh.values.shape
    heap = [(math.inf, -1)]  # considered nodes by value; a node whose value fell stands there again
    for i in range(nx):
        for j in range(ny):
            if mesh.status[i, j] == FRONT:
                _consider_around(mesh, heap, i, j)
    for i in range(nx):
        for j in range(ny):
            _leave_front(mesh, i, j)
    stop, highest = 2, 0.0
    while True:
        _, node = heapq.heappop(heap)
        if node < 0:
            break
        i, j = node // ny, node % ny
        if mesh.status[i, j] != CONSIDERED:
            continue
        if mesh.values[i, j] > top:
            stop = 1
            break
        if stop_at_boundary and (i == 0 or j == 0 or i == nx - 1 or j == ny - 1):
            stop = 0
            break
        mesh.status[i, j] = FRONT
        highest = max(highest, mesh.values[i, j])
        for a in range(max(i - 1, 0), min(i + 2, nx)):
            for b in range(max(j - 1, 0), min(j + 2, ny)):
                _leave_front(mesh, a, b)
        for a in range(max(i - mesh.reach, 0), min(i + mesh.reach + 1, nx)):
            for b in range(max(j - mesh.reach, 0), min(j + mesh.reach + 1, ny)):
                if mesh.status[a, b] == CONSIDERED and _within(mesh, i, j, a, b):
                    _improve(mesh, heap, i, j, a, b)
        _consider_around(mesh, heap, i, j)
    return stop, highest


@machine_code
def _consider_around(mesh: _Mesh, heap: list[tuple[float, int]], i: int, j: int) -> None:
    """Give the unknown neighbours of a new node of the front their first values."""
    nx, ny = mesh.values.shape
    for a in range(max(i - 1, 0), min(i + 2, nx)):
        for b in range(max(j - 1, 0), min(j + 2, ny)):
            if mesh.status[a, b] == UNKNOWN:
                _consider(mesh, a, b)
                heapq.heappush(heap, (mesh.values[a, b], a * ny + b))


@machine_code
def _consider(mesh: _Mesh, i: int, j: int) -> None:
    """The first value of a node, from all of the front within reach."""
    nx, ny = mesh.values.shape
    mesh.status[i, j] = CONSIDERED
    for a in range(max(i - mesh.reach, 0), min(i + mesh.reach + 1, nx)):
        for b in range(max(j - mesh.reach, 0), min(j + mesh.reach + 1, ny)):
            if mesh.status[a, b] == FRONT and _within(mesh, i, j, a, b):
                value = mesh.values[a, b] + _action(mesh, a, b, i, j)
                if value < mesh.lowest[i, j]:
                    mesh.lowest[i, j] = value
                    mesh.source[i, j] = a * ny + b
    a, b = mesh.source[i, j] // ny, mesh.source[i, j] % ny
    mesh.values[i, j] = min(mesh.lowest[i, j], _from_pairs(mesh, a, b, i, j))


@machine_code
def _improve(mesh: _Mesh, heap: list[tuple[float, int]], a: int, b: int, i: int, j: int) -> None:
    """Lower the value of the node (i, j), if segments from near the new node (a, b) of the front do."""
    ny = mesh.values.shape[1]
    value = mesh.values[a, b] + _action(mesh, a, b, i, j)
    if value < mesh.lowest[i, j]:
        mesh.lowest[i, j] = value
        mesh.source[i, j] = a * ny + b
        value = min(value, _from_pairs(mesh, a, b, i, j))
    elif mesh.refined:
        value = _from_pairs(mesh, a, b, i, j)
    else:
        c, d = mesh.source[i, j] // ny, mesh.source[i, j] % ny
        value = _from_between(mesh, c, d, a, b, i, j) if abs(a - c) + abs(b - d) == 1 else math.inf
    if value < mesh.values[i, j]:
        mesh.values[i, j] = value
        heapq.heappush(heap, (value, i * ny + j))


@machine_code
def _from_pairs(mesh: _Mesh, a: int, b: int, i: int, j: int) -> float:
    """The lowest value of (i, j) by segments from between (a, b) and a neighbour on the front."""
    nx, ny = mesh.values.shape
    lowest = math.inf
    for c in range(max(a - 1, 0), min(a + 2, nx)):
        for d in range(max(b - 1, 0), min(b + 2, ny)):
            apart = abs(c - a) + abs(d - b)
            if mesh.status[c, d] == FRONT and (apart == 1 or (apart == 2 and mesh.refined)):
                lowest = min(lowest, _from_between(mesh, a, b, c, d, i, j))
    return lowest


@machine_code
def _within(mesh: _Mesh, a: int, b: int, i: int, j: int) -> bool:
    return (a - i) * (a - i) + (b - j) * (b - j) <= mesh.reach * mesh.reach


@machine_code
def _leave_front(mesh: _Mesh, i: int, j: int) -> None:
    """A node of the front falls behind it when all its neighbours are known."""
    nx, ny = mesh.values.shape
    if mesh.status[i, j] != FRONT:
        return
    for a in range(max(i - 1, 0), min(i + 2, nx)):
        for b in range(max(j - 1, 0), min(j + 2, ny)):
            if mesh.status[a, b] < FRONT:
                return
    mesh.status[i, j] = ACCEPTED


@machine_code
def _action(mesh: _Mesh, a: int, b: int, i: int, j: int) -> float:
    """Action of the segment from (a, b) to (i, j); its middle is a node of the mesh half as wide."""
    r, s, t = mesh.roots[mesh.varies * (a + i), mesh.varies * (b + j)]
    u, v = r * (i - a), s * (i - a) + t * (j - b)
    p, q = mesh.drift[a + i, b + j, 0], mesh.drift[a + i, b + j, 1]
    return math.sqrt((u * u + v * v) * (p * p + q * q)) - (u * p + v * q)


@machine_code
def _from_between(mesh: _Mesh, a: int, b: int, c: int, d: int, i: int, j: int) -> float:
    """The least value of (i, j) by segments from between (a, b) and (c, d), infinite if there is none."""
    # At either end of the pair the segment from a single node has the same value: only a minimum inside
    # counts. R and R f in its middle are linear between those of the ends, so that R times the segment is a
    # parabola of λ.
    r, s, t = mesh.roots[mesh.varies * (a + i), mesh.varies * (b + j)]
    dr, ds, dt = mesh.roots[mesh.varies * (c + i), mesh.varies * (d + j)]
    dr, ds, dt = dr - r, ds - s, dt - t
    u, v = r * (i - a), s * (i - a) + t * (j - b)
    du, dv = r * (a - c) + dr * (i - a), s * (a - c) + t * (b - d) + ds * (i - a) + dt * (j - b)
    ddu, ddv = dr * (a - c), ds * (a - c) + dt * (b - d)
    p, q = mesh.drift[a + i, b + j, 0], mesh.drift[a + i, b + j, 1]
    dp, dq = mesh.drift[c + i, d + j, 0] - p, mesh.drift[c + i, d + j, 1] - q
    rise = mesh.values[c, d] - mesh.values[a, b]
    bend = _second_difference(mesh, a, b, c, d) if mesh.refined else 0.0

    terms = u, v, du, dv, ddu, ddv, p, q, dp, dq, rise, bend
    low, low_slope = 0.0, _slope(0.0, terms)
    if low_slope >= 0:
        return math.inf
    high, high_slope = 1.0, _slope(1.0, terms)
    if high_slope <= 0:
        return math.inf
    share, last = 0.5, 0
    for _ in range(MAX_SECANTS):
        before = share
        share = (low * high_slope - high * low_slope) / (high_slope - low_slope)
        slope = _slope(share, terms)
        if abs(share - before) < SHARE_TOLERANCE:
            break
        # Of an end that stays twice in a row the slope is halved (Illinois), or the other would creep.
        if slope > 0:
            high, high_slope = share, slope
            low_slope *= 0.5 if last == 1 else 1.0
            last = 1
        else:
            low, low_slope = share, slope
            high_slope *= 0.5 if last == -1 else 1.0
            last = -1
    u, v = u + share * (du + share * ddu), v + share * (dv + share * ddv)
    p, q = p + share * dp, q + share * dq
    base = mesh.values[a, b] + share * rise - bend * share * (1 - share) / 2
    return base + math.sqrt((u * u + v * v) * (p * p + q * q)) - (u * p + v * q)


@machine_code
def _slope(share: float, terms: tuple[float, ...]) -> float:
    """Derivative by λ of the value that `_from_between` minimises."""
    u, v, du, dv, ddu, ddv, p, q, dp, dq, rise, bend = terms
    u, v = u + share * (du + share * ddu), v + share * (dv + share * ddv)
    du, dv = du + 2 * share * ddu, dv + 2 * share * ddv
    p, q = p + share * dp, q + share * dq
    length, speed = math.sqrt(u * u + v * v), math.sqrt(p * p + q * q) + 1e-300
    product = (p * dp + q * dq) * length / speed + (u * du + v * dv) * speed / length
    return rise - bend * (0.5 - share) + product - (u * dp + v * dq + p * du + q * dv)


@machine_code
def _second_difference(mesh: _Mesh, a: int, b: int, c: int, d: int) -> float:
    """Of U along the line of two neighbours: the smaller of those at both, none where they differ in sign."""
    nx, ny = mesh.values.shape
    known, smaller = 0, 0.0
    for _ in range(2):
        e, f = 2 * a - c, 2 * b - d  # the node on the other side of (a, b)
        if 0 <= e < nx and 0 <= f < ny and mesh.status[e, f] >= FRONT:
            second = mesh.values[e, f] - 2 * mesh.values[a, b] + mesh.values[c, d]
            if known == 0 or (second * smaller > 0 and abs(second) < abs(smaller)):
                smaller = second
            elif second * smaller <= 0:
                smaller = 0.0
            known += 1
        a, b, c, d = c, d, a, b
    return smaller


STRAIGHT_REACH = 3.0  # mesh widths that suffice where f does not turn
LONGEST_DEFAULT_REACH = 60  # mesh widths, beyond which the reach is not set unasked
CHUNK = 1 << 18  # points at which f is evaluated in one call


def mesh_quasipotential(
    drift: Callable[[np.ndarray], np.ndarray], attractor: np.ndarray, *, hessian: np.ndarray,
    box: np.ndarray, shape: tuple[int, int], diffusion: Diffusion, reach: int | None = None,
    level: float | None = None, stop_at_boundary: bool = True, as_published: bool = False,
) -> _MeshQuasipotential:  # fmt: skip
    """V with respect to an attractor, or to a stable limit cycle, on a mesh.

    Parameters
    ----------
    drift
        f: points as rows, ``(n, 2)`` to ``(n, 2)``. It is evaluated at the nodes and half-way between them.
    attractor
        A, shape ``(2,)``, a stable equilibrium inside the box; it need not be a node. Or states along a
        cycle, shape ``(n, 2)``, closer to each other than mesh widths; then the reach has to be given.
    hessian
        M, shape ``(2, 2)``: the Hessian of V (not of U) at A, such as `siq.systems.equilibria.hessian_at`.
        Within an ellipse of a few mesh widths V is ``½ (x - A)·M (x - A)``. Of a cycle ``(n, 2, 2)``, each
        for the places next to its state.
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
    cycle = attractor if attractor.ndim == 2 else None
    wanted = {"attractor": (2,), "hessian": (2, 2), "box": (2, 2)}
    if cycle is not None:
        wanted |= {"attractor": (len(cycle), 2), "hessian": (len(cycle), 2, 2)}
    for (name, form), array in zip(wanted.items(), (attractor, hessian, box), strict=True):
        if array.shape != form or not np.isfinite(array).all():
            raise ValueError(f"the {name} must be finite numbers of shape {form}: the mesh has two states")
    if diffusion.dimension != 2:  # asked before D is evaluated, which takes a state of its own dimension
        raise ValueError(f"the diffusion is one of {diffusion.dimension} states: the mesh has two")
    if len(shape) != 2 or min(shape) < MIN_NODES:
        raise ValueError(f"a mesh of {shape} nodes is too coarse; give at least {MIN_NODES} along each state")
    if np.any(box[:, 0] >= box[:, 1]):
        raise ValueError(f"the box {box.tolist()} needs a lower and an upper end for each state")
    if reach is not None and reach < 2:
        raise ValueError(f"a reach of {reach} mesh widths is too short; give at least 2")
    if level is not None and not level > 0:
        raise ValueError(f"the level {level} must be positive: V is zero at the attractor")
    axes = tuple(np.linspace(low, high, count) for (low, high), count in zip(box, shape, strict=True))
    widths = (box[:, 1] - box[:, 0]) / (np.array(shape) - 1)
    x = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    if cycle is not None:
        if reach is None:
            raise ValueError("about a cycle the reach has to be given")
        away, which = cKDTree(cycle / widths).query(x / widths)
        start = np.einsum("abi,abij,abj->ab", x - cycle[which], hessian[which], x - cycle[which]) / 2
        begin = np.where(away <= START_HALF_AXIS, start, np.inf)
        attractor = cycle[0]
    else:
        rim, turning = _start(drift, attractor, hessian, box, widths, diffusion)
        if level is not None and rim >= level:
            raise ValueError(
                f"V is {rim:.3g} at the rim of the start, above the level {level:.3g}; take more nodes"
            )
        if reach is None and as_published:
            reach = max(round(10 + 4 * (math.log2(max(shape)) - 7)), 2)
        elif reach is None:
            reach = min(math.ceil(STRAIGHT_REACH + turning / 2), LONGEST_DEFAULT_REACH)
        start = np.einsum("abi,ij,abj->ab", x - attractor, hessian, x - attractor) / 2
        begin = np.where(start <= rim, start, np.inf)
    finer = tuple(np.linspace(low, high, 2 * n - 1) for (low, high), n in zip(box, shape, strict=True))
    if diffusion.constant:
        roots = _metric_roots(diffusion, attractor[None])[None]
    else:
        roots = _by_rows(lambda x: _metric_roots(diffusion, x), finer)
    roots = roots * widths[[0, 0, 1]]
    small = math.frexp(np.abs(roots).max())[1]
    roots = np.ldexp(roots, -small)
    flow = _by_rows(lambda x: _drift_values(drift, x), finer)
    flow = (_square(roots) @ (flow / widths)[..., None])[..., 0]
    fast = math.frexp(np.abs(flow).max())[1]
    flow = np.ldexp(flow, -fast)
    unit = math.ldexp(0.5, 2 * small + fast)  # V of one unit of U within the mesh
    values = begin / unit
    status = np.where(np.isfinite(begin), FRONT, UNKNOWN).astype(np.int8)
    lowest, source = np.full(shape, np.inf), np.full(shape, -1)
    varies = int(not diffusion.constant)
    mesh = _Mesh(values, status, lowest, source, flow, roots, varies, reach, not as_published)
    stop, highest = _march(mesh, math.inf if level is None else level / unit, stop_at_boundary)
    known = np.where(mesh.status >= FRONT, unit * values, np.nan)
    return _MeshQuasipotential((axes[0], axes[1]), known, attractor, unit * highest, STOPS[stop], reach)


def mesh_potential(
    dynamics: Dynamics, attractor: np.ndarray, *, box: np.ndarray, level: float, nodes: int = 512
) -> Callable[[np.ndarray], np.ndarray] | None:
    """V about an attractor as a function of points, up to a level.

    None where f is not finite, or D not positive definite, in the whole box.
    """
    try:
        return mesh_quasipotential(
            dynamics.drift, attractor, hessian=hessian_at(dynamics, attractor), box=box,
            shape=(nodes, nodes), diffusion=dynamics.diffusion, level=level, stop_at_boundary=False,
        ).evaluate  # fmt: skip
    except NumericalFailure as reason:
        LOGGER.info("no mesh about %s: %s", attractor, reason)
        return None


def _by_rows(function: Callable[[np.ndarray], np.ndarray], axes: Sequence[np.ndarray]) -> np.ndarray:
    """A function of points ``(n, 2)`` on a rectangular mesh, some rows of it at a time."""
    first, second = axes
    rows, parts = max(CHUNK // len(second), 1), []
    for row in range(0, len(first), rows):
        points = np.stack(np.meshgrid(first[row : row + rows], second, indexing="ij"), axis=-1)
        parts.append(function(points.reshape(-1, 2)).reshape(*points.shape[:2], -1))
    return np.concatenate(parts)
