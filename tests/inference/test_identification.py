from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest
import sympy
from known_systems import (
    KnownSystem,
    archetype,
    as_system,
    double_well,
    exact_field,
    maier_stein,
    uniform_points,
)

from siq.data.recordings import Recordings, SnapshotPairs, snapshot_pairs
from siq.errors import NumericalFailure
from siq.inference.field_estimate import FieldEstimate
from siq.inference.library import IdentificationOptions, candidate_library, field_library
from siq.inference.regression import (
    _evenly,
    _refuse_forgotten,
    identify_vector_field,
    refit,
    residuals,
)
from siq.numerics.integration import FlowMap, dormand_prince_step
from siq.systems.dynamics import Dynamics
from siq.systems.simulation import SimulationOptions, simulate_snapshots

x, y = (sympy.Symbol(name, real=True) for name in "xy")
CORRELATED = np.array([[1.0, 0.9], [0.9, 1.0]])


@functools.cache
def exact_flow(dynamics: Dynamics, count: int, h: tuple[float, float], seed: int, bounds: tuple) -> tuple:
    draw = np.random.default_rng(seed)
    x0 = draw.uniform(*np.array(bounds).T, size=(count, len(bounds)))
    steps = draw.uniform(*h, size=count)

    end = x0
    for _ in range(32):
        end, _error = dormand_prince_step(dynamics.drift, end, steps / 32)
    return x0, end, steps


def flow_pairs(known: KnownSystem, count: int, *, h: tuple[float, float], seed: int = 0) -> SnapshotPairs:
    """Pairs of the exact flow, to rounding, each with a step of its own."""
    bounds = tuple(map(tuple, known.domain.tolist()))
    return SnapshotPairs(*exact_flow(known.dynamics, count, h, seed, bounds), np.zeros(count, dtype=int))


def noisy(
    known: KnownSystem, *, seed: int, intensity: float = 0.05, trajectories: int = 60, pairs: int = 30,
    pair_step: float = 0.02, substeps: int = 2, interval: float = 0.1,
) -> Recordings:  # fmt: skip
    options = SimulationOptions(
        trajectories=trajectories, pairs=pairs, pair_step=pair_step, substeps=substeps,
        interval=interval, noise_intensity=intensity,
    )  # fmt: skip
    return simulate_snapshots(as_system(known), options=options, generator=np.random.default_rng(seed))


def identified(
    known: KnownSystem, data: SnapshotPairs, *, integrator_step: float | None = None, **options: object
) -> FieldEstimate:
    settings = IdentificationOptions(**{"degree": 3, **options})
    library = field_library([symbol.name for symbol in known.dynamics.symbols], settings)
    return identify_vector_field(library, data, options=settings, integrator_step=integrator_step)


def terms(found: FieldEstimate) -> list[dict[str, float]]:
    return [
        {name: float(value) for name, value in zip(found.library.names, column, strict=True) if value != 0}
        for column in found.coefficients.T
    ]


def exact_terms(known: KnownSystem) -> list[dict[str, float]]:
    return [
        {str(term): float(value) for term, value in sympy.expand(equation).as_coefficients_dict().items()}
        for equation in known.dynamics.formulas
    ]


def assert_same(found: FieldEstimate, known: KnownSystem, tolerance: float) -> None:
    for mine, wanted in zip(terms(found), exact_terms(known), strict=True):
        assert set(mine) == set(wanted)
        for name, value in wanted.items():
            assert mine[name] == pytest.approx(value, abs=tolerance), name


def scores(found: FieldEstimate, known: KnownSystem) -> np.ndarray:
    """Errors of the coefficients in their standard errors; fails where terms are missing or false."""
    exact = [exact_terms(known)[i][found.library.names[k]] for i, k in found.support]
    assert len(exact) == sum(map(len, exact_terms(known)))
    return (found.values - exact) / np.sqrt(np.diag(found.covariance))


