"""One line of progress: what runs, how many of how many, how much time is left; and why a job failed."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, TextIO

MARK = "\x1e"
"""Begins a line that is an event, as the logger plugin of the workflow writes them."""

SECONDS = {
    "diagnosis": 40.0,
    "escapes": 15.0,
    "figures": 5.0,
    "identify": 2.0,
    "landscape_figures": 2.5,
    "mismatch_figures": 5.0,
    "mismatch_landscape": 3.0,
    "reference": 15.0,
    "refine": 6.0,
    "train": 17.0,
}
"""What jobs take beside one another, measured on studies of two and three states; others about a second.
Only their ratios matter once a job has ended: the speed of the machine then follows."""

OF_SNAKEMAKE = "Using workflow specific profile"
"""What Snakemake prints before it has a logger, of use to nobody here."""

EVERY = 15.0
"""Seconds between lines where they are kept, as in a log; a choice."""


@dataclass
class Progress:
    """Where a workflow stands, from its events.

    Attributes
    ----------
    clock
        Seconds of any clock that does not go back.
    total, done
        Jobs.
    running
        What runs, by number of the job, in the words of its rule.
    failed
        The jobs that failed: what they were about, and their logs.
    errors
        What Snakemake itself says of a fault.
    broken
        Whether a job ended by a fault of ours, with a traceback.
    planned
        What is to run, in the words of the rules.
    """

    clock: Callable[[], float] = time.monotonic
    total: int = 0
    done: int = 0
    running: dict[int, str] = field(default_factory=dict)
    failed: list[tuple[str, tuple[str, ...]]] = field(default_factory=list)
    errors: list[str] = field(default_factory=list)
    broken: bool = False
    planned: list[str] = field(default_factory=list)
    _doing: dict[str, str] = field(default_factory=dict)
    _rules: dict[int, str] = field(default_factory=dict)
    _words: dict[int, str] = field(default_factory=dict)
    _latest_words: str = "starting"
    _work: float = 0.0
    _worked: float = 0.0
    _began: float | None = None
    _latest: float = 0.0

    def take(self, event: Mapping[str, Any]) -> None:
        """Follow one event."""
        kind = event.get("event")
        if kind == "run_info":
            counts = {name: int(count) for name, count in event["stats"].items()}
            self.total = counts.pop("total", sum(counts.values()))
            self._work = sum(count * _seconds(rule) for rule, count in counts.items())
            self._began = self._latest = self.clock()
        elif kind == "job_info":
            job = int(event["jobid"])
            self._rules[job] = event["rule_name"]
            self._words[job] = self.running[job] = _in_short(event.get("rule_msg") or event["rule_name"])
            self.planned.append(self._words[job])
        elif kind == "doing":
            self._doing[str(event["of"])] = str(event["text"])
        elif kind == "job_finished":
            self._end(int(event["job_id"]))
        elif kind == "job_error":
            job = int(event["jobid"])
            self.running.pop(job, None)
            self.failed.append((self._words.get(job, str(event["rule_name"])), tuple(event.get("log") or ())))
        elif kind == "error":
            self.errors.append(str(event.get("text", "")))

    def _end(self, job: int) -> None:
        words = self._words.get(job, "")
        self._doing = {of: text for of, text in self._doing.items() if not words.endswith(f"({of})")}
        self.running.pop(job, None)
        self.done += 1
        self._worked += _seconds(self._rules.get(job, ""))
        self._latest = self.clock()

    def _within(self, words: str) -> str:
        """What a running job said last of what it is doing."""
        said = [text for of, text in self._doing.items() if words.endswith(f"({of})")]
        return f": {said[-1]}" if said else ""

    def left(self) -> float | None:
        """Seconds that are left; None before anything began, and where it takes longer than was thought."""
        if self._began is None or not self._work:
            return None
        spent = self._latest - self._began
        pace = spent / self._worked if self._worked and spent > 0 else 1.0
        left = (self._work - self._worked) * pace - (self.clock() - self._latest)
        return None if left < 0 and self.running else max(left, 0.0)

    def line(self) -> str:
        """Where it stands, in one line."""
        if not self.total:
            return "reading and checking your files"
        words = list(self.running.values())
        if words:
            self._latest_words = words[-1] + self._within(words[-1])
        what = "finishing" if self.done == self.total else self._latest_words
        more = f" (and {len(words) - 1} more)" if len(words) > 1 else ""
        left = self.left()
        time_left = "" if left is None else f", {_duration(left)}"
        return f"{min(self.done + 1, self.total)} of {self.total}: {what}{more}{time_left}"


def _in_short(message: str) -> str:
    """``bead, run 000: drawing`` as ``drawing (bead)``: what is done comes first, and the line is short."""
    of, colon, what = message.partition(": ")
    name = of.removesuffix(", run 000")
    return f"{what} ({name})" if colon else message


def _seconds(rule: str) -> float:
    return SECONDS.get(rule, 1.0)


def _duration(seconds: float) -> str:
    """About how long, in words."""
    if seconds < 5:
        return "a few seconds left"
    if seconds < 90:
        return f"about {5 * round(seconds / 5)} s left"
    if seconds < 5400:
        return f"about {round(seconds / 60)} min left"
    return f"about {round(seconds / 3600)} h left"


class Screen:
    """Shows the line: rewritten in place on a terminal, now and then in a log.

    Parameters
    ----------
    stream
        Where to.
    columns
        Width of the terminal; None where the stream is none.
    clock
        As `Progress.clock`.
    """

    def __init__(
        self, stream: TextIO, *, columns: int | None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._stream, self._columns, self._clock = stream, columns, clock
        self._shown = ""
        self._last: float | None = None

    def show(self, line: str) -> None:
        """Show where it stands."""
        if self._columns is not None:
            cut = line if len(line) < self._columns else line[: self._columns - 2] + "…"
            if cut != self._shown:
                self._stream.write("\r" + cut.ljust(len(self._shown)))
                self._shown = cut
        elif self._last is None or self._clock() - self._last >= EVERY:
            self._stream.write(line + "\n")
            self._last = self._clock()
        self._stream.flush()

    def say(self, line: str) -> None:
        """Write a line that stays."""
        self.clear()
        self._stream.write(line + "\n")
        self._stream.flush()

    def clear(self) -> None:
        """Take the rewritten line away."""
        if self._shown:
            self._stream.write("\r" + " " * len(self._shown) + "\r")
            self._shown = ""
        self._stream.flush()


def follow(lines: Iterable[str], screen: Screen, progress: Progress) -> list[str]:
    """Read what a workflow writes, show where it stands, and pass on what its jobs say.

    The traceback of a job is not passed on: it stands in the job's log, which `faults` names.

    Parameters
    ----------
    lines
        As they come; an empty one only has the time that is left shown anew.
    screen, progress
        What is shown, and what is followed.

    Returns
    -------
    list of str
        The lines that were passed on.
    """
    passed_on: list[str] = []
    in_traceback = False
    for raw in lines:
        text, mark, event = raw.rstrip("\r\n").partition(MARK)
        if mark:
            progress.take(json.loads(event))
            in_traceback = False
        if text.startswith("Traceback (most recent call last)"):
            in_traceback = progress.broken = True
        elif text.strip() and not in_traceback and not text.startswith(OF_SNAKEMAKE):
            passed_on.append(text)
            screen.say(text)
        screen.show(progress.line())
    screen.clear()
    return passed_on


def faults(progress: Progress, passed_on: list[str]) -> list[str]:
    """Sentences on why a workflow stopped, where its jobs did not say so themselves.

    Parameters
    ----------
    progress
        Where it stopped.
    passed_on
        What its jobs said.
    """
    if passed_on and not progress.broken:
        return []
    if progress.failed:
        what, logs = progress.failed[0]
        where = f"; the log is {logs[0]}" if logs else ""
        return [f"This step stopped by a fault that is not yours: {what}{where}. Please report it."]
    return progress.errors[:1] or ["The workflow did not end; `siq run --verbose` shows what Snakemake says."]


def screen_of(stream: TextIO = sys.stderr, *, columns: int = 80) -> Screen:
    """A screen on a stream, rewritten in place where it is a terminal."""
    return Screen(stream, columns=columns if stream.isatty() else None)
