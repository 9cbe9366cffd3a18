"""Files of recordings: which columns do they hold, and which numbers, labels and units are in these.

Parquet, CSV, HDF5 and MATLAB files are told apart by suffix and all become the same thing: names, known
before anything large is read, and columns of cells, read on request, which are then parsed as numbers or
labels. Which columns there must be, and in which order times stand, is the matter of `siq.recordings`.

Files are data. Nothing is unpickled, and MATLAB objects and structs are refused before they are read.
"""

from __future__ import annotations

import csv
import difflib
import re
import unicodedata
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, TypeAlias

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from siq.errors import InputError

# Each reader imports the library of its format itself: most jobs read Parquet only.

Column: TypeAlias = "pa.Array | pa.ChunkedArray"

# Text that holds a number, and what may follow as its unit: "1.2mm", "5 %", but "3 1/s" only after a space.
_NUMBER = r"(?:[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?|[+-]?(?i:nan|infinity|inf))"
_UNIT = r"(?:\s*[^\W\d_]|\s*[%°‰]|\s+1/)[^,;]*"


@dataclass(frozen=True)
class ColumnFile:
    """The columns of a file, of which only the names have been read.

    Attributes
    ----------
    names
        The columns' names, in the order of the file.
    units
        The units stated outside the cells, by the place that states them: ``"name"`` where the heading is
        ``x [mm]``, ``"metadata"`` where the format keeps a unit (Parquet field metadata, HDF5 attribute).
    load
        Reads the columns of the given positions in `names`; all have the same length.
    """

    names: tuple[str, ...]
    units: tuple[Mapping[str, str | None], ...]
    load: Callable[[Sequence[int]], list[Column]]


class CellFault(NamedTuple):
    """The first cell of a column that cannot be used; rows are counted from 1."""

    row: int
    column: str
    fault: str
    remedy: str


def open_columns(path: str | Path) -> ColumnFile:
    """Open a file of columns by its suffix.

    Parameters
    ----------
    path
        A file named ``.parquet``, ``.csv``, ``.h5``, ``.hdf5`` or ``.mat``. HDF5 holds one dataset per
        column at the root, or a single compound dataset; a MATLAB file holds one vector per column.

    Raises
    ------
    InputError
        When the suffix is unknown, or the file is missing, empty or damaged; `ColumnFile.load` raises it
        for columns that are no vectors of numbers or text, or that differ in length.
    """
    file = str(path)
    reader = READERS.get(Path(path).suffix.lower())
    if reader is None:
        raise InputError(
            file, "", f"the suffix '{Path(path).suffix}' is unknown", f"use one of {', '.join(READERS)}"
        )
    try:
        with Path(path).open("rb") as stream:
            empty = not stream.read(1)
    except OSError as error:
        raise InputError(
            file, "", f"it cannot be read ({error.strerror})", "check the name and permissions"
        ) from None
    if empty:
        raise InputError(file, "", "the file is empty", "write the recordings again")
    return reader(file)


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


def parse_numbers(file: str, name: str, cells: Column) -> tuple[np.ndarray, str | None, CellFault | None]:
    """Turn the cells of a column into finite numbers.

    Parameters
    ----------
    file, name
        The file and the column, for messages.
    cells
        Numbers, or text that holds a number and possibly a unit: ``1.2 mm``.

    Returns
    -------
    values : numpy.ndarray
        Shape ``(n,)``, float64; only to be used where there is no fault.
    unit : str or None
        The unit that all cells carry.
    fault : CellFault or None
        The first cell that is missing, not finite, no number, or in another unit than the first row.

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
    finite = np.isfinite(values)
    if not finite.all():
        row = int(np.argmin(finite))
        if fault is None or row + 1 < fault.row:
            what = "missing (empty or NaN)" if np.isnan(values[row]) else "infinite"
            fault = CellFault(
                row + 1, name, f"the value is {what}", "remove the row or write a finite number"
            )
    return values, unit, fault


def parse_labels(file: str, cells: Column) -> tuple[np.ndarray, tuple[str, ...], CellFault | None]:
    """Give every label of the column ``recording`` a number, in order of first appearance.

    Parameters
    ----------
    file
        The file, for messages.
    cells
        Text, or whole numbers.

    Returns
    -------
    recording : numpy.ndarray
        Shape ``(n,)``, int64: the index of every row's label.
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
    if missing.any():
        remedy = "write the label of the row's recording"
        return codes, (), CellFault(int(np.argmax(missing)) + 1, "recording", "the label is missing", remedy)
    present = pa.array(codes).dictionary_encode()  # numbers again, now in order of first appearance
    labels = tuple(texts.dictionary.take(present.dictionary).to_pylist())
    return present.indices.to_numpy().astype(np.int64), labels, None


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


