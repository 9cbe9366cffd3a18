from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import sympy
from known_systems import (
    KnownSystem,
    archetype,
    double_well,
    exact_field,
    linear_system,
    maier_stein,
    polynomial_system,
    portrait_of,
    potential_gradient,
    potential_values,
    uniform_points,
)

from siq.errors import NumericalFailure
from siq.quasipotential.power_series import quasipotential_series
from siq.quasipotential.refinement import RefinementOptions, refine
from siq.quasipotential.wells import Well, _grow_well, best_trial, fit_well
from siq.systems.basins import Basin, Descents, basin_of
from siq.systems.formulas import compile_formulas
from siq.systems.phase_portrait import PhasePortrait, phase_portrait


def grown(known: KnownSystem, found: PhasePortrait, index: int, degree: int = 4) -> Well:
    return _grow_well(
        known.dynamics, found.attractors[index], found.basins[index], found.saddles[index],
        degree=degree, generator=np.random.default_rng(0),
    )  # fmt: skip


def assert_exact(known: KnownSystem, well: Well, tolerance: float = 1e-10) -> None:
    x = well.points[well.values(well.points) < well.level]
    exact = potential_values(known, x) - potential_values(known, well.attractor[None])
    np.testing.assert_allclose(well.values(x), exact, atol=tolerance * exact.max())
    slope = potential_gradient(known, x)
    np.testing.assert_allclose(well.gradients(x), slope, atol=10 * tolerance * np.abs(slope).max())
    assert well.residual < 1e-12
    assert well.values(well.attractor[None]) == 0


@pytest.mark.parametrize(
    "known",
    [*(archetype(d) for d in (2, 3, 4, 6)), maier_stein(1), double_well(2), double_well(3)],
    ids=[*(f"archetype {d}" for d in (2, 3, 4, 6)), "Maier-Stein", "double well 2", "double well 3"],
)
def test_wells_of_known_systems_are_exact_up_to_the_saddle(known: KnownSystem) -> None:
    found = portrait_of(known, share=0.8)
    for index, attractor in enumerate(found.attractors):
        well = grown(known, found, index)
        assert_exact(known, well)
        assert well.saddle is not None
        levels = potential_values(known, np.stack([well.saddle, attractor.position]))
        assert well.level == pytest.approx(levels[0] - levels[1], rel=1e-9)


@pytest.mark.parametrize("dimension", [2, 3, 4, 5])
def test_linear_systems_have_their_quadratic_form(dimension: int) -> None:
    known = linear_system(dimension)
    well = grown(known, portrait_of(known, 200, share=0.7), 0, degree=4 if dimension < 4 else 3)
    assert_exact(known, well)
    assert well.saddle is None
    assert np.abs(well.coefficients[well.basis.exponents.sum(axis=1) > 2]).max() < 1e-10


def test_a_linear_system_in_six_dimensions() -> None:
    known = linear_system(6)
    assert_exact(known, grown(known, portrait_of(known, 150, share=0.7), 0, degree=2))


@pytest.mark.parametrize(
    ("dimension", "seed"),
    [(2, 0), *[pytest.param(*one, marks=pytest.mark.slow) for one in ((2, 1), (2, 2), (3, 0))]],
)
def test_random_polynomials_are_found_in_every_well(dimension: int, seed: int) -> None:
    known = polynomial_system(dimension, seed=seed)
    found = portrait_of(known, 250 if dimension == 2 else 120, share=0.6)
    assert len(found.attractors) == len(known.attractors)
    for index in range(len(found.attractors)):
        well = grown(known, found, index)
        assert_exact(known, well)
        if well.saddle is not None:
            lowest = min(potential_values(known, np.array([one.position for one in found.saddles[index]])))
            at_bottom = potential_values(known, well.attractor[None])[0]
            assert well.level == pytest.approx(lowest - at_bottom, rel=1e-8)


@pytest.mark.parametrize("beta", [2, 3])
def test_the_powers_near_an_attractor_are_those_of_the_series(beta: float) -> None:
    known = maier_stein(beta)  # V is no polynomial
    well = grown(known, portrait_of(known), 0, degree=8)
    series = quasipotential_series(known.dynamics, well.attractor, degree=8)
    angles = np.linspace(0, 2 * np.pi, 20)
    x = well.attractor + 0.1 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    np.testing.assert_allclose(well.values(x), series.values(x), rtol=2e-3)
    np.testing.assert_allclose(
        well.hessians(well.attractor[None])[0], series.hessians(well.attractor[None])[0], atol=1e-12
    )


@pytest.mark.parametrize("degree", [4, 6, 8])
def test_a_v_that_is_no_polynomial_is_approached_by_higher_degrees(degree: int) -> None:
    known = maier_stein(3)
    well = grown(known, portrait_of(known), 0, degree=degree)
    limit = {4: 1e-2, 6: 2e-3, 8: 5e-4}[degree]
    assert well.residual < limit
    # The path over the saddle keeps to the axis, on which V = (x² - 1)²/4.
    assert well.level == pytest.approx(0.25, rel=3 * limit)


