"""The power series of V at an attractor, and its third powers in many states."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
import sympy
from known_systems import (
    KnownSystem,
    archetype,
    linear_system,
    maier_stein,
    polynomial_system,
    potential_gradient,
    potential_values,
)

from siq.quasipotential import power_series
from siq.quasipotential.hamilton_jacobi import Expansion
from siq.quasipotential.power_series import _cubic_series, local_series, quasipotential_series
from siq.systems.dynamics import Dynamics

pytestmark = pytest.mark.portable

x, y = (sympy.Symbol(name, real=True) for name in "xy")


def series_of(known: KnownSystem, degree: int, which: int = -1) -> Expansion:
    return quasipotential_series(known.dynamics, known.attractors[which], degree=degree)


def around(center: np.ndarray, radius: float, count: int = 200) -> np.ndarray:
    directions = np.random.default_rng(0).normal(size=(count, len(center)))
    return center + radius * directions / np.linalg.norm(directions, axis=1, keepdims=True)


EXACT = {
    **{f"linear {d}": partial(linear_system, d) for d in range(2, 7)},
    **{f"archetype {d}": partial(archetype, d) for d in (2, 3, 4)},
    "Maier-Stein": partial(maier_stein, 1),
    "polynomial 2": partial(polynomial_system, 2, seed=1),
    "polynomial 3": partial(polynomial_system, 3, seed=1),
}


@pytest.mark.parametrize("make", EXACT.values(), ids=EXACT)
def test_a_polynomial_quasipotential_is_found_exactly(make: Callable[[], KnownSystem]) -> None:
    known = make()
    series = series_of(known, 5)
    points = around(series.basis.center, 1.0)
    at_attractor = potential_values(known, series.basis.center[None])
    expected = potential_values(known, points) - at_attractor
    np.testing.assert_allclose(series.values(points), expected, rtol=1e-11, atol=1e-12)
    np.testing.assert_allclose(
        series.gradients(points), potential_gradient(known, points), rtol=1e-11, atol=1e-11
    )


def test_the_second_derivatives_are_those_of_the_gradient() -> None:
    series = series_of(maier_stein(3), 6)
    points, step = around(series.basis.center, 0.5, 20), 1e-5
    for state, shift in enumerate(step * np.eye(2)):
        slope = (series.gradients(points + shift) - series.gradients(points - shift)) / (2 * step)
        np.testing.assert_allclose(series.hessians(points)[:, state], slope, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("degree", [2, 3, 5, 6, 8])
def test_the_residual_falls_as_the_power_after_the_degree(degree: int) -> None:
    known = maier_stein(3)  # of which V is no polynomial
    series = series_of(known, degree)

    def residual(radius: float) -> float:
        points = around(series.basis.center, radius)
        slope = series.gradients(points)
        return float(np.abs(np.sum(slope * (known.dynamics.drift(points) + slope), axis=1)).max())

    # Small enough that the next power rules, large enough that it stands above rounding.
    assert np.log2(residual(0.04) / residual(0.02)) == pytest.approx(degree + 1, abs=0.4)


def test_the_series_turns_with_the_states() -> None:
    known = maier_stein(3)
    angle = 0.7
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    u, v = (sympy.Symbol(name, real=True) for name in "uv")
    back = dict(zip(known.dynamics.symbols, turn.T @ np.array([u, v]), strict=True))
    turned = Dynamics.of((u, v), tuple(turn @ np.array([f.subs(back) for f in known.dynamics.formulas])))
    series = series_of(known, 6)
    other = quasipotential_series(turned, turn @ series.basis.center, degree=6)
    points = around(series.basis.center, 0.5)
    np.testing.assert_allclose(other.values(points @ turn.T), series.values(points), rtol=1e-11)


def test_the_series_scales_with_the_states_and_the_time() -> None:
    known = maier_stein(3)
    scale, speed = np.array([1e-2, 1e3]), 1e-4
    u, v = (sympy.Symbol(name, real=True) for name in "uv")
    back = {x: u / scale[0], y: v / scale[1]}
    equations = tuple(speed * s * f.subs(back) for s, f in zip(scale, known.dynamics.formulas, strict=True))
    diffusion = speed * np.diag(scale**2)
    series = series_of(known, 6)
    other = quasipotential_series(
        Dynamics.of((u, v), equations, diffusion=diffusion), scale * series.basis.center, degree=6
    )
    points = around(series.basis.center, 0.5)
    np.testing.assert_allclose(other.values(points * scale), series.values(points), rtol=1e-11)


def test_a_field_that_is_no_polynomial_is_expanded_by_its_derivatives() -> None:
    # ∇V·g = 0 for any V and g = 2 (-∂V/∂y, ∂V/∂x).
    potential = sympy.cosh(x) + sympy.exp(y) - y + x * sympy.sin(y) / 3
    slope = [potential.diff(x), potential.diff(y)]
    dynamics = Dynamics.of((x, y), (-slope[0] - 2 * slope[1], -slope[1] + 2 * slope[0]))
    series = quasipotential_series(dynamics, np.zeros(2), degree=7)
    points = around(np.zeros(2), 0.1)
    expected = sympy.lambdify([x, y], potential)(*points.T) - 2
    np.testing.assert_allclose(series.values(points), expected, atol=1e-11)


@pytest.mark.parametrize(("dimension", "degree"), [(3, 6), (4, 5)])
def test_the_series_is_found_quickly(dimension: int, degree: int) -> None:
    known = archetype(dimension)
    began = time.process_time()
    series_of(known, degree)
    assert time.process_time() - began < 2


def test_a_saddle_has_no_series() -> None:
    known = maier_stein(1)
    with pytest.raises(ValueError, match="no attractor"):
        quasipotential_series(known.dynamics, np.zeros(2), degree=4)


def test_a_point_that_is_no_equilibrium_has_no_series() -> None:
    known = maier_stein(1)
    with pytest.raises(ValueError, match="no equilibrium"):
        quasipotential_series(known.dynamics, np.array([1.001, 0]), degree=4)


def test_a_kink_at_the_attractor_is_refused() -> None:
    dynamics = Dynamics.of((x, y), (-x + sympy.sqrt(sympy.Abs(y)) ** 3, -y))
    with pytest.raises(ValueError, match="no finite derivatives"):
        quasipotential_series(dynamics, np.zeros(2), degree=4)


@pytest.mark.parametrize("dimension", [2, 3])
def test_it_is_the_power_series_of_degree_three(dimension: int, monkeypatch: pytest.MonkeyPatch) -> None:
    known = polynomial_system(dimension, seed=1)
    attractor = known.attractors[0]
    x = attractor + np.random.default_rng(0).normal(size=(5, dimension))
    whole = quasipotential_series(known.dynamics, attractor, degree=3)
    monkeypatch.setattr(power_series, "MOST_STATES_OF_DEGREE_4", 0)
    gradients, hessians = local_series(known.dynamics, attractor)
    assert gradients(x) == pytest.approx(whole.gradients(x), abs=1e-10)
    assert hessians(x) == pytest.approx(whole.hessians(x), abs=1e-10)


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
    _, cube = _cubic_series(Dynamics.of(x, field), np.ones(count))
    exact = np.zeros((count,) * 3)
    exact[np.arange(count), np.arange(count), np.arange(count)] = 6.0
    assert np.abs(cube - exact).max() < 1e-9
