"""Angles: cards, wells modulo a period, hops over either side, mean velocity and effective diffusion."""

from __future__ import annotations

import numpy as np
import pytest
import sympy
from scipy import special
from scipy.integrate import quad

from siq import (
    Dynamics,
    InputError,
    Landscape,
    NoLandscape,
    PipelineSettings,
    Recordings,
    Rotation,
    load_system,
)
from siq.inference.library import IdentificationOptions, candidate_library
from siq.quasipotential.fokker_planck import CellProcess, Dissipation
from siq.quasipotential.landscape_files import landscape_data, landscape_from_data
from siq.systems.phase_portrait import phase_portrait

PHI, X, V = sympy.symbols("phi x v", real=True)
TURN = (0.0, 2 * np.pi)


def washboard(
    tilt: float, *, domain: tuple[float, float] = TURN, noise: sympy.Expr | None = None
) -> Dynamics:
    rows = None if noise is None else [[noise]]
    force = sympy.Float(tilt) - sympy.sin(PHI)
    return Dynamics.of([PHI], [force], diffusion=rows, domain=[domain], periodic=["phi"])


@pytest.fixture(scope="module")
def tilted() -> Landscape:
    return Landscape.from_equations(washboard(0.5, domain=(-np.pi, np.pi)))


def test_a_well_is_found_once_and_left_over_either_side(tilted: Landscape) -> None:
    assert len(tilted.attractors) == 1
    assert tilted.attractors[0].position == pytest.approx([np.arcsin(0.5)])
    assert tilted.basins == pytest.approx([1.0])
    barriers = tilted.barriers().set_index("turns_phi").barrier
    along = 2 * (np.sqrt(3) - np.pi / 3)  # of U = 2V, V = -φ/2 - cos φ, up to the next top
    assert barriers[1] == pytest.approx(along, rel=1e-7)
    assert barriers[-1] == pytest.approx(along + 2 * np.pi, rel=1e-7)
    assert tilted.certificate is not None and tilted.certificate.certified


def test_times_of_hops_follow_from_the_exact_velocity(tilted: Landscape) -> None:
    # Rates of hops forwards and backwards make v = 2π (r₊ - r₋), D = 2π² (r₊ + r₋).
    noise = 0.12
    times = tilted.escape_times(noise=noise).set_index("turns_phi").mean_time
    rotation = tilted.rotation(noise=noise)
    assert 2 * np.pi * (1 / times[1] - 1 / times[-1]) == pytest.approx(rotation.velocity, rel=0.01)
    assert 2 * np.pi**2 * (1 / times[1] + 1 / times[-1]) == pytest.approx(rotation.diffusion, rel=0.01)


def test_times_are_checked_by_a_simulation_that_counts_turns(tilted: Landscape) -> None:
    row = tilted.verify_times(noise=0.35).iloc[0]
    assert row.lower < row.operator < row.upper
    assert 2 * np.pi / row.operator == pytest.approx(tilted.rotation(noise=0.35).velocity, rel=0.05)


def test_formulas_hold_a_turn_on(tilted: Landscape) -> None:
    x = np.linspace(0.0, 1.2, 7)[:, None]
    exact = 2 * (-x / 2 - np.cos(x))[:, 0] - 2 * (-np.pi / 12 - np.cos(np.pi / 6))
    for turns in (-3, 0, 2):
        assert tilted.quasipotential(x + turns * 2 * np.pi) == pytest.approx(exact, abs=1e-4)


def test_a_landscape_of_angles_is_read_as_it_was_written(tilted: Landscape) -> None:
    again = landscape_from_data(landscape_data(tilted), tilted.dynamics)
    assert (
        [way.turns for way in again.transitions] == [way.turns for way in tilted.transitions] == [(-1,), (1,)]
    )
    assert again.barriers().equals(tilted.barriers())


def test_it_does_not_matter_where_a_period_begins() -> None:
    whole = phase_portrait(washboard(0.0, domain=TURN))  # the well lies on both ends of the domain
    moved = phase_portrait(washboard(0.0, domain=(-2.0, 2 * np.pi - 2)))
    for portrait in (whole, moved):
        assert [one.position[0] for one in portrait.attractors] == pytest.approx([0.0])
        assert portrait.shares == pytest.approx([1.0], abs=0.01)
        assert portrait.unsettled == 0


