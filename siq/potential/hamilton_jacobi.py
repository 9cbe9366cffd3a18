"""Gauss–Newton on the Hamilton–Jacobi equation ``∇V·(f + D∇V) = 0`` for V in a basis.

The equation has false solutions that are just as exact as the true one: V flat along a direction, V = 0, and
one for every invariant subspace of the linearisation. Where the iteration ends depends on where it starts;
what it found must be tested by what does not know of this equation (`siq.certificate.tests`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg

from siq.dynamics.diffusion import Diffusion
from siq.dynamics.dynamics import Dynamics
from siq.dynamics.reach import measure_at
from siq.potential.bases import Basis

VANISHING = 1e-8  # of f: where D∇V is smaller, Gauss–Newton is on its way to V = 0, which is a solution, too
INDEPENDENT = 1e-5  # diagonal of a triangular factor: below this share columns are not independent enough

STEEP = 3.0  # of the median residual: what is larger counts less and less
UNTOLD = 1e-10  # of the largest singular value: combinations of functions that the points leave open


@dataclass(frozen=True)
class HamiltonJacobi:
    """The equation at some points.

    Attributes
    ----------
    points
        Shape ``(n, d)``.
    gradients
        ∂θ_j/∂x_i at the points, shape ``(n, d, m)``.
    flow
        f at the points, shape ``(n, d)``.
    diffusion
        D.
    weight
        Shape ``(n,)``: one over ∣f∣ in the metric of the noise, so that fast regions do not rule.
    measure
        That metric: D, or what stands in for a D without inverse (`siq.dynamics.reach.measure_at`).
    """

    points: np.ndarray
    gradients: np.ndarray
    flow: np.ndarray
    diffusion: Diffusion
    weight: np.ndarray
    measure: Diffusion

    def residual(self, coefficients: np.ndarray) -> np.ndarray:
        """Weighted ``∇V·(f + D∇V)``, shape ``(n,)``."""
        gradient = self.slopes(coefficients)
        return self.weight * (gradient * (self.flow + self.diffusion.push(self.points, gradient))).sum(axis=1)

    def jacobian(self, coefficients: np.ndarray) -> np.ndarray:
        """Derivative of the residual with respect to the coefficients, shape ``(n, m)``."""
        gradient = self.slopes(coefficients)
        along = self.weight[:, None] * (self.flow + 2 * self.diffusion.push(self.points, gradient))
        return np.einsum("nd,ndm->nm", along, self.gradients)

    def slopes(self, coefficients: np.ndarray) -> np.ndarray:
        """∇V at the points, shape ``(n, d)``."""
        n, d, m = self.gradients.shape
        slopes: np.ndarray = (self.gradients.reshape(n * d, m) @ coefficients).reshape(n, d)
        return slopes

    def size(self, coefficients: np.ndarray) -> float:
        """Rms of ∇V over the points, in the metric of the noise."""
        gradient = self.slopes(coefficients)
        return float(np.sqrt(self.measure.steepness(self.points, gradient).mean()))

    def size_jacobian(self, coefficients: np.ndarray) -> np.ndarray:
        """Derivative of the size, which must not be zero, by the coefficients, shape ``(m,)``."""
        along = self.measure.push(self.points, self.slopes(coefficients))
        return np.einsum("nd,ndm->m", along, self.gradients) / (len(along) * self.size(coefficients))

    def sizes(self) -> np.ndarray:
        """Rms of each function's gradient over the points, in the metric of the noise: shape ``(m,)``."""
        steepness = self.measure.steepness(self.points, self.gradients.transpose(0, 2, 1))
        return np.sqrt(np.asarray(steepness.mean(axis=0)))

    def restricted(self, rows: np.ndarray) -> HamiltonJacobi:
        """The equation with some of the functions only."""
        return replace(self, gradients=self.gradients[:, :, rows])


