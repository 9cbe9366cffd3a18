from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from remembering import STEP, double_wells, trap

from siq.data.correlation import markov_lag
from siq.data.recordings import Recordings
from siq.errors import NumericalFailure
from siq.inference.checks import mean_residual_probability
from siq.inference.field_estimate import FieldEstimate
from siq.inference.library import IdentificationOptions, field_library
from siq.inference.regression import coarse_pairs, identify_vector_field, lagged_pairs, lost_time, refit
from siq.quasipotential.landscape import Landscape
from siq.workflow.pipeline import PipelineSettings, identify_run as identify_step

OPTIONS = IdentificationOptions(degree=3)


def recorded(values: np.ndarray) -> Recordings:
    names = ["x", "y"][: values.shape[2]]
    return Recordings.from_arrays(np.arange(values.shape[1]) * STEP, values, names=names)


def identified(recordings: Recordings, lag: int) -> FieldEstimate:
    library = field_library(recordings.names, OPTIONS)
    return identify_vector_field(library, lagged_pairs(recordings, lag), options=OPTIONS)


@pytest.mark.parametrize(
    ("given", "lag"), [({"memory": 5.0}, 24), ({"exposure": 1.0}, 2), ({"exposure": 4.0, "sensor": 0.005}, 5)]
)
def test_f_and_the_strength_of_the_forces_are_those_behind_the_memory(
    given: dict[str, float], lag: int
) -> None:
    found = identified(recorded(double_wells(1, states=2, **given)), lag)
    terms = {(found.library.states[i], found.library.names[k]) for i, k in found.support}
    assert terms == {("x", "x"), ("x", "x**3"), ("y", "y")}
    exact = {"x": 1.0, "x**3": -1.0, "y": -1.0}
    for (_, k), value, error in zip(
        found.support, found.values, np.sqrt(np.diag(found.covariance)), strict=True
    ):
        assert abs(value - exact[found.library.names[k]]) < 3 * error
        assert error < 0.06
    np.testing.assert_allclose(np.diag(found.noise_rate), 0.2, rtol=0.06)


def test_errors_are_right_though_pairs_overlap() -> None:
    scores = []
    for seed in range(12):
        recordings = recorded(trap(seed, exposure=2.0, samples=8_000))
        found = identified(recordings, 3)
        assert [found.library.names[k] for _, k in found.support] == ["x"]
        scores.append((found.values[0] + 5.0) / np.sqrt(found.covariance[0, 0]))
    assert 0.5 < np.sqrt(np.mean(np.square(scores))) < 1.6


def test_lost_time_is_the_memory_or_a_third_of_the_exposure() -> None:
    for given, lag, lost in (({"memory": 3.0}, 15, 3 * STEP), ({"exposure": 3.0}, 4, STEP)):
        recordings = recorded(double_wells(2, samples=10_000, **given))
        found = identified(recordings, lag)
        assert lost_time(found, lagged_pairs(recordings, lag))[0] == pytest.approx(lost, rel=0.2)


def test_coarse_pairs_do_not_overlap() -> None:
    recordings = Recordings.from_arrays(np.arange(11.0), np.arange(22.0).reshape(2, 11, 1), names=["x"])
    pairs = coarse_pairs(recordings, 3, lost=0.5)
    assert pairs.x0[:, 0].tolist() == [0, 3, 6, 11, 14, 17]
    assert pairs.xh[:, 0].tolist() == [3, 6, 9, 14, 17, 20]
    assert set(pairs.h) == {2.5}
    assert pairs.recording.tolist() == [0, 0, 0, 1, 1, 1]


def test_held_out_residuals_have_a_mean_for_a_wrong_f_alone() -> None:
    recordings = recorded(double_wells(4, memory=3.0, samples=10_000))
    held = np.arange(8) >= 6
    training, unseen = (lagged_pairs(recordings.select(np.flatnonzero(some)), 15) for some in (~held, held))
    fitted = refit(identified(recordings, 15), training)
    seen = len(training.h)
    assert mean_residual_probability(fitted, unseen, seen=seen) > 1e-3
    wrong = fitted.coefficients * 3
    assert mean_residual_probability(replace(fitted, coefficients=wrong), unseen, seen=seen) < 1e-4


def test_gaps_everywhere_are_refused_in_a_sentence() -> None:
    recordings = Recordings.from_arrays(np.arange(5.0), np.zeros((3, 5, 1)), names=["x"])
    with pytest.raises(NumericalFailure, match="record longer without gaps"):
        lagged_pairs(recordings, 10)


def test_the_step_says_that_it_looked_from_earlier() -> None:
    recordings = recorded(double_wells(1, memory=3.0, samples=10_000))
    found = identify_step(PipelineSettings(), recordings, number=0)
    assert found.result is not None
    assert found.result.memory is not None
    assert found.result.prediction.passed
    assert "the recordings are Markovian" in found.outcome.reason
    strength = found.result.noise_strength
    assert strength is not None
    assert abs(strength[0] - 0.2) < 4 * strength[1]


@pytest.mark.slow
@pytest.mark.parametrize(
    "given",
    [
        {"memory": 5.0},
        {"memory": 2.0, "states": 2},
        {"exposure": 1.0},
        {"exposure": 4.0, "states": 2},
        {"exposure": 1.5},
        {"exposure": 10.0},
    ],
)
@pytest.mark.parametrize("seed", [1, 2])
def test_barriers_are_certified_and_right(given: dict[str, float], seed: int) -> None:
    recordings = recorded(double_wells(seed, **given))  # type: ignore[arg-type]
    assert markov_lag(recordings).remembers
    landscape = Landscape.from_recordings(recordings)
    assert landscape.certificate is not None
    assert landscape.certificate.certified
    barriers = landscape.barriers()
    assert len(barriers) == 2
    assert (abs(barriers["barrier"] - 0.5) < 3 * barriers["standard_error"]).all()
