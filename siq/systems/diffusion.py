"""The diffusion D(x): constant, formulas of the states, singular; what it does to momenta and velocities.

``dx = f(x) dt + √ε σ(x) dW`` with ``D = σσᵀ``, in the sense of Itô. Every product with D, its root or its
inverse is taken at points, so that a constant D, `Diffusion`, and one that is a formula of the states,
`StateNoise`, are used alike. Who can do with a constant D only asks for its
`matrix`, and another one refuses.

Along characteristics, paths and in the prefactor of escape times stand derivatives of D with a momentum p:
``pull`` is ``pᵀ(∂_k D)p``, ``turn`` is ``(∂_k D)p``, ``bend`` is ``pᵀ(∂_k ∂_l D)p``, and ``divergence`` is
``Σ_i ∂_i D_ij``. Of a constant D they vanish.

``dx = f(x) dt + √ε σ(x) dW`` with ``D(x) = σσᵀ``, in the sense of Itô: the noise of a moment is that of the
state before it. Whether D is positive definite is looked at where it is used: no formula says it by itself.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import sympy
from scipy.linalg import solve_triangular

from siq.errors import NumericalFailure
from siq.systems.formulas import compile_formulas, exact_number, parse_formula


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


class StateNoise(Diffusion):
    """A D that depends on the state.

    Parameters
    ----------
    symbols
        The d states, in their order, as they stand in the formulas.
    rows
        D_ij as formulas, d rows of d.

    Raises
    ------
    ValueError
        When the formulas are not a symmetric matrix, or other names than the states stand in them.

    Examples
    --------
    >>> x, y = sympy.symbols("x y", real=True)
    >>> noise = StateNoise((x, y), ((1 + x**2, 0), (0, 1)))
    >>> noise.push(np.array([[2.0, 0.0]]), np.array([[1.0, 1.0]]))
    array([[5., 1.]])
    >>> noise.pull(np.array([[2.0, 0.0]]), np.array([[1.0, 1.0]]))
    array([[4., 0.]])
    """

    def __init__(self, symbols: Sequence[sympy.Symbol], rows: Sequence[Sequence[sympy.Expr | float]]) -> None:
        d = len(symbols)
        formulas = tuple(tuple(sympy.sympify(entry) for entry in row) for row in rows)
        if len(formulas) != d or any(len(row) != d for row in formulas):
            raise ValueError("the diffusion is not a square matrix; give one row and one column a state")
        if any(formulas[i][j] - formulas[j][i] != 0 for i in range(d) for j in range(i)) and any(
            sympy.simplify(formulas[i][j] - formulas[j][i]) != 0 for i in range(d) for j in range(i)
        ):
            raise ValueError("the diffusion is not symmetric; correct the matrix")
        unknown = set().union(*(entry.free_symbols for row in formulas for entry in row)) - set(symbols)
        if unknown:
            names = ", ".join(sorted(map(str, unknown)))
            raise ValueError(f"the diffusion depends on {names}; let it depend on the states alone")
        object.__setattr__(self, "symbols", tuple(symbols))
        object.__setattr__(self, "_formulas", formulas)

    symbols: tuple[sympy.Symbol, ...]
    _formulas: tuple[tuple[sympy.Expr, ...], ...]

    def __repr__(self) -> str:
        return f"StateNoise({self.symbols}, {self._formulas})"

    @property
    def matrix(self) -> np.ndarray:
        """There is none.

        Raises
        ------
        NumericalFailure
            Always.
        """
        raise NumericalFailure(
            "this is worked out only for a noise that is the same everywhere; here D depends on the state"
        )

    @property
    def dimension(self) -> int:
        """Number of states, d."""
        return len(self.symbols)

    @property
    def constant(self) -> bool:
        """No."""
        return False

    @property
    def formulas(self) -> tuple[tuple[sympy.Expr, ...], ...]:
        """D row by row as formulas."""
        return self._formulas

    @cached_property
    def regular(self) -> bool:
        """Whether no state is left out by its formulas; where D is singular otherwise is told at points."""
        return all(any(entry != 0 for entry in row) for row in self._formulas)

    @cached_property
    def diagonal(self) -> bool:
        """Whether the noise of each state is its own."""
        return all(
            entry == 0 for i, row in enumerate(self._formulas) for j, entry in enumerate(row) if i != j
        )

    def extended(self, count: int) -> Diffusion:
        """The same noise in a system of `count` further states, which it does not reach."""
        further = sympy.symbols(f"_further:{count}", real=True)
        rows = [(*row, *(sympy.S.Zero,) * count) for row in self._formulas]
        nothing = [(sympy.S.Zero,) * (self.dimension + count)] * count
        return StateNoise((*self.symbols, *further), [*rows, *nothing])

    def frozen(self, point: np.ndarray) -> Diffusion:
        """The constant D that is the one at a point, shape ``(d,)``.

        Raises
        ------
        NumericalFailure
            Where D is no covariance.
        """
        matrix = self.at(np.asarray(point, dtype=float)[None])[0]
        try:
            return Diffusion(matrix)
        except ValueError:
            raise NumericalFailure(_indefinite(point)) from None

    def at(self, x: np.ndarray) -> np.ndarray:
        """D at points: ``(n, d)`` to ``(n, d, d)``."""
        return self._tensor(self._values, x, 2)

    def derivatives(self, x: np.ndarray) -> np.ndarray:
        """∂D_ij/∂x_k at points: ``(n, d)`` to ``(n, d, d, d)``, k last."""
        return self._tensor(self._first, x, 3)

    def second_derivatives(self, x: np.ndarray) -> np.ndarray:
        """∂²D_ij/∂x_k∂x_l at points: ``(n, d)`` to ``(n, d, d, d, d)``, k and l last."""
        return self._tensor(self._second, x, 4)

    def push(self, x: np.ndarray, momenta: np.ndarray) -> np.ndarray:
        """``D(x) p`` at points ``(n, d)`` and momenta ``(n, ..., d)``."""
        if not len(x):
            return np.zeros(momenta.shape)
        n, d = x.shape
        return np.asarray((momenta.reshape(n, -1, d) @ self.at(x)).reshape(momenta.shape))

    def root_at(self, x: np.ndarray) -> np.ndarray:
        """σ at points, lower triangular: ``(n, d)`` to ``(n, d, d)``.

        Raises
        ------
        NumericalFailure
            Where D is not positive definite, or where it leaves a state out.
        """
        self._check_inverse()
        matrices = self.at(x)
        try:
            root = np.linalg.cholesky(matrices)
        except np.linalg.LinAlgError:
            root = np.full(matrices.shape, np.nan)
        if not np.isfinite(root).all():
            lowest = np.array([_lowest(matrix) for matrix in matrices])
            raise NumericalFailure(_indefinite(x[np.argmin(lowest)]))
        return root

    def whitening_at(self, x: np.ndarray) -> np.ndarray:
        """σ⁻¹ at points: ``(n, d)`` to ``(n, d, d)``; raises as `root_at`."""
        return np.linalg.inv(self.root_at(x))

    def positive_at(self, x: np.ndarray) -> np.ndarray:
        """Mask of the points ``(n, d)`` at which D is a covariance: shape ``(n,)``.

        Far from the states that they were learned from formulas may be none. Where they leave no state out,
        D has to be positive definite.
        """
        matrices = self.at(x)
        finite = np.isfinite(matrices).all(axis=(1, 2))
        values = np.linalg.eigvalsh(np.where(finite[:, None, None], matrices, 0.0))
        least = 0.0 if self.regular else -1e-12 * np.abs(values).max(axis=1)  # rounding
        return np.asarray(finite & (values[:, 0] > least))

    def precision_at(self, x: np.ndarray) -> np.ndarray:
        """D⁻¹ at points: ``(n, d)`` to ``(n, d, d)``; raises as `root_at`."""
        whitening = self.whitening_at(x)
        return whitening.transpose(0, 2, 1) @ whitening

    def squared_speed(self, x: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """``v·D(x)⁻¹ v`` at points and velocities ``(n, d)``: shape ``(n,)``; raises as `root_at`."""
        whitened = (self.whitening_at(x) @ velocity[:, :, None])[:, :, 0]
        return np.asarray((whitened**2).sum(axis=1))

    def kicks(self, x: np.ndarray, numbers: np.ndarray) -> np.ndarray:
        """``σ(x) ξ`` of components: states and numbers ``(d, ...)`` to ``(d, ...)``, for simulations.

        Raises
        ------
        NumericalFailure
            Where D is no covariance.
        """
        d = self.dimension
        values = self._values(x)
        finite = np.isfinite(x).all(axis=0)  # a state that has run away is told by who simulates
        if self.diagonal:
            variances = values[:: d + 1]
            if not (variances[:, finite] >= 0).all():
                worst = int(np.argmin(np.where(finite, variances.min(axis=0), np.inf)))
                raise NumericalFailure(_indefinite(x[:, worst]))
            return np.asarray(np.sqrt(variances) * numbers)
        matrices = np.where(finite, values, np.eye(d).reshape(d * d, 1)).T.reshape(-1, d, d)
        levels, vectors = np.linalg.eigh(matrices)
        rounding = -1e-12 * np.abs(levels).max(axis=1)  # of numbers of one size, and some products of them
        if (levels[:, 0] < rounding).any():
            raise NumericalFailure(_indefinite(x[:, int(np.argmin(levels[:, 0]))]))
        along = np.einsum("nji,jn->ni", vectors, numbers) * np.sqrt(np.maximum(levels, 0.0))
        kicks: np.ndarray = np.einsum("nij,nj->in", vectors, along)
        return np.where(finite, kicks, np.nan)

    def _tensor(self, function: Callable[[np.ndarray], np.ndarray], x: np.ndarray, order: int) -> np.ndarray:
        values = function(np.ascontiguousarray(x.T))
        return values.T.reshape(len(x), *(self.dimension,) * order)

    @cached_property
    def _values(self) -> Callable[[np.ndarray], np.ndarray]:
        return compile_formulas(self._flat, self.symbols)

    @cached_property
    def _first(self) -> Callable[[np.ndarray], np.ndarray]:
        return compile_formulas(_derivatives(self._flat, self.symbols), self.symbols)

    @cached_property
    def _second(self) -> Callable[[np.ndarray], np.ndarray]:
        first = _derivatives(self._flat, self.symbols)
        return compile_formulas(_derivatives(first, self.symbols), self.symbols)

    @property
    def _flat(self) -> list[sympy.Expr]:
        return [entry for row in self._formulas for entry in row]


def state_noise(symbols: Sequence[sympy.Symbol], rows: Sequence[Sequence[sympy.Expr | float]]) -> Diffusion:
    """D of formulas: constant where no state stands in them. Raises as `StateNoise` and `Diffusion`."""
    found = StateNoise(symbols, rows)
    if any(entry.free_symbols for row in found.formulas for entry in row):
        return found
    return Diffusion(np.array([[float(entry) for entry in row] for row in found.formulas]))


def diffusion_rows_of(diffusion: Diffusion) -> list[list[str | float]]:
    """D as plain data, row by row: numbers where it is constant, formulas elsewhere."""
    if diffusion.constant:
        return [[float(entry) for entry in row] for row in diffusion.matrix]
    return [[str(entry) for entry in row] for row in diffusion.formulas]


def diffusion_of_rows(symbols: Sequence[sympy.Symbol], rows: Sequence[Sequence[str | float]]) -> Diffusion:
    """D from what `diffusion_rows_of` made; raises as `StateNoise` and `Diffusion`, or `FormulaError`."""
    names = {each.name: each for each in symbols}
    if all(not isinstance(entry, str) for row in rows for entry in row):
        return Diffusion(np.array(rows, dtype=float))
    return state_noise(symbols, [[parse_formula(entry, names) for entry in row] for row in rows])


def _derivatives(expressions: Sequence[sympy.Expr], symbols: Sequence[sympy.Symbol]) -> list[sympy.Expr]:
    return [expression.diff(symbol) for expression in expressions for symbol in symbols]


def _lowest(matrix: np.ndarray) -> float:
    """The smallest eigenvalue, in units in which the diagonal is one where it is positive."""
    if not np.isfinite(matrix).all():
        return -np.inf
    scale = np.sqrt(np.where(np.diag(matrix) > 0, np.diag(matrix), 1.0))
    return float(np.linalg.eigvalsh(matrix / np.outer(scale, scale))[0])


def _indefinite(point: np.ndarray) -> str:
    place = ", ".join(f"{value:.4g}" for value in point)
    return (
        f"D is not positive definite at ({place}): give formulas that are positive wherever states are, or"
        " leave the states beyond out"
    )
