"""How many seconds are between times that a clock wrote?

Dates and times of day become seconds since the first of the file, since nothing else depends on when a
recording was made.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa

from siq.errors import InputError

if TYPE_CHECKING:
    from siq.data.cells import Column

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
