"""The diffusion D(x) of ``dx = f(x) dt + √ε σ(x) dW``, with ``D = σσᵀ``, in the sense of Itô.

D is constant, or formulas of the states, and either may be singular: noise then acts on some states only. All
products with D, its root or its inverse are taken at points, so that every D is used alike. Who can do with a
constant D only asks for its `matrix`, and another one refuses. Whether formulas are positive definite is
looked at where they are used: no formula says it by itself.

Along characteristics, paths and in the prefactor of escape times stand derivatives of D with a momentum p:
``p·D p``, ``p·(∂_k D) p`` and ``p·(∂_k ∂_l D) p`` (`Diffusion.contract`), ``(∂_k D) p`` (`Diffusion.turn`)
and ``Σ_i ∂_i D_ij`` (`Diffusion.divergence`). All but the first vanish where D is constant.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property

import numpy as np
import sympy
from scipy.linalg import solve_triangular

from siq.errors import Fault, NumericalFailure
from siq.numerics.randomness import positive
from siq.systems.formulas import compile_formulas, exact_number, parse_formula

ROUNDING = 1e-12  # of numbers of size one, and some products of them

LARGEST_STATE = 1e30  # numerical: its eighth power, as in a series, is a number still, and so is its inverse


class Diffusion:
    """D(x): ``Diffusion(matrix)`` is constant, `Diffusion.of_formulas` depends on the state.

    Parameters
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
    >>> x, y = sympy.symbols("x y", real=True)
    >>> noise = Diffusion.of_formulas((x, y), ((1 + x**2, 0), (0, 1)))
    >>> noise.contract(np.array([[2.0, 0.0]]), np.array([[1.0, 1.0]]), order=1)
    array([[4., 0.]])
    """

    dimension: int
    constant: bool
    """Whether D is the same everywhere, so that `matrix`, `root` and their kin may be asked for."""
    regular: bool
    """Whether noise reaches every state directly, so that D has an inverse where it is positive."""
    formulas: tuple[tuple[sympy.Expr, ...], ...]
    """D row by row as formulas."""
    symbols: tuple[sympy.Symbol, ...] = ()
    """The states in the formulas, in their order; none of a constant D."""

    def __new__(cls, *_: object) -> Diffusion:
        """A constant D where no other is asked for by its class."""
        return super().__new__(_Constant if cls is Diffusion else cls)

    def __init__(self, matrix: np.ndarray) -> None:
        raise NotImplementedError

    @classmethod
    def identity(cls, dimension: int) -> Diffusion:
        """D = 1, for states of one unit."""
        return Diffusion(np.eye(dimension))

    @classmethod
    def of_formulas(
        cls, symbols: Sequence[sympy.Symbol], rows: Sequence[Sequence[sympy.Expr | float]]
    ) -> Diffusion:
        """D of formulas, d rows of d, in the symbols of the states; constant where no state stands in them.

        Raises ValueError when they are not a symmetric matrix, or other names than the states stand in them.
        """
        found = _Formulas(symbols, rows)
        if any(entry.free_symbols for row in found.formulas for entry in row):
            return found
        return Diffusion(np.array([[float(entry) for entry in row] for row in found.formulas]))

    @classmethod
    def of_rows(
        cls, symbols: Sequence[sympy.Symbol], rows: Sequence[Sequence[str | float]], *,
        parse: Callable[[str | float], sympy.Expr] | None = None,
    ) -> Diffusion:  # fmt: skip
        """D from plain data, see `rows`; raises as `of_formulas`, or `FormulaError`.

        `parse` reads a formula; by default it may have the states in it, and nothing else.
        """
        names = {each.name: each for each in symbols}
        if all(not isinstance(entry, str) for row in rows for entry in row):
            found = Diffusion(np.array(rows, dtype=float))
        else:
            read = parse or (lambda text: parse_formula(text, names))
            found = cls.of_formulas(symbols, [[read(entry) for entry in row] for row in rows])
        sizes = np.abs(found.matrix[found.matrix != 0]) if found.constant else np.ones(1)
        if not ((sizes >= LARGEST_STATE**-2) & (sizes <= LARGEST_STATE**2)).all():
            fault = "the diffusion is too large or too small for numbers"
            raise Fault(fault, "write the states in other units")
        return found

    @property
    def rows(self) -> list[list[str | float]]:
        """D as plain data, row by row: numbers where it is constant, formulas elsewhere."""
        if self.constant:
            return [[float(entry) for entry in row] for row in self.matrix]
        return [[str(entry) for entry in row] for row in self.formulas]

    # A constant D alone.

    @property
    def matrix(self) -> np.ndarray:
        """D where it is the same everywhere, shape ``(d, d)``; raises NumericalFailure where it is not."""
        raise NumericalFailure(
            "this is worked out only for a noise that is the same everywhere; here D depends on the state"
        )

    @property
    def scale(self) -> np.ndarray:
        """√D_ii, shape ``(d,)``: the unit of each state in which its noise is one; 1 where there is none."""
        return np.sqrt(positive(np.diag(self.matrix)))

    @cached_property
    def root(self) -> np.ndarray:
        """σ with ``D = σσᵀ``, shape ``(d, d)``: lower triangular where D is regular."""
        if self.regular:
            return np.linalg.cholesky(self.matrix)
        values, vectors = np.linalg.eigh(self.matrix)
        return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))

    @cached_property
    def precision(self) -> np.ndarray:
        """D⁻¹, shape ``(d, d)``; raises NumericalFailure where noise does not reach every state."""
        self._check_inverse()
        return np.linalg.inv(self.matrix)

    @cached_property
    def whitening(self) -> np.ndarray:
        """σ⁻¹, shape ``(d, d)``: the noise of ``σ⁻¹ x`` is the same in every direction; raises as D⁻¹."""
        self._check_inverse()
        return np.asarray(solve_triangular(self.root, np.eye(self.dimension), lower=True))

    def intensity(self, rate: np.ndarray) -> float:
        """ε of a noise whose covariance per unit of time, shape ``(d, d)``, is about ε D."""
        return float(np.trace(self.precision @ rate)) / self.dimension

    def _check_inverse(self) -> None:
        if not self.regular:
            raise NumericalFailure("the noise does not reach every state: D has no inverse")

    # Any D, at points.

    def derivatives(self, x: np.ndarray, order: int = 1) -> np.ndarray:
        """``∂^order D_ij / ∂x_k …`` at points: ``(n, d)`` to ``(n, d, d, d, …)``, k and further ones last."""
        raise NotImplementedError

    def at(self, x: np.ndarray) -> np.ndarray:
        """D at points: ``(n, d)`` to ``(n, d, d)``."""
        return self.derivatives(x, 0)

    def contract(self, x: np.ndarray, momenta: np.ndarray, order: int = 0) -> np.ndarray:
        """``p·D(x) p``, or its first or second derivatives by x.

        Parameters
        ----------
        x
            Points, shape ``(n, d)``.
        momenta
            p, shape ``(n, d)``; for order 0 there may be several at a point, ``(n, ..., d)``.
        order
            Of the derivative: the result has the shape ``(n, ...)``, ``(n, d)`` or ``(n, d, d)``.
        """
        if order == 0:
            return np.asarray((momenta * self.push(x, momenta)).sum(axis=-1))
        if self.constant:
            return np.zeros((len(x), *(self.dimension,) * order))
        further = "k" if order == 1 else "kl"
        factors = f"ni,nij{further},nj->n{further}"
        return np.asarray(np.einsum(factors, momenta, self.derivatives(x, order), momenta))

    def turn(self, x: np.ndarray, momenta: np.ndarray) -> np.ndarray:
        """``((∂_k D)p)_i`` at points and momenta ``(n, d)``: shape ``(n, d, d)``, i before k."""
        if self.constant:
            return np.zeros((len(x), self.dimension, self.dimension))
        return np.asarray(np.einsum("nijk,nj->nik", self.derivatives(x), momenta))

    def divergence(self, x: np.ndarray) -> np.ndarray:
        """``Σ_i ∂_i D_ij`` at points: ``(n, d)`` to ``(n, d)``."""
        return np.asarray(np.einsum("nijj->ni", self.derivatives(x)))

    def push(self, x: np.ndarray, momenta: np.ndarray) -> np.ndarray:
        """``D(x) p``, the velocity that a momentum, or ∇V, adds, at points and momenta ``(n, ..., d)``."""
        if not len(x):
            return np.zeros(momenta.shape)
        n, d = x.shape
        return np.asarray((momenta.reshape(n, -1, d) @ self.at(x)).reshape(momenta.shape))

    def root_at(self, x: np.ndarray) -> np.ndarray:
        """σ at points, lower triangular where D is regular: ``(n, d)`` to ``(n, d, d)``.

        Raises NumericalFailure where D is not positive definite, or formulas leave a state out.
        """
        self._check_inverse()
        matrices = self.at(x)
        try:
            root = np.linalg.cholesky(matrices)
        except np.linalg.LinAlgError:
            root = np.full(matrices.shape, np.nan)
        if not np.isfinite(root).all():
            known = np.isfinite(matrices).all(axis=(1, 2))
            lowest = np.full(len(x), -np.inf)  # eigenvalues
            lowest[known] = np.linalg.eigvalsh(_scaled(matrices[known]))[:, 0]
            raise _indefinite(x[np.argmin(lowest)])
        return root

    def whitening_at(self, x: np.ndarray) -> np.ndarray:
        """σ⁻¹ at points: ``(n, d)`` to ``(n, d, d)``; raises NumericalFailure where there is none."""
        return np.linalg.inv(self.root_at(x))

    def precision_at(self, x: np.ndarray) -> np.ndarray:
        """D⁻¹ at points: ``(n, d)`` to ``(n, d, d)``; raises as `whitening_at`."""
        whitening = self.whitening_at(x)
        return whitening.transpose(0, 2, 1) @ whitening

    def squared_speed(self, x: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """``v·D(x)⁻¹ v`` at points and velocities ``(n, d)``: shape ``(n,)``, no state's unit matters in it.

        Raises NumericalFailure where D has no inverse.
        """
        return np.asarray(((self.whitening_at(x) @ velocity[:, :, None])[:, :, 0] ** 2).sum(axis=1))

    def positive_at(self, x: np.ndarray) -> np.ndarray:
        """Mask of the points ``(n, d)`` at which D is a covariance: shape ``(n,)``.

        Formulas may be none far from the states that they were learned from. Where they leave no state out, D
        has to be positive definite.
        """
        matrices = self.at(x)
        finite = np.isfinite(matrices).all(axis=(1, 2))
        values = np.linalg.eigvalsh(np.where(finite[:, None, None], matrices, 0.0))
        least = 0.0 if self.regular else -ROUNDING * np.abs(values).max(axis=1)
        return np.asarray(finite & (values[:, 0] > least))

    def frozen(self, point: np.ndarray) -> Diffusion:
        """The constant D that is the one at a point ``(d,)``; raises NumericalFailure where it is none."""
        matrix = self.at(np.asarray(point, dtype=float)[None])[0]
        try:
            return Diffusion(matrix)
        except ValueError:
            raise _indefinite(point) from None

    def kicks(self, x: np.ndarray, numbers: np.ndarray) -> np.ndarray:
        """``σ(x) ξ`` of components, for simulations: states and numbers ``(d, ...)`` to ``(d, ...)``.

        Raises NumericalFailure where D is no covariance.
        """
        raise NotImplementedError

    def extended(self, count: int) -> Diffusion:
        """D in a system of `count` further states, on which this noise does not act."""
        if self.constant:
            return Diffusion(np.pad(self.matrix, (0, count)))
        further = sympy.symbols(f"_further:{count}", real=True)
        rows = sympy.diag(sympy.Matrix(self.formulas), sympy.zeros(count)).tolist()
        return Diffusion.of_formulas((*self.symbols, *further), rows)

    def in_units(self, center: np.ndarray, units: np.ndarray, factor: float) -> Diffusion:
        """``factor · units⁻¹ D units⁻ᵀ`` as a D of the states y, ``x = center + units y``."""
        return _InUnits(self, center, units, factor)


class _Constant(Diffusion):
    constant = True

    def __init__(self, matrix: np.ndarray) -> None:
        matrix = np.asarray(matrix, dtype=float)
        if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1]:
            raise Fault("the diffusion is not a square matrix", "give one row and one column a state")
        scaled = _scaled(matrix)
        if not np.isfinite(scaled).all() or np.abs(scaled - scaled.T).max() > ROUNDING:
            raise Fault("the diffusion is not symmetric", "correct the matrix")
        if np.linalg.eigvalsh(scaled)[0] < -ROUNDING:
            raise Fault("the diffusion is not positive semi-definite", "correct the matrix")
        self._matrix = (matrix + matrix.T) / 2
        self.dimension = len(matrix)

    def __repr__(self) -> str:
        return f"Diffusion({self._matrix!r})"

    @property
    def matrix(self) -> np.ndarray:
        return self._matrix

    @cached_property
    def regular(self) -> bool:  # type: ignore[override]
        return bool(np.linalg.eigvalsh(_scaled(self.matrix))[0] > ROUNDING)

    @property
    def formulas(self) -> tuple[tuple[sympy.Expr, ...], ...]:  # type: ignore[override]
        return tuple(tuple(exact_number(float(entry)) for entry in row) for row in self.matrix)

    def derivatives(self, x: np.ndarray, order: int = 1) -> np.ndarray:
        if order == 0:
            return np.broadcast_to(self.matrix, (len(x), *self.matrix.shape))
        return np.zeros((len(x), *(self.dimension,) * (2 + order)))

    def push(self, x: np.ndarray, momenta: np.ndarray) -> np.ndarray:
        return momenta @ self.matrix

    def root_at(self, x: np.ndarray) -> np.ndarray:
        return np.broadcast_to(self.root, (len(x), *self.matrix.shape))

    def whitening_at(self, x: np.ndarray) -> np.ndarray:
        return np.broadcast_to(self.whitening, (len(x), *self.matrix.shape))

    def positive_at(self, x: np.ndarray) -> np.ndarray:
        return np.full(len(x), True)

    def frozen(self, point: np.ndarray) -> Diffusion:
        return self

    def kicks(self, x: np.ndarray, numbers: np.ndarray) -> np.ndarray:
        return np.asarray(self.root @ numbers)


class _Formulas(Diffusion):
    constant = False

    def __init__(self, symbols: Sequence[sympy.Symbol], rows: Sequence[Sequence[sympy.Expr | float]]) -> None:
        d = len(symbols)
        formulas = tuple(tuple(sympy.sympify(entry) for entry in row) for row in rows)
        if len(formulas) != d or any(len(row) != d for row in formulas):
            raise Fault("the diffusion is not a square matrix", "give one row and one column a state")
        apart = [formulas[i][j] - formulas[j][i] for i in range(d) for j in range(i)]
        if any(each != 0 and sympy.simplify(each) != 0 for each in apart):
            raise Fault("the diffusion is not symmetric", "correct the matrix")
        unknown = set().union(*(entry.free_symbols for row in formulas for entry in row)) - set(symbols)
        if unknown:
            names = ", ".join(sorted(map(str, unknown)))
            raise Fault(f"the diffusion depends on {names}", "let it depend on the states alone")
        self.symbols, self.formulas, self.dimension = tuple(symbols), formulas, d
        self.regular = all(any(entry != 0 for entry in row) for row in formulas)
        self._compiled: dict[int, Callable[[np.ndarray], np.ndarray]] = {}
        self._diagonal = all(formulas[i][j] == 0 for i in range(d) for j in range(d) if i != j)

    def __repr__(self) -> str:
        return f"_Formulas({self.symbols}, {self.formulas})"

    def derivatives(self, x: np.ndarray, order: int = 1) -> np.ndarray:
        values = self._values(np.ascontiguousarray(x.T), order)
        return values.T.reshape(len(x), *(self.dimension,) * (2 + order))

    def _values(self, components: np.ndarray, order: int) -> np.ndarray:
        """Derivatives one after another: components ``(d, n)`` to ``(d^(2 + order), n)``."""
        if order not in self._compiled:
            entries = [entry for row in self.formulas for entry in row]
            for _ in range(order):
                entries = [each.diff(symbol) for each in entries for symbol in self.symbols]
            self._compiled[order] = compile_formulas(entries, self.symbols)
        return self._compiled[order](components)

    def kicks(self, x: np.ndarray, numbers: np.ndarray) -> np.ndarray:
        d, values = self.dimension, self._values(x, 0)
        finite = np.isfinite(x).all(axis=0)  # a state that has run away is told by who simulates
        if self._diagonal:
            variances = values[:: d + 1]
            if not (variances[:, finite] >= 0).all():
                raise _indefinite(x[:, int(np.argmin(np.where(finite, variances.min(axis=0), np.inf)))])
            return np.asarray(np.sqrt(variances) * numbers)
        matrices = np.where(finite, values, np.eye(d).reshape(d * d, 1)).T.reshape(-1, d, d)
        levels, vectors = np.linalg.eigh(matrices)
        if (levels[:, 0] < -ROUNDING * np.abs(levels).max(axis=1)).any():
            raise _indefinite(x[:, int(np.argmin(levels[:, 0]))])
        along = np.einsum("nji,jn->ni", vectors, numbers) * np.sqrt(np.maximum(levels, 0.0))
        return np.where(finite, np.einsum("nij,nj->in", vectors, along), np.nan)


class _InUnits(Diffusion):
    """D of the states ``x = center + units y`` as a D of y, times a factor for the unit of time."""

    def __init__(self, noise: Diffusion, center: np.ndarray, units: np.ndarray, factor: float) -> None:
        self.noise, self.center, self.units, self.factor = noise, center, units, factor
        self.dimension, self.constant, self.regular = noise.dimension, noise.constant, noise.regular
        self._inverse = np.linalg.inv(units)
        self._constant = factor * self._inverse @ noise.matrix @ self._inverse.T if noise.constant else None

    def derivatives(self, y: np.ndarray, order: int = 1) -> np.ndarray:
        if self._constant is not None:  # in any unit of the states its derivatives are zero
            whole = np.broadcast_to(self._constant, (len(y), *self._constant.shape))
            return self.noise.derivatives(y, order) if order else whole
        turned = self.factor * self.noise.derivatives(self.center + y @ self.units.T, order)
        for matrix in (self._inverse.T, self._inverse.T, *[self.units] * order):  # each index goes last
            turned = np.tensordot(turned, matrix, axes=(1, 0))
        return turned

    def push(self, y: np.ndarray, momenta: np.ndarray) -> np.ndarray:
        return super().push(y, momenta) if self._constant is None else momenta @ self._constant

    def whitening_at(self, y: np.ndarray) -> np.ndarray:
        own = self.noise.whitening_at(self.center + y @ self.units.T) @ self.units
        return np.asarray(own / np.sqrt(self.factor))


def _scaled(matrices: np.ndarray) -> np.ndarray:
    """D in units in which its diagonal is one: ``(..., d, d)``."""
    scale = np.sqrt(positive(np.diagonal(matrices, axis1=-2, axis2=-1)))
    return matrices / (scale[..., :, None] * scale[..., None, :])


def _indefinite(point: np.ndarray) -> NumericalFailure:
    place = ", ".join(f"{value:.4g}" for value in point)
    return NumericalFailure(
        f"D is not positive definite at ({place}): give formulas that are positive wherever states are, or"
        " leave the states beyond out"
    )
