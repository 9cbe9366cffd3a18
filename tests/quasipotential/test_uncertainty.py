from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import sympy
from known_systems import KnownSystem, exact_field

from siq.inference.field_estimate import IdentifiedField, NoiseFormula, constant_noise
from siq.inference.selection import RivalTerms
from siq.quasipotential.characteristics import _potential_slopes, potential_errors, relative_error
from siq.systems.dynamics import Dynamics
from siq.systems.equilibria import hessian_at

X, Y = sympy.symbols("x y", real=True)
WELL = np.array([1.0, 0.0])
POINTS = np.random.default_rng(1).uniform([0.3, -0.6], [1.4, 0.6], (40, 2))


def field(equations: tuple[sympy.Expr, ...], noise: np.ndarray, *, degree: int = 3) -> IdentifiedField:
    dynamics = Dynamics.of((X, Y), equations, diffusion=noise)
    known = KnownSystem(dynamics, None, WELL[None], np.array([[-2.0, 2.0], [-1.0, 1.0]]))
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
    assert potential_errors(found, gradient, WELL, POINTS) == pytest.approx(expected, rel=0.03, abs=1e-5)
    values = (x**2 - 1) ** 2 / 4 + y**2 / (2 * strength)
    whole = np.linalg.norm(expected) / np.linalg.norm(values)
    assert relative_error(found, gradient, WELL, POINTS, values) == pytest.approx(whole, rel=0.01)


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
    plain = potential_errors(found, gradient, WELL, POINTS)
    doubted = potential_errors(replace(found, rivals=RivalTerms(0 * doubt[0], doubt)), gradient, WELL, POINTS)
    expected = np.hypot(plain, 0.1 * np.abs(POINTS[:, 0] ** 2 - 1) / 2)
    assert doubted == pytest.approx(expected, rel=0.03, abs=1e-5)
    moved = potential_errors(replace(found, rivals=RivalTerms(doubt[0], 0 * doubt)), gradient, WELL, POINTS)
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
    errors = potential_errors(found, gradient, WELL, POINTS)
    assert (errors >= of_both * 0.97 - 1e-5).all()
    on_axis = np.array([[0.4, 0.0], [1.3, 0.0]])
    along = (on_axis[:, 0] ** 2 - 1) ** 2 / (4 * one) / np.sqrt(samples)
    assert potential_errors(found, gradient, WELL, on_axis) == pytest.approx(along, rel=0.03)


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
    errors = potential_errors(found, lambda x: (x**3 - x) / (1 + slope * x), np.array([1.0]), ends[:, None])
    assert errors == pytest.approx(expected, rel=0.02)


def test_recordings_without_noise_leave_no_error() -> None:
    found = replace(field((X - X**3, -Y), np.eye(2)), residual_ratio=1e-9)
    assert not potential_errors(found, lambda x: x, WELL, POINTS).any()
    assert relative_error(found, lambda x: x, WELL, POINTS, np.ones(len(POINTS))) == 0


def test_errors_are_not_told_where_paths_do_not_come_from_the_attractor() -> None:
    found = field((X - X**3, -Y), np.eye(2))
    errors = potential_errors(found, lambda x: np.zeros_like(x), WELL, POINTS)
    assert np.isnan(errors).all()
