from __future__ import annotations

import numpy as np
import pytest
import sympy
from known_systems import (
    KnownSystem,
    archetype,
    double_well,
    linear_system,
    maier_stein,
    polynomial_system,
    potential_gradient,
    potential_values,
    uniform_points,
)
from scipy.integrate import solve_ivp

from siq.equilibria import find_equilibria, hessian_at
from siq.errors import NumericalFailure
from siq.landscape.paths import MinimumActionPath, minimum_action_path, transition_path
from siq.vector_field import VectorField

MAIER_STEIN = {1: 0.5, 3: 0.5, 5: 0.4830697, 10: 0.3400413}  # β > 4: by shooting, independent of this code


def path_of(known: KnownSystem, end: np.ndarray, *, which: int = 0, **options: object) -> MinimumActionPath:
    return minimum_action_path(
        known.field, known.attractors[which], end, diffusion=known.diffusion, **options
    )


def transformed(known: KnownSystem, matrix: np.ndarray, *, speed: float = 1.0) -> KnownSystem:
    """The same system in other states ``matrix x`` and another unit of time, D carried along."""
    back = np.linalg.inv(matrix) @ sympy.Matrix(known.field.symbols)
    inner = dict(zip(known.field.symbols, list(back), strict=True))
    equations = sympy.Matrix(known.field.equations).subs(inner, simultaneous=True)
    return KnownSystem(
        VectorField(known.field.symbols, tuple(speed * (sympy.Matrix(matrix) * equations))),
        None if known.potential is None else known.potential.subs(inner, simultaneous=True),
        speed * matrix @ known.diffusion @ matrix.T,
        known.attractors @ matrix.T,
        known.domain,
    )


def rotating(dimension: int, rotation: float) -> KnownSystem:
    """The archetypal V with a circulation that is stronger by some factor."""
    plain = archetype(dimension)
    gradient = [plain.potential.diff(symbol) for symbol in plain.field.symbols]
    equations = [f + rotation * (f + v) for f, v in zip(plain.field.equations, gradient, strict=True)]
    return plain._replace(field=VectorField(plain.field.symbols, tuple(map(sympy.expand, equations))))


def resonator() -> tuple[KnownSystem, np.ndarray]:
    """The paper's driven resonator, slowly varying amplitudes P and Q, and its saddle."""
    p, q = sympy.symbols("P Q", real=True)
    own, drive, loss, cubic, force = 1.0, 1.0018, 0.00045, 33.0, 1.4e-5
    detuning, bend = (own**2 - drive**2) / (2 * drive), 3 * cubic / (8 * drive) * (p**2 + q**2)
    equations = (
        detuning * q - loss * p + bend * q,
        -detuning * p - loss * q - bend * p - force / (2 * drive),
    )
    field = VectorField((p, q), equations)
    found = find_equilibria(field, np.random.default_rng(0).uniform(-0.02, 0.02, size=(200, 2)))
    attractors = np.array([one.position for one in found if one.kind == "attractor"])
    saddle = next(one.position for one in found if one.kind == "saddle")
    domain = np.array([[-0.02, 0.02], [-0.02, 0.02]])
    return KnownSystem(field, None, np.eye(2), attractors, domain), saddle


def pairs(known: KnownSystem) -> list[tuple[int, np.ndarray]]:
    """Attractors with the saddles to which a path leads from them, by the known V.

    Backwards along ``ẋ = f + 2D∇V`` from a saddle one comes to the attractors from which it is reached.
    """

    def arrives(_: float, x: np.ndarray, __: KnownSystem) -> float:
        return float(np.linalg.norm(known.attractors - x, axis=1).min() - 0.05)

    arrives.terminal = True  # type: ignore[attr-defined]
    found = []
    for one in find_equilibria(known.field, uniform_points(known, 200)):
        if one.kind != "saddle" or one.unstable != 1:
            continue
        push = 2 * known.diffusion @ hessian_at(known.field, one.position, diffusion=known.diffusion)
        rates, modes = np.linalg.eig(known.field.jacobian(one.position[None])[0] + push)
        for side in (1, -1):
            start = one.position + side * 1e-3 * modes[:, np.argmin(rates.real)].real
            way = solve_ivp(_backwards, [0, 60], start, args=(known,), rtol=1e-6, atol=1e-8, events=arrives)
            if way.status == 1:
                near = np.linalg.norm(known.attractors - way.y[:, -1], axis=1)
                found.append((int(near.argmin()), one.position))
    return found


def _backwards(_: float, x: np.ndarray, known: KnownSystem) -> np.ndarray:
    slope = potential_gradient(known, x[None])[0]
    return -known.field(x[None])[0] - 2 * known.diffusion @ slope


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
    expected = -known.field(path.points) @ np.linalg.inv(known.diffusion)
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


MATRICES = {
    "units": np.diag([1e-2, 1e2]),
    "rotation": np.array([[0.8, -0.6], [0.6, 0.8]]),
    "both": np.array([[1e-3, 2e-3], [-30.0, 50.0]]),
}


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
    tiny = transformed(known, 1e-5 * np.eye(2))._replace(diffusion=np.eye(2))  # U is then of order 1e-10
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
    path = minimum_action_path(
        known.field, np.zeros(2), known.attractors[0], diffusion=known.diffusion, tolerance=1e-2
    )
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
    way = transition_path(
        known.field, start, saddle, target, diffusion=known.diffusion, nodes=200, tolerance=1e-2
    )
    np.testing.assert_allclose(way.points[0], start)
    np.testing.assert_allclose(way.points[-1], target)
    np.testing.assert_allclose(way.downhill[0], saddle)
    assert len(way.points) == len(way.uphill.points) + 199
    steps = np.diff(way.downhill, axis=0)
    forces = known.field((way.downhill[1:] + way.downhill[:-1]) / 2)
    angle = np.sum(steps * forces, axis=1) / np.linalg.norm(steps, axis=1) / np.linalg.norm(forces, axis=1)
    assert angle[1:-3].min() > 0.99


def test_where_f_does_not_lead_is_told() -> None:
    known, saddle = resonator()
    elsewhere = 1.5 * saddle
    with pytest.raises(NumericalFailure, match="does not lead from the saddle"):
        transition_path(known.field, known.attractors[0], saddle, elsewhere, diffusion=known.diffusion)
    with pytest.raises(NumericalFailure, match="no saddle"):
        transition_path(known.field, saddle, *known.attractors, diffusion=known.diffusion)


def test_a_path_needs_two_states() -> None:
    known = archetype(2)
    with pytest.raises(ValueError, match="where it starts"):
        path_of(known, known.attractors[0])
