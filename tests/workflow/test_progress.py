"""One line of progress, from the events of a workflow."""

from __future__ import annotations

import io
import json
from typing import Any

from siq.workflow.launch import MARK, _faults, _follow, _Progress, _Screen

EVENTS: list[dict[str, Any]] = [
    {"event": "run_info", "stats": {"draw": 1, "refine": 1, "page": 1, "total": 3}},
    {"event": "job_info", "jobid": 1, "rule_name": "draw", "rule_msg": "bead, run 000: drawing trajectories"},
    {"event": "job_finished", "job_id": 1},
    {"event": "job_info", "jobid": 2, "rule_name": "refine", "rule_msg": "bead, run 000: refining"},
]


class Clock:
    """A clock that goes on by one second each time that it is read."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        self.now += 1.0
        return self.now


def line(event: dict[str, Any]) -> str:
    return f"{MARK}{json.dumps(event)}\n"


def test_the_line_says_what_runs_how_many_of_how_many_and_the_time_left() -> None:
    progress = _Progress(clock=Clock())
    assert progress.line() == "reading and checking your files"
    for event in EVENTS:
        progress.take(event)
    assert progress.line().startswith("2 of 3: refining (bead), about ")
    assert progress.left() is not None and progress.done == 1


def test_a_job_that_takes_longer_than_was_thought_promises_no_end() -> None:
    clock = Clock()
    progress = _Progress(clock=clock)
    for event in EVENTS:
        progress.take(event)
    clock.now += 10_000
    assert progress.left() is None
    assert progress.line() == "2 of 3: refining (bead)"


def test_a_job_says_what_it_is_doing() -> None:
    progress = _Progress(clock=Clock())
    for event in EVENTS:
        progress.take(event)
    progress.take({"event": "doing", "of": "bead", "text": "candidate 2 of 6: dry friction"})
    progress.take({"event": "doing", "of": "another", "text": "candidate 9 of 9"})
    assert progress.line().startswith("2 of 3: refining (bead): candidate 2 of 6: dry friction, about ")


def test_on_a_terminal_the_line_is_rewritten_and_fits() -> None:
    stream = io.StringIO()
    _follow(map(line, EVENTS), _Screen(stream, columns=30), _Progress(clock=Clock()))
    shown = stream.getvalue()
    assert "\n" not in shown and max(map(len, shown.split("\r"))) <= 30
    assert shown.endswith("\r")  # nothing of it stays


def test_in_a_log_a_line_stands_now_and_then() -> None:
    stream = io.StringIO()
    _follow(map(line, EVENTS * 10), _Screen(stream, columns=None, clock=Clock()), _Progress(clock=Clock()))
    assert 2 <= stream.getvalue().count("\n") <= 5 and "\r" not in stream.getvalue()


def test_the_sentence_of_a_job_comes_through_and_its_traceback_does_not() -> None:
    stream, progress = io.StringIO(), _Progress(clock=Clock())
    lines = [
        *map(line, EVENTS),
        "bead.csv, row 3: it is empty; remove it.\n",
        "Traceback (most recent call last):\n",
        '  File "x.py", line 1\n',
        "KeyError: 'what'\n",
        line({"event": "job_error", "jobid": 2, "rule_name": "refine", "log": ["results/refine.log"]}),
    ]
    passed_on = _follow(lines, _Screen(stream, columns=None, clock=Clock()), progress)
    assert passed_on == ["bead.csv, row 3: it is empty; remove it."]
    assert "KeyError" not in stream.getvalue() and "row 3" in stream.getvalue()
    (fault,) = _faults(progress, passed_on)
    assert "refining (bead)" in fault and "results/refine.log" in fault


def test_a_sentence_that_was_passed_on_is_enough() -> None:
    assert _faults(_Progress(), ["study.yaml, line 2: no; yes."]) == []
    said = _Progress()
    said.take(
        {"event": "error", "text": "MissingInputException: x.csv", "exception": "MissingInputException"}
    )
    assert _faults(said, []) == ["MissingInputException: x.csv"]
