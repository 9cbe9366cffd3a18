"""The ladder of a record: how many states, their profile, and a Markov model of the hops, each tested."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
from remembering import double_wells
from scipy.ndimage import gaussian_filter1d
from scipy.signal import lfilter

from siq.data.inspection import inspect
from siq.data.kinetics import MarkovModel, _levels_of
from siq.data.preparation import without_background
from siq.data.recordings import Recordings
from siq.data.states import DwellCount, RecordStates, _valley_depths, switching
from siq.data.stationarity import change_of, relaxation_samples, runs_of
from siq.remarks import Remark, sentence

RATES = np.array([[-0.10, 0.06, 0.04], [0.10, -0.15, 0.05], [0.05, 0.10, -0.15]])
"""Per sample: stays of 10, 6.7 and 6.7 of them."""


def chain(seed: int, rates: np.ndarray, count: int) -> np.ndarray:
    """States of a jump process, seen once a step."""
    generator = np.random.default_rng(seed)
    reached = np.cumsum(scipy.linalg.expm(rates), axis=1)
    draws, path = generator.random(count), np.zeros(count, dtype=int)
    for k in range(1, count):
        path[k] = min(int(np.searchsorted(reached[path[k - 1]], draws[k])), len(rates) - 1)
    return path


def recorded(values: np.ndarray) -> Recordings:
    values = values.reshape(len(values), -1)
    return Recordings.from_arrays(np.arange(float(len(values))), values, names=["x", "y"][: values.shape[1]])


def noise(seed: int, count: int, memory: float = 0.0) -> np.ndarray:
    """Of standard deviation 1, with so much left of it after a step."""
    kicks = np.sqrt(1 - memory**2) * np.random.default_rng(1000 + seed).standard_normal(count)
    return np.asarray(lfilter([1.0], [1.0, -memory], kicks))


def found_in(values: np.ndarray) -> RecordStates:
    found = switching(recorded(values))
    assert found is not None
    return found


def test_intervals_of_stays_cover() -> None:
    truth, counted, modelled = -1 / np.diag(RATES), [], []
    for seed in range(40):
        path = chain(seed, RATES, 1500)
        runs = [slice(0, len(path))]
        model = MarkovModel.of(path, runs, 3, None)
        assert model is not None and model.lag == 1
        modelled += [low <= one <= high for one, (_, low, high) in zip(truth, model.stays, strict=True)]
        # What is seen once a step hops less: its stays are those of the chain.
        seen = 1 / (1 - np.diag(scipy.linalg.expm(RATES)))
        counts = DwellCount.of_visits(np.arange(float(len(path))), path, runs, states=3)
        counted += [one.limits[0] <= mean <= one.limits[1] for one, mean in zip(counts, seen, strict=True)]
    assert np.mean(counted) > 0.9 and np.mean(modelled) > 0.88


@pytest.mark.parametrize(
    ("power", "seeds"),
    [(1, 2), (3, 2), *(pytest.param(power, 40, marks=pytest.mark.slow) for power in (1, 3))],
)
def test_one_well_is_never_two(power: int, seeds: int) -> None:
    step = 0.05
    kicks = np.sqrt(0.5 * step) * np.random.default_rng(power).standard_normal((4000, seeds))
    x = np.zeros((4000, seeds))
    for k in range(1, len(x)):
        x[k] = x[k - 1] - step * x[k - 1] ** power + kicks[k]
    assert not any(found_in(one).supported for one in x.T)


def test_three_levels_that_noise_blurs() -> None:
    path = chain(0, RATES, 20_000)
    found = found_in(path + 0.2 * noise(0, len(path)))
    assert found.supported and found.rung == 3 and found.markov is not None
    assert found.levels == pytest.approx((0, 1, 2), abs=0.05)
    assert found.markov.stays[:, 0] == pytest.approx(-1 / np.diag(RATES), rel=0.15)
    assert all(one in (True, None) for one in found.exponential)
    stored = json.loads(json.dumps(found.as_data(), allow_nan=False))
    assert RecordStates.from_data(stored).sentence() == found.sentence()
    assert "has three states of x" in found.sentence()


def test_three_states_in_two_dimensions() -> None:
    path = chain(1, RATES / 20, 20_000)
    corners = np.array([[-1.0, -0.5], [0.0, 1.0], [1.0, -0.5]])
    x = corners[path] + 0.2 * np.column_stack([noise(seed, len(path), memory=0.8) for seed in (1, 2)])
    found = found_in(x)
    assert found.supported and len(found.counts) == 3 and found.rung == 3
    order = np.argsort(found.places[:, 0])
    assert found.places[order] == pytest.approx(corners, abs=0.1)
    turns = np.flatnonzero(np.diff(path))
    assert found.transitions == pytest.approx(len(turns), rel=0.1)
    assert "(−1.0" in found.sentence() or "(−0.9" in found.sentence()


def states_of_noise(path: np.ndarray) -> RecordStates:
    return found_in(path + 0.1 * noise(5, len(path)))


@pytest.mark.parametrize("separation", [4.0, 0.0], ids=["levels", "double well"])
def test_missing_samples_end_no_visit(separation: float) -> None:
    """A tenth of the samples is missing here and there; states, hops and stays in time are as with them."""
    if separation:
        values = separation * chain(3, np.array([[-0.01, 0.01], [0.02, -0.02]]), 5000) + noise(3, 5000)
    else:
        values, kicks = np.ones(40_000), np.sqrt(0.25 * 0.05) * noise(5, 40_000)
        for k in range(len(values) - 1):
            values[k + 1] = values[k] + 0.05 * (values[k] - values[k] ** 3) + kicks[k]
    whole, kept = recorded(values), np.random.default_rng(6).random(len(values)) > 0.1
    some = replace(whole, t=whole.t[kept], values=whole.values[kept], recording=whole.recording[kept])
    expected, found = switching(whole), switching(some)
    assert expected is not None and found is not None and expected.supported and found.supported
    assert found.rung == expected.rung and len(found.visits) == kept.sum()
    assert np.mean(found.visits == expected.visits[kept]) > 0.98
    for one, other in zip(found.counts, expected.counts, strict=True):
        assert one.visits == pytest.approx(other.visits, rel=0.1)
        assert one.time == pytest.approx(other.time, rel=0.02)
    stays = [[np.mean(one) for one in each.stays] for each in (found, expected)]
    assert stays[0] == pytest.approx(stays[1], rel=0.12)


def test_wells_that_mix_slowly_stand_apart_and_a_quick_relaxation_among_hops_is_seen() -> None:
    """Over a cosine samples relax within two of them, and it takes thousands to have been in all wells."""
    generator, step = np.random.default_rng(77), 0.005
    x, values = 0.0, np.empty(30_000)
    kicks = 0.7 * np.sqrt(step) * generator.standard_normal((len(values), 4))
    for k, some in enumerate(kicks):
        for kick in some:
            x += kick - step * (1.1 * np.pi * np.sin(2 * np.pi * x) + 0.3 * x)
        values[k] = x
    assert 1 < (relaxation_samples(values, [slice(0, len(values))]) or 0) < 5  # 2.3 in a well
    found = found_in(values)
    assert found.supported and len(found.levels) >= 3
    assert np.abs(np.array(found.levels) - np.round(found.levels)).max() < 0.1
    assert np.diff(np.round(found.levels)) == pytest.approx(1)


def test_a_record_whose_stays_change_ends_on_the_first_rung() -> None:
    pair = np.array([[-0.1, 0.1], [0.02, -0.02]])
    found = states_of_noise(np.concatenate([chain(2, pair, 4000), chain(3, pair[::-1, ::-1], 4000)]))
    assert found.rung == 1 and found.limit == Remark("data.not_stationary", {"period": None, "unit": None})
    assert found.profile is None and found.markov is None


def test_a_record_that_swings_ends_on_the_first_rung_with_its_period() -> None:
    path = chain(4, np.array([[-0.02, 0.02], [0.02, -0.02]]), 4000)
    swing = 0.05 * np.sin(2 * np.pi * np.arange(len(path)) / 25)
    found = found_in(path + swing + 0.1 * noise(5, len(path)))
    assert found.rung == 1 and found.limit is not None
    assert found.limit.values["period"] == pytest.approx(25, rel=0.02)


def test_a_record_that_a_sensor_cuts_off_has_no_profile() -> None:
    path = chain(2, np.array([[-0.004, 0.004], [0.004, -0.004]]), 20_000)
    x = path + 0.15 * noise(5, len(path), memory=0.8)
    found = found_in(np.minimum(x, 1.1))
    assert found.supported and found.rung == 1 and found.profile is None
    assert found.limit is not None and found.limit.code == "data.clipped"
    assert found_in(np.round(x, 2)).profile is not None


def test_a_dozen_hops_are_too_few_to_refute_a_markov_process() -> None:
    lengths = [400, 900, 150, 700, 60, 1100, 300, 500, 800, 250, 600, 350]
    found = states_of_noise(np.repeat(np.arange(12) % 2, lengths))
    assert found.rung == 2 and found.limit == Remark("data.few_hops")


def test_stays_that_are_too_regular_make_no_markov_model() -> None:
    lengths = np.ceil(np.random.default_rng(6).gamma(6, 15, 80)).astype(int)
    found = states_of_noise(np.repeat(np.arange(80) % 2, lengths))
    assert found.rung == 2 and found.limit == Remark("data.not_markov")
    assert found.exponential == (False, False)


def test_hops_that_depend_on_what_was_not_recorded_end_on_the_second_rung() -> None:
    # Two hidden states in each seen one: stays are long or short for a while.
    rates = np.zeros((4, 4))
    rates[0, 1] = rates[1, 0] = 0.2
    rates[2, 3] = rates[3, 2] = 0.01
    rates[0, 2] = rates[2, 0] = rates[1, 3] = rates[3, 1] = 0.002
    found = states_of_noise(chain(4, rates - np.diag(rates.sum(axis=1)), 40_000) % 2)
    assert found.rung == 2 and found.limit == Remark("data.not_markov") and found.markov is None
    assert False in found.exponential
    assert found.profile is not None and (found.profile.tops[:, ::2] > 2).all()


def test_baselines_that_differ_are_given_one_each() -> None:
    pair = np.array([[-0.06, 0.06], [0.10, -0.10]])
    path = np.array([chain(seed, pair, 1500) for seed in range(4)])
    x = 3.0 * path + 0.2 * np.array([noise(seed, 1500) for seed in range(4)])
    offsets = np.array([0.0, 0.1, -0.1, 0.15])
    names = ["x"]
    together = Recordings.from_arrays(np.arange(1500.0), (x + offsets[:, None])[:, :, None], names=names)
    found = switching(together)
    assert found is not None and found.offset == pytest.approx(0.25, abs=0.05)
    assert "differ in their baselines" in found.sentence()
    flat = without_background(together)
    assert "differ in their baselines" in flat.notes[-1]
    taken = (together.values - flat.values)[:, 0].reshape(4, -1)
    np.testing.assert_allclose(taken.mean(axis=1), offsets - offsets.mean(), atol=0.02)
    recordings = Recordings.from_arrays(np.arange(1500.0), x[:, :, None], names=names)
    alike = switching(recordings)
    assert alike is not None and alike.offset == 0
    assert without_background(recordings) is recordings


def test_baselines_are_told_by_steps_where_recordings_hop_seldom_and_stay_near_the_top() -> None:
    generator = np.random.default_rng(3)
    number, length, step = 5, 4000, 0.02
    offsets = 60 * generator.standard_normal(number)
    x = np.empty((length, number))
    now = generator.choice([-1.0, 1.0], number)
    for place in range(length):
        x[place] = 150 * now + offsets
        for _ in range(4):
            kick = np.sqrt(2 * 0.7 * step / 4) * generator.standard_normal(number)
            now = now + 4 * (now - now**3) * step / 4 + kick
    found = switching(Recordings.from_arrays(step * np.arange(length), x.T[:, :, None], names=["x"]))
    assert found is not None and found.supported
    told = found.baseline.reshape(number, length)[:, 0]
    # What a recording spends in each well, and near the top, would move its mean by ten and more.
    np.testing.assert_allclose(
        told, offsets - offsets.mean(), atol=3.5 * 150 / np.sqrt(4**2 * step * length / 1.4)
    )


def test_an_inspection_tells_the_rungs() -> None:
    path = chain(0, RATES, 6000)
    found = inspect(recorded(path + 0.1 * noise(0, len(path))))
    assert found.switching is not None and found.switching.rung == 3
    assert len(runs_of(found.recordings)) == 1
    assert "The hops are a Markov process" in found.text()


def test_states_are_seen_over_a_drift_as_large_as_their_distance() -> None:
    x = double_wells(1, samples=60_000, traces=1, intensity=0.3)[0, ::5, 0]
    drift = np.linspace(-1, 1, len(x))
    found = switching(recorded(x + drift))
    assert found is not None and found.supported and len(found.levels) == 2
    still = switching(recorded(x))
    assert still is not None and not still.background.any()
    assert abs(found.transitions - still.transitions) <= 0.2 * still.transitions


def test_a_rare_state_between_two_is_one() -> None:
    """Wells of 6 % and of 45 % of the time: a bin of the histogram holds enough of the rare one."""
    path = np.repeat(np.tile([0.0, 1.0, 2.0, 1.0], 12), np.tile([900, 120, 900, 120], 12))
    about = np.zeros(len(path))
    kicks = 0.1 * noise(3, len(path))
    for k in range(1, len(path)):
        about[k] = 0.6 * about[k - 1] + kicks[k]
    found = switching(recorded(path + about))
    assert found is not None and found.supported
    assert np.round(found.levels, 1).tolist() == [0.0, 1.0, 2.0]


def test_pulses_of_one_shape_are_no_states() -> None:
    """A pulse of four samples has a peak of the histogram at each of them, where the record never stays."""
    path = np.repeat(np.tile([0.0, 1.0], 10), 600)
    x = path + 0.1 * noise(4, len(path), memory=0.9)
    for begin in np.flatnonzero(path > 0.5)[20::80]:
        x[begin : begin + 4] += [2.0, 6.0, 3.0, -0.5]
    assert np.round(found_in(x).levels, 1).tolist() == [0.0, 1.0]


def test_three_levels_behind_a_filter() -> None:
    """A filter before sampling correlates the noise about the levels over two or three samples."""
    path = chain(5, 0.1 * RATES, 8000)
    x = gaussian_filter1d(2.0 * path + 1.0 * noise(5, len(path)), 0.66)
    found = found_in(x)
    assert np.round(found.levels).tolist() == [0.0, 2.0, 4.0]
    for rate, one in zip(-0.1 * np.diag(RATES), found.counts, strict=True):
        assert one.limits[0] * 0.8 < 1 / rate < one.limits[1] * 1.2


def test_ten_seasons_are_a_period() -> None:
    t, season = np.arange(520.0), 52.0
    x = np.exp(1.5 * np.cos(2 * np.pi * t / season)) + 0.2 * noise(6, len(t), memory=0.5)
    assert change_of(recorded(x), x, (x > 1.5).astype(int)) == pytest.approx(season, rel=0.05)
    hops = chain(6, np.array([[-0.04, 0.04], [0.04, -0.04]]), len(t))
    assert change_of(recorded(hops), hops + 0.2 * noise(7, len(t)), hops) is None


def test_what_swings_about_its_levels_is_no_filter() -> None:
    """A swing forgets little at first, too, as what is filtered does, and then falls below any filter's."""
    levels = 3.0 * chain(9, np.array([[-0.02, 0.02], [0.02, -0.02]]), 8000)
    runs, white = [slice(0, len(levels))], noise(9, len(levels))
    swinging, filtered = lfilter([0.57], [1, -1.1, 0.67], white), gaussian_filter1d(1.5 * white, 0.66)
    every = []
    for about in (swinging, filtered):
        found = _levels_of(levels + about, runs, np.array([0.0, 3.0]))
        assert found is not None
        every.append(found.filtered(levels + about, runs))
    assert every[0] == 1 < every[1]


