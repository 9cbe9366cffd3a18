"""Errors, coverage and false certificates as a table.

A certificate is false where it stands on a wrong branch, where a well is missing or invented, or where a
barrier's error is above three times the stated one. Of normal errors of the right size a share of 0.0027 is
above three: what that alone would bring stands beside the count.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.laboratories.bounds import bound
from benchmarks.laboratories.models import LABORATORIES, Laboratory
from benchmarks.laboratories.one import CROSSINGS, MADE_BY, answers_of, methods_of, read, write
from benchmarks.laboratories.truths import truth

INTERVAL = 1.96  # standard errors on either side of a 95 % interval
ABOVE = 3.0  # standard errors, beyond which a stated error is false
BY_CHANCE = 0.0027  # of normal errors are


@dataclass(frozen=True)
class Row:
    """What one method said of one laboratory.

    Attributes
    ----------
    laboratory, method
        Of which and by which.
    records
        How many.
    crossings
        Mean number of a record.
    answered, certified
        Shares of the records.
    ratio
        Rms error of the barriers that were found, over the bound.
    bias
        Mean error of the barriers over the bound.
    interval
        Median standard error over the bound.
    covered
        Share of barriers within their 95 % intervals.
    ratio_certified, covered_certified
        The same of the certified records alone.
    false
        False certificates, and `expected` those that chance brings to errors of the right size.
    seconds
        Median time of a record.
    errors
        Of every barrier, over its bound.
    """

    laboratory: str
    method: str
    records: int
    crossings: float
    answered: float
    certified: float
    ratio: float
    bias: float
    interval: float
    covered: float
    ratio_certified: float
    covered_certified: float
    false: int
    expected: float
    seconds: float
    errors: np.ndarray


def known_of(laboratory: Laboratory, folder: Path) -> dict[str, Any]:
    """True barriers and their bounds, kept in a file since the bounds take a minute."""
    file = folder / laboratory.name / "truth.json"
    key = repr(laboratory)
    found = read(file)
    if found.get(MADE_BY) != key:
        known = truth(laboratory)
        best = bound(laboratory, known)
        found = {MADE_BY: key, "barriers": known.barriers.tolist(), "bounds": best.barriers.tolist()}
        write(file, found)
    return found


def summarised(folder: Path, names: list[str]) -> list[Row]:
    """A row for every laboratory and method of which there are answers."""
    rows = []
    for name in names:
        files = sorted((folder / name).glob("[0-9]*.json"))
        if not files:
            continue
        answers = [answers_of(file, LABORATORIES[name]) for file in files]
        known = known_of(LABORATORIES[name], folder)
        methods = dict.fromkeys(method for each in answers for method in methods_of(each))
        rows += [row(name, method, answers, known) for method in methods]
    return rows


def row(name: str, method: str, answers: list[dict[str, Any]], known: dict[str, Any]) -> Row:
    """What one method said of one laboratory, counted."""
    said = [each[method] for each in answers if method in each]
    count = len(known["barriers"])
    barriers = np.array([_numbers(each.get("barriers"), count) for each in said])
    spread = np.array([_numbers(each.get("standard_errors"), count) for each in said])
    certified = np.array([bool(each["certified"]) for each in said])
    errors = (barriers - known["barriers"]) / known["bounds"]
    stated = spread / known["bounds"]
    times = [each["seconds"] for each in said if each.get("seconds")]
    return Row(
        name, method, len(said),
        float(np.mean([each.get(CROSSINGS, np.nan) for each in answers if method in each])),
        float(np.isfinite(barriers).all(axis=1).mean()), float(certified.mean()),
        _rms(errors), _mean(errors), float(np.nanmedian(stated)) if np.isfinite(stated).any() else np.nan,
        _covered(errors, stated), _rms(errors[certified]), _covered(errors[certified], stated[certified]),
        int(sum(map(false, said, errors, stated))), BY_CHANCE * count * int(certified.sum()),
        float(np.median(times)) if times else np.nan, errors,
    )  # fmt: skip


def false(said: dict[str, Any], errors: np.ndarray, stated: np.ndarray) -> bool:
    """Whether a certificate was given that should not have been."""
    if not said["certified"]:
        return False
    wells = said["extra_wells"] > 0 or not np.isfinite(errors).all()
    return bool(wells or said["wrong_branch"] or (np.abs(errors) > ABOVE * stated).any())


def _numbers(given: list[float | None] | None, count: int) -> np.ndarray:
    return np.array(given or [None] * count, dtype=float)


def _rms(errors: np.ndarray) -> float:
    known = errors[np.isfinite(errors)]
    return float(np.sqrt((known**2).mean())) if known.size else np.nan


def _mean(errors: np.ndarray) -> float:
    known = errors[np.isfinite(errors)]
    return float(known.mean()) if known.size else np.nan


def _covered(errors: np.ndarray, stated: np.ndarray) -> float:
    known = np.isfinite(errors) & np.isfinite(stated)
    return float((np.abs(errors) <= INTERVAL * stated)[known].mean()) if known.any() else np.nan


HEAD = (
    "| laboratory | method | records | crossings | barriers found | rms error / bound | mean error / bound"
    " | stated / bound | covered | certified | rms / bound, certified | covered, certified"
    " | false (by chance) | s |"
)


def text(rows: list[Row]) -> str:
    """As a table in Markdown."""
    lines = [HEAD, "|" + "---|" * (HEAD.count("|") - 1)]
    for one in rows:
        cells = [
            one.laboratory, one.method, str(one.records), f"{one.crossings:.1f}", _share(one.answered),
            _number(one.ratio), _number(one.bias), _number(one.interval), _share(one.covered),
        ]  # fmt: skip
        if one.method == "siq":
            cells += [
                _share(one.certified), _number(one.ratio_certified), _share(one.covered_certified),
                f"{one.false} ({one.expected:.1f})",
            ]  # fmt: skip
        else:
            cells += ["", "", "", ""]
        lines.append("| " + " | ".join([*cells, f"{one.seconds:.0f}"]) + " |")
    return "\n".join(lines)


def _share(value: float) -> str:
    return "" if np.isnan(value) else f"{value:.0%}"


def _number(value: float) -> str:
    return "" if np.isnan(value) else f"{value:.2f}"
