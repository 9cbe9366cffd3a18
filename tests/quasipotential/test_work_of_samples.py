"""What samples about paths of least action tell of ΔU/ε, where f is no polynomial and where it is one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from siq.data.recordings import Recordings, snapshot_pairs
from siq.inference.field_estimate import FieldEstimate
from siq.quasipotential.transitions import transitions, ways_out, with_work_of_samples
from siq.systems.phase_portrait import phase_portrait
from siq.workflow.pipeline import PipelineSettings, identify_run


def hopping(
    force: Callable[[np.ndarray], np.ndarray], *, seed: int, samples: int = 7500, states: int = 1
) -> Recordings:
    """Eight recordings of states pushed by a force ``(8, d)`` and by noise of intensity 0.4, begun at ±1."""
    draw, step, within = np.random.default_rng(seed), 0.02, 5
    state = np.zeros((8, states))
    state[:, 0] = np.sign(draw.standard_normal(8))
    path = np.empty((samples, 8, states))
    for sample in range(samples):
        for _ in range(within):
            kick = np.sqrt(0.4 * step / within) * draw.standard_normal(state.shape)
            state = state + step / within * force(state) + kick
        path[sample] = state
    times = [step * np.arange(samples)] * 8
    return Recordings.from_arrays(times, list(path.transpose(1, 0, 2)), names=["x", "y"][:states])


def springs(state: np.ndarray) -> np.ndarray:
    """-V' of two springs that meet about x = 0, where U has an edge."""
    return np.tanh(6 * state) - state


def turning(state: np.ndarray) -> np.ndarray:
    """The same in x, a spring in y, and half of both turned by a right angle: V stays as it is."""
    push, y = springs(state[:, 0]), state[:, 1]
    return np.column_stack([push + 0.5 * y, 0.5 * push - y])


def identified(recordings: Recordings, degree: int = 5) -> FieldEstimate:
    settings = PipelineSettings()
    settings = replace(settings, identification=replace(settings.identification, degree=degree))
    found = identify_run(settings, recordings, number=0).result
    assert found is not None
    return found


def heights(found: FieldEstimate, recordings: Recordings) -> list[tuple[float, float]]:
    """ΔU/ε of the ways between both wells, moved by what else f may be, and their standard errors."""
    assert found.noise_strength is not None
    portrait, (intensity, _) = phase_portrait(found.dynamics, recordings.values[::20]), found.noise_strength
    ways = transitions(found, ways_out(found.dynamics, portrait), [None, None])
    both = [(way.barrier / intensity, way.error / intensity) for way in ways if way.end is not None]
    assert len(both) == 2
    return both


@pytest.mark.slow
@pytest.mark.parametrize("states", [1, 2])
def test_samples_between_wells_mend_the_work_of_an_f_that_is_no_polynomial(states: int) -> None:
    recordings = hopping(springs if states == 1 else turning, seed=1, states=states)
    true = 2 / 0.4 * (np.log(np.cosh(6.0)) / 6 - 0.5)
    found = identified(recordings)
    assert found.prediction is not None and not found.prediction.passed
    assert "has a shape that no function" in found.prediction.reason
    for (height, error), (plain, _) in zip(
        heights(found, recordings), heights(replace(found, alternatives=None), recordings), strict=True
    ):
        assert abs(height - true) < 2.5 * error < 0.9
        assert plain < true - 0.7


def test_samples_between_wells_agree_with_an_f_of_the_library() -> None:
    chances, scores = [], []
    for seed in range(6):
        recordings = hopping(lambda x: x - x**3, seed=seed, samples=2500)
        found = identified(recordings, degree=3)
        portrait = phase_portrait(found.dynamics, recordings.values[::20])
        paths = [way.path for way in ways_out(found.dynamics, portrait) if way.path is not None]
        chances.append(with_work_of_samples(found, snapshot_pairs(recordings), paths)[1])
        scores += [(height - 0.5 / 0.4) / error for height, error in heights(found, recordings)]
    assert min(chances) > 1e-3
    assert 0.2 < np.median(chances) < 0.9
    assert np.sqrt(np.mean(np.square(scores))) < 1.5


@pytest.mark.parametrize(
    "force",
    [
        pytest.param(lambda x: np.tanh(6 * x) - x, marks=pytest.mark.slow, id="edge"),
        pytest.param(lambda x: x - x**3, id="cubic"),
    ],
)
def test_a_function_of_a_state_that_f_lacks_shows_among_several_states(
    force: Callable[[np.ndarray], np.ndarray],
) -> None:
    def both(state: np.ndarray) -> np.ndarray:
        x, y = state.T
        return np.column_stack([force(x) + 0.5 * y, -0.5 * force(x) - y])

    found = identified(hopping(both, seed=3, samples=2000, states=2), degree=3)
    assert found.prediction is not None
    right = force(np.array(2.0)) == -6.0
    assert found.prediction.passed == right
    assert ("as a function of a state" in found.prediction.reason) == (not right)
