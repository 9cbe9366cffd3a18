"""Which of two simulations foresees recordings better: of pairs, and by more than appears by chance."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
import scipy.stats

from siq.diagnosis import holdout
from siq.diagnosis.dictionary import roles_of
from siq.diagnosis.holdout import (
    CHANGE_BY_CHANCE,
    HeldOutErrors,
    _change_between,
    in_blocks,
    predicts_better,
    preferred_model,
    preferred_recalibration,
    simulated,
    typically_better,
)
from siq.diagnosis.investigation import _spread_of_free_runs
from siq.diagnosis.study import _measurements_of
from siq.inference.measurements import with_expectations
from siq.inference.recalibration import recalibrate
from siq.inference.trajectories import scored_rows
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics, Parameter, symbol


def squares_of(noise: np.ndarray, *errors: float) -> list[tuple[float, ...]]:
    """Squared errors of simulations that are off by sines of these amplitudes, and by the same noise."""
    wave = np.sin(np.arange(len(noise)) / 7)
    return [in_blocks((error * wave + noise) ** 2) for error in errors]


def test_a_gain_far_below_the_noise_is_seen_in_pairs() -> None:
    # 4 % of the squared error: two independent errors of 600 values would differ by 6 % by chance.
    noise = np.random.default_rng(1).normal(size=2000)
    without, with_it = squares_of(noise, 0.3, 0.0)
    assert _change_between(without, with_it) == "better"
    assert _change_between(with_it, without) == "worse"


def test_where_nothing_is_gained_one_in_twenty_looks_better() -> None:
    draw = np.random.default_rng(2)
    noises = draw.normal(size=(1000, 240))
    # Two simulations that are equally far off, in ways that have nothing to do with each other.
    first, second = 0.3 * draw.normal(size=(2, 1000, 240))
    said = [
        _change_between(in_blocks((noise + one) ** 2), in_blocks((noise + other) ** 2))
        for noise, one, other in zip(noises, first, second, strict=True)
    ]
    better = said.count("better") / len(said)
    assert 0.03 < better < 0.075
    assert 0.03 < said.count("worse") / len(said) < 0.075


def test_a_stretch_that_dominates_does_not_hide_a_gain_in_all_of_it() -> None:
    one = np.array([100.0] + [1.0] * 11)
    assert _change_between(tuple(one), tuple(0.5 * one)) == "better"
    # A gain in this stretch alone may be chance.
    other = one.copy()
    other[0] = 80.0
    other[1::2] *= 1.3
    assert _change_between(tuple(one), tuple(other)) == "same"


def test_scale_and_order_of_blocks_do_not_matter() -> None:
    draw = np.random.default_rng(3)
    one, other = draw.chisquare(1, (2, 12))
    order = draw.permutation(12)
    for scale in (1e-12, 1.0, 1e6):
        assert _change_between(tuple(scale * one), tuple(scale * other)) == _change_between(
            tuple(one[order]), tuple(other[order])
        )


@pytest.mark.parametrize(
    ("first", "second", "change"),
    [
        (None, None, "unknown"),
        (None, (1.0, 2.0), "better"),
        ((1.0, 2.0), None, "worse"),
        ((1.0, 2.0), (1.0, 2.0), "same"),
        ((1.0,), (0.1,), "same"),  # one value tells no error
        ((0.0, 0.0), (1.0, 1.0), "worse"),
        ((1.0, 1.0), (0.0, 0.0), "better"),
        ((0.0, 0.0, 3.0), (0.0, 0.0, 1.0), "same"),  # all of it in one block
    ],
)
def test_what_ran_away_and_what_is_empty(first: tuple | None, second: tuple | None, change: str) -> None:
    assert _change_between(first, second) == change


def test_a_value_or_two_are_at_the_noise_only_if_noise_may_be_so_large() -> None:
    for values, largest in ((1, 2.24), (2, 1.92), (300, 1.08)):
        for error in (0.99 * largest, 1.01 * largest):
            found = HeldOutErrors(before=error, noise_floor=1.0, values=values)
            assert found.at_noise("before") == (error < largest)


def test_without_what_was_found_is_the_better_of_two() -> None:
    squares = np.random.default_rng(4).chisquare(1, 300)
    errors = HeldOutErrors.of(
        {"before": 9 * squares, "recalibrated": 4 * squares, "augmented": squares}, noise_floor=0.95
    )
    assert errors.error("without") == errors.recalibrated == pytest.approx(2 * errors.augmented)
    assert errors.change("without", "augmented") == "better" and errors.values == 300
    assert errors.at_noise("augmented") and not errors.at_noise("without")
    away = HeldOutErrors.of({"before": None, "recalibrated": squares, "augmented": squares})
    assert away.better_without == "recalibrated" and away.change("before", "recalibrated") == "better"
    nothing = HeldOutErrors.of({"before": None, "recalibrated": None, "augmented": None})
    assert nothing.change("without", "augmented") == "unknown" and not nothing.at_noise("before")


@pytest.mark.parametrize(
    ("before", "augmented", "floor", "share"),
    [
        (0.5, 0.1, 0.1, 1.0), (0.5, 0.14, 0.1, 0.9), (0.5, 0.05, 0.1, 1.125), (30.0, 0.19, 0.1, 0.9),
        (None, 0.1, 0.1, 1.0), (0.5, None, 0.1, 0.0), (0.5, 0.1, None, 0.0), (0.5, 0.5, 0.1, 0.0),
    ],
)  # fmt: skip
def test_what_is_gained_is_a_share_of_what_could_be(
    before: float | None, augmented: float | None, floor: float | None, share: float
) -> None:
    """A simulation that is off by thirty times the spread is no better than their mean."""
    errors = HeldOutErrors(before=before, recalibrated=before, augmented=augmented, floor=floor)
    assert errors.share_gained == pytest.approx(share)


@pytest.mark.parametrize("tau", [0.0, 1.0])
def test_noises_of_a_fit_foresee_how_far_free_runs_are_off(tau: float) -> None:
    """Of a decay that a force drives at random, white or with a correlation time."""
    draw, step, rate = np.random.default_rng(5), 0.1, 0.5
    t, frames = np.arange(0, 20, step), []
    for place in range(16):
        force = draw.normal(size=len(t)) / np.sqrt(step)
        for k in range(1, len(t)):
            if tau:
                force[k] = force[k - 1] * np.exp(-step / tau) + force[k] * (1 - np.exp(-step / tau))
        x = np.full(len(t), 2.0)
        for k in range(1, len(t)):
            x[k] = x[k - 1] * np.exp(-rate * step) + 0.3 * force[k] * step
        frames.append(
            pd.DataFrame({"recording": f"r{place}", "t": t, "x": x + 0.01 * draw.normal(size=len(t))})
        )
    k, x = symbol("k"), symbol("x")
    model = Dynamics(("x",), (-k * x,), Diffusion.identity(1), parameters=(Parameter("k", rate, "1"),))
    data = _measurements_of(pd.concat(frames, ignore_index=True), model)
    fit, _ = recalibrate(with_expectations(model), data)
    assert fit.has_process_noise
    off = (simulated(fit, data, noise=fit.noise, substeps=fit.substeps) - data.outputs)[scored_rows(data)]
    foreseen = _spread_of_free_runs(fit, data, roles_of(fit.model))
    # A correlation over half of the time in which the force is forgotten makes it too much.
    low, high = (0.7, 1.4) if tau == 0 else (1.0, 2.5)
    assert low < foreseen[0] / np.mean(off**2) < high


@pytest.mark.parametrize(
    ("before", "after", "floor", "most"),
    [
        (1.0, 0.7, 0.1, True),
        (1.0, 0.72, 0.1, False),
        (1.0, 0.72, 0.5, True),
        (None, 9.0, 0.1, True),
        (1.0, None, 0.1, False),
    ],
)
def test_a_name_takes_more_than_it_leaves_beyond_the_noise(
    before: float | None, after: float | None, floor: float, most: bool
) -> None:
    """A square of 1 falls to 0.49, which is less than half; or to 0.5184, of which 0.25 are noise."""
    assert HeldOutErrors(before, before, augmented=after, noise_floor=floor).takes_most is most
    # What describes the rest is not credited to the name.
    if after is not None:
        assert HeldOutErrors(before, before, augmented=0.0, named=after, noise_floor=floor).takes_most is most


@pytest.mark.parametrize(
    ("share", "change"), [(-1.01, "better"), (-0.99, "same"), (0.99, "same"), (1.01, "worse")]
)
def test_what_blocks_change_by_chance_is_the_jackknife_of_their_sums(share: float, change: str) -> None:
    draw = np.random.default_rng(0)
    first, second = draw.exponential(size=12), draw.exponential(size=12)
    left_out = [np.log((second.sum() - b) / (first.sum() - a)) for a, b in zip(first, second, strict=True)]
    limit = scipy.stats.t.isf(CHANGE_BY_CHANCE, 11) * np.sqrt(11 * np.var(left_out))
    second *= np.exp(share * limit) * first.sum() / second.sum()
    assert _change_between(first, second) == change


def test_fewer_parameters_win_where_errors_are_nearly_alike() -> None:
    def with_one_block(height: float) -> np.ndarray:
        """Squares about the same but for a block of twenty, which makes all of it doubtful."""
        return 0.1 * np.repeat([1.0] * 19 + [height], 10)

    least = with_one_block(1.0)
    assert preferred_model([least, with_one_block(4.6)], [2, 1]) == 1  # larger by 18 %, a tenth in size
    assert preferred_model([least, with_one_block(7.0)], [2, 1]) == 0  # by 30 %
    assert preferred_model([least, 1.05 * least], [2, 1]) == 0  # in every block: not by chance
    assert preferred_model([with_one_block(4.6), None, least, least.copy()], [3, 0, 2, 2]) == 2
    assert preferred_model([None, None], [2, 1]) == 0


def test_the_likeliest_model_stays_where_free_runs_are_no_better_than_the_mean_of_the_recordings() -> None:
    errors = np.ones(100)
    assert preferred_model([None, 9.0 * errors, errors], [1, 2, 1]) == 1
    assert preferred_model([None, 9.0 * errors, 0.9 * errors], [1, 2, 1]) == 2


def test_a_model_is_better_than_none_by_more_than_chance_or_below_a_limit() -> None:
    without = np.random.default_rng(0).exponential(size=400)
    alike = without[::-1]
    assert predicts_better(without, 0.5 * without) and not predicts_better(without, None)
    assert predicts_better(None, without)  # nothing else ends
    assert not predicts_better(without, alike)
    assert predicts_better(without, alike, limit=1.01 * alike.mean())
    assert not predicts_better(without, alike, limit=alike.mean())
    assert not predicts_better(without, 2 * without, limit=10.0)


def test_errors_fall_typically_where_most_blocks_and_their_sum_do() -> None:
    before = np.ones(200)
    assert typically_better(before, np.random.default_rng(0).uniform(0.6, 1.1, 200))
    assert not typically_better(before, np.r_[0.01, np.random.default_rng(0).uniform(0.9, 1.1, 199)])
    assert not typically_better(
        before, np.r_[np.full(140, 0.2), np.full(60, 8.0)]
    )  # less in most, more in all


@dataclass
class FakeFit:
    model: Any
    covariance: np.ndarray
    noise: Any = None
    refits: Any = None


@pytest.mark.parametrize(
    ("share", "others", "moved"), [(1.01, 0, True), (0.99, 0, False), (1.01, 2, True), (0.99, 2, False)]
)
def test_a_refit_counts_where_its_parameters_move_further_than_parts_move_them(
    share: float, others: int, moved: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    draw = np.random.default_rng(0)
    covariance = np.array([[1.0, 0.6], [0.6, 1.0]]) * np.outer([1e-3, 1e3], [1e-3, 1e3])
    inverse, values = np.linalg.inv(covariance), draw.standard_normal((8, 2)) * [1e-3, 1e3]
    among = 7 / 8 * sum(one @ inverse @ one for one in values - values.mean(axis=0))
    away = np.array([2e-3, 1e3])
    # Every refit that is asked has its share of the chance of a false one.
    needed = scipy.stats.f.isf(CHANGE_BY_CHANCE / (1 + others), 2, 7) * among
    away *= np.sqrt(share * needed / (away @ inverse @ away))

    def fit(at: np.ndarray, refits: Any, covariance: np.ndarray = covariance) -> Any:
        model = SimpleNamespace(values=at, free=[0, 1], parameters=[], held=lambda names: None)
        return FakeFit(model, covariance, refits=refits)

    def refits(squares: np.ndarray) -> list[tuple[Any, np.ndarray]]:
        return [
            (SimpleNamespace(model=SimpleNamespace(values=one)), each)
            for one, each in zip(values, np.array_split(squares, 8), strict=True)
        ]

    alone, noise = draw.exponential(size=400), SimpleNamespace(without_process=lambda: None)
    monkeypatch.setattr(holdout, "errors_left_out", lambda *given, **named: alone)
    monkeypatch.setattr(holdout, "_refits_left_out", lambda fit, *given, **named: fit.refits)
    half, double = (share * alone * draw.uniform(0.9, 1.1, 400) for share in (0.5, 2.0))
    card, better = fit(np.zeros(2), None), fit(away, refits(half))
    failed = [fit(away, None), fit(away, refits(0.1 * alone), np.full((2, 2), np.inf))][:others]

    def preferred(*fits: Any) -> Any:
        return preferred_recalibration(card, [(one, None) for one in fits], None, noise=noise)  # type: ignore[arg-type]

    assert preferred(*failed, better) is (better if moved else card)
    worse = fit(away, refits(double))
    assert preferred(*failed, worse) is card
    if not others:  # of those that are as good the first is preferred
        again = fit(2 * away, refits(half))
        assert preferred(fit(2 * away, refits(half)), again) is not again
        monkeypatch.setattr(holdout, "errors_left_out", lambda *given, **named: None)
        assert preferred(worse) is (worse if moved else card)  # the simulation as it is runs away
