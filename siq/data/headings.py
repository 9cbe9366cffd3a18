"""Which name and which unit are in the heading of a column, and is it the time, or which recording?

``x [mm]``, ``x (mm)``, ``x / mm`` and ``x in mm`` all are x in millimetres; ``t_s`` is the time in seconds.
Names stand in formulas: ``bead x`` becomes ``bead_x`` there, and keeps its heading beside it.
"""

from __future__ import annotations

import keyword
import re
import unicodedata
from typing import NamedTuple


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


RESERVED = _words("sin cos tan exp log sqrt tanh atan Abs sign Max Min pi recording t delay")
"""What no state may be called, since formulas have another meaning for it (`siq.dynamics.cards`)."""

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
