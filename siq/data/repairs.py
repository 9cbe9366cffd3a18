"""What in a table can be put right without a guess: padding, rows that stand twice, or in no order?

Rows without any value are dropped, and those at either end of a recording in which a value is missing. A
missing value between others is refused, since leaving it out makes a gap that its owner should know of. Rows
in no order are sorted by time, but never two recordings into one another: where the time starts over, a new
one begins.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

RESTART = 0.1  # of the time that a recording took: where it starts over, it does so near its beginning
SHUFFLED = (
    1 / 3
)  # of the steps lead back in time: recordings of three samples, one after another, have as many


@dataclass(frozen=True)
class Rows:
    """Which rows are kept, in which order, of which recording.

    Attributes
    ----------
    order
        Shape ``(n,)``: indices of rows; those of a recording stand together.
    recording
        Shape ``(n,)``: the recording of each.
    labels
        Of the recordings.
    notes
        What was done.
    """

    order: np.ndarray
    recording: np.ndarray
    labels: tuple[str, ...]
    notes: tuple[str, ...] = ()


def trim(rows: Rows, numbers: np.ndarray) -> Rows:
    """Drop rows at the ends of recordings in which a number is missing, where two others are left.

    Parameters
    ----------
    rows
        As they stand.
    numbers
        Shape ``(k, n)``: the time and the measured columns, by the rows of the file.
    """
    whole = ~np.isnan(numbers[:, rows.order]).any(axis=0)
    if whole.all():
        return rows
    place = np.arange(len(whole))
    count = len(rows.labels)
    first, last = np.full(count, len(whole)), np.full(count, -1)
    np.minimum.at(first, rows.recording[whole], place[whole])
    np.maximum.at(last, rows.recording[whole], place[whole])
    inner = np.bincount(rows.recording[whole], minlength=count) >= 2
    keep = (place >= first[rows.recording]) & (place <= last[rows.recording]) | ~inner[rows.recording]
    dropped = int((~keep).sum())
    if dropped == 0:
        return rows
    at = len(np.unique(rows.recording[~keep]))
    note = (
        f"{_rows(dropped)} with missing values at the beginning or the end of"
        f" {_recordings(at)} {'was' if dropped == 1 else 'were'} left out"
    )
    return Rows(rows.order[keep], rows.recording[keep], rows.labels, (*rows.notes, note))


def put_in_order(rows: Rows, numbers: np.ndarray, *, labelled: bool) -> Rows:
    """Drop rows that stand twice, sort rows in no order, begin a recording where the time starts over.

    Parameters
    ----------
    rows
        As they stand.
    numbers
        Shape ``(k, n)``: the time and the measured columns, by the rows of the file.
    labelled
        Whether the table says where its recordings begin.
    """
    t = numbers[0]
    bounds = np.searchsorted(rows.recording, np.arange(len(rows.labels) + 1))
    steps = np.diff(t[rows.order])
    inside = rows.recording[1:] == rows.recording[:-1]
    if not (inside & (steps <= 0)).any():
        return rows
    parts, labels, notes = [], [], {"sorted": 0, "twice": 0, "begun": 0}
    for index, label in enumerate(rows.labels):
        own = rows.order[bounds[index] : bounds[index + 1]]
        pieces = [own]
        back = int((np.diff(t[own]) < 0).sum())
        if back >= 3 and back > SHUFFLED * (len(own) - 1):
            order = own[np.argsort(t[own], kind="stable")]
            if (np.diff(t[_once(order, numbers)]) > 0).all():
                notes["sorted"] += 1
                pieces = [order]
        elif back and not labelled:
            pieces = _restarts(own, t)
            notes["begun"] += len(pieces) - 1
        for number, piece in enumerate(pieces):
            once = _once(piece, numbers)
            notes["twice"] += len(piece) - len(once)
            parts.append(once)
            labels.append(label if len(pieces) == 1 else f"{label}/{number}" if label != "0" else str(number))
    said = []
    if notes["sorted"]:
        said.append(f"the rows of {_recordings(notes['sorted'])} stood in no order and were sorted by time")
    if notes["begun"]:
        said.append(f"the time starts over {_times(notes['begun'])}, and each time a new recording begins")
    if notes["twice"]:
        said.append(
            f"{_rows(notes['twice'])} stood twice and {'was' if notes['twice'] == 1 else 'were'} taken once"
        )
    return Rows(
        np.concatenate(parts),
        np.repeat(np.arange(len(parts)), [len(part) for part in parts]),
        tuple(labels),
        (*rows.notes, *said),
    )


def _once(rows: np.ndarray, numbers: np.ndarray) -> np.ndarray:
    """The rows without those that are, to the last number, like the row before."""
    own = numbers[:, rows]
    same = (own[:, 1:] == own[:, :-1]).all(axis=0)
    return rows[np.append(True, ~same)]


def _restarts(rows: np.ndarray, t: np.ndarray) -> list[np.ndarray]:
    """The rows, cut wherever the time returns to near its beginning; whole where it goes back elsewhere."""
    time = t[rows]
    cuts = np.flatnonzero(np.diff(time) < 0) + 1
    begin = 0
    for cut in cuts.tolist():
        if time[cut] > time[begin] + RESTART * (time[cut - 1] - time[begin]):
            return [rows]
        begin = cut
    return np.split(rows, cuts)


def _rows(count: int) -> str:
    return "one row" if count == 1 else f"{count} rows"


def _recordings(count: int) -> str:
    return "one recording" if count == 1 else f"{count} recordings"


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"
