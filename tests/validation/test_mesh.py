from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import sympy
from known_systems import (
    KnownSystem,
    double_well,
    linear_system,
    maier_stein,
    polynomial_system,
    potential_values,
)

from siq.errors import NumericalFailure
from siq.quasipotential.characteristics import adapted_fan
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics
from siq.systems.equilibria import hessian_at
from siq.validation.mesh import _MeshQuasipotential, mesh_quasipotential

LEFT = np.array([[-2.0, 0.0], [-1.0, 1.0]])  # the left well of a system with its saddle at the origin


def mesh_of(
    known: KnownSystem, count: int, *, which: int = 0, box: np.ndarray | None = None, **options: Any
) -> _MeshQuasipotential:
    attractor = known.attractors[which]
    return mesh_quasipotential(
        known.dynamics.drift,
        attractor,
        hessian=hessian_at(known.dynamics, attractor),
        box=known.domain if box is None else box,
        shape=(count + 1, count + 1),
        diffusion=known.dynamics.diffusion,
        **options,
    )


def nodes_of(mesh: _MeshQuasipotential) -> np.ndarray:
    return np.stack(np.meshgrid(*mesh.axes, indexing="ij"), axis=-1)


def errors(known: KnownSystem, mesh: _MeshQuasipotential) -> np.ndarray:
    """Of V at the nodes that were reached, as shares of the level."""
    x = nodes_of(mesh)[np.isfinite(mesh.values)]
    exact = potential_values(known, x) - potential_values(known, mesh.attractor[None])
    return (mesh.values[np.isfinite(mesh.values)] - exact) / mesh.level


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def turning_double_well(rotation: float) -> KnownSystem:
    """``V = (x² - 1)²/2 + y²/2`` with g = rotation · (-∂V/∂y, ∂V/∂x): everywhere |g| = rotation |∇V|."""
    x, y = sympy.symbols("x y", real=True)
    potential = sympy.expand((x**2 - 1) ** 2 / 2 + y**2 / 2)
    turn = sympy.Matrix([[-1, -rotation], [rotation, -1]])
    force = turn * sympy.Matrix([potential.diff(x), potential.diff(y)])
    return KnownSystem(
        Dynamics.of((x, y), tuple(force)), potential, np.array([[-1.0, 0.0], [1.0, 0.0]]), LEFT
    )


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_linear_system_has_its_quadratic_form(seed: int) -> None:
    known = linear_system(2, seed=seed)
    assert np.abs(known.diffusion[0, 1]) > 0.05
    mesh = mesh_of(known, 64)
    assert mesh.stop == "boundary"
    assert np.abs(errors(known, mesh)).max() < 1e-4
    # The method as published has no second differences, and errors of V on every edge of the front.
    assert rms(errors(known, mesh_of(known, 64, as_published=True))) < 5e-3


def scaled(known: KnownSystem, scale: np.ndarray, speed: float) -> dict[str, Any]:
    """The same system in other units of the states, by `scale`, and of time."""
    attractor = known.attractors[0]
    return {
        "drift": lambda x: speed * scale * known.dynamics.drift(x / scale),
        "attractor": attractor * scale,
        "hessian": hessian_at(known.dynamics, attractor) / np.outer(scale, scale),
        "diffusion": Diffusion(speed * known.diffusion * np.outer(scale, scale)),
    }


# Decimal factors change rounding, and with it which of two nodes of the same value comes first; so none has.
@pytest.mark.parametrize("known", [linear_system(2, seed=3), turning_double_well(1)])
@pytest.mark.parametrize(
    ("scale", "speed", "tolerance"),
    [([2.0**-7, 2.0**10], 2.0**-14, 0.0), ([1e-2, 1e3], 1e-4, 1e-9), ([3e-9, 3e-9], 7.0, 1e-9)],
)
def test_units_of_the_states_and_of_time_change_nothing(
    known: KnownSystem, scale: list[float], speed: float, tolerance: float
) -> None:
    box = known.domain + np.array([[0.07], [0.03]])
    mesh = mesh_of(known, 48, box=box)
    other = mesh_quasipotential(
        **scaled(known, np.array(scale), speed), box=box * np.array(scale)[:, None], shape=(49, 49)
    )
    assert other.reach == mesh.reach
    np.testing.assert_allclose(other.values, mesh.values, rtol=tolerance, atol=0)
    np.testing.assert_allclose(other.axes[1], mesh.axes[1] * scale[1], rtol=1e-14, atol=1e-14 * scale[1])


def test_mesh_widths_may_differ() -> None:
    known = linear_system(2, seed=1)
    mesh = mesh_quasipotential(
        known.dynamics.drift,
        np.zeros(2),
        hessian=hessian_at(known.dynamics, np.zeros(2)),
        box=np.array([[-1.93, 2.11], [-0.71, 0.93]]),  # A is no node, nor in the middle
        shape=(141, 61),
        diffusion=known.dynamics.diffusion,
    )
    assert mesh.values.shape == (141, 61)
    assert np.abs(errors(known, mesh)).max() < 1e-4


