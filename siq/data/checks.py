"""Tables of recordings: are the columns there and of one length, and do the times increase.

What is asked of a table as a whole, whatever file it is from; single cells are checked by
`siq.data.cells`.
"""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from siq.errors import InputError

if TYPE_CHECKING:
    from siq.data.cells import Column


def find_columns(file: str, names: Sequence[str], columns: Sequence[str] | None) -> list[int]:
    """Find the positions of ``recording``, of ``t`` and of the measured columns among the names.

    Parameters
    ----------
    file
        The file, for messages.
    names
        The names of all columns, in the order of the file.
    columns
        The measured columns wanted; None for all.

    Raises
    ------
    InputError
        When a column is missing, stands twice or has no name, or nothing is measured.
    ValueError
        When `columns` repeats a name, or holds ``recording`` or ``t``.
    """
    if columns is not None and (len(set(columns)) < len(columns) or {"recording", "t"} & set(columns)):
        raise ValueError(f"the columns {list(columns)} are not distinct measured columns")
    known = [name for name in names if name not in ("recording", "t")]
    wanted = ["recording", "t", *(known if columns is None else columns)]
    for name in wanted:
        place = f"column {names.index(name) + 1}" if name in names else ""
        if name not in names:
            raise InputError(file, "", f"the column '{name}' is missing", _remedy_of_missing(name, known))
        if not name or name.startswith("__index_level_"):  # what pandas makes of the index of a frame
            raise InputError(file, place, "the column has no name", "name it, or write without the row index")
        if names.count(name) > 1:
            remedy = "rename or remove one of them"
            raise InputError(file, f"column {name}", "the column stands twice", remedy)
    if len(wanted) == 2:
        raise InputError(file, "", "there is no measured column", "add one beside 'recording' and 't'")
    return [names.index(name) for name in wanted]


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


def _remedy_of_missing(name: str, known: list[str]) -> str:
    if name == "recording":
        return "add a column 'recording', with one label for all rows if there is only one recording"
    if name == "t":
        near = [each for each in known if each.lower() in ("t", "time")]
        return f"rename '{near[0]}' to 't'" if near else "add the time of every sample as a column 't'"
    near = difflib.get_close_matches(name, known, n=1)
    if near:
        return f"did you mean '{near[0]}'"
    return f"the measured columns are {', '.join(known)}" if known else "add it"
