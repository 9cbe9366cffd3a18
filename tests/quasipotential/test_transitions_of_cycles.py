"""Barriers out of limit cycles and into them, against exact ones and against the mesh."""

from __future__ import annotations

import numpy as np
import pytest
import sympy
from scipy.integrate import quad, solve_ivp
from scipy.interpolate import CubicSpline

from siq.errors import NumericalFailure
from siq.quasipotential import paths
from siq.quasipotential.landscape import Landscape
from siq.quasipotential.path_chains import MinimumActionPath
from siq.quasipotential.paths import minimum_action_path, transition_path
from siq.quasipotential.transitions import _escape_rate_over_cycle
from siq.systems.cycles import Cycle, closed_orbit, hessians_along
from siq.systems.dynamics import Dynamics
from siq.systems.equilibria import hessian_at
from siq.systems.phase_portrait import phase_portrait
from siq.validation.mesh import mesh_quasipotential

x, y, z = (sympy.Symbol(name, real=True) for name in "xyz")
INNER, OUTER = 0.6, 1.0


def rings(turn: float, *, axis: bool = False) -> Dynamics:
    """dV/dr = r(r² - a²)(r² - b²) and a rotation: a point and two cycles; with z²/2 beside."""
    radius = x**2 + y**2
    slope = (radius - sympy.Rational(9, 25)) * (radius - 1)
    flat = (-x * slope - turn * y, -y * slope + turn * x)
    if axis:
        return Dynamics.of((x, y, z), (*flat, -z), domain=[(-1.8, 1.8), (-1.8, 1.8), (-1, 1)])
    return Dynamics.of((x, y), flat, domain=[(-1.8, 1.8)] * 2)


def height(radius: float) -> float:
    """U = 2V of the rings, zero at the point."""
    a, b = INNER**2, OUTER**2
    return 2 * (radius**6 / 6 - (a + b) * radius**4 / 4 + a * b * radius**2 / 2)


def ring(system: Dynamics, radius: float, turn: float) -> Cycle:
    phase = np.linspace(0, 2 * np.pi, 256, endpoint=False)
    guess = radius * np.stack([np.cos(phase), np.sin(phase)], axis=1)
    guess = np.column_stack([guess, np.zeros((256, system.dimension - 2))])
    return closed_orbit(system, guess, 2 * np.pi / turn, scale=np.full(system.dimension, 2.0))


def out_of(turn: float, *, axis: bool = False) -> MinimumActionPath:
    system = rings(turn, axis=axis)
    return minimum_action_path(system, *(ring(system, radius, turn) for radius in (OUTER, INNER)))


def into(turn: float, *, axis: bool = False) -> MinimumActionPath:
    system = rings(turn, axis=axis)
    return minimum_action_path(system, np.zeros(system.dimension), ring(system, INNER, turn))


def loop(turn: float, *, half: float = 0.08, strength: int = 20) -> tuple[Dynamics, float]:
    """V = k (h - c)²/2 with h = (x² + y²)/2 - x³/3, and a field along its levels; the barrier is exact.

    The cycle is h = c, and the saddle of h at (1, 0), where it is 1/6, is one of V.
    """
    level = (x**2 + y**2) / 2 - x**3 / 3
    potential = strength * (level - sympy.Rational(str(half))) ** 2 / 2
    field = (
        -potential.diff(x) + turn * level.diff(y),
        -potential.diff(y) - turn * level.diff(x),
    )
    system = Dynamics.of((x, y), field, domain=[(-0.7, 1.3), (-0.7, 0.7)])
    return system, strength * (1 / 6 - half) ** 2


def test_the_barriers_of_rings_are_exact() -> None:
    """Every phase is as good as any other, which no minimisation may mind."""
    found = out_of(2.0)
    assert found.converged
    assert found.action == pytest.approx(height(INNER) - height(OUTER), rel=2e-4)
    np.testing.assert_allclose(np.linalg.norm(found.points[[0, -1]], axis=1), [OUTER, INNER], rtol=1e-8)
    assert found.values[0] == 0 and found.values[-1] == found.action


@pytest.mark.slow
@pytest.mark.parametrize("axis", [False, True])
@pytest.mark.parametrize("turn", [0.2, 2.0, 20.0])
def test_both_barriers_of_rings_are_exact_however_fast_they_turn(turn: float, axis: bool) -> None:
    for found, exact in (
        (into(turn, axis=axis), height(INNER)), (out_of(turn, axis=axis), height(INNER) - height(OUTER)),
    ):  # fmt: skip
        assert found.converged
        assert found.action == pytest.approx(exact, rel=5e-4)


