"""Periodic orbits of systems in which everything is known exactly, and that of van der Pol."""

from __future__ import annotations

import numpy as np
import pytest
import sympy

from siq.errors import NumericalFailure
from siq.systems.cycles import Cycle, _unstable_direction, closed_orbit, hessians_along
from siq.systems.dynamics import Dynamics

pytestmark = pytest.mark.portable

x, y, z = (sympy.Symbol(name, real=True) for name in "xyz")
INNER, OUTER, TURN = 0.6, 1.0, 2.0


def rings(*, axis: bool) -> Dynamics:
    """dV/dr = r(r² - a²)(r² - b²) and a rotation: a point and two cycles; with z²/2 beside."""
    radius = x**2 + y**2
    slope = (radius - sympy.Rational(9, 25)) * (radius - 1)
    flat = (-x * slope - 2 * y, -y * slope + 2 * x)
    return Dynamics.of((x, y, z), (*flat, -z)) if axis else Dynamics.of((x, y), flat)


def around(radius: float, *, axis: bool) -> Cycle:
    phase = np.linspace(0, 2 * np.pi, 128, endpoint=False)
    guess = 1.04 * radius * np.stack([np.cos(phase), np.sin(phase)], axis=1)
    guess = np.column_stack([guess, np.full(128, 0.03)]) if axis else guess
    return closed_orbit(rings(axis=axis), guess, 3.2, scale=np.full(2 + axis, 2.0))


def curvature(radius: float) -> float:
    """V'' of the radius."""
    return 2 * radius**2 * (radius**2 - OUTER**2 + radius**2 - INNER**2)


@pytest.mark.parametrize("axis", [False, True])
@pytest.mark.parametrize("radius", [INNER, OUTER])
def test_circles_have_their_period_and_multipliers(radius: float, axis: bool) -> None:
    cycle = around(radius, axis=axis)
    assert cycle.period == pytest.approx(np.pi, rel=1e-10)
    np.testing.assert_allclose(np.hypot(*cycle.points.T[:2]), radius, rtol=1e-9)
    exact = [np.exp(-curvature(radius) * np.pi), *([np.exp(-np.pi)] if axis else [])]
    np.testing.assert_allclose(cycle.multipliers, sorted(exact, reverse=True), rtol=1e-8)
    assert cycle.stable == (radius == OUTER) and cycle.unstable == int(radius == INNER)
    assert cycle.kind == ("cycle" if radius == OUTER else "unstable cycle")
    distance = cycle.distances(1.1 * cycle.points[:3], scale=np.ones(2 + axis))
    np.testing.assert_allclose(distance, 0.1 * radius, rtol=1e-2)


@pytest.mark.parametrize("axis", [False, True])
@pytest.mark.parametrize("radius", [INNER, OUTER])
def test_v_has_its_curvature_across_a_cycle(radius: float, axis: bool) -> None:
    """Of a stable cycle that of V; of an unstable one of what is left to climb, none along the axis."""
    cycle = around(radius, axis=axis)
    found = hessians_along(rings(axis=axis), cycle, reaching=radius == INNER)
    exact = np.zeros_like(found)
    exact[:, :2, :2] = np.einsum("ni,nj->nij", *[cycle.points[:, :2] / radius] * 2) * abs(curvature(radius))
    if axis:
        exact[:, 2, 2] = radius == OUTER
    np.testing.assert_allclose(found, exact, atol=1e-8)


def test_a_cycle_that_is_not_symmetric_has_the_curvature_of_its_v() -> None:
    """V = (x² + y⁴ + xy/2 - 1)²/4 with f = -∇V + a field along its levels: V'' is ∇h∇hᵀ/2 where h = 0."""
    level = x**2 + y**4 + x * y / 2 - 1
    f = tuple(-level * level.diff(s) / 2 + g for s, g in ((x, -level.diff(y)), (y, level.diff(x))))
    system = Dynamics.of((x, y), f)
    phase = np.linspace(0, 2 * np.pi, 256, endpoint=False)
    guess = settled(system, np.stack([np.cos(phase), np.sin(phase)], axis=1)[:1])
    cycle = closed_orbit(system, *guess, scale=np.full(2, 2.0))
    slope = np.stack([2 * cycle.points[:, 0] + cycle.points[:, 1] / 2,
                      4 * cycle.points[:, 1] ** 3 + cycle.points[:, 0] / 2], axis=1)  # fmt: skip
    exact = np.einsum("ni,nj->nij", slope, slope) / 2
    np.testing.assert_allclose(hessians_along(system, cycle), exact, atol=1e-7)


def settled(system: Dynamics, start: np.ndarray) -> tuple[np.ndarray, float]:
    """States of one period and the period, as seen on a trajectory by the rule of Runge and Kutta."""
    at, step, states = start, 0.005, []
    for _ in range(6000):
        k1 = system.drift(at)
        k2 = system.drift(at + step / 2 * k1)
        k3 = system.drift(at + step / 2 * k2)
        at = at + step / 6 * (k1 + 2 * k2 + 2 * k3 + system.drift(at + step * k3))
        states.append(at[0])
    way = np.array(states)
    above = np.flatnonzero((way[:-1, 1] < 0) & (way[1:, 1] >= 0))
    first, last = above[-2:]
    return way[np.linspace(first, last, 256, endpoint=False).astype(int)], (last - first) * step


def test_van_der_pol_has_the_period_known_to_ten_digits() -> None:
    system = Dynamics.of((x, y), (y, (1 - x**2) * y - x))
    cycle = closed_orbit(system, *settled(system, np.array([[2.0, 0.0]])), scale=np.array([4.0, 5.0]))
    assert cycle.period == pytest.approx(6.6632868593, rel=1e-10)
    # Liouville: the product of the multipliers is exp ∮ div f dt.
    assert cycle.multipliers[0].real == pytest.approx(
        np.exp(cycle.period * (1 - cycle.points[:, 0] ** 2).mean()), rel=1e-8
    )


def test_what_grows_leads_away_from_a_cycle() -> None:
    cycle = around(INNER, axis=True)
    direction = _unstable_direction(rings(axis=True), cycle, scale=np.ones(3))
    assert abs(direction @ cycle.points[0]) / INNER == pytest.approx(1, rel=1e-5)


def test_where_there_is_no_cycle_none_is_found() -> None:
    phase = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    guess = 0.02 * np.stack([np.cos(phase), np.sin(phase)], axis=1)
    with pytest.raises(NumericalFailure):
        closed_orbit(rings(axis=False), guess, np.pi, scale=np.full(2, 2.0))
    with pytest.raises(NumericalFailure, match="no curvature"):
        hessians_along(rings(axis=False), around(INNER, axis=False))
