"""Refined coefficients as formulas that people read, with a standard error for each."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import sympy

from siq.potential.refinement import Refined
from siq.potential.symbolic import SymbolicDecomposition, minimum


def refined_decomposition(refined: Refined, points: np.ndarray) -> SymbolicDecomposition:
    """V, g and f of a refinement, V zero at its minimum.

    Parameters
    ----------
    refined
        What the routes found.
    points
        Recorded states, shape ``(n, d)``; the minimum of V is sought within their box.

    Returns
    -------
    SymbolicDecomposition
        With f as it was identified, so that f = -D∇V + g is a statement and no definition. Where there is
        one attractor only, its well's formula stands for the whole where no other was found.
    """
    library, found = refined.library, refined.found
    symbols = library.symbols
    wells = refined.wells or refined.network_wells
    vector_field = found.dynamics.formulas
    errors = {
        f"f_{state}": _named(found.standard_errors[:, i], library.names)
        for i, state in enumerate(library.states)
    }
    if refined.potential is None:
        return SymbolicDecomposition(symbols, None, (), vector_field, wells, errors)
    assert refined.circulatory is not None and refined.potential_covariance is not None
    assert refined.circulatory_errors is not None
    value = expression_over(refined.potential, library.terms)
    lowest = minimum(value, symbols, points)
    potential_errors = np.sqrt(np.diag(refined.potential_covariance))
    # The constant is minus the minimum; at the minimum its own place does not matter to first order.
    at = library.evaluate(points[np.argmin(library.evaluate(points) @ refined.potential)][None])[0]
    constant = float(np.sqrt(at @ refined.potential_covariance @ at))
    named = _named(potential_errors, library.names) | {"1": constant}
    errors |= {"V": named, "U": {term: 2 * error for term, error in named.items()}}
    errors |= {
        f"g_{state}": _named(refined.circulatory_errors[:, i], library.names)
        for i, state in enumerate(library.states)
    }
    return SymbolicDecomposition(
        symbols=symbols,
        potential=value - sympy.Float(lowest, 17),
        circulatory=tuple(expression_over(column, library.terms) for column in refined.circulatory.T),
        vector_field=vector_field,
        wells=wells,
        standard_errors=errors,
    )


def expression_over(coefficients: np.ndarray, terms: Sequence[sympy.Expr]) -> sympy.Expr:
    """A sum of terms with float coefficients, zeros left out."""
    return sympy.Add(
        *(sympy.Float(float(c), 17) * term for c, term in zip(coefficients, terms, strict=True) if c != 0)
    )


def relative_error_of(refined: Refined, points: np.ndarray) -> float:
    """Relative standard error of V over points, from the uncertainty of f alone."""
    if refined.potential is None or refined.potential_covariance is None or refined.found.noise_free:
        return 0.0
    functions = refined.library.evaluate(points)
    values = functions @ refined.potential
    lowest = int(np.argmin(values))
    difference = functions - functions[lowest]
    variance = np.einsum("nq,qr,nr->n", difference, refined.potential_covariance, difference)
    size = np.linalg.norm(values - values[lowest])
    return float(np.sqrt(np.maximum(variance, 0).sum()) / size)


def _named(errors: np.ndarray, names: Sequence[str]) -> dict[str, float]:
    return {name: float(error) for name, error in zip(names, errors, strict=True) if error > 0}
