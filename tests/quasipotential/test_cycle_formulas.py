"""V about limit cycles as a formula in phase and distance, and times of leaving a cycle."""

from __future__ import annotations

import numpy as np
import pytest
import sympy
from scipy.integrate import quad

from siq import Dynamics, Landscape, NumericalFailure
from siq.quasipotential.power_series import CycleFormula
from siq.systems.cycles import Cycle, closed_orbit, hessians_along

x, y, z = (sympy.Symbol(name, real=True) for name in "xyz")
RADIUS = x**2 + y**2


def cycle_of(system: Dynamics, points: np.ndarray, period: float) -> Cycle:
    return closed_orbit(system, points, period, scale=np.ptp(points, axis=0))


def circle(radius: float = 1.0, *, turn: int = 1) -> np.ndarray:
    phase = turn * 2 * np.pi * np.arange(256) / 256
    return radius * np.stack([np.cos(phase), np.sin(phase)], axis=1)


@pytest.mark.parametrize("turn", [2, -2])
def test_a_circle_has_its_three_terms_and_no_others(turn: int) -> None:
    """x(1 - x² - y²) and a rotation: V = (1 - r²)²/4 = s² + s³ + s⁴/4, s = r - 1."""
    system = Dynamics.of((x, y), (x * (1 - RADIUS) - turn * y, y * (1 - RADIUS) + turn * x))
    found = CycleFormula.of(system, cycle_of(system, circle(turn=int(np.sign(turn))), np.pi))
    table = found.terms()
    side = -np.sign(turn)  # to the left of the motion lies the middle, if it turns to the left
    assert table[["power", "harmonic"]].to_numpy().tolist() == [[2, 0], [3, 0], [4, 0]]
    assert table.cosine.tolist() == pytest.approx([1.0, side, 0.25], abs=1e-9)
    assert table.sine.tolist() == pytest.approx([0.0, 0.0, 0.0])
    assert found.residual < 1e-8 and found.level == pytest.approx(0.25, rel=0.05)
    points = np.random.default_rng(0).normal(scale=0.8, size=(500, 2))
    exact = (1 - (points**2).sum(axis=1)) ** 2 / 4
    value = found.values(points)
    known = ~np.isnan(value)
    assert known.mean() > 0.7
    assert value[known] == pytest.approx(exact[known], abs=1e-10)
    assert (exact[~known] > 0.9 * found.level).all()


@pytest.mark.slow
def test_a_cycle_that_is_no_circle_has_the_exact_potential() -> None:
    """V = k (h - c)²/2 with h = (x² + y²)/2 - x³/3 and a field along its levels, 6 here."""
    level, half = RADIUS / 2 - x**3 / 3, sympy.Rational("0.08")
    potential = 20 * (level - half) ** 2 / 2
    field = (-potential.diff(x) + 6 * level.diff(y), -potential.diff(y) - 6 * level.diff(x))
    landscape = Landscape.from_equations(Dynamics.of((x, y), field, domain=[(-0.7, 1.3), (-0.7, 0.7)]))
    found = landscape.about_cycle(0)
    points = np.random.default_rng(1).uniform(-0.6, 0.6, (2000, 2))
    value, exact = found.values(points), sympy.lambdify((x, y), potential)(*points.T)
    known = ~np.isnan(value)
    assert known.sum() > 100 and found.residual < 0.02
    # By the share of the residual V may be off.
    assert (np.abs(value - exact)[known] <= 1.5 * found.residual * exact[known] + 1e-9).all()
    assert found.level > 0.1 * 10 * (1 / 6 - 0.08) ** 2


def test_noise_that_depends_on_the_state_stands_in_the_formula() -> None:
    """With D = d(r) and f = -D∇V + rotation, V is the same."""
    noise = 1 + RADIUS / 2
    potential = (1 - RADIUS) ** 2 / 4
    field = (-noise * potential.diff(x) - y, -noise * potential.diff(y) + x)
    system = Dynamics.of((x, y), field, diffusion=[[noise, 0], [0, noise]])
    found = CycleFormula.of(system, cycle_of(system, circle(), 2 * np.pi))
    assert found.terms().cosine.tolist() == pytest.approx([1.0, -1.0, 0.25], abs=1e-8)


def test_an_oscillator_of_van_der_pol_solves_the_equation_where_it_says() -> None:
    for strength in (0.5, 2.0):
        system = Dynamics.of((x, y), (y, strength * (1 - x**2) * y - x), domain=[(-3, 3), (-5, 5)])
        found = Landscape.from_equations(system).about_cycle(0)
        assert 0 < found.residual < 0.02 and found.level > 0
        hessians = hessians_along(system, found.cycle)
        across = np.einsum(
            "ni,nij,nj->n",
            found._frame(np.arange(len(hessians)) / len(hessians) * found.cycle.period)[2],
            hessians,
            found._frame(np.arange(len(hessians)) / len(hessians) * found.cycle.period)[2],
        )
        assert found.coefficients[0] == pytest.approx(across / 2)


def test_what_has_no_formula_says_so() -> None:
    with_axis = Dynamics.of((x, y, z), (x * (1 - RADIUS) - y, y * (1 - RADIUS) + x, -z))
    points = np.column_stack([circle(), np.zeros(256)])
    cycle = closed_orbit(with_axis, points, 2 * np.pi, scale=np.ones(3))
    with pytest.raises(NumericalFailure, match="two states only"):
        CycleFormula.of(with_axis, cycle)
    wells = Landscape.from_equations(Dynamics.of((x, y), (x - x**3, -y), domain=[(-2, 2), (-1, 1)]))
    with pytest.raises(NumericalFailure, match="ask for 'potential'"):
        wells.about_cycle(0)


@pytest.mark.slow
def test_leaving_a_cycle_takes_as_long_as_by_exact_quadrature() -> None:
    """Rings with dV/dr = r (r² - a²)(r² - 1): a point, and a cycle, which is left inwards."""
    slope = (RADIUS - sympy.Rational(9, 25)) * (RADIUS - 1)
    system = Dynamics.of((x, y), (-x * slope - 2 * y, -y * slope + 2 * x), domain=[(-1.8, 1.8)] * 2)
    landscape, noise = Landscape.from_equations(system), 0.012
    table = landscape.verify_times(noise=noise, seed=1)
    inner, outer = landscape._cores(noise)
    radius = np.sqrt(2 * inner.level / inner.hessian[0, 0])
    edge = 1 - np.sqrt(2 * outer.level / np.linalg.eigvalsh(outer.hessian)[-1])

    def weight(r: float) -> float:
        """ln of the density over the radius: -U/ε + ln r."""
        return -2 / noise * (r**6 / 6 - 1.36 * r**4 / 4 + 0.36 * r**2 / 2) + np.log(r)

    def time(begin: float, end: float) -> float:
        far = 2.0 if end < begin else 0.0

        def inside(r: float) -> float:
            return abs(quad(lambda s: np.exp(weight(s) - weight(r)), far, r, limit=200)[0]) * 2 / noise

        return abs(quad(inside, begin, end, limit=200)[0])

    for row, exact in zip(table.itertuples(), (time(1e-9, edge), time(1.0, radius)), strict=True):
        assert row.law == pytest.approx(exact, rel=0.2) and row.law_error > 0.1
        assert row.check == pytest.approx(exact, abs=3 * row.relative_error * exact)
        assert row.relative_error < 0.12
