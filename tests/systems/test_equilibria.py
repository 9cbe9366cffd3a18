from __future__ import annotations

import numpy as np
import pytest
import sympy
from known_systems import (
    KnownSystem,
    archetype,
    double_well,
    limit_cycle,
    linear_system,
    maier_stein,
    polynomial_system,
    portrait_of,
    uniform_points,
)

from siq.remarks import sentence
from siq.systems.basins import follow, sides_of
from siq.systems.dynamics import Dynamics
from siq.systems.equilibria import classify, find_equilibria, hessian_at
from siq.systems.phase_portrait import phase_portrait

pytestmark = pytest.mark.portable

x, y = (sympy.Symbol(name, real=True) for name in "xy")
WIDE = np.array([[-2.0, 2.0], [-2.0, 2.0]])


def equilibria(known: KnownSystem, count: int = 200) -> dict[str, list[list[float]]]:
    found: dict[str, list[list[float]]] = {}
    for one in find_equilibria(known.dynamics, uniform_points(known, count)):
        found.setdefault(one.kind, []).append((one.position.round(9) + 0.0).tolist())
    return found


@pytest.mark.parametrize("dimension", [2, 3, 4])
def test_the_archetype_has_two_attractors_and_a_saddle(dimension: int) -> None:
    zeros = [0.0] * (dimension - 1)
    assert equilibria(archetype(dimension)) == {
        "attractor": [[-1.0, *zeros], [1.0, *zeros]],
        "saddle": [[0.0, *zeros]],
    }


@pytest.mark.parametrize("beta", [1, 5, 10])
def test_maier_and_steins_system_has_two_attractors_and_a_saddle(beta: float) -> None:
    found = equilibria(maier_stein(beta))
    assert found["attractor"] == [[-1.0, 0.0], [1.0, 0.0]]
    assert found["saddle"] == [[0.0, 0.0]]
    if beta == 1:
        assert set(found) == {"attractor", "saddle"}


@pytest.mark.parametrize("seed", range(3))
def test_all_wells_of_random_systems_are_found(seed: int) -> None:
    known = polynomial_system(2, seed=seed)
    np.testing.assert_allclose(equilibria(known)["attractor"], known.attractors, atol=1e-8)


def test_every_equilibrium_is_a_root_to_rounding() -> None:
    known = polynomial_system(2, seed=1)
    for one in find_equilibria(known.dynamics, uniform_points(known, 200)):
        assert np.abs(known.dynamics.drift(one.position[None])).max() < 1e-11


def test_a_limit_cycle_has_no_attractor() -> None:
    known = limit_cycle()
    assert equilibria(known) == {"repeller": [[0.0, 0.0]]}
    found = portrait_of(known)
    assert found.attractors == ()
    assert found.unsettled == 1
    assert "limit cycle" in sentence(found.fault())


def test_a_limit_cycle_beside_an_attractor_is_named() -> None:
    # The origin attracts within the unit circle, the circle of radius 2 beyond.
    square = x**2 + y**2
    radial = (square - 1) * (4 - square) / 4
    dynamics = Dynamics.of((x, y), (x * radial - 2 * y, y * radial + 2 * x))
    points = np.random.default_rng(0).uniform(-1.5, 1.5, size=(150, 2))
    found = phase_portrait(dynamics, points)
    assert len(found.attractors) == 1
    assert found.unsettled == pytest.approx((np.linalg.norm(points, axis=1) > 1).mean())
    told = sentence(found.fault())
    assert "of the recorded states lead to no equilibrium: they end on a limit cycle" in told


def test_an_equilibrium_that_is_degenerate_is_named() -> None:
    dynamics = Dynamics.of((x, y), (-(x**3), -y))
    one = classify(dynamics, np.zeros(2))
    assert one.kind == "degenerate"
    dynamics = Dynamics.of((x, y), (-x * (x - 1) ** 2, -y))
    points = np.random.default_rng(0).uniform(-1, 2, size=(200, 2))
    found = phase_portrait(dynamics, points)
    assert "neither stable nor unstable to first order" in sentence(found.fault())


def test_an_f_that_is_constant_has_no_equilibria() -> None:
    points = np.random.default_rng(0).uniform(-1, 1, (50, 2))
    assert find_equilibria(Dynamics.of((x, y), (0 * x, 1 + 0 * y)), points) == []


def test_kinds_and_numbers_of_unstable_directions() -> None:
    for equations, kind, unstable in [
        ((-x, -2 * y), "attractor", 0),
        ((x, -2 * y), "saddle", 1),
        ((x - y, 2 * y + x), "repeller", 2),
        ((-x / 10 - 5 * y, 5 * x - y / 10), "attractor", 0),
        ((-y, x), "degenerate", 0),
    ]:
        one = classify(Dynamics.of((x, y), equations), np.zeros(2))
        assert (one.kind, one.unstable) == (kind, unstable)
        assert (np.diff(one.eigenvalues.real) <= 0).all()


@pytest.mark.parametrize("known", [archetype(3), double_well(2), maier_stein(5)])
def test_a_saddle_lies_between_the_attractors_next_to_it(known: KnownSystem) -> None:
    found = portrait_of(known)
    assert [len(saddles) for saddles in found.saddles] == [1, 1]
    assert found.saddles[0] == found.saddles[1]
    attractors = list(found.attractors)
    (sides,) = sides_of(known.dynamics, found.saddles[0][:1], attractors, box=found.box)
    assert set(sides) == {0, 1}
    np.testing.assert_allclose([one.position for one in attractors], known.attractors, atol=1e-9)


