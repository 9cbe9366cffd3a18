"""The decomposition over one hidden layer of random tanh units, of which the output weights are solved for.

A short training of the two networks (paper, section 2.2) leaves V far from exact, but on the right branch of
the Hamilton–Jacobi equation ``∇V·(f + D∇V) = 0``. From there on no steps of descent are needed. Over hidden
units that are drawn at random and stay as they are (random features; Rahimi and Recht 2007, NeurIPS 20) f is
linear in the output weights, and follows from the pairs by least squares; the equation is quadratic in those
of V, and a few steps of Gauss–Newton end where it holds; ``g = f + D∇V`` is linear
again. What comes out are networks of the paper's form, ``V = η_v (V^NN(y) + |y|²)``, with one hidden layer.

Neither the Hessian of V at the attractors nor an f that is identified elsewhere takes part. Whether the
branch is the right one is asked where f comes to rest: about an attractor A the quasipotential has
``∂f(A) + 2D ∂²V(A)`` with the eigenvalues of ``-∂f(A)ᵀ``, so that paths of least action leave it. On a false
branch, where V is flat along a direction, some of them do not.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import scipy.linalg

from siq.data.recordings import SnapshotPairs
from siq.networks.decomposition import TrainedNetworks
from siq.numerics.integration import runge_kutta_step
from siq.quasipotential.hamilton_jacobi import HamiltonJacobi
from siq.systems.diffusion import Diffusion
from siq.systems.equilibria import find_equilibria

if TYPE_CHECKING:  # needs torch, which the mathematics does without
    from siq.networks.training import TrainingData

logger = logging.getLogger(__name__)

SPREADS = (0.1, 0.2, 0.4, 0.8)  # of the units' weights on normalised states; the held-out pairs choose
CORRECTIONS = 3  # of f for the integrator's error; each gains about two digits
SINGULAR_RATIO = 1e-12  # damping of least squares: combinations of units that the points leave open
SLOW_SHARE = 0.04  # of the points, by their speed: below it residuals are not divided by the speed alone
RIDGE = 1e-8  # of the mean square gradient of a unit: how far the start may be from the networks' own V
POINTS_PER_UNIT = 10  # representative pairs that are used, at most
STARTS = 100  # points, the slowest among them, from which fixed points of f are sought
# Measured on the paper's archetypal system in three dimensions, in 50 runs and some trials before them.
STEPS = 25  # of Gauss–Newton; a right start takes about ten
MAX_RESIDUAL = 1e-3  # median of |∇V·(f + D∇V)|/(|∇V||f|): about 1e-5 on the right branch
# Of the slowest rate of approach, how fast paths of least action leave: 1 on the right branch, -1 where V is
# flat along that direction, and in between a choice.
ESCAPE_SHARE = 0.5


@dataclass(frozen=True)
class UnitBasis:
    """Random tanh units ``tanh(y W + b)`` and ``|y|²`` of normalised states ``y = (x - μ)/σ``.

    Attributes
    ----------
    weights, biases
        W and b, shapes ``(d, units)`` and ``(units,)``.
    mean, scale
        μ and σ, shape ``(d,)``.
    """

    weights: np.ndarray
    biases: np.ndarray
    mean: np.ndarray
    scale: np.ndarray

    def hidden(self, x: np.ndarray) -> np.ndarray:
        """The units alone, shape ``(n, units)``."""
        return np.tanh(self._normalised(x) @ self.weights + self.biases)

    def gradients(self, x: np.ndarray) -> np.ndarray:
        """Points ``(n, d)`` to gradients ``(n, d, m)``."""
        of_units = (1 - self.hidden(x) ** 2)[:, None] * (self.weights / self.scale[:, None])
        return np.concatenate([of_units, (2 * self._normalised(x) / self.scale)[:, :, None]], axis=2)

    def hessians(self, x: np.ndarray) -> np.ndarray:
        """Points ``(n, d)`` to Hessians ``(n, d, d, m)``."""
        hidden, slopes = self.hidden(x), self.weights / self.scale[:, None]
        of_units = (-2 * hidden * (1 - hidden**2))[:, None, None] * slopes[:, None] * slopes
        square = np.broadcast_to(np.diag(2 / self.scale**2)[:, :, None], (*of_units.shape[:3], 1))
        return np.concatenate([of_units, square], axis=3)

    def design(self, x: np.ndarray) -> np.ndarray:
        """Functions for f, ``[tanh(y W + b), 1, y]``: points ``(n, d)`` to ``(n, units + 1 + d)``."""
        return np.column_stack([self.hidden(x), np.ones(len(x)), self._normalised(x)])

    def _normalised(self, x: np.ndarray) -> np.ndarray:
        return (x - self.mean) / self.scale


class OutputWeights:
    """The output weights of one run, solved for from where its networks have come.

    Parameters
    ----------
    data
        The pairs of the run.
    diffusion
        D, constant.
    units
        Number of units.
    generator
        Draws the units, and the points where there are too many.
    """

    def __init__(
        self,
        data: TrainingData,
        *,
        diffusion: Diffusion,
        units: int,
        generator: np.random.Generator,
    ) -> None:
        self.diffusion = diffusion
        most = POINTS_PER_UNIT * units
        pairs, others = (
            part
            if len(part.h) <= most
            else part.take(np.sort(generator.choice(len(part.h), most, replace=False)))
            for part in (data.representative, data.held_out)
        )
        mean, scale = pairs.x0.mean(axis=0), pairs.x0.std(axis=0)
        weights = generator.normal(size=(len(mean), units))
        biases = generator.uniform(-2, 2, units)
        observed, self.field_error = (others.xh - others.x0) / others.h[:, None], np.inf
        for spread in SPREADS:
            basis = UnitBasis(spread * weights, spread * biases, mean, scale)
            coefficients = _field_coefficients(basis, pairs)
            rest = observed - _mean_velocity(basis, coefficients, others.x0, others.h)
            error = float(np.sqrt((rest**2).sum() / (observed**2).sum()))
            logger.info("units spread by %g: held-out error of f %.1e", spread, error)
            if error < self.field_error:
                self.field_error, self.basis, self.coefficients = error, basis, coefficients
        self.points = pairs.x0
        flow = self.drift(self.points)
        self.squared_speed = diffusion.squared_speed(self.points, flow)
        # Where f vanishes so does what is divided by its speed; about fixed points everything counts alike.
        weight = 1 / (self.squared_speed + np.quantile(self.squared_speed, SLOW_SHARE))
        gradients = self.basis.gradients(self.points)
        self._equation = HamiltonJacobi(self.points, gradients, flow, diffusion, weight, diffusion)

    def drift(self, x: np.ndarray) -> np.ndarray:
        """f at points ``(n, d)``, shape ``(n, d)``."""
        return self.basis.design(x) @ self.coefficients

    def jacobian(self, x: np.ndarray) -> np.ndarray:
        """∂f_i/∂x_j at points ``(n, d)``, shape ``(n, d, d)``."""
        units = len(self.basis.biases)
        slopes = self.basis.gradients(x)[:, :, :units] @ self.coefficients[:units]
        return np.swapaxes(slopes + self.coefficients[units + 1 :] / self.basis.scale[:, None], 1, 2)

    def hopeless(self) -> str | None:
        """Why no networks can lead to a solution, in words; None where they can."""
        if not self.field_error < 1:
            return (
                "f over random units is as far from the held-out pairs as no f at all;"
                " record with less noise, or leave out training.output_weights"
            )
        if not self._attractors:
            return (
                "f over random units comes to rest nowhere within the recorded states, so that the branch of"
                " V cannot be tested; leave out training.output_weights"
            )
        return None

    def accepted(self, networks: TrainedNetworks) -> TrainedNetworks | None:
        """Networks with the output weights solved for; None where they lead to a false branch, or cannot."""
        if self.hopeless() is not None:
            return None
        basis, equation = self.basis, self._equation
        n, d, m = equation.gradients.shape
        # V over the units as the networks have it, by its gradient; |y|² keeps the weight that it has there.
        flat = equation.gradients.reshape(n * d, m)
        _, circulatory, vector_field = networks.evaluate(self.points)
        slopes = (circulatory - vector_field) @ self.diffusion.precision
        steepness = float(networks.potential_scale[0, 0])
        units, rest = flat[:, :-1], slopes.ravel() - steepness * flat[:, -1]
        start = np.linalg.solve(units.T @ units + RIDGE * n * np.eye(m - 1), units.T @ rest)
        weights = equation.robust_fit(
            np.append(start, steepness), np.arange(m) < m - 1,
            rounds=1, finest=np.inf, steps=STEPS, orthonormal=True,
        )  # fmt: skip
        unweighted = replace(equation, weight=1 / np.sqrt(self.squared_speed))
        residual = float(np.median(unweighted.relative_residuals(weights)))
        logger.info("output weights: median Hamilton–Jacobi residual %.1e", residual)
        if not (residual < MAX_RESIDUAL and self._right_branch(weights)):
            return None
        circulatory = equation.flow + self.diffusion.push(self.points, equation.slopes(weights))
        of_g = _LeastSquares(basis.design(self.points)[:, :m]).solve(circulatory)
        layers = (basis.weights, basis.biases[None])
        return TrainedNetworks(
            potential=(layers, (weights[:-1, None] / steepness, np.zeros((1, 1)))),
            circulatory=(layers, (of_g[:-1], of_g[-1:])),
            mean=basis.mean[None],
            scale=basis.scale[None],
            potential_scale=np.array([[steepness]]),
            circulatory_scale=np.ones((1, 1)),
            diffusion=self.diffusion.matrix,
        )

    def _right_branch(self, weights: np.ndarray) -> bool:
        """Whether paths of least action leave every fixed point at which f comes to rest."""
        for attractor in self._attractors:
            slope = self.jacobian(attractor[None])[0]
            curvature = self.basis.hessians(attractor[None])[0] @ weights
            leaving = np.linalg.eigvals(slope + 2 * self.diffusion.matrix @ curvature).real.min()
            approach = -np.linalg.eigvals(slope).real.max()
            logger.info(
                "about %s paths leave at rates of %.2g, f approaches at %.2g", attractor, leaving, approach
            )
            if leaving < ESCAPE_SHARE * approach:
                return False
        return True

    @cached_property
    def _attractors(self) -> list[np.ndarray]:
        """Stable fixed points of f within the recorded states."""
        starts = self.points[np.argsort(self.squared_speed)[:: max(len(self.points) // STARTS, 1)]]
        box = np.stack([self.points.min(axis=0), self.points.max(axis=0)], axis=1)
        found = find_equilibria(self, starts, box=box, margin=0.0)
        return [one.position for one in found if one.kind == "attractor"]


class _LeastSquares:
    """Least squares with one matrix ``(n, m)`` and many right-hand sides, damped where it is singular."""

    def __init__(self, matrix: np.ndarray) -> None:
        self.rows, columns = matrix.shape
        damping = SINGULAR_RATIO * np.linalg.norm(matrix)
        self.q, self.r = np.linalg.qr(np.vstack([matrix, damping * np.eye(columns)]))

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Coefficients ``(m, s)`` of right-hand sides ``(n, s)``."""
        return np.asarray(scipy.linalg.solve_triangular(self.r, self.q[: self.rows].T @ right))


def _field_coefficients(basis: UnitBasis, pairs: SnapshotPairs) -> np.ndarray:
    """C of ``f = design(x) C``, from mean velocities of pairs; then from what the integrator is off by."""
    problem = _LeastSquares(basis.design(pairs.x0))
    velocity = (pairs.xh - pairs.x0) / pairs.h[:, None]
    coefficients = problem.solve(velocity)
    for _ in range(CORRECTIONS):
        rest = velocity - _mean_velocity(basis, coefficients, pairs.x0, pairs.h)
        coefficients = coefficients + problem.solve(rest)
    return coefficients


def _mean_velocity(basis: UnitBasis, coefficients: np.ndarray, x0: np.ndarray, h: np.ndarray) -> np.ndarray:
    """(Φ_h(x0) - x0)/h by one step of the classical Runge–Kutta rule, shape ``(n, d)``."""
    return (runge_kutta_step(lambda x: (basis.design(x.T) @ coefficients).T, x0.T, h).T - x0) / h[:, None]
