from __future__ import annotations

import numpy as np
import pytest
import sympy
from known_paths import MATRICES, pairs, path_of, resonator, rotating, transformed
from known_systems import (
    KnownSystem,
    archetype,
    double_well,
    linear_system,
    maier_stein,
    polynomial_system,
    potential_gradient,
    potential_values,
)
from scipy.integrate import solve_ivp

from siq.errors import NumericalFailure
from siq.quasipotential.path_chains import MinimumActionPath
from siq.quasipotential.paths import minimum_action_path, transition_path
from siq.systems.dynamics import Dynamics
from siq.systems.equilibria import find_equilibria

pytestmark = pytest.mark.portable

MAIER_STEIN = {1: 0.5, 3: 0.5, 5: 0.4830697, 10: 0.3400413}  # β > 4: by shooting, independent of this code


@pytest.mark.parametrize("dimension", [1, 2, 3])
def test_the_action_to_any_point_of_a_linear_system_is_its_quadratic_form(dimension: int) -> None:
    known = linear_system(dimension)
    end = np.array([1.0, 0.5, -0.3, 0.4])[:dimension]
    path = path_of(known, end)
    assert path.converged
    assert path.action == pytest.approx(2 * potential_values(known, end[None])[0], rel=1e-7)
    np.testing.assert_array_equal(path.points[0], 0)
    np.testing.assert_allclose(path.points[-1], end, rtol=1e-12)
    np.testing.assert_allclose(path.values, 2 * potential_values(known, path.points), atol=1e-4)


@pytest.mark.parametrize("dimension", [2, 3])
def test_the_archetype_has_its_exact_barrier_values_and_momenta(dimension: int) -> None:
    known = archetype(dimension)
    path = path_of(known, np.zeros(dimension))
    assert path.converged
    assert path.action == pytest.approx(1, rel=1e-6)
    assert path.residual < 1e-5
    np.testing.assert_allclose(path.values, 2 * potential_values(known, path.points), atol=1e-5)
    np.testing.assert_allclose(path.momenta, potential_gradient(known, path.points), atol=1e-4)


@pytest.mark.parametrize("dimension", [1, 2])
@pytest.mark.parametrize("which", [0, 1])
def test_without_circulation_the_path_is_the_descent_reversed(dimension: int, which: int) -> None:
    known = double_well(dimension)
    x = np.sort(np.roots([1, 0, -1, 0.1]).real)[1]
    saddle = np.r_[x, np.full(dimension - 1, x / 2)]
    path = path_of(known, saddle, which=which)
    levels = 2 * potential_values(known, np.stack([known.attractors[which], saddle]))
    assert path.action == pytest.approx(levels[1] - levels[0], rel=1e-6)
    # p = ∇V = -D⁻¹f: time runs backwards along trajectories of f.
    expected = -known.dynamics.drift(path.points) @ np.linalg.inv(known.diffusion)
    np.testing.assert_allclose(path.momenta, expected, atol=1e-4)


@pytest.mark.parametrize("beta", MAIER_STEIN)
def test_maier_and_steins_barriers(beta: float) -> None:
    path = path_of(maier_stein(beta), np.zeros(2))
    assert path.converged
    assert path.action == pytest.approx(MAIER_STEIN[beta], rel=1e-6)
    height = np.abs(path.points[:, 1]).max()
    if beta < 4:
        assert height < 1e-8
        assert path.rivals == ()
    else:  # the mirror image is found, too
        assert height > 0.1
        assert path.rivals[0] == pytest.approx(path.action, rel=2e-3)


def test_a_path_that_is_a_saddle_of_the_action_is_left() -> None:
    axis = np.linspace([-1.0, 0], [0, 0], 20)
    path = path_of(maier_stein(10), np.zeros(2), initial=[axis])
    assert path.converged
    assert path.action == pytest.approx(MAIER_STEIN[10], rel=1e-6)


@pytest.mark.parametrize("which", [0, 1])
def test_the_resonators_barriers(which: int) -> None:
    known, saddle = resonator()
    path = path_of(known, saddle, which=which)
    assert path.converged
    assert path.residual < 1e-4
    assert path.action == pytest.approx([1.047e-8, 8.17e-9][which], rel=5e-3)  # by other means
    assert path.action == pytest.approx([1.046856e-8, 8.16145e-9][which], rel=1e-5)  # it stays where it is
    offset = path.points[2:] - known.attractors[which]
    turns = np.ptp(np.unwrap(np.arctan2(offset[:, 1], offset[:, 0]))) / (2 * np.pi)
    assert turns > 1.5


@pytest.mark.parametrize("rotation", [0.3, 3, 10])
def test_paths_wind_where_the_circulation_is_strong(rotation: float) -> None:
    path = path_of(rotating(2, rotation), np.zeros(2))
    assert path.converged
    assert path.action == pytest.approx(1, rel=1e-5)


@pytest.mark.parametrize("seed", [2])
def test_random_systems_have_their_exact_barriers(seed: int) -> None:
    _check_barriers(polynomial_system(2, seed=seed, rotation=3.0))


@pytest.mark.slow
@pytest.mark.parametrize(("dimension", "seed"), [(2, 0), (2, 1), (2, 3), (2, 4), (2, 5), (3, 0)])
def test_more_random_systems_have_their_exact_barriers(dimension: int, seed: int) -> None:
    _check_barriers(polynomial_system(dimension, seed=seed, rotation=3.0))


