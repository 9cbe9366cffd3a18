"""Characteristics and power series where D depends on the state."""

from __future__ import annotations

import numpy as np
import pytest
from known_noise import multiplicative, one_state, potential_of_one_state
from known_systems import potential_gradient, potential_values

from siq.dynamics.equilibria import hessian_at
from siq.reference.characteristics import characteristics
from siq.reference.mesh import mesh_quasipotential
from siq.reference.power_series import quasipotential_series
from siq.reference.sheets import even_directions


@pytest.mark.parametrize("dimension", [2, *(pytest.param(d, marks=pytest.mark.slow) for d in (3, 4))])
def test_characteristics_carry_the_given_potential_and_its_derivatives(dimension: int) -> None:
    known = multiplicative(dimension)
    center = known.attractors[1]
    fan = characteristics(
        known.dynamics, center, level=0.2, box=known.domain,
        directions=even_directions(dimension, 12, generator=np.random.default_rng(0)),
    )  # fmt: skip
    expected = potential_values(known, fan.points) - potential_values(known, center[None])
    assert expected.max() > 0.1
    np.testing.assert_allclose(fan.values, expected, rtol=1e-6, atol=1e-9)
    slopes = potential_gradient(known, fan.points)
    np.testing.assert_allclose(fan.momenta, slopes, atol=1e-7)
    for state, step in enumerate(1e-5 * np.eye(dimension)):
        second = potential_gradient(known, fan.points + step) - potential_gradient(known, fan.points - step)
        np.testing.assert_allclose(fan.hessians[:, state], second / 2e-5, atol=1e-4)


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("which", [0, 1])
def test_a_polynomial_potential_is_found_exactly_by_its_series(dimension: int, which: int) -> None:
    known = multiplicative(dimension)
    center = known.attractors[which]
    series = quasipotential_series(known.dynamics, center, degree=5)
    points = center + np.random.default_rng(0).normal(size=(50, dimension))
    expected = potential_values(known, points) - potential_values(known, center[None])
    np.testing.assert_allclose(series.evaluate(points), expected, rtol=1e-10, atol=1e-10)


def test_the_series_of_one_state_is_that_of_the_quadrature() -> None:
    known = one_state()
    series = quasipotential_series(known.dynamics, known.attractors[1], degree=8)
    for x in (0.9, 1.1):
        expected = potential_of_one_state(known, 1.0, x)
        assert series.evaluate(np.array([[x]]))[0] == pytest.approx(expected, rel=2e-6)


def test_the_mesh_says_that_it_knows_only_a_constant_d() -> None:
    known = multiplicative(2)
    center = known.attractors[0]
    with pytest.raises(ValueError, match="the same everywhere"):
        mesh_quasipotential(
            known.dynamics.drift, center, hessian=hessian_at(known.dynamics, center), box=known.domain,
            shape=(20, 20), diffusion=known.dynamics.diffusion, level=0.1,
        )  # fmt: skip
