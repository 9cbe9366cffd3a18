"""A vector field as formulas: its values and derivatives at points."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import sympy

from siq.expressions import compile_formulas


@dataclass(frozen=True)
class VectorField:
    """f of ``dx/dt = f(x)``, in formulas; points come as rows.

    Attributes
    ----------
    symbols
        The d states.
    equations
        The components of f.
    """

    symbols: tuple[sympy.Symbol, ...]
    equations: tuple[sympy.Expr, ...]

    @property
    def dimension(self) -> int:
        """Number of states, d."""
        return len(self.symbols)

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """F at points: ``(n, d)`` to ``(n, d)``."""
        return self._values(_components(x)).T

    def jacobian(self, x: np.ndarray) -> np.ndarray:
        """∂f_i/∂x_j at points: ``(n, d)`` to ``(n, d, d)``, i before j."""
        d = self.dimension
        return self._first(_components(x)).T.reshape(len(x), d, d)

    def hessian(self, x: np.ndarray) -> np.ndarray:
        """∂²f_i/∂x_j∂x_k at points: ``(n, d)`` to ``(n, d, d, d)``, i first."""
        d = self.dimension
        return self._second(_components(x)).T.reshape(len(x), d, d, d)

    @cached_property
    def _values(self) -> Callable[[np.ndarray], np.ndarray]:
        return compile_formulas(self.equations, self.symbols)

    @cached_property
    def _first(self) -> Callable[[np.ndarray], np.ndarray]:
        return compile_formulas(_derivatives(self.equations, self.symbols), self.symbols)

    @cached_property
    def _second(self) -> Callable[[np.ndarray], np.ndarray]:
        first = _derivatives(self.equations, self.symbols)
        return compile_formulas(_derivatives(first, self.symbols), self.symbols)


def _components(x: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(x.T)


def _derivatives(expressions: Sequence[sympy.Expr], symbols: Sequence[sympy.Symbol]) -> list[sympy.Expr]:
    return [expression.diff(symbol) for expression in expressions for symbol in symbols]
