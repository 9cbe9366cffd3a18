"""Curves of folds and Hopf points in the plane of two parameters, against formulas for them."""

from __future__ import annotations

import numpy as np
import pytest
import sympy

from siq.systems.continuation import CurveKind, follow_curves
from siq.systems.dynamics import Dynamics

pytestmark = pytest.mark.portable

a, b, x, y, z = sympy.symbols("a b x y z", real=True)
LIMITS = {"a": (-1.0, 1.0), "b": (-0.5, 1.5)}


def cusp() -> Dynamics:
    return Dynamics.of((x,), (a + b * x - x**3,), domain=[(-2, 2)], parameters={a: 0.0, b: 1.0})


def fold(first: float, second: float, *state: float) -> tuple[CurveKind, np.ndarray, np.ndarray]:
    return ("fold", np.array([first, second]), np.array(state))


def test_the_folds_of_a_cusp_lie_on_its_curve_and_pass_through_it():
    at = 2 / np.sqrt(27)
    (curve,) = follow_curves(cusp(), LIMITS, [fold(at, 1.0, -1 / np.sqrt(3)), fold(-at, 1.0, 1 / np.sqrt(3))])
    assert curve.kind == "fold" and curve.fault == "" and not curve.frequencies.any()
    assert 27 * curve.values[:, 0] ** 2 == pytest.approx(4 * curve.values[:, 1] ** 3, abs=1e-11)
    assert 3 * curve.states[:, 0] ** 2 == pytest.approx(curve.values[:, 1], abs=1e-11)
    # It ends where b does, on both sides of a cusp that a continuation in a or in b would not pass.
    ends = curve.values[[0, -1]]
    assert ends[:, 1] == pytest.approx([1.5, 1.5]) and ends[0, 0] * ends[1, 0] < 0
    assert curve.values[:, 1].min() == pytest.approx(0, abs=1e-4)


def test_folds_in_units_that_differ_by_many_orders():
    mass = sympy.Rational(1, 10**9)
    tiny = Dynamics.of(
        (x,), (1000 * (a * mass + b * x - (x / mass) ** 2 * x),), domain=[(-2e-9, 2e-9)],
        parameters={a: 0.0, b: 1.0},
    )  # fmt: skip
    (curve,) = follow_curves(tiny, LIMITS, [fold(2 / np.sqrt(27), 1.0, -1e-9 / np.sqrt(3))])
    assert 27 * curve.values[:, 0] ** 2 == pytest.approx(4 * curve.values[:, 1] ** 3, abs=1e-10)


def test_a_closed_curve_of_folds_is_gone_round_once():
    # ẋ = a² + b² - 1/4 + x² folds at x = 0, on a circle.
    ring = Dynamics.of((x,), (a**2 + b**2 - 0.25 + x**2,), domain=[(-2, 2)], parameters={a: 0.5, b: 0.0})
    (curve,) = follow_curves(ring, {"a": (-1, 1), "b": (-1, 1)}, [fold(0.5, 0, 0), fold(0, -0.5, 0)])
    assert np.hypot(*curve.values.T) == pytest.approx(0.5, abs=1e-11)
    assert curve.values[0] == pytest.approx(curve.values[-1])
    turned = np.unwrap(np.arctan2(*curve.values.T))
    assert abs(turned[-1] - turned[0]) == pytest.approx(2 * np.pi)


def test_the_hopf_points_of_the_brusselator_lie_at_b_of_one_plus_a_squared():
    brusselator = Dynamics.of(
        (x, y), (a - (b + 1) * x + x**2 * y, b * x - x**2 * y), domain=[(0, 5), (0, 5)],
        parameters={a: 1.0, b: 2.0},
    )  # fmt: skip
    seed = ("Hopf", np.array([1.0, 2.0]), np.array([1.0, 2.0]))
    (curve,) = follow_curves(brusselator, {"a": (0.5, 1.5), "b": (1.0, 4.0)}, [seed])
    first, second = curve.values.T
    assert second == pytest.approx(1 + first**2, abs=1e-10)
    assert curve.frequencies == pytest.approx(first, abs=1e-10)
    assert curve.states == pytest.approx(np.stack([first, second / first], axis=1), abs=1e-10)
    assert sorted(first[[0, -1]]) == pytest.approx([0.5, 1.5])


def test_hopf_points_end_where_they_meet_the_folds():
    # Bogdanov and Takens: folds at 4a = b², Hopf points at a = 0, b < 0 with ω² = -b; they meet at zero.
    system = Dynamics.of(
        (x, y), (y, a + b * x + x**2 - x * y), domain=[(-2, 2), (-2, 2)], parameters={a: 0.0, b: -1.0}
    )
    seeds = [("Hopf", np.array([0.0, -0.25]), np.zeros(2)), fold(0.25, 1.0, -0.5, 0.0)]
    hopf, folds = follow_curves(system, {"a": (-1.0, 1.0), "b": (-1.0, 1.5)}, seeds)
    assert hopf.kind == "Hopf" and np.abs(hopf.values[:, 0]).max() < 1e-10
    assert hopf.frequencies**2 == pytest.approx(-hopf.values[:, 1], abs=1e-10)
    assert sorted(hopf.values[[0, -1], 1]) == pytest.approx([-1, 0], abs=1e-4)
    assert 4 * folds.values[:, 0] == pytest.approx(folds.values[:, 1] ** 2, abs=1e-10)
    assert folds.values[:, 1].min() == pytest.approx(-1)  # through the point where both meet


def test_a_third_state_does_not_matter():
    system = Dynamics.of(
        (x, y, z), (a + b * x - x**3, y + 2 * z, -3 * y - 2 * z + x), domain=[(-2, 2)] * 3,
        parameters={a: 0.0, b: 1.0},
    )  # fmt: skip
    at = -1 / np.sqrt(3)
    (curve,) = follow_curves(system, LIMITS, [fold(2 / np.sqrt(27), 1.0, at, at / 2, -at / 4)])
    assert 27 * curve.values[:, 0] ** 2 == pytest.approx(4 * curve.values[:, 1] ** 3, abs=1e-10)


def test_what_is_no_fold_or_lies_outside_gives_no_curve():
    far = ("Hopf", np.zeros(2), np.zeros(1))
    assert follow_curves(cusp(), LIMITS, [fold(0.9, 1.0, 0.0), fold(0, 0, 5.0), far]) == []
    with pytest.raises(ValueError, match="two parameters"):
        follow_curves(cusp(), {"a": (-1.0, 1.0)}, [])
