"""Records of the simulated laboratories: what `siq` says of each, seed by seed."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from benchmarks.golden.table import tolerated
from benchmarks.laboratories.answers import answered
from benchmarks.laboratories.models import LABORATORIES
from benchmarks.laboratories.records import crossings, generator, recorded
from benchmarks.laboratories.truths import truth

SEEDS, SHORTER = 2, 4  # of each laboratory, and by how much its records are shorter: a matter of time alone
UNTOLD = ("seconds", "said")  # what differs from machine to machine, and words
TOLERANCES = {
    "laboratories": {
        **tolerated("true_barriers", 1e-5),
        **tolerated("barriers path_barriers", 1e-4),
        **tolerated("standard_errors stated_error", 0.05),
    }
}


def laboratories(results: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    """Every laboratory with its first seeds."""
    for name, whole in LABORATORIES.items():
        laboratory, known = whole.shorter(whole.samples // SHORTER, whole.records), truth(whole)
        for seed in range(SEEDS):
            seen = recorded(laboratory, generator(laboratory, seed))
            answer = answered(laboratory, seen, known).as_data()
            told = {key: value for key, value in answer.items() if key not in UNTOLD}
            told |= {"true_barriers": known.barriers, "crossings": crossings(laboratory, seen)}
            yield f"{name} {seed}", told