def relative_residuals(equation: HamiltonJacobi, coefficients: np.ndarray) -> np.ndarray:
    """``∣∇V·(f + D∇V)∣ / (∣∇V∣ ∣f∣)`` at the points, shape ``(n,)``."""
    slope = equation.slopes(coefficients)
    size = np.sqrt(equation.measure.steepness(equation.points, slope))
    return np.asarray(np.abs(equation.residual(coefficients)) / np.where(size > 0, size, np.inf))


def robust(equation: HamiltonJacobi, coefficients: np.ndarray, *, finest: float) -> HamiltonJacobi:
    """The equation with weights that fall with the square of what is left (Cauchy's).

    Parameters
    ----------
    equation, coefficients
        What is left is that of this formula.
    finest
        Residual below which nothing is an outlier.
    """
    rest = relative_residuals(equation, coefficients)
    scale = max(STEEP * float(np.median(rest)), finest)
    return replace(equation, weight=equation.weight / np.sqrt(1 + (rest / scale) ** 2))


def orthonormalised(equation: HamiltonJacobi, free: np.ndarray) -> tuple[HamiltonJacobi, np.ndarray]:
    """The equation in combinations of the free functions whose gradients are orthonormal over the points.

    Powers are all but dependent over a sublevel set that is narrow, or bent; their combinations are not, and
    Gauss–Newton then gets on by the normal equations. Combinations that the points do not tell are left out.

    Parameters
    ----------
    equation
        At points.
    free
        Which functions are combined, as a mask; the others stay and come last.

    Returns
    -------
    equation
        In the k combinations and the functions that stay.
    turned
        Shape ``(m, k + s)``: the old coefficients are this times the new ones.
    """
    roots = equation.measure.root_at(equation.points)
    stacked = np.einsum("nij,nim->njm", roots, equation.gradients[:, :, free], optimize=True)
    scale = np.sqrt((stacked**2).sum(axis=(0, 1)))
    scale = np.where(scale > 0, scale, 1.0)
    upper = np.linalg.qr((stacked / scale).reshape(-1, stacked.shape[2]), mode="r")
    _, sizes, right = np.linalg.svd(upper)
    told = sizes > UNTOLD * sizes[0]
    combined = right[told].T / sizes[told] / scale[:, None] * np.sqrt(len(equation.points))
    m, k, stay = len(free), int(told.sum()), np.flatnonzero(~free)
    turned = np.zeros((m, k + len(stay)))
    turned[np.ix_(np.flatnonzero(free), np.arange(k))] = combined
    turned[stay, k + np.arange(len(stay))] = 1.0
    n, d = equation.points.shape
    gradients = (equation.gradients.reshape(n * d, m) @ turned).reshape(n, d, -1)
    return replace(equation, gradients=gradients), turned


@dataclass(frozen=True)
class Solution:
    """Where Gauss–Newton ended.

    Attributes
    ----------
    coefficients
        Shape ``(m,)``.
    residual
        Root mean square of the weighted residual, divided by that of ∇V: the mean of
        ``∣∇V·(f + D∇V)∣ / (∣∇V∣ ∣f∣)``.
    converged
        Whether the last step was too small to matter.
    """

    coefficients: np.ndarray
    residual: float
    converged: bool


def equation_at(
    basis: Basis, x: np.ndarray, dynamics: Dynamics, *, attractor: np.ndarray | None = None
) -> HamiltonJacobi:
    """The equation at those of some points, shape ``(n, d)``, where f does not vanish.

    Where D has no inverse, the attractor, shape ``(d,)``, tells in which metric that is seen.
    """
    flow, noise = dynamics.drift(x), dynamics.diffusion
    measure = noise if attractor is None else measure_at(dynamics, attractor)
    speed = np.sqrt(measure.squared_speed(x, flow))
    moving = speed > 1e-9 * speed.max()
    return HamiltonJacobi(
        x[moving], basis.gradients(x[moving]), flow[moving], noise, 1 / speed[moving], measure
    )


