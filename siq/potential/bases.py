"""Functions in which V is written when it is refined: a candidate library, or powers about an attractor.

Both give their functions, gradients and Hessians at points; see `siq.potential.hamilton_jacobi` for what is
done with them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
import sympy

from siq.dynamics.formulas import compile_formulas
from siq.identify.library import CandidateLibrary, monomial_exponents

MOST_POWERS = 260  # more make every Gauss–Newton step take seconds


class Basis(Protocol):
    """m functions of d states."""

    @property
    def size(self) -> int:
        """Number of functions, m."""

    def values(self, x: np.ndarray) -> np.ndarray:
        """Points ``(n, d)`` to values ``(n, m)``."""

    def gradients(self, x: np.ndarray) -> np.ndarray:
        """Points ``(n, d)`` to gradients ``(n, d, m)``."""

    def hessians(self, x: np.ndarray) -> np.ndarray:
        """Points ``(n, d)`` to Hessians ``(n, d, d, m)``."""

    def expression(self, coefficients: np.ndarray) -> sympy.Expr:
        """The sum as a formula of the states."""


@dataclass(frozen=True)
class LibraryBasis:
    """The functions of a candidate library that V may use, without the constant.

    Attributes
    ----------
    library
        The library.
    chosen
        Shape ``(m,)``: which of its functions.
    """

    library: CandidateLibrary
    chosen: np.ndarray

    @property
    def size(self) -> int:
        """Number of functions, m."""
        return len(self.chosen)

    def restricted(self, rows: np.ndarray) -> LibraryBasis:
        """Some of the functions."""
        return LibraryBasis(self.library, self.chosen[rows])

    def values(self, x: np.ndarray) -> np.ndarray:
        """Points ``(n, d)`` to values ``(n, m)``."""
        return self.library.evaluate(x)[:, self.chosen]

    def gradients(self, x: np.ndarray) -> np.ndarray:
        """Points ``(n, d)`` to gradients ``(n, d, m)``."""
        d, q = self.library.dimension, self.library.size
        flat = self.library.derivatives[:, :, self.chosen].reshape(q, d * self.size)
        return (self.library.evaluate(x) @ flat).reshape(len(x), d, self.size)

    def hessians(self, x: np.ndarray) -> np.ndarray:
        """Points ``(n, d)`` to Hessians ``(n, d, d, m)``."""
        d = self.library.dimension
        flat = self._second(np.ascontiguousarray(x.T))
        return np.moveaxis(flat.reshape(self.size, d, d, len(x)), (0, 3), (3, 0))

    @cached_property
    def _second(self):  # type: ignore[no-untyped-def]
        symbols = self.library.symbols
        second = [self.library.terms[k].diff(a, b) for k in self.chosen for a in symbols for b in symbols]
        return compile_formulas(second, symbols)

    def expression(self, coefficients: np.ndarray) -> sympy.Expr:
        """The sum as a formula of the states."""
        return sympy.Add(
            *(
                sympy.Float(float(c), 17) * self.library.terms[k]
                for c, k in zip(coefficients, self.chosen, strict=True)
                if c != 0
            )
        )


def potential_basis(library: CandidateLibrary) -> LibraryBasis:
    """All functions that V may use; the constant means nothing to V and is left out."""
    allowed = library.in_potential.copy()
    allowed[library.constant] = False
    return LibraryBasis(library, np.flatnonzero(allowed))


@dataclass(frozen=True)
class PowerBasis:
    """Products of powers of ``(x - center)/scale``.

    Attributes
    ----------
    symbols
        The d states.
    center, scale
        Shape ``(d,)``.
    exponents
        Shape ``(m, d)``.
    """

    symbols: tuple[sympy.Symbol, ...]
    center: np.ndarray
    scale: np.ndarray
    exponents: np.ndarray

    @property
    def size(self) -> int:
        """Number of functions, m."""
        return len(self.exponents)

    def values(self, x: np.ndarray) -> np.ndarray:
        """Points ``(n, d)`` to values ``(n, m)``."""
        return self._product(self._powers(x), ())

    def gradients(self, x: np.ndarray) -> np.ndarray:
        """Points ``(n, d)`` to gradients ``(n, d, m)``."""
        powers = self._powers(x)
        d = len(self.symbols)
        return np.stack([self._product(powers, (i,)) for i in range(d)], axis=1)

    def hessians(self, x: np.ndarray) -> np.ndarray:
        """Points ``(n, d)`` to Hessians ``(n, d, d, m)``."""
        powers = self._powers(x)
        d = len(self.symbols)
        rows = [np.stack([self._product(powers, (i, j)) for j in range(d)], axis=1) for i in range(d)]
        return np.stack(rows, axis=1)

    def expression(self, coefficients: np.ndarray) -> sympy.Expr:
        """The sum as a formula of the states."""
        scaled = [
            (symbol - sympy.Float(float(c), 17)) / sympy.Float(float(s), 17)
            for symbol, c, s in zip(self.symbols, self.center, self.scale, strict=True)
        ]
        return sympy.Add(
            *(
                sympy.Float(float(c), 17)
                * sympy.Mul(*(base ** int(e) for base, e in zip(scaled, row, strict=True)))
                for c, row in zip(coefficients, self.exponents, strict=True)
                if c != 0
            )
        )

    def _powers(self, x: np.ndarray) -> np.ndarray:
        """Powers of every scaled state, shape ``(highest + 1, d, n)``."""
        y = ((x - self.center) / self.scale).T
        powers = np.ones((int(self.exponents.max()) + 1, *y.shape))
        for exponent in range(1, len(powers)):
            powers[exponent] = powers[exponent - 1] * y
        return powers

    def _product(self, powers: np.ndarray, derivatives: tuple[int, ...]) -> np.ndarray:
        exponents = self.exponents.copy()
        factor = np.ones(len(exponents))
        for axis in derivatives:
            factor = factor * exponents[:, axis] / self.scale[axis]
            exponents[:, axis] = np.maximum(exponents[:, axis] - 1, 0)
        result = np.repeat(factor[:, None], powers.shape[2], axis=1)
        for axis in range(powers.shape[1]):
            result *= powers[exponents[:, axis], axis]
        return result.T


def affordable_degree(dimension: int, degree: int) -> int:
    """The highest degree up to `degree`, but at least 2, with no more than `MOST_POWERS` powers."""
    while degree > 2 and math.comb(dimension + degree, degree) > MOST_POWERS:
        degree -= 1
    return degree


def power_basis(
    symbols: tuple[sympy.Symbol, ...], center: np.ndarray, scale: np.ndarray, *, degree: int
) -> PowerBasis:
    """All powers of degree 2 up to `degree` about a center; the quadratic ones come first."""
    exponents = [row for row in monomial_exponents(len(symbols), degree) if sum(row) >= 2]
    return PowerBasis(symbols, np.asarray(center, dtype=float), scale, np.array(exponents))