@pytest.mark.parametrize("turn", [pytest.param(1.0, marks=pytest.mark.slow), 6.0])
def test_the_way_out_of_a_cycle_over_a_saddle_is_exact(turn: float) -> None:
    system, exact = loop(turn)
    landscape = Landscape.from_equations(system)
    (cycle,), (way,) = landscape.cycles, landscape.transitions
    assert cycle.stable and cycle is landscape.attractors[0]
    assert way.barrier == pytest.approx(exact, rel=1e-6)
    assert way.end is None and way.path is not None and way.path.converged
    # g has no divergence, so that the density is exp(-U/ε), and its integral along the cycle ∮ dx/|∇h|.
    steep, noise = 20 * (1 / 6 - 0.08), exact / 10
    unstable = np.linalg.eigvals(system.jacobian(np.array([[1.0, 0.0]]))[0]).real.max()
    time = 2 * np.pi / unstable * steep * np.sqrt(1 / (20 * np.pi * noise)) * turn * cycle.period
    assert way.exit.prefactor_at(noise) == pytest.approx(time, rel=0.005)
    assert landscape.dwell_times(noise=noise)["mean_time"][0] == pytest.approx(time * np.exp(10), rel=0.005)
    assert "one attractor, a limit cycle of period" in landscape.report()
    assert landscape.certificate is None and any("not written as a formula" in one for one in landscape.notes)


def time_by_quadrature(begin: float, end: float, noise: float) -> float:
    """Mean time from one radius of the rings to another one."""

    def density(radius: float) -> float:
        return float(-height(radius) / noise + np.log(radius))

    far = 2.0 if end < begin else 0.0

    def slowness(radius: float) -> float:
        low, high = sorted((far, radius))
        known = [one for one in (INNER, OUTER) if low < one < high]
        behind = quad(lambda r: np.exp(density(r) - density(radius)), low, high, points=known, limit=400)[0]
        return 2 / noise * behind

    return abs(quad(slowness, begin, end, points=[INNER], limit=400)[0])


@pytest.mark.slow
@pytest.mark.parametrize("outwards", [True, False])
def test_the_law_of_ways_over_a_cycle_errs_as_the_noise_does(outwards: bool) -> None:
    """From the point, and from the outer ring, whose laws go with other powers of ε."""
    system = rings(2.0)
    path, start = (into(2.0), np.zeros(2)) if outwards else (out_of(2.0), ring(system, OUTER, 2.0))
    law, errors = _escape_rate_over_cycle(system, path, start, ring(system, INNER, 2.0)), []
    assert law.power == (0.5 if outwards else 0.0) and law.phases is not None
    assert law.phases[0].max() < 1e-5 * path.action  # every phase is as good as any other
    for share in (10, 20, 40):
        noise = path.action / share
        exact = time_by_quadrature(*((1e-6, OUTER) if outwards else (OUTER, 0.05)), noise)
        errors.append(share * (law.mean_time(noise) / exact - 1))
    assert np.abs(errors).max() < 1.3
    np.testing.assert_allclose(errors, errors[-1], rtol=0.25)


@pytest.mark.slow
@pytest.mark.parametrize("axis", [False, True])
def test_a_point_and_a_cycle_make_a_landscape(axis: bool) -> None:
    landscape = Landscape.from_equations(rings(2.0, axis=axis))
    assert [one.kind for one in landscape.attractors] == ["attractor", "cycle"]
    (parting,) = landscape.parting
    assert parting.unstable == 1 and parting.period == pytest.approx(np.pi, rel=1e-9)
    barriers = landscape.barriers().set_index("start").sort_index()
    assert barriers["end"].tolist() == [1, 0]
    exact = [height(INNER), height(INNER) - height(OUTER)]
    np.testing.assert_allclose(barriers["barrier"], exact, rtol=1e-4)
    np.testing.assert_allclose(landscape.heights, [0, height(OUTER)], atol=1e-5)
    # About the point there is a formula, and it is certified; about the cycle there is none, which is said.
    assert landscape.certificate is not None and landscape.certificate.certified
    assert landscape.wells[0] is not None and landscape.wells[1] is None
    assert landscape.basins.sum() == pytest.approx(1)


@pytest.mark.slow
def test_u_about_the_cycle_of_van_der_pol_is_that_of_the_mesh() -> None:
    """The mesh shares neither equations nor code with paths; its error is about 0.3 % here."""
    system = Dynamics.of((x, y), (y, (1 - x**2) * y - x), domain=[(-3, 3), (-4, 4)])
    (cycle,) = phase_portrait(system).cycles
    points, hessians = finer(cycle.points), finer(hessians_along(system, cycle))
    box = np.array([[-3.5, 3.5], [-4.5, 4.5]])
    mesh = mesh_quasipotential(
        system.drift,
        points,
        hessian=hessians,
        box=box,
        shape=(401, 401),
        diffusion=system.diffusion,
        reach=8,
    )
    places = np.array([[1.0, 0.0], [0.0, -1.0], [2.5, 1.0]])
    found = [minimum_action_path(system, cycle, place).action for place in places]
    np.testing.assert_allclose(found, 2 * mesh.evaluate(places), rtol=4e-3)


