"""What are drift and noise at a state, in machine code?

A polynomial is a table of powers ``(terms, d)`` and its coefficients.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from benchmarks.laboratories.models import Laboratory


class Polynomials(NamedTuple):
    """F and q of a laboratory.

    Attributes
    ----------
    component
        The state to whose equation each term of f belongs, shape ``(terms,)``.
    powers, coefficients
        Of f, shape ``(terms, d)`` and ``(terms,)``.
    noise_powers, noise_coefficients
        Of q.
    """

    component: np.ndarray
    powers: np.ndarray
    coefficients: np.ndarray
    noise_powers: np.ndarray
    noise_coefficients: np.ndarray


def polynomials(laboratory: Laboratory) -> Polynomials:
    """As arrays."""
    component, powers = zip(*laboratory.terms, strict=True)
    return Polynomials(
        np.array(component, dtype=np.int64),
        np.array(powers, dtype=np.int64),
        laboratory.coefficients,
        np.array(list(laboratory.intensity), dtype=np.int64),
        laboratory.intensities,
    )


@numba.njit(cache=True)
def monomial(powers: np.ndarray, x: np.ndarray) -> float:
    """``Π x_i^powers_i``."""
    value = 1.0
    for place in range(len(x)):
        for _ in range(powers[place]):
            value *= x[place]
    return value


@numba.njit(cache=True)
def slope(powers: np.ndarray, x: np.ndarray, by: int) -> float:
    """Its derivative by a state."""
    if powers[by] == 0:
        return 0.0
    lower = powers.copy()
    lower[by] -= 1
    return float(powers[by] * monomial(lower, x))


@numba.njit(cache=True)
def bend(powers: np.ndarray, x: np.ndarray, by: int, and_by: int) -> float:
    """Its second derivative by two states."""
    if powers[by] == 0:
        return 0.0
    lower = powers.copy()
    lower[by] -= 1
    return float(powers[by] * slope(lower, x, and_by))


@numba.njit(cache=True)
def drift(system: Polynomials, x: np.ndarray) -> np.ndarray:
    """F at a state, shape ``(d,)``."""
    value = np.zeros(len(x))
    for term in range(len(system.component)):
        value[system.component[term]] += system.coefficients[term] * monomial(system.powers[term], x)
    return value


@numba.njit(cache=True)
def jacobian(system: Polynomials, x: np.ndarray) -> np.ndarray:
    """∂f_i/∂x_j at a state."""
    d = len(x)
    value = np.zeros((d, d))
    for term in range(len(system.component)):
        for by in range(d):
            value[system.component[term], by] += system.coefficients[term] * slope(system.powers[term], x, by)
    return value


@numba.njit(cache=True)
def intensity(system: Polynomials, x: np.ndarray) -> float:
    """Q at a state: variance per unit of time of the process noise on each state."""
    value = 0.0
    for term in range(len(system.noise_coefficients)):
        value += system.noise_coefficients[term] * monomial(system.noise_powers[term], x)
    return value
