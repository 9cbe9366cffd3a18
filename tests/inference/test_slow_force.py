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
from siq.inference.claims import _gaussian_force, check_claims
from siq.inference.field_estimate import read_field, write_field
from siq.inference.kalman_identification import filtered_recordings, identify_by_likelihood
from siq.inference.library import IdentificationOptions, field_library
from siq.inference.observation import ObservationModel
from siq.systems.diffusion import Diffusion
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


def test_what_only_remembers_the_state_has_no_noise() -> None:
    """``dx = (x - x³ - c (x - z)) dt + √p dW`` and ``dz = (x - z)/τ dt``: a force that follows the state."""
    count, step, within, strength, time, noise = 8_000, 0.1, 10, 1.0, 3.0, 0.5
    draw = np.random.default_rng(5).standard_normal(count * within) * np.sqrt(noise * step / within)
    path, x, z = np.empty((count, 2)), 1.0, 1.0
    for place, kick in enumerate(draw):
        if place % within == 0:
            path[place // within] = x, z
        force = x - x**3 - strength * (x - z)
        x, z = x + step / within * force + kick, z + step / within * (x - z) / time
    recordings = Recordings.from_arrays([step * np.arange(count)], [path[:, :1]], names=["x"])
    library = field_library(("x", "force_x"), IdentificationOptions(degree=3))
    follows = ObservationModel(library, Diffusion.identity(2), hidden=True, slow_force=1.0, follows=True)
    found = identify_by_likelihood(follows, recordings, false_terms=0.01, generator=np.random.default_rng(1))
    assert np.allclose(found.diffusion.matrix, np.diag([1.0, 0.0]))
    assert found.noise_rate[0, 0] == pytest.approx(noise, rel=0.05) and found.noise_rate[1, 1] == 0
    rate, error = -found.values[-1], np.sqrt(found.covariance[-1, -1])
    assert abs(rate - 1 / time) < 3 * error < rate
    # The force is c z, and in the unit of the estimate: its factor times what follows x at its rate.
    assert found.slow_force * found.values[-2] / rate == pytest.approx(strength, rel=0.3)
    states = filtered_recordings(found, recordings).values[200:]
    assert np.corrcoef(states[:, 1], path[200:, 1])[0, 1] > 0.99
    claims = check_claims(found, filtered_recordings(found, recordings), recordings, false_alarms=0.05)
    assert claims["state_complete"].passed and "gaussian_force" not in claims


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
        ("following", 1.0, True, True),
    ],
)
def test_a_gate_is_no_noise(kind: str, share: float, passed: bool, tested: bool) -> None:
    """Of a force of unit variance a filter knows a share; what it does not know is left out of it.

    One that follows what hops is spread as that is, and by its noise beside.
    """
    draw = np.random.default_rng(3)
    times = STEP * np.arange(COUNT)
    gate, noise = telegraph(draw, times, 2 * TIME), relaxation(draw, COUNT, TIME, step=STEP)
    force = gate if kind == "gate" else noise
    known = share * force + np.sqrt(share * (1 - share)) * relaxation(draw, COUNT, TIME, step=STEP)
    library = field_library(("x", "force_x"), IdentificationOptions(degree=1))
    slope, coefficients = 5.0 / TIME * (kind == "following"), np.zeros((library.size, 2))
    coefficients[library.terms.index(library.symbols[0]), 1] = slope
    found: Any = SimpleNamespace(
        values=np.array([slope, -1 / TIME]), noise_rate=2 / TIME * np.eye(2), library=library, slow_force=1.0,
        coefficients=coefficients, diffusion=Diffusion.identity(2), hidden_states=True,
        slow_sensor=None, diagnosis=None, exposure=None,
    )  # fmt: skip
    response = ObservationModel.of(found).following(gate, np.array([], int), found.values, STEP)
    seen = np.column_stack([gate, known + response])
    states = Recordings.from_arrays([times], [seen], names=["x", "force_x"])
    verdict = _gaussian_force(found, states, 1 / 160)
    assert (verdict.passed, verdict.tested) == (passed, tested)