def planar(*equations: sympy.Expr, diffusion: np.ndarray | None = None, width: float = 1.5) -> KnownSystem:
    symbols = (x, y)[: len(equations)]
    diffusion = np.eye(len(symbols)) if diffusion is None else diffusion
    box = np.array([[-width, width]] * len(symbols))
    return KnownSystem(
        Dynamics.of(symbols, equations, diffusion=diffusion), None, np.zeros((0, len(symbols))), box
    )


UNCOUPLED = planar(x - x**3, -2 * y, diffusion=CORRELATED)
TURNING = planar(x - x**3 - 2 * y, 2 * x - y)


@pytest.mark.parametrize("h", [(0.01, 0.01), (0.005, 0.08)], ids=["one step", "varying steps"])
@pytest.mark.parametrize(
    "known",
    [
        pytest.param(archetype(3), id="archetype"),
        pytest.param(maier_stein(5), id="Maier-Stein", marks=pytest.mark.slow),
        pytest.param(double_well(2), id="double well"),
    ],
)
def test_pairs_without_noise_give_the_coefficients(known: KnownSystem, h: tuple[float, float]) -> None:
    found = identified(known, flow_pairs(known, 200, h=h))
    assert_same(found, known, 1e-7)
    assert found.noise_free
    assert found.residual_ratio < 1e-8
    points = uniform_points(known, 20, seed=5)
    np.testing.assert_allclose(found.dynamics.drift(points), known.dynamics.drift(points), atol=1e-6)


def test_terms_that_are_no_monomials_are_found() -> None:
    fraction, root = x / (x**2 + 1), sympy.sqrt(y**2 + 1)
    known = planar(3 * fraction - x - y, x - 2 * root)
    pairs = flow_pairs(known, 500, h=(0.01, 0.03))
    found = identified(known, pairs, degree=2, functions=("x/(1+x**2)", "sqrt(1+y**2)"))
    assert_same(found, known, 1e-7)
    # Without them f is not in the library, which shows.
    assert identified(known, pairs, degree=2).residual_ratio > 1e-4


@pytest.mark.slow
def test_the_paths_of_the_flow_need_no_small_steps() -> None:
    known = archetype(2)
    found = identified(known, flow_pairs(known, 150, h=(0.05, 0.15)))
    assert_same(found, known, 1e-7)
    assert found.flow.steps > 1


def test_the_residuals_and_a_second_fit_use_the_same_terms() -> None:
    known = maier_stein(5)
    first, second = flow_pairs(known, 400, h=(0.01, 0.02)), flow_pairs(known, 300, h=(0.02, 0.03), seed=9)
    found = identified(known, first)
    assert np.abs(residuals(found, second)).max() < 1e-7
    again = refit(found, second)
    np.testing.assert_array_equal(again.support, found.support)
    np.testing.assert_allclose(again.values, found.values, atol=1e-6)


def test_the_order_of_pairs_does_not_matter() -> None:
    pairs = flow_pairs(TURNING, 500, h=(0.01, 0.03))
    noise = np.random.default_rng(0).normal(size=pairs.xh.shape) * 0.02
    order = np.random.default_rng(1).permutation(500)
    for spread in (0.0, 1.0):
        mine = replace(pairs, xh=pairs.xh + spread * noise)
        other = SnapshotPairs(mine.x0[order], mine.xh[order], mine.h[order], mine.recording)
        one, two = identified(TURNING, mine), identified(TURNING, other)
        np.testing.assert_array_equal(one.support, two.support)
        np.testing.assert_allclose(one.values, two.values, rtol=1e-7)
        np.testing.assert_allclose(one.noise_rate, two.noise_rate, rtol=1e-6, atol=1e-18)


