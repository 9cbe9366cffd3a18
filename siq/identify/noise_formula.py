"""εD(x) as a sum of terms with errors: what residuals show of a noise that depends on the state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import sympy

from siq.dynamics.diffusion import Diffusion
from siq.dynamics.formulas import compile_formulas, parse_formula
from siq.dynamics.state_noise import state_noise


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

    @property
    def standard_errors(self) -> np.ndarray:
        """Shape ``(p,)``."""
        return np.sqrt(np.diag(self.covariance))

    def push_slopes(self, x: np.ndarray, momenta: np.ndarray) -> np.ndarray:
        """``p·(∂εD/∂value) p`` at points and momenta ``(n, d)``: shape ``(n, p)``."""
        terms = compile_formulas(self.terms, self.symbols)(np.ascontiguousarray(x.T)).T
        i, j = self.places.T
        return np.asarray(np.where(i == j, 1.0, 2.0) * momenta[:, i] * momenta[:, j] * terms)

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
