"""The invariant density over wells: against exact integrals, with a bound for what is not known."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.integrate
import scipy.special
import sympy
from known_systems import double_well, potential_gradient, potential_values
from known_wells import matched, stationary

from siq.errors import NumericalFailure
from siq.numerics.integration import heun_step
from siq.quasipotential.invariant_density import (
    SampledPotential,
    shares_by_rates,
)
from siq.systems.dynamics import Dynamics
from siq.systems.simulation import simulate_stationary
from workflow.figures.study import _project_landscape

KNOWN, POTENTIAL = matched("double well")
BOX = KNOWN.domain
INTENSITIES = (0.05, 0.1, 0.2)


def exact(x: np.ndarray) -> np.ndarray:
    """U of the double well, zero at its lowest attractor; g = 0, so that exp(-U/ε) is exact at any ε."""
    return 2 * (potential_values(KNOWN, x) - potential_values(KNOWN, KNOWN.attractors).min())


def exact_normalisation(intensity: float) -> float:
    """Over the box. Given the first state the second is normal about its half, cut off by the box."""

    def along(x: float) -> float:
        low, high = (BOX[1] - x / 2) * np.sqrt(2 / intensity)
        across = np.sqrt(np.pi * intensity / 2) * (scipy.special.erf(high) - scipy.special.erf(low)) / 2
        return float(across * np.exp(-exact(np.array([[x, x / 2]]))[0] / intensity))

    return float(scipy.integrate.quad(along, *BOX[0], points=list(KNOWN.attractors[:, 0]), limit=200)[0])


@pytest.fixture(scope="module")
def sampled() -> tuple[SampledPotential, SampledPotential, np.ndarray]:
    coarse = SampledPotential.of(POTENTIAL, BOX, cells=100)
    return SampledPotential.of(POTENTIAL, BOX, cells=200), coarse, coarse.lowest_possible(KNOWN.dynamics)


def grid(one: SampledPotential) -> np.ndarray:
    return exact(one.middles(np.ones(one.values.shape, dtype=bool)).T).reshape(one.values.shape)


def test_u_is_exact_in_the_cells_that_are_known(sampled) -> None:
    fine = sampled[0]
    assert 0.1 < fine.known.mean() < 0.9
    np.testing.assert_allclose(fine.values[fine.known], grid(fine)[fine.known], atol=1e-8)
    assert set(np.unique(fine.well)) == {-1, 0, 1}
    left = fine.middles(fine.well == 0)[0]
    assert left.max() < 0.3 and fine.middles(fine.well == 1)[0].min() > -0.3


def test_u_is_nowhere_below_what_it_cannot_be_below(sampled) -> None:
    _, coarse, lowest = sampled
    truth = grid(coarse)
    assert (lowest[~coarse.known] <= truth[~coarse.known]).all()
    assert np.isinf(lowest[coarse.known]).all()
    # And it says something: the level of the saddle is 0.31 above the higher well.
    assert lowest.min() > 0.3 * np.nanmax(coarse.values)
    # Where f enters the known region higher than at the lowest point of the rim, more is known.
    assert np.median(lowest[~coarse.known]) > 1.2 * lowest.min()


@pytest.mark.parametrize("intensity", INTENSITIES)
def test_the_exact_constant_lies_between_the_known_part_and_its_bound(sampled, intensity: float) -> None:
    density = SampledPotential.density(*sampled, intensity=intensity)
    truth = exact_normalisation(intensity)
    assert density.change < 0.01
    assert density.normalisation <= truth * (1 + 1e-3)
    assert truth <= density.normalisation / (1 - density.unknown) * (1 + 1e-3)
    assert density.normalisation > 0.9 * truth  # of which nearly all is known
    assert density.shares.sum() == pytest.approx(1) and density.shares.max() > 0.6
    assert density.probabilities.sum() == pytest.approx(1)
    assert (density.probabilities[~sampled[0].known] == 0).all()


def test_the_bound_falls_with_the_noise(sampled) -> None:
    unknown = [SampledPotential.density(*sampled, intensity=one).unknown for one in (0.02, *INTENSITIES)]
    assert unknown[0] < 1e-6 and (np.diff(unknown) > 0).all() and unknown[-1] < 1


def test_outside_the_known_region_the_marginal_is_not_known(sampled) -> None:
    fine = sampled[0]
    marginal = SampledPotential.density(*sampled, intensity=0.1).marginal()
    np.testing.assert_array_equal(np.isnan(marginal.values), ~fine.known.T)
    assert np.nansum(marginal.values) * fine.widths.prod() == pytest.approx(1)
    np.testing.assert_allclose(marginal.x1, fine.axes[0])


def of_values(values: np.ndarray, box: np.ndarray) -> SampledPotential:
    return SampledPotential(box, values, np.where(np.isfinite(values), 0, -1), 1)


def test_three_states_are_integrated_and_projected() -> None:
    box = np.array([[-3.0, 3.0], [-3.0, 2.0], [-2.0, 2.0]])

    def of(cells: int) -> SampledPotential:
        empty = of_values(np.full((cells,) * 3, np.nan), box)
        x, z, y = empty.middles(np.ones((cells,) * 3, dtype=bool))
        values = (x**2 + 2 * y**2 + z**2 + x * z).reshape((cells,) * 3)
        return of_values(np.where(values < 2.5, values, np.nan), box)

    fine, coarse = of(80), of(40)
    dynamics = Dynamics.of(symbols := sympy.symbols("x y z", real=True), tuple(-s for s in symbols))
    density = fine.density(coarse, coarse.lowest_possible(dynamics), intensity=0.25)
    gaussian = (0.25 * np.pi) ** 1.5 / np.sqrt(2 * 0.75)
    assert density.normalisation < gaussian < density.normalisation / (1 - density.unknown)
    assert density.normalisation == pytest.approx(gaussian, rel=1e-3)
    marginal = density.marginal()
    first, second = np.meshgrid(marginal.x1, marginal.x2)
    expected = np.exp(-(first**2 + second**2 + first * second) / 0.25) / (0.25 * np.pi / np.sqrt(0.75))
    np.testing.assert_allclose(np.nan_to_num(marginal.values), expected, atol=2e-3 * expected.max())


def test_a_hole_has_the_level_of_its_own_rim() -> None:
    box = np.array([[-2.0, 2.0]] * 2)
    empty = of_values(np.full((80, 80), np.nan), box)
    x, y = empty.middles(np.ones((80, 80), dtype=bool)).reshape(2, 80, 80)
    values = x**2 + y**2
    hole = (x - 0.8) ** 2 + y**2 < 0.04
    one = of_values(np.where((values < 2.0) & ~hole, values, np.nan), box)
    symbols = sympy.symbols("x y", real=True)
    still = Dynamics.of(symbols, (sympy.S.Zero * symbols[0], sympy.S.Zero * symbols[1]))
    rims = one.lowest_possible(still)
    assert rims[hole].min() == pytest.approx(0.6**2, abs=0.25)  # cells are 0.05 wide
    assert rims[hole].max() < 0.6**2
    assert rims[values > 2.1].min() == pytest.approx(2.0, abs=0.4)


def test_where_f_enters_higher_than_the_lowest_of_the_rim_more_is_known() -> None:
    box = np.array([[-2.0, 2.0]] * 2)
    empty = of_values(np.full((80, 80), np.nan), box)
    x, y = empty.middles(np.ones((80, 80), dtype=bool)).reshape(2, 80, 80)
    values = x**2 + 4 * y**2
    one = of_values(np.where(np.maximum(np.abs(x), np.abs(y)) < 1, values, np.nan), box)
    symbols = sympy.symbols("x y", real=True)
    still = Dynamics.of(symbols, (sympy.S.Zero * symbols[0], sympy.S.Zero * symbols[1]))
    rims, down = (
        one.lowest_possible(each) for each in (still, Dynamics.of(symbols, (-symbols[0], -symbols[1])))
    )
    outside = ~one.known
    assert np.ptp(rims[outside]) == 0 and rims[outside].min() == pytest.approx(1.0, abs=0.3)
    assert (down >= rims).all() and (down[outside] <= values[outside]).all()
    corner = outside & (np.abs(np.abs(x) - np.abs(y)) < 0.1)
    assert down[corner].min() > 2  # of 5 at the corners of the square


def test_islands_that_no_attractor_hangs_together_with_are_not_believed() -> None:
    def by_well(x: np.ndarray) -> np.ndarray:
        near = np.linalg.norm(x, axis=1)
        false = np.linalg.norm(x - [1.5, 0.0], axis=1) < 0.2
        return np.where(false, -1.0, np.where(near < 1, near**2, np.nan))[None]

    attractor = SimpleNamespace(attractor=np.zeros(2))
    stub = SimpleNamespace(by_well=by_well, wells=(attractor,))
    found = SampledPotential.of(stub, np.array([[-2.0, 2.0]] * 2), cells=80)
    assert np.nanmin(found.values) >= 0
    assert found.middles(found.known)[0].max() < 1


def test_a_formula_is_not_believed_where_it_is_negative() -> None:
    one = POTENTIAL.wells[0]
    upside_down = replace(one, coefficients=-one.coefficients)
    x = one.points[::50]
    assert np.isfinite(one.known_values(x)).mean() > 0.9
    assert np.isnan(upside_down.known_values(x)).all()
    assert np.isfinite(one.values(one.attractor[None])).all()


def test_the_components_of_the_wells_are_those_of_the_system() -> None:
    fields = _project_landscape(POTENTIAL, domain=BOX, trajectories=(), resolution=41)
    x = np.stack(np.meshgrid(fields.x1, fields.x2), axis=-1).reshape(-1, 2)
    seen = np.isfinite(fields.quasipotential).ravel()
    assert 0.1 < seen.mean() < 0.9
    np.testing.assert_allclose(fields.quasipotential.ravel()[seen], exact(x[seen]), atol=1e-8)
    downhill = fields.minus_gradient.reshape(2, -1).T
    np.testing.assert_allclose(downhill[seen], -potential_gradient(KNOWN, x[seen]), atol=1e-7)
    np.testing.assert_allclose(fields.circulatory.reshape(2, -1).T[seen], 0, atol=1e-7)
    assert np.isnan(downhill[~seen]).all()


def test_what_cannot_be_done_is_told(sampled) -> None:
    fine, coarse, lowest = sampled
    with pytest.raises(ValueError, match="must be positive"):
        fine.density(coarse, lowest, intensity=0.0)
    with pytest.raises(NumericalFailure, match="too narrow"):
        fine.density(coarse, lowest, intensity=1e-4)
    with pytest.raises(NumericalFailure, match="three states at most"):
        SampledPotential.of(POTENTIAL, np.array([[-1.0, 1.0]] * 4))
    nothing = of_values(np.full((8, 8), np.nan), BOX)
    with pytest.raises(NumericalFailure, match="known nowhere"):
        nothing.density(nothing, np.full((8, 8), 1.0), intensity=0.1)


def test_walkers_start_as_the_density_says_and_stay_so(sampled) -> None:
    density, fine = SampledPotential.density(*sampled, intensity=0.15), sampled[0]
    draw = np.random.default_rng(0)
    start = density.starting_states(2000, generator=draw)
    first = fine.simulated_shares(start, start[:, None])
    np.testing.assert_allclose(first[0], density.shares, atol=2 / 2000)
    samples = simulate_stationary(
        KNOWN.dynamics, start=start, step=0.02, rule=heun_step, intensity=0.15,
        burn_in=200, steps=2000, thin=100, generator=draw,
    )  # fmt: skip
    compared = density.compare(samples, bins=20)
    assert compared.total_variation < 1.6 * compared.sampling_floor < 0.06
    # What lies where U is not known is left out of the comparison, and bounded.
    assert 0 < compared.outside < density.unknown
    later = fine.simulated_shares(start, samples)
    np.testing.assert_allclose(later[0], density.shares, atol=0.03)
    assert (later[1] > 0.02).all()
    wrong = SampledPotential.density(*sampled, intensity=0.2)
    assert wrong.compare(samples, bins=20).total_variation > 2 * compared.total_variation


def test_walkers_stay_in_their_wells_at_small_noise(sampled) -> None:
    density, fine = SampledPotential.density(*sampled, intensity=0.02), sampled[0]
    start = density.starting_states(300, generator=np.random.default_rng(1))
    samples = simulate_stationary(
        KNOWN.dynamics, start=start, step=0.02, rule=heun_step, intensity=0.02,
        burn_in=0, steps=300, thin=100, generator=np.random.default_rng(2),
    )  # fmt: skip
    assert np.nanmax(fine.simulated_shares(start, samples)[1]) == 0


def test_without_a_step_bias_the_variance_of_a_turning_system_is_that_of_its_noise() -> None:
    x, y = symbols = sympy.symbols("x y", real=True)
    dynamics = Dynamics.of(symbols, (-x + 8 * y, -y - 8 * x))  # turns eight times while it descends
    start = np.random.default_rng(0).normal(scale=0.5**0.5, size=(2, 4000))
    samples = simulate_stationary(
        dynamics, start=start, step=0.1 / np.sqrt(130), rule=heun_step, intensity=1.0,
        burn_in=0, steps=600, thin=60, generator=np.random.default_rng(1),
    )  # fmt: skip
    assert samples[:, -1].var() == pytest.approx(0.5, rel=0.05)


def way(start: int, end: int | None, barrier: float | None, prefactor: float | None) -> dict[str, object]:
    return start, end, barrier, prefactor


def test_shares_by_rates_are_those_of_the_jumps() -> None:
    ways = [way(0, 1, 0.5, 2.0), way(1, 0, 0.3, 3.0), way(0, None, 0.2, None)]
    shares = shares_by_rates(ways, 2, intensity=0.1)
    assert shares[0] / shares[1] == pytest.approx(np.exp(2.0) * 2.0 / 3.0)
    assert shares_by_rates(ways, 2, intensity=1e-4)[0] == pytest.approx(1.0)
    draw = np.random.default_rng(0)
    three = [
        way(i, j, draw.uniform(0.5, 1), draw.uniform(1, 2)) for i in range(3) for j in range(3) if i != j
    ]
    rates = np.zeros((3, 3))
    for one in three:
        rates[one[:2]] = np.exp(-one[2] / 0.2) / one[3]
    np.testing.assert_allclose(shares_by_rates(three, 3, intensity=0.2), stationary(rates), rtol=1e-12)
    assert np.isnan(shares_by_rates([*ways[:1], way(1, 0, 0.3, None)], 2, intensity=0.1)).all()
    assert np.isnan(shares_by_rates(ways[:1], 2, intensity=0.1)).all()
    np.testing.assert_array_equal(shares_by_rates([], 1, intensity=0.1), [1.0])


def test_the_system_is_the_one_of_the_exact_answers() -> None:
    assert sympy.simplify(KNOWN.potential - double_well(2).potential) == 0
