"""Files of recordings as columns: text tables and their dialects, Parquet, HDF5, NetCDF, MATLAB, NumPy.

All formats become the same thing: headings, known before anything large is read, and columns of cells, read
on request. What headings mean is the matter of `siq.data.layout`, what cells mean that of `siq.data.tables`.

Laboratories write CSV in many ways: a German Excel separates by semicolons and writes decimal commas, a
logger puts comments above the table, ``numpy.savetxt`` the headings behind ``#``, other programs the units
into a second line. What was recognised is remarked, so that a wrong guess is seen.

Files are data. Nothing is unpickled, and MATLAB objects and structs are refused before they are read.
"""

from __future__ import annotations

import codecs
import csv
import difflib
import gzip
import json
import re
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from pyarrow import csv as arrow_csv

from siq.data.layout import SAMPLING, is_unit, read_heading
from siq.data.recordings import TABLE
from siq.errors import InputError
from siq.remarks import Remark

if TYPE_CHECKING:
    import pandas as pd
    import xarray

Column: TypeAlias = "pa.Array | pa.ChunkedArray"

FEWEST_UNNAMED = 10  # rows, below which no column without a heading can be told for the clock
SAMPLED_LINES = 200  # of a table, from which its separator and decimal mark are recognised
SPREADSHEETS = (".xlsx", ".xls", ".xlsm", ".xlsb", ".ods")
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|[+-]?(nan|inf(inity)?)", re.IGNORECASE)
_DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?")
_MISSING = tuple(arrow_csv.ConvertOptions().null_values)
_DASHES = ("-", "--", "---")  # where nothing was measured; among labels, one as any other
_FORTRAN = re.compile(rb"(?<=\d)(\.\d*)[dD](?=[+-]\d\d)")  # 1.5D+03, and not the label 7d-01
# Below the headings of a gauge's table: widths and kinds of its columns, 5s 14n.
_WIDTHS = re.compile(rb"^(\d+[sdn]\t)+\d+[sdn]\r?\n", re.MULTILINE)
_NUMERIC = re.compile(f"{_NUMBER.pattern}|{_DECIMAL_COMMA.pattern}", re.IGNORECASE)
_GROUPED = re.compile(r"[+-]?\d{1,3}((\.\d{3})+,\d+|(,\d{3})+\.\d+|,\d{3}(,\d{3})+)")
_LABELS = re.compile(r"(?i)^(labels|columns|channels|fields|names)\s*:=?\s*")
_SEPARATORS = {";": "semicolons", "\t": "tabs", ",": "commas", "|": "vertical bars", " ": "spaces"}
_COMMENTS = ("#", "%", "//")
GZIP = b"\x1f\x8b"  # with which packed files begin
_END_OF_HEADER, LARGEST_HEADER = b"***End_of_Header***", 20_000  # of LabVIEW's tables; bytes of the largest


@dataclass(frozen=True)
class ColumnFile:
    """The columns of a file, of which only the names have been read.

    The units are those that stand neither in headings nor in cells: Parquet field metadata, an HDF5
    attribute, a second line of headings.
    """

    headings: tuple[str, ...]  #: what stands above the columns, in their order, a unit included
    units: tuple[str | None, ...]  #: of each column, None where there is none
    load: Callable[[Sequence[int]], list[Column]]  #: columns of positions in `headings`, of one length
    titles: tuple[str | None, ...] = ()  #: what people call each, where a file that we wrote keeps that
    remarks: tuple[Remark, ...] = ()  #: what was recognised or assumed
    sampling: str = ""  #: the line above the table, if there is one, that says how often it was sampled


