"""Which terms does εD(x) have? All are fitted first, and dropped one by one by their own standard errors.

Where the likelihood is from makes no difference: of residuals of pairs (`siq.identify.noise_regression`), or
of the innovations of a filter (`siq.identify.noise_beside_sensor`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
import scipy.special
import sympy

from siq.identify.library import monomial_exponents
from siq.identify.noise_formula import NoiseFormula

DEGREE = 2  # of the formulas: the least that can bend, and keep positive where a straight line does not
HARMLESS = 0.02  # relative change of D over the states below which a constant one will do, see `residuals`
FEW_STATES = 3  # of which correlations may depend on the state: sixty coefficients


def noise_functions(symbols: Sequence[sympy.Symbol]) -> list[sympy.Expr]:
    """The functions of the state in which D is sought, the constant first."""
    return [
        sympy.Mul(*(each**power for each, power in zip(symbols, powers, strict=True)))
        for powers in monomial_exponents(len(symbols), DEGREE)
    ]


def all_places(d: int, functions: int) -> np.ndarray:
    """Row, column and function of every coefficient that εD(x) may have, shape ``(p, 3)``."""
    # Of many states the correlations are constant: their formulas would be most of all coefficients.
    whole = d <= FEW_STATES
    return np.array(
        [(i, j, k) for i in range(d) for j in range(i, d) for k in range(functions if i == j or whole else 1)]
    )


class NoiseLikelihood(Protocol):
    """How likely recordings are under formulas of the noise.

    Attributes
    ----------
    symbols, terms
        The d states, and the functions of them.
    start
        εD where it is the same everywhere, shape ``(d, d)``.
    """

    @property
    def symbols(self) -> Sequence[sympy.Symbol]:
        """See above."""

    @property
    def terms(self) -> Sequence[sympy.Expr]:
        """See above."""

    @property
    def start(self) -> np.ndarray:
        """See above."""

    def positive(self, chosen: np.ndarray, values: np.ndarray) -> bool:
        """Whether D is positive definite at all recorded states."""

    def scored(self, chosen: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Coefficients of the largest likelihood from a start at which D is positive, with covariance."""

    def least_squares(self, chosen: np.ndarray) -> np.ndarray:
        """Coefficients at which D is positive, where no constant part makes it so."""


def selected_noise(data: NoiseLikelihood, *, false_terms: float, probability: float) -> NoiseFormula:
    """εD(x) of the largest likelihood, of the terms that differ from zero.

    Parameters
    ----------
    data
        The likelihood.
    false_terms
        Probability that chance brings any term into D.
    probability
        See `NoiseFormula`.

    Raises
    ------
    NumericalFailure
        When no formula of this kind is positive at all recorded states.
    """
    start = data.start
    chosen = all_places(len(start), len(data.terms))
    values = np.array([start[i, j] if k == 0 else 0.0 for i, j, k in chosen])
    critical = float(-scipy.special.ndtri(false_terms / (2 * len(chosen))))
    while True:
        values, covariance = data.scored(chosen, values)
        kept, values = _eliminated(chosen, values, covariance, critical)
        if len(kept) == len(chosen):
            break
        chosen = chosen[kept]
        # What is left may not be positive: then the others begin where they are sure to be, if they can.
        if not data.positive(chosen, values):
            values = np.array([start[i, j] * (i == j) if k == 0 else 0.0 for i, j, k in chosen])
        if not data.positive(chosen, values):
            values = data.least_squares(chosen)
    return NoiseFormula(
        tuple(data.symbols), chosen[:, :2], tuple(data.terms[k] for k in chosen[:, 2]), values, covariance,
        probability,
    )  # fmt: skip


def _eliminated(
    chosen: np.ndarray, values: np.ndarray, covariance: np.ndarray, critical: float
) -> tuple[np.ndarray, np.ndarray]:
    """Backward elimination about the largest likelihood: the coefficients that stay, and what they become.

    The last term of a state's own noise stays: without it there would be none.
    """
    kept = np.arange(len(chosen))
    while len(kept):
        own = chosen[kept, 0] == chosen[kept, 1]
        count = np.array([(own & (chosen[kept, 0] == i)).sum() for i in chosen[kept, 0]])
        strength = np.abs(values) / np.sqrt(np.maximum(np.diag(covariance), np.finfo(float).tiny))
        strength[own & (count == 1)] = np.inf
        weakest = int(np.argmin(strength))
        if strength[weakest] >= critical:
            break
        along = covariance[:, weakest] / covariance[weakest, weakest]
        values = np.delete(values - along * values[weakest], weakest)
        covariance = covariance - np.outer(along, covariance[weakest])
        covariance = np.delete(np.delete(covariance, weakest, axis=0), weakest, axis=1)
        kept = np.delete(kept, weakest)
    return kept, values