def _check_barriers(known: KnownSystem) -> None:
    ways = pairs(known)
    assert ways
    for which, saddle in ways:
        levels = 2 * potential_values(known, np.stack([known.attractors[which], saddle]))
        path = path_of(known, saddle, which=which)
        assert path.action == pytest.approx(levels[1] - levels[0], rel=1e-4)


@pytest.fixture(scope="module")
def strong() -> MinimumActionPath:
    return path_of(maier_stein(10), np.zeros(2))


@pytest.mark.parametrize("name", MATRICES)
def test_units_and_rotations_change_nothing(name: str, strong: MinimumActionPath) -> None:
    known, matrix = maier_stein(10), MATRICES[name]
    other = transformed(known, matrix, speed=1e-4)
    first, second = strong, path_of(other, np.zeros(2))
    assert second.action == pytest.approx(first.action, rel=1e-7)
    assert second.converged
    back = second.points @ np.linalg.inv(matrix).T
    back *= np.sign(back[:, 1:].sum()) * np.array([0, 1]) * np.sign(first.points[:, 1].sum()) + [1, 0]
    np.testing.assert_allclose(back, first.points, atol=1e-5)


def test_small_units_change_nothing() -> None:
    known = archetype(2)
    small = path_of(transformed(known, 1e-5 * np.eye(2)), np.zeros(2))
    tiny = transformed(known, 1e-5 * np.eye(2)).with_diffusion(np.eye(2))  # U is then of order 1e-10
    path = path_of(tiny, np.zeros(2))
    assert path.action == pytest.approx(1e-10 * small.action, rel=1e-9)
    assert path.converged


def test_more_nodes_give_a_smaller_error() -> None:
    known = maier_stein(5)
    paths = [path_of(known, np.zeros(2), tolerance=tolerance) for tolerance in (1e-2, 1e-5)]
    assert paths[0].error > 10 * paths[1].error
    assert all(one.error > abs(one.action - MAIER_STEIN[5]) for one in paths)


def test_a_path_downhill_costs_nothing() -> None:
    known = archetype(2)
    path = minimum_action_path(known.dynamics, np.zeros(2), known.attractors[0], tolerance=1e-2)
    assert path.action < 1e-6


def test_a_path_to_another_attractor_crosses_the_saddle() -> None:
    known = archetype(2)
    path = path_of(known, known.attractors[1])
    assert path.action == pytest.approx(1, rel=1e-3)
    assert np.linalg.norm(path.points, axis=1).min() < 0.02


@pytest.mark.parametrize("which", [0, 1])
def test_a_transition_leads_over_the_saddle_and_down(which: int) -> None:
    known, saddle = resonator()
    start, target = known.attractors[which], known.attractors[1 - which]
    way = transition_path(known.dynamics, start, saddle, target, nodes=200, tolerance=1e-2)
    np.testing.assert_allclose(way.points[0], start)
    np.testing.assert_allclose(way.points[-1], saddle)
    np.testing.assert_allclose(way.downhill[-1], target)
    np.testing.assert_allclose(way.downhill[0], saddle)
    assert len(way.downhill) == 200
    steps = np.diff(way.downhill, axis=0)
    forces = known.dynamics.drift((way.downhill[1:] + way.downhill[:-1]) / 2)
    angle = np.sum(steps * forces, axis=1) / np.linalg.norm(steps, axis=1) / np.linalg.norm(forces, axis=1)
    assert angle[1:-3].min() > 0.99


def test_where_f_does_not_lead_is_told() -> None:
    known, saddle = resonator()
    elsewhere = 1.5 * saddle
    with pytest.raises(NumericalFailure, match="does not lead from the saddle"):
        transition_path(known.dynamics, known.attractors[0], saddle, elsewhere)
    with pytest.raises(NumericalFailure, match="no saddle"):
        transition_path(known.dynamics, saddle, *known.attractors)


def test_a_path_needs_two_states() -> None:
    known = archetype(2)
    with pytest.raises(ValueError, match="where it starts"):
        path_of(known, known.attractors[0])


def test_a_path_through_states_without_noise_is_refused() -> None:
    state = sympy.symbols("x", real=True)
    system = Dynamics.of((state,), (-state,), diffusion=((1 - state**2,),))
    with pytest.raises(NumericalFailure, match=r"no path from \[0.0\] to \[0.5\] .* finite action"):
        minimum_action_path(system, np.zeros(1), np.array([0.5]), initial=[np.array([[0.0], [2.0], [0.5]])])


def test_a_way_that_ends_at_another_attractor_is_soon_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    # The first side that is tried leads elsewhere, and comes to rest there only if it is followed finely.
    known = polynomial_system(2, seed=1)
    points = np.random.default_rng(0).uniform(*known.domain.T, (200, 2))
    saddles = [one.position for one in find_equilibria(known.dynamics, points) if one.kind == "saddle"]
    saddle = min(saddles, key=lambda one: float(np.linalg.norm(one - [-0.709, 0.244])))
    evaluations = []

    def counted(*arguments: object, **named: object) -> object:
        way = solve_ivp(*arguments, **named)
        evaluations.append(way.nfev)
        return way

    monkeypatch.setattr("siq.quasipotential.paths.solve_ivp", counted)
    way = transition_path(known.dynamics, known.attractors[0], saddle, known.attractors[1])
    np.testing.assert_allclose(way.downhill[-1], known.attractors[1], atol=1e-9)
    assert len(evaluations) == 2 and sum(evaluations) < 20_000  # 914,767 before