def open_columns(path: str | Path | pd.DataFrame | xarray.Dataset) -> ColumnFile:
    """Open a file of columns by its suffix, or a table or a dataset in memory.

    Parameters
    ----------
    path
        A file with one of the suffixes of `READERS`. HDF5 holds one dataset per column at the root, or a
        single compound dataset; a MATLAB file holds one vector per column. A NetCDF file holds variables,
        each over some of its dimensions, such as ``(recording, t)``.

    Raises
    ------
    InputError
        When the suffix is unknown, or the file is missing, empty or damaged; `ColumnFile.load` raises it
        for columns that are no vectors of numbers or text, or that differ in length.
    """
    if not isinstance(path, str | Path):
        if not hasattr(path, "data_vars"):
            return _open_frame(path)
        every = {str(name): each for name, each in path.variables.items()}
        known = {name: _Variable(tuple(map(str, v.dims)), v.values, v.attrs) for name, v in every.items()}
        return _over_dimensions(TABLE, known)
    file, path = str(path), Path(path)
    suffix, exists, begin = path.suffix.lower(), path.exists(), b""
    reader = READERS.get(suffix)
    if suffix == ".gz" and READERS.get(Path(path.stem).suffix.lower()) is _open_text:
        reader = _open_text
    if not exists and (reader or not suffix):  # what has nearly this name, and where it was looked for
        folder, remedy = path.parent, "check the name and the folder"
        if folder.is_dir():
            names = {one.name.casefold(): one for one in folder.iterdir() if not one.name.startswith(".")}
            near = difflib.get_close_matches(path.name.casefold(), names, n=1)
            near = near or [name for name in names if Path(name).stem == path.stem.casefold()]
            remedy = f"perhaps you meant '{names[near[0]]}'" if near else remedy
        else:
            remedy = f"there is no folder '{folder}' either"
        raise InputError(file, "", f"No such file; it was looked for at {path.absolute()}", remedy)
    try:
        if exists:
            with path.open("rb") as stream:
                begin = stream.read(8)
    except OSError as error:
        reason = f"it cannot be read ({error.strerror})"
        raise InputError(file, "", reason, "check the name and permissions") from None
    if not begin and reader:
        raise InputError(file, "", "the file is empty", "write the recordings again")
    if (suffix in SPREADSHEETS or begin.startswith(b"PK\x03\x04")) and suffix != ".npz":
        remedy = "save the sheet as CSV (in Excel: Save As, CSV UTF-8)"
        raise InputError(file, "", "it is a spreadsheet", remedy)
    if reader is None:
        remedy = f"use one of {', '.join(READERS)}"
        raise InputError(file, "", f"the suffix '{path.suffix}' is unknown", remedy)
    return reader(file)


def _open_frame(frame: pd.DataFrame) -> ColumnFile:
    """The columns of a table in memory, which may have units in ``frame.attrs["units"]``."""
    headings = tuple(str(heading) for heading in frame.columns)
    known = frame.attrs.get("units", {})

    def load(positions: Sequence[int]) -> list[Column]:
        columns = []
        for position in positions:
            try:
                columns.append(pa.Array.from_pandas(frame.iloc[:, position]))
            except (pa.ArrowInvalid, pa.ArrowTypeError, pa.ArrowNotImplementedError):
                fault = "it holds a mixture of things, not numbers in one unit"
                raise InputError(TABLE, f"column {headings[position]}", fault, "make it numbers") from None
        return columns

    return ColumnFile(headings, tuple(known.get(read_heading(one).title) for one in headings), load)


@contextmanager
def _reading(file: str, kind: str) -> Iterator[None]:
    # On a damaged file the parsers raise almost anything, from OSError to IndexError and MemoryError.
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        reason = str(error).split("\n")[0].rstrip(".") or type(error).__name__
        fault = f"it cannot be read as {kind} ({reason})"
        raise InputError(file, "", fault, "check its suffix, or write it again") from None


