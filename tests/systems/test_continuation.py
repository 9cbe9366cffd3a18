"""Folds, Hopf points and branch points of systems of which they are known exactly, and curves of them."""

from __future__ import annotations

import numpy as np
import pytest
import sympy

from siq.remarks import sentence
from siq.systems import continuation
from siq.systems.continuation import follow_branches, follow_curves
from siq.systems.dynamics import Dynamics

a, b, x, y, z, k, mu = sympy.symbols("a b x y z k mu", real=True)


def system(states, equations, domain, parameter=k):
    return Dynamics.of(states, equations, domain=domain, parameters={parameter: 0.0})


def kinds(found):
    return [one.kind for one in found[1]]


def test_the_folds_of_a_cusp_are_found_to_rounding():
    cusp = system((x,), (k + x - x**3,), [(-2, 2)])
    found = follow_branches(cusp, "k", (-1, 1), [(0.0, np.array([1.0]))])
    assert kinds(found) == ["fold", "fold"] and len(found[0]) == 1
    exact = 2 / (3 * np.sqrt(3))
    assert [one.value for one in found[1]] == pytest.approx([-exact, exact], abs=1e-12)
    assert [one.state[0] for one in found[1]] == pytest.approx([1 / np.sqrt(3), -1 / np.sqrt(3)], abs=1e-12)
    # From one limit to the other through both folds, each point an equilibrium.
    (branch,) = found[0]
    assert {round(branch.values[0], 12), round(branch.values[-1], 12)} == {-1.0, 1.0}
    assert branch.values + branch.states[:, 0] - branch.states[:, 0] ** 3 == pytest.approx(0, abs=1e-11)
    assert set(branch.unstable) == {0, 1}


def test_a_fold_in_units_that_differ_by_many_orders():
    """x in 1e-6, k in 1e4: a fold of k = 1e4 (1 + (1e6 x)²) at k = 1e4."""
    bent = system((x, y), (k / 10000 - 1 - (10**6 * x) ** 2, 3 * (x - y)), [(-3e-6, 3e-6), (-3e-6, 3e-6)])
    found = follow_branches(bent, "k", (0, 3e4), [(2e4, np.array([1e-6, 1e-6]))])
    assert kinds(found) == ["fold"]
    assert found[1][0].value == pytest.approx(1e4, rel=1e-12)


def test_the_hopf_point_of_the_normal_form_is_found_with_its_frequency():
    def of(mu):
        r = x**2 + y**2
        return mu * x - 3 * y - x * r, 3 * x + mu * y - y * r

    normal = system((x, y), of(mu - sympy.Rational(1, 4)), [(-2, 2), (-2, 2)], mu)
    found = follow_branches(normal, "mu", (-1, 1), [(-1.0, np.zeros(2))])
    assert kinds(found) == ["Hopf"]
    assert found[1][0].value == pytest.approx(0.25, abs=1e-12)
    assert found[1][0].frequency == pytest.approx(3, abs=1e-12)


def test_a_hopf_point_away_from_the_origin_beside_a_third_state():
    """The Brusselator x' = 1 - (k + 1) x + x² y, y' = k x - x² y oscillates from k = 2 on, with ω = 1."""
    brusselator = system(
        (x, y, z), (1 - (k + 1) * x + x**2 * y, k * x - x**2 * y, x - 5 * z), [(0, 4), (0, 5), (0, 2)]
    )
    found = follow_branches(brusselator, "k", (1, 3), [(1.0, np.array([1.0, 1.0, 0.2]))])
    assert kinds(found) == ["Hopf"]
    (hopf,) = found[1]
    assert hopf.value == pytest.approx(2, abs=1e-10) and hopf.frequency == pytest.approx(1, abs=1e-10)
    assert hopf.state == pytest.approx([1, 2, 0.2], abs=1e-10)


def test_the_folds_of_a_rational_system():
    """x' = k + x²/(1 + x²) - 0.55 x, of which the folds are roots of a polynomial."""
    grazing = system((x,), (k + x**2 / (1 + x**2) - sympy.Rational(55, 100) * x,), [(0, 4)])
    found = follow_branches(grazing, "k", (-0.2, 0.3), [(0.3, np.array([2.5]))])
    # f' = 2x/(1 + x²)² - 0.55 = 0
    roots = np.roots([0.55, 0, 1.1, -2, 0.55])
    roots = np.sort(roots[np.abs(roots.imag) < 1e-12].real)
    exact = 0.55 * roots - roots**2 / (1 + roots**2)
    assert kinds(found) == ["fold", "fold"]
    assert [one.value for one in found[1]] == pytest.approx(np.sort(exact), abs=1e-10)


