from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from remembering import STEP, double_wells

import siq
from siq.data.inspection import Inspection, inspect
from siq.data.preparation import without_background
from siq.data.recordings import Recordings


def recorded(values: np.ndarray, **options: str) -> Recordings:
    names = ["x", "y"][: values.shape[2]]
    t = np.arange(values.shape[1]) * STEP
    return Recordings.from_arrays(t, values, names=names, time_unit=options.get("time_unit"))


@pytest.fixture(scope="module")
def blurred() -> Inspection:
    return siq.inspect(recorded(double_wells(1, exposure=3.0, samples=10_000), time_unit="s"))


def test_a_file_a_table_and_recordings_are_told_alike(tmp_path: object, blurred: Inspection) -> None:
    recordings = blurred.recordings
    table = pd.DataFrame(
        {"recording": recordings.recording, "t [s]": recordings.t, "x": recordings.values[:, 0]}
    )
    assert siq.inspect(table).lines() == blurred.lines()


def test_memory_transitions_coverage_and_prospects_are_said(blurred: Inspection) -> None:
    text = blurred.text()
    for words in (
        "beyond an exposure of 0.03 s",
        "Markovian from 4 steps (0.04 s) on",
        "The record has two states of x",
        "transitions were seen",
        "of the range of x was visited",
        "Process noise is seen",
        "seen from a sample 4 steps earlier",
    ):
        assert words in text
    assert "sensor noise of about" not in text  # a first look would take the exposure for something else


def test_gaps_and_labels_are_said() -> None:
    values = double_wells(1, samples=1_000, traces=1)[0]
    t = np.arange(len(values)) * STEP
    t[500:] += 5.0
    both = np.column_stack([values, values[:, 0] > 0])
    found = siq.inspect(Recordings.from_arrays(t, both, names=["x", "side"]))
    assert found.gaps == 1
    assert "neighbouring samples, 1 gap\n" in found.text()
    assert "only 2 different values" in found.text()


def test_relaxations_without_noise_are_not_asked_for_transitions() -> None:
    t = np.linspace(0, 3, 101)
    starts = np.random.default_rng(0).uniform(-1.5, 1.5, (40, 1))
    found = siq.inspect(Recordings.from_arrays(t, (starts * np.exp(-t))[:, :, None], names=["x"]))
    assert found.memory.kind == "none"
    assert found.switching is None
    assert "No process noise is seen" in found.text()


def test_three_panels_show_it(blurred: Inspection) -> None:
    figure = blurred.plot()
    assert len(figure.axes) == 3
    assert figure.axes[2].get_xlabel() == "steps between two increments"


def test_a_slow_state_behind_a_noisy_sensor_is_no_single_relaxation() -> None:
    generator, x = np.random.default_rng(2), np.zeros((4000, 1))
    for k in range(len(x) - 1):
        x[k + 1] = 0.995 * x[k] + 0.1 * generator.standard_normal()
    seen = Recordings.from_arrays(np.arange(4000.0), x + generator.standard_normal(x.shape), names=["x"])
    codes = [one.code for one in inspect(seen).remarks()]
    assert "data.turns_back" in codes
    assert "data.single_recording" not in codes


def test_a_record_is_not_called_stationary_whose_drift_was_taken_off() -> None:
    generator, x = np.random.default_rng(3), np.zeros((1000, 1))
    for k in range(len(x) - 1):
        x[k + 1] = 0.8 * x[k] + 0.6 * generator.standard_normal()
    seen = Recordings.from_arrays(np.arange(1000.0), x + np.linspace(0, 5, 1000)[:, None], names=["x"])
    assert "Beyond what was taken off, no slow drift" in inspect(without_background(seen)).text()