def _open_text(file: str) -> ColumnFile:
    """Recognise how a table of text is written: encoding, comments, headings, units, separator, decimals."""
    content = Path(file).read_bytes()
    try:
        content = gzip.decompress(content) if content.startswith(GZIP) else content
    except (OSError, EOFError, zlib.error):
        raise InputError(file, "", "it cannot be unpacked", "write the recordings again") from None
    content, remarks = _in_utf8(file, content)
    content = _FORTRAN.sub(rb"\1E", content.replace("\u2212".encode(), b"-"))  # the minus of typesetters, too
    if content.startswith((b'"TOA5"', b"TOA5,")):  # of data loggers: station, names, units, how each was made
        _, names_of, units_of, _, *table = content.decode().splitlines()
        named = zip(*csv.reader([names_of, units_of]), strict=False)
        heading = ",".join(f'"{a} [{b}]"' if is_unit(b) and b != "TS" else f'"{a}"' for a, b in named)
        content = "\n".join([heading, *table]).encode()
    content = _WIDTHS.sub(b"", content, count=1)
    header = content[:LARGEST_HEADER].rfind(_END_OF_HEADER)
    begin, comments, separator = 0 if header < 0 else _after_line(content, header), [], ""
    while begin < len(content):
        end = _after_line(content, begin)
        line = content[begin:end].decode("utf-8", errors="ignore").strip()
        mark = next((each for each in _COMMENTS if line.startswith(each)), None)
        if match := re.fullmatch(r'"?sep=(.)"?', line):
            separator = match[1]
        elif mark is not None:
            comments.append(line.lstrip(mark).strip())
        elif line.strip(',;\t "|'):
            break
        begin = end
    sample = content[begin : begin + 200_000].decode("utf-8", errors="ignore").splitlines()[:SAMPLED_LINES]
    lines = [line for line in sample if line.strip() and not line.lstrip().startswith(_COMMENTS)]
    if not lines:
        raise InputError(file, "", "the table has no headings and no rows", "write the recordings again")
    # An oscilloscope writes numbers to the right of its settings, which end after some lines.
    rows = [_split(line, ",") for line in lines]
    beside = [place for place, cell in enumerate(rows[-1]) if cell]
    if (
        len(rows) >= FEWEST_UNNAMED and len(beside) > 1 and beside[0] > 0 and rows[0][0]
        and all(len(row) > beside[-1] and all(_NUMERIC.fullmatch(row[k]) for k in beside) for row in rows)
    ):  # fmt: skip
        cells = csv.reader(content[begin:].decode("utf-8", errors="ignore").splitlines())
        columns = [",".join(row[place] for place in beside) for row in cells if row]
        content, begin, lines = "\n".join(columns).encode(), 0, columns[: len(lines)]
    before = _preamble(lines, separator)
    comments += lines[:before]
    begin, lines = begin if not before else content.index(lines[before].encode(), begin), lines[before:]
    separator = separator or _separator(lines)
    stated = [comment for comment in comments if SAMPLING.match(comment)]
    comments = [_LABELS.sub("", comment) for comment in comments if comment not in stated]
    sampling = stated[0] if len(stated) == 1 else ""
    headings, title = _split(lines[0], separator), lines[0].strip()
    unnamed = all(map(_NUMERIC.fullmatch, headings))
    # Tables put one below the other repeat their headings.
    if not unnamed and content.count(title.encode(), begin) > 1:
        first, *others = content[begin:].splitlines()
        content, begin = b"\n".join([first, *[line for line in others if line.strip() != title.encode()]]), 0
        lines = [lines[0], *(line for line in lines[1:] if line.strip() != title)]
    rows = [_split(line, separator) for line in lines[1:]]
    if unnamed:
        # Of several comments the last one with a word of its own for each column.
        split = (_split(comment, separator) for comment in reversed(comments))
        above = next((cells for cells in split if len(set(cells)) == len(cells) == len(headings)), [])
        if not above and (len(headings) > 1 or sampling) and len(rows) >= FEWEST_UNNAMED:
            above = [f"column {number}" for number in range(1, len(headings) + 1)]
            remarks.append(Remark("data.no_headings", {}))
        if not above:
            example = ",".join(["t", *"xyzuvw"][: max(len(headings), 2)])
            fault = "the first line holds numbers where the headings should stand"
            remedy = f"add a first line that names the columns, the time among them, such as {example}"
            raise InputError(file, "line 1" if begin == 0 else "", fault, remedy)
        headings, rows = above, [headings, *rows]
    else:
        begin = _after_line(content, begin)
    commented = header >= 0 and headings[-1].strip() == "Comment"  # of which most rows have no cell
    if commented:
        headings = headings[:-1]
        rows = [row[: len(headings)] for row in rows]
    units: list[str | None] = [None] * len(headings)
    if rows and (found := _line_of_units(rows[0], len(headings))) is not None:
        units, rows, begin = found, rows[1:], _after_line(content, begin)
        remarks.append(Remark("data.line_of_units"))
    decimal_mark = _decimal_mark(file, rows, len(headings), separator)
    if separator != ",":
        values = {"separator": _SEPARATORS[separator], "decimal_comma": decimal_mark == ","}
        remarks.append(Remark("data.separator", values))
    body, marks = content[begin:], tuple(mark.encode() for mark in _COMMENTS)
    if any(b"\n" + mark in body or body.startswith(mark) for mark in marks):
        body = b"\n".join(line for line in body.splitlines() if not line.startswith(marks))
    if commented:
        cell = separator.encode()
        body = b"\n".join(cell.join(line.split(cell)[: len(headings)]) for line in body.splitlines())
    if separator == " ":
        body, separator = b"\n".join(b"\t".join(line.split()) for line in body.splitlines()), "\t"
    labels = [place for place, heading in enumerate(headings) if read_heading(heading).is_label]
    names = [str(position) for position in range(len(headings))]

    def load(positions: Sequence[int]) -> list[Column]:
        numbers = {str(position) for position in positions if position not in labels}
        try:
            cells = _read_cells(file, body, names, separator, decimal_mark, numbers)
        except pa.ArrowInvalid:  # text among the numbers, or a line of another length: find out where
            numbers = set()
            cells = _read_cells(file, body, names, separator, decimal_mark, numbers)
        missing = [pa.array([*_MISSING, *(() if place in labels else _DASHES)]) for place in positions]
        return [
            column if str(place) in numbers else pc.if_else(pc.is_in(column, none), None, column)
            for place, none in zip(positions, missing, strict=True)
            for column in [cells.column(str(place))]
        ]

    return ColumnFile(tuple(headings), tuple(units), load, remarks=tuple(remarks), sampling=sampling)