@pytest.mark.parametrize(("beta", "barrier", "seed"), [(5, 0.4831, 0), (10, 0.34004, 0), (10, 0.34004, 1)])
def test_wells_with_a_caustic_end_at_their_saddles(beta: float, barrier: float, seed: int) -> None:
    known = maier_stein(beta)
    x = uniform_points(known, 400, seed=seed)
    found = phase_portrait(known.dynamics, x, seed=seed)
    for index in (0, 1):
        well = grown(known, found, index, degree=8)
        assert well.saddle is not None
        assert 2 * well.level == pytest.approx(barrier, rel=0.15)


def test_a_well_ends_at_the_lowest_of_its_saddles() -> None:
    known = polynomial_system(2, seed=1)
    found = portrait_of(known, 300, share=0.6)
    index = int(np.argmax([len(saddles) for saddles in found.saddles]))
    heights = potential_values(known, np.array([one.position for one in found.saddles[index]]))
    assert len(heights) > 1
    well = grown(known, found, index)
    bottom = potential_values(known, well.attractor[None])[0]
    assert well.level <= heights.min() - bottom + 1e-9


def test_without_recorded_states_there_is_no_well() -> None:
    known = archetype(2)
    found = portrait_of(known)
    basin = found.basins[0]
    few = Basin(basin.states[:3], basin.chosen[basin.chosen[:, 0] < 3][:10])
    with pytest.raises(NumericalFailure, match="recorded states lead to the attractor"):
        _grow_well(
            known.dynamics, found.attractors[0], few, found.saddles[0],
            degree=4, generator=np.random.default_rng(0),
        )  # fmt: skip


def test_recordings_that_stay_inside_limit_the_well() -> None:
    known = archetype(2)
    x = known.attractors[0] + 0.3 * np.random.default_rng(0).uniform(-1, 1, size=(200, 2))
    found = phase_portrait(known.dynamics, x)
    well = grown(known, found, 0)
    assert_exact(known, well)
    assert well.saddle is None
    assert well.level < 0.4  # where the saddle is at 1/2


def test_a_degree_too_low_shows_in_the_residual() -> None:
    known = archetype(2)
    assert grown(known, portrait_of(known), 0, degree=2).residual > 0.5


def test_a_degree_that_cannot_follow_v_is_refused() -> None:
    known = archetype(2)
    with pytest.raises(NumericalFailure, match="powers of degree 3 do not follow V"):
        grown(known, portrait_of(known), 0, degree=3)


def test_a_region_leads_to_its_attractor_and_is_dense_near_it() -> None:
    known = archetype(2)
    found = portrait_of(known)
    for index, basin in enumerate(found.basins):
        points = basin.points(np.arange(len(basin.chosen)))
        center = known.attractors[index]
        np.testing.assert_allclose(basin.states[:, -1], np.broadcast_to(center, (len(basin.states), 2)),
                                   atol=1e-3)  # fmt: skip
        distance = np.linalg.norm(points - center, axis=1)
        assert (distance < 0.1).sum() > 100
        assert (points[:, 0] * center[0] > -0.5).mean() > 0.95


def test_a_region_below_a_level_never_rises_above_it_on_the_way() -> None:
    states = np.array([[[0.0], [1.0], [2.0], [3.0]], [[5.0], [6.0], [7.0], [8.0]]])
    basin = Basin(states, np.array([[0, 0], [0, 1], [0, 3], [1, 2]]))
    values = np.array([[1.0, 3.0, 2.0, 0.0], [9.0, 9.0, 0.5, 0.1]])
    np.testing.assert_array_equal(basin.below(values, 2.5), [2, 3])
    np.testing.assert_array_equal(basin.below(values, 3.5), [0, 1, 2, 3])
    np.testing.assert_array_equal(basin.points(np.array([1, 3])), [[1.0], [7.0]])


def test_starts_near_the_attractor_stay_in_the_recorded_box() -> None:
    known = archetype(2)
    box = np.array([[-1.2, -0.9], [-0.1, 0.1]])
    x = np.random.default_rng(0).uniform(*box.T, size=(50, 2))
    found = phase_portrait(known.dynamics, x)
    empty = Descents(found.descents.paths, found.descents.ends, found.descents.escaped)
    basin = basin_of(
        known.dynamics, empty, 0, list(found.attractors), box=box,
        generator=np.random.default_rng(0),
    )  # fmt: skip
    starts = basin.states[:, 0]
    assert ((starts >= box[:, 0]) & (starts <= box[:, 1])).all()


@pytest.mark.parametrize("known", [archetype(3), maier_stein(1)], ids=["archetype", "Maier-Stein"])
def test_the_network_route_refines_values_that_are_off_by_a_tenth(known: KnownSystem) -> None:
    found = portrait_of(known, share=0.8)

    def rough(x: np.ndarray) -> np.ndarray:
        waves = np.sin(2 * x).sum(axis=1) * np.cos(x[:, 0])
        return 3 + potential_values(known, x) * 1.05 + 0.01 * waves

    for index in range(2):
        well = fit_well(
            known.dynamics, found.attractors[index], found.basins[index], found.saddles[index], rough,
            degree=4, generator=np.random.default_rng(0),
        )  # fmt: skip
        assert_exact(known, replace(well, level=0.9 * well.level), 1e-9)