def test_two_wells_of_a_period_are_two() -> None:
    force = -sympy.sin(PHI) / 4 - sympy.sin(2 * PHI)
    landscape = Landscape.from_equations(Dynamics.of([PHI], [force], domain=[TURN], periodic=["phi"]))
    table = landscape.barriers()
    assert len(landscape.attractors) == 2
    assert landscape.heights == pytest.approx([0.0, 1.0])  # U = -½ cos φ - cos 2φ
    top = np.arccos(-1 / 8)
    exact = (-0.5 * np.cos(top) - np.cos(2 * top)) + 1.5
    out = table[table.start == 0].barrier
    assert out.tolist() == pytest.approx([exact, exact])
    assert table[["start", "end", "turns_phi"]].to_numpy().tolist() == [
        [0, 1, -1],
        [0, 1, 0],
        [1, 0, 0],
        [1, 0, 1],
    ]


def exact_rotation(tilt: float, noise: float) -> tuple[float, float]:
    """Stratonovich's and Reimann's integrals of f = F - sin φ, as nested quadrature."""
    spread = noise / 2

    def height(x: float) -> float:
        return -tilt * x - np.cos(x)

    def one_way(x: float, sign: int) -> float:
        inner = lambda y: np.exp(sign * (height(x) - height(x - sign * y)) / spread)  # noqa: E731
        return quad(inner, 0, 2 * np.pi, epsabs=0, epsrel=1e-11)[0] / spread

    mean = quad(lambda x: one_way(x, 1), *TURN, epsrel=1e-10)[0] / (2 * np.pi)
    square = quad(lambda x: one_way(x, 1) ** 2 * one_way(x, -1), *TURN, epsrel=1e-10)[0] / (2 * np.pi)
    return (1 - np.exp(-2 * np.pi * tilt / spread)) / mean, spread * square / mean**3


@pytest.mark.parametrize(("tilt", "noise"), [(0.5, 1.0), (0.9, 0.2), (1.3, 0.3)])
def test_velocity_and_diffusion_are_those_of_nested_quadrature(tilt: float, noise: float) -> None:
    found = Rotation.of(washboard(tilt), noise)
    assert (found.velocity, found.diffusion) == pytest.approx(exact_rotation(tilt, noise), rel=1e-8)
    back = Rotation.of(washboard(-tilt), noise)
    assert (-back.velocity, back.diffusion) == pytest.approx((found.velocity, found.diffusion))


def test_without_a_tilt_diffusion_is_that_of_lifson_and_jackson() -> None:
    found = Rotation.of(washboard(0.0), 0.3)
    assert found.velocity == 0
    assert found.diffusion == pytest.approx(0.15 / special.i0(1 / 0.15) ** 2, rel=1e-12)


def test_a_free_angle_turns_at_its_torque() -> None:
    free = Dynamics.of([PHI], [sympy.Float(0.7)], domain=[TURN], periodic=["phi"])
    found = Rotation.of(free, 0.4)
    assert (found.velocity, found.diffusion) == pytest.approx((0.7, 0.2), rel=1e-12)
    cells = CellProcess(free, 0.4, free.box)
    assert cells.density == pytest.approx(1 / len(cells.density))


@pytest.mark.parametrize("noise", [None, 1 + sympy.cos(PHI) / 2])
def test_cells_that_close_on_themselves_agree(noise: sympy.Expr | None) -> None:
    system = washboard(0.5, noise=noise)
    found = Rotation.of(system, 1.0)
    assert CellProcess(system, 1.0, system.box).rotation(0) == pytest.approx(
        (found.velocity, found.diffusion), rel=1e-5
    )


def test_a_state_that_is_coupled_to_nothing_changes_nothing() -> None:
    force = [sympy.Float(0.5) - sympy.sin(PHI), -X]
    system = Dynamics.of([PHI, X], force, domain=[TURN, (-4, 4)], periodic=["phi"])
    found, alone = Rotation.of(system, 1.0), Rotation.of(washboard(0.5), 1.0)
    assert found.velocity == pytest.approx(alone.velocity, rel=1e-5)
    assert found.diffusion == pytest.approx(alone.diffusion, abs=3 * found.diffusion_error)
    assert found.diffusion_error < 1e-4 * found.diffusion