@pytest.mark.parametrize("which", [0, 1])
def test_two_wells_of_different_depth(which: int) -> None:
    known = double_well(2)
    mesh = mesh_of(known, 256, which=which, level=0.12)  # of V, whose saddle is 0.15 or more above
    assert mesh.stop == "level"
    assert np.abs(errors(known, mesh)).max() < 3e-3
    x = nodes_of(mesh)
    exact = potential_values(known, x.reshape(-1, 2)).reshape(x.shape[:2])
    exact -= potential_values(known, mesh.attractor[None])
    # All of the well below the level, and nothing of the other one.
    below = (exact < 0.118) & (x[..., 0] * mesh.attractor[0] > 0.1)
    assert np.isfinite(mesh.values[below]).all()
    assert np.isnan(mesh.values[x[..., 0] * mesh.attractor[0] < -0.1]).all()


# Measured over N = 64, 128, 256, 512: rms errors fall by 3.8 to 4.9 for each doubling of N.
@pytest.mark.parametrize(
    "known", [maier_stein(1), turning_double_well(1), turning_double_well(3), turning_double_well(10)]
)
def test_the_error_is_of_second_order(known: KnownSystem) -> None:
    sizes = [rms(errors(known, mesh_of(known, count, box=LEFT))) for count in (64, 128, 256)]
    orders = np.log2(sizes[:-1]) - np.log2(sizes[1:])
    assert orders.min() > 1.7
    assert sizes[-1] < 2.5e-3


@pytest.mark.slow
@pytest.mark.parametrize("known", [maier_stein(1), turning_double_well(3)])
def test_the_order_stays_on_fine_meshes(known: KnownSystem) -> None:
    sizes = [rms(errors(known, mesh_of(known, count, box=LEFT))) for count in (256, 512, 1024)]
    orders = np.log2(sizes[:-1]) - np.log2(sizes[1:])
    assert orders.min() > 1.7


def test_the_published_method_is_of_first_order() -> None:
    known = maier_stein(1)
    sizes = [
        rms(errors(known, mesh_of(known, n, box=LEFT, reach=4, as_published=True))) for n in (64, 128, 256)
    ]
    orders = np.log2(sizes[:-1]) - np.log2(sizes[1:])
    assert orders.min() > 0.8
    assert orders.max() < 1.5
    assert sizes[-1] > 10 * rms(errors(known, mesh_of(known, 256, box=LEFT)))


@pytest.mark.parametrize(("beta", "barrier"), [(5, 0.4831), (10, 0.34004)])
def test_the_barrier_is_found_where_the_path_leaves_the_axis(beta: float, barrier: float) -> None:
    box = np.array([[-2.0, 0.5], [-1.0, 1.0]])
    mesh = mesh_of(maier_stein(beta), 256, box=box, level=0.26, stop_at_boundary=False)
    assert 2 * mesh.evaluate(np.zeros((1, 2)))[0] == pytest.approx(barrier, rel=5e-4)
    # V is even in y.
    np.testing.assert_allclose(mesh.values, mesh.values[:, ::-1], atol=5e-5)


@pytest.mark.slow
def test_values_agree_with_characteristics_beyond_the_caustic() -> None:
    known = maier_stein(10)
    fan = adapted_fan(
        known.dynamics,
        known.attractors[0],
        level=0.168,  # the saddle is at 0.170; below it the sheets meet on the axis
        box=np.array([[-2.0, 0.0], [-1.5, 1.5]]),
        generator=np.random.default_rng(0),
        count=48,
        most=200,
        rounds=4,
    )
    mesh = mesh_of(known, 200, box=np.array([[-2.0, 0.5], [-1.0, 1.0]]), level=0.2, stop_at_boundary=False)
    sheet = fan.lowest_sheet()
    difference = (mesh.evaluate(fan.points[sheet]) - fan.values[sheet]) / fan.level
    # Near the kink the fan keeps points of the upper sheet that are too high by up to 2e-3 of the level.
    assert np.abs(difference).max() < 2e-3
    assert rms(difference) < 3e-4
    assert np.median(np.abs(difference)) < 1e-4


def test_fast_turning_needs_a_long_reach() -> None:
    known = linear_system(2, rotation=24)
    mesh = mesh_of(known, 64)
    assert mesh.reach > 15
    assert np.abs(errors(known, mesh)).max() < 1e-4
    short = errors(known, mesh_of(known, 64, reach=3))
    assert rms(short) > 0.01 and short.mean() > 0


