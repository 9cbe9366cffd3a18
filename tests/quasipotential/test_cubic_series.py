"""Third powers of V in eigenvectors are those of the power series, and need no more states to be few."""

from __future__ import annotations

import numpy as np
import pytest
import sympy
from known_systems import polynomial_system

from siq.quasipotential.power_series import cubic_series, quasipotential_series
from siq.systems.dynamics import Dynamics

pytestmark = pytest.mark.portable


@pytest.mark.parametrize("dimension", [2, 3])
def test_it_is_the_power_series_of_degree_three(dimension: int) -> None:
    known = polynomial_system(dimension, seed=1)
    attractor = known.attractors[0]
    x = attractor + np.random.default_rng(0).normal(size=(5, dimension))
    cubic, whole = (
        cubic_series(known.dynamics, attractor),
        quasipotential_series(known.dynamics, attractor, degree=3),
    )
    assert cubic.gradients(x) == pytest.approx(whole.gradients(x), abs=1e-10)
    assert cubic.hessians(x) == pytest.approx(whole.hessians(x), abs=1e-10)


def test_of_a_long_chain_that_turns_it_is_exact() -> None:
    """``f = (A - 1)∇Φ`` has V = Φ, and eigenvectors that are all but parallel."""
    count = 40
    x = sympy.symbols(f"x:{count}", real=True)
    slope = [s**3 - s for s in x]
    for place in range(count - 1):
        slope[place] += 2 * (x[place] - x[place + 1])
        slope[place + 1] += 2 * (x[place + 1] - x[place])
    field = [-each for each in slope]
    for place in range(count - 1):
        field[place] += slope[place + 1] / 2
        field[place + 1] -= slope[place] / 2
    found = cubic_series(Dynamics.of(x, field), np.ones(count))
    exact = np.zeros((count,) * 3)
    exact[np.arange(count), np.arange(count), np.arange(count)] = 6.0
    assert np.abs(found.cube - exact).max() < 1e-9
