"""Headings of recordings: names and units of columns, and which of them is the time, a label or a state.

``x [mm]``, ``x (mm)``, ``x / mm`` and ``x in mm`` all are x in millimetres; ``t_s`` is the time in seconds.
Names stand in formulas: ``bead x`` becomes ``bead_x`` there, and keeps its heading beside it.

``recording`` and ``t`` are the plain names of the label and the time. Where they are missing, a column of
another name for the same thing takes their place, and a remark says so; a table that names no recordings is
one.
"""

from __future__ import annotations

import keyword
import re
import unicodedata
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pandas as pd
import pyarrow as pa
import yaml

from siq.data.correlation import MIN_REPETITIONS
from siq.errors import InputError, suggestion
from siq.remarks import Remark

if TYPE_CHECKING:
    from siq.data.formats import Column, ColumnFile


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


RESERVED = _words("sin cos tan exp log sqrt tanh atan Abs sign Max Min pi recording t delay")
"""What no state may be called, since formulas have another meaning for it (`siq.systems.cards`)."""

_CALLED = yaml.safe_load(Path(__file__).with_name("headings.yaml").read_text(encoding="utf-8"))
TIME_NAMES, AGE_NAMES, LABEL_NAMES, INDEX_NAMES, TIME_UNITS, ERROR_NAMES, ERROR_WORDS = (
    _words(_CALLED[each])
    for each in ("time", "age", "label", "index", "units_of_time", "error", "error_beside")
)
ERROR_WORDS |= ERROR_NAMES
MONTHS = re.compile(",".join(_CALLED["months"].split()))
_CALENDAR = {part: _words(words) for part, words in _CALLED["calendar"].items()}
_RANGES = {"month": (1, 12), "day": (1, 31), "day of the year": (1, 366), "hour": (0, 23)}
_DAY_ALONE = re.compile(r"\d+(-\d+-|\.\d+\.|/\d+/)\d+|(1[89]|20)\d\d(0[1-9]|1[0-2])([0-2]\d|3[01])")
TIME_OF_DAY = re.compile(r"\d{1,3}:\d{2}(:\d{2})?([.,]\d+)?")

_UNITS_AS_TITLES = TIME_UNITS - _words(
    "ns us µs μs ms s min h hr d yr ka"
)  # these are called so for other reasons
EVEN = 0.01  # share of the steps of a nameless clock that may be others: gaps, and where recordings begin

# Symbols of units, longest first; those after a prefix may also stand alone.
_PREFIX = "(?:da|[YZEPTGMkhdcmuµμnpfazy])?"
_PREFIXED = "mol|Ohm|ohm|rad|bar|cal|cd|Hz|Pa|Wb|lm|lx|sr|Da|eV|px|Ω|m|s|g|A|K|N|J|W|V|C|F|H|T|S|L|l|M|B"
_ALONE = (
    r"counts?|cts|pixels?|px|adu|ADU|a\.?u\.?|arb\.? ?u(?:nits?)?\.?|n\.?u\.?|atm|Torr|mmHg|rpm|ppm|ppb|dB"
    r"|deg|degrees?|radians?|°[CF]?|%|‰|per ?mil|1|-|min|minutes?|hours?|hrs?|h|days?|d|weeks?|months?|years?"
    r"|[kM]?yr|ka|sec(?:ond)?s?|[Vv]olts?|[Aa]mp(?:ere)?s?|meters?|metres?|k_?B ?T|kT|Å|u|LSB|lsb|bits?"
)
_POWER = r"(?:(?:\^|\*\*)?\{?[-−+]?\d+(?:[./]\d+)?\}?|[⁺⁻]?[⁰¹²³⁴⁵⁶⁷⁸⁹]+)?"
_FACTOR = rf"(?:(?:{_ALONE}|{_PREFIX}(?:{_PREFIXED})){_POWER})"
_UNIT = re.compile(rf"\(?{_FACTOR}(?:\s*(?:[·*⋅×/]|\s)\s*\(?{_FACTOR}\)?)*\)?")
_RATE_UNIT = "[kM]?Hz|[mµμu]?s"
SAMPLING = re.compile(  # such as "Sampling Rate (Hz):= 1000.00", or "dt = 20 ms"
    r"(?i:(sampl\w*|frame|acquisition)[ _-]*(rate|freq\w*|interval|period)|fs|sfreq|dt)\b[ \[(]*"
    rf"(?P<before>{_RATE_UNIT})?\b[^\w.]*(?P<number>(?=[\d.]*[1-9])\d+\.?\d*([eE]-?\d+)?)[^\w.]*(?P<after>{_RATE_UNIT})?\W*"
)
_RECIPROCALS = {"Hz": "s", "kHz": "ms", "MHz": "us"}

