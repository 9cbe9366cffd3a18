"""Which momenta and actions has a chain that is a minimum, and how far is it from Hamilton's equations?"""

from __future__ import annotations

import numpy as np

from siq.landscape.discretised_paths import NO_ACTION, DiscretisedPath, PathProblem, products


def path_nodes(problem: PathProblem, chain: DiscretisedPath) -> np.ndarray:
    """Points, momenta, and actions up to there, shape ``(n, 2d + 1)``."""
    y, parts = chain.points, problem.segments(chain.points)
    # Momenta of the middles, carried over half a segment with ṗ = -Jᵀp - p·(∂D)p; both sides agree at a
    # minimum.
    times = (parts.length / parts.speed)[:, None]
    middle = products(parts.metric, (parts.forward / times - parts.force) / 2)
    change = np.einsum("nij,ni->nj", problem.jacobian(parts.middles), middle)
    if not problem.constant:
        change += problem.noise.pull(parts.middles, middle)
    turn = times / 2 * change
    p = np.empty_like(y)
    p[1:-1] = (middle[1:] + turn[1:] + middle[:-1] - turn[:-1]) / 2
    p[0] = middle[0] + turn[0] if problem.begin is None else problem.begin.slope(y[0]) / 2
    p[-1] = middle[-1] - turn[-1] if problem.finish is None else -problem.finish.slope(y[-1]) / 2
    values = problem.level(y[:1]) + np.r_[0.0, np.cumsum(parts.actions)]
    return np.column_stack([y, p, values])


def hamiltonian_residual(problem: PathProblem, nodes: np.ndarray) -> float:
    """The largest Hamiltonian, in proportion to its parts."""
    y, p = np.split(nodes[:, :-1], 2, axis=1)
    force = problem.force(y)
    drift = np.sum(p * force, axis=1)
    push = np.sum((p if problem.constant else products(problem.noise.at(y), p)) * p, axis=1)
    scale = max((np.abs(drift) + push).max(), NO_ACTION * np.sum(force**2, axis=1).max())
    return float(np.abs(drift + push).max() / scale)


def extrapolated(problem: PathProblem, coarse: DiscretisedPath, fine: DiscretisedPath) -> np.ndarray:
    """Nodes without the error of second order, from a chain and one with half its spacing.

    Where the two differ by more than their errors, by a turn about the attractor say, they do not match, and
    the finer one stands for itself.
    """
    action = max((4 * fine.action - coarse.action) / 3, 0.0)
    second = path_nodes(problem, fine)
    nodes = (4 * second[::2] - path_nodes(problem, coarse)) / 3
    if not hamiltonian_residual(problem, nodes) < hamiltonian_residual(problem, second):
        nodes = second
        nodes[:, -1] *= action / max(fine.action, np.finfo(float).tiny)
    d, ends = problem.end.size, np.zeros((2, nodes.shape[1]))
    if problem.finish is not None:
        ends[1, :d] = problem.finish.closest(nodes[-1:, :d])[0]
        nodes[-1, -1] = action - problem.remaining(nodes[-1, :d])
        nodes = np.vstack([nodes, ends[1:]])
    nodes[-1, -1] = action
    if problem.begin is None:
        return nodes
    ends[0, :d] = problem.begin.closest(nodes[:1, :d])[0]
    return np.vstack([ends[:1], nodes])
