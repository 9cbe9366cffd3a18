"""Characteristics, power series and meshes where D depends on the state."""

from __future__ import annotations

import numpy as np
import pytest
import sympy
from known_noise import multiplicative, one_state, potential_of_one_state
from known_systems import potential_gradient, potential_values

from siq.errors import NumericalFailure
from siq.quasipotential.characteristics import _even_directions, characteristics
from siq.quasipotential.power_series import quasipotential_series
from siq.systems.diffusion import Diffusion
from siq.systems.equilibria import hessian_at
from siq.validation.mesh import mesh_quasipotential


@pytest.mark.parametrize("dimension", [2, *(pytest.param(d, marks=pytest.mark.slow) for d in (3, 4))])
def test_characteristics_carry_the_given_potential_and_its_derivatives(dimension: int) -> None:
    known = multiplicative(dimension)
    center = known.attractors[1]
    fan = characteristics(
        known.dynamics, center, level=0.2, box=known.domain,
        directions=_even_directions(dimension, 12, generator=np.random.default_rng(0)),
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
    np.testing.assert_allclose(series.values(points), expected, rtol=1e-10, atol=1e-10)


def test_the_series_of_one_state_is_that_of_the_quadrature() -> None:
    known = one_state()
    series = quasipotential_series(known.dynamics, known.attractors[1], degree=8)
    for x in (0.9, 1.1):
        expected = potential_of_one_state(known, 1.0, x)
        assert series.values(np.array([[x]]))[0] == pytest.approx(expected, rel=2e-6)


@pytest.mark.parametrize("which", [0, 1])
def test_the_mesh_finds_the_given_potential_with_errors_of_second_order(which: int) -> None:
    known = multiplicative(2)
    center = known.attractors[which]
    sizes = []
    for nodes in (65, 129):
        mesh = mesh_quasipotential(
            known.dynamics.drift, center, hessian=hessian_at(known.dynamics, center), box=known.domain,
            shape=(nodes, nodes), diffusion=known.dynamics.diffusion, level=0.2,
        )  # fmt: skip
        x = np.stack(np.meshgrid(*mesh.axes, indexing="ij"), axis=-1)[np.isfinite(mesh.values)]
        exact = potential_values(known, x) - potential_values(known, center[None])
        assert exact.max() > 0.19
        errors = (mesh.values[np.isfinite(mesh.values)] - exact) / mesh.level
        sizes.append(np.sqrt(np.mean(errors**2)))
    assert sizes[1] < 1.5e-3  # measured 1.3e-3 and 8.2e-4
    assert np.log2(sizes[0] / sizes[1]) > 1.9


def test_the_mesh_refuses_a_box_in_which_d_is_no_covariance() -> None:
    x, y = sympy.symbols("x y", real=True)
    noise = Diffusion.of_formulas((x, y), ((x, 0), (0, 1)))
    with pytest.raises(NumericalFailure, match="not positive definite"):
        mesh_quasipotential(
            lambda points: np.stack([points[:, 0] * (1 - points[:, 0]), -points[:, 1]], axis=1),
            np.array([1.0, 0.0]), hessian=np.eye(2), box=np.array([[-0.5, 3.0], [-1.5, 1.5]]),
            shape=(65, 65), diffusion=noise,
        )  # fmt: skip
