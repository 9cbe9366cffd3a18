"""εD(x) as a sum of terms with errors: what residuals show of a noise that depends on the state."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import sympy

from siq.dynamics.diffusion import Diffusion
from siq.dynamics.formulas import compile_formulas, parse_formula
from siq.dynamics.state_noise import state_noise


def constant_noise(symbols: Sequence[sympy.Symbol], rate: np.ndarray, *, samples: float) -> NoiseFormula:
    """εD that is the same everywhere, from the covariance of so many residuals per time, ``(d, d)``.

    The entries of a covariance of n normal residuals have the covariance ``(R_ik R_jl + R_il R_jk)/n``.
    """
    d = len(symbols)
    places = np.array([(i, j) for i in range(d) for j in range(i, d)])
    i, j = places.T
    straight, crossed = rate[np.ix_(i, i)] * rate[np.ix_(j, j)], rate[np.ix_(i, j)] * rate[np.ix_(j, i)]
    values, one = rate[i, j], sympy.Integer(1)
    covariance = (straight + crossed) / samples
    return NoiseFormula(tuple(symbols), places, (one,) * len(places), values, covariance, 1.0)


@dataclass(frozen=True)
class NoiseFormula:
    """εD(x) as a sum of terms, with errors.

    Attributes
    ----------
    symbols
        The d states.
    places
        Shape ``(p, 2)``: the entry (i, j), i ≤ j, of each coefficient.
    terms
        The function of each coefficient.
    values, covariance
        Shapes ``(p,)`` and ``(p, p)``, in the states' units squared per time.
    probability
        That a constant D shows as much by chance.
    """

    symbols: tuple[sympy.Symbol, ...]
    places: np.ndarray
    terms: tuple[sympy.Expr, ...]
    values: np.ndarray
    covariance: np.ndarray
    probability: float

    def diffusion(self, intensity: float) -> Diffusion:
        """D, where ε is the intensity."""
        d = len(self.symbols)
        rows = [[sympy.S.Zero for _ in range(d)] for _ in range(d)]
        for (i, j), term, value in zip(self.places, self.terms, self.values, strict=True):
            rows[i][j] += sympy.Float(float(value / intensity), 17) * term
        return state_noise(self.symbols, [[rows[min(i, j)][max(i, j)] for j in range(d)] for i in range(d)])

    @cached_property
    def _functions(self) -> Callable[[np.ndarray], np.ndarray]:
        return compile_formulas(self.terms, self.symbols)

    @property
    def standard_errors(self) -> np.ndarray:
        """Shape ``(p,)``."""
        return np.sqrt(np.diag(self.covariance))

    def push_slopes(self, x: np.ndarray, momenta: np.ndarray) -> np.ndarray:
        """``p·(∂εD/∂value) p`` at points and momenta ``(n, d)``: shape ``(n, p)``."""
        terms = self._functions(np.ascontiguousarray(x.T)).T
        i, j = self.places.T
        return np.asarray(np.where(i == j, 1.0, 2.0) * momenta[:, i] * momenta[:, j] * terms)

    def strength_slopes(self, x: np.ndarray) -> np.ndarray:
        """Derivatives of ``ln ε`` by the coefficients, shape ``(p,)``.

        ε is such that the determinant of D has the geometric mean one over the states ``(n, d)``.
        """
        terms = self._functions(np.ascontiguousarray(x.T))
        precision = self.diffusion(1.0).precision_at(x)
        i, j = self.places.T
        share = np.where(i == j, 1.0, 2.0)[:, None] * precision[:, i, j].T * terms
        return np.asarray(share.mean(axis=1) / len(self.symbols))

    def as_data(self) -> dict[str, Any]:
        """The terms with their errors, and the covariance, as plain data."""
        names = [each.name for each in self.symbols]
        return {
            "terms": [
                {
                    "row": names[i],
                    "column": names[j],
                    "term": str(term),
                    "coefficient": float(value),
                    "standard_error": float(error),
                }
                for (i, j), term, value, error in zip(
                    self.places, self.terms, self.values, self.standard_errors, strict=True
                )
            ],
            "covariance": self.covariance.tolist(),
            "probability": self.probability,
        }

    @classmethod
    def from_data(cls, data: Mapping[str, Any], symbols: Sequence[sympy.Symbol]) -> NoiseFormula:
        """What `as_data` gave."""
        names = {each.name: each for each in symbols}
        place = {each.name: index for index, each in enumerate(symbols)}
        rows = data["terms"]
        return cls(
            tuple(symbols),
            np.array([[place[row["row"]], place[row["column"]]] for row in rows]),
            tuple(parse_formula(row["term"], names) for row in rows),
            np.array([float(row["coefficient"]) for row in rows]),
            np.array(data["covariance"], dtype=float),
            float(data["probability"]),
        )
