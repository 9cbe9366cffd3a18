from __future__ import annotations

import numpy as np
import pytest
import sympy
from known_escapes import compressible, exit_time, line_exit_time
from known_paths import path_of, resonator, transformed
from known_systems import KnownSystem, archetype, double_well

from siq.errors import NumericalFailure
from siq.quasipotential.rates import escape_rate
from siq.systems.dynamics import Dynamics
from siq.systems.escapes import Neighbourhood, _EscapeTimes, simulate_escapes


def escapes_of(
    known: KnownSystem,
    intensity: float,
    longest: float,
    *,
    which: int = 0,
    level: float = 0.1,
    seed: int = 0,
    **options: object,
) -> _EscapeTimes:
    target = Neighbourhood.about(known.dynamics, known.attractors[1 - which], level=level)
    return simulate_escapes(
        known.dynamics,
        known.attractors[which],
        [target],
        intensity=intensity,
        longest=longest,
        generator=np.random.default_rng(seed),
        **options,
    )


def agrees(found: _EscapeTimes, expected: float, *, deviations: float = 3.0) -> bool:
    return abs(found.mean - expected) < deviations * found.standard_error


def test_with_one_state_the_exact_mean_is_found() -> None:
    known = double_well(1)
    intensity = 0.3
    found = escapes_of(known, intensity, 40.0, level=0.02, walkers=1000)
    # The quadrature ends at the attractor itself, which is soon reached from its neighbourhood.
    assert agrees(found, line_exit_time(known, intensity), deviations=4.0)
    assert found.standard_error < 0.05 * found.mean
    assert found.censored > 50


@pytest.mark.parametrize("which", [0, 1])
def test_with_circulation_the_backward_equation_is_confirmed(which: int) -> None:
    known = compressible(0.5)
    exact = exit_time(known, 0.5, which=which, level=0.1, nodes=120)
    found = escapes_of(known, 0.5, 1.5 * exact, which=which, walkers=800)
    assert found.standard_error < 0.05 * found.mean
    assert agrees(found, exact)


@pytest.mark.slow
@pytest.mark.parametrize("which", [0, 1])
@pytest.mark.parametrize("rotation", [0.0, 2.0])
def test_higher_barriers_are_confirmed(which: int, rotation: float) -> None:
    known = compressible(0.5, rotation)
    exact = exit_time(known, 0.25, which=which, level=0.1, nodes=500)
    found = escapes_of(known, 0.25, 3 * exact, which=which, walkers=4000, step=0.03)
    assert found.standard_error < 0.02 * found.mean
    assert agrees(found, exact)


@pytest.mark.slow
@pytest.mark.parametrize("which", [0, 1])
def test_the_resonator_escapes_by_the_law(which: int) -> None:
    known, saddle = resonator()
    path = path_of(known, saddle, which=which, tolerance=1e-5)
    rate = escape_rate(known.dynamics, path)
    ratios = []
    for barriers in (3, 5):
        intensity = path.action / barriers
        expected = rate.mean_time(intensity)
        found = escapes_of(
            known, intensity, 3 * expected, which=which, level=1e-9 if which else 8e-10, walkers=800
        )
        ratios.append(found.mean / expected)
    # What is missing is of order ε.
    assert 1 < ratios[1] < ratios[0] < 1.3
    assert (5 * ratios[1] - 3 * ratios[0]) / 2 == pytest.approx(1, abs=0.15)


def test_who_has_not_escaped_counts() -> None:
    known = archetype(2)
    early, late = (escapes_of(known, 0.5, longest, walkers=800) for longest in (8.0, 40.0))
    assert early.censored > early.escapes
    assert late.censored < 0.1 * late.escapes
    assert abs(early.mean - late.mean) < 3 * np.hypot(early.standard_error, late.standard_error) + 1.0
    assert early.times.mean() < 0.6 * late.mean


def test_the_estimate_is_all_time_by_all_escapes() -> None:
    found = _EscapeTimes(np.array([1.0, 2.0, 3.0]), np.zeros(3, dtype=int), censored=2, longest=4.0)
    assert found.mean == pytest.approx(14 / 3)
    assert found.standard_error == pytest.approx(14 / 3 / np.sqrt(3))
    none = _EscapeTimes(np.zeros(0), np.zeros(0, dtype=int), censored=5, longest=4.0)
    assert none.mean == none.standard_error == np.inf


def test_where_they_escape_to_is_told() -> None:
    x = sympy.Symbol("x", real=True)
    dynamics = Dynamics.of((x,), (-((x**2) * (x**2 - 1) ** 2).diff(x),))
    targets = [Neighbourhood(np.array([side]), np.array([[8.0]]), 0.02) for side in (-1.0, 1.0)]
    found = simulate_escapes(
        dynamics, np.zeros(1), targets, intensity=0.1,
        longest=50.0, walkers=300, generator=np.random.default_rng(0),
    )  # fmt: skip
    assert found.escapes > 200
    assert found.targets.mean() == pytest.approx(0.5, abs=3 * 0.5 / np.sqrt(found.escapes))


def test_an_ellipsoid_that_reaches_too_far_is_no_escape() -> None:
    known = archetype(2)
    options = {"level": 20.0, "walkers": 20, "step": 0.02}  # the start itself lies in it
    reached = Neighbourhood.about(known.dynamics, known.attractors[1], level=20.0)
    assert reached.height(known.attractors[0][:, None]) <= 1
    assert escapes_of(known, 0.1, 0.1, **options).escapes == 0


def test_units_change_the_times_alone() -> None:
    known = archetype(2)
    other = transformed(known, np.diag([2.0**-7, 2.0**5]), speed=2.0**-10)
    first = escapes_of(known, 0.5, 20.0, walkers=100, step=2.0**-5)
    second = escapes_of(other, 0.5, 20.0 * 2**10, walkers=100, step=2.0**5)
    assert first.escapes > 10
    np.testing.assert_allclose(second.times, 2**10 * first.times)


@pytest.mark.slow
def test_the_default_step_is_small_enough() -> None:
    known = archetype(2)
    default = escapes_of(known, 0.6, 20.0, walkers=2000, seed=1)
    fine = escapes_of(known, 0.6, 20.0, walkers=2000, seed=2, step=0.02)
    assert abs(default.mean - fine.mean) < 3 * np.hypot(default.standard_error, fine.standard_error)


def test_runaway_walkers_are_told() -> None:
    with pytest.raises(NumericalFailure, match="run to infinity"):
        escapes_of(archetype(2), 1.0, 100.0, walkers=50, step=1.0)


def test_nonsense_is_refused() -> None:
    with pytest.raises(ValueError, match="positive intensity"):
        escapes_of(archetype(2), 0.0, 1.0)