def _in_utf8(file: str, content: bytes) -> tuple[bytes, list[Remark]]:
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        try:
            return content.decode("utf-16").encode(), [Remark("data.encoding", {"name": "UTF-16"})]
        except UnicodeDecodeError:
            pass
    content = content.removeprefix(codecs.BOM_UTF8)
    if b"\0" in content[:100_000]:
        raise InputError(file, "", "the file is no text", "save the table as CSV in UTF-8")
    try:
        content.decode()
    except UnicodeDecodeError:
        # What Windows writes in western Europe; five bytes have no meaning there.
        try:
            return content.decode("cp1252").encode(), [Remark("data.encoding", {"name": "Windows-1252"})]
        except UnicodeDecodeError:
            raise InputError(file, "", "the text is not UTF-8", "save it as CSV in UTF-8") from None
    return content, []


def _after_line(content: bytes, begin: int) -> int:
    match = re.compile(rb"\r\n|\n|\r").search(content, begin)
    return match.end() if match else len(content)


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


def _preamble(lines: list[str], separator: str) -> int:
    """How many lines stand before the headings, such as ``Operator: Ann`` or ``Horizontal scale,0.0004``.

    Rows have numbers where the last one has. No line before the headings has them all.
    """
    separator = separator or _separator(lines[-2:])
    rows = [_split(line, separator) for line in lines]
    numbers = [place for place, cell in enumerate(rows[-1]) if _NUMERIC.fullmatch(cell)]
    data = [
        len(row) == len(rows[-1]) and all(_NUMERIC.fullmatch(row[place]) for place in numbers) for row in rows
    ]
    if not numbers or sum(data) < FEWEST_UNNAMED:
        return 0
    first = data.index(True)
    units = first > 1 and _line_of_units(rows[first - 1], len(rows[-1])) is not None
    headings = first - 1 - units
    if headings <= 0 or len(rows[headings]) != len(rows[-1]) or any(map(_NUMERIC.fullmatch, rows[headings])):
        return 0
    return headings


