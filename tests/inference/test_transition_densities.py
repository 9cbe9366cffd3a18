"""One state that forgets much of itself from sample to sample: f and D by the density of each transition."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import scipy.stats

from siq.data.recordings import Recordings, SnapshotPairs, snapshot_pairs
from siq.inference.checks import neighbour_correlations
from siq.inference.diffusion_model import process_noise_increments
from siq.inference.field_estimate import FieldEstimate, NoiseDiagnosis
from siq.inference.library import IdentificationOptions, candidate_library
from siq.inference.regression import (
    identify_vector_field,
    refit,
    residuals,
    with_noise_formula,
)
from siq.inference.transition_densities import TransitionDensity, Transitions
from siq.numerics.integration import FlowMap
from siq.systems.diffusion import Diffusion

RATE, INTENSITY = 1.3, 0.4
STRENGTH, WITHIN = 0.4, 100  # barriers of 1.25


def double_well(
    step: float,
    *,
    bent: float = 0.0,
    least: float = 1.0,
    unit: float = 1.0,
    samples: int = 100,
    exposed: bool = False,
    seed: int = 1,
) -> SnapshotPairs:
    """Records of ``dx = (x - x³) dt + √(ε (least + bent x²)) dW``, a hundred steps between two samples.

    Samples are states, or means since the last one.
    """
    draw, x, kept = np.random.default_rng(seed), np.linspace(-1.5, 1.5, 200), []
    for _ in range(samples + 1):
        kept.append(unit * x)
        total = np.zeros_like(x)
        for _ in range(WITHIN):
            kick = np.sqrt(STRENGTH * (least + bent * x**2) * step / WITHIN) * draw.standard_normal(len(x))
            x = x + (x - x**3) * step / WITHIN + kick
            total += x / WITHIN
        if exposed:
            kept[-1] = unit * total
    states = np.array(kept).T[:, :, None]
    pairs, count = (states[:, :-1].reshape(-1, 1), states[:, 1:].reshape(-1, 1)), samples * len(x)
    return SnapshotPairs(*pairs, np.full(count, step), np.repeat(np.arange(len(x)), samples))


def behind_sensor(pairs: SnapshotPairs, noise: float) -> SnapshotPairs:
    """The same as a sensor with normal noise shows it: what ends one pair begins the next."""
    draw, n = np.random.default_rng(7), len(pairs)
    later = noise * draw.standard_normal((n, 1))
    first = np.diff(pairs.recording, prepend=-1) != 0
    earlier = np.where(first[:, None], noise * draw.standard_normal((n, 1)), np.roll(later, 1, axis=0))
    x0, xh = pairs.x0 + earlier, pairs.xh + later
    x0[~first] = xh[np.flatnonzero(~first) - 1]
    return replace(pairs, x0=x0, xh=xh)


def identified(pairs: SnapshotPairs) -> FieldEstimate:
    return identify_vector_field(candidate_library(("x",), degree=5), pairs, options=IdentificationOptions())


def terms_of(found: FieldEstimate) -> dict[str, tuple[float, float]]:
    errors = np.sqrt(np.diag(found.covariance))
    names = [str(found.library.terms[k]) for k in found.support[:, 1]]
    return {name: (value, error) for name, value, error in zip(names, found.values, errors, strict=True)}


def test_a_density_is_that_of_a_linear_force() -> None:
    """Ornstein and Uhlenbeck: a normal law, at two steps, one of which jitters by rounding."""
    draw = np.random.default_rng(0)
    h = np.where(np.arange(3000) % 3, 0.5, 1.0) * (1 + 1e-12 * draw.standard_normal(3000))
    x0, z = 0.5 * draw.standard_normal(3000), draw.standard_normal(3000)
    spread = np.sqrt(INTENSITY / (2 * RATE) * (1 - np.exp(-2 * RATE * h)))
    xh = x0 * np.exp(-RATE * h) + spread * z
    edges = np.linspace(-3, 3, 241)
    density = TransitionDensity(edges, -RATE * edges[1:-1], np.full(239, INTENSITY), np.full(240, INTENSITY))
    expected = scipy.stats.norm.logpdf(z) - np.log(spread)
    assert len(TransitionDensity.distinct(h)[0]) == 2
    assert density.log_density(x0, xh, h) == pytest.approx(expected, abs=0.01)
    assert density.normal_scores(x0, xh, h) == pytest.approx(z, abs=0.005)
    steep = TransitionDensity(edges, np.full(239, 1e30), np.full(239, INTENSITY), np.full(240, INTENSITY))
    assert np.isnan(steep.log_density(x0, xh, h)).all()


def same(noise: float) -> Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """What a sensor shows with a deviation that is the same everywhere."""
    return lambda x: (x, np.full(x.shape, noise))


def test_densities_behind_a_sensor_are_those_of_a_kalman_filter() -> None:
    """Of a linear force that filter is exact; two recordings, each of which begins with what is measured."""
    draw, noise, h, n = np.random.default_rng(3), 0.3, 0.4, 400
    kept, variance = np.exp(-RATE * h), INTENSITY / (2 * RATE) * (1 - np.exp(-2 * RATE * h))
    x = np.zeros((2, n + 1))
    for k in range(n):
        x[:, k + 1] = kept * x[:, k] + np.sqrt(variance) * draw.standard_normal(2)
    seen = x + noise * draw.standard_normal(x.shape)
    expected = []
    for record in seen:
        mean, spread = record[0], noise**2
        for value in record[1:]:
            mean, spread = kept * mean, kept**2 * spread + variance
            score = (value - mean) / np.sqrt(whole := spread + noise**2)
            mean, spread = mean + spread / whole * (value - mean), spread * noise**2 / whole
            expected.append((-(score**2) / 2 - np.log(2 * np.pi * whole) / 2, score, mean))
    edges, begins = np.linspace(-3, 3, 241), np.arange(2 * n) % n == 0
    density = TransitionDensity(edges, -RATE * edges[1:-1], np.full(239, INTENSITY), np.full(240, INTENSITY))
    found = density.foreseen(
        seen[:, :-1].ravel(), seen[:, 1:].ravel(), np.full(2 * n, h), begins, same(noise)
    )  # fmt: skip
    for one, other in zip(found, np.transpose(expected), strict=True):
        assert one == pytest.approx(other, abs=0.003)
    steep = TransitionDensity(edges, np.full(239, 1e30), np.full(239, INTENSITY), np.full(240, INTENSITY))
    assert np.isnan(steep.foreseen(np.zeros(2), np.zeros(2), np.full(2, h), begins[:2], same(noise))[0]).all()


@pytest.mark.parametrize("share", [1.0, 0.4])
def test_densities_of_means_are_those_of_a_kalman_filter(share: float) -> None:
    """Of a linear force state and integral are jointly normal: van Kampen, Stochastic Processes, VIII.1."""
    draw, noise, h, n = np.random.default_rng(4), 0.1, 0.6, 300
    time = share * h
    kept, gone = np.exp(-RATE * time), (1 - np.exp(-RATE * time)) / RATE
    spread = INTENSITY / (2 * RATE) * (1 - kept**2)
    to_both = np.array([[kept], [gone / time]])
    second = INTENSITY / RATE**2 * (time - 2 * gone + (1 - kept**2) / (2 * RATE)) / time**2
    shared = INTENSITY / 2 * gone**2 / time
    both = np.array([[spread, shared], [shared, second + noise**2]])
    waited = np.exp(-RATE * (h - time))
    while_waiting = INTENSITY / (2 * RATE) * (1 - waited**2)
    root, x, seen = np.linalg.cholesky(both), 0.3, []
    for _ in range(n + 1):
        x = waited * x + np.sqrt(while_waiting) * draw.standard_normal()
        x, value = to_both[:, 0] * x + root @ draw.standard_normal(2)
        seen.append(value)
    mean, variance, expected = 0.0, 1e6, []
    for value in seen:
        joint = to_both * variance @ to_both.T + both
        ahead, gain = to_both[:, 0] * mean, joint[0, 1] / joint[1, 1]
        score = (value - ahead[1]) / np.sqrt(joint[1, 1])
        state = ahead[0] + gain * (value - ahead[1])
        expected.append((-(score**2) / 2 - np.log(2 * np.pi * joint[1, 1]) / 2, score, state))
        left = joint[0, 0] - gain * joint[0, 1]
        mean, variance = waited * state, waited**2 * left + while_waiting
    edges, seen = np.linspace(-3, 3, 241), np.array(seen)
    density = TransitionDensity(edges, -RATE * edges[1:-1], np.full(239, INTENSITY), np.full(240, INTENSITY))
    ends = seen[:-1], seen[1:], np.full(n, h), np.arange(n) == 0, same(noise)
    for one, other in zip(density.foreseen(*ends, exposure=time), np.transpose(expected[1:]), strict=True):
        assert one == pytest.approx(other, abs=0.006)


@pytest.mark.slow
def test_f_and_d_are_found_of_means_over_such_steps() -> None:
    pairs = behind_sensor(double_well(0.5, samples=8, exposed=True), 0.1)
    found = Transitions(identified(pairs), pairs).identified_behind_sensor(exposure=0.5, false_terms=0.01)
    assert found is not None and found.exposure == 0.5
    terms, noise = terms_of(found), found.constant_noise
    assert set(terms) == {"x", "x**3"} and noise is not None and found.diagnosis is not None
    for value, error, true in (
        *((*terms[name], true) for name, true in (("x", 1.0), ("x**3", -1.0))),
        (found.noise_rate[0, 0], noise.standard_errors[0], STRENGTH),
    ):
        assert abs(value - true) < 3.5 * error < 0.5 * abs(true)
    assert found.diagnosis.measurement[0] == pytest.approx(0.1, rel=0.25)


@pytest.mark.parametrize("noise", [0.1, pytest.param(0.3, marks=pytest.mark.slow)])
def test_f_and_d_are_found_behind_a_sensor_over_such_steps(noise: float) -> None:
    """Without its noise D is 1.1 and 2 times as large. It is seen, f and D are right, all else is white."""
    pairs = behind_sensor(double_well(0.5, samples=20), noise)
    without = identified(pairs)
    assert without.noise_rate[0, 0] > 1.05 * STRENGTH
    found = Transitions(without, pairs).identified_behind_sensor(false_terms=0.01)
    assert found is not None
    terms, seen = terms_of(found), found.diagnosis
    assert set(terms) == {"x", "x**3"} and seen is not None and found.constant_noise is not None
    assert seen.sensor_evidence is not None and seen.sensor_evidence > 5
    for value, error, true in (
        *((*terms[name], true) for name, true in (("x", 1.0), ("x**3", -1.0))),
        (found.noise_rate[0, 0], found.constant_noise.standard_errors[0], STRENGTH),
        (seen.measurement[0], np.asarray(seen.measurement_error)[0], noise),
    ):
        assert abs(value - true) < 3.5 * error < 0.7 * abs(true)
    scores = (
        process_noise_increments(found, pairs, residuals(found, pairs))[:, 0] / found.noise_rate[0, 0] ** 0.5
    )
    assert scipy.stats.kstest(scores, "norm").pvalue > 0.01
    assert (np.abs(neighbour_correlations(found, pairs)[1]) < 3).all()
    half = refit(found, pairs.take(slice(0, len(pairs) // 2)))
    assert half.values == pytest.approx(found.values, rel=0.3)


def test_a_sensor_without_noise_has_none() -> None:
    pairs = double_well(0.5, samples=20)
    found = Transitions(identified(pairs), pairs).identified_behind_sensor(false_terms=0.01)
    evidence = None if found is None or found.diagnosis is None else found.diagnosis.sensor_evidence
    assert evidence is None or evidence < 5


@pytest.mark.slow
def test_errors_behind_a_sensor_are_as_large_as_they_say() -> None:
    scores = []
    for seed in range(16):
        pairs = behind_sensor(double_well(0.5, samples=20, seed=seed), 0.2)
        found = Transitions(identified(pairs), pairs).identified_behind_sensor(false_terms=0.01)
        assert found is not None
        terms, seen = terms_of(found), found.diagnosis
        assert {"x", "x**3"} <= set(terms) and seen is not None
        own = [(terms[name][0] - true) / terms[name][1] for name, true in (("x", 1), ("x**3", -1))]
        if found.constant_noise is not None:
            own.append((found.noise_rate[0, 0] - STRENGTH) / found.constant_noise.standard_errors[0])
        scores.append([*own, ((seen.measurement - 0.2) / seen.measurement_error)[0]])
    for column in zip(*(one for one in scores if len(one) == 4), strict=True):
        assert 0.5 < np.sqrt(np.mean(np.square(column))) < 1.6 and abs(np.mean(column)) < 0.8


@pytest.mark.slow
def test_a_noise_that_depends_on_the_state_is_found_behind_a_sensor() -> None:
    pairs = behind_sensor(double_well(0.5, bent=1.0), 0.15)
    found = Transitions(identified(pairs), pairs).identified_behind_sensor(false_terms=0.01)
    assert found is not None and found.noise is not None and found.diagnosis is not None
    assert [str(term) for term in found.noise.terms] == ["1", "x**2"]
    assert (np.abs(found.noise.values - STRENGTH) < 4 * found.noise.standard_errors).all()
    assert found.diagnosis.measurement[0] == pytest.approx(0.15, rel=0.1)


@pytest.mark.parametrize("step", [0.5, 1.0])
def test_f_and_d_are_found_over_steps_as_long_as_the_state_takes_to_relax(step: float) -> None:
    """Within such a step a state that begins on the top is in either well; it relaxes in 0.5."""
    pairs = double_well(step)
    found = identified(pairs)
    assert found.flow.by_density and found.constant_noise is not None
    terms = terms_of(found)
    assert set(terms) == {"x", "x**3"}
    for name, true in (("x", 1.0), ("x**3", -1.0)):
        assert abs(terms[name][0] - true) < 3 * terms[name][1]
    error = np.sqrt(found.constant_noise.covariance[0, 0])
    assert abs(found.noise_rate[0, 0] - STRENGTH) < 3 * error < 0.1 * STRENGTH
    assert with_noise_formula(found, pairs, false_terms=0.01) is None
    scores = process_noise_increments(found, pairs, residuals(found, pairs))[:, 0] / np.sqrt(STRENGTH)
    assert scipy.stats.kstest(scores, "norm").pvalue > 0.01
    half = refit(found, pairs.take(slice(None, None, 2)))
    assert half.flow.by_density and half.values == pytest.approx(found.values, rel=0.2)


@pytest.mark.slow
def test_errors_over_long_steps_are_as_large_as_they_say() -> None:
    found = [identified(double_well(0.7, samples=20, seed=seed)) for seed in range(24)]
    terms, noises = [terms_of(one) for one in found], [one.constant_noise for one in found]
    assert all({"x", "x**3"} <= set(one) for one in terms)
    scores = [
        [(one[name][0] - true) / one[name][1] for one in terms] for name, true in (("x", 1), ("x**3", -1))
    ]
    scores.append([(one.values[0] - STRENGTH) / one.standard_errors[0] for one in noises if one is not None])
    for column in scores:
        assert 0.6 < np.sqrt(np.mean(np.square(column))) < 1.5 and abs(np.mean(column)) < 0.7


def test_units_change_nothing_but_units() -> None:
    one, other = (identified(double_well(0.7, unit=unit)) for unit in (1.0, 250.0))
    assert other.noise_rate == pytest.approx(250.0**2 * one.noise_rate, rel=1e-3)
    for name, power in (("x", 0), ("x**3", -2)):
        assert terms_of(other)[name][0] == pytest.approx(250.0**power * terms_of(one)[name][0], rel=1e-2)


def test_a_noise_that_depends_on_the_state_is_found_over_long_steps() -> None:
    pairs = double_well(0.5, bent=0.5)
    found = with_noise_formula(identified(pairs), pairs, false_terms=0.01)
    assert found is not None and found.noise is not None
    assert [str(term) for term in found.noise.terms] == ["1", "x**2"]
    expected = STRENGTH * np.array([1, 0.5])
    assert (np.abs(found.noise.values - expected) < 4 * found.noise.standard_errors).all()
    terms = terms_of(found)
    assert all(abs(terms[name][0] - true) < 4 * terms[name][1] for name, true in (("x", 1), ("x**3", -1)))


@pytest.mark.slow
def test_a_noise_that_nearly_vanishes_is_found_by_moments() -> None:
    pairs = double_well(0.3, bent=1.0, least=1e-5)
    found = with_noise_formula(identified(pairs), pairs, false_terms=0.01)
    assert found is not None and found.noise is not None and not found.flow.by_density
    assert "x**2" in [str(term) for term in found.noise.terms]


def test_counts_behind_a_law_are_as_likely_as_poisson_says() -> None:
    """The same filter on cells, with the probability of each count by the law of Poisson."""
    draw, h, n = np.random.default_rng(5), 0.1, 1500
    x = 100.0 + np.zeros(n + 1)
    for k in range(n):
        x[k + 1] = x[k] - h * (x[k] - 100) + np.sqrt(900 * h) * draw.standard_normal()
    counts = draw.poisson(np.maximum(x, 1.0)).astype(float)
    pairs = snapshot_pairs(Recordings.from_arrays(h * np.arange(n + 1), counts[:, None], names=["x"]))
    library, mean = candidate_library(["x"], degree=1), float(counts.mean())
    seen = NoiseDiagnosis(
        "process", 900.0, np.eye(1), 0.0, 0.0, np.array([np.sqrt(mean)]),
        sensor_law=np.array([[0.0, 1 / mean, 0.0]]),
    )  # fmt: skip
    support = np.array([[0, library.names.index(name)] for name in ("1", "x")])
    found = FieldEstimate.on_support(
        library, support, np.array([100.0, -1.0]), np.eye(2), np.array([[900.0]]), 0.1,
        FlowMap(1, coarse=True), Diffusion.identity(1), diagnosis=seen,
    )  # fmt: skip
    given = Transitions(found, pairs)
    ours = given.log_densities(found.values, given.strengths, given.sensor)
    density = given._density(found.values, given.strengths)
    (matrix,) = density._matrices(np.array([h]))
    cells = density.first + density.width * (np.arange(len(matrix)) + 0.5)
    share, exact = scipy.stats.poisson.pmf(counts[0], np.maximum(cells, 1e-9)), []
    for value in counts[1:]:
        share = (share / share.sum()) @ matrix * scipy.stats.poisson.pmf(value, np.maximum(cells, 1e-9))
        exact.append(np.log(share.sum()))
    assert np.abs(ours - exact).mean() < 0.002 and abs(ours.sum() - sum(exact)) < 0.5
