"""D, the noise of a system: what it does to momenta and velocities, and its inverse where it has one.

``dx = f(x) dt + √ε σ(x) dW`` with ``D = σσᵀ``, in the sense of Itô. Every product with D, its root or its
inverse is taken at points, so that a constant D, `Diffusion`, and one that is a formula of the states,
`siq.dynamics.state_noise.StateNoise`, are used alike. Who can do with a constant D only asks for its
`matrix`, and another one refuses.

Along characteristics, paths and in the prefactor of escape times stand derivatives of D with a momentum p:
``pull`` is ``pᵀ(∂_k D)p``, ``turn`` is ``(∂_k D)p``, ``bend`` is ``pᵀ(∂_k ∂_l D)p``, and ``divergence`` is
``Σ_i ∂_i D_ij``. Of a constant D they vanish.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import sympy
from scipy.linalg import solve_triangular

from siq.dynamics.formulas import exact_number
from siq.errors import NumericalFailure


class NoiseField:
    """What follows from D and its derivatives at points, whatever D is."""

    def at(self, x: np.ndarray) -> np.ndarray:
        """D at points: ``(n, d)`` to ``(n, d, d)``."""
        raise NotImplementedError

    def derivatives(self, x: np.ndarray) -> np.ndarray:
        """∂D_ij/∂x_k at points: ``(n, d)`` to ``(n, d, d, d)``, k last."""
        raise NotImplementedError

    def second_derivatives(self, x: np.ndarray) -> np.ndarray:
        """∂²D_ij/∂x_k∂x_l at points: ``(n, d)`` to ``(n, d, d, d, d)``, k and l last."""
        raise NotImplementedError

    def pull(self, x: np.ndarray, momenta: np.ndarray) -> np.ndarray:
        """``pᵀ(∂_k D)p`` at points and momenta ``(n, d)``: shape ``(n, d)``."""
        return np.asarray(np.einsum("ni,nijk,nj->nk", momenta, self.derivatives(x), momenta))

    def turn(self, x: np.ndarray, momenta: np.ndarray) -> np.ndarray:
        """``((∂_k D)p)_i`` at points and momenta ``(n, d)``: shape ``(n, d, d)``, i before k."""
        return np.asarray(np.einsum("nijk,nj->nik", self.derivatives(x), momenta))

    def bend(self, x: np.ndarray, momenta: np.ndarray) -> np.ndarray:
        """``pᵀ(∂_k ∂_l D)p`` at points and momenta ``(n, d)``: shape ``(n, d, d)``."""
        return np.asarray(np.einsum("ni,nijkl,nj->nkl", momenta, self.second_derivatives(x), momenta))

    def divergence(self, x: np.ndarray) -> np.ndarray:
        """``Σ_i ∂_i D_ij`` at points: ``(n, d)`` to ``(n, d)``."""
        return np.asarray(np.einsum("nijj->ni", self.derivatives(x)))


@dataclass(frozen=True)
class NoiseInUnits(NoiseField):
    """D of the states ``x = center + units y`` as a D of y, times a factor for the unit of time.

    Attributes
    ----------
    noise
        D of x.
    center, units
        Shape ``(d,)`` and ``(d, d)``.
    factor
        By which ``units⁻¹ D units⁻ᵀ`` is multiplied.
    """

    noise: Diffusion
    center: np.ndarray
    units: np.ndarray
    factor: float

    @cached_property
    def _inverse(self) -> np.ndarray:
        return np.linalg.inv(self.units)

    def _points(self, y: np.ndarray) -> np.ndarray:
        return np.asarray(self.center + y @ self.units.T)

    def at(self, y: np.ndarray) -> np.ndarray:
        """D at points: ``(n, d)`` to ``(n, d, d)``."""
        return np.asarray(self.factor * self._inverse @ self.noise.at(self._points(y)) @ self._inverse.T)

    def whitening_at(self, y: np.ndarray) -> np.ndarray:
        """σ⁻¹ at points: ``(n, d)`` to ``(n, d, d)``; raises as that of the noise."""
        own = self.noise.whitening_at(self._points(y)) @ self.units
        return np.asarray(own / np.sqrt(self.factor))

    def derivatives(self, y: np.ndarray) -> np.ndarray:
        """∂D_ij/∂y_k at points: ``(n, d)`` to ``(n, d, d, d)``, k last."""
        inner = self.noise.derivatives(self._points(y))
        left, units = self._inverse, self.units
        return np.asarray(
            self.factor * np.einsum("ai,bj,nijk,kl->nabl", left, left, inner, units, optimize=True)
        )

    def second_derivatives(self, y: np.ndarray) -> np.ndarray:
        """∂²D_ij/∂y_k∂y_l at points: ``(n, d)`` to ``(n, d, d, d, d)``, k and l last."""
        inner = self.noise.second_derivatives(self._points(y))
        left, units = self._inverse, self.units
        turned = np.einsum("ai,bj,nijkl,kc,ld->nabcd", left, left, inner, units, units, optimize=True)
        return np.asarray(self.factor * turned)


@dataclass(frozen=True, eq=False)
class Diffusion(NoiseField):
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
    def constant(self) -> bool:
        """Whether D is the same everywhere, so that `matrix`, `root` and their kin may be asked for."""
        return True

    @property
    def formulas(self) -> tuple[tuple[sympy.Expr, ...], ...]:
        """D row by row as formulas."""
        return tuple(tuple(exact_number(float(entry)) for entry in row) for row in self.matrix)

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

    def root_at(self, x: np.ndarray) -> np.ndarray:
        """σ at points: ``(n, d)`` to ``(n, d, d)``."""
        return np.broadcast_to(self.root, (len(x), *self.matrix.shape))

    def whitening_at(self, x: np.ndarray) -> np.ndarray:
        """σ⁻¹ at points: ``(n, d)`` to ``(n, d, d)``; raises as `whitening`."""
        return np.broadcast_to(self.whitening, (len(x), *self.matrix.shape))

    def positive_at(self, x: np.ndarray) -> np.ndarray:
        """Mask of the points ``(n, d)`` at which D is a covariance: shape ``(n,)``; here everywhere."""
        return np.full(len(x), True)

    def precision_at(self, x: np.ndarray) -> np.ndarray:
        """D⁻¹ at points: ``(n, d)`` to ``(n, d, d)``; raises as `precision`."""
        return np.broadcast_to(self.precision, (len(x), *self.matrix.shape))

    def frozen(self, point: np.ndarray) -> Diffusion:
        """The constant D that is the one at a point, shape ``(d,)``."""
        del point  # D is constant
        return self

    def derivatives(self, x: np.ndarray) -> np.ndarray:
        """∂D_ij/∂x_k at points: ``(n, d)`` to ``(n, d, d, d)``, k last."""
        return np.zeros((len(x), *(self.dimension,) * 3))

    def second_derivatives(self, x: np.ndarray) -> np.ndarray:
        """∂²D_ij/∂x_k∂x_l at points: ``(n, d)`` to ``(n, d, d, d, d)``, k and l last."""
        return np.zeros((len(x), *(self.dimension,) * 4))

    def in_units(self, center: np.ndarray, units: np.ndarray, factor: float) -> NoiseInUnits:
        """The same noise as one of y, ``x = center + units y``; see `NoiseInUnits`."""
        return NoiseInUnits(self, center, units, factor)

    def kicks(self, x: np.ndarray, numbers: np.ndarray) -> np.ndarray:
        """``σ(x) ξ`` of components: states and numbers ``(d, ...)`` to ``(d, ...)``, for simulations."""
        del x  # D is constant
        return np.asarray(self.root @ numbers)

    def intensity(self, rate: np.ndarray) -> float:
        """ε of a noise whose covariance per unit of time, shape ``(d, d)``, is about ε D."""
        return float(np.trace(self.precision @ rate)) / self.dimension
