from __future__ import annotations

import numpy as np
import pytest
import sympy

from siq.errors import NumericalFailure
from siq.systems.dynamics import Dynamics
from siq.systems.equilibria import hessian_at, measure_at, unreached_states

X, V, Z = sympy.symbols("x v z", real=True)


def test_noise_reaches_a_position_by_its_velocity_and_not_the_other_way() -> None:
    noise = np.diag([0.0, 1.0, 0.0])
    assert unreached_states(Dynamics.of((X, V, Z), (V, -X - V, -Z), diffusion=noise)) == ("z",)
    assert unreached_states(Dynamics.of((X, V, Z), (V, -X - V, X - Z), diffusion=noise)) == ()
    assert unreached_states(Dynamics.of((X, V), (-X, X - V), diffusion=np.diag([0.0, 1.0]))) == ("x",)
    by_state = Dynamics.of((X, V), (V, -X - V), diffusion=[[0, 0], [0, 1 + X**2]])
    assert unreached_states(by_state) == ()


@pytest.mark.parametrize("units", [1.0, 1e-9])
def test_the_curvature_of_v_about_a_damped_particle_is_that_of_its_energy(units: float) -> None:
    friction, noise, stiffness = 0.3, 0.7, 2.0
    system = Dynamics.of(
        (X, V), (V, -stiffness * X - friction * V), diffusion=np.diag([0.0, noise * units**2])
    )
    expected = friction / noise * np.diag([stiffness, 1.0]) / units**2
    np.testing.assert_allclose(
        hessian_at(system, np.zeros(2)), expected, rtol=1e-12, atol=1e-12 * expected.max()
    )


def test_states_that_noise_moves_alike_only_are_named() -> None:
    """The graph of the equations cannot tell that x - z comes to rest: Kalman's condition does."""
    alike = Dynamics.of((X, V, Z), (-X + V, -V, -Z + V), diffusion=np.diag([0.0, 1.0, 0.0]))
    assert unreached_states(alike) == ()
    with pytest.raises(NumericalFailure, match="does not reach x and z about"):
        hessian_at(alike, np.zeros(3))


def test_what_stands_in_for_a_diffusion_is_it_where_all_relaxes_alike() -> None:
    noise = np.array([[2.0, 0.3], [0.3, 1.0]])
    regular = Dynamics.of((X, V), (-3 * X, -3 * V), diffusion=noise)
    assert measure_at(regular, np.zeros(2)) is regular.diffusion
    particle = Dynamics.of((X, V), (V, -X - V), diffusion=np.diag([0.0, 1.0]))
    # K = -(tr J / d) W with W = (D/γ) diag(1/ω², 1)
    np.testing.assert_allclose(measure_at(particle, np.zeros(2)).matrix, np.diag([0.5, 0.5]), atol=1e-14)
    # No unit of time or state matters to what it measures: it scales as D does.
    slow = Dynamics.of((X, V), (V / 10, (-X - V) / 10), diffusion=np.diag([0.0, 0.1]))
    np.testing.assert_allclose(measure_at(slow, np.zeros(2)).matrix, np.diag([0.05, 0.05]), atol=1e-14)
