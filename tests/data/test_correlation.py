from __future__ import annotations

import numpy as np
import pytest
from remembering import STEP, double_wells, trap

from siq.data.correlation import (
    Kind,
    MarkovLag,
    _displacement,
    _increment_covariances,
    markov_lag,
)
from siq.data.recordings import Recordings
from siq.data.stationarity import even_stretches, lagged_covariances, long_run_covariance


def recorded(values: np.ndarray, step: float = STEP) -> Recordings:
    names = ["x", "y", "z"][: values.shape[2]]
    return Recordings.from_arrays(np.arange(values.shape[1]) * step, values, names=names)


def looked_at(values: np.ndarray) -> MarkovLag:
    return markov_lag(recorded(values))


@pytest.mark.parametrize("memory", [2.0, 5.0, 10.0])
def test_coloured_forces_are_recognised_with_their_memory(memory: float) -> None:
    found = looked_at(double_wells(1, memory=memory))
    assert found.kind == "coloured"
    assert found.remembers
    assert found.memory == pytest.approx(memory * STEP, rel=0.15)
    assert found.lag is not None
    assert 2.5 * memory < found.lag < 8 * memory


@pytest.mark.parametrize(("exposure", "lag", "states"), [(1.0, 2, 1), (3.0, 4, 2), (4.0, 5, 1)])
def test_an_exposure_is_recognised_with_its_length(exposure: float, lag: int, states: int) -> None:
    found = looked_at(double_wells(2, exposure=exposure, states=states, samples=10_000))
    assert found.kind == "blur"
    assert found.memory == pytest.approx(exposure * STEP, rel=0.05)
    assert found.lag is not None
    assert lag <= found.lag <= lag + 1  # one in twenty times chance adds a step


def test_a_blurred_trap_is_recognised() -> None:
    found = looked_at(trap(1, exposure=1.0))
    assert found.kind == "blur"
    assert found.memory == pytest.approx(STEP, rel=0.1)


def test_an_exposure_with_an_error_of_the_sensor_shows_both() -> None:
    found = looked_at(double_wells(1, exposure=3.0, sensor=0.01))
    assert found.kind == "blur"
    assert found.memory == pytest.approx(3 * STEP, rel=0.05)
    assert found.sensor[0] == pytest.approx(0.01, rel=0.1)


@pytest.mark.parametrize("sensor", [0.01, 0.05])
def test_an_error_of_the_sensor_is_no_memory(sensor: float) -> None:
    found = looked_at(double_wells(1, sensor=sensor, samples=10_000))
    assert found.kind == "sensor"
    assert not found.remembers
    assert found.sensor[0] == pytest.approx(sensor, rel=0.1)


def jittered(errors: float, seed: int = 1) -> np.ndarray:
    """A double well whose samples are taken as many steps earlier or later, by normal errors."""
    fine = double_wells(seed, samples=320_000, traces=1, intensity=0.3)[0, :, 0]
    late = errors * np.random.default_rng(seed).standard_normal(20_000)
    return fine[np.clip(np.round(16 * (np.arange(20_000) + late)), 0, len(fine) - 1).astype(int)][
        None, :, None
    ]


@pytest.mark.parametrize("errors", [0.8, 1.2])
def test_a_clock_with_errors_is_told_from_a_sensor_with_errors(errors: float) -> None:
    found = markov_lag(recorded(jittered(errors), 16 * STEP))
    assert found.kind == "clock" and not found.remembers
    assert found.memory == pytest.approx(errors * 16 * STEP, rel=0.15)
    heavy = jittered(0.0)
    heavy += 0.15 * np.random.default_rng(0).standard_t(4, heavy.shape)
    assert [markov_lag(recorded(heavy[:, :n], 16 * STEP)).kind for n in (2000, 20_000)] == ["sensor"] * 2


def test_white_noise_raises_no_alarm() -> None:
    """One in a thousand is allowed; of forty records none is one with a memory."""
    draw = np.random.default_rng(5)
    x = np.where(np.arange(40) % 2 == 0, 1.0, -1.0)
    path = np.empty((10_000, 40))
    for k in range(len(path)):
        path[k] = x
        for _ in range(2):
            x = x + STEP / 2 * (x - x**3) + np.sqrt(0.2 * STEP / 2) * draw.standard_normal(40)
    kinds = [looked_at(path.T[one : one + 1, :, None]).kind for one in range(40)]
    assert kinds.count("white") >= 39
    assert not {"blur", "coloured", "either", "memory", "hidden"} & set(kinds)