def test_dissipation_is_the_work_of_the_torque() -> None:
    system, noise = washboard(0.5), 0.5
    work = 2 / noise * 0.5 * Rotation.of(system, noise).velocity
    assert Dissipation.of(system, noise, system.box).value == pytest.approx(work, rel=1e-5)
    assert Dissipation.of(washboard(0.0), noise, system.box).value == pytest.approx(0.0, abs=1e-12)


def test_committors_go_around() -> None:
    force = -sympy.sin(2 * PHI)  # wells at 0 and π
    landscape = Landscape.from_equations(
        Dynamics.of([PHI], [force], domain=[(-1.0, 2 * np.pi - 1)], periodic=["phi"])
    )
    flow = landscape.committor(0, 1, noise=0.6)
    value = flow.process.interpolated(flow.committor)
    for x in (0.5, 1.2, 1.5):  # as likely on either side, also beyond the end of the domain
        assert value(np.array([[x]]))[0] == pytest.approx(value(np.array([[-x]]))[0], abs=1e-3)
        assert value(np.array([[x]]))[0] == pytest.approx(value(np.array([[2 * np.pi - x]]))[0], abs=1e-3)
    assert value(np.array([[np.pi / 2]]))[0] == pytest.approx(0.5, abs=1e-3)


def test_an_angle_that_runs_has_a_velocity_and_no_landscape() -> None:
    with pytest.raises(NoLandscape, match="turns on and on"):
        Landscape.from_equations(washboard(1.5))
    assert Rotation.of(washboard(1.5), 0.02).velocity == pytest.approx(np.sqrt(1.5**2 - 1), rel=1e-3)
    with pytest.raises(ValueError, match="no state is periodic"):
        Rotation.of(Dynamics.of([X], [-X], domain=[(-1, 1)]), 0.1)


def test_a_pendulum_leaves_over_either_side_at_the_heights_of_its_energy() -> None:
    swing = [V, sympy.Float("0.2") - sympy.sin(PHI) - V]
    pendulum = Dynamics.of(
        [PHI, V], swing, domain=[TURN, (-4, 4)], diffusion=[[0, 0], [0, 2]], periodic=["phi"]
    )  # fmt: skip
    barriers = Landscape.from_equations(pendulum).barriers().set_index("turns_phi").barrier
    rest = np.arcsin(0.2)  # U is the energy, D being twice the friction
    tops = {1: np.pi - rest, -1: -np.pi - rest}
    for turns, top in tops.items():
        exact = (-0.2 * top - np.cos(top)) - (-0.2 * rest - np.cos(rest))
        assert barriers[turns] == pytest.approx(exact, rel=1e-5)


CARD = """
name: ring
states:
  phi: {{unit: rad, domain: [{domain}], periodic: true}}
equations:
  phi: "{force}"
"""


def test_a_card_declares_an_angle(tmp_path) -> None:
    card = tmp_path / "ring.yaml"
    card.write_text(CARD.format(domain="-pi, pi", force="1/2 - sin(3*phi)"))
    system = load_system(card)
    assert system.periodic == ("phi",)
    assert system.periods == pytest.approx([2 * np.pi])
    card.write_text(system.to_card())
    assert load_system(card).periodic == ("phi",)
    card.write_text(CARD.format(domain="0, 3", force="1/2 - sin(phi)"))
    with pytest.raises(InputError, match=r"the equation of 'phi' is not the same a period of 'phi' on"):
        load_system(card)
    card.write_text(CARD.format(domain="0, pi", force="1/2").replace("domain: [0, pi], ", ""))
    with pytest.raises(InputError, match="the period is not known"):
        load_system(card)


def test_functions_of_an_angle_are_its_harmonics() -> None:
    library = candidate_library(["phi"], degree=2, angles={"phi": TURN})
    assert library.names == ("1", "sin(phi)", "cos(phi)", "sin(2*phi)", "cos(2*phi)")
    whole = candidate_library(["phi", "v"], degree=2, angles={"phi": TURN})
    assert "v*sin(phi)" in whole.names and "v**2" in whole.names and "phi" not in whole.names
    phase = candidate_library(["q"], degree=1, angles={"q": (0, 1)})
    assert phase.evaluate(np.array([[0.25]]))[0] == pytest.approx([1.0, 1.0, 0.0])


