"""Symbolic decompositions: the formulas of V, g and f, what they evaluate to, and their terms.

A formula is a sympy expression of the states. `model.json` (`siq.potential.storage`) is how it travels.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import scipy.optimize
import sympy

from siq.dynamics.diffusion import Diffusion
from siq.dynamics.dynamics import Dynamics
from siq.dynamics.formulas import compile_formulas
from siq.errors import NumericalFailure
from siq.identify.library import CandidateLibrary, linear_combination
from siq.potential.well import Well


@dataclass(frozen=True)
class SymbolicDecomposition:
    """Formulas of ``f = -D∇V + g``.

    Attributes
    ----------
    symbols
        The d states.
    potential
        V, zero at its minimum; None where no single formula holds over the wells.
    circulatory
        Components of g; none where there is no V.
    vector_field
        Components of f.
    wells
        V about each attractor, zero there and valid below a level, where it was found.
    standard_errors
        Of the coefficients, by component (``U``, ``V``, ``f_x``, ``g_x``) and term, where they are known.
    """

    symbols: tuple[sympy.Symbol, ...]
    potential: sympy.Expr | None
    circulatory: tuple[sympy.Expr, ...]
    vector_field: tuple[sympy.Expr, ...]
    wells: tuple[Well, ...] = ()
    standard_errors: Mapping[str, Mapping[str, float]] = field(default_factory=dict)

    @property
    def quasipotential(self) -> sympy.Expr:
        """U = 2V, zero at its minimum: the action is ½∫∣φ̇ - f∣²dt, and p ~ exp(-U/ε) for √ε dW."""
        return sympy.expand(2 * self._potential())

    @property
    def gradient(self) -> tuple[sympy.Expr, ...]:
        """∇V."""
        return tuple(self._potential().diff(symbol) for symbol in self.symbols)

    def _potential(self) -> sympy.Expr:
        if self.potential is None:
            raise ValueError("no single formula of V was found; each well has its own")
        return self.potential

    @cached_property
    def evaluate(self) -> Callable[[np.ndarray], np.ndarray]:
        """V, g_1 … g_d, f_1 … f_d: points as components ``(d, ...)`` to values ``(2d + 1, ...)``."""
        return compile_formulas([self._potential(), *self.circulatory, *self.vector_field], self.symbols)

    @cached_property
    def evaluate_gradient(self) -> Callable[[np.ndarray], np.ndarray]:
        """∇V: points as components ``(d, ...)`` to components ``(d, ...)``."""
        return compile_formulas(self.gradient, self.symbols)

    def components(self) -> dict[str, sympy.Expr]:
        """The formulas by the names that tables give them: ``U``, ``V``, ``f_x``, ``g_x`` and so on."""
        formulas = {} if self.potential is None else {"U": self.quasipotential, "V": self.potential}
        formulas |= {f"f_{s}": f for s, f in zip(self.symbols, self.vector_field, strict=True)}
        if self.circulatory:
            formulas |= {f"g_{s}": g for s, g in zip(self.symbols, self.circulatory, strict=True)}
        return formulas


def exact_decomposition(dynamics: Dynamics, quasipotential: sympy.Expr) -> SymbolicDecomposition:
    """The decomposition of known dynamics with a known U = 2V; g = f + D∇V. For scoring only."""
    potential = sympy.expand(quasipotential / 2)
    gradient = [potential.diff(symbol) for symbol in dynamics.symbols]
    downhill = downhill_formulas(dynamics.diffusion, gradient)
    return SymbolicDecomposition(
        symbols=dynamics.symbols,
        potential=potential,
        circulatory=tuple(sympy.expand(f + v) for f, v in zip(dynamics.formulas, downhill, strict=True)),
        vector_field=tuple(sympy.expand(formula) for formula in dynamics.formulas),
    )


def downhill_formulas(diffusion: Diffusion, gradient: Sequence[sympy.Expr]) -> tuple[sympy.Expr, ...]:
    """D∇V as formulas, from those of ∇V."""
    return tuple(
        sum((entry * slope for entry, slope in zip(row, gradient, strict=True)), sympy.S.Zero)
        for row in diffusion.formulas
    )


def decomposition_from_coefficients(
    library: CandidateLibrary,
    *,
    potential: np.ndarray,
    circulatory: np.ndarray,
    vector_field: np.ndarray,
    points: np.ndarray,
) -> SymbolicDecomposition:
    """Formulas from coefficients over a library, with V shifted to be zero at its minimum.

    Parameters
    ----------
    library
        The q functions.
    potential
        Coefficients of V, shape ``(q,)``.
    circulatory, vector_field
        Coefficients of g and f, shape ``(q, d)``.
    points
        Shape ``(n, d)``; the minimum is sought within their box, from the lowest of them.

    Raises
    ------
    NumericalFailure
        When V is nowhere finite on the points.
    """

    def expression(coefficients: np.ndarray) -> sympy.Expr:
        chosen = np.flatnonzero(coefficients)
        return sympy.Add(*(sympy.Float(float(coefficients[k]), 17) * library.terms[k] for k in chosen))

    value = expression(potential)
    lowest = minimum(value, library.symbols, points)
    return SymbolicDecomposition(
        symbols=library.symbols,
        potential=value - sympy.Float(lowest, 17),
        circulatory=tuple(expression(column) for column in circulatory.T),
        vector_field=tuple(expression(column) for column in vector_field.T),
    )


def minimum(
    expression: sympy.Expr, symbols: Sequence[sympy.Symbol], points: np.ndarray, *, starts: int = 8
) -> float:
    """Smallest value of an expression within the box of some points.

    Parameters
    ----------
    expression
        A function of `symbols`.
    symbols
        The d states.
    points
        Shape ``(n, d)``. Descents start from the lowest of them that do not lie side by side.
    starts
        Number of descents.

    Returns
    -------
    float
    """
    together = compile_formulas([expression, *(expression.diff(s) for s in symbols)], tuple(symbols))
    values = together(points.T)[0]
    if not np.isfinite(values).any():
        raise NumericalFailure("the formula of V is nowhere finite on the recorded points")
    scale = np.ptp(points, axis=0)
    scale[scale == 0] = 1.0
    # Spread over all points, not among the lowest only: one well may be recorded far more often than a
    # deeper one.
    order = points[np.argsort(np.where(np.isfinite(values), values, np.inf))]
    chosen: list[np.ndarray] = []
    while len(order) and len(chosen) < starts:
        chosen.append(order[0])
        order = order[np.linalg.norm((order - order[0]) / scale, axis=1) > 0.15]
    bounds = np.stack([points.min(axis=0), points.max(axis=0)], axis=1) / scale[:, None]
    unit = float(np.ptp(values[np.isfinite(values)])) or 1.0

    def function(y: np.ndarray) -> tuple[float, np.ndarray]:
        result = together((y * scale)[:, None])[:, 0]
        return result[0] / unit, result[1:] * scale / unit

    best = float(np.nanmin(values))
    for point in chosen:
        found = scipy.optimize.minimize(
            function, point / scale, jac=True, bounds=bounds, method="L-BFGS-B",
            options={"ftol": 1e-15, "gtol": 1e-12},
        )  # fmt: skip
        best = min(best, float(found.fun) * unit)
    return best


def term_coefficients(expression: sympy.Expr) -> dict[str, float]:
    """Coefficients by term as text, such as ``{"x**2": -2.0, "1": 1.0}``; zeros left out."""
    return {str(term): value for term, value in linear_combination(expression).items()}