def _column_file(
    headings: Sequence[str],
    load: Callable[[Sequence[int]], list[Column]],
    metadata: Sequence[str | None] | None = None,
) -> ColumnFile:
    parts = [_split_heading(heading) for heading in headings]
    places = zip(parts, metadata or [None] * len(parts), strict=True)
    units = tuple({"name": unit, "metadata": kept} for (_, unit), kept in places)
    return ColumnFile(names=tuple(name for name, _ in parts), units=units, load=load)


def _split_heading(heading: str) -> tuple[str, str | None]:
    match = re.fullmatch(r"\s*(.*?)\s*\[\s*(.*?)\s*\]\s*", heading)
    return (match[1], match[2] or None) if match else (heading.strip(), None)


def _same_unit(left: str, right: str) -> bool:
    # The micro sign and the Greek letter look the same, as do m/s² and m/s2 to a reader.
    plain = [unicodedata.normalize("NFKC", unit).replace(" ", "") for unit in (left, right)]
    return plain[0] == plain[1]


@contextmanager
def _reading(file: str, kind: str) -> Iterator[None]:
    # On a damaged file the parsers raise almost anything, from OSError to IndexError and MemoryError.
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        reason = str(error).split("\n")[0].rstrip(".") or type(error).__name__
        raise InputError(
            file, "", f"it cannot be read as {kind} ({reason})", "check its suffix, or write it again"
        ) from None


def _open_parquet(file: str) -> ColumnFile:
    from pyarrow import parquet

    with _reading(file, "Parquet"), parquet.ParquetFile(file) as handle:
        schema = handle.schema_arrow

    def load(positions: Sequence[int]) -> list[Column]:
        with _reading(file, "Parquet"), parquet.ParquetFile(file) as handle:
            table = handle.read(columns=[schema.names[position] for position in positions])
        return [table.column(schema.names[position]) for position in positions]

    units = tuple(_text((field.metadata or {}).get(b"unit")) for field in schema)
    return _column_file(schema.names, load, units)


def _open_csv(file: str) -> ColumnFile:
    with _reading(file, "CSV"):
        try:
            with Path(file).open(encoding="utf-8-sig", newline="") as stream:
                lines = csv.reader(stream)
                header = next((line for line in lines if any(cell.strip() for cell in line)), [])
                skip = lines.line_num
        except UnicodeDecodeError:
            raise InputError(file, "", "the text is not UTF-8", "save it as CSV in UTF-8") from None
    if len(header) == 1 and any(separator in header[0] for separator in ";\t"):
        raise InputError(file, "line 1", "the columns are not separated by commas", "separate them by commas")
    labels = [position for position, name in enumerate(header) if _split_heading(name)[0] == "recording"]

    def load(positions: Sequence[int]) -> list[Column]:
        numbers = {str(position) for position in positions if position not in labels}
        try:
            table = _read_csv(file, len(header), skip, numbers)
        except pa.ArrowInvalid:  # text among the numbers, or a line of another length: find out where
            table = _read_csv(file, len(header), skip, set())
        return [table.column(str(position)) for position in positions]

    return _column_file(header, load)


def _read_csv(file: str, width: int, skip: int, numbers: set[str]) -> pa.Table:
    """Read the columns named `numbers` (by position, as text) as numbers, all others as text."""
    from pyarrow import csv as arrow_csv

    names = [str(position) for position in range(width)]
    ragged = []

    def keep_first(row: arrow_csv.InvalidRow) -> str:
        ragged.append(row)
        return "error"

    options = {
        "read_options": arrow_csv.ReadOptions(
            column_names=names,
            skip_rows=skip,
            use_threads=bool(numbers),  # rows are counted only when one thread reads
        ),
        "parse_options": arrow_csv.ParseOptions(invalid_row_handler=None if numbers else keep_first),
        "convert_options": arrow_csv.ConvertOptions(
            column_types={name: pa.float64() if name in numbers else pa.string() for name in names},
            strings_can_be_null=True,
            quoted_strings_can_be_null=True,
        ),
    }
    if numbers:
        return arrow_csv.read_csv(file, **options)
    with _reading(file, "CSV"):
        try:
            return arrow_csv.read_csv(file, **options)
        except pa.ArrowInvalid:
            if not ragged:
                raise
    raise InputError(
        file,
        f"row {ragged[0].number - skip}",
        f"it has {ragged[0].actual_columns} cells while the header has {width}",
        "give every row one cell per column, and quote cells that hold a comma",
    )


