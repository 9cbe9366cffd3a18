"""How is the action of a chain made minimal?

By Newton's method, with steps across the chain, damped by an upper bound of the action that touches it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from siq.landscape.chain_spacing import START_SHARE, relative_lengths, spaced
from siq.landscape.discretised_paths import DiscretisedPath, PathProblem, products
from siq.landscape.tubes import Tube

KICKS = (0.3, 0.1, 0.03, 0.01)  # of the distance: tried from a chain that is at rest and no minimum
SMALLEST_SHIFT, LARGEST_SHIFT = 1e-3, 1e12  # of Newton's matrix
LEAST_GAIN, GOOD_GAIN = 0.05, 0.7  # of what a step promised: it is taken; the next one is bolder
STEPS, RESPACINGS, MOST_KICKS = 150, 40, 3
UNEVEN = 1.6  # longest to shortest segment at which a chain is spaced anew
COARSE, FINE = 1e-7, 1e-12  # share of S that a step must still gain, for first guesses and for the answer


def descended(
    problem: PathProblem, y: np.ndarray, count: int, action: float, *, first: bool = False
) -> DiscretisedPath:
    """Move a chain of `count` points down to a minimum of S, by steps across the chain.

    A `first` chain is spaced anew where it has become uneven, and pushed off where it rests at a saddle
    of S.

    Parameters
    ----------
    problem
        The action.
    y
        Points along which the chain is laid, in any number.
    count
        Number of points of the chain.
    action
        About that of the path; it decides where the chain begins.
    first
        Whether it starts far from a minimum.
    """
    level = START_SHARE * action
    y = spaced(problem, y, count, level)
    if y.shape[1] == 1:
        return DiscretisedPath(y, problem.action(y), True)
    action, shift, spacings, kicks = problem.action(y), 1.0, 0, 0
    for _ in range(STEPS):
        across = Across(problem, y)
        resting = (COARSE if first else _fine(problem)) * action + np.finfo(float).eps * across.effort
        gained, expected = 0.0, np.inf
        while shift < LARGEST_SHIFT:
            step = across.step(shift)
            if step is not None:
                new = across.moved(step)
                expected = -0.5 * float(across.slope @ step)
                gained = action - problem.action(new)
                if gained > LEAST_GAIN * expected or expected < resting:
                    break
            shift = max(4 * shift, SMALLEST_SHIFT)
        else:
            break
        if gained > 0:
            y, action = new, action - gained
        if expected > resting:
            shift *= 0.2 if gained > GOOD_GAIN * expected else 1.0
            shift = max(shift if shift > 1e-8 else 0.0, problem.flat)
            measure = relative_lengths(problem, y)
            if first and spacings < RESPACINGS and measure.max() > UNEVEN * measure.min():
                y = spaced(problem, y, count, level)
                action, spacings = problem.action(y), spacings + 1
        elif across.step(problem.flat) is None:
            if not first or kicks == MOST_KICKS:
                break
            kicks += 1
            lower = min((across.moved(push) for push in across.kicks()), key=problem.action)
            if problem.action(lower) >= action:
                break
            y, action, shift = lower, problem.action(lower), 1.0
        elif shift <= SMALLEST_SHIFT:
            return DiscretisedPath(y, action, True)
        else:
            shift = problem.flat
    return DiscretisedPath(y, action, False)


def _fine(problem: PathProblem) -> float:
    """Share of S that a step must still gain: of tubes, the third order that their cost leaves out."""
    return START_SHARE**1.5 if problem.flat > 0 else FINE


class Across:
    """Moves of a chain across itself: slope and second derivatives of S, in banded form.

    A chain may slide along itself without any change of S but that of its error, which must not matter. The
    matrix for frozen times is that of ``Σ |Δ - τf|²/2τ``, ``τ = |Δ|/|f|`` being held fast, without the second
    derivatives of f and D: of an upper bound of S that touches it. With ``q = D⁻¹(Δ/τ - f)``, twice the
    momentum, and ``G_ik = ∂_k f_i + ((∂_k D)q)_i``, its blocks are ``τ GᵀD⁻¹G``, ``-D⁻¹G`` and ``D⁻¹/τ``.
    """

    def __init__(self, problem: PathProblem, y: np.ndarray) -> None:
        parts, dimension = problem.segments(y), y.shape[1]
        self.y, self.effort = y, float(np.sum(parts.speed * parts.length))
        self.range = slice(1 if problem.begin is None else 0, -1 if problem.finish is None else None)
        times = (parts.length / parts.speed)[:, None, None]
        metric, middles, jacobian = parts.metric, parts.middles, problem.jacobian(parts.middles)
        force, forward = (products(metric, part) for part in (parts.force, parts.forward))
        twice = forward / times[:, 0] - force
        turned, by_middle = jacobian, np.einsum("nij,ni->nj", jacobian, twice)
        bent = problem.bend(middles, -times[:, 0] * twice)
        # The times change, too: by so much, up to a factor, with the middles and the differences.
        slower = 2 * times[:, 0] * np.einsum("nij,ni->nj", jacobian, force)
        if not problem.constant:
            noise = problem.noise
            turned = jacobian + noise.turn(middles, twice)
            by_middle = by_middle + noise.pull(middles, twice) / 2
            bent = bent - times / 2 * noise.bend(middles, twice)
            slower -= times[:, 0] * noise.pull(middles, force) - noise.pull(middles, forward) / times[:, 0]
        by_middle *= -times[:, 0]
        slope = np.zeros_like(y)
        slope[1:] += by_middle / 2 + twice
        slope[:-1] += by_middle / 2 - twice
        longer, share = -2 * forward / times[:, 0], (0.25 / (parts.speed * parts.length))[:, None, None]
        pushed = metric @ turned
        frozen = _Blocks(times * turned.transpose(0, 2, 1) @ pushed, -pushed, metric / times)
        exact = _Blocks(
            frozen.middle + bent - share * _outer(slower, slower),
            frozen.mixed - share * _outer(longer, slower),
            frozen.forward - share * _outer(longer, longer),
        )
        first, last = np.zeros((2, dimension, dimension))
        if problem.begin is not None:
            slope[0] += problem.begin.slope(y[0])
            first = problem.begin.curvature(y[0])
        if problem.finish is not None:
            slope[-1] += problem.finish.slope(y[-1])
            last = problem.finish.curvature(y[-1])
        self.problem = problem
        normal = _normals(y)
        if isinstance(problem.begin, Tube):  # along the tube, on which the chain begins, and ends
            normal[0] = np.linalg.svd(problem.begin.slope(y[0])[None])[2][1:].T
        if problem.finish is not None:
            normal[-1] = np.linalg.svd(problem.finish.slope(y[-1])[None])[2][1:].T
        self.normal = normal[self.range]
        self.slope = np.einsum("nij,ni->nj", self.normal, slope[self.range]).ravel()
        self.exact = exact.banded(self.normal, self.range.start, (first, last))
        self.frozen = frozen.banded(self.normal, self.range.start, (first, last))

    def step(self, shift: float) -> np.ndarray | None:
        """Newton's step with a shift; None where the matrix is not positive definite."""
        try:
            with np.errstate(all="ignore"):
                matrix = self.exact + shift * self.frozen
            factor = scipy.linalg.cholesky_banded(matrix, lower=True)
        except (np.linalg.LinAlgError, ValueError):  # ValueError: not finite
            return None
        return -scipy.linalg.cho_solve_banded((factor, True), self.slope)

    def moved(self, step: np.ndarray) -> np.ndarray:
        """The chain after a step."""
        y = self.y.copy()
        y[self.range] += np.einsum("nij,nj->ni", self.normal, step.reshape(len(self.normal), -1))
        if isinstance(begin := self.problem.begin, Tube):
            y[0] = begin.onto(y[0], float(begin.level(self.y[:1])[0]))
        if (finish := self.problem.finish) is not None:
            y[-1] = finish.onto(y[-1], float(finish.level(self.y[-1:])[0]))
        return y

    def kicks(self) -> list[np.ndarray]:
        """Steps to both sides along the direction in which S curves downwards most."""
        _, vectors = scipy.linalg.eig_banded(self.exact, lower=True, select="i", select_range=(0, 0))
        way = vectors[:, 0] / np.abs(vectors).max()
        return [side * size * way for size in KICKS for side in (1, -1)]