def _split(line: str, separator: str) -> list[str]:
    if separator == " ":
        # "t (s)" is one heading, not two.
        return [cell.replace("\0", " ") for cell in re.sub(r"\s+(?=[\[(])", "\0", line.strip()).split()]
    return [cell.strip() for cell in next(csv.reader([line], delimiter=separator), [])]


def _line_of_units(cells: list[str], width: int) -> list[str | None] | None:
    """Units from the second line of headings, if that is what it is: no number, and a unit at least."""
    inner = [cell.strip("[]() ") for cell in cells]
    if any(cell and not is_unit(text) for cell, text in zip(cells, inner, strict=True)):
        return None
    units = [text if text not in ("", "-") else None for text in inner]
    return units if len(cells) == width and any(units) and not any(map(_NUMERIC.fullmatch, cells)) else None


def _decimal_mark(file: str, rows: list[list[str]], width: int, separator: str) -> str:
    if separator == "," and rows and len(rows[0]) > width and all(len(row) == len(rows[0]) for row in rows):
        fault = f"the headings name {width} columns and the rows have {len(rows[0])} cells"
        remedy = "write decimal points, or separate the columns by semicolons if decimals have commas"
        raise InputError(file, "", fault, remedy)
    cells = [cell for row in rows for cell in row]
    for number, cell in ((number, cell) for number, row in enumerate(rows, 1) for cell in row):
        quoted = separator == "," and "," in cell and _NUMBER.fullmatch(cell.replace(",", ""))
        if quoted or (separator != "," and _GROUPED.fullmatch(cell)):
            fault = f"'{cell}' has a mark between thousands, or a decimal comma"
            remedy = "write numbers with a decimal point, and without marks between thousands"
            raise InputError(file, f"row {number}", fault, remedy)
    commas = next((cell for cell in cells if _DECIMAL_COMMA.fullmatch(cell)), None)
    points = next((cell for cell in cells if "." in cell and _NUMBER.fullmatch(cell)), None)
    if commas is not None and points is not None:
        fault = f"decimals are written with commas ('{commas}') and with points ('{points}')"
        raise InputError(file, "", fault, "write all numbers in the same way")
    return "." if commas is None else ","


def _read_cells(
    file: str, body: bytes, names: list[str], separator: str, decimal_mark: str, numbers: set[str]
) -> pa.Table:
    """Read the columns named `numbers` (by position, as text) as numbers, all others as text."""
    if not body.strip():
        return pa.table({name: pa.array([], pa.string()) for name in names})
    ragged: list[arrow_csv.InvalidRow] = []

    def keep_first(row: arrow_csv.InvalidRow) -> str:
        ragged.append(row)
        return "error"

    # Rows are counted only when one thread reads.
    reading = arrow_csv.ReadOptions(column_names=names, use_threads=bool(numbers))
    parsing = arrow_csv.ParseOptions(delimiter=separator, invalid_row_handler=None if numbers else keep_first)
    converting = arrow_csv.ConvertOptions(
        column_types={name: pa.float64() if name in numbers else pa.string() for name in names},
        decimal_point=decimal_mark, null_values=[*_MISSING, *_DASHES], quoted_strings_can_be_null=True,
    )  # fmt: skip
    if numbers:
        return arrow_csv.read_csv(pa.BufferReader(body), reading, parsing, converting)
    with _reading(file, "CSV"):
        try:
            cells = arrow_csv.read_csv(pa.BufferReader(body), reading, parsing, converting)
        except pa.ArrowInvalid:
            if not ragged:
                raise
            fault = f"it has {ragged[0].actual_columns} cells while the header has {len(names)}"
            remedy = "give every row one cell per column, and quote cells that hold a comma"
            raise InputError(file, f"row {ragged[0].number}", fault, remedy) from None
    if decimal_mark == ",":  # "1.5 mm" in the place of "1,5 mm"
        comma = r"^(\s*[+-]?[0-9]*),([0-9])"
        return pa.table(
            {name: pc.replace_substring_regex(cells[name], comma, r"\1.\2") for name in cells.column_names}
        )
    return cells


