from __future__ import annotations

import numpy as np
import pytest

from siq.data.recordings import Recordings
from siq.errors import NumericalFailure


def recordings(count: int) -> Recordings:
    return Recordings(
        names=("x",), units=("1",), labels=tuple(f"r{k}" for k in range(count)),
        recording=np.repeat(np.arange(count), 2), t=np.tile([0.0, 1.0], count),
        values=np.arange(2.0 * count)[:, None],
    )  # fmt: skip


def held(data: Recordings, seed: int, **options: float) -> np.ndarray:
    return data.held_out(generator=np.random.default_rng(seed), **options)


@pytest.mark.parametrize(
    ("count", "share", "expected"), [(10, 0.2, 2), (2, 0.2, 1), (5, 0.9, 4), (3, 0.01, 1)]
)
def test_a_share_is_held_out_but_never_all_or_none(count: int, share: float, expected: int) -> None:
    for seed in range(5):
        mask = held(recordings(count), seed, share=share)
        assert mask.shape == (count,)
        assert mask.sum() == expected


def test_which_ones_are_held_out_depends_on_the_generator_alone() -> None:
    data = recordings(50)
    np.testing.assert_array_equal(held(data, 3), held(data, 3))
    assert (held(data, 3) != held(data, 4)).any()


@pytest.mark.parametrize("seed", range(5))
def test_copies_of_a_resampled_recording_stay_together(seed: int) -> None:
    data = recordings(12).resampled(generator=np.random.default_rng(seed))
    mask = held(data, seed)
    originals = [label.split("#")[0] for label in data.labels]
    assert len(set(originals)) < 12
    for label in set(originals):
        assert len({bool(mask[k]) for k, other in enumerate(originals) if other == label}) == 1


def test_one_recording_cannot_be_held_out() -> None:
    with pytest.raises(NumericalFailure, match="there is one recording"):
        held(recordings(1), 0)
    copies = recordings(3).select([1, 1, 1])
    with pytest.raises(NumericalFailure, match="there is one recording"):
        held(copies, 0)
