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
    """What is expected of the free parameters of a model: combinations of them are normal, of unit width.

    Attributes
    ----------
    rows
        The combinations, shape ``(r, p)``.
    middle
        What is expected of each, shape ``(r,)``.
    """

    rows: np.ndarray
    middle: np.ndarray

    @classmethod
    def of(cls, model: Dynamics) -> Expectations:
        """Those of a model's free parameters, each by itself, and of several together."""
        free = {model.parameters[place].name: column for column, place in enumerate(model.free)}
        values = {each.name: each.value for each in model.parameters}
        rows, middle = [np.zeros((0, len(free)))], [np.zeros(0)]
        for column in free.values():
            expected = model.parameters[model.free[column]].expected
            if expected:
                rows.append(np.zeros((1, len(free))))
                rows[-1][0, column] = 1 / abs(expected)
                middle.append(np.array([np.sign(expected)]))
        for each in model.expected_together:
            mine = [place for place, name in enumerate(each.names) if name in free]
            if mine:
                rows.append(np.zeros((len(each.roots), len(free))))
                roots = np.sqrt(each.weight) * each.roots
                rows[-1][:, [free[each.names[place]] for place in mine]] = roots[:, mine]
                known = [0.0 if name in free else values[name] for name in each.names]
                middle.append(-roots @ np.array(known))
        return cls(np.concatenate(rows), np.concatenate(middle))

    def deviations(self, values: np.ndarray) -> np.ndarray:
        """How far values ``(p,)`` of the free parameters fall short, in units of what may be, ``(r,)``."""
        return self.middle - self.rows @ values

    def beside(
        self, columns: np.ndarray, innovations: np.ndarray, values: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Columns ``(n, p)`` and innovations ``(n,)`` with one row more for each expectation."""
        if not len(self.rows):
            return columns, innovations
        return np.concatenate([columns, self.rows]), np.concatenate([innovations, self.deviations(values)])


def with_expectations(model: Dynamics) -> Dynamics:
    """A model whose free parameters are expected to be about as they are; zero says nothing of a size."""
    parameters = (
        each if each.fixed or each.value == 0 else replace(each, expected=each.value)
        for each in model.parameters
    )
    return replace(model, parameters=tuple(parameters))