def _open_parquet(file: str) -> ColumnFile:
    from pyarrow import parquet

    with _reading(file, "Parquet"), parquet.ParquetFile(file) as handle:
        schema = handle.schema_arrow

    def load(positions: Sequence[int]) -> list[Column]:
        with _reading(file, "Parquet"), parquet.ParquetFile(file) as handle:
            table = handle.read(columns=[schema.names[position] for position in positions])
        return [table.column(schema.names[position]) for position in positions]

    kept = [field.metadata or {} for field in schema]
    units, titles = (tuple(_text(each.get(key)) for each in kept) for key in (b"unit", b"heading"))
    remarks = map(Remark.from_data, json.loads((schema.metadata or {}).get(b"notes", b"[]")))
    return ColumnFile(tuple(schema.names), units, load, titles, tuple(remarks))


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
                return _vectors(file, {name: rows[name] for name in wanted})
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
                columns[name] = values
        return _vectors(file, columns)

    return ColumnFile(tuple(names), tuple(units), load)


class _Variable(NamedTuple):
    """A variable of a NetCDF file, over dimensions."""

    dimensions: tuple[str, ...]
    values: np.ndarray
    attributes: Mapping[str, Any]

    @property
    def unit(self) -> str | None:
        """Of a clock, ``seconds since 2020-01-01``, without its beginning."""
        said = _text(self.attributes.get("units"))
        return said and said.partition(" since ")[0]

    def unpacked(self) -> np.ndarray:
        """Values as the conventions for climate data (CF) pack them into integers, NaN where none is."""
        told, values = self.attributes, self.values
        if values.dtype.kind not in "iuf":
            return values
        empty = [told[key] for key in ("_FillValue", "missing_value") if key in told]
        if not empty and not any(key in told for key in ("scale_factor", "add_offset")):
            return values
        numbers = np.where(np.isin(values, np.ravel(empty)), np.nan, values.astype(float))
        return np.asarray(numbers * told.get("scale_factor", 1.0) + told.get("add_offset", 0.0))


def _open_netcdf(file: str) -> ColumnFile:
    import h5py
    from scipy.io import netcdf_file

    found = {}
    with _reading(file, "NetCDF"):
        if not h5py.is_hdf5(file):  # version 3
            with netcdf_file(file, mmap=False) as handle:
                for name, each in handle.variables.items():
                    dimensions = each.dimensions
                    values = np.array(each[...] if dimensions else each.data)
                    if values.dtype == "S1" and values.ndim:  # text, character by character
                        values, dimensions = values.view(f"S{values.shape[-1]}")[..., 0], dimensions[:-1]
                    found[name] = _Variable(dimensions, values, each._attributes)
            return _over_dimensions(file, found)
        with h5py.File(file, "r") as handle:
            for name, each in handle.items():
                attributes = dict(each.attrs)
                bare = b"not a netCDF variable" in attributes.get("NAME", b"")  # the size of a dimension
                if bare or not isinstance(each, h5py.Dataset):
                    continue
                axes = ((name,) if each.is_scale and not axis else (axis[0].name,) for axis in each.dims)
                dimensions = tuple(axis[0].rpartition("/")[2] for axis in axes)
                found[name] = _Variable(dimensions, each[()], attributes)
    return _over_dimensions(file, found)


def _over_dimensions(file: str, variables: dict[str, _Variable]) -> ColumnFile:
    """Variables as columns: a row for every element of the dimensions that they have together.

    A dimension that numbers recordings and has no variable of its name is a column, too.
    """
    several = {name: each for name, each in variables.items() if each.dimensions}
    if not several:
        raise InputError(file, "", "it has no variable over a dimension", "store t and the states over one")
    sizes: dict[str, int] = {}
    for each in sorted(several.values(), key=lambda one: -len(one.dimensions)):
        sizes |= dict(zip(each.dimensions, each.values.shape, strict=True))
    for name in sizes:
        if name not in several and read_heading(name).is_label:
            several[name] = _Variable((name,), np.arange(sizes[name]), {})
    names, order = tuple(several), list(sizes)

    def load(positions: Sequence[int]) -> list[Column]:
        columns = {}
        for name in (names[position] for position in positions):
            own = several[name].dimensions
            values = several[name].unpacked().transpose([own.index(one) for one in order if one in own])
            values = values.reshape([sizes[one] if one in own else 1 for one in order])
            columns[name] = np.broadcast_to(values, tuple(sizes.values())).ravel()
        return _vectors(file, columns)

    return ColumnFile(names, tuple(several[name].unit for name in names), load)


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
            return _vectors(file, {name: variables[name] for name in wanted})

    return ColumnFile(names, (None,) * len(names), load)


