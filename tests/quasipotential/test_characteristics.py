"""Characteristics: curves, caustics and sheets; and errors of V along ascending paths."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import sympy
from known_systems import (
    KnownSystem,
    archetype,
    exact_archetype,
    exact_field,
    linear_system,
    maier_stein,
    polynomial_system,
    potential_gradient,
    potential_values,
)
from scipy.integrate import solve_ivp

from siq.inference.diffusion_model import constant_noise
from siq.inference.field_estimate import FieldEstimate, NoiseFormula
from siq.quasipotential.characteristics import (
    End,
    Fan,
    _even_directions,
    _join,
    _potential_errors,
    _potential_slopes,
    adapted_fan,
    characteristics,
    relative_error,
)
from siq.systems.dynamics import Dynamics
from siq.systems.equilibria import hessian_at
from workflow.scoring import _exact_values

WELL = np.array([[-2.0, 0.0], [-1.5, 1.5]])  # of Maier–Stein's system, up to the separatrix
SADDLE_LEVEL = 0.25  # of V along the axis; the barrier itself is lower for β > 4


def fan_of(known: KnownSystem, *, level: float, count: int = 32, which: int = 0, **options: Any) -> Fan:
    directions = _even_directions(known.dynamics.dimension, count, generator=np.random.default_rng(0))
    options = {"box": known.domain, "directions": directions} | options
    return characteristics(known.dynamics, known.attractors[which], level=level, **options)


def escape(beta: float, *, level: float) -> Fan:
    known = maier_stein(beta)
    return adapted_fan(
        known.dynamics,
        known.attractors[0],
        level=level,
        box=WELL,
        generator=np.random.default_rng(0),
        count=48,
        most=200,
        rounds=4,
    )


@pytest.fixture(scope="module")
def strong() -> Fan:
    """Maier–Stein's well for β = 10."""
    return escape(10, level=0.18)


