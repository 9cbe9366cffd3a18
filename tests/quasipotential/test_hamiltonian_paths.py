"""Paths where noise acts on some states only, against energies and other discretisations."""

from __future__ import annotations

import numpy as np
import pytest
import sympy
from scipy.integrate import quad, solve_ivp
from scipy.optimize import fsolve, least_squares

import siq
from siq.errors import NumericalFailure
from siq.quasipotential.hamiltonian_paths import hamiltonian_paths
from siq.quasipotential.paths import descent, minimum_action_path, transition_path
from siq.quasipotential.rates import escape_rate
from siq.systems.dynamics import Dynamics

X, V = sympy.symbols("x v", real=True)
TILT = sympy.Rational(1, 10)


def particles(count: int, friction: float, noise: float) -> tuple[Dynamics, sympy.Expr]:
    """Damped particles in a double well that couples them, and their potential Φ: V is (γ/D)(v²/2 + Φ)."""
    x, v = sympy.symbols(f"x:{count}", real=True), sympy.symbols(f"v:{count}", real=True)
    potential = (x[0] ** 2 - 1) ** 2 / 4 - TILT * x[0]
    for one, other in zip(x[1:], x, strict=False):
        potential += 0.7 * one**2 + 0.4 * one * other + 0.3 * one * x[0] ** 2
    forces = [-friction * speed - potential.diff(place) for place, speed in zip(x, v, strict=True)]
    system = Dynamics.of((*x, *v), (*v, *forces), diffusion=np.diag([0.0] * count + [noise] * count))
    return system, potential


def rest(system: Dynamics, first: float) -> np.ndarray:
    start = np.r_[first, np.zeros(system.dimension - 1)]
    return np.asarray(fsolve(lambda state: system.drift(state[None])[0], start, xtol=1e-13))


@pytest.mark.parametrize(("count", "friction"), [(1, 8.0), (1, 0.1), (2, 0.5), (3, 2.0)])
def test_damped_particles_have_the_barrier_and_the_momenta_of_their_energy(
    count: int, friction: float
) -> None:
    noise = 0.5
    system, potential = particles(count, friction, noise)
    start, saddle, target = (rest(system, place) for place in (-1.0, -0.1, 1.0))
    energy = sympy.lambdify(system.symbols[:count], potential)
    barrier = 2 * friction / noise * (energy(*saddle[:count]) - energy(*start[:count]))
    way = transition_path(system, start, saddle, target, tolerance=1e-5)
    path = way
    assert path.converged and path.residual < 1e-6
    assert path.action == pytest.approx(barrier, rel=1e-6)
    slopes = sympy.lambdify(
        system.symbols[:count], [potential.diff(place) for place in system.symbols[:count]]
    )
    gradient = np.stack(
        np.broadcast_arrays(*slopes(*path.points[:, :count].T), path.points[:, 0])[:-1], axis=1
    )
    expected = friction / noise * np.concatenate([gradient, path.points[:, count:]], axis=1)
    np.testing.assert_allclose(path.momenta, expected, atol=1e-4 * np.abs(expected).max())
    speeds = friction / noise * (path.points[:, count:] ** 2).sum(axis=1)
    values = speeds + 2 * friction / noise * (energy(*path.points[:, :count].T) - energy(*start[:count]))
    np.testing.assert_allclose(path.values, values, atol=1e-4 * barrier)