def test_a_random_polynomial_system() -> None:
    known = polynomial_system(2, seed=1)
    mesh = mesh_of(known, 200, box=known.attractors[0][:, None] + np.array([-1.0, 1.0]), level=0.05)
    assert mesh.stop == "level"
    assert rms(errors(known, mesh)) < 5e-3


def test_why_the_work_ends() -> None:
    known = linear_system(2)
    at_boundary = mesh_of(known, 40)
    reached = np.isfinite(at_boundary.values)
    assert at_boundary.stop == "boundary"
    assert not reached[[0, -1]].any() and not reached[:, [0, -1]].any()
    exact = potential_values(known, nodes_of(at_boundary).reshape(-1, 2)).reshape(reached.shape)
    assert reached[exact < 0.99 * at_boundary.level].all()
    assert np.nanmax(at_boundary.values) == at_boundary.level

    at_level = mesh_of(known, 40, level=at_boundary.level / 2)
    assert at_level.stop == "level"
    assert 0.4 < at_level.level / at_boundary.level <= 0.5
    np.testing.assert_array_equal(
        at_level.values[np.isfinite(at_level.values)],
        at_boundary.values[np.isfinite(at_level.values)],
    )

    everywhere = mesh_of(known, 40, stop_at_boundary=False)
    assert everywhere.stop == "everywhere"
    assert np.isfinite(everywhere.values).all()
    np.testing.assert_array_equal(everywhere.values[reached], at_boundary.values[reached])


def test_values_between_nodes() -> None:
    known = linear_system(2)
    mesh = mesh_of(known, 64)
    draw = np.random.default_rng(0)
    x = draw.uniform(-2.2, 2.2, size=(2000, 2))
    exact, cubic = potential_values(known, x), mesh.evaluate(x)
    inside = exact < 0.7 * mesh.level
    np.testing.assert_allclose(cubic[inside], exact[inside], atol=1e-5 * mesh.level)
    assert np.isnan(cubic[(np.abs(x) > 2).any(axis=1) | (exact > 1.1 * mesh.level)]).all()
    assert np.isnan(mesh.evaluate(np.array([[np.nan, 0.0]]))).all()
    np.testing.assert_array_equal(mesh.evaluate(nodes_of(mesh).reshape(-1, 2)), mesh.values.ravel())


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({"attractor": np.zeros(3)}, "the attractor must be finite numbers of shape"),
        ({"hessian": np.array([[1.0, np.nan], [0.0, 1.0]])}, "the hessian must be finite"),
        ({"diffusion": Diffusion(np.diag([1.0, 0.0]))}, "the diffusion .* is not positive definite"),
        ({"hessian": np.array([[1.0, 1.0], [0.0, 1.0]])}, "the hessian .* is not symmetric"),
        ({"box": np.array([[2.0, -2.0], [-1.0, 1.0]])}, "needs a lower and an upper end"),
        ({"box": np.array([[0.0, 2.0], [-1.0, 1.0]])}, "the attractor .* is not inside the box"),
        ({"box": np.array([[-1.05, 2.0], [-1.0, 1.0]])}, "take more nodes or a larger box"),
        ({"attractor": np.array([-0.8, 0.0])}, "is no equilibrium"),
        ({"hessian": 2 * np.diag([2.0, 2.0])}, "is not the Hessian of V .* U = 2V has twice that"),
        ({"shape": (8, 64)}, "too coarse"),
        ({"reach": 1}, "a reach of 1 mesh widths is too short"),
        ({"level": 0.0}, "the level 0.0 must be positive"),
        ({"level": 1e-4}, "above the level"),
        ({"drift": lambda x: x[:, :1]}, "f of points of shape"),
    ],
)
def test_bad_input_is_refused_in_words(change: dict[str, Any], fault: str) -> None:
    known = maier_stein(1)
    good: dict[str, Any] = {
        "drift": known.dynamics.drift,
        "attractor": known.attractors[0],
        "hessian": np.diag([2.0, 2.0]),
        "box": known.domain,
        "shape": (64, 64),
        "diffusion": known.dynamics.diffusion,
    }
    with pytest.raises(ValueError, match=fault):
        mesh_quasipotential(**(good | change))


def test_a_field_that_is_not_finite_is_refused_in_words() -> None:
    known = linear_system(2)
    root: Callable[[np.ndarray], np.ndarray] = np.sqrt

    def drift(x: np.ndarray) -> np.ndarray:
        with np.errstate(invalid="ignore"):
            return known.dynamics.drift(x) * root(1.5 - x[:, :1])

    # f is multiplied by a scalar, whose value at A enters M as time does: not at all but for D.
    with pytest.raises(NumericalFailure, match="not finite everywhere"):
        mesh_quasipotential(
            drift,
            np.zeros(2),
            hessian=hessian_at(known.dynamics, np.zeros(2)),
            box=known.domain,
            shape=(40, 40),
            diffusion=Diffusion(known.diffusion * np.sqrt(1.5)),
        )
