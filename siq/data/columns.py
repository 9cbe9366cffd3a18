"""Columns of recordings: headings, labels, the order of times, and how finely values were written.

What is asked of a table as a whole, whatever file it is from; single cells are checked by
`siq.data.cells`.

A column whose values are all multiples of one step, 0.001 or the least step of a digitiser, was rounded to
that step. Each value is then off by up to half a step, with a standard deviation of step/√12.

``x [mm]``, ``x (mm)``, ``x / mm`` and ``x in mm`` all are x in millimetres; ``t_s`` is the time in seconds.
Names stand in formulas: ``bead x`` becomes ``bead_x`` there, and keeps its heading beside it.
"""

from __future__ import annotations

import keyword
import re
import unicodedata
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from siq.errors import InputError


def distinct_labels(labels: tuple[str, ...], chosen: np.ndarray) -> tuple[str, ...]:
    """Give the labels of the chosen recordings; a copy is told apart by its label: ``r07``, ``r07#2``.

    Parameters
    ----------
    labels
        The labels of all recordings.
    chosen
        Shape ``(m,)``: indices into `labels`; one may stand more than once.
    """
    taken = set(labels)  # a label of the file may itself look like that of a copy
    copies: dict[int, int] = {}
    distinct = []
    for index in chosen.tolist():
        label, copy = labels[index], copies.get(index, 0) + 1
        while copy > 1 and f"{label}#{copy}" in taken:
            copy += 1
        copies[index] = copy
        distinct.append(label if copy == 1 else f"{label}#{copy}")
        taken.add(distinct[-1])
    return tuple(distinct)


def sources(labels: tuple[str, ...]) -> np.ndarray:
    """Index of the recording that each is, or is a copy of: ``r07#2`` is a copy where there is an ``r07``.

    Parameters
    ----------
    labels
        The labels of all recordings, k of them.

    Returns
    -------
    numpy.ndarray
        Shape ``(k,)``, indices into `labels`.
    """
    position = {label: index for index, label in enumerate(labels)}

    def source(label: str) -> int:
        original, _, copy = label.rpartition("#")
        return position[original if copy.isdigit() and original in position else label]

    return np.array([source(label) for label in labels], dtype=np.int64)


if TYPE_CHECKING:
    from siq.data.cells import Column


def equally_long(file: str, columns: dict[str, Column]) -> list[Column]:
    """Give the columns, by name, as a list; InputError for the first that is not as long as the first one."""
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


