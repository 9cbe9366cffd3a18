"""What was cut is put together again where it belongs together, and nowhere else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from siq.data.preparation import in_stretches, joined
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
