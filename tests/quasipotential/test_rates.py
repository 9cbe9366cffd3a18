from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import sympy
from known_escapes import compressible, exit_time, line_exit_time
from known_paths import MATRICES, pairs, path_of, resonator, transformed
from known_systems import (
    KnownSystem,
    archetype,
    double_well,
    limit_cycle,
    maier_stein,
    polynomial_system,
    potential_gradient,
    uniform_points,
)
from scipy.integrate import solve_ivp

from siq.errors import NumericalFailure
from siq.quasipotential.path_chains import MinimumActionPath
from siq.quasipotential.paths import minimum_action_path
from siq.quasipotential.rates import EscapeRate, NoiseStrength, _Frame, escape_rate, mean_residence_time
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics, symbol
from siq.systems.equilibria import find_equilibria, hessian_at
from siq.systems.formulas import compile_formulas


def rate_of(known: KnownSystem, end: np.ndarray, *, which: int = 0, **options: object) -> EscapeRate:
    path = path_of(known, end, which=which, tolerance=1e-5)
    return escape_rate(known.dynamics, path, **options)


def leading(rate: EscapeRate, intensity: float) -> float:
    """The law without its correction."""
    return replace(rate, correction=0.0).mean_time(intensity)


def exact_hessian(known: KnownSystem) -> Callable[[np.ndarray], np.ndarray]:
    """∇²V at points ``(n, d)``, from the known V."""
    symbols = known.dynamics.symbols
    function = compile_formulas([known.potential.diff(a, b) for a in symbols for b in symbols], symbols)
    return lambda x: function(np.ascontiguousarray(x.T)).T.reshape(len(x), len(symbols), len(symbols))


def test_with_one_state_the_law_is_the_limit_of_the_exact_time() -> None:
    known = double_well(1)
    rate = rate_of(known, np.sort(np.roots([1, 0, -1, 0.1]).real)[1:2])
    assert rate.exponent == pytest.approx(0, abs=1e-5)
    assert rate.remarks == ()
    first, second = (
        line_exit_time(known, rate.barrier / one) / leading(rate, rate.barrier / one) for one in (20, 40)
    )
    assert 0.01 < second - 1 < first - 1 < 0.04
    assert 2 * second - first == pytest.approx(1, abs=2e-3)
    # The correction is what the law leaves out to the first order of ε: a fourth is left with twice ΔU/ε.
    first, second = (
        line_exit_time(known, rate.barrier / one) / rate.mean_time(rate.barrier / one) for one in (20, 40)
    )
    assert second - 1 == pytest.approx((first - 1) / 4, rel=0.2) and first - 1 < 0.003


@pytest.mark.parametrize(
    ("height", "share"), [("1 - cos(x)", 0.5), ("x**2/2 - x**3/3", 5 / 18), ("(x**2 - 1)**2/4", 0.375)]
)
def test_the_correction_is_that_of_integrals_known_in_closed_form(height: str, share: float) -> None:
    # Bessel's I₀ of a cosine, Airy's functions of a cubic, parabolic cylinder functions of a quartic.
    x = symbol("x")
    potential = sympy.sympify(height, locals={"x": x})
    dynamics = Dynamics(
        states=("x",), equations=(-sympy.Float(7) * potential.diff(x),),
        diffusion=Diffusion(np.array([[7.0]])),
    )  # fmt: skip
    start, end = {"1 - cos(x)": (0, np.pi), "x**2/2 - x**3/3": (0, 1)}.get(height, (-1, 0))
    rate = escape_rate(dynamics, minimum_action_path(dynamics, np.array([float(start)]), np.array([end])))
    assert rate.correction * rate.barrier == pytest.approx(share, rel=1e-4) and rate.unknown == 0
    time = rate.mean_exit_time(NoiseStrength(rate.barrier / 5))
    assert time is not None and time.law_error == pytest.approx(share / 25, rel=1e-4)


@pytest.mark.parametrize("which", [0, 1])
def test_without_circulation_it_is_the_law_of_kramers(which: int) -> None:
    known, x = double_well(2), np.sort(np.roots([1, 0, -1, 0.1]).real)[1]
    saddle = np.array([x, x / 2])
    rate = rate_of(known, saddle, which=which)
    at = np.linalg.det(exact_hessian(known)(np.stack([known.attractors[which], saddle])))
    unstable = np.linalg.eigvals(known.dynamics.jacobian(saddle[None])[0]).max()
    expected = 2 * np.pi / unstable * np.sqrt(-at[1] / at[0])
    assert rate.prefactor == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_circulation_without_divergence_enters_by_the_saddles_rate_alone(dimension: int) -> None:
    known = archetype(dimension)
    rate = rate_of(known, np.zeros(dimension))
    unstable = np.linalg.eigvals(known.dynamics.jacobian(np.zeros((1, dimension)))[0]).real.max()
    assert rate.exponent == pytest.approx(0, abs=1e-4)
    assert rate.prefactor == pytest.approx(2 * np.pi / unstable * np.sqrt(2 / 4), rel=1e-4)


