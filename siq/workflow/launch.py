"""Start Snakemake for a study, recordings or a folder of cases, and follow it with one line of progress.

A job's message, ``NAME, run 000: drawing trajectories``, is what the line says; events come from the logger
plugin in ``workflow/plugins``, one line of JSON each.
"""

from __future__ import annotations

import importlib.util
import json
import os
import queue
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import IO, Any, TextIO

from siq.errors import InputError, MissingExtra, suggestion
from siq.numerics.files import CARD, case_folders, given_path, read_document
from siq.workflow.answers import Exit, answer_of_page
from siq.workflow.examples import STUDIES, name_for, write_generated

MARK = "\x1e"
"""Begins a line that is an event, as the logger plugin of the workflow writes them."""

SECONDS = {
    "diagnosis": 40.0, "escapes": 15.0, "figures": 5.0, "identify": 2.0, "landscape_figures": 2.5,
    "mismatch_figures": 5.0, "mismatch_landscape": 3.0, "reference": 15.0, "refine": 6.0, "train": 17.0,
}  # fmt: skip
"""What jobs take beside one another, measured on studies of two and three states; others about a second.
Only their ratios matter once a job has ended: the speed of the machine then follows."""

OF_SNAKEMAKE = "Using workflow specific profile"
"""What Snakemake prints before it has a logger, of no use here."""

EVERY = 15.0
"""Seconds between lines where they are kept, as in a log; a choice."""


@dataclass
class _Progress:
    """Where a workflow stands, from its events."""

    clock: Callable[[], float] = time.monotonic  #: seconds of any clock that does not go back
    total: int = 0  #: jobs
    done: int = 0  #: of these
    running: dict[int, str] = field(default_factory=dict)  #: by number of the job, in words of its rule
    #: What the jobs that failed were about, and their logs.
    failed: list[tuple[str, tuple[str, ...]]] = field(default_factory=list)
    errors: list[str] = field(default_factory=list)  #: what Snakemake itself says of a fault
    broken: bool = False  #: whether a job ended by a fault of ours, with a traceback
    planned: list[str] = field(default_factory=list)  #: what is to run, in the words of the rules
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
            self._work = sum(count * SECONDS.get(rule, 1.0) for rule, count in counts.items())
            self._began = self._latest = self.clock()
        elif kind == "job_info":
            job = int(event["jobid"])
            self._rules[job] = event["rule_name"]
            # ``bead, run 000: drawing`` as ``drawing (bead)``: what is done comes first, the line is short.
            message = event.get("rule_msg") or event["rule_name"]
            of, colon, what = message.partition(": ")
            short = f"{what} ({of.removesuffix(', run 000')})" if colon else message
            self._words[job] = self.running[job] = short
            self.planned.append(self._words[job])
        elif kind == "doing":
            self._doing[str(event["of"])] = str(event["text"])
        elif kind == "job_finished":
            job = int(event["job_id"])
            words = self._words.get(job, "")
            self._doing = {of: text for of, text in self._doing.items() if not words.endswith(f"({of})")}
            self.running.pop(job, None)
            self.done += 1
            self._worked += SECONDS.get(self._rules.get(job, ""), 1.0)
            self._latest = self.clock()
        elif kind == "job_error":
            job = int(event["jobid"])
            self.running.pop(job, None)
            self.failed.append((self._words.get(job, str(event["rule_name"])), tuple(event.get("log") or ())))
        elif kind == "error":
            self.errors.append(str(event.get("text", "")))

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
            # With what a running job said last of what it is doing.
            said = [f": {text}" for of, text in self._doing.items() if words[-1].endswith(f"({of})")]
            self._latest_words = words[-1] + "".join(said[-1:])
        what = "finishing" if self.done == self.total else self._latest_words
        more = f" (and {len(words) - 1} more)" if len(words) > 1 else ""
        time_left = "" if (left := self.left()) is None else f", {_duration(left)}"
        return f"{min(self.done + 1, self.total)} of {self.total}: {what}{more}{time_left}"


def _duration(seconds: float) -> str:
    """About how long, in words."""
    if seconds < 5:
        return "a few seconds left"
    if seconds < 90:
        return f"about {5 * round(seconds / 5)} s left"
    if seconds < 5400:
        return f"about {round(seconds / 60)} min left"
    return f"about {round(seconds / 3600)} h left"


class _Screen:
    """Shows the line: rewritten in place on a terminal of so many columns, now and then in a log."""

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


