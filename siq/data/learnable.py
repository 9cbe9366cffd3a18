"""Can anything be learned from these recordings, and what has to be said of it before that takes long?"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from siq.data.noise_floor import noise_floors
from siq.data.recordings import Recordings, SnapshotPairs, read_recordings, snapshot_pairs
from siq.errors import InputError

TURNS = {2 * np.pi: "2π", 360.0: "360"}  # of an angle, in radians and in degrees
NEARLY = 0.9  # of a turn: a jump by so much, in a column that stays within one, is no motion

SINGLE = (
    "there is one recording, and it shows no random forces: it leads into one stable state and tells nothing"
    " of others, nor of barriers"
)
SINGLE_REMEDY = (
    "record how the system settles from many starting points, or one long record in which noise makes it hop;"
    " if these are positions of something that has inertia, set 'identification.hidden_velocities'"
)


def checked_for_learning(
    recordings: Recordings, *, file: str, chosen: bool, hidden_velocities: bool = False
) -> Recordings:
    """Refuse what nothing can be learned from; leave out columns that never change.

    Parameters
    ----------
    recordings
        As read.
    file
        For messages.
    chosen
        Whether somebody named the states: then none is left out.
    hidden_velocities
        Whether they are positions: these are smooth, however strong the random forces on velocities are.

    Raises
    ------
    InputError
        For a single recording without noise, and for a state that never changes.
    """
    recordings = _moving(recordings, file=file, chosen=chosen)
    if len(recordings.labels) == 1 and not hidden_velocities:
        floors = noise_floors(recordings)
        if floors is not None and all(floor.process == 0 for floor in floors):
            raise InputError(file, "", SINGLE, SINGLE_REMEDY)
    return replace(recordings, notes=(*recordings.notes, *remarks(recordings)))


def _moving(recordings: Recordings, *, file: str, chosen: bool) -> Recordings:
    still = np.ptp(recordings.values, axis=0) == 0
    if not still.any():
        return recordings
    title = recordings.titles[int(np.argmax(still))]
    value = f"{recordings.values[0, int(np.argmax(still))]:g}"
    if still.all() or chosen:
        raise InputError(
            file, f"column {title}", f"it is {value} in every row, and what never changes is no state",
            "leave it out of the states" if chosen else "record how the system moves",
        )  # fmt: skip
    kept = np.flatnonzero(~still)
    notes = [
        f"the column '{name}' is {recordings.values[0, place]:g} in every row and was left out"
        for place, name in enumerate(recordings.titles)
        if still[place]
    ]
    return replace(
        recordings,
        names=tuple(recordings.names[place] for place in kept),
        units=tuple(recordings.units[place] for place in kept),
        headings=tuple(recordings.headings[place] for place in kept) if recordings.headings else (),
        values=np.ascontiguousarray(recordings.values[:, kept]),
        notes=(*recordings.notes, *notes),
    )


def remarks(recordings: Recordings) -> list[str]:
    """What is unusual, and may be wrong."""
    said = []
    single = int((np.bincount(recordings.recording) == 1).sum())
    if single:
        said.append(
            "one recording has a single sample, which tells nothing"
            if single == 1
            else f"{single} recordings have a single sample each, which tells nothing"
        )
    inside = recordings.recording[1:] == recordings.recording[:-1]
    for title, values in zip(recordings.titles, recordings.values.T, strict=True):
        jumps = np.abs(np.diff(values)[inside])
        for turn, text in TURNS.items():
            count = int((jumps > NEARLY * turn).sum())
            between = ((jumps > 0.5 * turn) & (jumps < NEARLY * turn)).any()
            if count and not between and np.ptp(values) <= turn * (1 + 1e-6):
                times = "once" if count == 1 else f"{count} times"
                said.append(
                    f"'{title}' jumps by {text} {times}, as an angle does that wraps around: unwrap it first,"
                    " or record its sine and cosine"
                )
    return said


def read_pairs(
    path: str | Path,
    *,
    states: Sequence[str] | None,
    units: Mapping[str, str] | None,
    pair_step: float | None,
    hidden_velocities: bool = False,
) -> tuple[Recordings, SnapshotPairs]:
    """Read recordings that something is to be learned from, and their pairs.

    Parameters
    ----------
    path, states, units
        See `read_recordings`.
    pair_step
        See `snapshot_pairs`.
    hidden_velocities
        See `checked_for_learning`.

    Raises
    ------
    InputError
        As `read_recordings` and `checked_for_learning` do, and when no two samples are
        close enough to be a pair.
    """
    recordings = read_recordings(path, columns=states, units=units)
    recordings = checked_for_learning(
        recordings, file=str(path), chosen=states is not None, hidden_velocities=hidden_velocities
    )
    try:
        pairs = snapshot_pairs(recordings, pair_step=pair_step)
    except ValueError as error:
        raise InputError(path, "", str(error), "raise recordings.pair_step in the study") from None
    without = len(recordings.labels) - len(np.unique(pairs.recording))
    single = int((np.bincount(recordings.recording) == 1).sum())
    if without > single:
        note = (
            f"{without - single} of {len(recordings.labels)} recordings have longer steps than the others and"
            " give no pairs; recordings.pair_step in the study says how long a step may be"
        )
        recordings = replace(recordings, notes=(*recordings.notes, note))
    return recordings, pairs