@pytest.mark.parametrize(("which", "exponent"), [(0, 0.5), (1, -0.5)])
def test_the_integral_along_an_axis_is_exact(which: int, exponent: float) -> None:
    rate = rate_of(compressible(0.5), np.zeros(2), which=which)
    assert rate.exponent == pytest.approx(exponent, abs=1e-4)
    assert rate.prefactor == pytest.approx(2 * np.pi / 2 * np.sqrt(2 / 4) * np.exp(exponent), rel=2e-4)


def test_second_derivatives_along_the_path_are_those_of_v() -> None:
    known = polynomial_system(2, seed=6)
    for which, saddle in pairs(known)[:1]:
        path = path_of(known, saddle, which=which, tolerance=1e-5)
        followed = escape_rate(known.dynamics, path)
        frame = _Frame(known.dynamics, path, None)
        given = frame.exponent(frame.curvature(exact_hessian(known), frame.points[::2]))
        assert abs(given) > 0.01
        assert followed.exponent == pytest.approx(given, abs=1e-3)


@pytest.mark.parametrize("dimension", [2, 4])
def test_the_hessian_at_a_saddle_follows_from_its_linearisation(dimension: int) -> None:
    known = polynomial_system(dimension, seed=1) if dimension < 3 else archetype(dimension)
    found = find_equilibria(known.dynamics, uniform_points(known, 100))
    saddles = np.array([one.position for one in found if one.kind == "saddle" and one.unstable == 1])
    assert len(saddles)
    exact = exact_hessian(known)(saddles)
    for saddle, expected in zip(saddles, exact, strict=True):
        found = hessian_at(known.dynamics, saddle)
        np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6)
        assert (np.linalg.eigvalsh(found) < 0).sum() == 1


@pytest.mark.parametrize("fast", [1, 20])
def test_noise_that_grows_fast_about_an_attractor_keeps_the_law_of_one_state(fast: int) -> None:
    """A gene with 0.02 molecules, and a state without influence: ``2π (D_S/D_A)^½ / (-f'_A f'_S)^½``.

    Series about the attractor end far closer to it than the saddle is; taken too far they gave a time that
    was too long by 10⁸.
    """
    x, y = symbol("x"), symbol("y")
    birth, death = sympy.Rational(1, 100) + 4 * x**2 / (4 + x**2), x / 2
    roots = [float(root) for root in sympy.Poly(sympy.numer(sympy.together(birth - death)), x).nroots()[:2]]
    noise, slope = sympy.lambdify(x, birth + death), sympy.lambdify(x, sympy.diff(birth - death, x))
    few, saddle = roots
    law = 2 * np.pi * np.sqrt(noise(saddle) / noise(few) / (-slope(few) * slope(saddle)))
    dynamics = Dynamics.of(
        (x, y), (birth - death, -fast * y), diffusion=[[birth + death, 0], [0, 1]], domain=[(0, 10), (-3, 3)]
    )
    path = minimum_action_path(dynamics, np.array([few, 0.0]), np.array([saddle, 0.0]))
    assert escape_rate(dynamics, path).prefactor == pytest.approx(law, rel=0.01)


@pytest.mark.parametrize("beta", [2, 3])
def test_maier_and_steins_integral_below_the_critical_strength(beta: float) -> None:
    def rates(x: float, state: np.ndarray) -> list[float]:
        bend = state[0]  # ∂²V/∂y² on the axis, where p = x³ - x = ẋ
        force = 2 * (1 + x**2) * bend - 2 * bend**2 + 2 * beta * x * (x**3 - x)
        return [force / (x**3 - x), (bend - 1 - x**2) / (x**3 - x)]

    start = -1 + 1e-6
    exact = solve_ivp(rates, [start, -1e-6], [2, 0], method="DOP853", rtol=1e-10, atol=1e-12).y
    rate = rate_of(maier_stein(beta), np.zeros(2))
    assert rate.exponent == pytest.approx(exact[1, -1], abs=1e-3)
    assert rate.remarks[0].code == "quasipotential.law_sets_in_late_by_resonance"


@pytest.mark.parametrize("beta", [5, 10])
def test_a_saddle_at_which_v_is_not_smooth_is_refused(beta: float) -> None:
    with pytest.raises(NumericalFailure, match="not smooth"):
        rate_of(maier_stein(beta), np.zeros(2))


def oblique(stable: float) -> KnownSystem:
    """Without symmetry and without a known V; the saddle at the origin attracts at a rate of choice."""
    x, y = sympy.symbols("x y", real=True)
    equations = (
        x - x**3 + 0.4 * y * x**2 + 0.2 * y**2,
        -stable * y + 2.7 * x**2 * (1 - x**2) - 0.5 * x**2 * y,
    )
    wells, domain = np.array([[-1.0, 0.0], [1.0, 0.0]]), np.array([[-1.9, 1.9], [-1.6, 2.0]])
    return KnownSystem(Dynamics.of((x, y), equations), None, wells, domain)


