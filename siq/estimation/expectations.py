"""Expectations: what a card's values say of parameters that recordings do not tell.

Whoever writes a value on a card knows its order of magnitude. A parameter of a hidden state may be told by
nothing else, and a fit without expectations moves it anywhere, along with the hidden state, to gain next to
nothing. So a value is expected about that of the card, within its own size: a normal prior, as weak as that.
What recordings do tell, they tell far better.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from siq.dynamics.dynamics import Dynamics


@dataclass(frozen=True)
class Expectations:
    """What is expected of the free parameters of a model.

    Attributes
    ----------
    values
        Expected, shape ``(p,)``; NaN where nothing is.
    """

    values: np.ndarray

    @classmethod
    def of(cls, model: Dynamics) -> Expectations:
        """Those of a model's free parameters."""
        expected = [model.parameters[place].expected for place in model.free]
        return cls(np.array([np.nan if each is None else each for each in expected], dtype=float))

    @property
    def weights(self) -> np.ndarray:
        """One over the size of each, zero where nothing is expected, shape ``(p,)``."""
        known = np.isfinite(self.values) & (self.values != 0)
        return np.where(known, 1.0 / np.where(known, np.abs(self.values), 1.0), 0.0)

    def deviations(self, values: np.ndarray) -> np.ndarray:
        """How far values ``(p,)`` of the free parameters fall short, in units of what may be, ``(p,)``."""
        return np.where(self.weights > 0, (np.nan_to_num(self.values) - values) * self.weights, 0.0)

    def beside(
        self, columns: np.ndarray, innovations: np.ndarray, values: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Columns ``(n, p)`` and innovations ``(n,)`` with one row more for each parameter."""
        if not self.weights.any():
            return columns, innovations
        return (
            np.concatenate([columns, np.diag(self.weights)]),
            np.concatenate([innovations, self.deviations(values)]),
        )


def with_expectations(model: Dynamics) -> Dynamics:
    """A model whose free parameters are expected to be about as they are; zero says nothing of a size."""
    parameters = (
        each if each.fixed or each.value == 0 else replace(each, expected=each.value)
        for each in model.parameters
    )
    return replace(model, parameters=tuple(parameters))
