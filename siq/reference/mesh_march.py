"""In which order do the nodes of a mesh learn their values, and over which segments?

The mesh is worked through from its front on, the lowest value first, as `siq.reference.mesh` says. All of it
is machine code and stands in one file: numba keeps a function until *its own* file changes, and would not
notice that a function of another file did.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from siq.numerics.machine_code import machine_code
from siq.reference.mesh_values import Stop

PRECISION = 1e-6  # of λ: U is flat at its minimum, and off by the square of this
MOST_SECANTS = 60  # numerical, a guard: bisection alone reaches PRECISION in 20

# A node has no value yet; a guess; its value, on the front; its value, behind the front.
UNKNOWN, CONSIDERED, FRONT, ACCEPTED = range(4)
STOPS: tuple[Stop, ...] = ("boundary", "level", "everywhere")


class Mesh(NamedTuple):
    """What the compiled functions work on; displacements are in mesh widths.

    Attributes
    ----------
    values
        U, shape ``(nx, ny)``.
    status
        `UNKNOWN`, `CONSIDERED`, `FRONT` or `ACCEPTED`.
    lowest, source
        The lowest value by a segment from a single node, and that node as ``i * ny + j``.
    drift
        R f at the nodes and half-way, shape ``(2 nx - 1, 2 ny - 1, 2)``.
    roots
        R, with which lengths in ``D⁻¹`` become plain ones: R₁₁, R₂₁ and R₂₂ where `drift` is, shape
        ``(2 nx - 1, 2 ny - 1, 3)``; ``(1, 1, 3)`` of a D that is the same everywhere.
    varies
        1 where D depends on the state, 0 elsewhere.
    reach
        Longest segment.
    refined
        Whether to work with second differences and all pairs.
    """

    values: np.ndarray
    status: np.ndarray
    lowest: np.ndarray
    source: np.ndarray
    drift: np.ndarray
    roots: np.ndarray
    varies: int
    reach: int
    refined: bool


class Heap(NamedTuple):
    """Considered nodes, the lowest first: ``nodes`` by place, ``places`` by node, and how many, ``(1,)``."""

    nodes: np.ndarray
    places: np.ndarray
    size: np.ndarray


@machine_code
def march(mesh: Mesh, heap: Heap, top: float, stop_at_boundary: bool) -> tuple[int, float]:
    """Work through the mesh; the index in `STOPS`, and the highest U that is known."""
    nx, ny = mesh.values.shape
    for i in range(nx):
        for j in range(ny):
            if mesh.status[i, j] == FRONT:
                _consider_around(mesh, heap, i, j)
    for i in range(nx):
        for j in range(ny):
            _leave_front(mesh, i, j)
    stop, highest = 2, 0.0
    while heap.size[0] > 0:
        i, j = heap.nodes[0] // ny, heap.nodes[0] % ny
        if mesh.values[i, j] > top:
            stop = 1
            break
        if stop_at_boundary and (i == 0 or j == 0 or i == nx - 1 or j == ny - 1):
            stop = 0
            break
        _take_lowest(heap, mesh.values)
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
def _consider_around(mesh: Mesh, heap: Heap, i: int, j: int) -> None:
    """Give the unknown neighbours of a new node of the front their first values."""
    nx, ny = mesh.values.shape
    for a in range(max(i - 1, 0), min(i + 2, nx)):
        for b in range(max(j - 1, 0), min(j + 2, ny)):
            if mesh.status[a, b] == UNKNOWN:
                _consider(mesh, a, b)
                position = heap.size[0]
                heap.size[0] += 1
                heap.nodes[position] = a * ny + b
                _rise(heap, mesh.values, position)


@machine_code
def _consider(mesh: Mesh, i: int, j: int) -> None:
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
def _improve(mesh: Mesh, heap: Heap, a: int, b: int, i: int, j: int) -> None:
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
        _rise(heap, mesh.values, heap.places[i * ny + j])


@machine_code
def _from_pairs(mesh: Mesh, a: int, b: int, i: int, j: int) -> float:
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
def _within(mesh: Mesh, a: int, b: int, i: int, j: int) -> bool:
    return (a - i) * (a - i) + (b - j) * (b - j) <= mesh.reach * mesh.reach


@machine_code
def _leave_front(mesh: Mesh, i: int, j: int) -> None:
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
def _action(mesh: Mesh, a: int, b: int, i: int, j: int) -> float:
    """Action of the segment from (a, b) to (i, j); its middle is a node of the mesh half as wide."""
    r, s, t = mesh.roots[mesh.varies * (a + i), mesh.varies * (b + j)]
    u, v = r * (i - a), s * (i - a) + t * (j - b)
    p, q = mesh.drift[a + i, b + j, 0], mesh.drift[a + i, b + j, 1]
    return math.sqrt((u * u + v * v) * (p * p + q * q)) - (u * p + v * q)


@machine_code
def _from_between(mesh: Mesh, a: int, b: int, c: int, d: int, i: int, j: int) -> float:
    """The least value of (i, j) by segments from between (a, b) and (c, d), infinite if there is none.

    At either end of the pair the segment from a single node has the same value, so that only a minimum
    inside counts. R and R f in the middle of the segment are linear between their values for the two ends,
    so that R times the segment is a parabola of λ.
    """
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

    low, low_slope = 0.0, _slope(0.0, u, v, du, dv, ddu, ddv, p, q, dp, dq, rise, bend)
    if low_slope >= 0:
        return math.inf
    high, high_slope = 1.0, _slope(1.0, u, v, du, dv, ddu, ddv, p, q, dp, dq, rise, bend)
    if high_slope <= 0:
        return math.inf
    share, last = 0.5, 0
    for _ in range(MOST_SECANTS):
        before = share
        share = (low * high_slope - high * low_slope) / (high_slope - low_slope)
        slope = _slope(share, u, v, du, dv, ddu, ddv, p, q, dp, dq, rise, bend)
        if abs(share - before) < PRECISION:
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
def _slope(
    share: float,
    u: float,
    v: float,
    du: float,
    dv: float,
    ddu: float,
    ddv: float,
    p: float,
    q: float,
    dp: float,
    dq: float,
    rise: float,
    bend: float,
) -> float:
    """Derivative by λ of the value that `_from_between` minimises."""
    u, v = u + share * (du + share * ddu), v + share * (dv + share * ddv)
    du, dv = du + 2 * share * ddu, dv + 2 * share * ddv
    p, q = p + share * dp, q + share * dq
    length, speed = math.sqrt(u * u + v * v), math.sqrt(p * p + q * q) + 1e-300
    product = (p * dp + q * dq) * length / speed + (u * du + v * dv) * speed / length
    return rise - bend * (0.5 - share) + product - (u * dp + v * dq + p * du + q * dv)


@machine_code
def _second_difference(mesh: Mesh, a: int, b: int, c: int, d: int) -> float:
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


@machine_code
def _rise(heap: Heap, values: np.ndarray, position: int) -> None:
    """Move the node at a place up until its parent is lower."""
    ny = values.shape[1]
    node = heap.nodes[position]
    value = values[node // ny, node % ny]
    while position > 0:
        parent = heap.nodes[(position - 1) // 2]
        if values[parent // ny, parent % ny] <= value:
            break
        heap.nodes[position] = parent
        heap.places[parent] = position
        position = (position - 1) // 2
    heap.nodes[position] = node
    heap.places[node] = position


@machine_code
def _take_lowest(heap: Heap, values: np.ndarray) -> None:
    """Remove the first node; the last takes its place and moves down."""
    ny = values.shape[1]
    heap.size[0] -= 1
    size = heap.size[0]
    node = heap.nodes[size]
    value = values[node // ny, node % ny]
    position = 0
    while 2 * position + 1 < size:
        child = 2 * position + 1
        below = heap.nodes[child]
        if child + 1 < size:
            beside = heap.nodes[child + 1]
            if values[beside // ny, beside % ny] < values[below // ny, below % ny]:
                child, below = child + 1, beside
        if values[below // ny, below % ny] >= value:
            break
        heap.nodes[position] = below
        heap.places[below] = position
        position = child
    heap.nodes[position] = node
    heap.places[node] = position
