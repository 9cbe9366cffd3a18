"""Formats of recordings: tables of text and their dialects, Parquet, HDF5, MATLAB.

Laboratories write CSV in many ways: a German Excel separates by semicolons and writes decimal commas, a
logger puts comments above the table, ``numpy.savetxt`` the headings behind ``#``, other programs the units
into a second line. What was recognised is said, so that a wrong guess is seen.

Parquet, CSV, HDF5, MATLAB and NumPy files are told apart by suffix and all become the same thing: headings,
known before anything large is read, and columns of cells, read on request. What the headings mean is the
matter of `siq.data.layout`, what the cells mean that of `siq.data.cells`.

Files are data. Nothing is unpickled, and MATLAB objects and structs are refused before they are read.
"""

from __future__ import annotations

import codecs
import csv
import json
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from siq.data.cells import Column
from siq.data.columns import equally_long, is_label, is_unit, read_heading
from siq.errors import InputError
from siq.numerics.files import missing_file

LOOKED_AT = 200  # lines of the table from which its separator and decimal mark are recognised
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|[+-]?(nan|inf(inity)?)", re.IGNORECASE)
_DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?")
_GROUPED = re.compile(r"[+-]?\d{1,3}(\.\d{3})+,\d+")
_SEPARATORS = {";": "semicolons", "\t": "tabs", ",": "commas", "|": "vertical bars", " ": "spaces"}
_MARKS = ("#", "%", "//")  # with which a line of comment begins


@dataclass(frozen=True)
class TextTable:
    """A table of text, with its headings apart from its rows.

    Attributes
    ----------
    headings, units
        Of each column; a unit is None where no second line of headings says one.
    body
        The rows, in UTF-8.
    separator, decimal_mark
        How cells are separated, and how decimals are.
    notes
        What was recognised that is not usual.
    """

    headings: tuple[str, ...]
    units: tuple[str | None, ...]
    body: bytes
    separator: str
    decimal_mark: str
    notes: tuple[str, ...]


def read_text_table(file: str, content: bytes) -> TextTable:
    """Recognise how a table is written.

    Parameters
    ----------
    file
        For messages.
    content
        Of the file.

    Raises
    ------
    InputError
        When it is no text, has no headings, or can be read in two ways.
    """
    content, notes = _in_utf8(file, content)
    begin, comments, separator = _skip_comments(content)
    sample = content[begin : begin + 200_000].decode("utf-8", errors="ignore").splitlines()[:LOOKED_AT]
    lines = [line for line in sample if line.strip() and not line.lstrip().startswith(_MARKS)]
    if not lines:
        raise InputError(file, "", "the table has no headings and no rows", "write the recordings again")
    separator = separator or _separator(lines)
    split = _splitter(separator)
    cells = split(lines[0])
    if all(_is_number(cell) for cell in cells):
        above = split(comments[-1]) if comments else []
        if len(above) != len(cells):
            example = ",".join(["t", *"xyzuvw"][: len(cells)])
            raise InputError(
                file,
                "line 1" if begin == 0 else "",
                "the first line holds numbers where the headings should stand",
                f"add a first line that names the columns, such as {example}",
            )
        headings, rows = above, lines
    else:
        headings, rows = cells, lines[1:]
        begin = _after_line(content, begin)
    units: list[str | None] = [None] * len(headings)
    if rows and (found := _line_of_units(split(rows[0]), len(headings))) is not None:
        units, rows = found, rows[1:]
        begin = _after_line(content, begin)
        notes.append("the second line of headings was read as the units")
    mark = _decimal_mark(file, [split(row) for row in rows], len(headings), separator)
    if separator != ",":
        notes.append(f"the columns are separated by {_SEPARATORS[separator]}" + (
            ", and decimals by a comma" if mark == "," else ""
        ))  # fmt: skip
    body = _without_comments(content[begin:])
    if separator == " ":
        body = b"\n".join(b"\t".join(line.split()) for line in body.splitlines())
    return TextTable(
        tuple(headings), tuple(units), body, "\t" if separator == " " else separator, mark, tuple(notes)
    )


