"""How are outputs written down, and when are two of them the same?

A table has items, and tolerances of quantities, ``[relative, absolute]``, by their names up to a blank.
Numbers are the same when they differ by no more than the absolute tolerance plus the relative one times the
largest number of the quantity. All that has no tolerance, or is no number, has to be equal.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

Tolerances = Mapping[str, tuple[float, float]]
Quantities = Mapping[str, Any]
DIGITS = 12  # of a number in a table: more than any tolerance asks for
LEARNED = (
    "learned_"  # begins the name of what networks alone say, which other processors change beyond any bound
)
SHOWN = 60  # characters of a value in a line


class Table(NamedTuple):
    """Items of a group, and by how much their quantities may differ."""

    tolerances: Tolerances
    items: Mapping[str, Quantities]


class Compared(NamedTuple):
    """A quantity of two computations; `off` is relative, infinite where not only numbers differ."""

    name: str
    off: float
    same: bool
    text: str


def tolerated(names: str, relative: float, absolute: float = 0.0) -> dict[str, tuple[float, float]]:
    """The same tolerance for several quantities."""
    return dict.fromkeys(names.split(), (relative, absolute))


def plain(value: Any) -> Any:
    """The same as JSON has it: lists, rounded numbers, None for a number that is not finite."""
    value = value.tolist() if hasattr(value, "tolist") else value
    if isinstance(value, Mapping):
        return {str(key): plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [plain(one) for one in value]
    if isinstance(value, float):
        return float(f"{value:.{DIGITS}g}") if math.isfinite(value) else None
    return value if value is None or isinstance(value, bool | int) else str(value)


def write(path: Path, table: Table) -> None:
    """One line for each quantity, so that a difference is read as one."""
    items = [f"  {_text(name)}: {{\n{_lines(one, '   ')}\n  }}" for name, one in table.items.items()]
    head = f'{{\n "tolerances": {{\n{_lines(table.tolerances, "  ")}\n }},\n "items": {{\n'
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(head + ",\n".join(items) + "\n }\n}\n", encoding="utf-8")


def read(path: Path) -> Table:
    """What `write` wrote; an empty table where there is none."""
    if not path.is_file():
        return Table({}, {})
    data = json.loads(path.read_text(encoding="utf-8"))
    return Table({name: (pair[0], pair[1]) for name, pair in data["tolerances"].items()}, data["items"])


def compared(known: Quantities, found: Quantities, tolerances: Tolerances) -> Iterator[Compared]:
    """Every quantity of an item: whether it is the same, and by how much it is off."""
    for name in dict.fromkeys((*known, *found)):
        old, new = known.get(name, "absent"), found.get(name, "absent")
        relative, absolute = tolerances.get(name.split(" ")[0], (0.0, 0.0))
        text = f"{name}: {_text(old)[:SHOWN]} -> {_text(new)[:SHOWN]}"
        (form, first), (other_form, second) = _parted(old), _parted(new)
        if form != other_form:
            yield Compared(name, math.inf, False, text)
            continue
        largest = max(map(abs, first), default=0.0)
        off = max((abs(one - other) for one, other in zip(first, second, strict=True)), default=0.0)
        share = off / largest if largest else off
        yield Compared(name, share, off <= absolute + relative * largest, f"{text} (by {share:.2g} of it)")


def _parted(value: Any) -> tuple[Any, list[float]]:
    """A value with a mark in the place of every number, and the numbers."""
    if isinstance(value, dict | list):
        keys = list(value) if isinstance(value, dict) else []
        parts = [_parted(one) for one in (value.values() if isinstance(value, dict) else value)]
        return (keys, [form for form, _ in parts]), [one for _, numbers in parts for one in numbers]
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return (float, [float(value)]) if number else (value, [])


def _lines(entries: Mapping[str, Any], indent: str) -> str:
    return ",\n".join(f"{indent}{_text(key)}: {_text(plain(value))}" for key, value in entries.items())


def _text(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False)