def check_times(
    file: str, t: np.ndarray, recording: np.ndarray, labels: tuple[str, ...], rows: np.ndarray
) -> None:
    """Refuse times that do not increase within every recording.

    Parameters
    ----------
    file
        The file, for messages.
    t, recording
        Shape ``(n,)``: the time and the recording of each row; the rows of a recording stand together.
    labels
        The label of each recording.
    rows
        Shape ``(n,)``: where each row stands in the file, counted from 0.

    Raises
    ------
    InputError
        For the first row of the file whose time is repeated or earlier, or when no recording has two rows.
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
        remedy = "keep one of the two rows, or label them as two recordings"
    else:
        fault = f"the times of recording '{label}' are unsorted ({now} comes after {before})"
        remedy = "sort its rows by t, or begin a new label where a new recording begins"
    raise InputError(file, f"row {rows[earlier + 1] + 1}, column t", fault, remedy)


MOST_DECIMALS = 12  # a double of size 1 has 15 to 16; what has as many as that was not rounded
FEWEST_VALUES = 8  # distinct values below which a step says nothing
SAMPLE = 2000  # distinct values that are looked at before all are


def quantum(values: np.ndarray) -> float | None:
    """The step of which all values are multiples, None where there is none.

    Parameters
    ----------
    values
        Shape ``(n,)``, finite.

    Returns
    -------
    float or None
        A power of ten where the values have so many decimals; else the least difference of two values, where
        all differences are multiples of it.

    Examples
    --------
    >>> quantum(np.round(np.sin(np.arange(100.0)), 3))
    0.001
    >>> quantum(np.sin(np.arange(100.0))) is None
    True
    """
    some = np.unique(values[:: max(len(values) // SAMPLE, 1)])
    if len(some) < FEWEST_VALUES:
        return None
    largest = float(np.abs(some).max())
    if largest == 0:
        return None
    most = MOST_DECIMALS - int(np.ceil(np.log10(largest)))
    for decimals in range(most - MOST_DECIMALS, most + 1):
        if _are_multiples(some, decimals) and _are_multiples(values, decimals):
            return float(f"1e{-decimals}")
    return _least_difference(values)


def decimals_of(step: float) -> int | None:
    """How many decimals a number has that was rounded to `step`; None where that is no power of ten."""
    decimals = round(-np.log10(step))
    return max(decimals, 0) if np.isclose(step, 10.0**-decimals, rtol=1e-9) else None


def rounding_error(step: float) -> float:
    """Standard deviation of what rounding to `step` does to a value."""
    return step / float(np.sqrt(12.0))


def _are_multiples(values: np.ndarray, decimals: int) -> bool:
    # Rounding as a writer does gives back the very number that was read, where it has no further decimals.
    return bool((np.round(values, decimals) == values).all() if decimals >= 0 else False) or bool(
        np.allclose(np.round(values, decimals), values, rtol=1e-14, atol=0.0)
    )


def _least_difference(values: np.ndarray) -> float | None:
    """The step of a digitiser: many equal values, all of them a whole number of steps apart."""
    levels = np.unique(values)
    if not FEWEST_VALUES <= len(levels) <= len(values) // 2:
        return None
    gaps = np.diff(levels)
    # Levels that differ by less than numbers are written with are one level.
    gaps = gaps[gaps > 1e-9 * np.ptp(levels)]
    if len(gaps) == 0:
        return None
    step = float(gaps.min())
    counts = (levels - levels[0]) / step
    if counts[-1] > 1e7 or np.abs(counts - np.round(counts)).max() > 0.05:
        return None
    return float(np.ptp(levels) / np.round(counts[-1]))


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


RESERVED = _words("sin cos tan exp log sqrt tanh atan Abs sign Max Min pi recording t delay")
"""What no state may be called, since formulas have another meaning for it (`siq.systems.cards`)."""

TIME_NAMES = _words(
    "t time times zeit temps tiempo tempo timestamp timestamps datetime date elapsed elapsedtime clock"
    " clocktime uhrzeit seconds"
)
LABEL_NAMES = _words(
    "recording recordings record run runs trial trials id rec experiment measurement series trajectory traj"
    " track trackid runid recordingid trialid recid trajectoryid replicate repetition rep file filename sweep"
    " ringdown label particle particleid messung versuch aufnahme"
)
INDEX_NAMES = _words("index idx row rowid rownumber unnamed")
TIME_UNITS = _words(
    "ns us µs μs ms s sec secs second seconds min minute minutes h hr hrs hour hours d day days yr year years"
)

# Symbols of units, longest first; those after a prefix may also stand alone.
_PREFIX = "(?:da|[YZEPTGMkhdcmuµμnpfazy])?"
_PREFIXED = "mol|Ohm|ohm|rad|bar|cal|cd|Hz|Pa|Wb|lm|lx|sr|Da|eV|px|Ω|m|s|g|A|K|N|J|W|V|C|F|H|T|S|L|l|M|B"
_ALONE = (
    r"counts?|cts|pixels?|px|adu|ADU|a\.?u\.?|arb\.? ?u(?:nits?)?\.?|n\.?u\.?|atm|Torr|mmHg|rpm|ppm|ppb|dB"
    r"|deg|degrees?|radians?|°[CF]?|%|‰|1|-|min|minutes?|hours?|hrs?|h|days?|d|years?|yr|sec(?:ond)?s?|volts?"
    r"|meters?|metres?|k_?B ?T|kT|Å|u|LSB|lsb|bits?"
)
_POWER = r"(?:(?:\^|\*\*)?\{?[-−+]?\d+(?:[./]\d+)?\}?|[⁺⁻]?[⁰¹²³⁴⁵⁶⁷⁸⁹]+)?"
_FACTOR = rf"(?:(?:{_ALONE}|{_PREFIX}(?:{_PREFIXED})){_POWER})"
_UNIT = re.compile(rf"\(?{_FACTOR}(?:\s*(?:[·*⋅×/]|\s)\s*\(?{_FACTOR}\)?)*\)?")


class Heading(NamedTuple):
    """A heading, taken apart: what people call the column, and its unit where it says one."""

    title: str
    unit: str | None


def is_unit(text: str) -> bool:
    """Whether text reads as a unit: ``mm``, ``µm/s``, ``kg m^-3``, ``arb. units``.

    Examples
    --------
    >>> [is_unit(text) for text in ("mm", "µm²/s", "raw", "left", "a.u.")]
    [True, True, False, False, True]
    """
    return _UNIT.fullmatch(text.strip()) is not None


def read_heading(heading: str) -> Heading:
    """Take a heading apart.

    Examples
    --------
    >>> read_heading("bead x (µm)"), read_heading("x(t)"), read_heading("time_ms")
    (Heading(title='bead x', unit='µm'), Heading(title='x', unit=None), Heading(title='time', unit='ms'))
    """
    text = heading.strip()
    if match := re.fullmatch(r"(.*?)\s*\[\s*(.*?)\s*\]", text):
        return Heading(_without_time(match[1]), match[2] or None)
    if match := re.fullmatch(r"(.*?\S)\s*\(\s*(.*?)\s*\)", text):
        if is_unit(match[2]):
            return Heading(_without_time(match[1]), match[2])
        return Heading(_without_time(text), None)
    for pattern in (r"(.*?\S)\s+/\s*(\S.*)", r"(.*?\S)\s+in\s+(\S.*)", r"(.*?\S)\s*,\s*(\S.*)"):
        if (match := re.fullmatch(pattern, text)) and is_unit(match[2]):
            return Heading(match[1], match[2])
    if (
        (match := re.fullmatch(r"(.+?)[\s_./]+([^\s_./]+)", text))
        and match[2] in TIME_UNITS
        and is_time(match[1])
    ):
        return Heading(match[1], match[2])
    return Heading(text, None)


def _without_time(title: str) -> str:
    """``x`` of ``x(t)``."""
    return re.sub(r"\s*\(\s*t\s*\)$", "", title)


def usable_name(title: str) -> str:
    """A name that formulas can use, as close to the title as can be.

    Examples
    --------
    >>> [usable_name(title) for title in ("bead x", "lambda", "2nd mode", "x")]
    ['bead_x', 'lambda_', 'x_2nd_mode', 'x']
    """
    name = re.sub(r"\W+", "_", unicodedata.normalize("NFKC", title)).strip("_")
    if name and not name[0].isalpha() and not name.isidentifier():
        name = f"x_{name}"
    if not name:
        return "x_"
    return f"{name}_" if keyword.iskeyword(name) or name in RESERVED else name


def is_time(title: str) -> bool:
    """Whether a column of this title is the time."""
    return _plain(title) in TIME_NAMES


def is_label(title: str) -> bool:
    """Whether a column of this title says which recording a row belongs to."""
    return _plain(title) in LABEL_NAMES


def is_index(title: str) -> bool:
    """Whether a column of this title may count the rows, as tables that pandas wrote do."""
    return (
        title == ""
        or _plain(re.sub(r"[\d.:\s]+$", "", title)) in INDEX_NAMES
        or title.startswith("__index_level_")
    )


def _plain(title: str) -> str:
    return re.sub(r"[\W_]+", "", title).casefold()