@dataclass(frozen=True)
class _Blocks:
    """Second derivatives of the segments by middles and differences, ``(n - 1, d, d)`` each."""

    middle: np.ndarray
    mixed: np.ndarray  # difference before middle
    forward: np.ndarray

    def banded(self, normal: np.ndarray, start: int, ends: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        """The matrix of the moves ``normal`` from point `start` on, in the lower form of scipy's solvers.

        `ends` are added to the blocks of the first point and of the last.
        """
        count, _, m = normal.shape
        transposed = self.mixed.transpose(0, 2, 1)
        both = (self.mixed + transposed) / 2
        diagonal = np.zeros((len(self.middle) + 1, *ends[0].shape))
        diagonal[1:] += self.middle / 4 + self.forward + both
        diagonal[:-1] += self.middle / 4 + self.forward - both
        diagonal[0] += ends[0]
        diagonal[-1] += ends[1]
        # Row of the next point, column of this one.
        below = self.middle / 4 - self.forward + (self.mixed - transposed) / 2
        turned = normal.transpose(0, 2, 1)
        diagonal = turned @ diagonal[start : start + count] @ normal
        below = turned[1:] @ below[start : start + count - 1] @ normal[:-1]
        matrix = np.zeros((2 * m, count * m))
        for column in range(m):
            for row in range(column, m):
                matrix[row - column, column::m] = diagonal[:, row, column]
            for row in range(m):
                matrix[m + row - column, column::m][: count - 1] = below[:, row, column]
        return matrix


def _outer(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    return left[:, :, None] * right[:, None, :]


def _normals(y: np.ndarray) -> np.ndarray:
    """Orthonormal directions across a chain at its points, shape ``(n, d, d - 1)``."""
    along = np.gradient(y, axis=0)
    return np.linalg.svd(along[:, None, :])[2][:, 1:].transpose(0, 2, 1)
