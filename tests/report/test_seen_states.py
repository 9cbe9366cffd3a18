"""What the record shows by itself is said with its intervals, and beside the wells that it belongs to."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from told_landscapes import NOISE, landscape, record_row, told

from siq.data.two_states import DwellCount, RecordStates
from siq.report.summary import summarise
from siq.workflow.tables import as_table

SEEN = RecordStates(
    "rate", "Hz", "s", True, 1e-6, (0.825, 35.29), (DwellCount(48, 48 * 1.74), DwellCount(0, 1.1)),
    np.array([0.0, 1.0]), np.array([1.0]),
)  # fmt: skip


def test_two_states_of_a_record_are_told_without_any_formula() -> None:
    said = SEEN.sentence()
    assert "has two states of rate, at 0.825\u00a0Hz and 35.3\u00a0Hz: 48 transitions were seen" in said
    assert "last 1.74 (1.3 to 2.4) and more than 0.30 s in the mean" in said
    assert replace(SEEN, supported=False).sentence() == ""


def test_visits_belong_to_the_well_at_their_place() -> None:
    rows = [
        record_row(attractor=place, visits=5, time=5 * mean, counted=mean)
        for place, mean in (("(0.6)", 12.0), ("(−0.5)", 10.0))
    ]
    data = told(landscape([[-0.5], [0.6]], [0.25, 0.35], noise=NOISE))
    wells = summarise(data, record=as_table("record", rows)).wells
    assert [one.visits.whole.mean for one in wells if one.visits] == [10.0, 12.0]
    others = summarise(data, record=as_table("record", rows), run=1).wells
    assert [one.visits for one in others] == [None, None]
