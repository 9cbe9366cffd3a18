"""Selection: whole recordings, chosen or drawn, since the samples of one recording are not independent."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from siq.data.labels import distinct_labels
from siq.data.recordings import Recordings


def select_recordings(recordings: Recordings, indices: Sequence[int] | np.ndarray) -> Recordings:
    """Take whole recordings, in the order given.

    Parameters
    ----------
    recordings
        The trajectories.
    indices
        Indices into ``recordings.labels``, not of rows. One that stands twice gives copies, told apart by
        their labels: ``r07``, ``r07#2``.

    Raises
    ------
    ValueError
        When `indices` is empty, is a mask, or points outside the recordings.
    """
    chosen = np.asarray(indices)
    count = len(recordings.labels)
    if chosen.ndim != 1 or chosen.dtype.kind not in "iu" or chosen.size == 0:
        raise ValueError("recordings are selected by a list of at least one index")
    if chosen.min() < 0 or chosen.max() >= count:
        raise ValueError(f"a selected recording is not one of 0 ... {count - 1}")
    bounds = np.searchsorted(recordings.recording, np.arange(count + 1))
    lengths = np.diff(bounds)[chosen]
    begins = np.cumsum(lengths) - lengths
    rows = np.arange(lengths.sum()) + np.repeat(bounds[chosen] - begins, lengths)
    return replace(
        recordings,
        labels=distinct_labels(recordings.labels, chosen),
        recording=np.repeat(np.arange(len(chosen)), lengths),
        t=recordings.t[rows],
        values=recordings.values[rows],
    )


def resample_recordings(recordings: Recordings, *, generator: np.random.Generator) -> Recordings:
    """Draw as many recordings as there are, with replacement: one bootstrap sample.

    Whole recordings are drawn, not rows, since the samples of one recording are not independent.

    Parameters
    ----------
    recordings
        The trajectories.
    generator
        Where the draw comes from; the only source of chance.
    """
    count = len(recordings.labels)
    return select_recordings(recordings, generator.integers(count, size=count))
