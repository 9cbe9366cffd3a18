"""What the record shows by itself is said with its intervals, and beside the wells that it belongs to."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from told_landscapes import NOISE, landscape, record_row, told

from siq.data.kinetics import MarkovModel, Profile
from siq.data.states import DwellCount, RecordStates
from siq.report.study_page import _states_table
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


def test_the_rungs_stand_side_by_side_in_one_table() -> None:
    profile = Profile(
        np.arange(3.0), np.array([0.0, 2.0, 0.5]), np.ones(3), np.ones(2), np.array([[2.0, 0.2, 1.5, 0.2]])
    )
    markov = MarkovModel(0.1, 0.5, np.array([[1.7, 1.3, 2.3], [0.34, 0.26, 0.46]]), np.eye(2))
    seen = replace(
        SEEN,
        rung=3,
        profile=profile,
        markov=markov,
        exponential=(True, None),
        places=np.array([[0.825], [35.29]]),
    )
    table = _states_table(seen).set_index("")
    assert list(table.columns) == ["state 1", "state 2"]
    first, second = table["state 1"], table["state 2"]
    assert first["mean stay, counted (s)"] == "1.74 (1.3 to 2.4)" and first["visits seen to end"] == "48"
    assert (
        second["mean stay, counted (s)"].startswith("more than") and second["stays are"] == "too few to tell"
    )
    assert first["tops beside it, −log p"] == "2.00 ± 0.20" and second[
        "mean stay, Markov model (s)"
    ].startswith("0.340")


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