_TIME_ARGUMENT = re.compile(r"\s*\(\s*t\s*\)$")  # x(t) is x
_BEFORE_PRESENT = re.compile(
    r"[\s_]*(?<![^\W_])(?:cal[\s_]+)?(?:b2k|BP|before present)(?![^\W_])", re.IGNORECASE
)


class _Heading(NamedTuple):
    """A heading, taken apart: what people call the column, and its unit where it says one."""

    title: str
    unit: str | None
    before_present: bool = False

    @property
    def is_age(self) -> bool:
        """Whether a time of this heading runs backwards, such as the ages of a core."""
        return self.before_present or _plain(self.title) in AGE_NAMES

    @property
    def may_be_time(self) -> bool:
        """Whether such a column may be the time."""
        return _is_time(self.title) and (
            self.unit is None or self.unit.casefold() in {unit.casefold() for unit in TIME_UNITS}
        )

    @property
    def is_label(self) -> bool:
        """Whether such a column says which recording a row belongs to."""
        return _plain(self.title) in LABEL_NAMES


def is_unit(text: str) -> bool:
    """Whether text reads as a unit: ``mm``, ``µm/s``, ``kg m^-3``, ``arb. units``.

    Examples
    --------
    >>> [is_unit(text) for text in ("mm", "µm²/s", "raw", "left", "a.u.")]
    [True, True, False, False, True]
    """
    return _UNIT.fullmatch(text.strip()) is not None


def read_heading(heading: str) -> _Heading:
    """Take a heading apart.

    Examples
    --------
    >>> [tuple(read_heading(text)[:2]) for text in ("bead x (µm)", "x(t)", "U/mV", "time_ms", "year")]
    [('bead x', 'µm'), ('x', None), ('U', 'mV'), ('time', 'ms'), ('year', 'year')]
    >>> read_heading("age (yr b2k)")
    _Heading(title='age', unit='yr', before_present=True)
    """
    text = _BEFORE_PRESENT.sub("", heading).strip()
    if text != heading.strip():
        age = _Heading("age", text) if text in TIME_UNITS else read_heading(text)
        if age.may_be_time:
            return age._replace(before_present=True)
    text = heading.strip()
    if match := re.fullmatch(r"(.*?)\s*\[\s*(.*?)\s*\]", text):
        return _Heading(_TIME_ARGUMENT.sub("", match[1]), match[2] or None)
    if (
        (match := re.fullmatch(r"([^/]*[^/\s])\s*/\s*(\S.*)", text))
        and is_unit(match[2])
        and not is_unit(text)
    ):
        return _Heading(match[1], match[2].removeprefix("(").removesuffix(")"))
    if match := re.fullmatch(r"(.*?\S)\s*\(\s*(.*?)\s*\)", text):
        if is_unit(match[2]):
            return _Heading(_TIME_ARGUMENT.sub("", match[1]), match[2])
        return _Heading(_TIME_ARGUMENT.sub("", text), None)
    for pattern in (r"(.*?\S)\s+in\s+(\S.*)", r"(.*?\S)\s*,\s*(\S.*)"):
        if (match := re.fullmatch(pattern, text)) and is_unit(match[2]):
            return _Heading(match[1], match[2])
    if (
        (match := re.fullmatch(r"(.+?)[\s_./]+([^\s_./]+)", text))
        and match[2] in TIME_UNITS
        and _is_time(match[1])
    ):
        return _Heading(match[1], match[2])
    return _Heading(text, text if text.casefold() in _UNITS_AS_TITLES else None)


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


def _is_time(title: str) -> bool:
    """Whether a column of this title is the time."""
    return _plain(title) in TIME_NAMES | AGE_NAMES or title.casefold() in _UNITS_AS_TITLES


