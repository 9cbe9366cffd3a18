from __future__ import annotations

import numpy as np
import sympy
from known_systems import KnownSystem, archetype, exact_field, uniform_points

from siq.systems.dynamics import Dynamics


def test_what_was_identified_is_dynamics_with_its_coefficients_as_parameters() -> None:
    known = archetype(2)
    found = exact_field(known, 3, relative_error=1e-3)
    dynamics, points = found.dynamics, uniform_points(known, 20)
    np.testing.assert_allclose(dynamics.drift(points), known.dynamics.drift(points), rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(dynamics.values, found.values)
    assert dynamics.covariance is found.covariance
    assert [each.name for each in dynamics.parameters] == [f"c{k}" for k in range(len(found.values))]
    assert dynamics.free == tuple(range(len(found.values)))
    moved = dynamics.with_values(2 * found.values)
    np.testing.assert_allclose(moved.drift(points), 2 * dynamics.drift(points), rtol=1e-13, atol=1e-13)


def test_parameters_have_names_that_no_state_has() -> None:
    c0 = sympy.Symbol("c0", real=True)
    known = KnownSystem(Dynamics.of((c0,), (c0 - c0**3,)), None, np.zeros((0, 1)), np.array([[-2.0, 2.0]]))
    dynamics = exact_field(known, 3).dynamics
    assert [each.name for each in dynamics.parameters] == ["c_0", "c_1"]
    x = np.array([[0.5]])
    np.testing.assert_allclose(dynamics.drift(x), x - x**3, rtol=1e-14)
