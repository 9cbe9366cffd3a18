"""What does the spread of a state do to its mean? The closure of the moments for a Gaussian spread.

Where a state is known to within a covariance P, the mean of f is not f of the mean: to second order it is
``f + ½ Σ P_jk ∂²f/∂x_j∂x_k``. A filter that leaves this out attributes it to the coefficients of f.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import sympy

from siq.dynamics.dynamics import Dynamics, Input
from siq.dynamics.parametric import Signals, symbol


class ClosedFunctions:
    """F with the effect of a spread, its derivatives, and the outputs.

    The methods are those of `siq.dynamics.parametric.ParametricFunctions`, for f between samples.

    Parameters
    ----------
    model
        The dynamics without the closure.
    """

    def __init__(self, model: Dynamics) -> None:
        d = model.dimension
        self._pairs = [(j, k) for j in range(d) for k in range(j + 1)]
        names = [f"_spread_{j}_{k}" for j, k in self._pairs]
        equations = []
        for formula in model.equations:
            bent = sympy.S.Zero
            for (j, k), name in zip(self._pairs, names, strict=True):
                second = formula.diff(model.symbols[j], model.symbols[k])
                bent += second * symbol(name) * (sympy.Rational(1, 2) if j == k else 1)
            equations.append(formula + bent)
        further = tuple(Input(name, "1", "zero_order") for name in names)
        self._closed = replace(
            model, equations=tuple(equations), inputs=(*model.inputs, *further), covariance=None
        )

    def at(self, spread: np.ndarray) -> FunctionsAtSpread:
        """The functions for one covariance at each interval, shape ``(n, d, d)``."""
        return FunctionsAtSpread(self._closed, np.stack([spread[:, j, k] for j, k in self._pairs]))


class FunctionsAtSpread:
    """`ClosedFunctions` with the covariances inserted."""

    def __init__(self, closed: Dynamics, spread: np.ndarray) -> None:
        self._closed, self._spread = closed, spread

    def rates(self, x: np.ndarray, signals: Signals, values: np.ndarray) -> np.ndarray:
        """Mean of f at mean states ``(d, n)``: shape ``(d, n)``."""
        return self._closed.functions.rates(x, self._with_spread(signals), values)

    def slopes(self, x: np.ndarray, signals: Signals, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Its derivatives by states and by free parameters: ``(d, d, n)`` and ``(d, p, n)``."""
        return self._closed.functions.slopes(x, self._with_spread(signals), values)

    def at_intervals(self, chosen: np.ndarray) -> FunctionsAtSpread:
        """Those of some of the intervals, by their places."""
        return FunctionsAtSpread(self._closed, self._spread[:, chosen])

    def _with_spread(self, signals: Signals) -> Signals:
        return replace(signals, inputs=np.concatenate([signals.inputs, self._spread]))
