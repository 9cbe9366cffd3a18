"""Tables of recordings: are the columns there and of one length, and do the times increase.

What is asked of a table as a whole, whatever file it is from; single cells are checked by
`siq.data.cells`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from siq.errors import InputError

if TYPE_CHECKING:
    from siq.data.cells import Column


def equally_long(file: str, columns: dict[str, Column]) -> list[Column]:
    """Give the columns, by name, as a list; InputError for the first that is not as long as the first one."""
    lengths = {name: len(column) for name, column in columns.items()}
    first = next(iter(lengths), "")
    for name, length in lengths.items():
        if length != lengths[first]:
            raise InputError(
                file,
                f"column {name}",
                f"it has {length} rows while column {first} has {lengths[first]}",
                "give all columns one value per sample, or name the columns to read",
            )
    return list(columns.values())


def check_times(
    file: str, t: np.ndarray, recording: np.ndarray, labels: tuple[str, ...], rows: np.ndarray
) -> None:
    """Refuse times that do not increase within every recording.

    Parameters
    ----------
    file
        The file, for messages.
    t, recording
        Shape ``(n,)``: the time and the recording of each row; the rows of a recording stand together.
    labels
        The label of each recording.
    rows
        Shape ``(n,)``: where each row stands in the file, counted from 0.

    Raises
    ------
    InputError
        For the first row of the file whose time is repeated or earlier, or when no recording has two rows.
    """
    same = recording[1:] == recording[:-1]
    if not same.any():
        remedy = "give the rows of one recording the same label"
        raise InputError(file, "", "no recording has two samples", remedy)
    wrong = np.flatnonzero(same & (t[1:] <= t[:-1]))
    if wrong.size == 0:
        return
    earlier = wrong[np.argmin(rows[wrong + 1])]
    label, before, now = labels[recording[earlier]], float(t[earlier]), float(t[earlier + 1])
    if now == before:
        fault = f"the time {now} of recording '{label}' is repeated (row {rows[earlier] + 1} has it too)"
        remedy = "keep one of the two rows, or label them as two recordings"
    else:
        fault = f"the times of recording '{label}' are unsorted ({now} comes after {before})"
        remedy = "sort its rows by t, or begin a new label where a new recording begins"
    raise InputError(file, f"row {rows[earlier + 1] + 1}, column t", fault, remedy)
