"""Third powers of V in eigenvectors are those of the power series, and need no more states to be few."""

from __future__ import annotations

import numpy as np
import pytest
from known_systems import polynomial_system

from siq.reference.cubic_series import cubic_series
from siq.reference.power_series import quasipotential_series


@pytest.mark.parametrize("dimension", [2, 3])
def test_it_is_the_power_series_of_degree_three(dimension: int) -> None:
    known = polynomial_system(dimension, seed=1)
    attractor = known.attractors[0]
    x = attractor + np.random.default_rng(0).normal(size=(5, dimension))
    cubic, whole = (
        cubic_series(known.dynamics, attractor),
        quasipotential_series(known.dynamics, attractor, degree=3),
    )
    assert cubic.gradient(x) == pytest.approx(whole.gradient(x), abs=1e-10)
    assert cubic.hessian(x) == pytest.approx(whole.hessian(x), abs=1e-10)
