"""A sensor whose noise depends on what it shows, as that of counted photons does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.stats
import sympy

from siq.data.preparation import in_stretches
from siq.data.recordings import Recordings, snapshot_pairs
from siq.inference.checks import sensor_law
from siq.inference.field_estimate import FieldEstimate, NoiseDiagnosis
from siq.inference.kalman_filter import Grid, Noise, linearise
from siq.inference.library import IdentificationOptions, field_library
from siq.inference.measurements import LEAST_VARIANCE, measurements
from siq.numerics.integration import FlowMap
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics
from siq.workflow.pipeline import PipelineSettings, identify_run

STEP, INTENSITY, COUNTS = 0.05, 0.3, 100.0
LIBRARY = field_library(["x"], IdentificationOptions(degree=3))


def path(seed: int, samples: int = 20_000, *, slope: float = 0.0) -> np.ndarray:
    """``dx = (u - u³) dt + √(0.3 (1 + slope u)) dW`` about u = x - 2, shape ``(n,)``."""
    generator, x, seen = np.random.default_rng(seed), 1.0, np.empty(samples)
    kicks = np.sqrt(INTENSITY * STEP / 5) * generator.standard_normal((samples, 5))
    for k in range(samples):
        seen[k] = x
        for kick in kicks[k]:
            x += STEP / 5 * (x - x**3) + np.sqrt(max(1 + slope * x, 0.1)) * kick
    return seen + 2.0


def recorded(values: np.ndarray) -> Recordings:
    return Recordings.from_arrays(STEP * np.arange(len(values)), values[:, None], names=["x"])


def true_field(unit: float) -> FieldEstimate:
    """The f of `path`, of values that are multiplied by a unit."""
    x = sympy.Symbol("x", real=True)
    f = sympy.Poly(unit * ((x / unit - 2) - (x / unit - 2) ** 3), x)
    names = ["1", "x", "x**2", "x**3"]
    support = np.array([[0, LIBRARY.names.index(name)] for name in names])
    return FieldEstimate.on_support(
        LIBRARY, support, np.array(f.all_coeffs()[::-1], dtype=float), np.eye(4),
        np.array([[INTENSITY * unit**2]]), 0.1, FlowMap(1), Diffusion.identity(1),
    )  # fmt: skip


def test_counts_have_the_variance_of_poisson() -> None:
    values = np.random.default_rng(0).poisson(COUNTS * np.clip(path(1), 0, None)).astype(float)
    law = sensor_law(true_field(COUNTS), snapshot_pairs(recorded(values)))
    assert law is not None
    places = np.quantile(values, [0.1, 0.5, 0.9])
    np.testing.assert_allclose(
        np.polynomial.Polynomial(law[0])(places), places / values.mean(), rtol=0.12
    )  # fmt: skip


def test_a_gain_that_is_noisy_has_a_variance_with_the_square() -> None:
    x = path(2)
    values = x * (1 + 0.08 * np.random.default_rng(0).standard_normal(len(x)))
    law = sensor_law(true_field(1.0), snapshot_pairs(recorded(values)))
    assert law is not None and law[0, 2] > 0
    places = np.array([1.0, 2.0, 3.0])
    expected = places**2 / np.mean(x**2)
    np.testing.assert_allclose(np.polynomial.Polynomial(law[0])(places), expected, atol=0.25)


@pytest.mark.parametrize("slope", [0.0, 0.6], ids=["constant", "of the state"])
def test_noise_that_is_the_same_everywhere_has_no_law_whatever_process_noise_does(slope: float) -> None:
    for seed in range(4):
        x = path(10 + seed, slope=slope)
        values = x + 0.1 * np.random.default_rng(seed).standard_normal(len(x))
        assert sensor_law(true_field(1.0), snapshot_pairs(recorded(values))) is None


def test_a_filter_with_a_law_has_the_likelihood_of_the_normal_distribution() -> None:
    """A walk without a force: the measured values are normal together, with a variance of each."""
    x, y = sympy.Symbol("x", real=True), np.array([0.3, 0.5, -0.2, 0.4, 0.9, 0.1])
    model = Dynamics.of((x,), (sympy.S.Zero,))
    law, sensor, rate = np.array([[0.5, 1.0, 0.0]]), 0.04, 0.3
    data = replace(measurements(recorded(y), model), sensor_law=law)
    # Begun at zero, and linearised where the law is asked for the values of before.
    levels = np.concatenate([[0.0], y[:-1]])
    states = np.concatenate([y[:1] * 0, y[1:]])[:, None]
    along = linearise(model, Grid(data, 1), model.values, states)
    noise = Noise(np.array([sensor]), np.array([rate]))
    levels[1:] = states[:-1, 0]
    white, logarithm, *_ = along.filtered(data.first, data.step, noise)
    times = STEP * np.arange(len(y))
    variance = sensor * np.maximum(law[0, 0] + law[0, 1] * levels, LEAST_VARIANCE)
    covariance = rate * np.minimum.outer(times, times) + np.diag(variance)
    expected = scipy.stats.multivariate_normal(np.zeros(len(y)), covariance).logpdf(y)
    got = -(float((white[:, 0, 0] ** 2).sum()) + logarithm + len(y) * np.log(2 * np.pi)) / 2
    assert got == pytest.approx(expected, rel=1e-9)


@pytest.fixture(scope="module")
def counted() -> FieldEstimate:
    values = np.random.default_rng(3).poisson(COUNTS * np.clip(path(3, 8000), 0, None)).astype(float)
    settings = PipelineSettings(identification=IdentificationOptions(degree=3))
    found = identify_run(settings, in_stretches(recorded(values)), number=0).result
    assert found is not None
    return found


def test_f_of_counts_is_right_and_they_say_so(counted: FieldEstimate) -> None:
    noise, unit = counted.diagnosis, COUNTS
    assert noise is not None and noise.sensor_law is not None
    assert noise.measurement[0] == pytest.approx(np.sqrt(2 * unit), rel=0.05)
    x = unit * np.array([1.0, 1.5, 2.0, 2.5, 3.0])
    rows = counted.library.evaluate(x[:, None])[:, counted.support[:, 1]]
    errors = np.sqrt(np.einsum("nk,kl,nl->n", rows, counted.covariance, rows))
    true = unit * ((x / unit - 2) - (x / unit - 2) ** 3)
    assert (np.abs(rows @ counted.values - true) < 3.5 * errors).all()
    told = {one.code: one.values for one in noise.remarks}["inference.measurement_noise"]["sensors"][0]
    levels, sizes = np.transpose(told["along"])
    np.testing.assert_allclose(sizes, np.sqrt(levels), rtol=0.1)


def test_a_law_is_stored_as_it_is(counted: FieldEstimate) -> None:
    assert counted.diagnosis is not None and counted.diagnosis.sensor_law is not None
    again = NoiseDiagnosis.from_data(counted.diagnosis.as_data())
    np.testing.assert_array_equal(again.sensor_law, counted.diagnosis.sensor_law)
