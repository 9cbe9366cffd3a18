"""Which column is the time, which says the recording, and which are states?

``recording`` and ``t`` are the plain names. Where they are missing, a column of another name for the same
thing takes their place, and that is said; a table that names no recordings is one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from siq.data.columns import TIME_UNITS, Heading, is_index, is_label, is_time, read_heading, usable_name
from siq.data.formats import ColumnFile
from siq.errors import InputError, suggestion


@dataclass(frozen=True)
class Layout:
    """The columns of a table by what they mean.

    Attributes
    ----------
    recording
        Position of the labels, None where all rows are one recording.
    time
        Position of the time.
    states
        Positions of the measured columns.
    names, titles
        Of the measured columns, in formulas and to people.
    units
        By position: what the heading says, and what stands elsewhere, by the place.
    notes
        What was assumed.
    """

    recording: int | None
    time: int
    states: tuple[int, ...]
    names: tuple[str, ...]
    titles: tuple[str, ...]
    units: tuple[dict[str, str | None], ...]
    notes: tuple[str, ...]


def layout_of(file: str, source: ColumnFile, columns: Sequence[str] | None) -> Layout:
    """Find the time, the labels and the measured columns.

    Parameters
    ----------
    file
        The file, for messages.
    source
        Its columns.
    columns
        The names of the measured columns wanted, in the order of the state vector; None for all.

    Raises
    ------
    InputError
        When a column is missing, stands twice or has no name, or nothing is measured.
    ValueError
        When `columns` repeats a name, or holds ``recording`` or ``t``.
    """
    if columns is not None and (len(set(columns)) < len(columns) or {"recording", "t"} & set(columns)):
        raise ValueError(f"the columns {list(columns)} are not distinct measured columns")
    parts = [read_heading(heading) for heading in source.headings]
    kept = source.titles or (None,) * len(parts)
    titles = [title or part.title for title, part in zip(kept, parts, strict=True)]
    plain = [part.title for part in parts]
    _refuse_twice(file, plain, source)
    notes = list(source.notes)
    taken = set() if columns is None else {place for place, part in enumerate(parts) if part.title in columns}
    free = [place for place in range(len(parts)) if place not in taken]
    dropped = _row_numbers(source, plain, free, notes)
    free = [place for place in free if place not in dropped]
    time = _time_column(file, source.headings, parts, free, notes)
    free.remove(time)
    recording = _label_column(source, plain, free, notes)
    if recording is not None and recording in free:
        free.remove(recording)
    if columns is None:
        others = [place for place in free if _second_time(source, parts[place], place)]
        for place in others:
            notes.append(f"the column '{source.headings[place]}' looks like a second time and was left out")
        states = [place for place in free if place not in others]
        names = _distinct([usable_name(plain[place]) for place in states])
        for place in states:
            if not plain[place]:
                raise InputError(
                    file, f"column {place + 1}", "the column has no name", "name it, or remove the column"
                )
        for place, name in zip(states, names, strict=True):
            if name != plain[place]:
                notes.append(f"'{titles[place]}' is called {name} in formulas")
    else:
        known = [place for place in range(len(parts)) if place not in (time, recording, *dropped)]
        states = [_wanted(file, name, plain, known, notes) for name in columns]
        names = list(columns)
    if not states:
        raise InputError(file, "", "there is no measured column", "add one beside 'recording' and 't'")
    units = tuple(
        {"name": part.unit, "metadata": unit} for part, unit in zip(parts, source.units, strict=True)
    )
    return Layout(
        recording,
        time,
        tuple(states),
        tuple(names),
        tuple(titles[place] for place in states),
        units,
        tuple(notes),
    )


def _refuse_twice(file: str, plain: list[str], source: ColumnFile) -> None:
    for name in plain:
        if name and plain.count(name) > 1:
            raise InputError(
                file, f"column {name}", "the column stands twice", "rename or remove one of them"
            )


def _row_numbers(source: ColumnFile, plain: list[str], free: list[int], notes: list[str]) -> set[int]:
    """Columns that only count the rows, as pandas writes them, and empty ones at the end of all lines."""
    dropped = set()
    for place in free:
        if not is_index(plain[place]):
            continue
        values = _numbers(source, place)
        if values is None:
            continue
        if np.isnan(values).all():
            dropped.add(place)
        elif _counts(values):
            dropped.add(place)
            called = f"'{source.headings[place]}'" if plain[place] else f"{place + 1}, which has no name,"
            notes.append(f"the column {called} counts the rows and was left out")
    return dropped


def _counts(values: np.ndarray) -> bool:
    """Whether values are 0, 1, 2, … from any start, or that of a table whose rows were taken or mixed."""
    whole = bool((np.isfinite(values) & (values == np.round(values))).all())
    return (whole and len(np.unique(values)) == len(values)) or bool(
        whole and (np.diff(values) == 1).mean() > 0.5
    )


def _numbers(source: ColumnFile, place: int) -> np.ndarray | None:
    try:
        cells = source.load([place])[0]
        if pa.types.is_dictionary(cells.type):
            cells = cells.cast(cells.type.value_type)
        return np.asarray(cells.cast(pa.float64()).to_numpy(zero_copy_only=False))
    except (pa.ArrowInvalid, pa.ArrowNotImplementedError, InputError):
        return None


def _may_be_time(part: Heading) -> bool:
    return part.unit is None or part.unit.casefold() in {unit.casefold() for unit in TIME_UNITS}


def _second_time(source: ColumnFile, part: Heading, place: int) -> bool:
    """Whether a column is another clock: called so, and ever increasing but where recordings begin."""
    if not is_time(part.title) or not _may_be_time(part) or part.title == "T":
        return False
    values = _numbers(source, place)
    return values is None or bool((np.diff(values) > 0).mean() > 0.5)


def _time_column(
    file: str, headings: Sequence[str], parts: list[Heading], free: list[int], notes: list[str]
) -> int:
    found = [place for place in free if parts[place].title == "t"]
    if found:
        return found[0]
    found = [place for place in free if is_time(parts[place].title) and _may_be_time(parts[place])]
    if len(found) > 1:
        # "T" is a temperature rather than a time.
        found = [place for place in found if parts[place].title != "T"]
    if len(found) == 1:
        notes.append(f"the column '{parts[found[0]].title}' is the time")
        return found[0]
    if found:
        names = " and ".join(f"'{headings[place].strip()}'" for place in found)
        raise InputError(file, "", f"the columns {names} all look like the time", "call the right one 't'")
    remedy = "add the time of every sample as a column 't'"
    raise InputError(file, "", "the column 't' is missing", remedy)


def _label_column(source: ColumnFile, plain: list[str], free: list[int], notes: list[str]) -> int | None:
    exact = [place for place in range(len(plain)) if plain[place] == "recording"]
    if exact:
        return exact[0]
    for place in free:
        if not is_label(plain[place]):
            continue
        values = _numbers(source, place)
        if values is not None and (np.any(values != np.round(values)) or np.isnan(values).all()):
            continue  # measured, and no label
        if values is not None and len(values) > 1 and len(np.unique(values)) == len(values):
            free.remove(place)
            notes.append(f"the column '{plain[place]}' counts the rows and was left out")
            continue
        notes.append(f"the column '{plain[place]}' says which recording a row belongs to")
        return place
    return None


def _distinct(names: list[str]) -> list[str]:
    """Names, those that came out alike told apart by numbers: ``x_a``, ``x_a_2``."""
    given: list[str] = []
    for name in names:
        candidate, count = name, 1
        while candidate in given:
            count += 1
            candidate = f"{name}_{count}"
        given.append(candidate)
    return given


def _wanted(file: str, name: str, plain: list[str], known: list[int], notes: list[str]) -> int:
    """The column that is meant by a name: called so, or nearly so, if there is but one."""
    for matches in (
        [place for place in known if plain[place] == name],
        [place for place in known if usable_name(plain[place]) == name],
        [place for place in known if usable_name(plain[place]).casefold() == name.casefold()],
    ):
        if len(matches) == 1:
            if plain[matches[0]] != name:
                notes.append(f"'{plain[matches[0]]}' is called {name} in formulas")
            return matches[0]
    titles = [plain[place] for place in known if plain[place]]
    remedy = suggestion(name, titles, otherwise=f"the measured columns are {', '.join(titles)}")
    raise InputError(file, "", f"the column '{name}' is missing", remedy if titles else "add it")