@pytest.mark.parametrize("balanced", [pytest.param(True, marks=pytest.mark.slow), False])
def test_damping_that_all_but_vanishes_at_the_saddle_has_a_path(balanced: bool) -> None:
    """``dv = (x - x³ - γ(x) v) dt + √(ε D) dW`` with γ = 0.1 x² + 0.01: the path winds, and comes in slowly.

    If D is γ, V is the energy. If D is one, ``dU/dE = 2⟨γv²⟩/⟨v²⟩`` on orbits, to the first order in γ.
    """
    damping = sympy.Rational(1, 10) * X**2 + sympy.Rational(1, 100)
    noise = [[0, 0], [0, damping if balanced else 1]]
    system = Dynamics.of((X, V), (V, X - X**3 - damping * V), diffusion=noise)
    way = transition_path(system, np.array([1.0, 0.0]), np.zeros(2), np.array([-1.0, 0.0]))
    assert way.converged
    if balanced:
        assert way.action == pytest.approx(0.5, rel=1e-5)
        return

    def slope(energy: float) -> float:
        turns = np.sqrt(1 + np.array([-1, 1]) * 2 * np.sqrt(energy + 0.25))  # from -1/4 in the well to 0
        x = turns.mean() + np.diff(turns) / 2 * np.sin(np.linspace(-np.pi / 2, np.pi / 2, 4001))
        speed = np.sqrt(np.maximum(2 * energy + x**2 - x**4 / 2, 0.0))
        lost = sympy.lambdify(X, damping)(x) * speed
        return float(2 * np.trapezoid(lost, x) / np.trapezoid(speed, x))

    barrier, _ = quad(slope, -0.25, 0.0, epsrel=1e-6)
    assert way.action == pytest.approx(barrier, rel=0.03)


def test_the_way_up_is_the_way_down_with_the_velocity_reversed() -> None:
    system, _ = particles(1, 0.6, 0.5)
    start, saddle = rest(system, -1.0), rest(system, -0.1)
    path = minimum_action_path(system, start, saddle, tolerance=1e-5)
    down = descent(system, saddle, start, 20_000) * [1, -1]
    inner = path.points[np.linalg.norm(path.points - start, axis=1) > 0.02]
    distance = np.abs(inner[:, None] - down[None, ::4]).sum(axis=2).min(axis=1)
    assert distance.max() < 2e-3


def test_coloured_noise_has_the_barrier_of_perturbation_theory() -> None:
    """Of dx/dt = x - x³ + η, the action is ½∫(ξ² + τ²ξ̇²)dt with ξ = ẋ - f: τ²/4 more than white noise."""
    for time in (0.1, 0.05):
        system = Dynamics.of((X, V), (X - X**3 + V, -V / time), diffusion=np.diag([0.0, 1 / time**2]))
        path = minimum_action_path(system, np.array([-1.0, 0.0]), np.zeros(2), tolerance=1e-6)
        assert path.converged
        assert path.action == pytest.approx(0.5 + time**2 / 4, abs=time**4)


def test_the_action_of_positions_alone_is_least_along_the_path() -> None:
    """A second discretisation: ½∫(ẍ - f_v(x, ẋ))²/D dt over positions, by differences."""
    system = Dynamics.of((X, V), (V, X - X**3 + TILT - (0.5 + X**2) * V), diffusion=np.diag([0.0, 1.0]))
    start, saddle = rest(system, -1.0), rest(system, -0.1)
    path = minimum_action_path(system, start, saddle, tolerance=1e-5)
    actions = []
    for steps in (200, 400):
        step = 30.0 / steps
        fixed = np.full(2, start[0]), np.full(2, saddle[0])

        def rest_of(inner: np.ndarray, step: float = step, fixed: tuple = fixed) -> np.ndarray:
            x = np.concatenate([fixed[0], inner, fixed[1]])
            velocity = (x[2:] - x[:-2]) / (2 * step)
            force = system.drift(np.stack([x[1:-1], velocity], axis=1))[:, 1]
            return np.sqrt(step / 2) * ((x[2:] - 2 * x[1:-1] + x[:-2]) / step**2 - force)

        first = np.linspace(0, 1, steps - 3) ** 3 * (saddle[0] - start[0]) + start[0]
        found = least_squares(
            rest_of, first, method="trf", x_scale=1.0, jac_sparsity=_band(steps - 1, steps - 3)
        )
        actions.append(2 * found.cost)
    extrapolated = (4 * actions[1] - actions[0]) / 3
    assert path.action == pytest.approx(extrapolated, rel=1e-3)
    assert abs(actions[1] / path.action - 1) < abs(actions[0] / path.action - 1) < 0.05


def _band(rows: int, columns: int) -> np.ndarray:
    place = np.arange(rows)[:, None] - np.arange(columns)[None]
    return ((place >= 0) & (place <= 2)).astype(int)


