"""How does a page become HTML that needs nothing else? Cells, downloads, sizes, and the templates."""

from __future__ import annotations

import base64
import datetime
import re
from typing import Any

import numpy as np
import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined

from siq.numerics.number_text import number_text

LARGEST_VECTOR = 400_000  # bytes: a larger SVG is offered as the PNG that is shown
DOTS_PER_INCH = 200  # of the PNG files; pages have 96
CHARACTER = 7.6  # pixels, about: the width of a figure in a table
CELL = 18.0  # pixels around it
SHORT_TEXT, LINE = 24, 34  # characters: longer texts wrap, to lines no shorter than the latter
PHONE, PAGE = 360, 950  # pixels that a table may fill


def render_template(name: str, content: object) -> str:
    """Render a page as HTML; all text is escaped, but for what is `markupsafe.Markup`."""
    return _environment().get_template(name).render(content=content)


def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("siq.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {
        "cell": cell_text,
        "is_number": _is_number_column,
        "kept_columns": kept_columns,
        "data_address": _data_address,
        "figure_download": _figure_download,
        "table_download": _table_download,
        "file_name": file_name,
        "page_width": _page_width,
        "wide_for": _wide_for,
        "short": short_caption,
        "unbroken": lambda text: text.replace(" × 10", "\u00a0×\u00a010"),
        "records": lambda frame: list(frame.itertuples(index=False, name=None)),
    }
    return environment


def kept_columns(frame: pd.DataFrame) -> pd.DataFrame:
    """The table without columns that say nothing: of missing values, or of empty texts."""
    said = [not (frame[name].isna() | (frame[name].astype(str) == "")).all() for name in frame.columns]
    return frame if all(said) or frame.empty else frame.loc[:, said]


def _address(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"


_KINDS = {"svg": "image/svg+xml", "png": "image/png"}


def _data_address(figure: Any) -> str:
    # An SVG inside <img> keeps its identifiers to itself and cannot run or load anything.
    return _address(_KINDS[figure.kind], figure.image)


def _figure_download(figure: Any) -> tuple[str, str]:
    """What a figure is downloaded as: its kind and its address."""
    if figure.vector is not None and len(figure.vector) <= LARGEST_VECTOR:
        return "svg", _address(_KINDS["svg"], figure.vector)
    return figure.kind, _data_address(figure)


def _table_download(table: Any) -> str:
    frame = table.frame if table.data is None else table.data
    text = frame.to_csv(index=False, lineterminator="\n")
    return _address("text/csv;charset=utf-8", text.encode("utf-8"))


def short_caption(caption: str) -> str:
    """The first sentence, or its first part, for the contents: no more than a line."""
    first = re.split(r"(?<=[a-zà-ÿ)\]])[.:;](?:\s|$)", caption, maxsplit=1)[0].rstrip(".")
    return first if len(first) <= 90 else first[:88].rsplit(" ", 1)[0] + " …"


def file_name(caption: str, number: int, *, what: str) -> str:
    """A name for a download: ``table-3-barriers-of-u``."""
    words = re.findall(r"[a-z0-9]+", caption.lower())[:5]
    return "-".join([what, str(number), *words])


def _page_width(figure: Any) -> int:
    # The first chunk of every PNG holds its width in dots.
    if figure.kind == "png":
        return round(int.from_bytes(figure.image[16:20], "big") * 96 / DOTS_PER_INCH)
    head = figure.image[:2000].decode("utf-8", errors="replace")
    found = re.search(r"<svg[^>]*\bwidth=\"([\d.]+)(pt|px|in)?\"", head)
    if found is None:
        return 600
    return round(float(found[1]) * {"pt": 96 / 72, "in": 96.0}.get(found[2] or "px", 1.0))


def _wide_for(frame: pd.DataFrame, rows: int) -> str:
    """For which screens a table is about too wide: ``page phone``, ``phone``, or none."""
    width = 0.0
    for name in frame.columns:
        cells = [_least_width(cell_text(value)) for value in frame[name].head(rows)]
        width += CELL + CHARACTER * max([longest_word(str(name)), *cells])
    return "page phone" if width > PAGE else "phone" if width > PHONE else ""


def _least_width(text: str) -> int:
    """Characters on the narrowest line that a cell can be set in: long texts wrap."""
    return len(text) if len(text) <= SHORT_TEXT else min(LINE, max(longest_word(text), SHORT_TEXT // 2))


def longest_word(text: str) -> int:
    """Characters of the longest word: headings wrap, figures do not."""
    return max((len(word) for word in text.split()), default=0)


def _is_number_column(column: pd.Series) -> bool:
    return pd.api.types.is_numeric_dtype(column) and not pd.api.types.is_bool_dtype(column)


def cell_text(value: object) -> str:
    """What stands in a cell."""
    if value is None or value is pd.NA or value is pd.NaT:
        return "—"
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if isinstance(value, int | np.integer):
        return str(value).replace("-", "−")
    if isinstance(value, float | np.floating):
        return str(int(value)).replace("-", "−") if _is_whole(float(value)) else number_text(float(value))
    if isinstance(value, datetime.datetime):
        return value.isoformat(sep=" ", timespec="seconds")
    return str(value)


def _is_whole(value: float) -> bool:
    # Counts become floating-point numbers as soon as one of their column is missing.
    return value.is_integer() and abs(value) < 1e5