def _is_error(title: str, titles: Sequence[str]) -> bool:
    """Whether a column is the error of another one by its title: ``x_err``, ``2σ of x``, ``Uncertainty``."""
    spaced = re.sub(r"(?<=[a-z\d])(?=[A-Z])|\b[123] ?(?=s|σ)|\b(of|mean)\b|[(\[].*", " ", title)
    words = re.findall(r"±|[^\W_]+", spaced.replace("+/-", "±").casefold())
    others = {_plain(other) for other in titles if other != title}
    cuts = [{"".join(words[:cut]), "".join(words[cut:])} for cut in range(1, len(words))]
    return "".join(words) in ERROR_NAMES or any(cut & ERROR_WORDS and cut & others for cut in cuts)


def _plain(title: str) -> str:
    return re.sub(r"[\W_]+", "", title).casefold()


class _Layout(NamedTuple):
    """The columns of a table by what they mean, as positions."""

    source: ColumnFile  # which they are positions in
    recording: int | None  # None where all rows are one recording
    time: int
    backwards: bool  # an age, which falls as time goes on
    states: tuple[int, ...]
    names: tuple[str, ...]  # of the states, in formulas, ...
    titles: tuple[str, ...]  # ... and to people
    units: tuple[dict[str, str | None], ...]  # of all columns: what each place says
    remarks: tuple[Remark, ...]


def layout_of(file: str, source: ColumnFile, columns: Sequence[str] | None) -> _Layout:
    """Find the time, the labels and the measured columns: those wanted, in their order, or all.

    Raises
    ------
    InputError
        When a column is missing, stands twice or has no name, or nothing is measured.
    ValueError
        When `columns` repeats a name, or holds ``recording`` or ``t``.
    """
    if columns is not None and (len(set(columns)) < len(columns) or {"recording", "t"} & set(columns)):
        raise ValueError(f"the columns {list(columns)} are not distinct measured columns")
    source = _with_stated_times(_with_one_clock(source))
    parts = [read_heading(heading) for heading in source.headings]
    plain = [part.title for part in parts]
    titles = [title or name for title, name in zip(source.titles or (None,) * len(parts), plain, strict=True)]
    for name in plain:
        if name and plain.count(name) > 1:
            remedy = "rename or remove one of them"
            raise InputError(file, f"column {name}", "the column stands twice", remedy)
    remarks = list(source.remarks)
    free = [place for place in range(len(parts)) if columns is None or plain[place] not in columns]
    dropped = set()
    for place in free:  # columns that only count the rows, as pandas writes them, and empty ones at the end
        title = plain[place]
        index = _plain(re.sub(r"[\d.:\s]+$", "", title)) in INDEX_NAMES or title.startswith("__index_level_")
        values = _numbers(source, place) if index or title == "" else None
        if values is None:
            continue
        if np.isnan(values).all():
            dropped.add(place)
        # 0, 1, 2, … from any start, or those of a table whose rows were taken or mixed.
        elif (np.isfinite(values) & (values == np.round(values))).all() and (
            len(np.unique(values)) == len(values) or (np.diff(values) == 1).mean() > 0.5
        ):
            dropped.add(place)
            named = source.headings[place] if plain[place] else None
            remarks.append(Remark("data.column_counts_rows", {"column": named, "place": place + 1}))
    free = [place for place in free if place not in dropped]
    time = _time_column(file, source, parts, free, remarks)
    free.remove(time)
    recording = _label_column(source, parts, time, free, remarks)
    if columns is None:
        # Other clocks are called so, and ever increase but where recordings begin; "T" is a temperature.
        others = [
            place
            for place in free
            if place != recording and parts[place].may_be_time and parts[place].title != "T"
            if (values := _numbers(source, place)) is None or (np.diff(values) > 0).mean() > 0.5
        ]
        remarks += [Remark("data.second_time", {"column": source.headings[place]}) for place in others]
        states = [place for place in free if place not in (recording, *others)]
        errors = [place for place in states if _is_error(plain[place], plain)]
        if len(errors) < len(states):
            states = [place for place in states if place not in errors]
            remarks += [Remark("data.error_left_out", {"column": plain[place]}) for place in errors]
        names: list[str] = []
        for place in states:
            if not plain[place]:
                remedy = "name it, or remove the column"
                raise InputError(file, f"column {place + 1}", "the column has no name", remedy)
            name, count = usable_name(plain[place]), 1
            while (candidate := name if count == 1 else f"{name}_{count}") in names:
                count += 1
            names.append(candidate)
            if candidate != plain[place]:
                remarks.append(Remark("data.name_in_formulas", {"title": titles[place], "name": candidate}))
    else:
        known = [place for place in range(len(parts)) if place not in (time, recording, *dropped)]
        states = [_wanted(file, name, plain, known, remarks) for name in columns]
        names = list(columns)
    if not states:
        raise InputError(file, "", "there is no measured column", "add one beside 'recording' and 't'")
    pairs = zip(parts, source.units, strict=True)
    units = tuple({"name": part.unit, "metadata": unit} for part, unit in pairs)
    shown = tuple(titles[place] for place in states)
    return _Layout(
        source, recording, time, parts[time].is_age, tuple(states), tuple(names), shown, units, tuple(remarks)
    )


