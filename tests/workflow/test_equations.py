"""The landscape of given equations: exact families, known barriers, and that units do not matter."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import sympy
from known_systems import (
    KnownSystem,
    archetype,
    as_system,
    double_well,
    limit_cycle,
    linear_system,
    maier_stein,
    potential_values,
)
from scipy.integrate import quad

from siq.errors import InputError
from siq.quasipotential.landscape import Landscape, LandscapeOptions, NoLandscape
from siq.quasipotential.landscape_assembly import EquationSettings, landscape_from_equations
from siq.quasipotential.landscape_files import landscape_data
from siq.quasipotential.paths import minimum_action_path
from siq.report.summary import summarise
from siq.systems.cards import load_system
from siq.systems.cycles import hessians_along
from siq.systems.dynamics import Dynamics
from siq.validation.mesh import mesh_quasipotential
from workflow.rows import landscape_rows

X, Y, Z = sympy.symbols("x y z", real=True)
SYSTEMS = Path(__file__).parents[2] / "config" / "systems"
CARD = SYSTEMS / "consumer-resource.yaml"
TOGGLE = Dynamics.of((X, Y), (3 / (1 + Y**2) - X, 3 / (1 + X**2) - Y), domain=[(0, 4), (0, 4)])


def turned(dimension: int) -> KnownSystem:
    """``f = (A - 1)∇Φ`` with a Φ of two wells that couples all states, and A constant and antisymmetric."""
    symbols = sympy.symbols(f"x:{dimension}", real=True)
    first, others = symbols[0], symbols[1:]
    potential = (first**2 - 1) ** 2 / 4 + sum(
        ((one - first / 3) ** 2 * (1 + first**2) / 2 for one in others), 0
    )
    turning = sympy.zeros(dimension)
    for i in range(dimension):
        for j in range(i):
            turning[i, j], turning[j, i] = sympy.Rational(1 + i, 2), -sympy.Rational(1 + i, 2)
    gradient = sympy.Matrix([potential.diff(one) for one in symbols])
    equations = tuple((turning - sympy.eye(dimension)) * gradient)
    attractors = np.outer([-1.0, 1.0], [1.0, *[1 / 3] * len(others)])
    domain = np.array([[-1.8, 1.8]] * dimension)
    return KnownSystem(
        Dynamics.of(symbols, equations, domain=domain), sympy.expand(potential), attractors, domain
    )


def worst_error(known: KnownSystem, landscape: Landscape) -> float:
    """Of V in all wells, over the depth."""
    errors = []
    for well in landscape.wells:
        assert well is not None
        exact = potential_values(known, well.points) - potential_values(known, well.attractor[None])
        errors.append(float(np.abs(well.values(well.points) - exact).max() / well.level))
    return max(errors)


@pytest.mark.parametrize(
    "known",
    [
        pytest.param(linear_system(2), id="linear"),
        pytest.param(double_well(1), id="one state"),
        pytest.param(double_well(2), id="gradient", marks=pytest.mark.slow),
        pytest.param(turned(2), id="turned", marks=pytest.mark.slow),
        pytest.param(turned(3), id="turned in three", marks=pytest.mark.slow),
        pytest.param(archetype(3), id="archetype", marks=pytest.mark.slow),
    ],
)
def test_v_of_exact_families_is_found_to_rounding_and_certified(known: KnownSystem) -> None:
    landscape = Landscape.from_equations(as_system(known))
    assert len(landscape.attractors) == len(known.attractors)
    assert worst_error(known, landscape) < 1e-9
    assert landscape.certificate is not None and landscape.certificate.certified
    assert set(landscape.certificate.tests) == {"hamilton_jacobi", "branch", "characteristics", "error"}
    for way in landscape.transitions:
        start = known.attractors[way.start] if len(known.attractors) else np.zeros(1)
        ends = np.stack([way.saddle.position, landscape.attractors[way.start].position, start])
        height = potential_values(known, ends)
        assert way.barrier == pytest.approx(2 * (height[0] - height[1]), rel=1e-5)


@pytest.mark.slow
def test_v_is_exact_in_four_states() -> None:
    known = turned(4)
    assert worst_error(known, Landscape.from_equations(as_system(known))) < 1e-8


def test_maier_stein_without_a_caustic_has_its_barrier_and_its_v() -> None:
    landscape = Landscape.from_equations(SYSTEMS / "maier-stein.yaml")
    assert landscape.barriers()["barrier"].to_numpy() == pytest.approx([0.5, 0.5], rel=1e-6)
    assert worst_error(maier_stein(1), landscape) < 1e-9
    assert landscape.basins == pytest.approx([0.5, 0.5], abs=0.02)


@pytest.mark.slow
@pytest.mark.parametrize(("beta", "barrier"), [(5, 0.4831), (10, 0.3400)])
def test_behind_a_caustic_the_path_tells_the_barrier_and_the_caustic_is_named(
    beta: int, barrier: float
) -> None:
    landscape = Landscape.from_equations(SYSTEMS / f"maier-stein-{beta}.yaml")
    assert landscape.barriers()["barrier"].to_numpy() == pytest.approx([barrier, barrier], abs=1e-4)
    assert any("cross at a caustic" in note for note in landscape.notes)
    certificate = landscape.certificate
    assert certificate is not None and (not certificate.certified or certificate.error > 0.005)


@pytest.mark.slow
def test_a_rational_f_has_a_certified_v_and_its_wells_are_alike_where_they_have_to_be() -> None:
    landscape = Landscape.from_equations(TOGGLE)
    assert landscape.certificate is not None and landscape.certificate.certified
    assert landscape.certificate.error < 0.001
    one, two = landscape.barriers()["barrier"]
    assert one == pytest.approx(two, rel=1e-5)
    assert np.abs(landscape.heights).max() < 1e-5 * one
    x = np.array([[0.5, 2.4], [0.35, 2.5], [0.8, 1.9]])
    assert landscape.quasipotential(x) == pytest.approx(landscape.quasipotential(x[:, ::-1]), rel=2e-3)


@pytest.mark.slow
def test_the_consumer_and_its_resource_agree_with_a_mesh() -> None:
    """Both barriers, and U in the well that is a focus, against a method that shares nothing but f."""
    landscape = Landscape.from_equations(CARD)
    assert landscape.certificate is not None and landscape.certificate.certified
    system = load_system(CARD)
    boxes = [[(0.8, 4.6), (2.2, 4.4)], [(4.0, 5.6), (3.9, 4.2)]]
    for way, box in zip(landscape.transitions, boxes, strict=True):
        start = landscape.attractors[way.start].position
        well = landscape.potential(way.start)
        mesh = mesh_quasipotential(
            system.drift, start, hessian=well.hessians(start[None])[0], box=np.array(box, dtype=float),
            shape=(400, 400), diffusion=system.diffusion, level=1.02 * well.level, stop_at_boundary=False,
        )  # fmt: skip
        height = 2 * float(mesh.evaluate(way.saddle.position[None])[0])
        assert height == pytest.approx(way.barrier, rel=0.03)
        x = well.points[well.believed(well.points) & (well.values(well.points) < 0.9 * well.level)]
        on_mesh = mesh.evaluate(x)
        known = np.isfinite(on_mesh)
        difference = np.linalg.norm(well.values(x)[known] - on_mesh[known])
        assert difference < 0.04 * np.linalg.norm(on_mesh[known])


@pytest.mark.slow
@pytest.mark.parametrize(("size", "rate"), [((1e-3, 40.0), 1.0), ((1.0, 1.0), 1e-4)])
def test_units_of_states_and_of_time_change_nothing(size: tuple[float, float], rate: float) -> None:
    known = double_well(2)
    scaled = [symbol / s for symbol, s in zip(known.dynamics.symbols, size, strict=True)]
    inserted = dict(zip(known.dynamics.symbols, scaled, strict=True))
    equations = [
        rate * s * f.subs(inserted, simultaneous=True)
        for f, s in zip(known.dynamics.formulas, size, strict=True)
    ]
    factors = np.array(size)
    system = Dynamics.of(
        known.dynamics.symbols, equations, diffusion=rate * known.diffusion * np.outer(factors, factors),
        domain=known.domain * factors[:, None],
    )  # fmt: skip
    plain, other = (Landscape.from_equations(one) for one in (as_system(known), system))
    assert other.certificate is not None and other.certificate.certified
    assert other.barriers()["barrier"].to_numpy() == pytest.approx(plain.barriers()["barrier"], rel=1e-4)
    times = [
        np.array([way.rate.prefactor for way in each.transitions if way.rate]) for each in (plain, other)
    ]
    assert times[1] * rate == pytest.approx(times[0], rel=0.01)


@pytest.mark.slow
def test_rotation_of_the_states_changes_no_barrier() -> None:
    known, angle = double_well(2), 0.7
    x, y = known.dynamics.symbols
    c, s = np.cos(angle), np.sin(angle)
    inserted = {x: c * x - s * y, y: s * x + c * y}
    one, two = (f.subs(inserted, simultaneous=True) for f in known.dynamics.formulas)
    turn = np.array([[c, s], [-s, c]])
    system = Dynamics.of(
        (x, y), (c * one + s * two, -s * one + c * two),
        diffusion=turn @ known.diffusion @ turn.T, domain=[(-2.2, 2.2), (-2.2, 2.2)],
    )  # fmt: skip
    landscape = Landscape.from_equations(system)
    assert landscape.certificate is not None and landscape.certificate.certified
    plain = sorted(Landscape.from_equations(as_system(known)).barriers()["barrier"])
    assert sorted(landscape.barriers()["barrier"]) == pytest.approx(plain, rel=1e-4)


def test_a_way_out_of_the_domain_has_a_barrier() -> None:
    """One well of two: the pass lies in the domain, and what is behind it does not."""
    system = Dynamics.of((X, Y), (X - X**3, -Y), domain=[(-2, 0.3), (-1, 1)])
    landscape = Landscape.from_equations(system)
    (way,) = landscape.transitions
    assert way.end is None and way.barrier == pytest.approx(0.5, rel=1e-5)
    assert way.rate is not None and landscape.wells[0] is not None


@pytest.mark.slow
def test_escape_times_follow_where_the_noise_is_known() -> None:
    options = LandscapeOptions(noise_intensities=(0.05,))
    landscape = Landscape.from_equations(as_system(double_well(2)), EquationSettings(landscape=options))
    assert np.isfinite(landscape.dwell_times()["mean_time"]).all()
    assert "The equations have two stable states" in landscape.report()
    assert "recorded" not in landscape.report()


def test_a_limit_cycle_is_an_attractor_without_a_formula() -> None:
    landscape = Landscape.from_equations(as_system(limit_cycle()))
    (cycle,) = landscape.cycles
    assert cycle.period == pytest.approx(np.pi, rel=1e-9)
    assert cycle.multipliers == pytest.approx(np.exp(-2 * np.pi), rel=1e-7)
    assert landscape.transitions == () and landscape.wells == (None,)
    assert "no way out of it within the domain" in landscape.report()
    # V = (r² - 1)²/4 has the curvature 2 across the circle.
    across = cycle.points / np.linalg.norm(cycle.points, axis=1, keepdims=True)
    curvature = np.einsum("ni,nij,nj->n", across, hessians_along(landscape.dynamics, cycle), across)
    np.testing.assert_allclose(curvature, 2, rtol=1e-7)
    rows = landscape_rows(0, landscape).set_index("kind")
    assert rows.loc["cycle", "item"] == "A1" and rows.loc["cycle", "note"].startswith("period 3.1415927")
    (stored,) = landscape_data(landscape)["wells"]
    assert stored["cycle"]["period"] == cycle.period and len(stored["cycle"]["points"]) == len(cycle.points)
    (line,) = summarise(landscape).cycles
    np.testing.assert_allclose(np.linalg.norm(line, axis=1), 1, rtol=1e-6)


def test_systems_without_a_landscape_say_why() -> None:
    chaos = Dynamics.of((X, Y), (Y, X - X**3), domain=[(0.2, 0.6), (0.5, 0.9)])
    with pytest.raises(NoLandscape, match="no stable equilibrium"):
        Landscape.from_equations(chaos)
    with pytest.raises(InputError, match="no domain"):
        Landscape.from_equations(replace(TOGGLE, domain=None))
    with pytest.raises(InputError, match="divides by zero"):
        Landscape.from_equations(Dynamics.of((X, Y), (1 / X, -Y), domain=[(-1, 1), (-1, 1)]))
    apart = Dynamics.of((X, Y), (X - X**3, X - Y), diffusion=np.diag([0.0, 1.0]), domain=[(-2, 2)] * 2)
    with pytest.raises(InputError, match=r"does not reach x, neither directly .* let it act on x"):
        Landscape.from_equations(apart)
    alike = Dynamics.of(
        (X, Y, Z), (Z - X, Z - Y, -Z), diffusion=np.diag([0.0, 0.0, 1.0]), domain=[(-1, 1)] * 3
    )
    with pytest.raises(NoLandscape, match="does not reach x and y about the equilibrium"):
        Landscape.from_equations(alike)


def test_a_damped_particle_has_its_energy_as_a_formula() -> None:
    """Noise on the velocity alone: V = (γ/D)(v²/2 + Φ), with one well, which is left over its only saddle."""
    friction, noise = 1.5, 0.5
    system = Dynamics.of(
        (X, Y), (Y, X**2 - X - friction * Y), diffusion=np.diag([0.0, noise]), domain=[(-1, 1.8), (-1.2, 1.2)]
    )
    landscape = Landscape.from_equations(system)
    assert landscape.certificate is not None and landscape.certificate.certified
    assert landscape.certificate.error < 1e-6
    (way,) = landscape.transitions
    assert way.end is None and way.barrier == pytest.approx(2 * friction / noise / 6, rel=1e-6)
    well = landscape.potential()
    x = well.inside()
    energy = friction / noise * (x[:, 1] ** 2 / 2 + x[:, 0] ** 2 / 2 - x[:, 0] ** 3 / 3)
    np.testing.assert_allclose(well.values(x), energy, atol=1e-10)
    # Kramers, with both frequencies 1: half of what reaches the saddle in the mean comes back.
    across = np.sqrt(friction**2 / 4 + 1) - friction / 2
    mean = landscape.dwell_times(noise=0.1)["mean_time"][0]
    assert mean == pytest.approx(2 * np.pi / across * np.exp(way.barrier / 0.1), rel=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("case", ["friction", "coloured", "state noise"])
def test_formulas_hold_where_noise_acts_on_one_state_and_nothing_is_conserved(case: str) -> None:
    """Characteristics certify them, and they agree with paths solved for by themselves."""
    cases = {
        "friction": ((Y, X - X**3 + 0.1 - (0.5 + X**2) * Y), [[0, 0], [0, 1]]),
        "coloured": ((X - X**3 + 0.1 + Y, -2 * Y), [[0, 0], [0, 4]]),
        "state noise": ((Y, X - X**3 + 0.1 - Y), [[0, 0], [0, 1 + X**2 / 2]]),
    }
    equations, noise = cases[case]
    system = Dynamics.of((X, Y), equations, diffusion=noise, domain=[(-2, 2), (-2, 2)])
    landscape = Landscape.from_equations(system)
    assert landscape.certificate is not None and landscape.certificate.certified
    for way in landscape.transitions:
        assert way.path is not None and way.path.converged
        well = landscape.potential(way.start)
        points = well.inside()[:: len(well.inside()) // 5]
        for end in points[np.abs(points - well.attractor).max(axis=1) > 0.1]:
            path = minimum_action_path(system, well.attractor, end)
            error = max(landscape.certificate.error, 1e-5) * well.level
            assert well.values(end[None])[0] == pytest.approx(path.action / 2, abs=2 * error)


@pytest.mark.parametrize("name", ["schloegl", "budworm", "stommel"])
def test_barriers_of_textbook_systems_of_one_state_are_those_of_a_quadrature(name: str) -> None:
    """``ΔU = -∫ 2f/D dx`` from the attractor to the threshold, with the D(x) of chemistry in one of them."""
    system = load_system(SYSTEMS / f"{name}.yaml")
    landscape = landscape_from_equations(system, EquationSettings(), formulas=False)
    assert len(landscape.attractors) == 2

    def slope(x: float) -> float:
        at = np.array([[x]])
        return float(-2 * system.drift(at)[0, 0] / system.diffusion.at(at)[0, 0, 0])

    for way in landscape.transitions:
        start = landscape.attractors[way.start].position[0]
        exact, _ = quad(slope, start, way.saddle.position[0], epsabs=1e-13)
        assert way.barrier == pytest.approx(exact, rel=1e-7)
