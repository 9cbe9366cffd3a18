"""D as formulas of the states: noise that is stronger here than there.

``dx = f(x) dt + √ε σ(x) dW`` with ``D(x) = σσᵀ``, in the sense of Itô: the noise of a moment is that of the
state before it. Whether D is positive definite is looked at where it is used: no formula says it by itself.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property

import numpy as np
import sympy

from siq.dynamics.diffusion import Diffusion
from siq.dynamics.formulas import compile_formulas, parse_formula
from siq.errors import NumericalFailure


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