def test_levels_that_stand_for_many_samples_have_no_period() -> None:
    path = chain(6, np.array([[-0.2, 0.2], [0.2, -0.2]]), 5000)
    seen, held = path + 0.2 * noise(7, len(path)), np.repeat(path[::10], 10)
    assert change_of(recorded(seen), seen, held) == pytest.approx(10)
    assert change_of(recorded(seen), seen, held, held=10) is None


@pytest.mark.slow
def test_few_visits_in_two_dimensions_are_three_states() -> None:
    """Some forty visits to each: the wells are known by these less well than the valleys between them."""
    places = np.array([[2.0, 0.5], [1.4, 1.4], [0.5, 2.0]])
    path = chain(8, np.array([[-2.0, 2.0, 0.0], [2.5, -5.0, 2.5], [0.0, 2.0, -2.0]]) * 1e-3, 40_000)
    about = np.column_stack([noise(seed, len(path), memory=0.9) for seed in (1, 2)])
    found = found_in(places[path] + 0.22 * about)
    assert found.places[found.places[:, 0].argsort()] == pytest.approx(places[::-1], abs=0.1)


def test_three_hops_are_no_drift() -> None:
    path = np.repeat([0.0, 1.0, 0.0, 1.0], [2300, 3200, 1500, 3000])
    found = found_in(0.412 + 0.018 * path + 0.0015 * noise(9, len(path)))
    assert found.levels == pytest.approx((0.412, 0.430), abs=2e-4)
    assert found.rung == 2 and found.limit is not None and found.limit.code == "data.few_hops"


