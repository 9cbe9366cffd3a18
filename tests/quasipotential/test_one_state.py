"""One state: the top between two wells is the saddle, and everything about it is known by quadrature."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import sympy
from known_escapes import line_exit_time
from known_systems import KnownSystem, double_well, exact_field, portrait_of, potential_values
from scipy.integrate import solve_ivp

from siq.data.recordings import Recordings
from siq.quasipotential.certificate import references_about
from siq.quasipotential.invariant_density import SampledPotential, marginal_density
from siq.quasipotential.landscape import Landscape
from siq.quasipotential.landscape_assembly import find_landscape
from siq.quasipotential.landscape_comparison import reference_landscape
from siq.quasipotential.refinement import RefinementOptions
from siq.systems.dynamics import Dynamics
from siq.systems.equilibria import find_equilibria
from siq.systems.phase_portrait import phase_portrait

X = sympy.Symbol("x", real=True)
ROOTS = (-1.0, 0.3, 1.5)  # of f: a well, the saddle, a well


def three_roots() -> KnownSystem:
    """``f = -(x + 1)(x - 3/10)(x - 3/2)``: of one state every f is a gradient."""
    f = -(X + 1) * (X - sympy.Rational(3, 10)) * (X - sympy.Rational(3, 2))
    potential = sympy.integrate(sympy.expand(-f), X)
    return KnownSystem(Dynamics.of((X,), (f,)), potential, np.array([[-1.0], [1.5]]), np.array([[-1.8, 2.1]]))


def recorded(known: KnownSystem) -> Recordings:
    """Forty trajectories over the domain."""
    t = np.linspace(0, 3, 61)
    starts = np.random.default_rng(0).uniform(*known.domain[0], 40)
    x = solve_ivp(
        lambda _, x: known.dynamics.drift(x[:, None])[:, 0], (0, 3), starts, t_eval=t, rtol=1e-11, atol=1e-13
    ).y
    return Recordings.from_arrays(t, x[:, :, None], names=["x"])


@functools.cache
def from_recordings() -> Landscape:
    return Landscape.from_recordings(recorded(three_roots()))


def heights(known: KnownSystem) -> np.ndarray:
    """Exact U at the three roots."""
    return 2 * potential_values(known, np.array(ROOTS)[:, None])


def test_the_top_between_two_wells_is_the_saddle() -> None:
    known = three_roots()
    found = find_equilibria(known.dynamics, np.linspace(-1.8, 2.1, 50)[:, None])
    assert [one.kind for one in found] == ["attractor", "saddle", "attractor"]
    np.testing.assert_allclose([one.position[0] for one in found], ROOTS, atol=1e-9)


def test_recordings_of_one_state_give_barriers() -> None:
    left, top, right = heights(three_roots())
    barriers = from_recordings().barriers()
    assert list(barriers["start"]) == [0, 1] and list(barriers["end"]) == [1, 0]
    np.testing.assert_allclose(barriers["barrier"], [top - left, top - right], rtol=1e-7)


@pytest.mark.slow
def test_a_file_and_a_table_do_as_well(tmp_path: Path) -> None:
    file = tmp_path / "recorded.csv"
    rows = recorded(three_roots())
    label = np.array(rows.labels)[rows.recording]
    table = pd.DataFrame({"recording": label, "t": rows.t, "x": rows.values[:, 0]})
    table.to_csv(file, index=False)
    known = from_recordings().barriers()["barrier"]
    for source in (file, str(file), table):
        np.testing.assert_allclose(Landscape.from_recordings(source).barriers()["barrier"], known, rtol=1e-9)


def test_equal_wells_have_a_barrier_of_a_half() -> None:
    dynamics = Dynamics.of((X,), (X - X**3,))
    known = KnownSystem(dynamics, X**4 / 4 - X**2 / 2, np.array([[-1.0], [1.0]]), np.array([[-1.6, 1.6]]))
    barriers = find_landscape(
        exact_field(known, 3), portrait_of(known), options=RefinementOptions(degrees=(4,))
    ).barriers()
    np.testing.assert_allclose(barriers["barrier"], [0.5, 0.5], rtol=1e-9)


def test_u_is_known_and_exact_from_well_to_well() -> None:
    known, landscape = three_roots(), from_recordings()
    x = np.linspace(-1.6, 1.9, 141)[:, None]
    u = landscape.quasipotential(x)
    exact = 2 * potential_values(known, x) - heights(known)[0]
    low = exact < 1.1 * landscape.barriers()["barrier"].min()
    np.testing.assert_allclose(u[low], exact[low], atol=1e-7)
    beyond = np.array([[-2.0], [2.3]])  # no recording was there
    assert np.isnan(landscape.quasipotential(beyond)).all()


def test_a_well_ends_at_the_saddle() -> None:
    for well in from_recordings().wells:
        assert well is not None and well.saddle is not None
        inside, outside = (
            well.attractor + 0.99 * (well.saddle - well.attractor),
            2 * well.saddle - 0.9 * well.attractor,
        )
        assert list(well.believed(np.stack([well.saddle, inside, outside]))) == [True, True, False]


@pytest.mark.parametrize("diffusion", [1.0, 2.5])
def test_times_are_those_of_kramers(diffusion: float) -> None:
    known = double_well(1)
    # V = -∫f/D: more noise makes a lower landscape of the same f.
    known = known.with_diffusion(diffusion * np.eye(1))._replace(potential=known.potential / diffusion)
    landscape = find_landscape(
        exact_field(known, 3), portrait_of(known, share=0.8), options=RefinementOptions(degrees=(4,))
    )
    at = np.sort(np.roots([1, 0, -1, 0.1]).real)
    slopes = np.abs(known.dynamics.jacobian(at[:, None])[:, 0, 0])
    rates = [way.rate for way in landscape.transitions]
    expected = 2 * np.pi / np.sqrt(slopes[1] * slopes[[0, 2]])
    np.testing.assert_allclose([rate.prefactor for rate in rates], expected, rtol=1e-4)
    noise = rates[0].barrier / 25
    exact = line_exit_time(known, noise)  # O(ε/ΔU) above the law
    assert landscape.escape_times(noise=noise)["mean_time"][0] == pytest.approx(exact, rel=0.04)


def test_an_equilibrium_without_linear_part_is_degenerate() -> None:
    points = np.linspace(-1, 1, 50)[:, None]
    found = find_equilibria(Dynamics.of((X,), (-(X**3),)), points)
    assert [one.kind for one in found] == ["degenerate"]
    # Slow is not degenerate: the rate is told by the recorded region, whatever the unit of time.
    slow = find_equilibria(Dynamics.of((X,), (-X / 10**9,)), points)
    assert [one.kind for one in slow] == ["attractor"]


def test_characteristics_are_the_reference_of_one_state() -> None:
    known = three_roots()
    reference = reference_landscape(
        known.dynamics, portrait_of(known), box=known.domain, reach=1.2, generator=np.random.default_rng(0)
    )
    left, top, right = heights(known)
    np.testing.assert_allclose(reference.barriers, [top - left, top - right], rtol=1e-4)
    np.testing.assert_allclose(reference.heights, [0, right - left], atol=1e-4)
    values, exact = reference.values, 2 * potential_values(known, reference.points) - left
    low = exact < top - left
    np.testing.assert_allclose(values[low], exact[low], atol=1e-4)


def test_the_level_of_characteristics_is_no_higher_than_they_come_within_the_domain() -> None:
    """Noise is weak at the stable state and strong elsewhere, so that its curvature promises a high level."""
    noise = sympy.Rational(1, 50) + X**2
    system = Dynamics.of((X,), (-X,), diffusion=[[noise]])
    (reference,) = references_about(system, phase_portrait(system, np.linspace(-2, 2, 400)[:, None]))
    highest = sympy.log(noise.subs(X, 2) / noise.subs(X, 0)) / 2
    assert not reference.fault
    assert reference.level < 1.2 * float(highest)


def test_the_density_of_one_state_is_exact_from_either_formula() -> None:
    known, landscape, noise = three_roots(), from_recordings(), 0.2
    potential = landscape.global_quasipotential
    assert potential is not None
    fine, coarse = (SampledPotential.of(potential, known.domain, cells=cells) for cells in (4000, 2000))
    density = fine.density(coarse, coarse.lowest_possible(known.dynamics), intensity=noise)
    shift = heights(known)[0]
    exact = 2 * known.potential - shift
    assert density.unknown < 2e-3
    one, other = density.marginal(), marginal_density(exact, (X,), intensity=noise, box=known.domain)
    assert density.normalisation == pytest.approx(other.normalisation, rel=1e-3)
    assert one.plane == other.plane == (0,) and one.values.shape == (1, 4000)
    at = np.isfinite(one.values[0])
    np.testing.assert_allclose(one.values[0][at], np.interp(one.x1, other.x1, other.values[0])[at], atol=5e-3)
    # Draws from the density itself differ from it by no more than draws do.
    draw = np.random.default_rng(0)
    start = density.starting_states(20_000, generator=draw)
    compared = density.compare(start[:, None, :])
    again = other.compare(start[:, None, :])
    assert compared.total_variation < 0.02 and again.total_variation < 0.02
    assert compared.histogram.shape == again.histogram.shape == (1, 40)
    assert (compared.histogram[0] * np.diff(compared.x1_edges)).sum() == pytest.approx(1)