@pytest.mark.parametrize("dimension", [2, 3, 4])
@pytest.mark.parametrize("start_degree", [2, 4])
def test_a_linear_system_has_its_quadratic_form(dimension: int, start_degree: int) -> None:
    known = linear_system(dimension)
    fan = fan_of(known, level=0.5, count=6, box=100 * known.domain, start_degree=start_degree)
    assert (fan.ends == End.LEVEL).all()
    np.testing.assert_allclose(fan.values, potential_values(known, fan.points), rtol=1e-8)
    np.testing.assert_allclose(fan.momenta, potential_gradient(known, fan.points), rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(fan.hessians, np.broadcast_to(fan.hessian, fan.hessians.shape), atol=1e-8)
    np.testing.assert_allclose(fan.values[fan.last], 0.5, rtol=1e-7)
    assert fan.first_caustic() is None


def test_the_archetype_has_its_exact_values(archetype: Dynamics) -> None:
    fan = adapted_fan(
        archetype,
        np.array([1.0, 0, 0]),
        level=0.499,  # of V, whose saddle is at 1/2
        box=archetype.box,
        generator=np.random.default_rng(0),
        most=120,
        rounds=1,
    )
    np.testing.assert_allclose(2 * fan.values, _exact_values(exact_archetype(), fan.points.T), atol=2e-7)
    assert fan.first_caustic() is None
    assert fan.lowest_sheet().all()


def test_momenta_and_curvatures_are_the_derivatives_of_the_value() -> None:
    known = polynomial_system(2, seed=1)
    fan = fan_of(known, level=0.05, count=8)
    np.testing.assert_allclose(fan.momenta, potential_gradient(known, fan.points), rtol=1e-7, atol=1e-8)
    step = 1e-5
    for state, shift in enumerate(step * np.eye(2)):
        slope = potential_gradient(known, fan.points + shift) - potential_gradient(known, fan.points - shift)
        np.testing.assert_allclose(fan.hessians[:, state], slope / (2 * step), rtol=1e-5, atol=1e-5)


def test_units_of_the_states_and_of_time_change_nothing() -> None:
    known = maier_stein(5)
    scale, speed = np.array([1e-2, 1e2]), 1e-4
    back = {symbol: symbol / s for symbol, s in zip(known.dynamics.symbols, scale, strict=True)}
    equations = tuple(speed * s * f.subs(back) for s, f in zip(scale, known.dynamics.formulas, strict=True))
    scaled = KnownSystem(
        Dynamics.of(known.dynamics.symbols, equations, diffusion=speed * np.diag(scale**2)),
        None,
        known.attractors * scale,
        known.domain * scale[:, None],
    )
    fan, other = fan_of(known, level=0.2, count=8), fan_of(scaled, level=0.2, count=8)
    assert len(fan.points) == len(other.points)
    # The step widths follow rounding errors, so that the two agree as the integrator does with the truth.
    np.testing.assert_allclose(other.values, fan.values, rtol=1e-6)
    np.testing.assert_allclose(other.points / scale, fan.points, atol=1e-6)


def focus_on_the_axis(beta: float) -> float:
    """Where ∂²V/∂y² = tan(a) diverges along the path on the axis, from its own equation."""

    def rates(_: float, state: np.ndarray) -> list[float]:
        x, (sine, cosine) = state[0], (np.sin(state[1]), np.cos(state[1]))
        bend = 2 * beta * x * (x**3 - x)  # -p ∂²f_x/∂y² with p = x³ - x
        return [x**3 - x, 2 * (1 + x**2) * sine * cosine - 2 * sine**2 + bend * cosine**2]

    def diverges(_: float, state: np.ndarray) -> float:
        return float(state[1] + np.pi / 2)

    diverges.terminal = True  # type: ignore[attr-defined]
    start = [-1 + 1e-7, np.arctan(2)]
    path = solve_ivp(rates, [0, 40], start, events=diverges, method="DOP853", rtol=1e-11, atol=1e-13)
    return float(path.y_events[0][0, 0])


@pytest.mark.parametrize("beta", [1, 2, 3])
def test_no_caustic_below_the_saddle_where_the_path_keeps_to_the_axis(beta: float) -> None:
    fan = fan_of(maier_stein(beta), level=0.999 * SADDLE_LEVEL, box=WELL)
    assert (fan.ends == End.LEVEL).all()
    assert fan.first_caustic() is None
    assert fan.lowest_sheet().all()


@pytest.mark.parametrize("beta", [5, 10])
def test_the_caustic_is_found_on_the_axis(beta: float) -> None:
    fan = fan_of(maier_stein(beta), level=0.999 * SADDLE_LEVEL, box=WELL)
    caustic = fan.first_caustic()
    assert caustic is not None
    x = focus_on_the_axis(beta)
    np.testing.assert_allclose(caustic[0], [x, 0], atol=1e-6)
    assert caustic[1] == pytest.approx((x**4 / 2 - x**2 + 0.5) / 2, abs=1e-6)
    on_axis = fan.curve == int(np.flatnonzero(fan.ends == End.CAUSTIC)[np.argmin(fan.caustic_values)])
    assert fan.values[on_axis].max() < caustic[1]  # nothing beyond it is handed on


@pytest.mark.parametrize(("beta", "caustic"), [(3, False), (10, True)])
def test_directions_that_focus_at_once_are_seen_though_the_determinant_keeps_its_sign(
    beta: float, caustic: bool
) -> None:
    flat = maier_stein(beta).dynamics
    x, y = flat.symbols
    z = type(y)("z", real=True)
    # The same system turned about its axis: on it both directions across focus at the same point.
    equations = (flat.equations[0] - beta * x * z**2, flat.equations[1], -(1 + x**2) * z)
    fan = characteristics(
        Dynamics.of((x, y, z), equations),
        np.array([-1.0, 0, 0]),
        level=0.999 * SADDLE_LEVEL,
        box=np.vstack([WELL, [-1.5, 1.5]]),
        directions=np.array([[1.0, 0, 0], [0.5, 0.5, 0.5]]),
    )
    assert (fan.ends[0] == End.CAUSTIC) == caustic
    if caustic:
        assert fan.caustic_points[0, 0] == pytest.approx(focus_on_the_axis(beta), abs=1e-6)


def test_the_barrier_beyond_the_caustic_is_that_of_minimum_action(strong: Fan) -> None:
    barrier = 2 * strong.value_near(np.zeros((1, 2)), sheet=strong.lowest_sheet(), distance=0.2)[0]
    assert barrier == pytest.approx(0.34004, rel=1e-3)


@pytest.mark.slow
def test_the_barrier_a_little_above_the_critical_strength() -> None:
    fan = escape(5, level=0.245)
    barrier = 2 * fan.value_near(np.zeros((1, 2)), sheet=fan.lowest_sheet(), distance=0.2)[0]
    assert barrier == pytest.approx(0.4831, rel=1e-3)


def test_curves_that_have_crossed_the_axis_are_not_on_the_lowest_sheet(strong: Fan) -> None:
    caustic = strong.first_caustic()
    assert caustic is not None
    sheet = strong.lowest_sheet()
    side = np.sign((strong.points - strong.attractor) @ strong.metric.T[:, 1])
    began = side[np.searchsorted(strong.curve, np.arange(len(strong.directions)))]
    past = (strong.points[:, 0] > caustic[0][0]) & (strong.values > caustic[1])
    crossed = past & (side * began[strong.curve] < 0)
    deep = crossed & (np.abs(strong.points[:, 1]) > 0.03)
    assert deep.sum() > 20
    assert not sheet[deep].any()
    assert sheet.mean() > 0.9
    # By symmetry V is even in y, and so must be what is left.
    kept = strong.points[sheet]
    mirrored = strong.value_near(kept * [1, -1], sheet=sheet)
    off_axis = np.isfinite(mirrored) & (np.abs(kept[:, 1]) > 0.03)
    np.testing.assert_allclose(mirrored[off_axis], strong.values[sheet][off_axis], atol=2e-3)


@pytest.mark.slow
def test_values_near_a_fan_are_of_second_order() -> None:
    known = polynomial_system(2, seed=1)
    fan = adapted_fan(
        known.dynamics,
        known.attractors[0],
        level=0.05,
        box=known.domain,
        generator=np.random.default_rng(0),
        rounds=1,
    )
    sheet = fan.lowest_sheet()
    assert sheet.all()
    within = np.random.default_rng(1).uniform(-0.5, 0.5, size=(200, 2))
    x = fan.attractor + within @ np.linalg.inv(fan.metric).T
    exact = potential_values(known, x) - potential_values(known, fan.attractor[None])
    np.testing.assert_allclose(fan.value_near(x, sheet=sheet), exact, atol=1e-4)
    assert np.isnan(fan.value_near(fan.attractor[None] + 50, sheet=sheet)).all()


def test_curves_end_at_the_box() -> None:
    box = np.array([[-1.1, -0.9], [-0.1, 0.1]])
    fan = fan_of(maier_stein(1), level=0.2, box=box)
    assert (fan.ends == End.BOX).all()
    assert np.all((fan.points >= box[:, 0]) & (fan.points <= box[:, 1]))
    reached = fan.points[fan.last]
    np.testing.assert_allclose(np.abs((reached - [-1, 0]) / 0.1).max(axis=1), 1, atol=1e-6)


def test_curves_end_at_a_time_limit_and_at_another_equilibrium(monkeypatch: pytest.MonkeyPatch) -> None:
    known = maier_stein(1)
    with monkeypatch.context() as context:
        context.setattr("siq.quasipotential.characteristics.MAX_RELAXATION_TIMES", 0.5)
        assert (fan_of(known, level=0.2).ends == End.TIME).all()
    to_the_saddle = fan_of(known, level=0.3, directions=np.array([[1.0, 0.0]]))
    assert to_the_saddle.ends[0] == End.REST
    assert to_the_saddle.values[-1] == pytest.approx(SADDLE_LEVEL, abs=1e-5)


@pytest.mark.slow
def test_new_curves_are_put_where_neighbours_part() -> None:
    known = archetype(2)  # whose rates differ, so that evenly spread starts end in bundles

    def widest(fan: Fan) -> float:
        order = np.argsort(np.arctan2(fan.directions[:, 1], fan.directions[:, 0]))
        ends = fan.points[fan.last][order] @ fan.metric.T
        return float(np.linalg.norm(ends - np.roll(ends, 1, axis=0), axis=1).max())

    even = fan_of(known, level=0.4, which=1)
    adapted = adapted_fan(
        known.dynamics,
        known.attractors[1],
        level=0.4,
        box=known.domain,
        generator=np.random.default_rng(0),
        count=32,
    )
    assert len(adapted.directions) <= 512
    assert widest(adapted) < 0.11 < widest(even)


def test_one_state_has_two_curves() -> None:
    known = linear_system(1)
    fan = fan_of(known, level=0.5)
    assert len(fan.ends) == 2
    np.testing.assert_allclose(fan.values, potential_values(known, fan.points), rtol=1e-9)


def test_joined_fans_count_their_curves_on() -> None:
    known = maier_stein(10)
    first = fan_of(known, level=0.24, box=WELL, count=8)
    second = fan_of(known, level=0.24, box=WELL, directions=np.array([[1.0, 0.0], [1.0, 0.1]]))
    both = _join(first, second)
    assert both.curve.max() == 9
    assert (np.diff(both.curve) >= 0).all()
    np.testing.assert_array_equal(both.points[both.curve == 9], second.points[second.curve == 1])
    assert set(np.flatnonzero(second.ends == End.CAUSTIC) + 8) <= set(
        np.flatnonzero(both.ends == End.CAUSTIC)
    )


X, Y = sympy.symbols("x y", real=True)
STABLE = np.array([1.0, 0.0])
POINTS = np.random.default_rng(1).uniform([0.3, -0.6], [1.4, 0.6], (40, 2))


def field(equations: tuple[sympy.Expr, ...], noise: np.ndarray, *, degree: int = 3) -> FieldEstimate:
    dynamics = Dynamics.of((X, Y), equations, diffusion=noise)
    known = KnownSystem(dynamics, None, STABLE[None], np.array([[-2.0, 2.0], [-1.0, 1.0]]))
    return exact_field(known, degree=degree, relative_error=0.03)


@pytest.mark.parametrize("strength", [1.0, 2.5])
def test_errors_are_exact_where_f_is_downhill(strength: float) -> None:
    # f = (x - x³, -y), D = diag(1, s): V = x⁴/4 - x²/2 + y²/2s, with x², x⁴, y² by a coefficient each.
    found = field((X - X**3, -Y), np.diag([1.0, strength]))

    def gradient(x: np.ndarray) -> np.ndarray:
        return np.stack([x[:, 0] ** 3 - x[:, 0], x[:, 1] / strength], axis=1)

    x, y = POINTS.T
    parts = np.stack([(x**2 - 1) / 2, (x**4 - 1) / 4, y**2 / (2 * strength)])
    expected = 0.03 * np.sqrt((parts**2).sum(axis=0))
    assert _potential_errors(found, gradient, STABLE, POINTS) == pytest.approx(expected, rel=0.03, abs=1e-5)
    values = (x**2 - 1) ** 2 / 4 + y**2 / (2 * strength)
    whole = np.linalg.norm(expected) / np.linalg.norm(values)
    assert relative_error(found, gradient, STABLE, POINTS, values) == pytest.approx(whole, rel=0.01)


def test_slopes_are_those_of_the_hessian_of_a_linear_system_that_turns() -> None:
    jacobian, noise = np.array([[-1.0, 0.8], [-1.7, -0.6]]), np.array([[1.0, 0.2], [0.2, 0.7]])
    rows = tuple(sum(jacobian[i, j] * (X, Y)[j] for j in range(2)) for i in range(2))
    found, origin = field(rows, noise, degree=1), np.zeros(2)
    hessian = hessian_at(found.dynamics, origin)
    slopes, _ = _potential_slopes(found, lambda x: x @ hessian, origin, POINTS)
    names = list(found.library.names)
    for column, (component, term) in enumerate(found.support):
        values = [found.values.copy(), found.values.copy()]
        values[0][column] += 1e-5
        values[1][column] -= 1e-5
        up, down = (hessian_at(found.dynamics.with_values(one), origin) for one in values)
        expected = np.einsum("ni,ij,nj->n", POINTS, (up - down) / 4e-5, POINTS)
        assert slopes[:, term, component] == pytest.approx(expected, rel=0.03, abs=2e-3), names[term]


def test_what_rivals_would_change_adds_to_the_error() -> None:
    found = field((X - X**3, -Y), np.eye(2))

    def gradient(x: np.ndarray) -> np.ndarray:
        return np.stack([x[:, 0] ** 3 - x[:, 0], x[:, 1]], axis=1)

    doubt = np.zeros((1, found.library.size, 2))
    doubt[0, list(found.library.names).index("x"), 0] = 0.1
    plain = _potential_errors(found, gradient, STABLE, POINTS)
    doubted = _potential_errors(replace(found, alternatives=(0 * doubt[0], doubt)), gradient, STABLE, POINTS)
    expected = np.hypot(plain, 0.1 * np.abs(POINTS[:, 0] ** 2 - 1) / 2)
    assert doubted == pytest.approx(expected, rel=0.03, abs=1e-5)
    moved = _potential_errors(replace(found, alternatives=(doubt[0], 0 * doubt)), gradient, STABLE, POINTS)
    assert moved == pytest.approx(expected, rel=0.03, abs=1e-5)


@pytest.mark.parametrize("strength", [1.0, 2.5])
def test_the_shape_of_an_estimated_constant_d_has_its_part(strength: float) -> None:
    rate, samples = 0.2 * np.diag([1.0, strength]), 50.0
    shape = rate / np.sqrt(np.linalg.det(rate))
    found = replace(field((X - X**3, -Y), shape), covariance=np.zeros((3, 3)), noise_rate=rate)
    found = replace(found, constant_noise=constant_noise(found.library.symbols, rate, samples=samples))
    one, two = np.diag(shape)

    def gradient(x: np.ndarray) -> np.ndarray:
        return np.stack([(x[:, 0] ** 3 - x[:, 0]) / one, x[:, 1] / two], axis=1)

    # V = (x² - 1)²/4D₁ + y²/2D₂, and D₁ = 1/D₂ = √(R₁/R₂), each R with the relative variance 2/n.
    x, y = POINTS.T
    first, second = (x**2 - 1) ** 2 / (4 * one), y**2 / (2 * two)
    of_both = np.abs(second - first) * np.sqrt(2 / samples) / np.sqrt(2)
    # A correlation of both noises would turn the gradient of V: to first order by what lies between.
    errors = _potential_errors(found, gradient, STABLE, POINTS)
    assert (errors >= of_both * 0.97 - 1e-5).all()
    on_axis = np.array([[0.4, 0.0], [1.3, 0.0]])
    along = (on_axis[:, 0] ** 2 - 1) ** 2 / (4 * one) / np.sqrt(samples)
    assert _potential_errors(found, gradient, STABLE, on_axis) == pytest.approx(along, rel=0.03)


def test_the_formula_of_d_has_its_part() -> None:
    # One state, D = 1 + c x with an error of c: V' = (x³ - x)/(1 + c x).
    state, slope, error = sympy.Symbol("x", real=True), 0.3, 0.05
    dynamics = Dynamics.of((state,), (state - state**3,), diffusion=np.eye(1))
    known = KnownSystem(dynamics, None, np.array([[1.0]]), np.array([[-2.0, 2.0]]))
    found = exact_field(known, degree=3, relative_error=0.0)
    noise = NoiseFormula(
        (state,), np.zeros((2, 2), dtype=int), (sympy.Integer(1), state), np.array([1.0, slope]),
        np.diag([0.0, error**2]), 0.0,
    )  # fmt: skip
    found = replace(
        found, noise=noise, diffusion=noise.diffusion(1.0), noise_rate=np.eye(1), residual_ratio=0.5
    )
    ends = np.array([0.3, 0.7, 1.4])
    nodes, weights = np.polynomial.legendre.leggauss(40)
    expected = []
    for end in ends:
        x = 1 + (end - 1) * (nodes + 1) / 2
        turned = (x**3 - x) * x / (1 + slope * x) ** 2
        expected.append(error * abs(weights @ turned * (end - 1) / 2))
    errors = _potential_errors(found, lambda x: (x**3 - x) / (1 + slope * x), np.array([1.0]), ends[:, None])
    assert errors == pytest.approx(expected, rel=0.02)


def test_recordings_without_noise_leave_no_error() -> None:
    found = replace(field((X - X**3, -Y), np.eye(2)), residual_ratio=1e-9)
    assert not _potential_errors(found, lambda x: x, STABLE, POINTS).any()
    assert relative_error(found, lambda x: x, STABLE, POINTS, np.ones(len(POINTS))) == 0


def test_errors_are_not_told_where_paths_do_not_come_from_the_attractor() -> None:
    found = field((X - X**3, -Y), np.eye(2))
    errors = _potential_errors(found, lambda x: np.zeros_like(x), STABLE, POINTS)
    assert np.isnan(errors).all()