@pytest.mark.parametrize("digits", [1, 16])
def test_valleys_are_those_of_histograms_between_quantiles(digits: int) -> None:
    series = np.random.default_rng(3).normal(size=(3, 2500)).round(digits)
    series[1] += 2 * np.sign(series[2])
    numbers = [12, 40, 25]
    for row, number, depth in zip(series, numbers, _valley_depths(series, numbers), strict=True):
        counts = np.histogram(row, number, np.quantile(row, [0.001, 0.999]).tolist())[0]
        above = [(np.maximum(counts - valley, 0), place) for place, valley in enumerate(counts)]
        lesser = max(min(peaks[:place].sum(), peaks[place:].sum()) for peaks, place in above)
        assert depth == lesser / 2500


def test_short_recordings_beside_a_long_one_make_no_period() -> None:
    for seed in range(4):
        x = lfilter([1], [1, -0.9], np.random.default_rng(seed).standard_normal(4680))[200:]
        parts = [one[:, None] for one in np.split(x, np.arange(60, 481, 60))]
        given = Recordings.from_arrays([0.1 * np.arange(len(one)) for one in parts], parts, names=["x"])
        assert change_of(given, x, np.zeros(len(x), dtype=int)) is None


def test_one_well_in_per_cent_is_no_two_states() -> None:
    """What is bent by a sensor, or lies between two ends, has two peaks as soon as it is spread enough."""
    share = 1 / (1 + np.exp(-2.5 * noise(1, 12_000, memory=np.exp(-1 / 30))))
    assert not found_in(np.round(100 * share, 1)).supported