def test_shooting_from_point_to_point_of_a_solution_meets_the_next() -> None:
    """Hamilton's equations hold for another integrator, noise of the state included."""
    system = Dynamics.of((X, V), (V, X - X**3 + TILT - V), diffusion=[[0, 0], [0, 1 + X**2 / 2]])
    start, saddle = rest(system, -1.0), rest(system, -0.1)
    path = hamiltonian_paths(system, start, saddle, beside=descent(system, saddle, start, 4000))[0]
    noise = system.diffusion

    def rates(_: float, state: np.ndarray) -> np.ndarray:
        x, p = state[None, :2], state[None, 2:]
        velocity = system.drift(x) + 2 * noise.push(x, p)
        force = -np.einsum("nij,ni->nj", system.jacobian(x), p) - noise.contract(x, p, 1)
        return np.concatenate([velocity[0], force[0]])

    states = np.concatenate([path.points, path.momenta], axis=1)
    for first in range(1, len(states) - 21, 40):
        last = first + 20
        shot = solve_ivp(
            rates, path.times[[first, last]], states[first], rtol=1e-10, atol=1e-13, method="DOP853"
        )
        assert np.abs(shot.y[:, -1] - states[last]).max() < 1e-4 * np.abs(states[last]).max()


def test_any_state_of_a_linear_system_is_reached_at_its_quadratic_form() -> None:
    system = Dynamics.of((X, V), (V, -2 * X - 0.4 * V), diffusion=np.diag([0.0, 0.8]))
    for end in ([1.0, 0.5], [-0.2, 1.3]):
        path = minimum_action_path(system, np.zeros(2), np.array(end))
        assert path.action == pytest.approx(0.4 / 0.8 * (2 * end[0] ** 2 + end[1] ** 2), rel=1e-6)


def test_a_regular_system_has_the_path_of_its_geometric_action() -> None:
    turned = Dynamics.of((X, V), (X - X**3 - V * X, -V + X - X**3 + X**2 / 4), diffusion=np.diag([1.0, 0.5]))
    start, saddle = np.array([1.0, 0.0]), np.zeros(2)
    start = np.asarray(fsolve(lambda state: turned.drift(state[None])[0], start, xtol=1e-13))
    curve = minimum_action_path(turned, start, saddle, tolerance=1e-6)
    own = hamiltonian_paths(turned, start, saddle, beside=descent(turned, saddle, start, 4000))[0]
    assert own.smooth and own.action == pytest.approx(curve.action, rel=1e-5)


def test_paths_begin_at_attractors_alone() -> None:
    system, _ = particles(1, 0.6, 0.5)
    with pytest.raises(NumericalFailure, match="no stable equilibrium"):
        minimum_action_path(system, np.array([0.3, 0.1]), rest(system, -1.0))


@pytest.mark.parametrize("friction", [0.2, 1.0, 5.0])
def test_the_prefactor_is_that_of_kramers(friction: float) -> None:
    system, potential = particles(1, friction, 0.5)
    start, saddle = rest(system, -1.0), rest(system, -0.1)
    rate = escape_rate(system, minimum_action_path(system, start, saddle, tolerance=1e-5))
    stiffness = sympy.lambdify(system.symbols[0], potential.diff(system.symbols[0], 2))
    here, there = (np.sqrt(abs(stiffness(place[0]))) for place in (start, saddle))
    across = np.sqrt(friction**2 / 4 + there**2) - friction / 2
    assert rate.prefactor == pytest.approx(2 * np.pi / across * there / here, rel=1e-3)


@pytest.mark.slow
def test_a_curve_along_which_h_would_grow_is_no_path() -> None:
    """As where states come to the saddle about as fast across the path: this one had an action of 0.0885."""
    system = siq.reference_systems()["two-genes"]
    known = system.barriers[0]
    straight = np.linspace(known.start, known.saddle, 100)
    found = hamiltonian_paths(system.dynamics, known.start, known.saddle, curves=[straight], tolerance=1e-3)
    assert [one.action for one in found if one.smooth] == pytest.approx([known.value], rel=1e-5)