def test_a_pitchfork_is_a_branch_point_of_two_branches_and_no_fold():
    fork = system((x, y), (k * x - x**3, -2 * y), [(-2, 2), (-1, 1)])
    seeds = [(1.0, np.array([0.0, 0.0])), (1.0, np.array([1.0, 0.0])), (1.0, np.array([-1.0, 0.0]))]
    found = follow_branches(fork, "k", (-1, 1), seeds)
    assert kinds(found) == ["branch point"] and len(found[0]) == 2
    assert found[1][0].value == pytest.approx(0, abs=1e-12)
    assert found[1][0].state == pytest.approx([0, 0], abs=1e-12)


def test_a_transcritical_point_exchanges_stability():
    crossing = system((x,), (k * x - x**2,), [(-2, 2)])
    found = follow_branches(crossing, "k", (-1, 1.1), [(1.0, np.zeros(1)), (1.0, np.ones(1))])
    assert kinds(found) == ["branch point"] and len(found[0]) == 2
    assert found[1][0].value == pytest.approx(0, abs=1e-12)
    for branch in found[0]:
        assert set(branch.unstable) == {0, 1}


def test_a_closed_branch_is_gone_round_once():
    ring = system((x,), (k**2 + x**2 - 1,), [(-2, 2)])
    found = follow_branches(
        ring, "k", (-2, 2), [(0.3, np.array([np.sqrt(0.91)])), (0.3, -np.array([np.sqrt(0.91)]))]
    )
    assert len(found[0]) == 1 and kinds(found) == ["fold", "fold"]
    assert [one.value for one in found[1]] == pytest.approx([-1, 1], abs=1e-10)
    (branch,) = found[0]
    assert branch.states[0] == pytest.approx(branch.states[-1], abs=1e-9)
    assert np.hypot(branch.values, branch.states[:, 0]) == pytest.approx(1, abs=1e-10)


def test_a_neutral_saddle_is_no_hopf_point():
    """Eigenvalues ±1 pass their sum of zero; nothing oscillates."""
    saddle = system((x, y), ((1 + k) * x, -y), [(-1, 1), (-1, 1)])
    assert follow_branches(saddle, "k", (-0.5, 0.5), [(0.0, np.zeros(2))])[1] == []


def test_a_branch_ends_where_it_leaves_the_domain():
    straight = system((x,), (k - x,), [(0, 1)])
    (branch,) = follow_branches(straight, "k", (-3, 3), [(0.5, np.array([0.5]))])[0]
    assert [branch.values.min(), branch.values.max()] == pytest.approx([0, 1], abs=1e-9)


def test_a_state_is_told_to_lie_on_its_branch_only():
    cusp = system((x,), (k + x - x**3,), [(-2, 2)])
    (branch,) = follow_branches(cusp, "k", (-1, 1), [(0.0, np.array([1.0]))])[0]
    for root in (-1.0, 0.0, 1.0):
        place = branch.index_of(np.array([root]), 0.0)
        assert place is not None and branch.states[place, 0] == pytest.approx(root, abs=0.05)
    assert branch.index_of(np.array([0.5]), 0.0) is None


def test_a_parameter_that_is_not_there_is_named():
    with pytest.raises(ValueError, match="no parameter 'q'"):
        follow_branches(system((x,), (k - x,), [(0, 1)]), "q", (0, 1), [])


LIMITS = {"a": (-1.0, 1.0), "b": (-0.5, 1.5)}


def cusp() -> Dynamics:
    return Dynamics.of((x,), (a + b * x - x**3,), domain=[(-2, 2)], parameters={a: 0.0, b: 1.0})


def fold(first: float, second: float, *state: float) -> tuple[str, np.ndarray, np.ndarray]:
    return ("fold", np.array([first, second]), np.array(state))


