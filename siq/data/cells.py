"""Cells of recordings: numbers, labels, units, clock times.

The columns come from `siq.data.formats`, whatever the format; here their cells are parsed, and the first
one that cannot be used is found.

Dates and times of day become seconds since the first of the file, since nothing else depends on when a
recording was made.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Mapping
from typing import NamedTuple, TypeAlias

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from siq.errors import InputError

Column: TypeAlias = "pa.Array | pa.ChunkedArray"

# Text that holds a number, and what may follow as its unit: "1.2mm", "5 %", but "3 1/s" only after a space.
_NUMBER = r"(?:[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?|[+-]?(?i:nan|infinity|inf))"
_UNIT = r"(?:\s*[^\W\d_]|\s*[%°‰]|\s+1/)[^,;]*"


class CellFault(NamedTuple):
    """The first cell of a column that cannot be used; rows are counted from 1."""

    row: int
    column: str
    fault: str
    remedy: str


def parse_numbers(file: str, name: str, cells: Column) -> tuple[np.ndarray, str | None, CellFault | None]:
    """Turn the cells of a column into numbers.

    Parameters
    ----------
    file, name
        The file and the column, for messages.
    cells
        Numbers, or text that holds a number and possibly a unit: ``1.2 mm``.

    Returns
    -------
    values : numpy.ndarray
        Shape ``(n,)``, float64, NaN where nothing stands; only to be used where there is no fault.
    unit : str or None
        The unit that all cells carry.
    fault : CellFault or None
        The first cell that is infinite, no number, or in another unit than the first row.

    Raises
    ------
    InputError
        When the column as a whole holds something other than numbers, such as dates.
    """
    if pa.types.is_dictionary(cells.type):
        cells = cells.cast(cells.type.value_type)
    unit, fault = None, None
    if _is_text(cells.type):
        cells, unit, fault = _split_units(name, cells)
    elif not any(is_kind(cells.type) for is_kind in _NUMERIC):
        raise InputError(
            file, f"column {name}", f"it holds {cells.type}, not numbers", "write it as numbers in one unit"
        )
    try:
        values = cells.cast(pa.float64()).to_numpy(zero_copy_only=False)
    except pa.ArrowInvalid:
        remedy = "subtract a constant, such as the time of the first sample"
        raise InputError(file, f"column {name}", "its integers are too large to be exact", remedy) from None
    infinite = np.isinf(values)
    if infinite.any():
        row = int(np.argmax(infinite))
        if fault is None or row + 1 < fault.row:
            fault = CellFault(
                row + 1, name, "the value is infinite", "remove the row or write a finite number"
            )
    return values, unit, fault


def parse_labels(
    file: str, cells: Column, *, blank: np.ndarray | None = None
) -> tuple[np.ndarray, tuple[str, ...], CellFault | None]:
    """Give every label of the column ``recording`` a number, in order of first appearance.

    Parameters
    ----------
    file
        The file, for messages.
    cells
        Text, or whole numbers.
    blank
        Shape ``(n,)``: rows in which nothing else stands either, and which need no label.

    Returns
    -------
    recording : numpy.ndarray
        Shape ``(n,)``, int64: the index of every row's label, -1 of a blank row.
    labels : tuple of str
        The labels as text without outer spaces; 3 and 3.0 both become ``"3"``.
    fault : CellFault or None
        The first row without a label.

    Raises
    ------
    InputError
        When the cells are no labels but, for example, lists.
    """
    if isinstance(cells, pa.ChunkedArray):
        cells = cells.combine_chunks()
    if pa.types.is_nested(cells.type):
        remedy = "write one text or whole number per row"
        raise InputError(file, "column recording", f"it holds {cells.type}, not labels", remedy)
    if not pa.types.is_dictionary(cells.type):
        cells = cells.dictionary_encode()
    # All work on text is done once per label, not once per row.
    texts = cells.dictionary
    if not _is_text(texts.type):
        texts = pa.array([_label(value) for value in texts.to_pylist()], type=pa.string())
    texts = pc.fill_null(pc.utf8_trim_whitespace(texts.cast(pa.string())), "").dictionary_encode()
    merged = np.append(texts.indices.to_numpy(), -1)
    codes = merged[cells.indices.cast(pa.int64()).fill_null(len(merged) - 1).to_numpy()]
    missing = (codes == -1) | (codes == texts.dictionary.index("").as_py())
    needed = missing if blank is None else missing & ~blank
    if needed.any():
        remedy = "write the label of the row's recording"
        return codes, (), CellFault(int(np.argmax(needed)) + 1, "recording", "the label is missing", remedy)
    present = pa.array(codes, mask=missing).dictionary_encode()  # again, now in order of first appearance
    labels = tuple(texts.dictionary.take(present.dictionary).to_pylist())
    return present.indices.fill_null(-1).to_numpy().astype(np.int64), labels, None


def agree_on_unit(file: str, name: str, stated: Mapping[str, str | None], expected: str | None) -> str | None:
    """Find the unit of a column, on which every place that states one must agree.

    Parameters
    ----------
    file, name
        The file and the column, for messages.
    stated
        The unit by the place that states it (``"name"``, ``"metadata"``, ``"cells"``), None where not stated.
    expected
        The unit that it must be if any place states one; None accepts every unit.

    Raises
    ------
    InputError
        When two places, or a place and `expected`, differ.
    """
    places = [(place, unit) for place, unit in stated.items() if unit is not None]
    for place, unit in places[1:]:
        if not _same_unit(unit, places[0][1]):
            raise InputError(
                file,
                f"column {name}",
                f"mixed units, {places[0][1]} in the {places[0][0]} but {unit} in the {place}",
                "state one unit, the one in which the numbers are",
            )
    if not places:
        return None
    unit = places[0][1]
    if expected is not None and not _same_unit(unit, expected):
        raise InputError(
            file,
            f"column {name}",
            f"the unit is {unit} where the system card has {expected}",
            f"convert the column to {expected}, or correct the unit in the card",
        )
    return unit


def _same_unit(left: str, right: str) -> bool:
    # The micro sign and the Greek letter look the same, as do m/s² and m/s2 to a reader.
    plain = [unicodedata.normalize("NFKC", unit).replace(" ", "") for unit in (left, right)]
    return plain[0] == plain[1]


_NUMERIC = (
    pa.types.is_floating,
    pa.types.is_integer,
    pa.types.is_boolean,
    pa.types.is_decimal,
    pa.types.is_null,
)


def _is_text(kind: pa.DataType) -> bool:
    return pa.types.is_string(kind) or pa.types.is_large_string(kind) or pa.types.is_string_view(kind)


def _split_units(name: str, cells: Column) -> tuple[Column, str | None, CellFault | None]:
    """Split cells of text into numbers (null where there is none) and the one unit that follows them."""
    cells = pc.utf8_trim_whitespace(cells.cast(pa.string()))
    cells = pc.if_else(pc.equal(cells, ""), None, cells)
    # The first cell says which unit to expect; only a cell that differs is looked at more closely.
    unit = _unit_of(next((each for each in cells.drop_null().slice(0, 1).to_pylist()), "")) or ""
    ending = (r"\s+" if unit[:1].isdigit() else r"\s*") + re.escape(unit) if unit else ""
    good = pc.fill_null(pc.match_substring_regex(cells, f"^{_NUMBER}{ending}$"), False)
    numbers = pc.replace_substring_regex(pc.if_else(good, cells, None), f"{ending}$", "")
    bad = pc.and_not(pc.is_valid(cells), good).to_numpy(zero_copy_only=False)
    if not bad.any():
        return numbers, unit or None, None
    row = int(np.argmax(bad))
    cell = cells[row].as_py()
    found = _unit_of(cell)
    if found is None:
        fault, remedy = f"'{cell}' is no number", "write a number with a decimal point, or remove the row"
        if not good.to_numpy(zero_copy_only=False).any():
            remedy = "if the column is no state, name the states in the study, or remove the column"
    else:
        fault = f"mixed units, {found or 'no unit'} after rows in {unit or 'no unit'}"
        remedy = "convert the whole column to one unit"
    return numbers, unit or None, CellFault(row + 1, name, fault, remedy)


def _unit_of(cell: str) -> str | None:
    """Find the unit in a cell of text: empty where there is none, None where the cell holds no number."""
    match = re.fullmatch(f"{_NUMBER}({_UNIT})?", cell)
    return (match[1] or "").strip() if match else None


def _label(value: object) -> str:
    if value is None or value != value:  # NaN, as missing numbers are written
        return ""
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    return value.decode("utf-8", errors="replace") if isinstance(value, bytes) else str(value)


_ISO = re.compile(r"\d{4}-\d{2}-\d{2}([T ]\d{2}:\d{2}(:\d{2}([.,]\d+)?)?\s*(Z|[+-]\d{2}:?\d{2})?)?")
_OF_DAY = re.compile(r"\d{1,3}:\d{2}(:\d{2}([.,]\d+)?)?")
_GERMAN = re.compile(r"\d{1,2}\.\d{1,2}\.\d{4}( \d{1,2}:\d{2}(:\d{2}([.,]\d+)?)?)?")
_SLASHED = re.compile(r"\d{1,4}/\d{1,2}/\d{1,4}.*")


def seconds_of_clock(file: str, name: str, cells: Column) -> tuple[np.ndarray, str] | None:
    """Seconds since the first time of a column of dates or times of day.

    Parameters
    ----------
    file, name
        The file and the column, for messages.
    cells
        The column.

    Returns
    -------
    seconds : numpy.ndarray
        Shape ``(n,)``, NaN where a cell is empty; and the first time, as it was written.
        None, in the place of both, where the column holds neither.

    Raises
    ------
    InputError
        Where a date can be read in two ways, or one of them cannot be read.
    """
    import pandas as pd

    if pa.types.is_dictionary(cells.type):
        cells = cells.cast(cells.type.value_type)
    kind = cells.type
    if (
        pa.types.is_timestamp(kind)
        or pa.types.is_date(kind)
        or pa.types.is_time(kind)
        or pa.types.is_duration(kind)
    ):
        values, first = cells.to_pandas(), ""
        if pa.types.is_time(kind):
            values = pd.to_timedelta(values.astype(str))
        elif pa.types.is_date(kind):
            values = pd.to_datetime(values)
    elif pa.types.is_string(kind) or pa.types.is_large_string(kind):
        text = cells.to_pandas().str.strip().replace("", None)
        first = next(iter(text.dropna()), "")
        values = _parsed(file, name, text, first)
        if values is None:
            return None
    else:
        return None
    present = values.dropna()
    if len(present) == 0:
        return None
    start = present.iloc[0]
    return ((values - start) / pd.Timedelta(seconds=1)).to_numpy(dtype=float), first or str(start)


def _parsed(file: str, name: str, text, first: str):  # type: ignore[no-untyped-def]
    import pandas as pd

    if _SLASHED.fullmatch(first):
        raise InputError(
            file, f"column {name}", f"the date '{first}' can be read in two ways",
            "write dates as 2024-12-31 12:00:00, or the time as seconds",
        )  # fmt: skip
    try:
        if _ISO.fullmatch(first):
            return pd.to_datetime(text.str.replace(",", "."), format="ISO8601", utc=True)
        if _GERMAN.fullmatch(first):
            return pd.to_datetime(text.str.replace(",", "."), dayfirst=True, format="mixed")
        if _OF_DAY.fullmatch(first):
            whole = text.str.replace(",", ".")
            return pd.to_timedelta(whole.where(whole.str.count(":") != 1, whole + ":00"))
    except (ValueError, TypeError):
        raise InputError(
            file, f"column {name}", f"not all of its cells are dates or times such as '{first}'",
            "write every time in the same way, or as seconds",
        ) from None  # fmt: skip
    return None