def _open_hdf5(file: str) -> ColumnFile:
    import h5py

    with _reading(file, "HDF5"), h5py.File(file, "r") as handle:
        # MATLAB 7.3 keeps the contents of its cells and objects in groups of these names.
        names = [name for name in handle if name not in ("#refs#", "#subsystem#")]
        compound = None
        if len(names) == 1 and getattr(getattr(handle[names[0]], "dtype", None), "names", None):
            compound = names[0]
            names = list(handle[compound].dtype.names)
            units: list[str | None] = [None] * len(names)
        else:
            attributes = [handle[name].attrs for name in names]
            units = [_text(each.get("unit", each.get("units"))) for each in attributes]

    def load(positions: Sequence[int]) -> list[Column]:
        wanted = [names[position] for position in positions]
        with _reading(file, "HDF5"), h5py.File(file, "r") as handle:
            if compound is not None:
                rows = handle[compound][()]
                return _equally_long(file, {name: _column(file, name, rows[name]) for name in wanted})
            columns = {}
            for name in wanted:
                dataset = handle[name]
                if not isinstance(dataset, h5py.Dataset):
                    raise _no_vector(file, name, "a group or a struct")
                values = dataset[()]
                if dataset.attrs.get("MATLAB_empty"):  # what is stored then is the shape
                    values = np.empty(0)
                elif _text(dataset.attrs.get("MATLAB_class")) == "char":  # stored as characters × rows
                    values = np.ascontiguousarray(values.T, dtype="=u4")
                    values = values.view(f"=U{values.shape[-1]}")
                columns[name] = _column(file, name, values)
        return _equally_long(file, columns)

    return _column_file(names, load, units)


def _open_matlab(file: str) -> ColumnFile:
    import h5py
    from scipy.io import loadmat, whosmat

    if h5py.is_hdf5(file):  # version 7.3
        return _open_hdf5(file)
    with _reading(file, "MATLAB"):
        kinds = {name: kind for name, _, kind in whosmat(file) if not name.startswith("__")}
    names = tuple(kinds)

    def load(positions: Sequence[int]) -> list[Column]:
        wanted = [names[position] for position in positions]
        for name in wanted:
            if kinds[name] in ("struct", "object", "cell", "opaque", "function", "sparse", "unknown"):
                raise _no_vector(file, name, f"a MATLAB {kinds[name]}")
        with _reading(file, "MATLAB"):
            variables = loadmat(file, variable_names=wanted)
            return _equally_long(file, {name: _column(file, name, variables[name]) for name in wanted})

    return _column_file(names, load)


READERS: dict[str, Callable[[str], ColumnFile]] = {
    ".parquet": _open_parquet,
    ".csv": _open_csv,
    ".h5": _open_hdf5,
    ".hdf5": _open_hdf5,
    ".mat": _open_matlab,
}
"""How the columns of a file are read, by the suffix of its name."""


def _column(file: str, name: str, values: np.ndarray) -> Column:
    values = np.asarray(values)
    if values.ndim != 1:
        if values.ndim and values.size != max(values.shape):
            raise _no_vector(file, name, f"of shape {' × '.join(map(str, values.shape))}")
        values = values.ravel()
    if values.dtype.kind == "f":
        return pa.array(values.astype(np.float64, copy=False))  # native byte order and precision
    if values.dtype.kind in "iub":
        return pa.array(values.astype(values.dtype.newbyteorder("="), copy=False))
    if values.dtype.kind == "S" or (
        values.dtype.kind == "O" and all(isinstance(each, bytes) for each in values[:1])
    ):
        return pa.array(values.tolist(), type=pa.binary()).cast(pa.string())
    if values.dtype.kind == "U":
        return pa.array(values.tolist(), type=pa.string())
    kind = "complex numbers" if values.dtype.kind == "c" else "cells, structs or references"
    raise _no_vector(file, name, f"an array of {kind}")


def _no_vector(file: str, name: str, found: str) -> InputError:
    text = ", or labels as one text per row" if name == "recording" else ""
    return InputError(
        file, f"column {name}", f"it is {found}, not one vector", f"store one vector of numbers{text}"
    )


def _equally_long(file: str, columns: dict[str, Column]) -> list[Column]:
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


def _text(value: object) -> str | None:
    if isinstance(value, np.ndarray | np.generic) and value.size == 1:
        value = value.item()
    if isinstance(value, bytes):
        value = value.decode("utf-8", errors="replace")
    return value if isinstance(value, str) else None


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
