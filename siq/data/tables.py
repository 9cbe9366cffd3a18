"""Tables of recordings: from cells of text or numbers to checked trajectories.

Cells become numbers, labels, units and times; dates and times of day become seconds since the first of the
file. The first cell that cannot be used is refused with its row and column; rows are counted from 1.

Rows without any value are dropped, and those at either end of a recording in which a value is missing. Of a
missing value between others the row is left out where such rows are few, since its time tells the gap, across
which nothing is learned. Rows in no order are sorted by time, but never two recordings into one another:
where the time starts over, a new one begins.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc

from siq.data.correlation import FEWEST_VALUES, MIN_REPETITIONS
from siq.data.formats import Column, ColumnFile, open_columns
from siq.data.layout import MONTHS, TIME_OF_DAY, layout_of, read_heading
from siq.data.recordings import LONGEST_STEP, TABLE, Recordings
from siq.errors import InputError
from siq.numerics.files import files_of
from siq.remarks import Remark, sentence

if TYPE_CHECKING:
    import xarray

AN_HOUR = 3600.0  # in seconds, in which dates are read
# Text that holds a number, and what may follow as its unit: "1.2mm", "5 %", but "3 1/s" only after a space.
_NUMBER = r"(?:[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?|[+-]?(?i:nan|infinity|inf))"
_UNIT = r"(?:\s*[^\W\d_]|\s*[%°‰]|\s+1/)[^,;]*"
_ISO_DATE = re.compile(r"\d{4}-\d{2}(-\d{2}([T ]\d{2}:\d{2}(:\d{2}([.,]\d+)?)?\s*(Z|[+-]\d{2}:?\d{2})?)?)?")
_GERMAN_DATE = re.compile(r"\d{1,2}\.\d{1,2}\.\d{4}( \d{1,2}:\d{2}(:\d{2}([.,]\d+)?)?)?")
_SLASHED_DATE = re.compile(r"(\d{1,4})/(\d{1,2})/\d{1,4}.*")
_NUMERIC = (
    pa.types.is_floating, pa.types.is_integer, pa.types.is_boolean, pa.types.is_decimal, pa.types.is_null,
)  # fmt: skip
_TEXT = (pa.types.is_string, pa.types.is_large_string, pa.types.is_string_view)
RESTART_SHARE = 0.1  # of the time that a recording took: where it starts over, it does so near its beginning
# Of the steps lead back in time where rows are shuffled: recordings of three samples, one after another, have
# as many.
SHUFFLED_SHARE = 1 / 3
ROUNDED_TIME = 0.75  # of what times are rounded to, by which they are off at most, and a little for the fit
DAY = 86_400.0  # seconds
FEWEST_ON_A_LINE = 10  # steps: fewer may lie on one by themselves
MOST_LAGGED = 10  # rows, by which a column may be behind the one that it copies
MOST_MISSING = 0.5  # of the values of a column, where other columns are fuller
NOISY = 0.25  # share of the steps at which a column turns back, half of what white forces do
LARGEST = 1e100  # numerical: of a value, whose square is finite, too

Fault = tuple[int, InputError]
"""The row, counted from 1, of the first cell of a column that cannot be used, and what is wrong there."""


class _Rows(NamedTuple):
    """Which rows are kept, in which order (those of a recording stand together), and of which recording."""

    order: np.ndarray
    recording: np.ndarray
    labels: tuple[str, ...]


def read_tables(
    source: str | Path | pd.DataFrame | xarray.Dataset, *, columns: Sequence[str] | None,
    units: Mapping[str, str] | None, gaps: bool = True,
) -> Recordings:  # fmt: skip
    """Read a table, in memory or in a file, or a folder that holds one file per recording.

    See `siq.data.recordings.read_recordings`.
    """
    if not isinstance(source, str | Path) or not Path(source).is_dir():
        return _checked(source, columns, units, gaps)
    files = files_of(Path(source))
    return _joined(files, [_checked(file, columns, units, gaps) for file in files], str(source))


def _checked(
    table: str | Path | pd.DataFrame | xarray.Dataset, columns: Sequence[str] | None,
    units: Mapping[str, str] | None, gaps: bool,
) -> Recordings:  # fmt: skip
    """Read and check a table; raises InputError for the first thing that cannot be used."""
    file, source = str(table) if isinstance(table, str | Path) else TABLE, open_columns(table)
    if columns is None:
        source = _stacked(source)
    layout = layout_of(file, source, columns)
    source, used = layout.source, [layout.time, *layout.states]
    cells = source.load([*([] if layout.recording is None else [layout.recording]), *used])
    labels = cells.pop(0) if layout.recording is not None else None
    if len(cells[0]) == 0:
        raise InputError(file, "", "the table has no rows", "write at least two samples of one recording")
    called = [source.headings[layout.time].strip(), *layout.titles]
    numbers = np.empty((len(used), len(cells[0])))
    found_units: list[str | None] = []
    faults: list[Fault] = []
    remarks = list(layout.remarks)
    for index, (name, place) in enumerate(zip(("t", *layout.names), used, strict=True)):
        if index == 0 and (clock := _seconds_of_clock(file, called[0], cells[0])) is not None:
            numbers[index], start = clock
            cell_unit: str | None = "s"
            layout.units[place]["name"] = None  # time_hour over dates says what they are rounded to
            if not np.nan_to_num(numbers[index] % DAY).any():
                numbers[index], cell_unit = numbers[index] / DAY, "d"
            remarks.append(Remark("data.time_of_clock", {"start": start, "unit": cell_unit}))
        else:
            shown = "t" if index == 0 else called[index]
            numbers[index], cell_unit, fault = _parse_numbers(file, shown, cells[index])
            faults += [fault] if fault else []
            if index and (mark := _mark_of_missing(numbers[index])) is not None:
                numbers[index][numbers[index] == mark] = np.nan
                remarks.append(Remark("data.mark_of_missing", {"column": shown, "value": mark}))
        stated = {**layout.units[place], "cells": cell_unit}
        found_units.append(_agreed_unit(file, called[index], stated, (units or {}).get(name)))
    if layout.backwards:
        numbers[0] *= -1
    filled = np.isnan(numbers[1:]).mean(axis=1) <= MOST_MISSING
    if columns is None and numbers.shape[1] > FEWEST_ON_A_LINE and filled.any() and not filled.all():
        told = [called[place + 1] for place in np.flatnonzero(~filled)]
        remarks.append(Remark("data.columns_of_gaps", {"columns": told}))
        kept = np.flatnonzero(filled)
        layout = layout._replace(
            names=tuple(layout.names[place] for place in kept),
            titles=tuple(layout.titles[place] for place in kept),
        )
        numbers, found_units = numbers[[0, *kept + 1]], [found_units[place] for place in (0, *kept + 1)]
    # Rows without a label and without any number are padding.
    blank = np.asarray(np.isnan(numbers).all(axis=0))
    if labels is None:
        order = np.flatnonzero(~blank)
        rows = _Rows(order, np.zeros(len(order), dtype=np.int64), ("0",))
    else:
        recording, names, fault = _parse_labels(file, labels, blank)
        faults += [fault] if fault else []
        order = np.flatnonzero(recording >= 0)
        order = order[np.argsort(recording[order], kind="stable")]
        rows = _Rows(order, recording[order], names)
    if dropped := numbers.shape[1] - len(rows.order):
        remarks.append(Remark("data.empty_rows", {"rows": dropped}))
    if faults:
        raise min(faults, key=lambda each: each[0])[1]
    rows = _complete(file, rows, numbers, ["t", *layout.titles], gaps, remarks)
    _with_all_digits(rows, numbers, remarks)
    rows = _in_order(rows, numbers, layout.recording is not None, remarks)
    check_times(file, numbers[0][rows.order], rows.recording, rows.labels, rows.order)
    found = Recordings(
        names=layout.names, units=tuple(found_units[1:]), labels=rows.labels, recording=rows.recording,
        t=numbers[0][rows.order], values=np.ascontiguousarray(numbers[1:, rows.order].T),
        time_unit=found_units[0], headings=() if layout.titles == layout.names else layout.titles,
        remarks=tuple(remarks),
    )  # fmt: skip
    return found if columns is not None else _without_clocks_and_labels(found)


def _stacked(source: ColumnFile) -> ColumnFile:
    """Columns of one quantity x below each other: recordings, ``cell 1``, ``cell 2``, …, or months."""
    parts = [read_heading(heading) for heading in source.headings]
    words = [re.fullmatch(r"(.*?[^\W\d])[\W_]*\d+", part.title) for part in parts]
    own = [place for place, word in enumerate(words) if word is not None and read_heading(word[1]).is_label]
    kinds = {(words[place][1].casefold(), parts[place].unit) for place in own}  # type: ignore[index]
    months = MONTHS.search(",".join(part.title.replace(",", "")[:3].casefold() for part in parts))
    years = [at for at, part in enumerate(parts) if months and (part.may_be_time or not part.title)]
    cells = [source.load([place])[0].to_pandas() for place in years]
    years = [
        at for at, one in zip(years, cells, strict=True) if one.dtype.kind in "if" and not (one % 1).any()
    ]
    if months and years:
        own = [months.string[: months.start()].count(",") + number for number in range(12)]
    elif len(own) < 2 or len(kinds) > 1 or any(part.is_label for part in parts):
        return source
    rest = [place for place in range(len(parts)) if place not in (*own, *years)]
    gone = [parts[place].title for place in rest if years and not parts[place].is_label]  # means of a year
    rest = [place for place in rest if parts[place].title not in gone]
    titles, unit = {place: parts[place].title for place in own}, parts[own[0]].unit

    def load(positions: Sequence[int]) -> list[pa.Array]:
        kept = [*rest, *years[:1], *own]
        table = pd.DataFrame({at: one.to_pandas() for at, one in zip(kept, source.load(kept), strict=True)})
        table = table.melt([*rest, *years[:1]], own, "own", "x", ignore_index=False).sort_index(kind="stable")
        number = table["own"].map(own.index)
        table["own"] = table[years[0]] + (number + 0.5) / 12 if years else table["own"].map(titles)
        if table["x"].dtype == object:  # a column has marks beside numbers, and another none
            table["x"] = table["x"].map(str, na_action="ignore")
        columns = [*rest, "own", "x"]
        return [pa.array(table[columns[position]], from_pandas=True) for position in positions]

    values = {"first": titles[own[0]], "last": titles[own[-1]], "months": bool(years), "left_out": gone}
    remark = Remark("data.side_by_side", values)
    new = ["t [year]" if years else "recording", f"x [{unit}]" if unit else "x"]
    return replace(
        source, headings=(*(source.headings[place] for place in rest), *new),
        units=(*(source.units[place] for place in rest), None, source.units[own[0]]), load=load, titles=(),
        remarks=(*source.remarks, remark),
    )  # fmt: skip


def _past_midnight(times: pd.Series) -> pd.Series:
    """Times of day that go on: where a day is all that they fall short of the usual step, a new one began."""
    steps = times.dt.total_seconds().diff()
    midnight = (steps < 0) & (steps + DAY > 0) & (steps + DAY <= LONGEST_STEP * steps.median())
    return times + pd.to_timedelta(DAY * midnight.cumsum(), unit="s")


def _without_clocks_and_labels(recordings: Recordings) -> Recordings:
    """Recordings without columns that are no states: a count of rows, a clock, a label, what never changes.

    A clock is a straight line in time in every recording, or never turns back where noise turns another one,
    as the depth of a core; rows may have been sorted since they were counted; a label has a few values, or
    one in each recording. The last column stays.
    """
    elapsed, begins = np.diff(recordings.t), np.diff(recordings.recording) == 0
    ways = np.sign(np.diff(recordings.values, axis=0)[begins])
    turns = max(((ways[1:] * ways[:-1]) < 0).sum(axis=0, initial=0), default=0) / max(len(ways), 1)
    kept, remarks = list[int](), []
    for place, (title, x) in enumerate(zip(recordings.titles, recordings.values.T, strict=True)):
        steps, different = np.diff(x)[begins], np.unique(x)
        slope = float(steps @ elapsed[begins]) / max(float(elapsed[begins] @ elapsed[begins]), 1e-300)
        off = np.abs(steps - slope * elapsed[begins]).max(initial=0.0)
        exact = 1e-9 * max(
            float(np.abs(different).max()), abs(slope) * float(elapsed[begins].max(initial=0.0))
        )
        onwards = turns > NOISY and len(different) >= FEWEST_VALUES and np.ptp(ways[:, place]) <= 1
        counts = len(different) == len(x) and np.array_equal(different, different[0] + np.arange(len(x)))
        if len(steps) > FEWEST_ON_A_LINE and counts:
            remarks.append(Remark("data.column_counts_rows", {"column": title, "place": place}))
        elif len(steps) > FEWEST_ON_A_LINE and slope and (off <= exact or onwards):
            remarks.append(Remark("data.clock_left_out", {"column": title}))
        elif len(different) == 1:
            remarks.append(Remark("data.column_at_rest", {"column": title, "value": float(x[0])}))
        elif not steps.any() or len(different) < FEWEST_VALUES <= len(x) / MIN_REPETITIONS:
            values = {"column": title, "values": len(different), "within": bool(steps.any())}
            remarks.append(Remark("data.label_left_out", values))
        elif len(steps) > FEWEST_ON_A_LINE and (
            copied := [one for one in kept if _copies(recordings, place, one)]
        ):
            remarks.append(
                Remark("data.copy_left_out", {"column": title, "of": recordings.titles[copied[0]]})
            )
        else:
            kept.append(place)
    if not remarks or not kept:
        return recordings
    return recordings.of_states(kept, remarks)


def _copies(recordings: Recordings, place: int, other: int) -> bool:
    """Whether a column is another one, of the same row or of one that is a few before or after it."""
    x, y, recording = recordings.values[:, place], recordings.values[:, other], recordings.recording
    for lag in range(min(MOST_LAGGED, len(x) // 2) + 1):
        same = recording[lag:] == recording[: len(x) - lag]
        for earlier, later in ((x, y), (y, x)):
            first, second = earlier[: len(x) - lag][same], later[lag:][same]
            if len(first) and np.array_equal(first[:100], second[:100]) and np.array_equal(first, second):
                return True
    return False


def _parse_numbers(file: str, name: str, cells: Column) -> tuple[np.ndarray, str | None, Fault | None]:
    """Numbers of a column, NaN where nothing stands, the unit that all cells carry, and the first fault.

    A fault is a cell that is infinite, no number, or in another unit than the first row. A column that as a
    whole holds something other than numbers, such as dates, is refused at once.
    """
    if pa.types.is_dictionary(cells.type):
        cells = cells.cast(cells.type.value_type)
    unit: str | None = None
    fault: Fault | None = None
    if any(is_kind(cells.type) for is_kind in _TEXT):
        cells, unit, fault = _split_units(file, name, cells)
    elif not any(is_kind(cells.type) for is_kind in _NUMERIC):
        remedy = "write it as numbers in one unit"
        raise InputError(file, f"column {name}", f"it holds {cells.type}, not numbers", remedy)
    try:
        values = cells.cast(pa.float64()).to_numpy(zero_copy_only=False)
    except pa.ArrowInvalid:
        remedy = "subtract a constant, such as the time of the first sample"
        raise InputError(file, f"column {name}", "its integers are too large to be exact", remedy) from None
    endless = np.abs(values) > LARGEST
    row = int(np.argmax(endless)) + 1
    if endless.any() and (fault is None or row < fault[0]):
        remedy = "remove the row or write a finite number; where a simulation ran away, end the file before"
        infinite = "the value is infinite, or beyond 10¹⁰⁰"
        fault = row, InputError(file, f"row {row}, column {name}", infinite, remedy)
    return values, unit or None, fault


def _mark_of_missing(values: np.ndarray) -> float | None:
    """The number that stands for a missing value: nines alone, or beyond 10²⁰, and far from all others."""
    known = values[np.isfinite(values)]
    for mark in (float(known.min(initial=np.inf)), float(known.max(initial=-np.inf))):
        if set(f"{abs(mark):.15g}".replace(".", "")) != {"9"} and not 1e20 <= abs(mark) < np.inf:
            continue
        others = known[known != mark]
        if 0 < len(others) < len(known) - 1 and np.abs(others - mark).min() > np.ptp(others):
            return mark
    return None


def _split_units(file: str, name: str, cells: Column) -> tuple[Column, str, Fault | None]:
    """Split cells of text into numbers (null where there is none) and the one unit that follows them."""
    cells = pc.utf8_trim_whitespace(cells.cast(pa.string()))
    cells = pc.if_else(pc.equal(cells, ""), None, cells)
    # The first cell says which unit to expect; only a cell that differs is looked at more closely.
    unit = _unit_of(next(iter(cells.drop_null().slice(0, 1).to_pylist()), "")) or ""
    ending = (r"\s+" if unit[:1].isdigit() else r"\s*") + re.escape(unit) if unit else ""
    good = pc.fill_null(pc.match_substring_regex(cells, f"^{_NUMBER}{ending}$"), False)
    numbers = pc.replace_substring_regex(pc.if_else(good, cells, None), f"{ending}$", "")
    bad = pc.and_not(pc.is_valid(cells), good).to_numpy(zero_copy_only=False)
    if not bad.any():
        return numbers, unit, None
    row = int(np.argmax(bad))
    found = _unit_of(cells[row].as_py())
    if found is None:
        fault = f"'{cells[row].as_py()}' is no number"
        remedy = "write a number with a decimal point, or remove the row"
        if not good.to_numpy(zero_copy_only=False).any():
            remedy = "if the column is no state, name the states in the study, or remove the column"
    else:
        fault = f"mixed units, {found or 'no unit'} after rows in {unit or 'no unit'}"
        remedy = "convert the whole column to one unit"
    return numbers, unit, (row + 1, InputError(file, f"row {row + 1}, column {name}", fault, remedy))


def _unit_of(cell: str) -> str | None:
    """Find the unit in a cell of text: empty where there is none, None where the cell holds no number."""
    match = re.fullmatch(f"{_NUMBER}({_UNIT})?", cell)
    return (match[1] or "").strip() if match else None


def _parse_labels(
    file: str, cells: Column, blank: np.ndarray
) -> tuple[np.ndarray, tuple[str, ...], Fault | None]:
    """Give every label of the column ``recording`` a number, in order of first appearance.

    A blank row, in which nothing else stands either, needs no label and gets -1. Labels are text without
    outer spaces; 3 and 3.0 both become ``"3"``.
    """
    if pa.types.is_nested(cells.type):
        remedy = "write one text or whole number per row"
        raise InputError(file, "column recording", f"it holds {cells.type}, not labels", remedy)
    # All work on text is done once per label, not once per row; -1 stands where nothing does.
    values, different = pd.factorize(cells.to_pandas())
    texts, names = pd.factorize(np.array([*map(_label, different), None], dtype=object))
    codes = texts[values]
    missing = (codes < 0) & ~blank
    if missing.any():
        row = int(np.argmax(missing)) + 1
        remedy = "write the label of the row's recording"
        fault = InputError(file, f"row {row}, column recording", "the label is missing", remedy)
        return codes, (), (row, fault)
    codes, order = pd.factorize(np.where(codes < 0, np.nan, codes))  # now in order of first appearance
    return codes.astype(np.int64), tuple(str(names[int(each)]) for each in order), None


def _label(value: object) -> str | None:
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    text = value.decode("utf-8", errors="replace") if isinstance(value, bytes) else str(value)
    return text.strip() or None


def _agreed_unit(file: str, name: str, stated: Mapping[str, str | None], expected: str | None) -> str | None:
    """The unit of a column, on which every place that states one must agree, and with what is expected."""

    def plain(unit: str) -> str:
        # The micro sign and the Greek letter look the same, as do m/s² and m/s2 to a reader.
        return unicodedata.normalize("NFKC", unit).replace(" ", "")

    places = [(place, unit) for place, unit in stated.items() if unit is not None]
    for place, unit in places[1:]:
        if plain(unit) != plain(places[0][1]):
            fault = f"mixed units, {places[0][1]} in the {places[0][0]} but {unit} in the {place}"
            remedy = "state one unit, the one in which the numbers are"
            raise InputError(file, f"column {name}", fault, remedy)
    agreed = places[0][1] if places else None
    if agreed is not None and expected is not None and plain(agreed) != plain(expected):
        fault = f"the unit is {agreed} where the system card has {expected}"
        remedy = f"convert the column to {expected}, or correct the unit in the card"
        raise InputError(file, f"column {name}", fault, remedy)
    return agreed


def _seconds_of_clock(file: str, name: str, cells: Column) -> tuple[np.ndarray, str] | None:
    """Seconds since the first time of a column of dates or times of day, and that time as it was written.

    None where the column holds neither. A date that can be read in two ways is refused.
    """
    if pa.types.is_dictionary(cells.type):
        cells = cells.cast(cells.type.value_type)
    kind, first = cells.type, ""
    if pa.types.is_string(kind) or pa.types.is_large_string(kind):
        text = cells.to_pandas().str.strip().replace("", None)
        first = next(iter(text.dropna()), "")
        points, slashed = text.str.replace(",", "."), _SLASHED_DATE.fullmatch(first)
        if slashed and len(slashed[1]) == 4:
            first, points, slashed = first.replace("/", "-"), points.str.replace("/", "-"), None
        # A number that is no month tells which of the two is, for all of the column.
        numbers = text.str.extract(_SLASHED_DATE).astype(float) if slashed else pd.DataFrame()
        no_month = (numbers > 12).any()
        if slashed and no_month.all() == no_month.any():
            fault = f"the date '{first}' can be read in two ways"
            remedy = "write dates as 2024-12-31 12:00:00, or the time as seconds"
            raise InputError(file, f"column {name}", fault, remedy)
        try:
            if _ISO_DATE.fullmatch(first):
                values = pd.to_datetime(points, format="ISO8601", utc=True)
            elif _GERMAN_DATE.fullmatch(first):
                values = pd.to_datetime(points, dayfirst=True, format="mixed")
            elif slashed:
                values = pd.to_datetime(points, dayfirst=bool(no_month[0]), format="mixed")
            elif TIME_OF_DAY.fullmatch(first):
                short = "00:" + points if "." in points[text.notna()].iloc[0] else points + ":00"
                values = _past_midnight(pd.to_timedelta(points.where(points.str.count(":") != 1, short)))
            else:
                return None
        except (ValueError, TypeError):
            fault = f"not all of its cells are dates or times such as '{first}'"
            remedy = "write every time in the same way, or as seconds"
            raise InputError(file, f"column {name}", fault, remedy) from None
    elif pa.types.is_time(kind):
        values = _past_midnight(pd.to_timedelta(cells.to_pandas().astype(str)))
    elif pa.types.is_date(kind):
        values = pd.to_datetime(cells.to_pandas())
    elif pa.types.is_timestamp(kind) or pa.types.is_duration(kind):
        values = cells.to_pandas()
    elif any(is_kind(kind) for is_kind in _NUMERIC) and (days := cells.to_pandas()).between(1e7, 1e8).all():
        texts = days.astype(str).str.removesuffix(".0")  # all of them days, such as 19580329
        values = pd.to_datetime(texts, format="%Y%m%d", errors="coerce")
        if values.isna().any():
            return None
    else:
        return None
    present = values.dropna()
    if len(present) == 0:
        return None
    start = present.iloc[0]
    return ((values - start) / pd.Timedelta(seconds=1)).to_numpy(dtype=float), first or str(start)


def _complete(
    file: str, rows: _Rows, numbers: np.ndarray, called: Sequence[str], gaps: bool, remarks: list[Remark]
) -> _Rows:
    """Rows in which no number is missing.

    Rows at the ends of recordings are left out, where two others remain, and with `gaps` those in which a
    measured value is missing, where they are the few. Where most are, the columns were hardly meant to be one
    state, and they are refused, as is whatever else is missing.
    """
    if not np.isnan(numbers[:, rows.order]).any():
        return rows
    whole = pd.Series(~np.isnan(numbers[:, rows.order]).any(axis=0))
    after = whole.groupby(rows.recording).cummax()
    before = whole[::-1].groupby(rows.recording[::-1]).cummax()
    keep = (after & before | (whole.groupby(rows.recording).transform("sum") < 2)).to_numpy()
    if not keep.all():
        values = {"rows": int((~keep).sum()), "recordings": len(np.unique(rows.recording[~keep]))}
        remarks.append(Remark("data.rows_at_ends", values))
    rows = _Rows(rows.order[keep], rows.recording[keep], rows.labels)
    missing = np.isnan(numbers[1:, rows.order]).any(axis=0) & ~np.isnan(numbers[0, rows.order])
    if gaps and 0 < 2 * missing.sum() <= len(missing):
        remarks.append(Remark("data.rows_with_gaps", {"rows": int(missing.sum())}))
        present, recording = np.unique(rows.recording[~missing], return_inverse=True)
        rows = _Rows(rows.order[~missing], recording, tuple(rows.labels[place] for place in present))
    wrong = rows.order[np.isnan(numbers[:, rows.order]).any(axis=0)]
    if len(wrong) == len(rows.order) and len(wrong) > 2:
        remedy = "interpolate all columns to the same times, or name the states in the study"
        raise InputError(file, "", "no row has a value in every column", remedy)
    if len(wrong):
        place = f"row {wrong.min() + 1}, column {called[int(np.argmax(np.isnan(numbers[:, wrong.min()])))]}"
        fault, remedy = "the value is missing (empty or NaN)", "remove the row or write a finite number"
        if len(wrong) > 1:
            fault += f", as in {len(wrong) - 1} more row{'s' if len(wrong) > 2 else ''}"
            remedy = "remove these rows or write finite numbers"
        raise InputError(file, place, fault, remedy)
    return rows


def _with_all_digits(rows: _Rows, numbers: np.ndarray, remarks: list[Remark]) -> None:
    """Times that were rounded to more than a step, and so repeat, as those of the even clock that they round.

    Where each time stands equally often, nothing tells a fast clock from several measurements at each time.
    """
    units = list[float]()
    for own in np.split(rows.order, np.searchsorted(rows.recording, np.arange(1, len(rows.labels)))):
        t, number = numbers[0][own], np.arange(len(own))
        often = np.diff(np.flatnonzero(np.r_[True, np.diff(t) != 0, True]))[1:-1]
        if len(own) < 2 * FEWEST_ON_A_LINE or (np.diff(t) < 0).any() or len(np.unique(often)) < 2:
            continue
        (slope, begin), unit = np.polyfit(number, t, 1), float(np.diff(np.unique(t)).min())
        if slope < unit and np.abs(t - begin - slope * number).max() <= ROUNDED_TIME * unit:
            numbers[0][own] = t[0] + float(f"{slope:.6g}") * number
            units.append(unit)
    if units:
        remarks.append(Remark("data.times_rounded", {"count": len(units), "unit": max(units)}))


def _in_order(rows: _Rows, numbers: np.ndarray, labelled: bool, remarks: list[Remark]) -> _Rows:
    """Without rows that stand twice, sorted where in no order; a recording begins where the time starts over.

    `labelled` says that the table itself tells where its recordings begin.
    """
    t = numbers[0]
    if not ((rows.recording[1:] == rows.recording[:-1]) & (np.diff(t[rows.order]) <= 0)).any():
        return rows
    bounds = np.searchsorted(rows.recording, np.arange(1, len(rows.labels)))
    parts, labels, was_sorted, twice, begun = [], [], 0, 0, 0
    for label, own in zip(rows.labels, np.split(rows.order, bounds), strict=True):
        pieces, back = [own], np.flatnonzero(np.diff(t[own]) < 0) + 1
        if len(back) >= 3 and len(back) > SHUFFLED_SHARE * (len(own) - 1):
            order = own[np.argsort(t[own], kind="stable")]
            if (np.diff(t[_once(order, numbers)]) > 0).all():
                was_sorted += 1
                pieces = [order]
        elif len(back) and not labelled:
            # Cut where the time returns to near its beginning; not at all where it goes back elsewhere.
            begins = own[np.append(0, back[:-1])]
            took = t[own[back - 1]] - t[begins]
            if (t[own[back]] <= t[begins] + RESTART_SHARE * took).all():
                pieces = np.split(own, back)
                begun += len(back)
        for number, piece in enumerate(pieces):
            once = _once(piece, numbers)
            twice += len(piece) - len(once)
            parts.append(once)
            labels.append(label if len(pieces) == 1 else f"{label}/{number}" if label != "0" else str(number))
    found = (
        Remark("data.rows_sorted", {"count": was_sorted}),
        Remark("data.time_starts_over", {"count": begun}),
        Remark("data.rows_twice", {"count": twice}),
    )
    remarks += [one for one in found if one.values["count"]]
    lengths = [len(part) for part in parts]
    return _Rows(np.concatenate(parts), np.repeat(np.arange(len(parts)), lengths), tuple(labels))


def _once(rows: np.ndarray, numbers: np.ndarray) -> np.ndarray:
    """The rows without those that are, to the last number, like the row before."""
    own = numbers[:, rows]
    return rows[np.append(True, ~(own[:, 1:] == own[:, :-1]).all(axis=0))]


def check_times(
    file: str, t: np.ndarray, recording: np.ndarray, labels: tuple[str, ...], rows: np.ndarray
) -> None:
    """Refuse times that do not increase within every recording.

    The rows of a recording stand together; `rows` says where each stands in the file, counted from 0. An
    `InputError` has the first row of the file whose time is repeated or earlier; it is raised, too, when no
    recording has two rows.
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
        remedy = "keep one of the two rows, label them as two recordings, or write times with more digits"
    else:
        fault = f"the times of recording '{label}' are unsorted ({now} comes after {before})"
        remedy = "sort its rows by t, or begin a new label where a new recording begins"
    if np.isclose(before + float(np.median(np.diff(t)[same])) - now, AN_HOUR):
        fault += ", as where clocks go back an hour at the end of summer time"
        remedy = f"write the offset from UTC behind each time, such as 02:10+01:00, else {remedy}"
    raise InputError(file, f"row {rows[earlier + 1] + 1}, column t", fault, remedy)