def _numbers(source: ColumnFile, place: int) -> np.ndarray | None:
    try:
        cells = source.load([place])[0]
        if pa.types.is_dictionary(cells.type):
            cells = cells.cast(cells.type.value_type)
        return np.asarray(cells.cast(pa.float64()).to_numpy(zero_copy_only=False))
    except (pa.ArrowInvalid, pa.ArrowNotImplementedError, InputError):
        return None


def _runs_evenly(values: np.ndarray | None) -> bool:
    """Whether numbers rise by one step nearly always, as nothing that is measured does."""
    if values is None or len(values) < 3:
        return False
    steps = np.diff(values)
    usual = np.median(steps)
    return bool(usual > 0 and (np.abs(steps - usual) > EVEN * usual).mean() <= EVEN)


def _calendar_parts(source: ColumnFile) -> dict[str, tuple[int, pd.Series]]:
    """Columns of whole numbers that are years, months, days, hours and so on: their places and values."""
    parts: dict[str, tuple[int, pd.Series]] = {}
    for place, heading in enumerate(source.headings):
        title = _plain(read_heading(heading).title)
        part = next((one for one, words in _CALENDAR.items() if title in words and one not in parts), None)
        if part is None or (numbers := _numbers(source, place)) is None or len(numbers) < 2:
            continue
        if not np.isfinite(numbers).all() or (numbers != np.round(numbers)).any():
            continue
        values = pd.Series(numbers.astype(int))
        low, high = _RANGES.get(part, (0, 59))
        if part == "year":  # one that each row has for itself is a time alone
            low, high = 1000, 9999 if (np.diff(values) == 0).mean() >= 0.5 else 0
        elif part == "hour" and values.min() >= 1 and values.max() == 24:  # the last of a day
            values -= 1
        elif part == "hour" and values.max() > 24 and (values % 100).max() < 60:  # 1330 is half past one
            parts["minute"], values = (place, values % 100), values // 100
        if values.between(low, high).all():
            parts[part] = place, values
    return parts


def _with_one_clock(source: ColumnFile) -> ColumnFile:
    """Days in one column and times of day in another, or parts such as year and hour, as one column."""
    parts, headings = _calendar_parts(source), [read_heading(one) for one in source.headings]
    rest = [place for place in range(len(headings)) if place not in {place for place, _ in parts.values()}]
    texts = {
        place: source.load([place])[0].to_pandas().astype(str).str.strip().str.removesuffix(".0")
        for place in rest
        if headings[place].may_be_time
    }
    days = [place for place, text in texts.items() if text.str.fullmatch(_DAY_ALONE).all()]
    clocks = [place for place, text in texts.items() if text.str.fullmatch(TIME_OF_DAY).all()]
    others = [place for place in rest if "year" in parts and place not in (*days, *clocks)]
    month, day = parts.get("month"), parts.get("day" if "month" in parts else "day of the year")
    monthly, used = False, [*days, *clocks]
    if any(_tells_time(headings[place].title, source, place) for place in others):
        return _with_column(source, None, [place for place, _ in parts.values()])
    if len(days) == 1 and (clocks or parts):
        times = texts[days[0]].str.replace(r"^(\d{4})(\d\d)(\d\d)$", r"\1-\2-\3", regex=True)
    elif "year" in parts and day is not None:
        first = 100 * parts["year"][1] + (1 if month is None else month[1])
        times = pd.to_datetime(first.astype(str), format="%Y%m") + pd.to_timedelta(day[1] - 1, unit="D")
        times = times.dt.strftime("%Y-%m-%d")
    elif monthly := "year" in parts and month is not None:
        times = parts["year"][1] + (month[1] - 0.5) / 12
    else:
        return source
    used += [parts[one][0] for one in ("year", "month", "day", "day of the year") if one in parts]
    if clocks:
        times = times + " " + texts[clocks[0]]
    elif "hour" in parts and not monthly:
        seconds, used = 3600 * parts["hour"][1], [*used, parts["hour"][0]]
        for part, size in (("minute", 60), ("second", 1)):
            place, numbers = parts.get(part, (None, seconds))
            # What is called min may be a minimum: of times that differ without it none is a part.
            alike = pd.DataFrame({"day": times, "seconds": seconds}).duplicated().any()
            if place is None or not (alike or place in used):
                break
            seconds, used = seconds + size * numbers, [*used, place]
        times = times + pd.to_datetime(seconds, unit="s").dt.strftime(" %H:%M:%S")
    return _with_column(source, ("t [year]" if monthly else "t", pa.array(times)), used)