def _in_utf8(file: str, content: bytes) -> tuple[bytes, list[str]]:
    for mark, encoding in ((codecs.BOM_UTF16_LE, "utf-16"), (codecs.BOM_UTF16_BE, "utf-16")):
        if content.startswith(mark):
            try:
                return content.decode(encoding).encode(), ["the text is UTF-16"]
            except UnicodeDecodeError:
                break
    content = content.removeprefix(codecs.BOM_UTF8)
    if b"\0" in content[:100_000]:
        raise InputError(file, "", "the file is no text", "save the table as CSV in UTF-8")
    try:
        content.decode()
    except UnicodeDecodeError:
        # What Windows writes in western Europe; five bytes have no meaning there.
        try:
            return content.decode("cp1252").encode(), ["the text is not UTF-8 and was read as Windows-1252"]
        except UnicodeDecodeError:
            raise InputError(file, "", "the text is not UTF-8", "save it as CSV in UTF-8") from None
    return content, []


def _skip_comments(content: bytes) -> tuple[int, list[str], str | None]:
    """Where the table begins, the comments above it, and the separator, where a line ``sep=;`` says it."""
    begin, comments, separator = 0, [], None
    while begin < len(content):
        end = _after_line(content, begin)
        line = content[begin:end].decode("utf-8", errors="ignore").strip()
        mark = next((each for each in _MARKS if line.startswith(each)), None)
        if match := re.fullmatch(r'"?sep=(.)"?', line):
            separator = match[1]
        elif mark is not None:
            comments.append(line.lstrip(mark).strip())
        elif line.strip(',;\t "|'):
            break
        begin = end
    return begin, comments, separator


def _after_line(content: bytes, begin: int) -> int:
    ends = [end for end in (content.find(b"\n", begin), content.find(b"\r", begin)) if end >= 0]
    if not ends:
        return len(content)
    end = min(ends)
    return end + (2 if content[end : end + 2] == b"\r\n" else 1)


def _without_comments(body: bytes) -> bytes:
    if not any(b"\n" + mark.encode() in body or body.startswith(mark.encode()) for mark in _MARKS):
        return body
    marks = tuple(mark.encode() for mark in _MARKS)
    return b"\n".join(line for line in body.splitlines() if not line.startswith(marks))


def _separator(lines: list[str]) -> str:
    """The separator that the headings and the rows share."""
    heading = re.sub(r'"[^"]*"', "", lines[0])
    for separator in (";", "\t", ",", "|"):
        if separator in heading and (separator != "," or not any(";" in line for line in lines[1:2])):
            return separator
    row = lines[1] if len(lines) > 1 else lines[0]
    if any(separator in row for separator in ";\t,|") or len(row.split()) == 1:
        return next((separator for separator in ";\t,|" if separator in row), ",")
    return " "


def _splitter(separator: str) -> Callable[[str], list[str]]:
    def split(line: str) -> list[str]:
        if separator == " ":
            # "t (s)" is one heading, not two.
            joined = re.sub(r"\s+(?=[\[(])", "\0", line.strip())
            return [cell.replace("\0", " ") for cell in joined.split()]
        return [cell.strip() for cell in next(csv.reader([line], delimiter=separator), [])]

    return split


def _is_number(cell: str) -> bool:
    return bool(_NUMBER.fullmatch(cell) or _DECIMAL_COMMA.fullmatch(cell))


def _line_of_units(cells: list[str], width: int) -> list[str | None] | None:
    """Units from the second line of headings, if that is what it is: no number, and a unit at least."""
    units: list[str | None] = []
    for cell in cells:
        inner = cell.strip("[]() ")
        if cell and not is_unit(inner):
            return None
        units.append(inner if inner not in ("", "-") else None)
    if len(cells) != width or not any(units) or any(_is_number(cell) for cell in cells):
        return None
    return units


def _decimal_mark(file: str, rows: list[list[str]], width: int, separator: str) -> str:
    if separator == ",":
        if rows and all(len(row) > width for row in rows) and all(len(row) == len(rows[0]) for row in rows):
            fault = f"the headings name {width} columns and the rows have {len(rows[0])} cells"
            remedy = "write decimal points, or separate the columns by semicolons if decimals have commas"
            raise InputError(file, "", fault, remedy)
        return "."
    cells = [cell for row in rows for cell in row]
    if any(_GROUPED.fullmatch(cell) for cell in cells):
        cell = next(cell for cell in cells if _GROUPED.fullmatch(cell))
        raise InputError(
            file,
            "",
            f"'{cell}' has both a point and a comma",
            "write numbers without marks between thousands",
        )
    commas = next((cell for cell in cells if _DECIMAL_COMMA.fullmatch(cell)), None)
    points = next((cell for cell in cells if "." in cell and _NUMBER.fullmatch(cell)), None)
    if commas is not None and points is not None:
        raise InputError(
            file, "", f"decimals are written with commas ('{commas}') and with points ('{points}')",
            "write all numbers in the same way",
        )  # fmt: skip
    return "." if commas is None else ","