def test_seven_states_have_a_number() -> None:
    remark = found_in(np.where(chain(0, RATES, 2000), -1.0, 1.0) + 0.2 * noise(0, 2000)).remark()
    seven = {
        name: [*value] * 4 for name, value in remark.values.items() if name in ("levels", "places", "means")
    }
    more = {name: [*remark.values[name]] * 4 for name in ("limits", "visits")}
    assert "The record has 8 states of x" in sentence(Remark(remark.code, remark.values | seven | more))


def test_levels_that_every_sample_draws_anew_are_no_states_that_last() -> None:
    generator = np.random.default_rng(0)
    blur, size = 0.25 * generator.standard_normal(4000), np.arange(4000)
    drawn = np.where(generator.random(4000) < 0.4, -1.0, 1.0)
    turned = np.where(size % 2, -1.0, 1.0) * np.where(generator.random(4000) < 0.1, -1, 1)
    assert not found_in(drawn + blur).supported
    assert not found_in(turned + blur).supported
    kept = np.where(chain(0, np.array([[-0.5, 0.5], [0.5, -0.5]]), 4000), -1.0, 1.0)
    assert found_in(kept + blur).supported  # which stays for two samples


def test_one_well_of_a_sensor_that_clips_is_no_two_states() -> None:
    found = found_in(np.clip(noise(2, 6000, memory=np.exp(-1 / 8)), -9.0, 1.0))
    assert found.probability < 0.01 and len(found.levels) > 1  # peaks there are
    assert not found.supported