def test_the_network_route_needs_recorded_states_below_the_saddle() -> None:
    known = archetype(2)
    found = portrait_of(known)

    def inverted(x: np.ndarray) -> np.ndarray:
        return -potential_values(known, x)

    with pytest.raises(NumericalFailure, match="the networks leave only"):
        fit_well(
            known.dynamics, found.attractors[0], found.basins[0], found.saddles[0], inverted,
            degree=4, generator=np.random.default_rng(0),
        )  # fmt: skip


def test_a_start_with_just_enough_states_is_not_halved() -> None:
    # A network that is far too low at the saddle leaves between two and four states for each coefficient.
    known = archetype(2)
    found = portrait_of(known)
    lowest = potential_values(known, found.attractors[0].position[None])
    top = found.saddles[0][0].position

    def dipped(x: np.ndarray) -> np.ndarray:
        away = ((x - top) ** 2).sum(axis=1)
        return potential_values(known, x) - lowest - 0.4996 * np.exp(-20 * away)

    well = fit_well(
        known.dynamics, found.attractors[0], found.basins[0], found.saddles[0], dipped,
        degree=8, generator=np.random.default_rng(0),
    )  # fmt: skip
    assert well.level == pytest.approx(0.5, rel=1e-9)
    assert_exact(known, replace(well, level=0.9 * well.level), 1e-9)


def test_the_network_route_does_not_follow_networks_in_how_far_a_well_reaches() -> None:
    # Steep along one state and flat along the other: where the network's V is low, V is not, and conversely.
    known = maier_stein(3)
    found = portrait_of(known)
    local = grown(known, found, 0, degree=10)

    def distorted(x: np.ndarray) -> np.ndarray:
        offset = x - local.attractor
        stretch = np.array([[3.0, 0.8], [0.8, 0.5]])
        return np.einsum("ni,ij,nj->n", offset, local.hessians(local.attractor[None])[0] * stretch, offset)

    x = local.points[local.values(local.points) < 0.9 * local.level]
    assert np.linalg.norm(distorted(x) - local.values(x)) > 0.4 * np.linalg.norm(local.values(x))
    well = fit_well(
        known.dynamics, found.attractors[0], found.basins[0], found.saddles[0], distorted,
        degree=10, generator=np.random.default_rng(0),
    )  # fmt: skip
    assert well.level == pytest.approx(local.level, rel=0.02)
    assert np.linalg.norm(well.values(x) - local.values(x)) < 5e-3 * np.linalg.norm(local.values(x))


@pytest.mark.parametrize("factor", [0.1, 10.0])
def test_the_network_route_is_not_drawn_to_a_v_that_vanishes(factor: float) -> None:
    known = archetype(2)
    found = portrait_of(known)

    def off(x: np.ndarray) -> np.ndarray:
        return factor * potential_values(known, x)

    well = fit_well(
        known.dynamics, found.attractors[0], found.basins[0], found.saddles[0], off,
        degree=4, generator=np.random.default_rng(0),
    )  # fmt: skip
    at = found.attractors[0].position[None]
    true = potential_values(known, well.points) - potential_values(known, at)
    np.testing.assert_allclose(well.values(well.points), true, atol=1e-6 * true.max())


def test_the_network_route_refuses_a_v_without_a_minimum() -> None:
    known = archetype(2)
    found = portrait_of(known)

    def saddle(x: np.ndarray) -> np.ndarray:
        return (x[:, 0] + 1) ** 2 - x[:, 1] ** 2  # low on either side of the attractor

    with pytest.raises(NumericalFailure, match="none with a minimum"):
        fit_well(
            known.dynamics, found.attractors[0], found.basins[0], found.saddles[0], saddle,
            degree=4, generator=np.random.default_rng(0),
        )  # fmt: skip


def test_the_formula_of_a_well_has_its_values() -> None:
    known = maier_stein(3)
    well = grown(known, portrait_of(known), 0, degree=6)
    x = well.points[:50]
    formula = compile_formulas([well.expression], known.dynamics.symbols)
    np.testing.assert_allclose(formula(np.ascontiguousarray(x.T))[0], well.values(x), atol=1e-12)
    assert isinstance(well.expression, sympy.Expr)


def test_refinement_keeps_the_best_degree_of_a_well() -> None:
    known = maier_stein(3)
    found = exact_field(known, 3)
    refined = refine(
        found, portrait_of(known), formula=None, network=None,
        points=uniform_points(known, 300),
        options=RefinementOptions(routes=("local",), degrees=(4, 6, 8)),
    )  # fmt: skip
    assert refined.formula is None
    for well in refined.wells:
        assert [trial.degree for trial in well.trials] == [4, 6, 8]
        assert well.trials[best_trial(well.trials)].degree == well.degree
    with_one = refine(
        found, portrait_of(known), formula=None, network=None,
        points=uniform_points(known, 300),
        options=RefinementOptions(routes=("local",), degrees=(6,)),
    )  # fmt: skip
    assert [well.degree for well in with_one.wells] == [6, 6]
