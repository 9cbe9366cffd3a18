"""Which of two simulations foresees recordings better: of pairs, and by more than appears by chance."""

from __future__ import annotations

import numpy as np
import pytest

from siq.diagnosis.holdout import HeldOutErrors, change_between, in_blocks


def squares_of(noise: np.ndarray, *errors: float) -> list[tuple[float, ...]]:
    """Squared errors of simulations that are off by sines of these amplitudes, and by the same noise."""
    wave = np.sin(np.arange(len(noise)) / 7)
    return [in_blocks((error * wave + noise) ** 2) for error in errors]


def test_a_gain_far_below_the_noise_is_seen_in_pairs() -> None:
    # 4 % of the squared error: two independent errors of 600 values would differ by 6 % by chance.
    noise = np.random.default_rng(1).normal(size=2000)
    without, with_it = squares_of(noise, 0.3, 0.0)
    assert change_between(without, with_it) == "better"
    assert change_between(with_it, without) == "worse"


def test_where_nothing_is_gained_one_in_twenty_looks_better() -> None:
    draw = np.random.default_rng(2)
    noises = draw.normal(size=(1000, 240))
    # Two simulations that are equally far off, in ways that have nothing to do with each other.
    first, second = 0.3 * draw.normal(size=(2, 1000, 240))
    said = [
        change_between(in_blocks((noise + one) ** 2), in_blocks((noise + other) ** 2))
        for noise, one, other in zip(noises, first, second, strict=True)
    ]
    better = said.count("better") / len(said)
    assert 0.03 < better < 0.075
    assert 0.03 < said.count("worse") / len(said) < 0.075


def test_a_stretch_that_dominates_does_not_hide_a_gain_in_all_of_it() -> None:
    one = np.array([100.0] + [1.0] * 11)
    assert change_between(tuple(one), tuple(0.5 * one)) == "better"
    # A gain in this stretch alone may be chance.
    other = one.copy()
    other[0] = 80.0
    other[1::2] *= 1.3
    assert change_between(tuple(one), tuple(other)) == "same"


def test_scale_and_order_of_blocks_do_not_matter() -> None:
    draw = np.random.default_rng(3)
    one, other = draw.chisquare(1, (2, 12))
    order = draw.permutation(12)
    for scale in (1e-12, 1.0, 1e6):
        assert change_between(tuple(scale * one), tuple(scale * other)) == change_between(
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
    assert change_between(first, second) == change


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
