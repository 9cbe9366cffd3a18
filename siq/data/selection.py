"""Selection of recordings: whole ones, stretches, resampled ones, and those that are held out."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from siq.data.columns import distinct_labels, sources
from siq.data.correlation import noise_floors
from siq.data.inspection import SINGLE_REMEDY
from siq.data.recordings import Recordings
from siq.data.stationarity import correlated_samples, runs_of
from siq.errors import NumericalFailure


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


STRETCHES = 10  # of a single recording, at least, two of which are held out
MOST_STRETCHES = 40  # more make no error better known
STRETCH_LABEL = re.compile(r"(?P<label>.*) \((?P<number>\d+) of (?P<of>\d+)\)")
LENGTH = 10  # correlation times in a stretch: what is left of its first sample at its end is then nothing


def in_stretches(recordings: Recordings, *, hidden_velocities: bool = False) -> Recordings:
    """Cut a recording that is the only one into stretches, of which some can be held out, or drawn again.

    Stretches are ten correlation times long, hops included, where this makes between ten and forty of them.
    Several recordings come back as they are, and so does one of fewer than `STRETCHES` pairs, or without
    random forces: a system that settles once is not seen again in another stretch.

    Parameters
    ----------
    recordings
        Trajectories.
    hidden_velocities
        Whether they are positions: these are smooth, however strong the random forces on velocities are, and
        whether there are any is found together with f.
    """
    count = len(recordings.t)
    if len(np.unique(sources(recordings.labels))) > 1 or len(recordings.labels) > 1 or count < 2 * STRETCHES:
        return recordings
    floors = noise_floors(recordings)
    if floors is not None and all(floor.process == 0 for floor in floors) and not hidden_velocities:
        return recordings
    runs = runs_of(recordings)
    longest = max(correlated_samples(column, runs) for column in recordings.values.T)
    cut = int(np.clip(count / (LENGTH * longest), STRETCHES, min(MOST_STRETCHES, count // 2)))
    label = recordings.labels[0]
    note = f"there is one recording; it was cut into {cut} stretches, so that some can be held out"
    return replace(
        recordings,
        labels=tuple(f"{label} ({number} of {cut})" for number in range(1, cut + 1)),
        recording=np.arange(count) * cut // count,
        notes=(*recordings.notes, note),
    )


def joined(recordings: Recordings) -> Recordings:
    """Put together again what `in_stretches` has cut, where one stretch follows the other.

    What takes long, such as a hop or a memory, is not seen in a stretch: how long a record remembers, and how
    it hops, is asked of the record as a whole. Rows stay as they are.
    """
    numbers = [STRETCH_LABEL.fullmatch(label) for label in recordings.labels]
    follows = [False] + [
        one is not None
        and other is not None
        and (one["label"], one["of"], int(one["number"]) + 1)
        == (other["label"], other["of"], int(other["number"]))
        for one, other in pairwise(numbers)
    ]
    if not any(follows):
        return recordings
    labels = tuple(
        label if number is None else number["label"]
        for label, number, later in zip(recordings.labels, numbers, follows, strict=True)
        if not later
    )
    if len(set(labels)) < len(labels):  # of recordings drawn again, some may follow, and others not
        labels = tuple(label for label, later in zip(recordings.labels, follows, strict=True) if not later)
    whole = np.cumsum(~np.array(follows)) - 1
    return replace(recordings, labels=labels, recording=whole[recordings.recording])


SHARE = 0.2  # a convention: the usual fifth


def held_out_recordings(
    recordings: Recordings, *, generator: np.random.Generator, share: float = SHARE
) -> np.ndarray:
    """A random part of the recordings, as a mask over ``recordings.labels``.

    Copies of a resampled recording stay together: none is held out while another is fitted.

    Raises
    ------
    NumericalFailure
        When all recordings are copies of one, so that none can be held out.
    """
    groups = np.asarray(sources(recordings.labels))
    names = np.unique(groups)
    if len(names) < 2:
        raise NumericalFailure(
            "there is only one recording, and it shows no random forces or is too short to be divided, so"
            f" that none can be held out; {SINGLE_REMEDY}"
        )
    count = min(max(round(share * len(names)), 1), len(names) - 1)
    return np.isin(groups, generator.permutation(names)[:count])