if TYPE_CHECKING:
    import pandas as pd

# Each reader imports the library of its format itself: most jobs read Parquet only.


@dataclass(frozen=True)
class ColumnFile:
    """The columns of a file, of which only the names have been read.

    Attributes
    ----------
    headings
        What stands above the columns, in the order of the file, a unit included where there is one.
    units
        The unit of each column that stands neither in its heading nor in its cells (Parquet field metadata,
        HDF5 attribute, a second line of headings), None where there is none.
    load
        Reads the columns of the given positions in `headings`; all have the same length.
    titles
        What people call each column, where the file keeps that beside a name (Parquet that we wrote).
    notes
        What was recognised or assumed.
    """

    headings: tuple[str, ...]
    units: tuple[str | None, ...]
    load: Callable[[Sequence[int]], list[Column]]
    titles: tuple[str | None, ...] = ()
    notes: tuple[str, ...] = ()


def open_columns(path: str | Path) -> ColumnFile:
    """Open a file of columns by its suffix.

    Parameters
    ----------
    path
        A file with one of the suffixes of `READERS`. HDF5 holds one dataset per
        column at the root, or a single compound dataset; a MATLAB file holds one vector per column.

    Raises
    ------
    InputError
        When the suffix is unknown, or the file is missing, empty or damaged; `ColumnFile.load` raises it
        for columns that are no vectors of numbers or text, or that differ in length.
    """
    file, suffix = str(path), Path(path).suffix.lower()
    if not Path(path).exists() and (suffix in READERS or not suffix):
        raise missing_file(file, [Path(path)])
    begin = b""
    try:
        if suffix in READERS or Path(path).exists():
            with Path(path).open("rb") as stream:
                begin = stream.read(8)
    except OSError as error:
        raise InputError(
            file, "", f"it cannot be read ({error.strerror})", "check the name and permissions"
        ) from None
    if not begin and suffix in READERS:
        raise InputError(file, "", "the file is empty", "write the recordings again")
    if (suffix in SPREADSHEETS or begin.startswith(b"PK\x03\x04")) and suffix != ".npz":
        raise InputError(
            file, "", "it is a spreadsheet", "save the sheet as CSV (in Excel: Save As, CSV UTF-8)"
        )
    reader = READERS.get(suffix)
    if reader is None:
        raise InputError(
            file, "", f"the suffix '{Path(path).suffix}' is unknown", f"use one of {', '.join(READERS)}"
        )
    return reader(file)


def frame_columns(file: str, frame: pd.DataFrame) -> ColumnFile:
    """The columns of a table in memory, as those of a file.

    Parameters
    ----------
    file
        What messages call the table.
    frame
        Columns may have a unit behind their name, or in ``frame.attrs["units"]``.
    """
    headings = [str(heading) for heading in frame.columns]
    known = frame.attrs.get("units", {})
    units = [known.get(read_heading(heading).title) for heading in headings]

    def load(positions: Sequence[int]) -> list[Column]:
        columns = []
        for position in positions:
            try:
                columns.append(pa.Array.from_pandas(frame.iloc[:, position]))
            except (pa.ArrowInvalid, pa.ArrowTypeError, pa.ArrowNotImplementedError):
                fault = "it holds a mixture of things, not numbers in one unit"
                raise InputError(file, f"column {headings[position]}", fault, "make it numbers") from None
        return columns

    return _column_file(headings, load, units)


def _column_file(
    headings: Sequence[str],
    load: Callable[[Sequence[int]], list[Column]],
    units: Sequence[str | None] | None = None,
) -> ColumnFile:
    return ColumnFile(tuple(headings), tuple(units or [None] * len(headings)), load)


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

    def kept(what: bytes) -> tuple[str | None, ...]:
        return tuple(_text((field.metadata or {}).get(what)) for field in schema)

    notes = json.loads((schema.metadata or {}).get(b"notes", b"[]"))
    return ColumnFile(tuple(schema.names), kept(b"unit"), load, kept(b"heading"), tuple(map(str, notes)))