def _joined(files: Sequence[Path], tables: Sequence[Recordings], folder: str) -> Recordings:
    """Tables of one folder as one; the name of a file is that of its recording."""
    first, names = tables[0], [file.name for file in files]
    stems = [file.stem for file in files]
    labels: list[str] = []
    for file, table in zip(files, tables, strict=True):
        if odd := sorted(set(table.names) ^ set(first.names)):
            ours, others = ", ".join(table.names), ", ".join(first.names)
            fault = f"its columns are {ours}, and those of {names[0]} are {others}"
            remedy = f"give {', '.join(odd)} to all files or to none, or name the states in the study"
            raise InputError(str(file), "", fault, remedy)
        stem = file.name if stems.count(file.stem) > 1 else file.stem
        labels += [stem] if len(table.labels) == 1 else [f"{stem}/{label}" for label in table.labels]
    stated = [dict(zip(table.names, table.units, strict=True)) | {"t": table.time_unit} for table in tables]
    *units, time_unit = (
        _agreed_unit(folder, name, {file: each[name] for file, each in zip(names, stated, strict=True)}, None)
        for name in (*first.names, "t")
    )
    starts = np.cumsum([0, *(len(table.labels) for table in tables[:-1])])
    lengths = [len(table.t) for table in tables]
    remarks = [Remark("data.folder", {"files": len(files), "recordings": len(labels)})]
    for text, remark in {sentence(each): each for table in tables for each in table.remarks}.items():
        having = sum(remark in table.remarks for table in tables)
        values = {"files": having, "all": len(tables), "text": text}
        remarks.append(remark if having == len(tables) else Remark("data.in_some_files", values))
    return Recordings(
        names=first.names, units=tuple(units), labels=tuple(labels),
        recording=np.concatenate([table.recording for table in tables]) + np.repeat(starts, lengths),
        t=np.concatenate([table.t for table in tables]),
        values=np.concatenate([table.values[:, [*map(table.names.index, first.names)]] for table in tables]),
        time_unit=time_unit, headings=first.headings, remarks=tuple(remarks),
    )  # fmt: skip