def finer(values: np.ndarray) -> np.ndarray:
    """What is known along a cycle, at sixteen times as many places."""
    count = len(values)
    curve = CubicSpline(np.arange(count + 1), np.concatenate([values, values[:1]]), bc_type="periodic")
    return np.asarray(curve(np.arange(16 * count) / 16))


@pytest.mark.slow
def test_an_oscillation_beside_rest_has_the_barriers_of_characteristics_and_of_the_mesh() -> None:
    """Liénard's equation with an unstable cycle within a stable one: here phases differ."""
    friction = sympy.Rational(1, 4) - x**2 + sympy.Rational(2, 5) * x**4
    system = Dynamics.of((x, y), (y - x * friction, -x), domain=[(-2, 2)] * 2)
    portrait = phase_portrait(system)
    (cycle,), (parting,) = portrait.cycles, portrait.parting
    inwards = minimum_action_path(system, portrait.attractors[0].position, parting)
    assert inwards.action == pytest.approx(lowest_crossing(system, parting), rel=1e-4)
    outwards = minimum_action_path(system, cycle, parting)
    mesh = mesh_quasipotential(
        system.drift, finer(cycle.points), hessian=finer(hessians_along(system, cycle)),
        box=np.array([[-3.0, 3.0]] * 2), shape=(401, 401), diffusion=system.diffusion, reach=9,
    )  # fmt: skip
    assert outwards.action == pytest.approx(2 * np.nanmin(mesh.evaluate(parting.points)), rel=5e-3)


def lowest_crossing(system: Dynamics, cycle: Cycle) -> float:
    """U at which the first trajectories of Hamilton's equations from the origin cross a cycle about it."""
    hessian = hessian_at(system, np.zeros(2))
    angle = np.arctan2(cycle.points[:, 1], cycle.points[:, 0])
    radius, order = np.linalg.norm(cycle.points, axis=1), np.argsort(angle)

    def rates(_: float, state: np.ndarray) -> np.ndarray:
        at, momentum = state[None, :2], state[2:4]
        falls = -momentum @ system.jacobian(at)[0]
        return np.concatenate([system.drift(at)[0] + 2 * momentum, falls, [2 * momentum @ momentum]])

    def crosses(_: float, state: np.ndarray) -> float:
        edge = np.interp(np.arctan2(state[1], state[0]), angle[order], radius[order], period=2 * np.pi)
        return float(np.hypot(state[0], state[1]) - edge)

    crosses.terminal = True  # type: ignore[attr-defined]
    levels = []
    for phase in np.linspace(0, np.pi, 12, endpoint=False):
        start = 1e-3 * np.array([np.cos(phase), np.sin(phase)])
        momentum = hessian @ start
        begin = np.concatenate([start, momentum, [start @ momentum]])
        way = solve_ivp(rates, (0, 200), begin, method="DOP853", rtol=1e-10, atol=1e-13, events=crosses)
        levels += [float(way.y_events[0][0][4])] if len(way.t_events[0]) else []
    return min(levels)


@pytest.mark.slow
def test_an_unstable_cycle_alone_bounds_a_well() -> None:
    """V = a²r²/2 - r⁴/4 and a rotation: beyond r = a all states run away."""
    radius, slope = x**2 + y**2, sympy.Rational(1, 2)
    field = (-x * (slope - radius) - y, -y * (slope - radius) + x)
    landscape = Landscape.from_equations(Dynamics.of((x, y), field, domain=[(-1, 1)] * 2))
    (way,) = landscape.transitions
    assert way.end is None and way.barrier == pytest.approx(1 / 8, rel=1e-4)
    assert (
        isinstance(way.saddle, Cycle)
        and way.notes[0] == "behind the unstable cycle f leads out of the region"
    )
    assert np.linalg.norm(way.place) == pytest.approx(np.sqrt(0.5), rel=1e-6)


def test_noise_on_some_states_only_is_refused_in_words() -> None:
    system = Dynamics.of((x, y), rings(2.0).formulas, diffusion=np.diag([0.0, 1.0]))
    with pytest.raises(NumericalFailure, match="noise on every state"):
        minimum_action_path(system, np.zeros(2), ring(system, INNER, 2.0))


def test_the_way_down_from_a_saddle_to_a_point_is_a_descent_wherever_the_path_began(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """From a cycle over a saddle to a point the period of a cycle was asked for."""
    x, y = sympy.symbols("x y", real=True)
    system, saddle, point = Dynamics.of((x, y), (x - x**3, -y)), np.zeros(2), np.array([1.0, 0.0])
    uphill = transition_path(system, -point, saddle, point)
    monkeypatch.setattr(paths, "minimum_action_path", lambda *_, **__: uphill)
    found = transition_path(system, Cycle(np.zeros((4, 2)), 1.0, np.zeros(1)), saddle, point)
    assert found.downhill is not None and found.downhill[-1] == pytest.approx(point)
