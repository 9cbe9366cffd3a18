from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import sympy
from known_systems import (
    KnownSystem,
    archetype,
    linear_system,
    maier_stein,
    potential_gradient,
    potential_values,
    uniform_points,
)

from siq.quasipotential.certificate_tests import SAFETY, _residual_integral
from siq.systems.dynamics import Dynamics

pytestmark = pytest.mark.portable

Gradient = Callable[[np.ndarray], np.ndarray]


def integral(known: KnownSystem, gradient: Gradient, x: np.ndarray) -> np.ndarray:
    rates = [np.linalg.eigvals(known.dynamics.jacobian(one[None])[0]).real for one in known.attractors]
    return _residual_integral(
        gradient, known.dynamics, x, box=known.domain,
        slowest=-max(rate.max() for rate in rates),
        fastest=float(np.linalg.norm(known.dynamics.jacobian(x), axis=(1, 2)).max()),
    )  # fmt: skip


def right_well(known: KnownSystem, count: int = 150) -> np.ndarray:
    """Points below nine tenths of the saddle of the archetype or of Maier–Stein, on the right."""
    x = uniform_points(known, 4000)
    top = potential_values(known, np.zeros((1, x.shape[1])))[0]
    return x[(potential_values(known, x) < 0.9 * top) & (x[:, 0] > 0)][:count]


@pytest.mark.parametrize("known", [archetype(3), maier_stein(1)], ids=["archetype", "Maier-Stein"])
def test_the_exact_v_has_no_error(known: KnownSystem) -> None:
    found = integral(known, lambda x: potential_gradient(known, x), right_well(known))
    assert found.max() < 1e-9


@pytest.mark.parametrize("dimension", [2, 3, 4])
def test_linear_systems_have_no_error(dimension: int) -> None:
    known = linear_system(dimension)
    found = integral(known, lambda x: potential_gradient(known, x), uniform_points(known, 100))
    assert found.max() < 1e-8 * potential_values(known, uniform_points(known, 100)).max()


@pytest.mark.parametrize("size", [0.003, 0.01, 0.03])
@pytest.mark.parametrize("known", [archetype(3), maier_stein(1)], ids=["archetype", "Maier-Stein"])
def test_the_bound_lies_above_the_true_error(known: KnownSystem, size: float) -> None:
    x = right_well(known)

    def wrong(points: np.ndarray) -> np.ndarray:
        y, slope = points - known.attractors[1], potential_gradient(known, points)
        # The gradient of size·(sin(2y₁) - 2y₁ + y₁²y₂), which is flat at the attractor.
        bump = np.zeros_like(points)
        bump[:, 0] = 2 * np.cos(2 * y[:, 0]) - 2 + 2 * y[:, 0] * y[:, 1]
        bump[:, 1] = y[:, 0] ** 2
        return slope + size * bump

    y = x - known.attractors[1]
    error = size * np.abs(np.sin(2 * y[:, 0]) - 2 * y[:, 0] + y[:, 0] ** 2 * y[:, 1])
    bound = SAFETY * integral(known, wrong, x)
    assert np.linalg.norm(bound) > np.linalg.norm(error)
    assert (bound > 0.9 * error).mean() > 0.9
    assert np.linalg.norm(bound) < 40 * np.linalg.norm(error)


@pytest.mark.parametrize("factor", [0.98, 1.02, 1.1])
@pytest.mark.parametrize("known", [linear_system(2), archetype(3)], ids=["linear", "archetype"])
def test_a_v_that_is_wrong_by_a_factor_is_bounded(known: KnownSystem, factor: float) -> None:
    x = right_well(known) if len(known.attractors) == 2 else uniform_points(known, 150)
    bound = SAFETY * integral(known, lambda points: factor * potential_gradient(known, points), x)
    error = np.abs(factor - 1) * potential_values(known, x)
    assert np.linalg.norm(bound) > np.linalg.norm(error)
    assert np.linalg.norm(bound) < 20 * np.linalg.norm(error)


def test_paths_that_run_away_are_infinite() -> None:
    known = maier_stein(1)
    found = integral(known, lambda x: -potential_gradient(known, x), right_well(known))
    assert not np.isfinite(found).any()


def test_other_units_give_the_same_bound() -> None:
    known, units = maier_stein(1), np.array([1e-3, 50.0])
    x = right_well(known)
    x = np.concatenate([x, [[0.9, 1.4]]])
    back = {s: s / float(u) for s, u in zip(known.dynamics.symbols, units, strict=True)}
    scaled = Dynamics.of(
        known.dynamics.symbols,
        tuple(
            u * f.subs(back, simultaneous=True) for u, f in zip(units, known.dynamics.formulas, strict=True)
        ),
        diffusion=np.diag(units**2),
    )

    def wrong(points: np.ndarray) -> np.ndarray:
        return 1.1 * potential_gradient(known, points) * [1.0, 0.8]

    options = {"slowest": 2.0, "fastest": 10.0}
    one = _residual_integral(wrong, known.dynamics, x, box=known.domain, **options)
    two = _residual_integral(
        lambda points: wrong(points / units) / units,
        scaled,
        x * units,
        box=known.domain * units[:, None],
        **options,
    )
    np.testing.assert_allclose(two, one, rtol=1e-6)


@pytest.mark.parametrize("units", [np.ones(2), np.array([1.0, 1e4])], ids=["one", "ten thousand"])
def test_a_path_has_run_away_in_whatever_units_the_other_state_is(units: np.ndarray) -> None:
    # Upwards in time x falls by x' = -x as it should, and y drifts off by 2 a unit of time.
    x, y = sympy.symbols("x y", real=True)
    dynamics = Dynamics.of((x, y), (-x * float(units[0]) / float(units[0]), y * 0 + 2 * float(units[1])))
    starts = np.array([[0.5, 0.5], [0.2, -0.5]]) * units
    found = _residual_integral(
        lambda points: np.column_stack([points[:, 0], np.zeros(len(points))]), dynamics, starts,
        box=np.array([[-1.0, 1.0], [-1.0, 1.0]]) * units[:, None], slowest=1.0, fastest=1.0,
    )  # fmt: skip
    assert not np.isfinite(found).any()
