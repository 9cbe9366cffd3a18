"""What is slower than it was is said; what is measured on another machine is made comparable."""

from __future__ import annotations

import pytest

from benchmarks.speed import slower


def row(seconds: float, *, reference: float = 1.0, task: str = "plan") -> dict[str, str]:
    return {"task": task, "seconds": str(seconds), "reference": str(reference)}


def test_a_fifth_more_than_the_median_of_the_last_ones_is_slower() -> None:
    rows = [row(2.0)] * 9 + [row(10.0), row(10.1), row(50.0), row(9.9), row(10.0), row(100.0, task="import")]
    assert slower(rows, row(11.9)) is None
    assert slower(rows, row(12.1)) == pytest.approx(1.21)
    assert slower(rows, row(24.2, reference=2.0)) == pytest.approx(1.21)  # a machine half as fast
    assert slower(rows, row(12.1, reference=2.0)) is None


def test_what_is_measured_for_the_first_time_is_not_slower() -> None:
    assert slower([row(1.0)], row(5.0, task="equations")) is None
