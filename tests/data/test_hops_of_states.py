"""What a record itself says of its states: two wells are told from one state on a moving background."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from siq.data.kinetics import continued_visits
from siq.data.preparation import in_stretches, without_background
from siq.data.recordings import Recordings
from siq.data.states import SIGNIFICANCE, DwellCount, switching
from siq.data.stationarity import (
    background_of,
    correlated_samples,
    even_stretches,
    relaxation_samples,
    runs_of,
    usual_step,
)

STEP, COUNT = 0.05, 20_000
TIME = STEP * np.arange(COUNT)


def one_state(seed: int) -> np.ndarray:
    """An Ornstein–Uhlenbeck process of relaxation time 1 and standard deviation 1."""
    memory = np.exp(-STEP)
    kicks = np.sqrt(1 - memory**2) * np.random.default_rng(seed).standard_normal(COUNT)
    return np.asarray(lfilter([1.0], [1.0, -memory], kicks))


def two_states(seed: int, intensity: float, count: int = COUNT) -> np.ndarray:
    generator, x = np.random.default_rng(seed), np.empty(count)
    x[0] = 1.0
    kicks = np.sqrt(intensity * STEP) * generator.standard_normal(count)
    for k in range(count - 1):
        x[k + 1] = x[k] + STEP * (x[k] - x[k] ** 3) + kicks[k]
    return x


def recorded(*series: np.ndarray) -> Recordings:
    return Recordings.from_arrays(TIME[: len(series[0])], np.array(series)[:, :, None], names=["x"])


def from_level_to_level(x: np.ndarray, runs: list[slice]) -> np.ndarray:
    return continued_visits(np.select([x >= 1, x <= -1], [1, 0], -1), runs)


BACKGROUNDS = {
    "none": 0 * TIME,
    "linear": 8 * TIME / TIME[-1],
    "one and a half periods": 4 * np.sin(3 * np.pi * TIME / TIME[-1]),
    "five periods": 4 * np.sin(10 * np.pi * TIME / TIME[-1]),
    "ten periods": 3 * np.sin(20 * np.pi * TIME / TIME[-1]),
}


@pytest.mark.parametrize("background", BACKGROUNDS)
def test_one_state_on_a_slow_background_is_not_two(background: str) -> None:
    found = switching(recorded(one_state(0) + BACKGROUNDS[background]))
    assert found is not None and not found.supported


@pytest.mark.parametrize(
    ("background", "sensor"), [("none", 0.1), ("linear", 0.0), ("one and a half periods", 0.1)]
)
def test_two_wells_are_two(background: str, sensor: float) -> None:
    noise = sensor * np.random.default_rng(9).standard_normal(COUNT)
    found = switching(recorded(two_states(3, 0.25) + noise + BACKGROUNDS[background] / 20))
    assert found is not None and found.supported and 10 < found.transitions < 60


def test_two_wells_of_which_each_recording_shows_one_are_not_seen_to_hop() -> None:
    found = switching(recorded(two_states(0, 0.04), -two_states(1, 0.04)))
    assert found is not None and found.transitions == 0 and not found.supported


def test_visits_go_from_level_to_level() -> None:
    x = np.array([0.0, -1.0, 0.5, -0.5, 1.0, 0.0, 1.2, -1.0, 0.9])
    recordings = Recordings.from_arrays(np.arange(9.0), x[:, None], names=["x"])
    runs = runs_of(recordings)
    visits = from_level_to_level(x, runs)
    assert visits.tolist() == [-1, 0, 0, 0, 1, 1, 1, 0, 0]
    low, high = DwellCount.of_visits(recordings.t, visits, runs)
    assert (low, high) == (DwellCount(1, 4.0), DwellCount(1, 3.0))


def test_a_gap_in_time_ends_no_visit() -> None:
    t = np.array([0.0, 1.0, 2.0, 10.0, 11.0, 12.0])
    x = np.array([-1.0, -1.0, -1.0, 1.0, 1.0, -1.0])
    recordings = Recordings.from_arrays(t, x[:, None], names=["x"])
    runs = runs_of(recordings)
    low, high = DwellCount.of_visits(t, from_level_to_level(x, runs), runs)
    assert (low, high) == (DwellCount(0, 2.0), DwellCount(1, 2.0))


def test_a_mean_dwell_time_is_as_sure_as_its_visits_are_many() -> None:
    count = DwellCount(25, 100.0)
    assert count.mean == 4.0
    low, high = count.limits
    assert low < 2.8 and high > 6.0
    assert DwellCount(0, 7.0).limits[1] == np.inf


def test_interval_of_a_mean_dwell_time_covers() -> None:
    generator = np.random.default_rng(0)
    hops = generator.poisson(20.0, size=2000)
    covered = [low <= 1.0 <= high for low, high in (DwellCount(int(n), 20.0).limits for n in hops)]
    assert 0.94 < np.mean(covered) < 0.98


@pytest.mark.parametrize("scale", [1.0, 1e-8, 1e6])
def test_an_exponential_correlation_is_found(scale: float) -> None:
    recordings = recorded(*(scale * one_state(seed) for seed in range(4)))
    relaxation = relaxation_samples(recordings.values[:, 0], runs_of(recordings))
    assert relaxation is not None and 0.6 < relaxation * STEP < 1.3
    time = usual_step(recordings) * correlated_samples(recordings.values[:, 0], runs_of(recordings))
    assert time == pytest.approx(1.0, rel=0.15)


def test_only_a_background_that_is_there_is_found() -> None:
    still = recorded(one_state(5))
    assert not background_of(still, still.values[:, 0]).any()
    moving = recorded(one_state(5) + BACKGROUNDS["linear"])
    drift = background_of(moving, moving.values[:, 0])
    assert np.ptp(drift) == pytest.approx(8, rel=0.2)


def test_a_record_that_is_too_short_says_nothing() -> None:
    assert switching(recorded(one_state(0)[:40])) is None


def test_a_slow_drift_is_taken_off_and_said() -> None:
    drifting = recorded(one_state(2) + BACKGROUNDS["linear"])
    flat = without_background(drifting)
    assert "drifts slowly" in flat.notes[-1]
    assert abs(np.polyfit(flat.t, flat.values[:, 0], 1)[0]) < 1e-3
    still = recorded(one_state(2))
    assert without_background(still) is still


def test_hops_are_no_slow_drift() -> None:
    hopping = recorded(two_states(3, 0.25))
    assert without_background(hopping) is hopping


@pytest.mark.parametrize("seed", [*(pytest.param(one, marks=pytest.mark.slow) for one in (0, 2)), 1])
def test_hops_of_one_quantity_are_no_slow_drift_of_another(seed: int) -> None:
    """y follows the wells of x, and is spread so widely that it shows none by itself."""
    draw, path, state = np.random.default_rng(seed), np.empty((20_000, 2)), np.array([1.0, 0.6])
    for place in range(len(path) * 4):
        force = np.array([state[0] - state[0] ** 3, 0.6 * state[0] - state[1]])
        state = state + 0.015 * force + np.sqrt(0.12 * 0.015) * draw.standard_normal(2)
        path[place // 4] = state
    hopping = Recordings.from_arrays([0.06 * np.arange(len(path))], [path], names=["x", "y"])
    assert without_background(hopping) is hopping


def test_a_few_hops_explain_a_record_better_than_a_drift() -> None:
    """Five visits, and cosines that follow them closely."""
    path = np.repeat([0.0, 1.0, 0.0, 1.0, 0.0], [900, 1300, 400, 700, 1200])
    noise = lfilter([0.3], [1, -0.9], np.random.default_rng(0).standard_normal(len(path)))
    for scale in (1.5, 3.0):
        hopping = recorded(scale * path + noise)
        assert not background_of(hopping, hopping.values[:, 0]).any()


def test_a_long_trace_is_cut_by_its_own_correlation_time() -> None:
    quick, hopping = in_stretches(recorded(one_state(0))), in_stretches(recorded(two_states(3, 0.25)))
    assert len(quick.labels) == 40 and 10 <= len(hopping.labels) < 20


@pytest.mark.parametrize("seed", [0, 1])
def test_levels_of_a_digitiser_are_no_states(seed: int) -> None:
    white = np.random.default_rng(seed).standard_normal(5000)
    x = np.round(2 * lfilter([0.87], [1, -0.5], white))
    found = switching(Recordings.from_arrays(np.arange(5000.0), x[:, None], names=["x"]), rungs=False)
    assert found is not None and found.probability > SIGNIFICANCE and len(found.levels) == 1


def test_steps_that_a_clock_rounded_are_even() -> None:
    times = np.round(0.015625 * np.arange(2000), 3)  # 64 Hz, in milliseconds
    whole = even_stretches(Recordings.from_arrays(times, np.zeros((2000, 1)), names=["x"]))
    assert set(whole.number) == {0}
    draw = np.random.default_rng(0)
    uneven = np.cumsum(np.where(draw.random(2000) < 0.2, draw.uniform(0.9, 1.1, 2000), 1.0))
    apart = even_stretches(Recordings.from_arrays(uneven, np.zeros((2000, 1)), names=["x"]))
    assert len(set(apart.number)) > 100


def test_a_trend_that_is_no_hop_is_a_drift() -> None:
    t, generator = 7 * np.arange(600) / 365.25, np.random.default_rng(0)
    x = 60 * t / t[-1] + 3 * np.sin(2 * np.pi * t) + lfilter([0.3], [1, -0.9], generator.standard_normal(600))
    found = switching(Recordings.from_arrays(t, x[:, None], names=["x"]), rungs=False)
    assert found is not None and found.probability < SIGNIFICANCE  # no single state at rest
    assert not found.supported and np.ptp(found.background) == pytest.approx(60, rel=0.1)