def test_the_folds_of_a_cusp_lie_on_its_curve_and_pass_through_it():
    at = 2 / np.sqrt(27)
    (curve,), remarks = follow_curves(
        cusp(), LIMITS, [fold(at, 1.0, -1 / np.sqrt(3)), fold(-at, 1.0, 1 / np.sqrt(3))]
    )
    assert curve.kind == "fold" and not remarks and not curve.frequencies.any()
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
    (curve,), _ = follow_curves(tiny, LIMITS, [fold(2 / np.sqrt(27), 1.0, -1e-9 / np.sqrt(3))])
    assert 27 * curve.values[:, 0] ** 2 == pytest.approx(4 * curve.values[:, 1] ** 3, abs=1e-10)


def test_a_closed_curve_of_folds_is_gone_round_once():
    # ẋ = a² + b² - 1/4 + x² folds at x = 0, on a circle.
    ring = Dynamics.of((x,), (a**2 + b**2 - 0.25 + x**2,), domain=[(-2, 2)], parameters={a: 0.5, b: 0.0})
    (curve,), _ = follow_curves(ring, {"a": (-1, 1), "b": (-1, 1)}, [fold(0.5, 0, 0), fold(0, -0.5, 0)])
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
    (curve,), _ = follow_curves(brusselator, {"a": (0.5, 1.5), "b": (1.0, 4.0)}, [seed])
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
    (hopf, folds), _ = follow_curves(system, {"a": (-1.0, 1.0), "b": (-1.0, 1.5)}, seeds)
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
    (curve,), _ = follow_curves(system, LIMITS, [fold(2 / np.sqrt(27), 1.0, at, at / 2, -at / 4)])
    assert 27 * curve.values[:, 0] ** 2 == pytest.approx(4 * curve.values[:, 1] ** 3, abs=1e-10)


def test_what_is_no_fold_or_lies_outside_gives_no_curve():
    far = ("Hopf", np.zeros(2), np.zeros(1))
    assert follow_curves(cusp(), LIMITS, [fold(0.9, 1.0, 0.0), fold(0, 0, 5.0), far])[0] == []
    with pytest.raises(ValueError, match="two parameters"):
        follow_curves(cusp(), {"a": (-1.0, 1.0)}, [])


def test_what_could_not_be_followed_is_remarked(monkeypatch):
    monkeypatch.setattr(continuation, "MAX_POINTS", 5)
    _, _, (remark,) = follow_branches(cusp(), "a", (-1.0, 1.0), [(0.0, np.array([1.0]))])
    assert sentence(remark) == "the branch through [1.0] at a = 0 has more than 5 points"
    curves, (remark,) = follow_curves(cusp(), LIMITS, [fold(2 / np.sqrt(27), 1.0, -1 / np.sqrt(3))])
    assert len(curves) == 1 and sentence(remark).endswith("has more than 5 points")
    assert sentence(remark).startswith("the curve of folds through a = ")


@pytest.mark.slow
def test_cycles_begin_at_a_hopf_point_as_roots_and_fold() -> None:
    """``r² = (1 ± √(1 + 4a))/2``: fold and amplitudes are exact, and a known cycle is no second branch."""
    grow = a + (x**2 + y**2) - (x**2 + y**2) ** 2
    form = Dynamics.of((x, y), (x * grow - y, y * grow + x), domain=[(-2, 2)] * 2, parameters={a: 0.0})
    radius = np.sqrt((1 + np.sqrt(1.4)) / 2)
    known = [(0.1, np.array([0.0, radius]), 2 * np.pi)]
    seeds = [(0.1, np.zeros(2))]
    (_, branch), found, remarks = follow_branches(form, "a", (-0.4, 0.2), seeds, cycles=known)
    assert [one.kind for one in found] == ["fold of cycles", "Hopf"] and not remarks
    assert found[0].value == pytest.approx(-0.25, abs=1e-9)
    assert np.linalg.norm(found[0].state) == pytest.approx(np.sqrt(0.5), abs=1e-5)
    square = branch.extents[1, :, 0] ** 2
    np.testing.assert_allclose(square - square**2, -branch.values, atol=1e-5)
    np.testing.assert_allclose(branch.frequencies, 1.0, rtol=1e-8)
    np.testing.assert_array_equal(branch.unstable, square < 0.5)
    np.testing.assert_allclose(branch.eigenvalues[:, 0].real, 2 * square - 4 * square**2, atol=1e-5)
    assert branch.index_of_cycle(np.array([radius, 0.0]), 0.1) is not None
    assert branch.index_of_cycle(np.array([0.5, 0.0]), 0.1) is None
