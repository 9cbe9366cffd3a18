"""Output weights of random units: solved for far beyond a rough V, and refused on a false branch."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import sympy
from known_systems import (
    KnownSystem,
    archetype,
    exact_field,
    limit_cycle,
    linear_system,
    maier_stein,
    potential_gradient,
    potential_values,
)

from siq.data.recordings import SnapshotPairs
from siq.networks.decomposition import TrainedNetworks, TrainingOptions
from siq.networks.training import TrainingData, prepare_data
from siq.numerics.integration import runge_kutta_step
from siq.quasipotential.output_weights import OutputWeights, _UnitBasis, formulas_by_well
from siq.quasipotential.refinement import RefinementOptions, local_wells
from siq.quasipotential.transitions import ways_out
from siq.systems.phase_portrait import evenly_spread, phase_portrait

STEP = 0.01
STEEPNESS = 1.5  # η_v of the stand-ins, which V keeps


def pairs_of(known: KnownSystem, *, seed: int = 0, count: int = 3000) -> TrainingData:
    """Pairs that start anywhere in the domain, 60 in a recording."""
    x0 = np.random.default_rng(seed).uniform(*known.domain.T, (count, len(known.domain)))
    xh = runge_kutta_step(lambda x: known.dynamics.drift(x.T).T, x0.T, STEP).T
    pairs = SnapshotPairs(x0, xh, np.full(len(x0), STEP), np.arange(len(x0)) // 60)
    return prepare_data(pairs, options=TrainingOptions(), generator=np.random.default_rng(seed))


def rough_networks(known: KnownSystem, factors: np.ndarray) -> TrainedNetworks:
    """Stand-ins of networks: ∇V is the exact one times factors of the shape ``(d,)``, and up to 20 % off."""

    def evaluate(x: np.ndarray) -> tuple[None, np.ndarray, np.ndarray]:
        slope = potential_gradient(known, x) * factors * (1 + 0.2 * np.sin(2 * x))
        return None, slope @ known.diffusion, np.zeros_like(slope)

    steepness = np.full((1, 1), STEEPNESS)
    return SimpleNamespace(evaluate=evaluate, potential_scale=steepness)  # type: ignore[return-value]


def solver(known: KnownSystem, *, seed: int = 1) -> OutputWeights:
    draw = np.random.default_rng(seed)
    return OutputWeights(pairs_of(known), diffusion=known.dynamics.diffusion, units=400, generator=draw)


def error_of(networks: TrainedNetworks, known: KnownSystem) -> float:
    """Of V over the inner part of the domain, up to a constant and relative to how much V varies there."""
    x = np.random.default_rng(9).uniform(*(0.8 * known.domain).T, (2000, len(known.domain)))
    exact, potential = potential_values(known, x), networks.potential_at(x)
    return float((potential - exact).std() / exact.std())


@pytest.mark.parametrize("known", [archetype(2), archetype(3), linear_system(2), linear_system(3)])
def test_a_rough_potential_leads_to_the_exact_one(known: KnownSystem) -> None:
    networks = solver(known).accepted(rough_networks(known, np.ones(len(known.domain))))
    assert networks is not None
    assert error_of(networks, known) < 2e-3
    x = known.attractors[:1] + 0.3
    _, circulatory, vector_field = networks.evaluate(x)
    assert vector_field == pytest.approx(known.dynamics.drift(x), rel=1e-2, abs=1e-2)
    slope = potential_gradient(known, x)
    assert circulatory == pytest.approx(known.dynamics.drift(x) + slope @ known.diffusion, rel=1e-2, abs=1e-2)


def test_noise_in_the_pairs_is_seen_and_f_known_as_well_as_stated() -> None:
    known, draw = archetype(2), np.random.default_rng(2)
    data = pairs_of(known, count=60_000)
    noisy = data.training, data.held_out
    noisy = tuple(replace(one, xh=one.xh + 0.014 * draw.normal(size=one.xh.shape)) for one in noisy)
    data = replace(data, training=noisy[0], held_out=noisy[1])
    solved = OutputWeights(data, diffusion=known.dynamics.diffusion, units=100, generator=draw)
    exact = known.dynamics.drift(solved.points)
    error = np.linalg.norm(solved.drift(solved.points) - exact) / np.linalg.norm(exact)
    assert 0.3 * solved.uncertainty < error < 2 * solved.uncertainty
    networks = solved.accepted(rough_networks(known, np.ones(2)))
    assert networks is not None
    assert solved.uncertainty < 0.01 and error_of(networks, known) < 0.05


@pytest.mark.slow
def test_a_kink_between_wells_is_met_by_networks_about_each_attractor() -> None:
    known = maier_stein(3)
    exact = exact_field(known, 3)
    data = pairs_of(known)
    solved = OutputWeights(
        data, diffusion=known.dynamics.diffusion, units=200, generator=np.random.default_rng(1), found=exact
    )
    networks = solved.by_wells()
    assert networks is not None and len(networks.parts) == 2
    x = data.training.x0
    portrait = phase_portrait(known.dynamics, x[evenly_spread(x, generator=np.random.default_rng(0))])
    wells, *_ = local_wells(
        known.dynamics, portrait, ways_out(known.dynamics, portrait), options=RefinementOptions(), seed=0,
        draw=np.random.default_rng(0),
    )  # fmt: skip
    for well in wells:
        assert well is not None
        places = well.inside(0.9)
        mine = networks.potential_at(places) - networks.potential_at(well.attractor[None])
        assert np.linalg.norm(mine - well.values(places)) < 0.01 * np.linalg.norm(well.values(places))
    # Both wells are as deep, and where no well is nothing is claimed.
    assert networks.heights == pytest.approx(0, abs=1e-2 * wells[0].level)
    assert np.isnan(networks.potential_at(np.array([[np.nan, 0.0]]))).all()
    by_well = formulas_by_well(networks, known.dynamics, degree=8)
    for formula, well in zip(by_well, wells, strict=True):
        places = well.inside(0.9)
        assert np.linalg.norm(formula.values(places) - well.values(places)) < 0.02 * np.linalg.norm(
            well.values(places)
        )


def test_without_an_identified_f_wells_are_not_told_apart() -> None:
    assert solver(maier_stein(3)).by_wells() is None


@pytest.mark.parametrize("flat", [0, 1])
def test_a_potential_that_is_flat_along_a_direction_is_refused(flat: int) -> None:
    known = archetype(2)
    factors = np.ones(2)
    factors[flat] = 0.0
    assert solver(known).accepted(rough_networks(known, factors)) is None


def test_where_f_comes_to_rest_nowhere_the_branch_is_not_taken_on_trust() -> None:
    known = limit_cycle()
    solved = solver(known)
    assert "comes to rest nowhere" in (solved.hopeless() or "")
    assert solved.accepted(rough_networks(known, np.ones(2))) is None


def test_the_draw_decides_the_units_and_nothing_else_does() -> None:
    known = archetype(2)
    rough = rough_networks(known, np.ones(2))
    one, again, other = (solver(known, seed=seed).accepted(rough) for seed in (1, 1, 2))
    assert one is not None and again is not None and other is not None
    x = np.random.default_rng(0).uniform(*known.domain.T, (50, 2))
    assert np.array_equal(one.potential_at(x), again.potential_at(x))
    assert not np.array_equal(one.potential_at(x), other.potential_at(x))


def test_flat_functions_have_no_slope_at_their_center_and_are_sums_of_the_units() -> None:
    draw = np.random.default_rng(4)
    basis = _UnitBasis(
        draw.normal(size=(2, 9)), draw.normal(size=9), np.ones(2), np.array([2.0, 0.5]), flat=True
    )
    assert basis.size == 8
    np.testing.assert_allclose(basis.gradients(basis.center[None]), 0, atol=1e-14)
    x, coefficients = draw.normal(size=(20, 2)), draw.normal(size=8)
    units = replace(basis, flat=False)
    same = np.append(basis.of_units(coefficients), coefficients[-1])
    for name in ("values", "gradients", "hessians"):
        flat, plain = getattr(basis, name)(x) @ coefficients, getattr(units, name)(x) @ same
        np.testing.assert_allclose(flat, plain, atol=1e-12)
    np.testing.assert_array_equal(units.of_units(same), same[:-1])


def test_derivatives_of_units_are_those_of_their_formula() -> None:
    draw = np.random.default_rng(3)
    basis = _UnitBasis(
        draw.normal(size=(2, 4)), draw.normal(size=4), np.array([0.3, -1.0]), np.array([2.0, 0.5])
    )
    coefficients, point = draw.normal(size=5), np.array([[0.7, -0.4]])
    states = sympy.symbols("x1 x2")
    y = [(x - m) / s for x, m, s in zip(states, basis.center, basis.scale, strict=True)]
    units = [
        sympy.tanh(y[0] * w0 + y[1] * w1 + b) for w0, w1, b in zip(*basis.weights, basis.biases, strict=True)
    ]
    square = coefficients[-1] * (y[0] ** 2 + y[1] ** 2)
    formula = sum((c * each for c, each in zip(coefficients[:-1], units, strict=True)), square)
    at = dict(zip(states, point[0], strict=True))
    assert (basis.hidden(point) @ coefficients[:-1])[0] == pytest.approx(float((formula - square).subs(at)))
    for i, one in enumerate(states):
        slope = float(formula.diff(one).subs(at))
        assert (basis.gradients(point) @ coefficients)[0, i] == pytest.approx(slope)
        for j, other in enumerate(states):
            curvature = float(formula.diff(one, other).subs(at))
            assert (basis.hessians(point) @ coefficients)[0, i, j] == pytest.approx(curvature)
