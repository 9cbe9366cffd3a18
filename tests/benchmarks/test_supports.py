"""The true terms, and no others, where every one of them is strong."""

from __future__ import annotations

from typing import Any

import pytest

from benchmarks.laboratories.supports import STRONG, SYSTEMS, WANTED, identified, row, true_terms
from siq.inference.library import IdentificationOptions, field_library


def test_terms_of_a_record_are_compared_with_the_true_ones() -> None:
    said = identified(SYSTEMS["double-well"], 0)
    assert said["missing"] == said["false"] == []
    assert said["weakest"] > STRONG


def test_true_terms_are_found_in_the_library() -> None:
    laboratory = SYSTEMS["hop-often"]
    library = field_library(list(laboratory.states), IdentificationOptions())
    named = {(i, library.names[k]): value for (i, k), value in true_terms(laboratory, library).items()}
    assert named == {
        (0, "x"): 1.0, (0, "x**3"): -1.0, (0, "x*y**2"): -1.0, (1, "y"): -1.0, (1, "x**2*y"): -1.0,
    }  # fmt: skip


def test_only_records_whose_terms_are_all_strong_count() -> None:
    def said(weakest: float, missing: list[str], false: list[str]) -> dict[str, Any]:
        return {"weakest": weakest, "missing": missing, "false": false, "seconds": 1.0}

    line = row("name", [said(9, [], []), said(8, [], ["1 in x"]), said(4, ["x in x"], [])])
    assert line == "| name | 3 | 2 | 1 ! | 1 | 8.0 | 1.0 |"


@pytest.mark.slow
@pytest.mark.parametrize("name", ["double-well", "double-well-sensor", "resonator-clean"])
def test_the_true_terms_are_found_where_all_are_strong(name: str) -> None:
    """The bar is 93 of 100."""
    said = [identified(SYSTEMS[name], seed) for seed in range(100)]
    strong = [one for one in said if one["weakest"] > STRONG]
    right = [one for one in strong if not one["missing"] and not one["false"]]
    print(row(name, said))
    assert len(right) >= WANTED * len(strong)
