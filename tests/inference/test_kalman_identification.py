"""f beside the noise of a sensor: the right terms, unbiased, and held-out recordings that can refuse it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.signal
from remembering import STEP as TIME, double_wells

from siq.data.correlation import markov_lag
from siq.data.preparation import in_stretches
from siq.data.recordings import Recordings, snapshot_pairs
from siq.errors import NumericalFailure
from siq.inference.checks import PredictionLimits
from siq.inference.field_estimate import FieldEstimate, read_field, write_field
from siq.inference.identify import _Case, _possible_exposures, identify
from siq.inference.kalman_filter import Noise
from siq.inference.kalman_identification import (
    filtered_recordings,
    held_out_innovations,
    identify_by_likelihood,
)
from siq.inference.library import IdentificationOptions, candidate_library, field_library
from siq.inference.observation import ObservationModel, unbroken
from siq.inference.regression import identify_vector_field, lagged_pairs, lost_time
from siq.systems.diffusion import Diffusion
from siq.workflow import pipeline
from siq.workflow.pipeline import PipelineSettings
from siq.workflow.tables import Status

STEP, FORCES, SENSOR = 0.02, 0.3, 0.1


def recorded(values: np.ndarray) -> Recordings:
    return Recordings.from_arrays(TIME * np.arange(values.shape[1]), values, names=["x"])


def double_well(seed: int, *, samples: int = 3000, records: int = 6) -> tuple[Recordings, np.ndarray]:
    """Records of dx = (x - x³) dt + √0.3 dW with sensor noise 0.1, and the states without it."""
    generator = np.random.default_rng(seed)
    x, now = np.empty((samples, records)), np.sign(generator.standard_normal(records))
    for row in range(samples):
        x[row] = now
        for _ in range(10):
            push = np.sqrt(FORCES * STEP / 10) * generator.standard_normal(records)
            now = now + STEP / 10 * (now - now**3) + push
    measured = x + SENSOR * generator.standard_normal(x.shape)
    recordings = Recordings.from_arrays(STEP * np.arange(samples), measured.T[:, :, None], names=["x"])
    return recordings, x.T.reshape(-1, 1)


def case_of(recordings: Recordings) -> _Case:
    options = IdentificationOptions()
    library = field_library(recordings.names, options)
    return _Case(
        recordings, library, options, lambda purpose: np.random.default_rng(0), None, recordings.units, None,
        None, PredictionLimits(),
    )  # fmt: skip


def identified(recordings: Recordings, *, degree: int) -> FieldEstimate:
    library = candidate_library(["x"], degree=degree)
    begin = identify_vector_field(
        library, snapshot_pairs(recordings), options=IdentificationOptions(degree=degree)
    )
    return identify_by_likelihood(
        ObservationModel(library, begin.diffusion), recordings, Noise(np.array([0.003]), np.array([0.5])),
        false_terms=0.05, generator=np.random.default_rng(0),
    )  # fmt: skip


@pytest.fixture(scope="module")
def found() -> tuple[FieldEstimate, Recordings, np.ndarray]:
    recordings, x = double_well(1)
    return identified(recordings, degree=5), recordings, x


def test_terms_and_noises_are_found(found: tuple[FieldEstimate, Recordings, np.ndarray]) -> None:
    field, noise = found[0], found[0].diagnosis
    assert noise is not None and noise.sensor_evidence is not None
    assert [field.library.names[k] for _, k in field.support] == ["x", "x**3"]
    errors = np.sqrt(np.diag(field.covariance))
    assert (np.abs(field.values - [1, -1]) < 3 * errors).all()
    assert noise.measurement[0] == pytest.approx(SENSOR, rel=0.03)
    assert field.noise_rate[0, 0] == pytest.approx(FORCES, rel=0.1)
    assert field.stability is not None and (field.stability > 0.5).all()
    assert noise.sensor_evidence > 100 and abs(noise.correlation_score) < 4


@pytest.mark.slow
def test_many_short_recordings_leave_white_innovations() -> None:
    """An initial state fitted to each seven samples would leave correlations of about minus one in seven."""
    whole, _ = double_well(1)
    count = len(whole.t) // 21
    cut = Recordings.from_arrays(
        STEP * np.arange(7), whole.values[: 7 * count].reshape(count, 7, 1), names=["x"]
    )
    noise = identified(cut, degree=3).diagnosis
    assert noise is not None and noise.kind == "process"
    assert abs(noise.correlation) < 0.04 and noise.measurement[0] == pytest.approx(SENSOR, rel=0.05)


def test_noise_that_depends_on_the_state_behind_a_noisy_sensor_is_kept(tmp_path: Path) -> None:
    generator, step = np.random.default_rng(4), STEP / 10
    x, now = np.empty((3000, 4)), np.array([1.0, -1.0, 1.0, -1.0])
    for row in range(len(x)):
        x[row] = now
        for _ in range(10):
            kick = np.sqrt(0.2 * (0.2 + now**2) * step) * generator.standard_normal(4)
            now = now + step * (now - now**3) + kick
    seen = x + 0.05 * generator.standard_normal(x.shape)
    found = identified(
        Recordings.from_arrays(STEP * np.arange(len(x)), seen.T[:, :, None], names=["x"]), degree=3
    )
    assert found.noise is not None and found.noise.probability < 0.05
    write_field(tmp_path / "field.json", found, IdentificationOptions(degree=3))
    again = read_field(tmp_path / "field.json")
    assert again is not None and again.noise is not None
    assert again.noise.probability == found.noise.probability


def test_where_the_origin_is_does_not_matter(found: tuple[FieldEstimate, Recordings, np.ndarray]) -> None:
    """Five states away from its wells a cubic is four monomials that are nearly alike."""
    one, recordings, _ = found
    away = identified(replace(recordings, values=recordings.values + 5), degree=5)
    assert [away.library.names[k] for _, k in away.support] == ["1", "x", "x**2", "x**3"]
    x = np.linspace(-1.3, 1.3, 14)[:, None]
    functions = away.library.evaluate(x + 5)[:, away.support[:, 1]]
    error = np.sqrt(np.einsum("np,pq,nq->n", functions, away.covariance, functions))
    change = away.dynamics.drift(x + 5)[:, 0] - one.dynamics.drift(x)[:, 0]
    assert (np.abs(change) < 3 * error).all() and error.max() < 0.5
    assert (np.abs(away.values) < 50 * np.sqrt(np.diag(away.covariance))).all()
    assert away.diagnosis is not None and one.diagnosis is not None
    assert away.diagnosis.measurement[0] == pytest.approx(one.diagnosis.measurement[0], rel=0.01)


def test_filtered_states_are_nearer_and_keep_the_mean_of_f(
    found: tuple[FieldEstimate, Recordings, np.ndarray],
) -> None:
    one, recordings, x = found
    filtered = filtered_recordings(one, recordings)
    assert np.std(filtered.values - x) < 0.75 * SENSOR
    for values, unbiased in ((filtered, True), (recordings, False)):
        pairs = snapshot_pairs(values)
        terms = np.column_stack([pairs.x0, pairs.x0**3])
        slopes = np.linalg.lstsq(terms, (pairs.xh - pairs.x0)[:, 0] / STEP, rcond=None)[0]
        assert (np.abs(slopes - [1, -1]).max() < 0.3) == unbiased


def test_held_out_recordings_refuse_an_f_that_lacks_a_term(
    found: tuple[FieldEstimate, Recordings, np.ndarray],
) -> None:
    one, recordings, _ = found
    parts = recordings.select([0, 1, 2, 3]), recordings.select([4, 5])
    probability, ratio = held_out_innovations(one, *parts)
    assert probability > 1e-3 and ratio == pytest.approx(1.0, abs=0.05)
    linear = replace(one, support=one.support[:1], covariance=one.covariance[:1, :1])
    probability, _ = held_out_innovations(linear, *parts)
    assert probability < 1e-6


def test_relaxations_without_random_forces_are_whole_trajectories() -> None:
    """Errors do not add up along a trajectory that nothing drives: f is known far better than by pairs."""
    generator = np.random.default_rng(3)
    t = 0.05 * np.arange(80)
    start = generator.uniform(-1.5, 1.5, 30)
    # x' = x - x³ from x(0): x² = 1/(1 + (1/x(0)² - 1) exp(-2t))
    x = np.sign(start)[:, None] / np.sqrt(1 + (1 / start[:, None] ** 2 - 1) * np.exp(-2 * t))
    measured = x + 0.02 * generator.standard_normal(x.shape)
    recordings = Recordings.from_arrays(t, measured[:, :, None], names=["x"])
    one = identified(recordings, degree=5)
    assert [one.library.names[k] for _, k in one.support] == ["x", "x**3"]
    errors = np.sqrt(np.diag(one.covariance))
    assert (np.abs(one.values - [1, -1]) < 3 * errors).all() and errors.max() < 0.02
    assert not one.noise_rate.any()
    assert one.diagnosis is not None and one.diagnosis.measurement[0] == pytest.approx(0.02, rel=0.05)
    filtered = filtered_recordings(one, recordings)
    assert np.std(filtered.values - x.reshape(-1, 1)) < 0.2 * 0.02


def test_means_over_an_exposure_are_treated_as_such() -> None:
    """f from means is off by the path that two of them share; with the running mean as a state it is not."""
    generator, within = np.random.default_rng(11), 10
    samples, step = 12_000, 0.04
    x, means = np.sign(generator.standard_normal(3)), np.empty((samples, 3))
    for row in range(samples):
        total = np.zeros(3)
        for _ in range(within):
            push = np.sqrt(FORCES * step / within) * generator.standard_normal(3)
            before, x = x, x + step / within * (x - x**3) + push
            total += (before + x) / 2
        means[row] = total / within
    means += 0.03 * generator.standard_normal(means.shape)
    recordings = Recordings.from_arrays(step * np.arange(samples), means.T[:, :, None], names=["x"])
    settings = PipelineSettings()
    done = pipeline.identify_run(settings, recordings, number=0)
    assert done.result is not None and done.result.exposure == pytest.approx(step)
    field = done.result
    assert [field.library.names[k] for _, k in field.support] == ["x", "x**3"]
    assert (np.abs(field.values - [1, -1]) < 3.5 * np.sqrt(np.diag(field.covariance))).all()
    assert field.noise_rate[0, 0] == pytest.approx(FORCES, rel=0.05)
    assert done.result.sensor_variance is not None
    assert np.sqrt(done.result.sensor_variance[0]) == pytest.approx(0.03, rel=0.1)
    assert "as the mean over the 0.04 before it" in done.outcome.reason


def test_a_gap_begins_another_recording() -> None:
    t = np.concatenate([np.arange(5), np.arange(20, 26)]).astype(float)
    data = unbroken(Recordings.from_arrays(t, np.zeros((11, 1)), names=["x"]))
    np.testing.assert_array_equal(data.first, [0, 5, 11])
    assert data.labels == ("0", "0")


def test_the_step_asks_the_likelihood_where_sensors_are_noisy() -> None:
    recordings, _ = double_well(2, samples=2000)
    settings = PipelineSettings()
    done = pipeline.identify_run(settings, recordings, number=0)
    assert done.result is not None and done.outcome.status == Status.OK
    assert done.result.sensor_variance is not None
    assert np.sqrt(done.result.sensor_variance[0]) == pytest.approx(SENSOR, rel=0.1)
    assert "measurement noise" in done.outcome.reason


@pytest.mark.slow
def test_a_sensor_is_found_where_steps_are_nearly_as_long_as_the_state_relaxes() -> None:
    # Neighbouring residuals are hardly correlated: a force that is too steep stands for the sensor's noise.
    values = double_wells(1, samples=150_000, traces=1, intensity=0.16, sensor=0.14)[:, ::30]
    coarse = in_stretches(Recordings.from_arrays(30 * TIME * np.arange(5000), values, names=["x"]))
    found = case_of(coarse).identified()
    assert found.sensor_variance is not None
    assert np.sqrt(found.sensor_variance[0]) == pytest.approx(0.14, rel=0.15)
    assert found.noise_rate[0, 0] == pytest.approx(0.16, rel=0.25)


def test_errors_of_a_sensor_that_last_are_no_memory_of_the_forces() -> None:
    values = double_wells(1, samples=100_000, traces=1, intensity=0.16)[:, ::5]
    errors = 0.1 * np.random.default_rng(0).standard_normal(values.shape)
    values += scipy.signal.lfilter([1], [1, -0.7], errors, axis=1)
    recordings = in_stretches(Recordings.from_arrays(5 * TIME * np.arange(20_000), values, names=["x"]))
    with pytest.raises(NumericalFailure, match="takes back within"):
        case_of(recordings).by_instruments(markov_lag(recordings))


def test_a_lost_time_below_zero_within_its_error_is_none() -> None:
    # White noise taken for one with a memory: what it adds up to over the lag is known to an error.
    values = double_wells(2, samples=20_000, traces=1, intensity=0.16)[:, ::5]
    case = case_of(in_stretches(Recordings.from_arrays(5 * TIME * np.arange(4000), values, names=["x"])))
    pairs = lagged_pairs(case.recordings, 5)
    lost, error = lost_time(identify_vector_field(case.library, pairs, options=case.options), pairs)
    assert -2 * error < lost < 0
    memory = replace(
        markov_lag(case.recordings), kind="coloured", lag=5,
        correlations=np.array([[0.02]]), errors=np.array([[0.01]]),
    )  # fmt: skip
    found = case.by_instruments(memory)
    assert found.diagnosis is not None and found.diagnosis.lost_time == 0


@pytest.mark.parametrize(("steps", "kept", "rows"), [(0.4, 1, 2), (1.0, 1, 1), (1.5, 2, 2), (10.0, 10, 1)])
def test_exposures_do_not_overlap_and_begin_at_rows_of_their_own(steps: float, kept: int, rows: int) -> None:
    t = np.concatenate([0.1 * np.arange(101), 20 + 0.1 * np.arange(41)])
    recordings = Recordings.from_arrays(t, np.sin(t)[:, None], names=["x"])
    view = ObservationModel(candidate_library(["x"], degree=1), Diffusion.identity(1), 0.1 * steps)
    data = view.measured(recordings, None)
    known = ~np.isnan(data.outputs[:, 0])
    assert view.every(recordings) == kept
    assert len(data.first) == 3 and known[data.first[:-1]].all()
    np.testing.assert_allclose(data.outputs[known, 0], np.sin(data.t[known]))
    intervals = np.diff(data.t)[data.begins]
    lengths = {round(float(one), 9) for one in intervals}
    assert round(0.1 * steps, 9) in lengths and len(lengths) == rows
    assert np.isfinite(view.states(data)).all()
    assert data.restarting == (1,)


@pytest.mark.slow
@pytest.mark.parametrize("steps", [0.5, 3.0])
def test_means_over_an_exposure_of_another_length_are_treated_as_such(steps: float) -> None:
    recordings = recorded(double_wells(1, exposure=steps, samples=4_000, sensor=0.01))
    library = candidate_library(["x"], degree=3)
    case = _Case(
        recordings, library, IdentificationOptions(degree=3), lambda _: np.random.default_rng(0), None,
        (None,), None, None, PredictionLimits(),
    )  # fmt: skip
    field = case.by_exposure(ObservationModel(library, Diffusion.identity(1), steps * TIME))
    assert field is not None and field.exposure == steps * TIME
    assert [field.library.names[k] for _, k in field.support] == ["x", "x**3"]
    assert (np.abs(field.values - [1, -1]) < 3.5 * np.sqrt(np.diag(field.covariance))).all()
    assert field.noise_rate[0, 0] == pytest.approx(0.2, rel=0.06)


def test_exposures_that_are_tried_are_those_that_residuals_show() -> None:
    memory = markov_lag(recorded(double_wells(1, exposure=10.0, samples=6_000)))
    first, second = _possible_exposures(memory)
    assert first == pytest.approx(0.1) and second == memory.memory == pytest.approx(0.1, rel=0.03)
    assert _possible_exposures(replace(memory, kind="either")) == [memory.step]
    assert _possible_exposures(replace(memory, kind="coloured")) == []


def test_a_record_that_no_claim_can_be_made_of_is_refused_in_words(monkeypatch: pytest.MonkeyPatch) -> None:
    # A machine that is on in every fourth sample: of noise too small to see there are no claims.
    x = np.tile([-0.58, -0.58, 1.73, -0.58], 100) + 0.01 * np.random.default_rng(0).standard_normal(400)
    options = IdentificationOptions(hidden_velocities="auto")
    seen = Recordings.from_arrays(10.0 * np.arange(400), x[:, None], names=["P"])
    seen = in_stretches(seen, hidden_velocities="auto")
    monkeypatch.setattr("siq.inference.identify.check_claims", lambda *_, **__: {})
    with pytest.raises(NumericalFailure, match="the sensor is noisy, and f with it is not found"):
        identify(seen, options=options, draw=lambda _: np.random.default_rng(0))
