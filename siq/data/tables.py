"""Tables of recordings, from cells to checked numbers.

Rows without any value are dropped, and those at either end of a recording in which a value is missing. A
missing value between others is refused, since leaving it out makes a gap that its owner should know of. Rows
in no order are sorted by time, but never two recordings into one another: where the time starts over, a new
one begins.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from siq.data.cells import CellFault, agree_on_unit, parse_labels, parse_numbers, seconds_of_clock
from siq.data.columns import check_times
from siq.data.formats import ColumnFile, open_columns
from siq.data.layout import layout_of
from siq.errors import InputError
from siq.numerics.files import files_of

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


class CheckedTable(NamedTuple):
    """What `siq.data.recordings.Recordings` is made of, by the same names."""

    names: tuple[str, ...]
    units: tuple[str | None, ...]
    labels: tuple[str, ...]
    recording: np.ndarray
    t: np.ndarray
    values: np.ndarray
    time_unit: str | None
    headings: tuple[str, ...]
    notes: tuple[str, ...]


def read_tables(
    path: str | Path,
    *,
    columns: Sequence[str] | None,
    units: Mapping[str, str] | None,
    gaps: bool = True,
) -> CheckedTable:
    """Read a file of recordings, or a folder that holds one file per recording.

    See `siq.data.recordings.read_recordings`.
    """
    if not Path(path).is_dir():
        return checked_table(str(path), open_columns(path), columns, units, gaps=gaps)
    files = files_of(Path(path))
    tables = [checked_table(str(file), open_columns(file), columns, units, gaps=gaps) for file in files]
    return _joined(files, tables, str(path))


def checked_table(
    file: str,
    source: ColumnFile,
    columns: Sequence[str] | None,
    units: Mapping[str, str] | None,
    *,
    gaps: bool = True,
) -> CheckedTable:
    """Check a table that has been opened.

    Parameters
    ----------
    file
        What messages call it.
    source
        Its columns.
    columns, units, gaps
        See `siq.data.recordings.read_recordings`.

    Raises
    ------
    InputError
        For the first thing that cannot be used.
    """
    layout = layout_of(file, source, columns)
    used = [layout.time, *layout.states]
    cells = source.load([*([] if layout.recording is None else [layout.recording]), *used])
    labels_of_rows = cells.pop(0) if layout.recording is not None else None
    if len(cells[0]) == 0:
        raise InputError(file, "", "the table has no rows", "write at least two samples of one recording")
    called = [source.headings[place].strip() if place == layout.time else layout.titles[index - 1]
              for index, place in enumerate(used)]  # fmt: skip
    names = ["t", *layout.names]
    numbers = np.empty((len(used), len(cells[0])))
    found_units: list[str | None] = []
    faults: list[CellFault] = []
    notes = list(layout.notes)
    for index, (name, place) in enumerate(zip(names, used, strict=True)):
        clock = seconds_of_clock(file, called[index], cells[index]) if name == "t" else None
        cell_unit: str | None = "s"
        if clock is not None:
            numbers[index] = clock[0]
            notes.append(f"the times were turned into seconds since the first, {clock[1]}")
        else:
            shown = name if name == "t" else called[index]
            numbers[index], cell_unit, fault = parse_numbers(file, shown, cells[index])
            faults += [fault] if fault else []
        stated = {**layout.units[place], "cells": cell_unit}
        found_units.append(agree_on_unit(file, called[index], stated, (units or {}).get(name)))
    rows, fault = _grouped(file, labels_of_rows, numbers)
    faults += [fault] if fault else []
    _refuse(file, faults)
    rows = trim(rows, numbers)
    if gaps:
        rows = _without_gaps(rows, numbers)
    _refuse_missing(file, numbers, rows, ["t", *called[1:]])
    rows = put_in_order(rows, numbers, labelled=layout.recording is not None)
    check_times(file, numbers[0][rows.order], rows.recording, rows.labels, rows.order)
    return CheckedTable(
        names=layout.names,
        units=tuple(found_units[1:]),
        labels=rows.labels,
        recording=rows.recording,
        t=numbers[0][rows.order],
        values=np.ascontiguousarray(numbers[1:, rows.order].T),
        time_unit=found_units[0],
        headings=() if layout.titles == layout.names else layout.titles,
        notes=(*notes, *rows.notes),
    )


def _grouped(file: str, labels: object, numbers: np.ndarray) -> tuple[Rows, CellFault | None]:
    """The rows by recording; those without a label and without any number are padding and left out."""
    blank = np.isnan(numbers).all(axis=0)
    notes: tuple[str, ...] = ()
    if labels is None:
        order = np.flatnonzero(~blank)
        rows = Rows(order, np.zeros(len(order), dtype=np.int64), ("0",))
        fault = None
    else:
        recording, names, fault = parse_labels(file, labels, blank=blank)
        order = np.flatnonzero(recording >= 0)
        order = order[np.argsort(recording[order], kind="stable")]
        rows = Rows(order, recording[order], names)
    dropped = numbers.shape[1] - len(rows.order)
    if dropped:
        notes = (f"{dropped} empty row{'s were' if dropped > 1 else ' was'} left out",)
    return Rows(rows.order, rows.recording, rows.labels, notes), fault


def _refuse(file: str, faults: Sequence[CellFault]) -> None:
    if faults:
        first = min(faults, key=lambda each: each.row)
        raise InputError(file, f"row {first.row}, column {first.column}", first.fault, first.remedy)


def _without_gaps(rows: Rows, numbers: np.ndarray) -> Rows:
    """Leave out rows in which a measured value is missing, where they are the few.

    Their times tell the gap, across which nothing is learned. Where most are missing, the columns were hardly
    meant to be one state, and they are refused.
    """
    missing = np.isnan(numbers[1:, rows.order]).any(axis=0) & ~np.isnan(numbers[0, rows.order])
    count = int(missing.sum())
    if not count or 2 * count > len(missing):
        return rows
    said = (
        "1 row in which a value is missing was"
        if count == 1
        else f"{count} rows in which a value is missing were"
    )
    note = f"{said} left out; nothing is learned across the gap{'' if count == 1 else 's'}"
    kept = ~missing
    present, recording = np.unique(rows.recording[kept], return_inverse=True)
    labels = tuple(rows.labels[place] for place in present)
    return Rows(rows.order[kept], recording, labels, (*rows.notes, note))


def _refuse_missing(file: str, numbers: np.ndarray, rows: Rows, called: Sequence[str]) -> None:
    missing = np.isnan(numbers[:, rows.order])
    if not missing.any():
        return
    wrong = np.flatnonzero(missing.any(axis=0))
    row = int(rows.order[wrong].min())
    column = int(np.argmax(np.isnan(numbers[:, row])))
    if len(wrong) == len(rows.order) and len(wrong) > 2:
        raise InputError(
            file, "", "no row has a value in every column",
            "interpolate all columns to the same times, or name the states in the study",
        )  # fmt: skip
    others = f", as in {len(wrong) - 1} more row{'s' if len(wrong) > 2 else ''}" if len(wrong) > 1 else ""
    remedy = (
        "remove the row or write a finite number"
        if not others
        else "remove these rows or write finite numbers"
    )
    raise InputError(
        file,
        f"row {row + 1}, column {called[column]}",
        f"the value is missing (empty or NaN){others}",
        remedy,
    )


def _joined(files: Sequence[Path], tables: Sequence[CheckedTable], folder: str) -> CheckedTable:
    """Tables of one folder as one; the name of a file is that of its recording."""
    first = tables[0]
    places = [[0] * 0 for _ in tables]
    labels: list[str] = []
    for file, table, order in zip(files, tables, places, strict=True):
        if set(table.names) != set(first.names):
            odd = sorted(set(table.names) ^ set(first.names))
            raise InputError(
                str(file), "", f"its columns are {', '.join(table.names)}, and those of {files[0].name} are"
                f" {', '.join(first.names)}",
                f"give {', '.join(odd)} to all files or to none, or name the states in the study",
            )  # fmt: skip
        order += [table.names.index(name) for name in first.names]
        stem = file.stem
        if [other.stem for other in files].count(stem) > 1:
            stem = file.name
        labels += [stem] if len(table.labels) == 1 else [f"{stem}/{label}" for label in table.labels]
    names = [file.name for file in files]
    units = []
    for index, name in enumerate(first.names):
        stated = [table.units[order[index]] for table, order in zip(tables, places, strict=True)]
        units.append(agree_on_unit(folder, name, dict(zip(names, stated, strict=True)), None))
    stated = [table.time_unit for table in tables]
    time_unit = agree_on_unit(folder, "t", dict(zip(names, stated, strict=True)), None)
    counts = np.cumsum([0, *(len(table.labels) for table in tables)])
    notes = [f"the folder holds {len(files)} files, one recording each" if len(labels) == len(files)
             else f"the folder holds {len(files)} files with {len(labels)} recordings"]  # fmt: skip
    for note in dict.fromkeys(note for table in tables for note in table.notes):
        having = sum(note in table.notes for table in tables)
        notes.append(note if having == len(tables) else f"in {having} of {len(tables)} files {note}")
    return CheckedTable(
        names=first.names,
        units=tuple(units),
        labels=tuple(labels),
        recording=np.concatenate(
            [table.recording + start for table, start in zip(tables, counts, strict=False)]
        ),
        t=np.concatenate([table.t for table in tables]),
        values=np.concatenate([table.values[:, order] for table, order in zip(tables, places, strict=True)]),
        time_unit=time_unit,
        headings=first.headings,
        notes=tuple(notes),
    )
