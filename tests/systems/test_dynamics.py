from __future__ import annotations

import numpy as np
import pytest
import sympy

from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics, Parameter

x, y, a, b, t = sympy.symbols("x y a b t", real=True)
POINTS = np.random.default_rng(0).normal(size=(7, 2))


def fitted() -> Dynamics:
    return Dynamics(
        ("x", "y"), (a * x - b * x**3, -y / a + sympy.sin(x * y)), Diffusion.identity(2),
        parameters=(Parameter("a", 2.0), Parameter("b", 0.3)),
    )  # fmt: skip


def test_values_stand_in_the_formulas_and_symbols_in_the_equations() -> None:
    found = fitted()
    assert found.equations[0].free_symbols == {a, b, x}
    assert found.formulas[0].free_symbols == {x}
    assert found.formulas[0].is_polynomial(x)
    other = found.with_values(np.array([1.0, 0.5]))
    np.testing.assert_array_equal(other.values, [1.0, 0.5])
    expected = POINTS[:, 0] - 0.5 * POINTS[:, 0] ** 3
    np.testing.assert_allclose(other.drift(POINTS)[:, 0], expected, rtol=1e-14)


def test_derivatives_are_those_of_the_drift() -> None:
    found, step = fitted(), 1e-6
    for j, shift in enumerate(step * np.eye(2)):
        slope = (found.drift(POINTS + shift) - found.drift(POINTS - shift)) / (2 * step)
        np.testing.assert_allclose(found.jacobian(POINTS)[:, :, j], slope, atol=1e-8)
        bend = (found.jacobian(POINTS + shift) - found.jacobian(POINTS - shift)) / (2 * step)
        np.testing.assert_allclose(found.hessian(POINTS)[..., j], bend, atol=1e-7)
    np.testing.assert_array_equal(found.drift_of_components(POINTS.T), found.drift(POINTS).T)


def test_a_drift_that_depends_on_the_time_is_no_function_of_the_state() -> None:
    driven = Dynamics.of((x,), (sympy.cos(t) - x,))
    assert not driven.autonomous
    with pytest.raises(ValueError, match="no function of x alone"):
        driven.drift(POINTS[:, :1])


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({"equations": (-x,)}, "1 equations for 2 states"),
        ({"units": ("m",)}, "1 units for 2 states"),
        ({"diffusion": Diffusion.identity(3)}, "3 rows of D for 2 states"),
        ({"domain": np.zeros((3, 2))}, r"the domain has the shape \(3, 2\)"),
    ],
)
def test_what_does_not_fit_the_states_is_refused(change: dict[str, object], fault: str) -> None:
    good = {"states": ("x", "y"), "equations": (-x, -y), "diffusion": Diffusion.identity(2)}
    with pytest.raises(ValueError, match=fault):
        Dynamics(**(good | change))  # type: ignore[arg-type]


def test_a_domain_that_nobody_said_is_asked_for() -> None:
    with pytest.raises(ValueError, match="no domain of x, y is known"):
        _ = fitted().box


def test_symbols_without_assumptions_are_the_states_all_the_same() -> None:
    known = Dynamics.of((x, y), (a * x - x**3 + y, -y), diffusion=[[1 + x**2, 0], [0, 1]], parameters={a: 2})
    u, v, c = sympy.symbols("x", positive=True), sympy.Symbol("y"), sympy.Symbol("a")
    given = Dynamics.of((u, v), (c * u - u**3 + v, -v), diffusion=[[1 + u**2, 0], [0, 1]], parameters={c: 2})
    states = np.array([[0.5, 1.0], [-1.0, 0.3]])
    assert np.array_equal(given.jacobian(states), known.jacobian(states))
    assert given.equations == known.equations
    assert np.array_equal(given.diffusion.at(states), known.diffusion.at(states))


def test_a_symbol_without_a_value_is_named() -> None:
    with pytest.raises(ValueError, match="'b' is no state and no parameter"):
        Dynamics.of((x,), (b * x - x**3,))


def test_what_formulas_divide_by_changes_by_its_inverse() -> None:
    n, r, k, half = sympy.symbols("n r K half", real=True)
    model = Dynamics(
        ("n",), (r * n * (1 - n / k) - n / (half + n),), Diffusion.identity(1), domain=np.array([[0.0, 9.0]]),
        parameters=(Parameter("r", 1.0), Parameter("K", 4.0), Parameter("half", 2.0)),
    )  # fmt: skip
    assert model.divisors == {1: 0}
    tau = sympy.Symbol("tau", real=True)
    decay = Dynamics.of((n,), (-n / tau,), domain=[(0, 9)], parameters={tau: 2.0})
    assert decay.divisors == {}
    # r/K changes straight: by its slopes at first, and twice as much along twice the way.
    near, twice = (model.moved(each * np.array([0.1, 1.0, 0.2])).values for each in (1e-6, 2e-6))
    assert near[0] / near[1] - 1 / 4 == pytest.approx(1e-6 * (0.1 / 4 - 1 / 16), rel=1e-6)
    assert twice[0] / twice[1] - 1 / 4 == pytest.approx(2 * (near[0] / near[1] - 1 / 4), rel=1e-6)
    np.testing.assert_allclose(twice[[0, 2]], [1 + 2e-7, 2 + 4e-7])
