"""Files of recordings: which formats are read, and how.

Parquet, CSV, HDF5 and MATLAB files are told apart by suffix and all become the same thing: names, known
before anything large is read, and columns of cells, read on request. What the cells mean is the matter of
`siq.data.cells`.

Files are data. Nothing is unpickled, and MATLAB objects and structs are refused before they are read.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa

from siq.data.cells import Column, split_heading
from siq.data.checks import equally_long
from siq.errors import InputError

if TYPE_CHECKING:
    import pandas as pd

# Each reader imports the library of its format itself: most jobs read Parquet only.


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


def frame_columns(file: str, frame: pd.DataFrame) -> ColumnFile:
    """The columns of a table in memory, as those of a file; without labels all rows are one recording.

    Parameters
    ----------
    file
        What messages call the table.
    frame
        Columns may have a unit behind their name, or in ``frame.attrs["units"]``.
    """
    headings = [str(heading) for heading in frame.columns]
    labelled = any(split_heading(heading)[0] == "recording" for heading in headings)
    known = frame.attrs.get("units", {})
    units = [known.get(split_heading(heading)[0]) for heading in headings]

    def load(positions: Sequence[int]) -> list[Column]:
        columns = []
        for position in positions:
            if position == len(headings):
                columns.append(pa.array(["0"] * len(frame)))
                continue
            try:
                columns.append(pa.Array.from_pandas(frame.iloc[:, position]))
            except (pa.ArrowInvalid, pa.ArrowTypeError, pa.ArrowNotImplementedError):
                fault = "it holds a mixture of things, not numbers in one unit"
                raise InputError(file, f"column {headings[position]}", fault, "make it numbers") from None
        return columns

    return _column_file(headings + ([] if labelled else ["recording"]), load, units + [None] * (not labelled))


def _column_file(
    headings: Sequence[str],
    load: Callable[[Sequence[int]], list[Column]],
    metadata: Sequence[str | None] | None = None,
) -> ColumnFile:
    parts = [split_heading(heading) for heading in headings]
    places = zip(parts, metadata or [None] * len(parts), strict=True)
    units = tuple({"name": unit, "metadata": kept} for (_, unit), kept in places)
    return ColumnFile(names=tuple(name for name, _ in parts), units=units, load=load)


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
    labels = [position for position, name in enumerate(header) if split_heading(name)[0] == "recording"]

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


def _text(value: object) -> str | None:
    if isinstance(value, np.ndarray | np.generic) and value.size == 1:
        value = value.item()
    if isinstance(value, bytes):
        value = value.decode("utf-8", errors="replace")
    return value if isinstance(value, str) else None
