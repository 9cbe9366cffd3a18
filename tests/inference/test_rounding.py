"""Values written to few decimals: known for what they are, used where it does no harm, and said."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from siq.data.correlation import resolution_step, rounding_error
from siq.data.recordings import Recordings, snapshot_pairs
from siq.inference.checks import _rounding_bias, bias_of_rounding, residual_noise
from siq.inference.field_estimate import HARMLESS_BIAS
from siq.inference.library import IdentificationOptions, candidate_library
from siq.inference.regression import identify_vector_field
from siq.workflow import pipeline
from siq.workflow.pipeline import PipelineSettings
from siq.workflow.tables import Status

STEP = 0.02


def settling(decimals: int | None, *, sensor: float = 0.0, seed: int = 0) -> Recordings:
    """x' = -x, y' = -2y from many starts, rounded."""
    generator = np.random.default_rng(seed)
    start = generator.uniform(-1, 1, (120, 1, 2))
    t = np.arange(60) * STEP
    values = start * np.exp(-t[None, :, None] * np.array([1.0, 2.0]))
    values += sensor * generator.normal(size=values.shape)
    if decimals is not None:
        values = values.round(decimals)
    return Recordings.from_arrays(t, values, names=["x", "y"], units=["µm", "µm"])


def identified(recordings: Recordings):  # type: ignore[no-untyped-def]
    library = candidate_library(["x", "y"], degree=1)
    return identify_vector_field(library, snapshot_pairs(recordings), options=IdentificationOptions(degree=1))


@pytest.mark.parametrize("decimals", [3, 5])
def test_rounded_recordings_give_formulas_and_it_is_said(decimals: int) -> None:
    settings = PipelineSettings()
    found = pipeline.identify_run(settings, settling(decimals), number=0)
    assert found.result is not None and found.outcome.status == Status.OK
    error = {3: "0.0003", 5: "3e-06"}[decimals]
    said = f"'x' and 'y' are written to {decimals} decimals, an error of {error} µm in each value"
    assert said in found.outcome.reason
    assert found.result.diagnosis.kind == "rounding" and found.result.diagnosis.intensity == 0.0
    field = found.result
    np.testing.assert_array_equal(field.support[:, 0], [0, 1])
    errors = np.sqrt(np.diag(field.covariance))
    assert (np.abs(field.values - [-1, -2]) < 3 * errors).all()


def test_noise_of_a_sensor_is_not_taken_for_rounding() -> None:
    noisy = settling(4, sensor=1e-3)
    noise = residual_noise(identified(noisy), noisy, pair_step=None)
    assert noise.kind == "measurement" and "measurement noise" in str(noise.fault(("x", "y")))
    half = replace(
        noisy, values=np.column_stack([np.round(noisy.values[:, 0], 3), settling(None).values[:, 1]])
    )
    found, pairs = identified(half), snapshot_pairs(half)
    for measured, correlation, rounded in ((0.1, -0.5, False), (1e-5, -0.5, True), (1e-5, -0.2, False)):
        bias = bias_of_rounding(found, pairs, half, np.array([3e-4, measured]), correlation=correlation)
        assert (bias is not None) == rounded


def test_the_bias_of_rounding_is_the_one_that_is_foreseen() -> None:
    """Over many drawings of a noise, since the error of rounding is not random where steps are small."""
    sensor = 0.02
    rounding = np.full(2, sensor)
    biases, foreseen, errors = [], [], []
    for seed in range(40):
        noisy = settling(None, sensor=sensor, seed=seed)
        found = identified(noisy)
        if len(found.support) != 2:
            continue
        errors.append(np.sqrt(np.diag(found.covariance)))
        biases.append(found.values - [-1, -2])
        foreseen.append(_rounding_bias(found, snapshot_pairs(noisy), rounding))
    measured = np.abs(np.mean(biases, axis=0) / np.mean(errors, axis=0)).max()
    assert np.mean(foreseen) == pytest.approx(measured, rel=0.25)
    assert np.mean(foreseen) > HARMLESS_BIAS


def test_rounding_that_is_too_coarse_is_refused_with_the_decimals_that_it_takes() -> None:
    coarse = settling(4)
    noise = residual_noise(identified(coarse), coarse, pair_step=None)
    assert (
        noise.kind == "rounding"
        and noise.fault(("x", "y")) is None
        and "inference.rounding" in {one.code for one in noise.remarks}
    )
    needed = noise.decimals
    assert identified(settling(needed)).noise_free and not identified(settling(needed - 2)).noise_free
    worse = replace(noise, rounding_bias=2.0)
    assert "2.0 standard errors; write at least" in str(worse.fault(("x", "y")))


def test_what_was_not_rounded_has_no_rounding_error() -> None:
    assert [resolution_step(values) for values in settling(None).values.T] == [None, None]
    steps = [resolution_step(values) for values in settling(2).values.T]
    assert [rounding_error(step) for step in steps if step] == pytest.approx([0.01 / np.sqrt(12)] * 2)