def test_the_order_of_recordings_does_not_matter() -> None:
    recordings = noisy(TURNING, seed=4)
    order = np.random.default_rng(1).permutation(len(recordings.labels))
    one, two = (
        identified(TURNING, snapshot_pairs(each, pair_step=0.02), integrator_step=0.01)
        for each in (recordings, recordings.select(order))
    )
    np.testing.assert_array_equal(one.support, two.support)
    np.testing.assert_allclose(one.values, two.values, rtol=1e-9)
    np.testing.assert_allclose(one.covariance, two.covariance, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize(
    ("units", "spread"),
    [
        ((1e-3, 40.0), 0.03),
        ((1e-6, 1.0), 0.03),
        ((1e4, 1e4), 0.03),
        ((1e-6, 1.0), 0.0),
        pytest.param((1e-3, 40.0), 0.0, marks=pytest.mark.slow),
        pytest.param((1e4, 1e4), 0.0, marks=pytest.mark.slow),
    ],
)
def test_other_units_scale_the_coefficients_and_keep_the_terms(
    units: tuple[float, float], spread: float
) -> None:
    known = maier_stein(5)
    pairs = flow_pairs(known, 250, h=(0.01, 0.02))
    pairs = replace(pairs, xh=pairs.xh + spread * np.random.default_rng(3).normal(size=pairs.xh.shape))
    scale = np.array(units)
    scaled = replace(pairs, x0=pairs.x0 * scale, xh=pairs.xh * scale)
    before, after = identified(known, pairs, degree=5), identified(known, scaled, degree=5)
    np.testing.assert_array_equal(after.support, before.support)
    powers = [[sympy.degree(term, s) for s in known.dynamics.symbols] for term in before.library.terms]
    factors = np.prod(scale ** np.array(powers, dtype=float), axis=1)
    expected = before.coefficients * scale / factors[:, None]
    np.testing.assert_allclose(after.coefficients, expected, rtol=1e-6)
    if spread:
        np.testing.assert_allclose(after.noise_rate, before.noise_rate * np.outer(scale, scale), rtol=1e-3)
        np.testing.assert_allclose(
            after.standard_errors, before.standard_errors * scale / factors[:, None], rtol=1e-3
        )


def repeated(known: KnownSystem, repetitions: int, *, step: float | None, **sampling: float) -> np.ndarray:
    """Standardised errors of all coefficients, shape ``(repetitions, p)``."""
    rows = []
    for seed in range(repetitions):
        pairs = snapshot_pairs(noisy(known, seed=seed, **sampling), pair_step=sampling.get("pair_step", 0.02))
        # The errors of the true terms are asked for: chance is to bring no others in thirty records.
        found = identified(known, pairs, integrator_step=step, false_terms=1e-3)
        rows.append(scores(found, known))
    return np.array(rows)


@pytest.mark.parametrize(
    ("known", "repetitions"),
    [
        (planar(x - x**3), 30),
        pytest.param(TURNING, 20, marks=pytest.mark.slow),
        pytest.param(UNCOUPLED, 20, marks=pytest.mark.slow),
    ],
    ids=["one state", "rotation", "correlated noise"],
)
def test_errors_under_noise_are_as_large_as_the_standard_errors_say(
    known: KnownSystem, repetitions: int
) -> None:
    z = repeated(known, repetitions, step=0.01)
    assert 0.85 < np.sqrt((z**2).mean()) < 1.2
    covered = (np.abs(z) < 1.96).mean()
    slack = 3 * np.sqrt(0.05 * 0.95 / z.size)
    assert 0.95 - slack < covered
    assert np.abs(z.mean(axis=0)).max() < 3.5 / np.sqrt(repetitions)


def test_the_standard_errors_are_those_of_cramer_and_rao() -> None:
    # With one step of Euler's rule per pair the increments are linear in the coefficients.
    recordings = noisy(UNCOUPLED, seed=1, pair_step=0.01, substeps=1)
    pairs = snapshot_pairs(recordings, pair_step=0.01)
    found = identified(UNCOUPLED, pairs, integrator_step=0.01)
    theta = found.library.evaluate(pairs.x0)[:, found.support[:, 1]]
    precision = np.linalg.inv(0.05 * CORRELATED)[np.ix_(found.support[:, 0], found.support[:, 0])]
    information = precision * (theta.T @ (theta * pairs.h[:, None]))
    np.testing.assert_allclose(found.covariance, np.linalg.inv(information), rtol=0.15, atol=1e-4)


@pytest.mark.slow
def test_correlated_noise_is_recovered_and_used() -> None:
    generalised, ordinary = [], []
    exact = np.array([1.0, -1.0, -2.0])
    for seed in range(12):
        pairs = snapshot_pairs(
            noisy(UNCOUPLED, seed=seed, pair_step=0.01, substeps=1, trajectories=120), pair_step=0.01
        )
        found = identified(UNCOUPLED, pairs, integrator_step=0.01)
        np.testing.assert_allclose(found.noise_rate, 0.05 * CORRELATED, rtol=0.12)
        generalised.append(found.values - exact)
        theta, slope = found.library.evaluate(pairs.x0), (pairs.xh - pairs.x0) / pairs.h[:, None]
        estimate = [
            np.linalg.lstsq(theta[:, found.support[found.support[:, 0] == i, 1]], slope[:, i])[0]
            for i in range(2)
        ]
        ordinary.append(np.concatenate(estimate) - exact)
    gain = np.sqrt((np.array(generalised) ** 2).mean(axis=0) / (np.array(ordinary) ** 2).mean(axis=0))
    assert gain.max() < 0.8


@pytest.mark.slow
def test_without_the_integrators_step_f_is_that_of_the_continuous_process() -> None:
    sampling = {"pair_step": 0.06, "substeps": 24, "interval": 0.12, "intensity": 0.2}
    z = repeated(TURNING, 12, step=None, **sampling)
    assert 0.75 < np.sqrt((z**2).mean()) < 1.3
    assert np.abs(z.mean(axis=0)).max() < 3.5 / np.sqrt(12)


def test_the_shift_of_the_mean_by_noise_is_accounted_for() -> None:
    # Where f bends, noise moves the mean of Xh by h²/4 ε f'' to lowest order: here by -0.09 h x.
    known, intensity = planar(x - x**3), 0.6
    pairs = snapshot_pairs(
        noisy(
            known, seed=0, intensity=intensity, trajectories=2000, pairs=30, pair_step=0.1, substeps=20,
            interval=0.2,
        ),
        pair_step=0.1,
    )  # fmt: skip
    found = replace(
        exact_field(known, 3), noise_rate=np.array([[intensity]]), residual_ratio=1.0, flow=FlowMap(4)
    )
    rest, start = residuals(found, pairs)[:, 0], pairs.x0[:, 0]
    assert abs(rest @ start / (start @ start) / 0.1) < 0.045
    without = residuals(replace(found, noise_rate=np.zeros((1, 1))), pairs)[:, 0]
    assert without @ start / (start @ start) / 0.1 < -0.06


def test_the_integrators_step_says_which_f_is_meant() -> None:
    coarse = snapshot_pairs(
        noisy(TURNING, seed=0, pair_step=0.1, substeps=1, interval=0.2, trajectories=600, intensity=0.01),
        pair_step=0.1,
    )
    exact = identified(TURNING, coarse, integrator_step=0.1)
    other = identified(TURNING, coarse)
    assert np.abs(scores(exact, TURNING)).max() < 4
    assert other.values.shape != exact.values.shape or np.abs(other.values - exact.values).max() > 0.1


def test_too_few_pairs_are_a_numerical_failure() -> None:
    with pytest.raises(NumericalFailure, match="only 19 pairs for 10 candidate functions"):
        identified(TURNING, flow_pairs(TURNING, 19, h=(0.01, 0.01)))


def test_a_function_that_is_not_finite_is_a_numerical_failure() -> None:
    pairs = flow_pairs(TURNING, 50, h=(0.01, 0.01))
    with pytest.raises(NumericalFailure, match="not finite"), np.errstate(invalid="ignore"):
        identified(TURNING, pairs, degree=2, functions=("log(x)",))


def test_an_equation_without_a_significant_term_is_a_numerical_failure() -> None:
    pairs = flow_pairs(TURNING, 200, h=(0.01, 0.01))
    drift = pairs.x0 + 0.1 * np.random.default_rng(0).normal(size=pairs.x0.shape)
    with pytest.raises(NumericalFailure, match="no term of the equation of"):
        identified(TURNING, replace(pairs, xh=drift))


def test_noise_free_pairs_beyond_the_limit_are_not_used_and_noisy_ones_are() -> None:
    pairs = flow_pairs(TURNING, 400, h=(0.01, 0.02))
    chosen = _evenly(400, 150)
    assert len(chosen) == 150
    assert (chosen[0], chosen[-1]) == (0, 399)
    some = SnapshotPairs(pairs.x0[chosen], pairs.xh[chosen], pairs.h[chosen], pairs.recording[chosen])
    np.testing.assert_array_equal(
        identified(TURNING, pairs, pairs=150).values, identified(TURNING, some).values
    )
    disturbed = replace(pairs, xh=pairs.xh + 0.005 * np.random.default_rng(0).normal(size=pairs.xh.shape))
    np.testing.assert_array_equal(
        identified(TURNING, disturbed, pairs=150).values, identified(TURNING, disturbed).values
    )


def test_copies_of_resampled_recordings_are_no_further_evidence() -> None:
    rng = np.random.default_rng(0)
    x0 = rng.uniform(-1, 1, (400, 1))
    pairs = SnapshotPairs(x0, 0.9 * x0 + 0.05 * rng.normal(size=x0.shape), np.full(400, 0.1), np.arange(400))
    parts = (pairs.x0, pairs.xh, pairs.h, pairs.recording)
    twice = SnapshotPairs(*(np.concatenate([part, part]) for part in parts), copies=2)
    library = candidate_library(["x"], degree=2)
    alone = identify_vector_field(library, pairs, options=IdentificationOptions())
    doubled = identify_vector_field(library, twice, options=IdentificationOptions())
    np.testing.assert_allclose(doubled.covariance, alone.covariance, rtol=0.01)


def test_only_resampled_recordings_are_copies_however_coarsely_values_are_written() -> None:
    rng = np.random.default_rng(0)
    values = rng.integers(0, 2, (3, 50, 1)).astype(float)
    times = np.arange(50.0)
    drawn = Recordings.from_arrays([times] * 3, [values[0], values[1], values[0]], names=["x"])
    named = replace(drawn, labels=("a", "b", "a#2"))
    assert snapshot_pairs(named.select(np.array([0, 1]))).copies == 1
    pairs = snapshot_pairs(named)  # two thirds of the pairs stand there twice
    assert pairs.copies == pytest.approx((2 * 2 + 1) / 3) and pairs.take(pairs.h > 0).copies == pairs.copies


def test_coarse_values_are_no_states_that_forget_each_other() -> None:
    rng = np.random.default_rng(0)
    x = np.zeros(4000)
    for place in range(1, len(x)):
        x[place] = 0.95 * x[place - 1] + 0.3 * rng.standard_normal()
    recordings = Recordings.from_arrays([np.arange(4000.0)], [np.round(x)[:, None]], names=["x"])
    pairs = snapshot_pairs(recordings)
    _refuse_forgotten(pairs)
    shuffled = replace(pairs, xh=rng.permutation(pairs.xh))
    with pytest.raises(NumericalFailure, match="forgets where it was") as refused:
        _refuse_forgotten(shuffled)
    assert refused.value.claim == "prediction"