def _open_numpy(file: str) -> ColumnFile:
    with _reading(file, "NumPy"):
        kept = np.load(file, allow_pickle=False)
        fields = kept.dtype.names if isinstance(kept, np.ndarray) else tuple(kept.files)
        columns = {name: kept[name] for name in fields or ()}
    remarks: tuple[Remark, ...] = ()
    if not columns and kept.ndim == 2 and kept.shape[1] > 1 and len(kept) >= FEWEST_UNNAMED:
        columns = {f"column {number}": one for number, one in enumerate(kept.T, start=1)}
        remarks = (Remark("data.no_headings", {}),)
    if not columns:
        remedy = "write numpy.savez(file, t=..., x=...), or a table with headings"
        raise InputError(file, "", "it is one array without names for its columns", remedy)
    names = tuple(columns)

    def load(positions: Sequence[int]) -> list[Column]:
        return _vectors(file, {names[position]: columns[names[position]] for position in positions})

    return ColumnFile(names, (None,) * len(names), load, remarks=remarks)


READERS: dict[str, Callable[[str], ColumnFile]] = {
    ".parquet": _open_parquet,
    **dict.fromkeys((".csv", ".tsv", ".txt", ".dat", ".lvm", ".asc", ".rdb"), _open_text),
    **dict.fromkeys((".h5", ".hdf5"), _open_hdf5),
    ".nc": _open_netcdf,
    ".mat": _open_matlab,
    **dict.fromkeys((".npz", ".npy"), _open_numpy),
}
"""How the columns of a file are read, by the suffix of its name."""


def _vectors(file: str, arrays: Mapping[str, np.ndarray]) -> list[Column]:
    """Arrays, by the names of their columns, as vectors of one length."""
    columns = {name: _vector(file, name, values) for name, values in arrays.items()}
    (first, other), *_ = columns.items()
    for name, column in columns.items():
        if len(column) != len(other):
            fault = f"it has {len(column)} rows while column {first} has {len(other)}"
            remedy = "give all columns one value per sample, or name the columns to read"
            raise InputError(file, f"column {name}", fault, remedy)
    return list(columns.values())


def _vector(file: str, name: str, values: np.ndarray) -> Column:
    values = np.asarray(values)
    if values.ndim != 1:
        if values.ndim and values.size != max(values.shape):
            raise _no_vector(file, name, f"of shape {' × '.join(map(str, values.shape))}")
        values = values.ravel()
    kind = values.dtype.kind
    if kind == "f":
        return pa.array(values.astype(np.float64, copy=False))  # native byte order and precision
    if kind in "iub":
        return pa.array(values.astype(values.dtype.newbyteorder("="), copy=False))
    if kind == "S" or (kind == "O" and all(isinstance(each, bytes) for each in values[:1])):
        return pa.array(values.tolist(), type=pa.binary()).cast(pa.string())
    if kind == "M":
        return pa.array(values)
    if kind == "U":
        return pa.array(values.tolist(), type=pa.string())
    held = "complex numbers" if kind == "c" else "cells, structs or references"
    raise _no_vector(file, name, f"an array of {held}")


def _no_vector(file: str, name: str, found: str) -> InputError:
    text = ", or labels as one text per row" if name == "recording" else ""
    remedy = f"store one vector of numbers{text}"
    return InputError(file, f"column {name}", f"it is {found}, not one vector", remedy)


def _text(value: object) -> str | None:
    if isinstance(value, np.ndarray | np.generic) and value.size == 1:
        value = value.item()
    if isinstance(value, bytes):
        value = value.decode("utf-8", errors="replace")
    return value if isinstance(value, str) else None