def test_three_levels_without_any_noise_are_states() -> None:
    """Nothing lies between them, so that a profile has no top to be told from none."""
    found = found_in(chain(1, RATES / 4, 6000).astype(float))
    assert found.supported and found.levels == pytest.approx((0, 1, 2)) and found.rung == 3


@pytest.mark.parametrize("seed", [0, 1])
def test_levels_without_any_noise_are_states(seed: int) -> None:
    """As of a channel that was told open or closed, 0 or 1, before it was written."""
    generator = np.random.default_rng(seed)
    found = found_in((np.cumsum(generator.random(10_000) < 0.02) % 2).astype(float))
    assert found.levels == pytest.approx((0, 1)) and found.rung == 3
    assert all(low < 50 < high for low, high in (one.limits for one in found.counts))
    assert "−log p" not in found.sentence()  # nothing lay between them that was ever seen


def test_levels_of_a_coarse_digitiser_are_no_states() -> None:
    for step in (2.0, 1.5):
        assert not found_in(np.round(noise(0, 10_000, memory=np.exp(-1 / 20)) / step) * step).supported


def test_one_well_of_whole_numbers_is_no_two_states() -> None:
    """Bins that hold one number or two by turns have valleys that surrogates have not."""
    generator = np.random.default_rng(1)
    x = np.full(20, 8.0)
    counts = np.empty((20, 600))
    for k in range(600):
        counts[:, k] = np.floor(x)
        for _ in range(20):
            born = 0.8 + 9 * x**4 / (60.0**4 + x**4)
            kick = np.sqrt(0.3 * (born + 0.1 * x)) * generator.standard_normal(20)
            x = np.maximum(x + 0.1 * (born - 0.1 * x) + kick, 0.0)
    found = switching(Recordings.from_arrays(np.arange(600.0), counts[:, :, None], names=["x"]))
    assert found is not None and not found.supported and found.probability > 0.1
