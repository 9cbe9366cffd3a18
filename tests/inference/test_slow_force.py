"""A slow force on one recorded position that was not recorded: the fifth rung."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from benchmarks.hostile.records import relaxation, telegraph
from benchmarks.slow_forces import STEP, WITHIN, _simulated
from siq.data.preparation import in_stretches
from siq.data.recordings import Recordings
from siq.inference.claims import _gaussian_force
from siq.inference.field_estimate import read_field, write_field
from siq.inference.kalman_identification import filtered_recordings
from siq.inference.library import IdentificationOptions
from siq.workflow.pipeline import PipelineSettings, identify_run

TIME, SIZE, COUNT = 3.0, 0.3, 20_000


def recorded(seed: int, size: float) -> tuple[Recordings, np.ndarray]:
    path = _simulated(COUNT, TIME, size, STEP / WITHIN, WITHIN, np.random.default_rng(seed))
    times = STEP * np.arange(COUNT)
    return Recordings.from_arrays([times], [path[:, :1]], names=["x"], units=["mm"]), path[:, 1]


@pytest.mark.slow
def test_it_is_a_state_where_the_past_refutes_f_of_the_position(tmp_path) -> None:
    recordings, force = recorded(1, SIZE)
    recordings = in_stretches(recordings)
    found = identify_run(PipelineSettings(), recordings, number=0).result
    assert found is not None and found.diagnosis is not None
    assert found.library.states == ("x", "force_x")
    assert found.prediction is not None and found.prediction.passed
    # dz = -z/τ dt + s √(2/τ) dW in its own unit, in which noise moves it as it moves x.
    rate, error = -found.values[-1], np.sqrt(found.covariance[-1, -1])
    assert abs(rate - 1 / TIME) < 3 * error < rate
    noise, factor = 0.2, SIZE * np.sqrt(2 / TIME / 0.2)
    place = int(np.flatnonzero((found.support == [0, 2]).all(axis=1))[0])
    assert abs(found.slow_force - factor) < 3 * np.sqrt(found.covariance[place, place])
    assert np.allclose(found.noise_rate, found.noise_rate[0, 0] * np.eye(2))
    assert abs(found.noise_rate[0, 0] - noise) < 0.03 * noise
    states = filtered_recordings(found, recordings)
    assert states.names == ("x", "force_x") and states.units == ("mm", "mm")
    assert np.corrcoef(states.values[:, 1], force)[0, 1] > 0.4
    assert [one.code for one in found.diagnosis.remarks] == ["inference.slow_force"]
    write_field(tmp_path / "field.json", found, IdentificationOptions())
    again = read_field(tmp_path / "field.json")
    assert again is not None and again.slow_force == pytest.approx(found.slow_force)


def test_a_position_that_is_the_whole_state_gets_none() -> None:
    recordings, _ = recorded(2, 0.0)
    settings = PipelineSettings(identification=IdentificationOptions(degree=3))
    found = identify_run(settings, in_stretches(recordings), number=0).result
    assert found is not None and found.library.states == ("x",) and not found.slow_force


def test_it_is_not_sought_where_hidden_states_are_switched_off() -> None:
    recordings, _ = recorded(1, SIZE)
    options = IdentificationOptions(degree=3, hidden_velocities=False)
    found = identify_run(PipelineSettings(identification=options), in_stretches(recordings), number=0).result
    assert found is not None and found.library.states == ("x",)


@pytest.mark.parametrize(
    ("kind", "share", "passed", "tested"),
    [
        ("noise", 1.0, True, True),
        ("gate", 1.0, False, True),
        ("gate", 0.6, False, True),
        ("noise", 0.1, False, False),
    ],
)
def test_a_gate_is_no_noise(kind: str, share: float, passed: bool, tested: bool) -> None:
    """Of a force of unit variance a filter knows a share; what it does not know is left out of it."""
    draw = np.random.default_rng(3)
    times = STEP * np.arange(COUNT)
    force = relaxation(draw, COUNT, TIME, step=STEP) if kind == "noise" else telegraph(draw, times, 2 * TIME)
    known = share * force + np.sqrt(share * (1 - share)) * relaxation(draw, COUNT, TIME, step=STEP)
    states = Recordings.from_arrays([times], [np.column_stack([force, known])], names=["x", "force_x"])
    found: Any = SimpleNamespace(values=np.array([-1 / TIME]), noise_rate=2 / TIME * np.eye(2))
    verdict = _gaussian_force(found, states, 1 / 160)
    assert (verdict.passed, verdict.tested) == (passed, tested)
