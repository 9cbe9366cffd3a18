"""Formulas of random systems as text, and how they are evaluated."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import sympy

FUNCTIONS = {
    "exp": sympy.exp,
    "tanh": sympy.tanh,
    "sign": sympy.sign,
    "Abs": sympy.Abs,
    "Max": sympy.Max,
}
"""All that formulas of this generator may call."""

Evaluator = Callable[[Mapping[str, Any]], np.ndarray]


def evaluator(texts: Sequence[str], names: Sequence[str]) -> Evaluator:
    """Formulas as one function of named arrays.

    Parameters
    ----------
    texts
        The formulas.
    names
        All names in them.

    Returns
    -------
    callable
        Maps arrays of one shape, by name, to an array of shape ``(formulas, *shape)``.
    """
    symbols = {name: sympy.Symbol(name, real=True) for name in names}
    written = [sympy.parse_expr(text, local_dict={**symbols, **FUNCTIONS}) for text in texts]
    compiled = sympy.lambdify(list(symbols.values()), written, modules="numpy", cse=True)

    def evaluate(values: Mapping[str, Any]) -> np.ndarray:
        given = [values[name] for name in names]
        shape = np.broadcast_shapes(*(np.shape(each) for each in given))
        with np.errstate(all="ignore"):
            return np.array([np.broadcast_to(each, shape) for each in compiled(*given)])

    return evaluate