def _follow(lines: Iterable[str], screen: _Screen, progress: _Progress) -> list[str]:
    """Read what a workflow writes, show where it stands, and pass on what its jobs say, which is returned.

    The traceback of a job is not passed on: it stands in the job's log, which `_faults` names. An empty line
    only has the time that is left shown anew.
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


def _faults(progress: _Progress, passed_on: list[str]) -> list[str]:
    """Sentences on why a workflow stopped, where its jobs did not say so themselves."""
    if passed_on and not progress.broken:
        return []
    if progress.failed:
        what, logs = progress.failed[0]
        where = f"; the log is {logs[0]}" if logs else ""
        return [f"This step stopped by a fault that is not yours: {what}{where}. Please report it."]
    return progress.errors[:1] or ["The workflow did not end; `siq run --verbose` shows what Snakemake says."]


NEEDED = ("snakemake", "filelock", "matplotlib")
PLUGINS = Path("workflow", "plugins")
TICK = 1.0  # seconds after which the time left is shown anew


def _workflow_folder() -> Path:
    """The folder of the Snakefile: the checkout that this package lies in, or what the wheel brought."""
    here = Path(__file__).resolve()
    checkout, shipped = here.parents[2], here.parent / "shipped"
    in_checkout = (checkout / "Snakefile").is_file() and (checkout / "workflow" / "places.py").is_file()
    return checkout if in_checkout else shipped


def _need_workflow() -> None:
    """Refuse to begin where a package is missing that the workflow needs."""
    for package in NEEDED:
        if importlib.util.find_spec(package) is None:
            raise MissingExtra("workflow", package)


@dataclass(frozen=True)
class Request:
    """What Snakemake is asked for."""

    targets: tuple[str, ...] = ()  #: files or rules
    study: Path | None = None  #: a study to be given by --configfile
    settings: tuple[str, ...] = ()  #: keys of the configuration, as --config takes them
    cores: str = "all"  #: a number, or all
    verbose: bool = False  #: whether Snakemake speaks for itself
    dry_run: bool = False  #: whether it only says what would run
    further: tuple[str, ...] = ()  #: options that are passed on

    def command(self) -> list[str]:
        """The command line; what it has to make stands behind ``--``, where no option can take it."""
        base = _workflow_folder()
        # -P: a folder `workflow` of yours, where you work, is not mistaken for ours.
        words = [sys.executable, "-P", "-m", "snakemake", "--snakefile", str(base / "Snakefile")]
        words += ["--directory", str(Path.cwd()), "--cores", self.cores]
        words += ["--workflow-profile", str(base / "profiles" / "default")]
        if not self.verbose:
            words += ["--logger", "siq"]
        if self.dry_run:
            words += ["--dry-run"]
        configuration = base / "config" / "config.yaml"
        words += ["--configfile", str(configuration), *([str(self.study.resolve())] if self.study else [])]
        if self.settings:
            words += ["--config", *self.settings]
        return [*words, *self.further, "--", *self.targets]


PARENT = "SIQ_PARENT"
"""Environment variable that tells Snakemake to end when its standard input does, see `workflow.warm`."""

FOLLOWED = "SIQ_FOLLOWED"
"""Environment variable that tells jobs that what they say of their progress is read."""


def _lines(stream: IO[str]) -> Iterator[str]:
    """The lines of a stream as they come, and an empty one each tick in between."""
    waiting: queue.Queue[str | None] = queue.Queue()

    def read() -> None:
        for line in stream:
            waiting.put(line)
        waiting.put(None)

    threading.Thread(target=read, daemon=True).start()
    while True:
        try:
            line = waiting.get(timeout=TICK)
        except queue.Empty:
            yield ""
            continue
        if line is None:
            return
        yield line


def _known_studies() -> Sequence[str]:
    """The names of the studies that come with the workflow."""
    return sorted(path.stem for path in (_workflow_folder() / "config" / "studies").glob("*.yaml"))


RESULTS = Path("results")


def run_study(given: str, asked: Request) -> Exit:
    """Answer a study, recordings without a study, or a study that comes with the workflow.

    Given is the path of a study (YAML) or of recordings (a file, or a folder of files), or the name of a
    study in ``config/studies``; to what is `asked`, what to make is added. Fails with `InputError` when the
    file cannot be used, with `MissingExtra` when the workflow is not installed.
    """
    _need_workflow()
    path = given_path(given)
    settings: tuple[str, ...] = ()
    study: Path | None = None
    if not path.exists() and given in _known_studies():
        name = given
    elif not path.exists():
        raise _not_there(given)
    elif any(each in path.name for each in "{}"):  # to Snakemake a blank that is filled in
        raise InputError(given, "", "the name has braces", "rename the file")
    elif (path / CARD).is_file():
        raise InputError(
            given, "", f"this is a case of a simulation and its recordings, since it has {CARD}",
            f"compare them by: siq diagnose {given}",
        )  # fmt: skip
    elif path.suffix.lower() in STUDIES:
        from siq.workflow.study import load_study  # here, so that a fault of the line is told at once

        data = read_document(path).data
        if "equations" in data:
            raise InputError(
                path, "", "this is the card of a system, not a study",
                f"write a study beside it, of two lines: 'name: {data.get('name', 'my-study')}' and"
                f" 'system: {path.name}'",
            )  # fmt: skip
        name, study = load_study(path).name, path
    else:
        name = name_for(path)
        study, origin = write_generated(path, name)
        settings = (f"origin={origin}",)
    page = RESULTS / name / "report.html"
    return _answered(replace(asked, targets=(page.as_posix(),), study=study, settings=settings), [page])


def diagnose_cases(folder: str, asked: Request) -> Exit:
    """Compare simulations with recordings: every case of a folder, or the one that the folder is.

    It has ``system.yaml`` and recordings, or folders that have them. Fails as `run_study` does.
    """
    _need_workflow()
    place = given_path(folder)
    if place.name == CARD and place.is_file():
        place = place.parent
    if not place.is_dir():
        raise _not_there(folder)
    pages = [RESULTS / "mismatch" / name / "report.html" for name in case_folders(place)]
    return _answered(replace(asked, targets=("diagnose",), settings=(f"cases={place.as_posix()}",)), pages)


def _not_there(given: str) -> InputError:
    """A wrong path, with where it was looked for and what is there of a similar name."""
    place = given_path(given).absolute()
    neighbours = [entry.name for entry in place.parent.iterdir()] if place.parent.is_dir() else []
    otherwise = suggestion(given, _known_studies(), otherwise="correct the path")
    remedy = suggestion(place.name, neighbours, otherwise=otherwise)
    if not place.parent.is_dir():
        return InputError(given, "", f"there is no folder {place.parent}", remedy)
    return InputError(given, "", f"there is no file or folder of that name in {place.parent}", remedy)


def _answered(request: Request, pages: Sequence[Path]) -> Exit:
    """Run the workflow in the folder in which you work, with one line of progress; say how it ended."""
    # Its standard input ends with this process, however that ends, and Snakemake then ends, too.
    base = _workflow_folder()  # with our logger, and in a checkout our sources
    paths = [str(base / PLUGINS), *([str(base)] if (base / "siq").is_dir() else [])]
    paths += [path for path in os.environ.get("PYTHONPATH", "").split(os.pathsep) if path]
    ours = {"PYTHONPATH": os.pathsep.join(paths), "PYTHONIOENCODING": "utf-8", PARENT: "1"}
    process = subprocess.Popen(
        request.command(), env=os.environ | ours | ({} if request.verbose else {FOLLOWED: "1"}),
        stdin=subprocess.PIPE, stdout=None if request.verbose else subprocess.PIPE,
        stderr=None if request.verbose else subprocess.STDOUT, encoding="utf-8", errors="replace",
    )  # fmt: skip
    progress, said = _Progress(), []

    def stop(number: int, frame: object) -> None:
        raise KeyboardInterrupt

    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, stop)
    try:
        if process.stdout is not None:
            columns = shutil.get_terminal_size().columns if sys.stderr.isatty() else None
            said = _follow(_lines(process.stdout), _Screen(sys.stderr, columns=columns), progress)
        code = process.wait()
    except KeyboardInterrupt:  # files are whole or not there; what was begun is made again
        try:
            if process.stdin is not None:
                process.stdin.close()
            process.wait(timeout=20.0)
        except (KeyboardInterrupt, subprocess.TimeoutExpired):
            process.kill()
            process.wait()
        print("\nStopped. Give the same command again to go on from here.", file=sys.stderr)
        return Exit.INTERRUPTED
    if code < 0:
        said = [f"Snakemake was ended by signal {-code}. Give the same command again to go on from here."]
        print(*said, file=sys.stderr)
    elif code and not request.verbose:
        said += (more := _faults(progress, said))
        for line in more:
            print(line, file=sys.stderr)
    if code not in (0, Exit.NO_ANSWER):
        return Exit.FAULT
    steps = progress.total
    if request.dry_run:
        for words in progress.planned:
            print(words)
        if not request.verbose:
            print(f"{steps} steps would run." if steps else "Nothing would run: all is up to date.")
        return Exit.ANSWERED
    told = {page: answer_of_page(page) for page in pages if page.is_file()}
    if not steps and not request.verbose:
        print("Nothing has changed since the last time; this is the answer that you have.", file=sys.stderr)
    for page, (lines, _) in told.items():
        for line in (*lines, f"The page to read: {page}"):
            if line not in said:
                print(line)
    return max((code for _, code in told.values()), default=Exit.FAULT)