def _open_text(file: str) -> ColumnFile:
    table = read_text_table(file, Path(file).read_bytes())
    labels = [place for place, heading in enumerate(table.headings) if is_label(read_heading(heading).title)]

    def load(positions: Sequence[int]) -> list[Column]:
        numbers = {str(position) for position in positions if position not in labels}
        try:
            cells = _read_cells(file, table, numbers)
        except pa.ArrowInvalid:  # text among the numbers, or a line of another length: find out where
            cells = _read_cells(file, table, set())
        return [cells.column(str(position)) for position in positions]

    return ColumnFile(table.headings, table.units, load, notes=table.notes)


def _read_cells(file: str, table: TextTable, numbers: set[str]) -> pa.Table:
    """Read the columns named `numbers` (by position, as text) as numbers, all others as text."""
    from pyarrow import csv as arrow_csv

    width = len(table.headings)
    names = [str(position) for position in range(width)]
    ragged = []

    def keep_first(row: arrow_csv.InvalidRow) -> str:
        ragged.append(row)
        return "error"

    options = {
        "read_options": arrow_csv.ReadOptions(
            column_names=names,
            use_threads=bool(numbers),  # rows are counted only when one thread reads
        ),
        "parse_options": arrow_csv.ParseOptions(
            delimiter=table.separator, invalid_row_handler=None if numbers else keep_first
        ),
        "convert_options": arrow_csv.ConvertOptions(
            column_types={name: pa.float64() if name in numbers else pa.string() for name in names},
            decimal_point=table.decimal_mark,
            strings_can_be_null=True,
            quoted_strings_can_be_null=True,
        ),
    }
    if not table.body.strip():
        return pa.table({name: pa.array([], pa.string()) for name in names})
    source = pa.BufferReader(table.body)
    if numbers:
        return arrow_csv.read_csv(source, **options)
    with _reading(file, "CSV"):
        try:
            cells = arrow_csv.read_csv(source, **options)
        except pa.ArrowInvalid:
            if not ragged:
                raise
        else:
            return _with_decimal_points(cells) if table.decimal_mark == "," else cells
    raise InputError(
        file,
        f"row {ragged[0].number}",
        f"it has {ragged[0].actual_columns} cells while the header has {width}",
        "give every row one cell per column, and quote cells that hold a comma",
    )


def _with_decimal_points(cells: pa.Table) -> pa.Table:
    """The same text with ``1.5 mm`` in the place of ``1,5 mm``."""
    comma = r"^(\s*[+-]?[0-9]*),([0-9])"
    return pa.table(
        {name: pc.replace_substring_regex(cells[name], comma, r"\1.\2") for name in cells.column_names}
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
                return equally_long(file, {name: _column(file, name, rows[name]) for name in wanted})
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
        return equally_long(file, columns)

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
            return equally_long(file, {name: _column(file, name, variables[name]) for name in wanted})

    return _column_file(names, load)


def _open_numpy(file: str) -> ColumnFile:
    with _reading(file, "NumPy"):
        kept = np.load(file, allow_pickle=False)
        fields = kept.dtype.names if isinstance(kept, np.ndarray) else tuple(kept.files)
        columns = {name: kept[name] for name in fields or ()}
    if not columns:
        raise InputError(
            file, "", "it is one array without names for its columns",
            "write numpy.savez(file, t=..., x=...), or a table with headings",
        )  # fmt: skip
    names = tuple(columns)

    def load(positions: Sequence[int]) -> list[Column]:
        wanted = [names[position] for position in positions]
        return equally_long(file, {name: _column(file, name, columns[name]) for name in wanted})

    return _column_file(names, load)


SPREADSHEETS = (".xlsx", ".xls", ".xlsm", ".xlsb", ".ods")
READERS: dict[str, Callable[[str], ColumnFile]] = {
    ".parquet": _open_parquet,
    ".csv": _open_text,
    ".tsv": _open_text,
    ".txt": _open_text,
    ".dat": _open_text,
    ".h5": _open_hdf5,
    ".hdf5": _open_hdf5,
    ".mat": _open_matlab,
    ".npz": _open_numpy,
    ".npy": _open_numpy,
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


def _text(value: object) -> str | None:
    if isinstance(value, np.ndarray | np.generic) and value.size == 1:
        value = value.item()
    if isinstance(value, bytes):
        value = value.decode("utf-8", errors="replace")
    return value if isinstance(value, str) else None