def _with_column(source: ColumnFile, column: tuple[str, pa.Array] | None, parts: Sequence[int]) -> ColumnFile:
    """A table with one more column at its end, a heading and its cells, in place of the columns `parts`."""
    kept, titles = [place for place in range(len(source.headings)) if place not in parts], source.titles

    def load(positions: Sequence[int]) -> list[Column]:
        loaded = iter(source.load([kept[each] for each in positions if each < len(kept)]))
        return [next(loaded) if each < len(kept) or column is None else column[1] for each in positions]

    values = {"columns": [source.headings[place].strip() for place in dict.fromkeys(parts)]}
    added = [] if column is None else [column[0]]
    remark = Remark("data.time_in_parts", values | {"left_out": column is None})
    return replace(
        source, headings=(*(source.headings[place] for place in kept), *added), load=load,
        units=(*(source.units[place] for place in kept), *(None for _ in added)),
        titles=(*(titles[place] for place in kept), *added) if titles else (),
        remarks=(*source.remarks, *([remark] if parts else [])),
    )  # fmt: skip


def _with_stated_times(source: ColumnFile) -> ColumnFile:
    """A table of which no column tells the time, with the times that a stated rate or interval gives."""
    stated, places = SAMPLING.fullmatch(source.sampling), range(len(source.headings))
    unit = (stated["before"] or stated["after"]) if stated else None
    if stated is None or unit is None or any(read_heading(one).may_be_time for one in source.headings):
        return source
    if any(
        _runs_evenly(_numbers(source, at)) or _tells_time(source.headings[at], source, at) for at in places
    ):
        return source
    step = 1 / float(stated["number"]) if unit in _RECIPROCALS else float(stated["number"])
    times = pa.array(step * np.arange(len(source.load([0])[0])))
    source = replace(
        source, remarks=(*source.remarks, Remark("data.time_by_rate", {"line": source.sampling}))
    )
    return _with_column(source, (f"t [{_RECIPROCALS.get(unit, unit)}]", times), [])


def _tells_time(title: str, source: ColumnFile, place: int) -> bool:
    """Whether cells are dates, or numbers that rise under a heading with a word of time: ``decimal_year``."""
    try:
        cells = source.load([place])[0]
    except InputError:
        return False
    if (values := _numbers(source, place)) is None or pa.types.is_temporal(cells.type):
        first = next((str(one) for one in cells.to_pylist() if one), "")
        return re.match(r"\d{4}-\d\d-\d\d|\d\d?\.\d\d?\.\d{4}", first) is not None
    steps = np.diff(values[np.isfinite(values)])
    rises = len(steps) > 0 and bool((steps <= 0).mean() <= EVEN)
    return rises and any(_is_time(word) for word in re.split(r"[\W_]+", title) if word[1:] or title == "t")


