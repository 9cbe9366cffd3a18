"""How long do wells last, and where are the states, whatever the barriers: the Fokker–Planck operator itself.

For ``dx = f dt + √ε σ dW`` in one or two states, ``L u = f·∇u + (ε/2) D:∇∇u`` on a box that nothing leaves
becomes a Markov jump process between cells. The flux between neighbours is Scharfetter and Gummel's,

    J = (a/h) [B(-z) p_left - B(z) p_right],    a = (ε/2) D,  z = (f - a') h/a,  B(z) = z/(eᶻ - 1),

which is exact for constant coefficients, keeps densities positive, and knows no smallness of ε. Where D has
mixed terms, diagonal neighbours take them (Kushner), in coordinates in which the mean D is the unit matrix.

The time of a *visit* is what one counts on a record: from where a core is entered until another one is. With
the invariant density π, and q the probability that of all cores this one was visited last (the solution of
the time-reversed ``L̃ q = 0`` with q = 1 in this core and 0 in the others),

    mean visit = ∫ π q dx / (flow of π q into other cores).

It is exact for any barrier; see Vanden-Eijnden, *Transition path theory*, Lect. Notes Phys. 703 (2006) 453.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from siq.dynamics.dynamics import Dynamics
from siq.errors import NumericalFailure

CELLS = {1: 2000, 2: 120}  # along each state: visits of a double well are then good to 1e-4 and 1e-2
COARSE = 1.0  # z between neighbours, in the mean over the density: beyond, wells are narrower than cells
SELDOM = 1e-9  # of the fastest rate
LEAST = 1e-9  # numerical: of the strongest noise; where it is weaker it is none
STEEP = 700.0  # of z: beyond, exp overflows, and B has its limits


@dataclass(frozen=True)
class CellProcess:
    """The Markov jump process between the cells of a box.

    Attributes
    ----------
    points
        Centres of the n cells, shape ``(n, d)``.
    rates
        Generator, sparse ``(n, n)``: row i holds the rates out of cell i, and minus their sum.
    density
        Invariant probability of each cell, shape ``(n,)``.
    """

    points: np.ndarray
    rates: sparse.csr_matrix
    density: np.ndarray

    def last_visited(self, cores: np.ndarray, which: int) -> np.ndarray:
        """Probability that core `which` was the last of all that was visited: shape ``(n,)``.

        Parameters
        ----------
        cores
            Shape ``(n,)``: the core that each cell belongs to, -1 between them.
        which
            One of them.
        """
        found = (cores == which).astype(float)
        free = np.flatnonzero(cores < 0)
        weight = np.maximum(self.density, np.finfo(float).tiny)
        # Of the reversed process only ratios count: π_j L_ji, row by row.
        flows = (sparse.diags(weight) @ self.rates).T.tocsr()
        inner = flows[free][:, free]
        scale = 1 / np.maximum(-inner.diagonal(), np.finfo(float).tiny)
        into = -(flows[free] @ found)
        found[free] = splu((sparse.diags(scale) @ inner).tocsc()).solve(scale * into)
        return np.clip(found, 0.0, 1.0)

    def mean_visit(self, cores: np.ndarray, which: int) -> float:
        """Mean time from entering core `which` until another one is entered, counted as on a record."""
        own = self.density * self.last_visited(cores, which)
        others = ((cores >= 0) & (cores != which)).astype(float)
        flow = float(own @ (self.rates @ others))
        return float(own.sum() / flow) if flow > 0 else float("inf")


def cell_process(
    dynamics: Dynamics, intensity: float, box: np.ndarray, *, cells: int | None = None
) -> CellProcess:
    """The process between cells of a box, with its invariant density.

    Parameters
    ----------
    dynamics
        f and D of one or two states; noise has to reach each of them.
    intensity
        ε.
    box
        Shape ``(d, 2)``, which nothing leaves. In two states with mixed terms of D it is the parallelogram's
        hull that is covered.
    cells
        Along each state.

    Raises
    ------
    NumericalFailure
        With more than two states, or where the noise is too weak for so few cells or does not reach a state.

    Notes
    -----
    A formula of D that was learned from recordings may be no covariance far from them. Cells where that is so
    are left out, and nothing goes there.
    """
    dimension = dynamics.dimension
    if dimension not in CELLS:
        raise NumericalFailure("the Fokker–Planck operator is solved for one and two states only")
    count = CELLS[dimension] if cells is None else cells
    middle = box.mean(axis=1)[None]
    matrix = dynamics.diffusion.at(middle)[0]
    shear = _shear(matrix)
    corners = np.array(list(product(*box))) @ np.linalg.inv(shear).T
    plain = np.array_equal(shear, np.eye(dimension))
    sides = box if plain else np.stack([corners.min(axis=0), corners.max(axis=0)], axis=1)
    axes = [low + (high - low) * (np.arange(count) + 0.5) / count for low, high in sides]
    steps = (sides[:, 1] - sides[:, 0]) / count
    y = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, dimension)
    inverse = np.linalg.inv(shear)

    def tensors(points: np.ndarray) -> np.ndarray:
        return np.asarray(inverse @ dynamics.diffusion.at(points @ shear.T) @ inverse.T)

    floor = LEAST * float(np.linalg.eigvalsh(tensors(y)).max())

    def noise(points: np.ndarray) -> np.ndarray:
        return 0.5 * intensity * _raised(tensors(points), floor)

    def flow(points: np.ndarray) -> np.ndarray:
        return np.asarray(dynamics.drift(points @ shear.T) @ inverse.T)

    usable = np.linalg.eigvalsh(tensors(y))[:, 0] > floor
    if not usable.any():
        raise NumericalFailure("the noise does not reach every state: no Fokker–Planck operator is solved")
    rates, kept = _connected(_rates(flow, noise, y, steps, count), usable)
    y, density = y[kept], _invariant(rates)
    tensor, drift = np.diagonal(noise(y), axis1=1, axis2=2), flow(y)
    if float((density[:, None] * np.abs(drift) * steps / tensor).sum(axis=0).max()) > COARSE:
        raise NumericalFailure("the noise is too weak for a grid: the wells are narrower than its cells")
    return CellProcess(y @ shear.T, rates, density)


def _connected(flows: sparse.csr_matrix, usable: np.ndarray) -> tuple[sparse.csr_matrix, np.ndarray]:
    """The generator of the largest set of usable cells that hang together, and which these are."""
    places = np.flatnonzero(usable)
    inner = flows[places][:, places]
    _, piece = sparse.csgraph.connected_components(inner, directed=True, connection="strong")
    own = piece == np.argmax(np.bincount(piece))
    places, inner = places[own], inner[own][:, own]
    return (inner - sparse.diags(np.asarray(inner.sum(axis=1)).ravel())).tocsr(), places


def _raised(matrices: np.ndarray, floor: float) -> np.ndarray:
    """Symmetric matrices ``(n, d, d)`` without eigenvalues below the floor."""
    levels, vectors = np.linalg.eigh(matrices)
    if (levels >= floor).all():
        return matrices
    return np.einsum("nik,nk,njk->nij", vectors, np.maximum(levels, floor), vectors)


def _shear(matrix: np.ndarray) -> np.ndarray:
    """A unit lower triangular change of states after which D has no mixed terms."""
    dimension = len(matrix)
    shear = np.eye(dimension)
    if dimension == 2 and abs(matrix[0, 1]) > 1e-12 * np.sqrt(matrix[0, 0] * matrix[1, 1]):
        shear[1, 0] = matrix[0, 1] / matrix[0, 0]
    return shear


def _rates(
    flow: Callable[[np.ndarray], np.ndarray],
    noise: Callable[[np.ndarray], np.ndarray],
    y: np.ndarray,
    steps: np.ndarray,
    count: int,
) -> sparse.csr_matrix:
    dimension = y.shape[1]
    index = np.arange(len(y)).reshape((count,) * dimension)
    rows, columns, values = [], [], []
    for axis in range(dimension):
        left = np.take(index, np.arange(count - 1), axis=axis).ravel()
        right = np.take(index, np.arange(1, count), axis=axis).ravel()
        h = steps[axis]
        face = (y[left] + y[right]) / 2
        tensor = noise(face)
        spread = tensor[:, axis, axis]
        slope = (noise(y[right])[:, axis, axis] - noise(y[left])[:, axis, axis]) / h
        drift = flow(face)[:, axis] - slope
        if dimension == 2:
            other = 1 - axis
            move = np.zeros(2)
            move[other] = steps[other] / 2
            # What the other direction's mixed term carries along this one: ∂(a_xy)/∂y.
            drift = drift - (noise(face + move) - noise(face - move))[:, 0, 1] / steps[other]
            spread = spread - np.abs(tensor[:, 0, 1]) * h / steps[other]
        spread = np.maximum(spread, 1e-9 * tensor[:, axis, axis])
        z = np.clip(drift * h / spread, -STEEP, STEEP)
        rows += [left, right]
        columns += [right, left]
        values += [spread / h**2 * _bernoulli(-z), spread / h**2 * _bernoulli(z)]
    if dimension == 2:
        for sign in (1, -1):
            low = index[:-1, :-1] if sign > 0 else index[:-1, 1:]
            high = index[1:, 1:] if sign > 0 else index[1:, :-1]
            start, end = low.ravel(), high.ravel()
            mixed = np.maximum(sign * noise((y[start] + y[end]) / 2)[:, 0, 1], 0) / np.prod(steps)
            used = mixed > 0
            rows += [start[used], end[used]]
            columns += [end[used], start[used]]
            values += [mixed[used], mixed[used]]
    total = sparse.csr_matrix(
        (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape=(len(y), len(y))
    )
    return total


def _bernoulli(z: np.ndarray) -> np.ndarray:
    """``z/(eᶻ - 1)``."""
    small = np.abs(z) < 1e-6
    with np.errstate(over="ignore"):
        return np.where(small, 1 - z / 2, z / np.expm1(np.where(small, 1.0, z)))


def _invariant(rates: sparse.csr_matrix) -> np.ndarray:
    """Probabilities with ``π L = 0``: that of a busy cell set to one, the others follow from it."""
    transposed = rates.T.tocsc()
    size = transposed.shape[0]
    # A process that rarely starts anew, anywhere, says which cell is busy; of one that is not, the ratio of
    # all others to it would have to be found.
    anew = SELDOM * float(-rates.diagonal().min())
    started = splu((transposed - anew * sparse.identity(size)).tocsc()).solve(np.full(size, -anew / size))
    fixed = int(np.argmax(started))
    free = np.delete(np.arange(size), fixed)
    right = -np.asarray(transposed[free][:, [fixed]].todense()).ravel()
    found = np.ones(size)
    found[free] = splu(transposed[free][:, free].tocsc()).solve(right)
    if not np.isfinite(found).all() or found.min() < -1e-6 * found.max():
        raise NumericalFailure(
            "the invariant density was not found: the noise is too weak for this box; use the barriers"
        )
    found = np.maximum(found, 0.0)
    return np.asarray(found / found.sum())


def cores_of(
    points: np.ndarray,
    attractors: np.ndarray,
    hessians: Sequence[np.ndarray] | np.ndarray,
    levels: np.ndarray,
) -> np.ndarray:
    """Which core each point is in, -1 between them: shape ``(n,)``.

    The core of an attractor is where ``(x - A)ᵀ M (x - A)``, which is U there to the second order, stays
    below a level.

    Parameters
    ----------
    points
        Shape ``(n, d)``.
    attractors
        Shape ``(k, d)``.
    hessians
        M, the Hessian of V at each: ``(d, d)``.
    levels
        Of U, shape ``(k,)``.
    """
    found = np.full(len(points), -1)
    lowest = np.full(len(points), np.inf)
    for place, (attractor, hessian, level) in enumerate(zip(attractors, hessians, levels, strict=True)):
        away = points - attractor
        height = np.einsum("ni,ij,nj->n", away, hessian, away)
        inside = (height <= level) & (height / level < lowest)
        found[inside], lowest[inside] = place, (height / level)[inside]
    return found