def test_a_saddle_that_attracts_slowly_is_refused_in_general() -> None:
    with pytest.raises(NumericalFailure, match="not smooth"):
        rate_of(oblique(0.7), np.zeros(2))
    late = rate_of(oblique(1.5), np.zeros(2)).remarks[0]
    assert late.code == "quasipotential.law_sets_in_late_by_turning"
    assert rate_of(oblique(2.5), np.zeros(2)).remarks == ()


@pytest.mark.slow
@pytest.mark.parametrize("which", [0, 1])
def test_the_law_is_the_limit_without_symmetry_too(which: int) -> None:
    known = oblique(2.5)
    rate = rate_of(known, np.zeros(2), which=which)
    first, second = (
        exit_time(known, rate.barrier / ratio, which=which, level=0.1, nodes=300)
        / leading(rate, rate.barrier / ratio)
        for ratio in (7, 10)
    )
    assert 1.02 < second < first < 1.1
    assert (10 * second - 7 * first) / 3 == pytest.approx(1, abs=0.015)


def test_a_caustic_on_the_path_is_refused() -> None:
    x = np.linspace(-1, 0, 200)
    points, momenta = np.stack([x, 0 * x], axis=1), np.stack([x**3 - x, 0 * x], axis=1)
    axis = MinimumActionPath(points, momenta, 0.5 - x**2, 0.5, 0.0, 0.0, True)
    with pytest.raises(NumericalFailure, match="caustic"):
        escape_rate(maier_stein(5).dynamics, axis)


def test_paths_from_or_to_something_else_are_refused() -> None:
    known = archetype(2)
    path = path_of(known, np.zeros(2))
    backwards = replace(path, points=path.points[::-1])
    with pytest.raises(NumericalFailure, match="no stable equilibrium"):
        escape_rate(known.dynamics, backwards)
    with pytest.raises(NumericalFailure, match="no saddle"):
        escape_rate(known.dynamics, path_of(known, np.array([-0.5, 0.2])))
    with pytest.raises(NumericalFailure, match="no stable equilibrium"):
        escape_rate(limit_cycle().dynamics, path)


def test_units_change_the_time_alone() -> None:
    known = compressible(0.5, 1.0)
    other = rate_of(transformed(known, MATRICES["both"], speed=1e-4), np.zeros(2))
    rate = rate_of(known, np.zeros(2))
    assert other.barrier == pytest.approx(rate.barrier, rel=1e-6)
    assert other.exponent == pytest.approx(rate.exponent, abs=1e-4)
    assert other.prefactor == pytest.approx(1e4 * rate.prefactor, rel=1e-4)


@pytest.mark.parametrize("which", [0, 1])
def test_the_law_is_the_limit_of_the_backward_equation(which: int) -> None:
    known = compressible(0.5)
    rate = rate_of(known, np.zeros(2), which=which)
    first, second = (
        exit_time(known, one, which=which, level=0.1, nodes=160) / leading(rate, one) for one in (0.15, 0.1)
    )
    assert 0.01 < second - 1 < first - 1 < 0.12
    assert 3 * second - 2 * first == pytest.approx(1, abs=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("which", [0, 1])
def test_the_law_is_the_limit_with_rotation_too(which: int) -> None:
    known = compressible(0.5, 1.0)
    rate = rate_of(known, np.zeros(2), which=which)
    first, second = (
        exit_time(known, one, which=which, level=0.1, nodes=400) / leading(rate, one) for one in (0.2, 0.15)
    )
    assert 4 * second - 3 * first == pytest.approx(1, abs=0.04)


def test_the_resonators_rates_stay_where_they_are() -> None:
    known, saddle = resonator()
    rates = [rate_of(known, saddle, which=which) for which in (0, 1)]
    np.testing.assert_allclose([rate.prefactor for rate in rates], [1.2515e4, 4.046e3], rtol=4e-3)
    assert all(rate.remarks == () for rate in rates)


def test_rates_add() -> None:
    rate = EscapeRate(barrier=1.0, prefactor=2.0, exponent=0.0)
    assert rate.mean_time(0.25) == pytest.approx(2 * np.exp(4))
    both = mean_residence_time([rate, rate], NoiseStrength(0.25))
    assert both is not None and both.value == pytest.approx(np.exp(4))
    with pytest.raises(NumericalFailure, match="far below the barrier"):
        rate.mean_time(1.5)


def test_a_second_path_and_a_path_that_is_not_converged_are_noted() -> None:
    known = archetype(2)
    path = path_of(known, np.zeros(2))
    doubtful = replace(path, converged=False, rivals=(path.action,))
    codes = [one.code for one in escape_rate(known.dynamics, doubtful).remarks]
    assert codes == ["quasipotential.path_not_converged", "quasipotential.second_path_of_same_action"]


def test_the_gradient_of_v_is_what_the_path_carries() -> None:
    known = compressible(0.5, 2.0)
    path = path_of(known, np.zeros(2), tolerance=1e-5)
    np.testing.assert_allclose(path.momenta, potential_gradient(known, path.points), atol=2e-5)
