"""States to begin with: those that are measured as they are measured, the others as nothing contradicts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import sympy

from siq.data.recordings import Recordings
from siq.inference.measurements import first_states, measurements
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import TIME, Dynamics, Parameter, symbol

X, V = symbol("x"), symbol("v")
MODEL = Dynamics(
    ("x", "v"),
    (V, -symbol("k") * X),
    Diffusion.identity(2),
    parameters=(Parameter("k", 1.0), Parameter("a", 2.0), Parameter("b", -0.5)),
)


def first_of(measured: sympy.Expr) -> np.ndarray:
    model = replace(MODEL, outputs=(("y", measured),))
    t = 0.1 * np.arange(30)
    table = Recordings(("y",), (None,), ("r",), np.zeros(30, dtype=int), t, np.sin(t)[:, None])
    return first_states(model, measurements(table, model))


def test_a_factor_and_an_offset_are_taken_off_and_velocities_are_differences() -> None:
    x = first_of(symbol("a") * X + symbol("b"))
    t = 0.1 * np.arange(30)
    np.testing.assert_allclose(x[:, 0], (np.sin(t) + 0.5) / 2)
    np.testing.assert_allclose(x[1:-1, 1], np.cos(t[1:-1]) / 2, atol=1e-3)


def test_what_is_bent_or_depends_on_more_is_not_read_off() -> None:
    for measured in (X**2, X + TIME, X + V, X * TIME):
        np.testing.assert_array_equal(first_of(measured), 0.0)


def test_a_long_formula_is_not_multiplied_out() -> None:
    """That would take hours: of a sum of bumps over a sum of terms, say."""
    terms = sympy.Add(*(symbol("a") * X**power + TIME**power for power in range(1, 9)))
    measured = X + sympy.Add(
        *(sympy.exp(-((terms - place) ** 2 / 2)) * (terms + place) ** 40 for place in range(9))
    )
    assert first_of(measured).shape == (30, 2)