def _time_column(
    file: str, source: ColumnFile, parts: list[_Heading], free: list[int], remarks: list[Remark]
) -> int:
    """The column ``t``; else the only one called like a time that goes on, rises evenly, or holds times."""
    found = [place for place in free if parts[place].title == "t"]
    if found:
        return found[0]
    found = [place for place in free if parts[place].may_be_time]
    if not found:
        found = [place for place in free if _runs_evenly(_numbers(source, place))]
    if len(found) != 1 or ((x := _numbers(source, found[0])) is not None and (np.diff(x) == 0).mean() > 0.5):
        found = [place for place in free if _tells_time(parts[place].title, source, place)] or found
    if len(found) > 1:
        # "T" is a temperature rather than a time, and an age that of what is measured.
        found = [place for place in found if parts[place].title != "T"]
        found = [place for place in found if not parts[place].is_age] or found
    if len(found) > 1:
        found = [place for place in found if _runs_evenly(_numbers(source, place))] or found
    if len(found) == 1:
        backwards = parts[found[0]].is_age
        remarks.append(Remark("data.time_column", {"column": parts[found[0]].title, "backwards": backwards}))
        return found[0]
    if found:
        names = " and ".join(f"'{source.headings[place].strip()}'" for place in found)
        raise InputError(file, "", f"the columns {names} all look like the time", "call the right one 't'")
    remedy = "add the time of every sample as a column 't'"
    if source.sampling:
        remedy = f"write the unit into the line '{source.sampling}', such as Sampling Rate (Hz), or {remedy}"
    raise InputError(file, "", "the column 't' is missing", remedy)


def _label_column(
    source: ColumnFile, parts: list[_Heading], time: int, free: list[int], remarks: list[Remark]
) -> int | None:
    """The column of labels, None where there is none; what is neither label nor measured goes out of `free`.

    It is called so; or it is of words, or of whole numbers, and tells apart the rows of one time, or is the
    same in rows that follow each other. Words that do neither, such as flags, are no state either.
    """
    plain = [part.title for part in parts]
    if "recording" in plain:
        return plain.index("recording")
    for place in free:
        if not parts[place].is_label:
            continue
        values = _numbers(source, place)
        if values is not None and (np.any(values != np.round(values)) or np.isnan(values).all()):
            continue  # measured, and no label
        if values is not None and len(values) > 1 and len(np.unique(values)) == len(values):
            free.remove(place)
            remarks.append(Remark("data.column_counts_rows", {"column": plain[place], "place": place + 1}))
            continue
        remarks.append(Remark("data.label_column", {"column": plain[place]}))
        return place
    times, *columns = (one.to_pandas() for one in source.load([time, *free]))
    repeated, chosen = bool(times.duplicated().any()), None
    for place, cells in zip(list(free), columns, strict=True):
        words = not pd.api.types.is_numeric_dtype(cells.dtype)
        if words and not cells.dropna().astype(str).str.match(r"\s*[^\W\d_]").all():
            continue  # numbers in some other way of writing, or dates
        if not words and not (repeated and (cells == cells.round()).all()):
            continue
        counts, blocks = cells.value_counts(), int((cells != cells.shift()).sum())
        few = chosen is None and 1 < len(counts) <= len(cells) / MIN_REPETITIONS and cells.notna().all()
        apart = repeated and not pd.DataFrame({"time": times, "label": cells}).duplicated().any()
        if few and (blocks == len(counts) or (apart and (words or counts.min() == counts.max()))):
            chosen = place
            remarks.append(Remark("data.label_column", {"column": plain[place]}))
        elif words and cells.notna().any():
            free.remove(place)
            remarks.append(Remark("data.words_left_out", {"column": plain[place]}))
    return chosen


def _wanted(file: str, name: str, plain: list[str], known: list[int], remarks: list[Remark]) -> int:
    """The column that is meant by a name: called so, or nearly so, if there is but one."""
    for called in (str, usable_name, lambda title: usable_name(title).casefold()):
        sought = name.casefold() if called not in (str, usable_name) else name
        matches = [place for place in known if called(plain[place]) == sought]
        if len(matches) == 1:
            if plain[matches[0]] != name:
                remarks.append(Remark("data.name_in_formulas", {"title": plain[matches[0]], "name": name}))
            return matches[0]
    titles = [plain[place] for place in known if plain[place]]
    remedy = suggestion(name, titles, otherwise=f"the measured columns are {', '.join(titles)}")
    raise InputError(file, "", f"the column '{name}' is missing", remedy if titles else "add it")
