"""One record, from its seed to a file.

    python -m benchmarks.laboratories.one LABORATORY SEED FOLDER [METHOD ...]

Methods are `siq` and those of `others`; what the file has already is not made again.
"""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path
from typing import Any

from benchmarks.laboratories.answers import answered
from benchmarks.laboratories.models import LABORATORIES, Laboratory
from benchmarks.laboratories.others import OTHERS
from benchmarks.laboratories.records import crossings, generator, recorded
from benchmarks.laboratories.truths import truth
from siq.numerics.files import whole_file

MADE_BY, CROSSINGS = "laboratory", "crossings"  # what else stands in a file


def file_of(folder: Path, name: str, seed: int) -> Path:
    """Where the answers about one record are."""
    return folder / name / f"{seed:03d}.json"


def read(file: Path) -> dict[str, Any]:
    """Answers by method; none where there is no file."""
    return json.loads(file.read_text("utf-8")) if file.exists() else {}


def answers_of(file: Path, laboratory: Laboratory) -> dict[str, Any]:
    """The same, and none where another laboratory of this name made the record."""
    found = read(file)
    return found if found.get(MADE_BY) == repr(laboratory) else {}


def methods_of(answers: dict[str, Any]) -> list[str]:
    """Who was asked."""
    return [name for name in answers if name not in (MADE_BY, CROSSINGS)]


def write(file: Path, data: Any) -> None:
    """Whole or not at all; what is no number is null."""
    with whole_file(file) as partial:
        partial.write_text(json.dumps(without_nan(data), indent=1, allow_nan=False) + "\n", encoding="utf-8")


def without_nan(data: Any) -> Any:
    """The same with null for every number that is none."""
    if isinstance(data, dict):
        return {key: without_nan(value) for key, value in data.items()}
    if isinstance(data, list | tuple):
        return [without_nan(value) for value in data]
    return None if isinstance(data, float) and not math.isfinite(data) else data


def main() -> None:
    """Make what is missing."""
    name, seed, folder, *methods = sys.argv[1:]
    laboratory, file = LABORATORIES[name], file_of(Path(folder), name, int(seed))
    answers = answers_of(file, laboratory)
    seen = recorded(laboratory, generator(laboratory, int(seed)))
    known = truth(laboratory)
    for method in methods:
        if method in answers:
            continue
        found = (
            answered(laboratory, seen, known) if method == "siq" else OTHERS[method](laboratory, seen, known)
        )
        answers |= {
            MADE_BY: repr(laboratory),
            CROSSINGS: crossings(laboratory, seen),
            method: found.as_data(),
        }
        write(file, answers)


if __name__ == "__main__":
    main()
