"""What was cut is put together again where it belongs together, and nowhere else."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import scipy.signal
from remembering import double_wells

from siq.data.preparation import (
    _checked_for_learning,
    in_stretches,
    joined,
    outliers,
    unusual,
    without_faults,
    without_velocity,
)
from siq.data.recordings import Recordings
from siq.data.stationarity import runs_of


def walk(labels: int = 1) -> Recordings:
    """Walks that forget within twenty steps."""
    generator = np.random.default_rng(3)
    x = np.zeros((labels, 2000, 1))
    for k in range(1999):
        x[:, k + 1] = 0.95 * x[:, k] + generator.standard_normal((labels, 1))
    return Recordings.from_arrays(0.1 * np.arange(2000), x, names=["x"])


def test_stretches_of_one_recording_are_one_run_again() -> None:
    whole = walk()
    cut = in_stretches(whole)
    assert len(cut.labels) > 1
    again = joined(cut)
    assert again.labels == whole.labels
    assert len(runs_of(again)) == 1 and len(runs_of(cut)) == len(cut.labels)
    assert np.array_equal(again.values, whole.values)


def test_stretches_that_do_not_follow_each_other_stay_apart() -> None:
    cut = in_stretches(walk())
    without = cut.select([0, 1, 3, 4, 5])
    assert [run.stop - run.start for run in runs_of(joined(without))] == [
        int((without.recording < 2).sum()),
        int((without.recording >= 2).sum()),
    ]
    drawn = cut.resampled(generator=np.random.default_rng(0))
    assert len(set(joined(drawn).labels)) == len(joined(drawn).labels)


def test_recordings_that_nobody_cut_stay_as_they_are() -> None:
    several = walk(3)
    assert joined(several) is several
    named = replace(several, labels=("run (1 of 3)", "run (3 of 3)", "other (2 of 3)"))
    assert joined(named) is named


def hopping(seed: int = 1) -> np.ndarray:
    """A double well of 20,000 samples, twelve of them a relaxation time."""
    return double_wells(seed, samples=80_000, traces=1, intensity=0.3)[0, ::4]


def seen(values: np.ndarray) -> Recordings:
    return Recordings.from_arrays(0.04 * np.arange(len(values)), values, names=["x", "y"][: values.shape[1]])


def test_samples_that_stand_apart_are_left_out_and_nothing_else() -> None:
    x, generator = hopping(), np.random.default_rng(0)
    rows = np.sort(generator.choice(np.arange(5, len(x) - 5, 7), 30, replace=False))
    spoiled = x.copy()
    spoiled[rows, 0] += np.where(generator.random(30) < 0.5, -1, 1) * generator.uniform(2, 20, 30)
    found = without_faults(seen(spoiled))
    np.testing.assert_array_equal(found.t, np.delete(0.04 * np.arange(len(x)), rows))
    assert "data.samples_apart" in {one.code for one in found.remarks}
    assert without_faults(seen(x)).values.shape == x.shape


def test_of_samples_with_a_clock_that_errs_those_are_kept_that_are_in_order() -> None:
    fine = double_wells(2, samples=320_000, traces=1, intensity=0.3)[0]
    late = np.random.default_rng(2).standard_normal(20_000)
    x = fine[np.clip(np.round(16 * (np.arange(20_000) + late)), 0, len(fine) - 1).astype(int)]
    x = x + 1e-4 * np.random.default_rng(3).standard_normal(x.shape)  # values that repeat were filled in
    found = without_faults(Recordings.from_arrays(0.16 * np.arange(len(x)), x, names=["x"]))
    (told,) = (one.values for one in found.remarks if one.code == "data.clock")
    assert told["error"] == pytest.approx(0.16, rel=0.15) and 5 <= told["every"] <= 7
    np.testing.assert_array_equal(found.values, x[:: told["every"]])


def test_faults_that_follow_each_other_or_are_just_too_small_are_no_jumps() -> None:
    x, rows = hopping(), np.arange(50, 19_950, 500)
    usual = float(np.median(np.abs(np.diff(x[:, 0])))) / 0.6745
    spoiled = x.copy()
    spoiled[rows, 0] += 12.0 * usual
    spoiled[rows[:6] + 1, 0] -= 9.0 * usual  # a second fault behind the first
    small = rows[6:10] + 200  # of two steps one is large: the state itself moves back as the fault ends
    spoiled[small, 0] = x[small - 1, 0] + 5.9 * usual
    spoiled[small + 1, 0] = x[small - 1, 0] + 1.5 * usual
    found = without_faults(seen(spoiled))
    left_out = np.setdiff1d(np.arange(len(x)), np.round(found.t / 0.04).astype(int))
    assert set(rows) | set(rows[:6] + 1) <= set(left_out) and len(left_out) < len(rows) + 30


def held(x: np.ndarray, generator: np.random.Generator, *, every: int = 0) -> np.ndarray:
    """Values that stay until the next one is measured, every so many samples or at half of them."""
    fresh = np.arange(len(x)) % every == 0 if every else generator.random(len(x)) < 0.5
    return x[np.maximum.accumulate(np.where(fresh, np.arange(len(x)), 0))]


@pytest.mark.parametrize("every", [0, 2, 9])
@pytest.mark.parametrize("digits", [2, 12])
def test_values_that_are_held_are_left_out(every: int, digits: int) -> None:
    x = np.round(hopping(), digits)
    found = without_faults(seen(held(x, np.random.default_rng(0), every=every)))
    assert "data.filled_left_out" in {one.code for one in found.remarks}
    rows = np.round(found.t / 0.04).astype(int)
    np.testing.assert_array_equal(found.values, x[rows])
    assert len(rows) > 0.95 * len(x) / (every or 2)  # rounded values repeat themselves here and there
    together = without_faults(seen(np.column_stack([x, held(x, np.random.default_rng(0), every=every)])))
    np.testing.assert_array_equal(together.values, x[np.round(together.t / 0.04).astype(int)] * [1, 1])


@pytest.mark.parametrize("digits", [3, 12])
def test_gaps_that_are_filled_along_straight_lines_are_gaps(digits: int) -> None:
    x, rows = hopping(), np.arange(20_000)
    gap = rows // 37 % 5 == 0
    lines = np.interp(rows, rows[~gap], x[~gap, 0])[:, None]
    found = without_faults(seen(np.round(lines, digits)))
    left = np.round(found.t / 0.04).astype(int)
    assert gap[left].sum() <= 0.02 * gap.sum()
    assert len(left) > 0.98 * (~gap).sum()


def test_what_a_sensor_repeats_is_not_taken_for_filled_in() -> None:
    x, dead = hopping(), hopping()
    for k in range(1, len(x)):  # it stays until it is moved far enough
        dead[k] = x[k] if abs(x[k] - dead[k - 1]) >= 0.25 else dead[k - 1]
    apart = np.column_stack([np.repeat(x[::4], 4, axis=0), np.roll(np.repeat(x[1::4], 4, axis=0), 2)])
    anew = np.column_stack([x, np.repeat(np.random.default_rng(0).normal(size=len(x) // 500), 500)])
    for values in (np.clip(x, -1, 0.9), np.round(x, 1), np.round(x / 0.3) * 0.3, dead, apart, anew):
        assert len(without_faults(seen(values)).t) == len(x)


def test_one_number_for_a_fault_is_left_out_where_it_stands_twice_in_a_row_too() -> None:
    x = 10 + hopping()
    lost = np.random.default_rng(0).random(len(x)) < 0.005
    lost[[0, 1, -2, -1, 100, 101]] = [False, False, False, False, True, True]
    found = without_faults(seen(np.where(lost[:, None], 0.0, x)))
    np.testing.assert_array_equal(found.values, x[~lost])


@pytest.mark.parametrize("share", [0.02, 0.08])
def test_one_number_for_a_fault_is_left_out_where_it_is_frequent_and_hides_the_noise(share: float) -> None:
    x = hopping()
    lost = np.random.default_rng(0).random(len(x)) < share
    lost[[0, 1, -2, -1]] = False
    found = without_faults(seen(np.where(lost[:, None], -99.0, x)))
    np.testing.assert_array_equal(found.values, x[~lost])


def test_an_angle_that_counts_its_turns_is_told_from_what_only_wanders() -> None:
    generator, phase = np.random.default_rng(0), 0.4
    steps = 0.3 * generator.standard_normal(20_000)
    turning = np.zeros(len(steps))
    for k, step in enumerate(steps):
        turning[k] = phase = phase + 0.1 * (0.5 - np.sin(phase)) + step
    wandering = scipy.signal.lfilter([1], [1, -0.999], steps)
    found = unusual(seen(np.column_stack([turning, wandering])))
    assert [(one.code, one.values["column"]) for one in found] == [("data.unwrapped_angle", "x")]


def test_an_angle_that_goes_too_far_in_a_step_is_left_out_beside_a_state() -> None:
    generator = np.random.default_rng(1)
    veers = (
        generator.random(8000) < 0.1
    )  # as the wind does from one hour to the next, written in tens of degrees
    turned = np.where(veers, generator.uniform(-180, 180, 8000), 12 * generator.standard_normal(8000))
    direction = np.round(np.cumsum(turned) % 360 / 10) * 10
    speed, white = generator.standard_normal(8000), generator.uniform(0, 360, 8000)
    wind = Recordings.from_arrays(
        0.1 * np.arange(8000), np.stack([direction, speed, white], axis=1)[None], names=["dir", "v", "w"]
    )
    found = _checked_for_learning(wind, file="", chosen=False)
    assert (found.names, [one.code for one in found.remarks]) == (wind.names[1:], ["data.wrapped_angle"])
    wanted = _checked_for_learning(wind, file="", chosen=True)
    assert (wanted.names, [one.code for one in wanted.remarks]) == (wind.names, ["data.wrapped_angle"])


def test_a_state_without_noise_is_no_fault() -> None:
    x = 10 + hopping()
    closed = np.arange(len(x)) // 40 % 100 == 50
    assert len(without_faults(seen(np.where(closed[:, None], 0.0, x))).t) == len(x)


def test_what_jumps_and_stays_is_the_states_own() -> None:
    x = hopping()
    jumps = 3.0 * (np.arange(len(x)) // 1500 % 2)
    jumps[5000] += 8.0
    assert len(without_faults(seen(x + jumps[:, None])).t) == len(x)


def test_a_hum_is_taken_off_to_its_phase() -> None:
    x, t = hopping(), 0.04 * np.arange(20_000)
    hum = 0.2 * np.sin(2 * np.pi * t / 0.313 + 0.4)
    found = without_faults(seen(x + hum[:, None]))
    assert float(np.std(found.values - x)) < 0.02 * np.std(hum)
    told = next(one.values for one in found.remarks if one.code == "data.hum_taken_off")
    assert told["period"] == pytest.approx(0.313, rel=1e-4)
    assert told["amplitude"] == pytest.approx(0.2, rel=0.02)


def test_a_slight_hum_is_taken_off_where_it_is_of_the_mains() -> None:
    """Of a frequency that no grid has it may be a force, and is left to the certificate."""
    x = hopping()
    given = Recordings.from_arrays(np.arange(len(x)), x, names=["x"], time_unit="ms")
    turns = 2 * np.pi * given.t / 1000
    lines = np.array([0.035 * np.sin(60 * turns), 0.013 * np.cos(180 * turns)])
    assert (np.diff(lines).var(axis=1) < 1e-2 * np.diff(x, axis=0).var()).all()
    hum = lines.sum(axis=0)[:, None]
    found = without_faults(replace(given, values=x + hum))
    periods = [one.values["period"] for one in found.remarks if one.code == "data.hum_taken_off"]
    assert sorted(periods) == pytest.approx([1000 / 180, 1000 / 60], rel=1e-3)
    assert float(np.std(found.values - x)) < 0.4 * float(np.std(hum))
    other = replace(given, values=x + 0.035 * np.sin(70 * turns)[:, None])
    assert without_faults(other) is other


@pytest.mark.parametrize(("hum", "force"), [(0.0, 0.0), (0.08, 0.0), (0.3, 0.0), (0.0, 120.0), (0.0, 480.0)])
def test_hops_hide_no_hum_of_the_mains_and_a_force_is_none(hum: float, force: float) -> None:
    """They have more power at its frequency, until the mean step from each state is taken off."""
    draw, step, x = np.random.default_rng(4), 2e-5, np.ones(100_000)
    t = step * np.arange(len(x))
    moved = step * force * np.cos(2 * np.pi * 50 * t) + np.sqrt(276 * step) * draw.normal(size=len(x))
    for k in range(1, len(x)):  # dx = (1200 (x - x³) + force) dt, D = 138 per second
        x[k] = x[k - 1] + 1200 * step * (x[k - 1] - x[k - 1] ** 3) + moved[k]
    measured = x + hum * np.sin(2 * np.pi * 50 * t + 0.4) + 0.03 * draw.normal(size=len(x))
    given = Recordings.from_arrays(t, measured[:, None], names=["x"], time_unit="s")
    found = without_faults(given)
    told = [one.values for one in found.remarks if one.code == "data.hum_taken_off"]
    assert [round(1 / one["period"]) for one in told] == ([50] if hum else [])
    if told:
        assert told[0]["amplitude"] == pytest.approx(hum, rel=0.2)
        left = (found.values - given.values)[:, 0] + measured - x
        assert abs(np.mean(left * np.exp(100j * np.pi * t))) < 0.2 * hum / 2


def test_how_recordings_begin_is_no_season() -> None:
    t = 2.0 * np.arange(600)  # less than a day
    x = hopping()[: 20 * 600].reshape(20, 600, 1) + 25 * np.exp(-t / 60)[:, None]
    recordings = Recordings.from_arrays(t, x, names=["x"], time_unit="min")
    assert "data.season_taken_off" not in {one.code for one in without_faults(recordings).remarks}


@pytest.mark.parametrize(
    ("unit", "step"), [("h", 1.0), ("d", 1.0), ("year", 1 / 12)], ids=["day", "year", "months"]
)
def test_what_recurs_each_day_or_year_is_taken_off(unit: str, step: float) -> None:
    x = hopping()[:12_000]
    given = Recordings.from_arrays(step * np.arange(len(x)), x, names=["x"], time_unit=unit)
    turns = 2 * np.pi * given.t / {"h": 24.0, "d": 365.2425, "year": 1.0}[unit]
    season = np.cos(turns) + 0.5 * np.sin(2 * turns + 1)
    found = without_faults(replace(given, values=x + season[:, None]))
    assert float(np.std(found.values - x)) < 0.1 * np.std(season)
    assert [one.values["period"] for one in found.remarks] == ["day" if unit == "h" else "year"]
    assert without_faults(given) is given  # which has none
    # Neither has what has another period, or whose phase is another one each time.
    other = np.cos(turns / 1.3)
    found = without_faults(replace(given, values=x + other[:, None]))
    assert not any(one.code == "data.season_taken_off" for one in found.remarks)


def test_a_column_at_rest_has_no_faults() -> None:
    given = seen(np.column_stack([hopping()[:, 0], np.zeros(20_000)]))
    assert without_faults(given) is given


def test_a_hum_below_the_step_of_a_digitiser_is_left() -> None:
    hum = 0.45 * np.sin(2 * np.pi * 0.04 * np.arange(20_000) / 0.313)
    given = seen(np.round(5 * hopping() + hum[:, None]))
    assert without_faults(given) is given  # less it, levels are apart by less than they were written with


def test_a_noisy_limit_cycle_is_no_hum() -> None:
    generator, state = np.random.default_rng(2), np.array([1.0, 0.0])
    path = np.empty((8000, 2))
    for row in range(len(path)):
        path[row] = state
        x, y = state
        grows = 1 - x**2 - y**2
        force = np.array([x * grows - 3 * y, y * grows + 3 * x])
        state = state + 0.04 * force + 0.02 * generator.standard_normal(2)
    given = seen(path)
    assert without_faults(given) is given


def test_a_state_far_from_zero_is_moved_by_a_round_number_and_called_so() -> None:
    near = np.random.default_rng(0).uniform(-3, 3, (500, 2))
    values = near + np.array([101325.4, 5.0])
    table = Recordings.from_arrays(np.arange(500.0), values, names=["p", "x"])
    found = table.centred(degree=5)
    assert found.names == ("p_minus_101325", "x") and found.titles == ("p − 101325", "x")
    assert found.values == pytest.approx(values - [101325, 0])
    assert table.centred(degree=1) is table  # a line through zero tells no more of its origin


def oscillator(position_noise: float, velocity_noise: float, sensor: float = 0.0) -> Recordings:
    """Two recordings of a damped oscillator at random, by steps a twentieth of the sampling."""
    draw = np.random.default_rng(2)
    x, v = np.array([1.0, -0.5]), np.zeros(2)
    rows = []
    for step in range(1500 * 20):
        if step % 20 == 0:
            rows.append([x, v])
        x, v = (
            x + 0.005 * v + position_noise * np.sqrt(0.005) * draw.standard_normal(2),
            v + 0.005 * (-x - 0.5 * v) + velocity_noise * np.sqrt(0.005) * draw.standard_normal(2),
        )
    values = np.moveaxis(np.array(rows), (0, 1, 2), (1, 2, 0))
    values[:, :, 0] += sensor * draw.standard_normal(values.shape[:2])
    return Recordings.from_arrays(0.1 * np.arange(1500), values, names=["x", "v"])


def test_a_velocity_on_which_all_noise_acts_is_found_again_from_its_position() -> None:
    found = without_velocity(oscillator(0, 0.6))
    assert found.names == ("x",) and found.remarks[-1].code == "data.velocity_found_again"
    assert without_velocity(oscillator(0, 0.6, sensor=0.005)).names == ("x",)
    exchanged = oscillator(0, 0.6)
    exchanged = replace(exchanged, names=("v", "x"), values=exchanged.values[:, ::-1])
    assert without_velocity(exchanged).names == ("x",)


@pytest.mark.parametrize("noises", [(0.3, 0.6), (0.3, 0), (0, 0)])
def test_noise_of_a_position_and_relaxations_keep_the_velocity(noises: tuple[float, float]) -> None:
    assert without_velocity(oscillator(*noises)).names == ("x", "v")


def bouncing(t: np.ndarray) -> np.ndarray:
    """A motion with kinks, such as a ball has that bounces, and with jumps, such as a voltage has."""
    return np.abs(np.sin(1.3 * t)) + np.where(t % 4.1 < 2, 0.5, 0.0)


@pytest.mark.parametrize("motion", [np.cos, bouncing])
@pytest.mark.parametrize("noise", [1e-9, 0.01])
def test_outliers_of_a_smooth_motion_are_told_from_kinks_and_jumps(
    motion: Callable[[np.ndarray], np.ndarray], noise: float
) -> None:
    generator = np.random.default_rng(7)
    t, inputs = np.tile(0.05 * np.arange(500), 3), np.zeros((0, 1500))
    recording, x = np.repeat(np.arange(3), 500), motion(t) + noise * generator.standard_normal(1500)
    assert not outliers(t, x, recording, inputs).any()
    spoiled, rows = x.copy(), np.sort(generator.choice(np.arange(10, 1490, 10), 30, replace=False))
    rows = rows[(t[rows] > 0.2) & (t[rows] < 24.8)]
    spoiled[rows] += np.where(generator.random(len(rows)) < 0.5, -1, 1) * generator.uniform(0.7, 9, len(rows))
    spoiled[700:704] = -3.0  # the sensor drops out
    spoiled[3] = np.nan
    found = np.flatnonzero(outliers(t, spoiled, recording, inputs))
    expected = np.union1d(rows, np.arange(700, 704))
    assert set(found) <= set(expected)
    assert len(found) >= (1.0 if motion is np.cos else 0.75) * len(expected)


def test_beside_a_pulse_of_an_input_nothing_is_an_outlier() -> None:
    t, kick = 0.05 * np.arange(600), np.zeros((1, 600))
    kick[0, 100:600:100] = 1.0
    x = np.cos(t) + kick[0]
    assert not outliers(t, x, np.zeros(600, dtype=int), kick).any()
    assert outliers(t, x, np.zeros(600, dtype=int), 0 * kick).sum() == 5
