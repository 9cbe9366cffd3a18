"""Folds, Hopf points and branch points of systems of which they are known exactly."""

import numpy as np
import pytest
import sympy

from siq.systems.continuation import ParameterFamily, follow_branches, place_on
from siq.systems.dynamics import Dynamics

pytestmark = pytest.mark.portable

x, y, z, k, mu = sympy.symbols("x y z k mu", real=True)


def system(states, equations, domain, parameter=k):
    return Dynamics.of(states, equations, domain=domain, parameters={parameter: 0.0})


def kinds(found):
    return [one.kind for one in found.bifurcations]


def test_the_folds_of_a_cusp_are_found_to_rounding():
    cusp = system((x,), (k + x - x**3,), [(-2, 2)])
    found = follow_branches(cusp, "k", (-1, 1), [(0.0, np.array([1.0]))])
    assert kinds(found) == ["fold", "fold"] and len(found.branches) == 1
    exact = 2 / (3 * np.sqrt(3))
    assert [one.value for one in found.bifurcations] == pytest.approx([-exact, exact], abs=1e-12)
    assert [one.state[0] for one in found.bifurcations] == pytest.approx(
        [1 / np.sqrt(3), -1 / np.sqrt(3)], abs=1e-12
    )
    # From one limit to the other through both folds, each point an equilibrium.
    (branch,) = found.branches
    assert {round(branch.values[0], 12), round(branch.values[-1], 12)} == {-1.0, 1.0}
    assert branch.values + branch.states[:, 0] - branch.states[:, 0] ** 3 == pytest.approx(0, abs=1e-11)
    assert set(branch.unstable) == {0, 1}


def test_a_fold_in_units_that_differ_by_many_orders():
    """x in 1e-6, k in 1e4: a fold of k = 1e4 (1 + (1e6 x)²) at k = 1e4."""
    bent = system((x, y), (k / 10000 - 1 - (10**6 * x) ** 2, 3 * (x - y)), [(-3e-6, 3e-6), (-3e-6, 3e-6)])
    found = follow_branches(bent, "k", (0, 3e4), [(2e4, np.array([1e-6, 1e-6]))])
    assert kinds(found) == ["fold"]
    assert found.bifurcations[0].value == pytest.approx(1e4, rel=1e-12)


def test_the_hopf_point_of_the_normal_form_is_found_with_its_frequency():
    def of(mu):
        r = x**2 + y**2
        return mu * x - 3 * y - x * r, 3 * x + mu * y - y * r

    normal = system((x, y), of(mu - sympy.Rational(1, 4)), [(-2, 2), (-2, 2)], mu)
    found = follow_branches(normal, "mu", (-1, 1), [(-1.0, np.zeros(2))])
    assert kinds(found) == ["Hopf"]
    assert found.bifurcations[0].value == pytest.approx(0.25, abs=1e-12)
    assert found.bifurcations[0].frequency == pytest.approx(3, abs=1e-12)


def test_a_hopf_point_away_from_the_origin_beside_a_third_state():
    """The Brusselator x' = 1 - (k + 1) x + x² y, y' = k x - x² y oscillates from k = 2 on, with ω = 1."""
    brusselator = system(
        (x, y, z), (1 - (k + 1) * x + x**2 * y, k * x - x**2 * y, x - 5 * z), [(0, 4), (0, 5), (0, 2)]
    )
    found = follow_branches(brusselator, "k", (1, 3), [(1.0, np.array([1.0, 1.0, 0.2]))])
    assert kinds(found) == ["Hopf"]
    (hopf,) = found.bifurcations
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
    assert [one.value for one in found.bifurcations] == pytest.approx(np.sort(exact), abs=1e-10)


def test_a_pitchfork_is_a_branch_point_of_two_branches_and_no_fold():
    fork = system((x, y), (k * x - x**3, -2 * y), [(-2, 2), (-1, 1)])
    seeds = [(1.0, np.array([0.0, 0.0])), (1.0, np.array([1.0, 0.0])), (1.0, np.array([-1.0, 0.0]))]
    found = follow_branches(fork, "k", (-1, 1), seeds)
    assert kinds(found) == ["branch point"] and len(found.branches) == 2
    assert found.bifurcations[0].value == pytest.approx(0, abs=1e-12)
    assert found.bifurcations[0].state == pytest.approx([0, 0], abs=1e-12)


def test_a_transcritical_point_exchanges_stability():
    crossing = system((x,), (k * x - x**2,), [(-2, 2)])
    found = follow_branches(crossing, "k", (-1, 1.1), [(1.0, np.zeros(1)), (1.0, np.ones(1))])
    assert kinds(found) == ["branch point"] and len(found.branches) == 2
    assert found.bifurcations[0].value == pytest.approx(0, abs=1e-12)
    for branch in found.branches:
        assert set(branch.unstable) == {0, 1}


def test_a_closed_branch_is_gone_round_once():
    ring = system((x,), (k**2 + x**2 - 1,), [(-2, 2)])
    found = follow_branches(
        ring, "k", (-2, 2), [(0.3, np.array([np.sqrt(0.91)])), (0.3, -np.array([np.sqrt(0.91)]))]
    )
    assert len(found.branches) == 1 and kinds(found) == ["fold", "fold"]
    assert [one.value for one in found.bifurcations] == pytest.approx([-1, 1], abs=1e-10)
    (branch,) = found.branches
    assert branch.states[0] == pytest.approx(branch.states[-1], abs=1e-9)
    assert np.hypot(branch.values, branch.states[:, 0]) == pytest.approx(1, abs=1e-10)


def test_a_neutral_saddle_is_no_hopf_point():
    """Eigenvalues ±1 pass their sum of zero; nothing oscillates."""
    saddle = system((x, y), ((1 + k) * x, -y), [(-1, 1), (-1, 1)])
    assert follow_branches(saddle, "k", (-0.5, 0.5), [(0.0, np.zeros(2))]).bifurcations == ()


def test_a_branch_ends_where_it_leaves_the_domain():
    straight = system((x,), (k - x,), [(0, 1)])
    (branch,) = follow_branches(straight, "k", (-3, 3), [(0.5, np.array([0.5]))]).branches
    assert [branch.values.min(), branch.values.max()] == pytest.approx([0, 1], abs=1e-9)


def test_a_state_is_told_to_lie_on_its_branch_only():
    cusp = system((x,), (k + x - x**3,), [(-2, 2)])
    (branch,) = follow_branches(cusp, "k", (-1, 1), [(0.0, np.array([1.0]))]).branches
    family = ParameterFamily(cusp, {"k": (-1, 1)})
    for root in (-1.0, 0.0, 1.0):
        place = place_on(family, branch, family.shares(np.array([[root]]), np.array([0.0]))[0])
        assert place is not None and branch.states[place, 0] == pytest.approx(root, abs=0.05)
    assert place_on(family, branch, family.shares(np.array([[0.5]]), np.array([0.0]))[0]) is None


def test_a_parameter_that_is_not_there_is_named():
    with pytest.raises(ValueError, match="no parameter 'q'"):
        follow_branches(system((x,), (k - x,), [(0, 1)]), "q", (0, 1), [])
