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
    outline_of,
    polynomial_system,
    potential_gradient,
    potential_values,
    uniform_points,
)

from siq.equilibria import Descents
from siq.errors import NumericalFailure
from siq.expressions import compile_formulas
from siq.local_route import Region, Well, fit_well, grow_well, region_of
from siq.outline import Outline, outline
from siq.power_series import quasipotential_series
from siq.refinement import RefinementOptions, refine


def grown(known: KnownSystem, found: Outline, index: int, degree: int = 4) -> Well:
    return grow_well(
        known.field, found.attractors[index], found.regions[index], found.saddles[index],
        diffusion=known.diffusion, degree=degree, generator=np.random.default_rng(0),
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
    found = outline_of(known, share=0.8)
    for index, attractor in enumerate(found.attractors):
        well = grown(known, found, index)
        assert_exact(known, well)
        assert well.saddle is not None
        levels = potential_values(known, np.stack([well.saddle, attractor.position]))
        assert well.level == pytest.approx(levels[0] - levels[1], rel=1e-9)


@pytest.mark.parametrize("dimension", [2, 3, 4, 5])
def test_linear_systems_have_their_quadratic_form(dimension: int) -> None:
    known = linear_system(dimension)
    well = grown(known, outline_of(known, 200, share=0.7), 0, degree=4 if dimension < 4 else 3)
    assert_exact(known, well)
    assert well.saddle is None
    assert np.abs(well.coefficients[well.basis.exponents.sum(axis=1) > 2]).max() < 1e-10


def test_a_linear_system_in_six_dimensions() -> None:
    known = linear_system(6)
    assert_exact(known, grown(known, outline_of(known, 150, share=0.7), 0, degree=2))


@pytest.mark.parametrize(("dimension", "seed"), [(2, 0), (2, 1), (2, 2), (3, 0)])
def test_random_polynomials_are_found_in_every_well(dimension: int, seed: int) -> None:
    known = polynomial_system(dimension, seed=seed)
    found = outline_of(known, 250 if dimension == 2 else 120, share=0.6)
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
    well = grown(known, outline_of(known), 0, degree=8)
    series = quasipotential_series(known.field, well.attractor, diffusion=known.diffusion, degree=8)
    angles = np.linspace(0, 2 * np.pi, 20)
    x = well.attractor + 0.1 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    np.testing.assert_allclose(well.values(x), series.evaluate(x), rtol=2e-3)
    np.testing.assert_allclose(
        well.hessians(well.attractor[None])[0], series.hessian(well.attractor[None])[0], atol=1e-12
    )


@pytest.mark.parametrize("degree", [4, 6, 8])
def test_a_v_that_is_no_polynomial_is_approached_by_higher_degrees(degree: int) -> None:
    known = maier_stein(3)
    well = grown(known, outline_of(known), 0, degree=degree)
    limit = {4: 1e-2, 6: 2e-3, 8: 5e-4}[degree]
    assert well.residual < limit
    # The path over the saddle keeps to the axis, on which V = (x² - 1)²/4.
    assert well.level == pytest.approx(0.25, rel=3 * limit)


@pytest.mark.parametrize(("beta", "barrier", "seed"), [(5, 0.4831, 0), (10, 0.34004, 0), (10, 0.34004, 1)])
def test_wells_with_a_caustic_end_at_their_saddles(beta: float, barrier: float, seed: int) -> None:
    known = maier_stein(beta)
    x = uniform_points(known, 400, seed=seed)
    found = outline(known.field, x, diffusion=known.diffusion, seed=seed)
    for index in (0, 1):
        well = grown(known, found, index, degree=8)
        assert well.saddle is not None
        assert 2 * well.level == pytest.approx(barrier, rel=0.15)


def test_a_well_ends_at_the_lowest_of_its_saddles() -> None:
    known = polynomial_system(2, seed=1)
    found = outline_of(known, 300, share=0.6)
    index = int(np.argmax([len(saddles) for saddles in found.saddles]))
    heights = potential_values(known, np.array([one.position for one in found.saddles[index]]))
    assert len(heights) > 1
    well = grown(known, found, index)
    bottom = potential_values(known, well.attractor[None])[0]
    assert well.level <= heights.min() - bottom + 1e-9


def test_without_recorded_states_there_is_no_well() -> None:
    known = archetype(2)
    found = outline_of(known)
    region = found.regions[0]
    few = Region(region.states[:3], region.chosen[region.chosen[:, 0] < 3][:10])
    with pytest.raises(NumericalFailure, match="recorded states lead to the attractor"):
        grow_well(
            known.field, found.attractors[0], few, found.saddles[0],
            diffusion=known.diffusion, degree=4, generator=np.random.default_rng(0),
        )  # fmt: skip


def test_recordings_that_stay_inside_limit_the_well() -> None:
    known = archetype(2)
    x = known.attractors[0] + 0.3 * np.random.default_rng(0).uniform(-1, 1, size=(200, 2))
    found = outline(known.field, x, diffusion=known.diffusion)
    well = grown(known, found, 0)
    assert_exact(known, well)
    assert well.saddle is None
    assert well.level < 0.4  # where the saddle is at 1/2


def test_a_degree_too_low_is_a_failure_or_shows_in_the_residual() -> None:
    known = archetype(2)
    found = outline_of(known)
    try:
        assert grown(known, found, 0, degree=3).residual > 1e-2
    except NumericalFailure as error:
        assert "do not follow V" in str(error)


def test_a_region_leads_to_its_attractor_and_is_dense_near_it() -> None:
    known = archetype(2)
    found = outline_of(known)
    for index, region in enumerate(found.regions):
        points = region.points(np.arange(len(region.chosen)))
        center = known.attractors[index]
        np.testing.assert_allclose(region.states[:, -1], np.broadcast_to(center, (len(region.states), 2)),
                                   atol=1e-3)  # fmt: skip
        distance = np.linalg.norm(points - center, axis=1)
        assert (distance < 0.1).sum() > 100
        assert (points[:, 0] * center[0] > -0.5).mean() > 0.95


def test_a_region_below_a_level_never_rises_above_it_on_the_way() -> None:
    states = np.array([[[0.0], [1.0], [2.0], [3.0]], [[5.0], [6.0], [7.0], [8.0]]])
    region = Region(states, np.array([[0, 0], [0, 1], [0, 3], [1, 2]]))
    values = np.array([[1.0, 3.0, 2.0, 0.0], [9.0, 9.0, 0.5, 0.1]])
    np.testing.assert_array_equal(region.below(values, 2.5), [2, 3])
    np.testing.assert_array_equal(region.below(values, 3.5), [0, 1, 2, 3])
    np.testing.assert_array_equal(region.points(np.array([1, 3])), [[1.0], [7.0]])


def test_starts_near_the_attractor_stay_in_the_recorded_box() -> None:
    known = archetype(2)
    box = np.array([[-1.2, -0.9], [-0.1, 0.1]])
    x = np.random.default_rng(0).uniform(*box.T, size=(50, 2))
    found = outline(known.field, x, diffusion=known.diffusion)
    empty = Descents(found.descents.paths, found.descents.ends, found.descents.escaped)
    region = region_of(
        known.field, empty, 0, list(found.attractors), diffusion=known.diffusion, box=box,
        generator=np.random.default_rng(0),
    )  # fmt: skip
    starts = region.states[:, 0]
    assert ((starts >= box[:, 0]) & (starts <= box[:, 1])).all()


@pytest.mark.parametrize("known", [archetype(3), maier_stein(1)], ids=["archetype", "Maier-Stein"])
def test_the_network_route_refines_values_that_are_off_by_a_tenth(known: KnownSystem) -> None:
    found = outline_of(known, share=0.8)

    def rough(x: np.ndarray) -> np.ndarray:
        waves = np.sin(2 * x).sum(axis=1) * np.cos(x[:, 0])
        return 3 + potential_values(known, x) * 1.05 + 0.01 * waves

    for index in range(2):
        well = fit_well(
            known.field, found.attractors[index], found.regions[index], found.saddles[index], rough,
            diffusion=known.diffusion, degree=4, generator=np.random.default_rng(0),
        )  # fmt: skip
        assert_exact(known, replace(well, level=0.9 * well.level), 1e-9)


def test_the_network_route_needs_recorded_states_below_the_saddle() -> None:
    known = archetype(2)
    found = outline_of(known)

    def inverted(x: np.ndarray) -> np.ndarray:
        return -potential_values(known, x)

    with pytest.raises(NumericalFailure, match="the networks leave only"):
        fit_well(
            known.field, found.attractors[0], found.regions[0], found.saddles[0], inverted,
            diffusion=known.diffusion, degree=4, generator=np.random.default_rng(0),
        )  # fmt: skip


def test_the_network_route_does_not_follow_networks_in_how_far_a_well_reaches() -> None:
    # Steep along one state and flat along the other: where the network's V is low, V is not, and conversely.
    known = maier_stein(3)
    found = outline_of(known)
    local = grown(known, found, 0, degree=10)

    def distorted(x: np.ndarray) -> np.ndarray:
        offset = x - local.attractor
        stretch = np.array([[3.0, 0.8], [0.8, 0.5]])
        return np.einsum("ni,ij,nj->n", offset, local.hessians(local.attractor[None])[0] * stretch, offset)

    x = local.points[local.values(local.points) < 0.9 * local.level]
    assert np.linalg.norm(distorted(x) - local.values(x)) > 0.4 * np.linalg.norm(local.values(x))
    well = fit_well(
        known.field, found.attractors[0], found.regions[0], found.saddles[0], distorted,
        diffusion=known.diffusion, degree=10, generator=np.random.default_rng(0),
    )  # fmt: skip
    assert well.level == pytest.approx(local.level, rel=0.02)
    assert np.linalg.norm(well.values(x) - local.values(x)) < 5e-3 * np.linalg.norm(local.values(x))


@pytest.mark.parametrize("factor", [0.1, 10.0])
def test_the_network_route_is_not_drawn_to_a_v_that_vanishes(factor: float) -> None:
    known = archetype(2)
    found = outline_of(known)

    def off(x: np.ndarray) -> np.ndarray:
        return factor * potential_values(known, x)

    well = fit_well(
        known.field, found.attractors[0], found.regions[0], found.saddles[0], off,
        diffusion=known.diffusion, degree=4, generator=np.random.default_rng(0),
    )  # fmt: skip
    at = found.attractors[0].position[None]
    true = potential_values(known, well.points) - potential_values(known, at)
    np.testing.assert_allclose(well.values(well.points), true, atol=1e-6 * true.max())


def test_the_network_route_refuses_a_v_without_a_minimum() -> None:
    known = archetype(2)
    found = outline_of(known)

    def upside_down(x: np.ndarray) -> np.ndarray:
        return -potential_values(known, x)

    with pytest.raises(NumericalFailure, match=r"recorded states below|none with a minimum"):
        fit_well(
            known.field, found.attractors[0], found.regions[0], found.saddles[0], upside_down,
            diffusion=known.diffusion, degree=4, generator=np.random.default_rng(0),
        )  # fmt: skip


def test_the_formula_of_a_well_has_its_values() -> None:
    known = maier_stein(3)
    well = grown(known, outline_of(known), 0, degree=6)
    x = well.points[:50]
    formula = compile_formulas([well.potential], known.field.symbols)
    np.testing.assert_allclose(formula(np.ascontiguousarray(x.T))[0], well.values(x), atol=1e-12)
    assert isinstance(well.potential, sympy.Expr)


def test_refinement_keeps_the_best_degree_of_a_well() -> None:
    known = maier_stein(3)
    found = exact_field(known, 3)
    refined = refine(
        found, outline_of(known), library=found.library, formula=None, network=None,
        points=uniform_points(known, 300), diffusion=known.diffusion,
        options=RefinementOptions(routes=("local",)),
    )  # fmt: skip
    assert refined.potential is None
    assert [int(well.basis.exponents.sum(axis=1).max()) for well in refined.wells] == [8, 8]
    with_one = refine(
        found, outline_of(known), library=found.library, formula=None, network=None,
        points=uniform_points(known, 300), diffusion=known.diffusion,
        options=RefinementOptions(routes=("local",), degree=6),
    )  # fmt: skip
    assert [int(well.basis.exponents.sum(axis=1).max()) for well in with_one.wells] == [6, 6]
