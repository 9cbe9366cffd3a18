"""The laboratories of the ladder: is each what it says, and is an answer judged rightly?"""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from benchmarks.rungs import LABORATORIES, judged, table


@pytest.mark.parametrize("name", sorted(LABORATORIES))
def test_a_laboratory_knows_its_states_and_their_stays(name: str) -> None:
    laboratory = LABORATORIES[name]
    case = laboratory.case(1)
    assert 1 <= laboratory.rung <= 6
    assert (laboratory.rung == 6) == (not laboratory.why)
    assert len(case.stays) == len(case.levels)
    assert (np.diff(case.levels) > 0).all()
    assert (case.stays > 0).all() or len(case.levels) == 1


def test_stays_of_a_chain_are_those_that_its_record_shows() -> None:
    case = LABORATORIES["chain of three"].case(0)
    level = np.abs(case.recordings.values - case.levels).argmin(axis=1)
    step = np.median(np.diff(case.recordings.t[case.recordings.recording == 0]))
    for state, mean in enumerate(case.stays):
        ends = int(((level[:-1] == state) & (level[1:] != state)).sum())
        assert step * (level == state).sum() / ends == pytest.approx(mean, rel=3 / np.sqrt(ends))


def test_an_answer_above_the_rung_and_one_that_failed_are_told_apart() -> None:
    laboratory = LABORATORIES["telegraph"]
    truth = laboratory.case(0).stays

    def climbed(rung: int, factor: float):
        stays = [(one * factor, one * factor * 0.9, one * factor * 1.1) for one in truth]
        return lambda recordings: SimpleNamespace(rung=rung, stays=stays)

    def failed(recordings):
        raise ValueError("no")

    right = judged(laboratory, 0, climbed(3, 1.0))
    assert (right["rung"], right["covered"], right["stays"]) == (3, 2, 2)
    above = judged(laboratory, 0, climbed(6, 1.5))
    assert (above["rung"], above["covered"]) == (6, 0)
    none = judged(laboratory, 0, failed)
    assert none["fault"] == "ValueError: no"
    text = table(pd.DataFrame([right, above, none]))
    assert "right rung: 1 of 3; above it: 1; stays within their intervals: 2 of 4" in text