def test_a_missing_velocity_is_no_memory_that_ends() -> None:
    draw = np.random.default_rng(2)
    x, v = 1.0, 0.0
    path = np.empty(20_000)
    for k in range(len(path) * 4):
        x, v = x + 0.0025 * v, v + 0.0025 * (-4 * x - 0.3 * v) + np.sqrt(0.0025) * draw.standard_normal()
        if k % 4 == 0:
            path[k // 4] = x
    found = looked_at(path[None, :, None])
    assert found.kind == "hidden"
    assert found.lag is None


def test_what_has_no_noise_or_too_few_samples_is_said() -> None:
    t = np.linspace(0, 3, 301)
    starts = np.random.default_rng(0).uniform(-1.5, 1.5, (30, 1))
    quiet = starts * np.exp(-t)
    assert looked_at(quiet[:, :, None]).kind == "none"
    assert looked_at(quiet[:1, :40, None]).kind == "unknown"


def test_uneven_samples_show_noise_of_the_sensor_and_no_memory_and_quiet_ones_tell_nothing() -> None:
    random = np.random.default_rng(3)
    x = double_wells(1, samples=40_000)[0]
    at = np.cumsum(random.integers(1, 8, size=9_000))
    at = at[at < len(x)]
    white = Recordings.from_arrays(0.1 * at, x[at], names=["x"])
    assert markov_lag(white).kind == "white"
    noisy = 0.3 * random.standard_normal((len(at), 1))
    sensor = markov_lag(Recordings.from_arrays(0.1 * at, x[at] + noisy, names=["x"]))
    assert sensor.kind == "sensor"
    assert sensor.sensor[0] == pytest.approx(0.3, rel=0.15)
    t = np.cumsum(random.uniform(0.02, 0.06, (30, 100)), axis=1)
    quiet = random.uniform(-1.5, 1.5, (30, 1)) * np.exp(-t)
    parts = np.repeat(np.arange(30), 100)
    given = Recordings(("x",), (None,), tuple(map(str, range(30))), parts, t.ravel(), quiet.reshape(-1, 1))
    assert markov_lag(given).kind == "unknown"


def test_a_sensor_that_hides_the_relaxation_of_neighbours_has_no_memory() -> None:
    x = double_wells(1, samples=20_000)
    found = looked_at(x + np.random.default_rng(0).standard_normal(x.shape))
    assert found.kind == "sensor" and found.sensor[0] == pytest.approx(1.0, rel=0.05)
    assert found.relaxation > 4 * found.step


def test_units_change_nothing() -> None:
    values = double_wells(3, memory=3.0, samples=5_000)
    one, other = looked_at(values), looked_at(1e-6 * values + 4.0)
    assert (one.kind, one.lag) == (other.kind, other.lag)
    np.testing.assert_allclose(one.correlations, other.correlations, atol=1e-6)


def test_stretches_end_at_gaps_and_recordings() -> None:
    t = np.array([0.0, 1, 2, 3, 5, 6, 7, 0, 1, 2])
    recording = np.repeat([0, 1], [7, 3])
    given = Recordings(("x",), (None,), ("a", "b"), recording, t, np.zeros((10, 1)))
    found = even_stretches(given)
    assert found.step == 1.0
    assert found.within(0).tolist() == [0, 1, 2, 4, 5, 7, 8]
    assert found.within(1).tolist() == [0, 1, 4, 7]
    assert found.within(2).tolist() == [0]


def test_long_run_covariance_is_that_of_sums() -> None:
    kicks = np.random.default_rng(0).standard_normal((200_000, 1))
    moving = kicks[2:] + 0.5 * kicks[1:-1] + 0.25 * kicks[:-2]
    covariances = lagged_covariances(moving, np.zeros(len(moving), dtype=int), 4)
    assert covariances[:4, 0, 0] == pytest.approx([1.3125, 0.625, 0.25, 0.0], abs=0.02)
    assert long_run_covariance(covariances, 2)[0, 0] == pytest.approx(1.75**2, rel=0.02)


@pytest.mark.parametrize("kind", ["blur", "coloured", "clock"])
def test_displacements_are_those_of_simulated_forces(kind: Kind) -> None:
    """Over long times all of σ² is seen, and without a memory nothing is correlated."""
    own = _increment_covariances(_displacement(kind, np.arange(400), 3.0))
    assert own[0] + 2 * own[1:].sum() == pytest.approx(1.0, abs=1e-9)
    none = _increment_covariances(_displacement(kind, np.arange(5), 0.0))
    assert none == pytest.approx([1, 0, 0, 0])


def test_an_exposure_of_one_step_correlates_neighbours_by_a_quarter() -> None:
    own = _increment_covariances(_displacement("blur", np.arange(5), 1.0))
    assert own == pytest.approx([2 / 3, 1 / 6, 0, 0])


def test_what_fifty_columns_remember_is_asked_in_as_many_functions() -> None:
    """Of all products of fifty powers the few of low degree would never be picked out."""
    walks = np.cumsum(np.random.default_rng(0).standard_normal((1, 4000, 50)), axis=1)
    found = markov_lag(Recordings.from_arrays(np.arange(4000.0), walks, names=[f"x{k}" for k in range(50)]))
    assert found.kind == "white"


def test_an_angle_that_turns_remembers_nothing() -> None:
    """Three wells in a turn, many turns: no polynomial is the mean of its increments, and its waves are."""
    draw, step, x = np.random.default_rng(4), 0.02, np.zeros(20_000)
    for k in range(1, len(x)):
        x[k] = x[k - 1] + step * (1.0 - 6 * np.sin(3 * x[k - 1])) + np.sqrt(3 * step) * draw.standard_normal()
    assert np.ptp(x) > 20 * np.pi
    recordings = recorded(np.degrees(x)[None, :, None], step)
    assert markov_lag(recordings).kind != "white"
    assert markov_lag(recordings, angles={"x": (0, 360)}).kind == "white"
