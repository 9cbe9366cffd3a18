"""D, the noise of a system: what it does to momenta and velocities, and its inverse where it has one.

``dx = f(x) dt + √ε σ(x) dW`` with ``D = σσᵀ``. Every product with D, its root or its inverse is taken here,
so that a D which depends on the state, or does not reach every state, changes this module and no other.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import solve_triangular

from siq.errors import NumericalFailure


@dataclass(frozen=True, eq=False)
class Diffusion:
    """A constant D.

    Attributes
    ----------
    matrix
        D, shape ``(d, d)``, in the states' units squared per unit of time; symmetric and positive
        semi-definite.

    Raises
    ------
    ValueError
        When the matrix is not square, not symmetric, or not positive semi-definite.

    Examples
    --------
    >>> noise = Diffusion(np.diag([1.0, 4.0]))
    >>> noise.push(np.zeros((1, 2)), np.array([[1.0, 1.0]]))
    array([[1., 4.]])
    >>> noise.squared_speed(np.zeros((1, 2)), np.array([[1.0, 2.0]]))
    array([2.])
    """

    matrix: np.ndarray

    def __post_init__(self) -> None:
        matrix = np.asarray(self.matrix, dtype=float)
        if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1]:
            raise ValueError("the diffusion is not a square matrix; give one row and one column a state")
        scale = np.sqrt(np.where(np.diag(matrix) > 0, np.diag(matrix), 1.0))
        scaled = matrix / np.outer(scale, scale)
        rounding = 1e-12  # of numbers of size one, and some products of them
        if not np.isfinite(scaled).all() or np.abs(scaled - scaled.T).max() > rounding:
            raise ValueError("the diffusion is not symmetric; correct the matrix")
        if np.linalg.eigvalsh(scaled)[0] < -rounding:
            raise ValueError("the diffusion is not positive semi-definite; correct the matrix")
        object.__setattr__(self, "matrix", (matrix + matrix.T) / 2)

    @classmethod
    def identity(cls, dimension: int) -> Diffusion:
        """D = 1, for states of one unit."""
        return cls(np.eye(dimension))

    @property
    def dimension(self) -> int:
        """Number of states, d."""
        return len(self.matrix)

    @property
    def scale(self) -> np.ndarray:
        """√D_ii, shape ``(d,)``: the unit of each state in which its noise is one; 1 where there is none."""
        return np.sqrt(np.where(np.diag(self.matrix) > 0, np.diag(self.matrix), 1.0))

    @cached_property
    def regular(self) -> bool:
        """Whether noise reaches every state directly, so that D has an inverse."""
        scaled = self.matrix / np.outer(self.scale, self.scale)
        return bool(np.linalg.eigvalsh(scaled)[0] > 1e-12)  # rounding of units of size one

    @cached_property
    def root(self) -> np.ndarray:
        """σ with ``D = σσᵀ``, shape ``(d, d)``: lower triangular where D is regular."""
        if self.regular:
            return np.linalg.cholesky(self.matrix)
        values, vectors = np.linalg.eigh(self.matrix)
        return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))

    @cached_property
    def precision(self) -> np.ndarray:
        """D⁻¹, shape ``(d, d)``.

        Raises
        ------
        NumericalFailure
            Where noise does not reach every state.
        """
        self._check_inverse()
        return np.linalg.inv(self.matrix)

    @cached_property
    def whitening(self) -> np.ndarray:
        """σ⁻¹, shape ``(d, d)``: in the states ``σ⁻¹ x`` the noise is the same in every direction.

        Raises
        ------
        NumericalFailure
            Where noise does not reach every state.
        """
        self._check_inverse()
        return np.asarray(solve_triangular(self.root, np.eye(self.dimension), lower=True))

    def _check_inverse(self) -> None:
        if not self.regular:
            raise NumericalFailure("the noise does not reach every state: D has no inverse")

    def extended(self, count: int) -> Diffusion:
        """The same noise in a system of `count` further states, which it does not reach."""
        return Diffusion(np.pad(self.matrix, (0, count)))

    def at(self, x: np.ndarray) -> np.ndarray:
        """D at points: ``(n, d)`` to ``(n, d, d)``."""
        return np.broadcast_to(self.matrix, (len(x), *self.matrix.shape))

    def push(self, x: np.ndarray, momenta: np.ndarray) -> np.ndarray:
        """``D(x) p`` at points ``(n, d)`` and momenta: the velocity that a momentum, or ∇V, adds.

        There may be several momenta at a point, shape ``(n, ..., d)``.
        """
        del x  # D is constant
        return momenta @ self.matrix

    def steepness(self, x: np.ndarray, momenta: np.ndarray) -> np.ndarray:
        """``p·D(x) p`` at points ``(n, d)`` and momenta ``(n, ..., d)``: shape ``(n, ...)``."""
        return np.asarray((momenta * self.push(x, momenta)).sum(axis=-1))

    def squared_speed(self, x: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """``v·D(x)⁻¹ v`` at points and velocities ``(n, d)``: shape ``(n,)``, no state's unit matters in it.

        Raises
        ------
        NumericalFailure
            Where D has no inverse.
        """
        del x  # D is constant
        return np.asarray(np.einsum("ni,ij,nj->n", velocity, self.precision, velocity))

    def intensity(self, rate: np.ndarray) -> float:
        """ε of a noise whose covariance per unit of time, shape ``(d, d)``, is about ε D."""
        return float(np.trace(self.precision @ rate)) / self.dimension
