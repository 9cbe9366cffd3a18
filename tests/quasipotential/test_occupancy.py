"""What was identified is held against the record's own hops and histogram."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from siq.data.recordings import Recordings
from siq.data.states import DwellCount
from siq.inference.field_estimate import FieldEstimate, Verdict
from siq.quasipotential.fokker_planck import cores_about
from siq.quasipotential.occupancy import (
    OccupancyCheck,
    _core_of,
    _errors_along,
    _predicted_visits,
    _probability_of,
    check_occupancy,
)
from siq.quasipotential.rates import NoiseStrength
from siq.remarks import Remark, sentence
from siq.systems.phase_portrait import PhasePortrait, phase_portrait
from siq.workflow import pipeline
from siq.workflow.pipeline import PipelineSettings

STEP, WITHIN, SAMPLES, RECORDS, INTENSITY = 0.05, 5, 4000, 10, 0.25
RECORDED = tuple[Recordings, FieldEstimate, PhasePortrait, np.ndarray]


@pytest.fixture(scope="module")
def recorded() -> RECORDED:
    """Ten recordings of ``dx = (x - x³) dt + √0.25 dW``, f as identified, its portrait, what is held out."""
    generator, step = np.random.default_rng(11), STEP / WITHIN
    state, values = np.sign(generator.standard_normal(RECORDS)), np.empty((RECORDS, SAMPLES, 1))
    for sample in range(SAMPLES):
        values[:, sample, 0] = state
        for _ in range(WITHIN):
            kick = np.sqrt(INTENSITY * step) * generator.standard_normal(RECORDS)
            state = state + step * (state - state**3) + kick
    recordings = Recordings.from_arrays(STEP * np.arange(SAMPLES), values, names=["x"])
    found = pipeline.identify_run(PipelineSettings(), recordings, number=0)
    assert found.result is not None
    portrait = phase_portrait(found.result.dynamics, recordings.values[::40], seed=0)
    return recordings, found.result, portrait, recordings.held_out(generator=generator)


def compared(recorded: RECORDED, intensity: float = INTENSITY) -> OccupancyCheck:
    recordings, record, portrait, held_out = recorded
    return check_occupancy(record, portrait, NoiseStrength(intensity), recordings, [(record, held_out)])


def verdict_of(found: OccupancyCheck) -> Verdict:
    tests = found.verdicts(false_alarms=0.05 / 8)
    return Verdict.worst([tests["times"], tests["record"]])


def test_what_is_right_passes(recorded: RECORDED) -> None:
    found = compared(recorded)
    assert sum(one.whole.visits for one in found.visits) > 30 and len(found.visits) == 2 and found.densities
    assert verdict_of(found).passed
    for one in found.visits:
        assert one.method == "operator"
        error = np.hypot(one.error, one.whole.visits**-0.5)
        assert abs(np.log(one.whole.mean / one.predicted)) < 3 * error


@pytest.mark.parametrize("intensity", [0.1, 0.8])
def test_a_wrong_strength_of_the_noise_is_refused(recorded: RECORDED, intensity: float) -> None:
    verdict = verdict_of(compared(recorded, intensity))
    assert not verdict.passed and verdict.reason


def test_a_wrong_depth_is_refused(recorded: RECORDED) -> None:
    recordings, record, portrait, held_out = recorded
    deeper = replace(record, coefficients=2.5 * record.coefficients)
    found = check_occupancy(deeper, portrait, NoiseStrength(INTENSITY), recordings, [(deeper, held_out)])
    assert not verdict_of(found).passed


@pytest.mark.parametrize("blur", [0.2, 0.4])
def test_values_of_a_noisy_sensor_are_spread_as_state_and_noise(recorded: RECORDED, blur: float) -> None:
    recordings, record, portrait, _ = recorded
    noise = blur * np.random.default_rng(3).standard_normal(recordings.values.shape)
    measured = replace(recordings, values=recordings.values + noise)
    for size, passes in ((blur, True), (2.5 * blur, False)):
        assert record.diagnosis is not None
        known = replace(record, diagnosis=replace(record.diagnosis, measurement=np.array([size])))
        parts = [(known, np.ones(RECORDS, dtype=bool))]
        found = check_occupancy(
            known, portrait, NoiseStrength(INTENSITY), recordings, parts, measured=measured
        )
        assert found.verdicts(false_alarms=0.05 / 8)["record"].passed == passes


def test_means_over_an_exposure_are_spread_less_than_the_state(recorded: RECORDED) -> None:
    recordings, record, portrait, _ = recorded
    length, cores = 8, cores_about(record.dynamics, portrait.attractors, portrait.saddles, INTENSITY)
    process = _predicted_visits(record, portrait, NoiseStrength(INTENSITY), cores)[1][0]
    places, x = np.linspace(-3, 3, 601), recordings.values[:, 0]

    def spread(exposure: float) -> float:
        weights = [process.density @ one for one in process.last]
        each = [np.diff(process.distribution(well, 0, places, exposure=exposure)) for well in (0, 1)]
        density = np.average(each, axis=0, weights=weights)
        middle = (places[1:] + places[:-1]) / 2
        return float(density @ middle**2 - (density @ middle) ** 2)

    # The variance within the exposures is what their means lose.
    lost = np.mean((x.reshape(-1, length) - x.reshape(-1, length).mean(axis=1, keepdims=True)) ** 2)
    assert spread(0.0) - spread(length * STEP) == pytest.approx(lost, rel=0.1)


def test_without_noise_there_is_no_test(recorded: RECORDED) -> None:
    recordings, record, portrait, held_out = recorded
    found = check_occupancy(record, portrait, None, recordings, [(record, held_out)])
    assert not found.verdicts(false_alarms=1e-4)
    assert found.missing == Remark("quasipotential.record_of_unknown_noise")
    assert "strength of the process noise" in sentence(found.missing)


def test_a_record_too_short_to_hop_is_no_test(recorded: RECORDED) -> None:
    recordings, record, portrait, _ = recorded
    rows = np.arange(40)
    short = replace(
        recordings, labels=("0",), recording=recordings.recording[rows], t=recordings.t[rows],
        values=recordings.values[rows],
    )  # fmt: skip
    found = check_occupancy(record, portrait, NoiseStrength(INTENSITY), short, [(record, np.array([True]))])
    assert found.missing == Remark("quasipotential.record_too_short_to_hop")
    tests = found.verdicts(false_alarms=0.01)
    assert not tests["connected"].tested and not tests["times"].tested


def test_wells_that_no_recording_joins_are_not_connected(recorded: RECORDED) -> None:
    recordings, record, portrait, _ = recorded
    side = np.where(np.arange(RECORDS) % 2, 1.0, -1.0)[recordings.recording][:, None]
    apart = replace(recordings, values=side * np.abs(recordings.values))
    parts = [(record, np.ones(RECORDS, dtype=bool))]
    tests = check_occupancy(record, portrait, NoiseStrength(INTENSITY), apart, parts).verdicts(
        false_alarms=0.01
    )
    assert not tests["connected"].tested and "no recording passed" in tests["connected"].reason
    tests = check_occupancy(record, portrait, NoiseStrength(INTENSITY), recordings, parts).verdicts(
        false_alarms=0.01
    )
    assert tests["connected"].passed and tests["times"].passed and "factor" in tests["times"].reason


def test_the_error_of_a_barrier_without_a_formula_is_its_scatter_over_recordings(recorded: RECORDED) -> None:
    """The mean force on ten pieces of the way from −1 to 0, added up, in each recording."""
    recordings, record, portrait, _ = recorded
    sides, x = np.linspace(-1, 0, 11), recordings.values[:, 0].reshape(RECORDS, SAMPLES)
    barriers, stated = [], []
    for one in x:
        piece = np.digitize(one[:-1], sides) - 1
        forces = [np.diff(one)[piece == k].mean() / STEP for k in range(10) if (piece == k).any()]
        barriers.append(-2 * 0.1 * np.sum(forces) / INTENSITY)
        single = Recordings.from_arrays(STEP * np.arange(SAMPLES), one[:, None], names=["x"])
        errors = _errors_along(record, portrait, INTENSITY, single)
        stated.append(errors[0, 1])
        assert errors[0, 1] == errors[1, 0]
    assert np.std(barriers) == pytest.approx(np.median(stated), rel=0.5)


def test_passages_that_nothing_is_seen_of_leave_barriers_to_the_formula(recorded: RECORDED) -> None:
    recordings, record, portrait, held_out = recorded
    kept = np.abs(recordings.values[:, 0]) > 0.6
    values, recording = recordings.values[kept], recordings.recording[kept]
    some = replace(recordings, t=STEP * np.arange(len(values)), values=values, recording=recording)
    found = check_occupancy(record, portrait, NoiseStrength(INTENSITY), some, [(record, held_out)])
    connected = found.verdicts(false_alarms=0.05 / 8)["connected"]
    assert np.array(found.passages).sum() > 30
    assert not connected.tested and "without a formula ΔU/ε is known to" in connected.reason
    assert compared(recorded).verdicts(false_alarms=0.05 / 8)["connected"].passed


def test_a_few_hops_do_not_test_a_time(recorded: RECORDED) -> None:
    recordings, record, portrait, _ = recorded
    some = recordings.select([0])
    parts = [(record, np.ones(1, dtype=bool))]
    found = check_occupancy(record, portrait, NoiseStrength(INTENSITY), some, parts)
    assert sum(one.whole.visits for one in found.visits) > 0
    times = found.verdicts(false_alarms=0.05 / 8)["times"]
    assert not times.tested and not times.passed and "too few hops" in times.reason


def test_cores_keep_clear_of_the_saddle(recorded: RECORDED) -> None:
    _, record, portrait, _ = recorded
    cores = cores_about(record.dynamics, portrait.attractors, portrait.saddles, 10.0)
    places = np.array([[0.0], [-1.0], [1.0], [-0.7]])
    found = _core_of(cores, places).tolist()
    assert found[0] == -1 and set(found[1:3]) == {0, 1}


def test_a_distribution_function_rises_from_nothing_to_all(recorded: RECORDED) -> None:
    _, record, portrait, _ = recorded
    noise = NoiseStrength(INTENSITY)
    cores = cores_about(record.dynamics, portrait.attractors, portrait.saddles, INTENSITY)
    _, processes, _ = _predicted_visits(record, portrait, noise, cores)
    along = processes[0].distribution(0, 0, np.linspace(-3, 3, 50), blur=0.1)
    assert along[0] < 1e-6 and along[-1] > 1 - 1e-6 and (np.diff(along) >= -1e-12).all()


def test_probabilities_of_counts_are_those_of_chance() -> None:
    generator = np.random.default_rng(1)
    true = np.exp(0.2 * generator.standard_normal(1000))
    counts = generator.poisson(15 / true)
    found = [_probability_of(DwellCount(int(n), 15.0), 1.0, 0.2) for n in counts]
    assert np.mean(np.array(found) < 0.05) < 0.06
    assert _probability_of(DwellCount(0, 15.0), 1.0, 0.0) < 1e-5
    assert _probability_of(DwellCount(0, 0.0), 1.0, 0.1) == 1.0