def test_a_saddle_leads_to_its_own_attractors_only() -> None:
    # Three wells in a row, and two saddles between them.
    known = KnownSystem(
        Dynamics.of((x, y), (-x * (x**2 - 1) * (x**2 - 4) / 4, -y)), None,
        np.array([[-2.0, 0], [0, 0], [2, 0]]), np.array([[-2.5, 2.5], [-1, 1]]),
    )  # fmt: skip
    found = portrait_of(known)
    places = [[one.position.round(6).tolist()[0] for one in saddles] for saddles in found.saddles]
    assert places == [[-1], [-1, 1], [1]]


def test_the_hessian_solves_the_lyapunov_equation() -> None:
    for dimension in range(2, 7):
        known = linear_system(dimension)
        hessian = hessian_at(known.dynamics, np.zeros(dimension))
        exact = np.array(sympy.hessian(known.potential, known.dynamics.symbols), dtype=float)
        np.testing.assert_allclose(hessian, exact, rtol=1e-9, atol=1e-10)
        np.testing.assert_array_equal(hessian, hessian.T)


@pytest.mark.parametrize("units", [(1.0, 1.0), (1e-2, 20.0), (1e6, 1e-5)])
def test_the_hessian_does_not_depend_on_the_axes_or_units(units: tuple[float, float]) -> None:
    known = maier_stein(5)
    angle = 0.6
    turn = np.diag(units) @ np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    back = dict(zip((x, y), np.linalg.inv(turn) @ np.array([x, y]), strict=True))
    diffusion = np.array([[1.0, 0.3], [0.3, 0.5]])
    turned = Dynamics.of(
        (x, y),
        tuple(turn @ np.array([f.subs(back, simultaneous=True) for f in known.dynamics.formulas])),
        diffusion=turn @ diffusion @ turn.T,
    )
    one = hessian_at(known.with_diffusion(diffusion).dynamics, np.array([-1.0, 0]))
    other = hessian_at(turned, turn @ [-1.0, 0])
    np.testing.assert_allclose(turn.T @ other @ turn, one, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("units", [(1e-3, 40.0), (1e5, 1e-6)])
def test_the_phase_portrait_does_not_depend_on_units(units: tuple[float, float]) -> None:
    known, scale = double_well(2), np.array(units)
    back = {s: s / sympy.Float(u) for s, u in zip(known.dynamics.symbols, units, strict=True)}
    scaled = Dynamics.of(
        known.dynamics.symbols,
        tuple(
            sympy.Float(u) * f.subs(back, simultaneous=True)
            for u, f in zip(units, known.dynamics.formulas, strict=True)
        ),
        diffusion=known.diffusion * np.outer(scale, scale),
    )
    points = uniform_points(known, 100)
    one = phase_portrait(known.dynamics, points)
    two = phase_portrait(scaled, points * scale)
    assert [other.kind for other in two.equilibria] == [other.kind for other in one.equilibria]
    for a, b in zip(one.equilibria, two.equilibria, strict=True):
        np.testing.assert_allclose(b.position / scale, a.position, atol=1e-8)
    np.testing.assert_array_equal(two.descents.ends, one.descents.ends)
    np.testing.assert_allclose(two.descents.paths / scale, one.descents.paths, atol=1e-5)
    assert two.fault() is None


def test_paths_begin_at_their_starts_and_end_at_attractors() -> None:
    known = archetype(2)
    starts = uniform_points(known, 60)
    attractors = [one for one in find_equilibria(known.dynamics, starts) if one.kind == "attractor"]
    paths = follow(known.dynamics, starts, attractors, box=known.domain)
    np.testing.assert_array_equal(paths.paths[:, 0], starts)
    assert not paths.escaped.any()
    ends = np.array([one.position for one in attractors])[paths.ends]
    np.testing.assert_allclose(paths.paths[:, -1], ends, atol=2e-3)


def test_what_leaves_the_box_for_good_has_escaped() -> None:
    dynamics = Dynamics.of((x, y), (x**3 - x, -y))  # beyond x = ±1 everything runs to infinity
    starts = np.random.default_rng(0).uniform(-1.5, 1.5, size=(80, 2))
    found = follow(dynamics, starts, [classify(dynamics, np.zeros(2))], box=np.array([[-1.5, 1.5]] * 2))
    np.testing.assert_array_equal(found.escaped, np.abs(starts[:, 0]) > 1)
    np.testing.assert_array_equal(found.ends, np.where(found.escaped, -1, 0))
    assert np.isfinite(found.paths).all()


def test_slow_places_on_the_way_are_passed() -> None:
    # Near x = 1 there almost is an equilibrium, which takes a hundred relaxation times to pass.
    dynamics = Dynamics.of((x, y), (-x * ((x - 1) ** 2 + sympy.Rational(1, 1000)), -y))
    starts = np.random.default_rng(0).uniform(0.1, 1.9, size=(50, 2))
    found = follow(dynamics, starts, [classify(dynamics, np.zeros(2))], box=WIDE)
    np.testing.assert_array_equal(found.ends, 0)


def test_phase_portraits_of_random_systems_have_no_fault() -> None:
    known = polynomial_system(2, seed=0)  # of which a part moves slowly, far from every equilibrium
    found = portrait_of(known, 100, share=0.7)
    assert found.fault() is None
    assert found.unsettled == 0
