"""What became of steps, as files have it."""

from __future__ import annotations

import json
import logging
from pathlib import Path

import pytest

from siq.workflow.tables import Method, Outcome, Status, Step
from workflow.files import read_outcomes, write_outcomes


def test_outcomes_are_read_back_with_their_details(tmp_path: Path) -> None:
    said = [
        Outcome(0, Step.TRAIN, Status.WARNING, "not yet", {"position": 0}),
        Outcome(1, Step.TRAIN, Status.SKIPPED, "the run has no trajectories"),
    ]
    write_outcomes(tmp_path / "train.json", said)
    assert read_outcomes(tmp_path / "train.json") == said


def test_the_file_is_that_of_the_contract(tmp_path: Path) -> None:
    write_outcomes(tmp_path / "regress.json", [Outcome(3, Step.REGRESS, details={"points": 12})])
    written = json.loads((tmp_path / "regress.json").read_text())
    assert written == [{"run": 3, "step": "regress", "status": "ok", "reason": "", "points": 12}]


def test_a_result_with_a_reservation_is_one() -> None:
    usable = {status for status in Status if Outcome(0, Step.SCORE, status).usable}
    assert usable == {Status.OK, Status.WARNING}


def test_whatever_is_not_ok_is_logged(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        write_outcomes(tmp_path / "a.json", [Outcome(0, Step.REFINE)])
        assert not caplog.records
        write_outcomes(tmp_path / "a.json", [Outcome(4, Step.REFINE, Status.FAILED, "no attractor")])
    assert caplog.messages == ["run 4, refine: failed, no attractor"]


def test_methods_are_the_words_of_the_tables() -> None:
    assert [str(one) for one in Method] == ["regression", "refined", "randomised network"]
    assert {"refined": 1}[Method.REFINED] == 1