def gauss_newton(
    equation: HamiltonJacobi,
    start: np.ndarray,
    *,
    free: np.ndarray | None = None,
    steps: int = 60,
    tolerance: float = 1e-13,
) -> Solution:
    """Minimise the sum of squares of the residual, relative to the size of ∇V.

    The residual alone would draw a bad start to V = 0, which solves the equation, too.

    Parameters
    ----------
    equation
        At points.
    start
        Coefficients to start from, shape ``(m,)``.
    free
        Which coefficients may change, as a mask; default all.
    steps, tolerance
        Most steps, and the relative change of the coefficients at which to end.
    """
    coefficients = start.copy()
    free = np.ones(len(start), dtype=bool) if free is None else free
    scale = equation.sizes()
    scale = np.where(scale > 0, scale, 1.0)
    residual, size = _relative(equation, coefficients)
    converged = not free.any()
    for _ in range(steps if free.any() else 0):
        if size == 0:
            converged = True
            break
        slant = equation.size_jacobian(coefficients)[free]
        jacobian = equation.jacobian(coefficients)[:, free] - np.outer(residual, slant)
        step = _least_squares(jacobian / (size * scale[free]), -residual) / scale[free]
        length = 1.0
        while True:
            trial = coefficients.copy()
            trial[free] += length * step
            attempt, size = _relative(equation, trial)
            if np.linalg.norm(attempt) < np.linalg.norm(residual) or length < 1e-3:
                break
            length /= 2
        improved = np.linalg.norm(attempt) < np.linalg.norm(residual)
        change = np.linalg.norm(length * step * scale[free])
        reached = np.linalg.norm(coefficients * scale)
        if improved:
            gain = 1 - float(np.linalg.norm(attempt)) / max(float(np.linalg.norm(residual)), 1e-300)
            coefficients, residual = trial, attempt
        if not improved or change <= tolerance * reached or gain < 1e-7:
            converged = True
            break
    return Solution(coefficients, relative_residual(equation, coefficients), converged)


def _relative(equation: HamiltonJacobi, coefficients: np.ndarray) -> tuple[np.ndarray, float]:
    """The residual over rms of ∇V, shape ``(n,)``, and that rms."""
    size = equation.size(coefficients)
    return equation.residual(coefficients) / max(size, 1e-300), size


def _least_squares(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """One step; directions that the points do not determine are left as they are.

    By the normal equations, ten times as fast, where these are good enough: the next step corrects this one.
    """
    try:
        factor, lower = scipy.linalg.cho_factor(matrix.T @ matrix, check_finite=False)
    except scipy.linalg.LinAlgError:
        pass
    else:
        diagonal = np.diag(factor)
        if diagonal.min() > INDEPENDENT * diagonal.max():
            found: np.ndarray = scipy.linalg.cho_solve((factor, lower), matrix.T @ right, check_finite=False)
            return found
    return np.linalg.lstsq(matrix, right, rcond=1e-11)[0]


def relative_residual(equation: HamiltonJacobi, coefficients: np.ndarray) -> float:
    """Rms of the weighted residual over rms of ∇V; infinite for V = 0, or all but 0."""
    gradient = equation.slopes(coefficients)
    squared = equation.measure.steepness(equation.points, gradient)
    if not np.sqrt((equation.weight**2 * squared).mean()) > VANISHING:
        return np.inf
    return float(np.sqrt((equation.residual(coefficients) ** 2).mean() / squared.mean()))


def sensitivity(
    equation: HamiltonJacobi, coefficients: np.ndarray, *, field_terms: np.ndarray, components: np.ndarray
) -> np.ndarray:
    """How the coefficients of V follow those of f, to first order: ∂ξ/∂c, shape ``(m, p)``.

    Parameters
    ----------
    equation, coefficients
        A solution.
    field_terms
        The functions of the p coefficients of f at the points, shape ``(n, p)``.
    components
        Shape ``(p,)``: the component of f that each belongs to.
    """
    gradient = equation.slopes(coefficients)
    forcing = equation.weight[:, None] * gradient[:, components] * field_terms
    jacobian = equation.jacobian(coefficients)
    scale = np.linalg.norm(jacobian, axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    return -np.linalg.lstsq(jacobian / scale, forcing, rcond=1e-11)[0] / scale[:, None]