def recorded(tilt: float, noise: float, *, seed: int, wrapped: bool = True) -> Recordings:
    """Twenty records of 120 units of time, by Euler's method with 100 steps a unit, every tenth kept."""
    generator = np.random.default_rng(seed)
    x, kept = np.full(20, 0.5), []
    for step in range(12_000):
        if step % 10 == 0:
            kept.append(x)
        x = x + 0.01 * (tilt - np.sin(x)) + np.sqrt(noise * 0.01) * generator.standard_normal(20)
    values = np.array(kept).T
    values = (values + np.pi) % (2 * np.pi) - np.pi if wrapped else values
    return Recordings.from_arrays(0.1 * np.arange(len(kept)), values[:, :, None], names=["phi"])


@pytest.fixture(scope="module")
def records() -> Recordings:
    return recorded(0.5, 0.5, seed=3)


ANGLE = PipelineSettings(identification=IdentificationOptions(angles={"phi": ("-pi", "pi")}))


def test_a_wrapped_angle_is_refused_with_the_remedy(records: Recordings) -> None:
    with pytest.raises(NoLandscape, match=r"declare it, as 'identification: \{angles: \{phi: \[0"):
        Landscape.from_recordings(records)


@pytest.mark.slow
def test_records_of_an_angle_tell_torque_barriers_and_velocity(records: Recordings) -> None:
    landscape = Landscape.from_recordings(records, ANGLE)
    found = dict(
        zip(
            map(str, landscape.field_estimate.library.terms),
            landscape.field_estimate.coefficients[:, 0],
            strict=True,
        )
    )
    assert found["1"] == pytest.approx(0.5, abs=0.05)
    assert found["sin(phi)"] == pytest.approx(-1.0, abs=0.06)
    table = landscape.barriers().set_index("turns_phi")
    along = 2 * (np.sqrt(3) - np.pi / 3)
    for turns, exact in ((1, along), (-1, along + 2 * np.pi)):
        assert table.barrier[turns] == pytest.approx(exact, abs=3 * table.standard_error[turns])
    # What f says of the motion, what is counted, and what is true.
    true, made = Rotation.of(washboard(0.5), 0.5), landscape.rotation()
    counted = Rotation.counted(records.unwrapped({"phi": (-np.pi, np.pi)}), "phi")
    for one in (made, counted):
        assert one.velocity == pytest.approx(true.velocity, abs=3 * one.velocity_error)
        assert one.diffusion == pytest.approx(true.diffusion, abs=3 * one.diffusion_error)


def test_wrapping_loses_nothing(records: Recordings) -> None:
    whole = recorded(0.5, 0.5, seed=3, wrapped=False)
    again = records.unwrapped({"phi": (-np.pi, np.pi)})
    moved = again.values - whole.values
    assert np.abs(np.diff(moved[:, 0])[np.diff(again.recording) == 0]).max() < 1e-9
    assert whole.unwrapped({"phi": (-np.pi, np.pi)}).values is not whole.values
    assert (whole.unwrapped({"phi": (-np.pi, np.pi)}).values == whole.values).all()


def test_an_angle_that_is_sampled_too_rarely_is_refused() -> None:
    values = np.random.default_rng(0).uniform(0, 2 * np.pi, (2, 200, 1))
    coarse = Recordings.from_arrays(np.arange(200.0), values, names=["phi"])
    with pytest.raises(InputError, match="record it more often"):
        coarse.unwrapped({"phi": TURN})
    with pytest.raises(InputError, match="no column 'psi'"):
        coarse.unwrapped({"psi": TURN})


def test_counted_motion_is_that_of_the_formulas() -> None:
    whole = recorded(0.9, 0.4, seed=5, wrapped=False)
    true, found = Rotation.of(washboard(0.9), 0.4), Rotation.counted(whole, "phi")
    assert found.velocity == pytest.approx(true.velocity, abs=3 * found.velocity_error)
    assert found.diffusion == pytest.approx(true.diffusion, abs=3 * found.diffusion_error)
    with pytest.raises(ValueError, match="not recorded"):
        Rotation.counted(whole, "psi")
