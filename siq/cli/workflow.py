"""Where is the workflow, is all installed that it needs, and how is it started?"""

from __future__ import annotations

import importlib.util
import os
import queue
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from siq.cli.progress import Progress, faults, follow, screen_of
from siq.errors import MissingExtra

NEEDED = ("snakemake", "filelock", "matplotlib")
PLUGINS = Path("workflow", "plugins")
TICK = 1.0  # seconds after which the time left is shown anew


def workflow_folder() -> Path:
    """The folder of the Snakefile: the checkout that this package lies in, or what the wheel brought."""
    here = Path(__file__).resolve()
    checkout, shipped = here.parents[2], here.parent / "shipped"
    in_checkout = (checkout / "Snakefile").is_file() and (checkout / "workflow" / "places.py").is_file()
    return checkout if in_checkout else shipped


def need_workflow() -> None:
    """Say what to install where the workflow cannot run.

    Raises
    ------
    MissingExtra
        For the first package that is missing.
    """
    for package in NEEDED:
        if importlib.util.find_spec(package) is None:
            raise MissingExtra("workflow", package)


@dataclass(frozen=True)
class Request:
    """What Snakemake is asked for.

    Attributes
    ----------
    targets
        Files or rules.
    study
        A study to be given by ``--configfile``.
    settings
        Keys of the configuration, as ``--config`` takes them.
    cores
        A number, or ``all``.
    verbose
        Whether Snakemake speaks for itself.
    dry_run
        Whether it only says what would run.
    further
        Options that are passed on.
    """

    targets: tuple[str, ...] = ()
    study: Path | None = None
    settings: tuple[str, ...] = ()
    cores: str = "all"
    verbose: bool = False
    dry_run: bool = False
    further: tuple[str, ...] = ()

    def command(self) -> list[str]:
        """The command line; what it has to make stands behind ``--``, where no option can take it."""
        base = workflow_folder()
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


FOLLOWED = "SIQ_FOLLOWED"
"""Environment variable that tells jobs that what they say of their progress is read."""


@dataclass(frozen=True)
class Ended:
    """How a workflow ended.

    Attributes
    ----------
    code
        Snakemake's own exit code.
    said
        The lines that were shown on the way.
    steps
        How many there were to do.
    planned
        What they were about, in words.
    interrupted
        Whether it was stopped from the keyboard.
    """

    code: int
    said: tuple[str, ...] = ()
    steps: int = 0
    planned: tuple[str, ...] = ()
    interrupted: bool = False


def run_workflow(request: Request) -> Ended:
    """Run the workflow in the folder in which you work, with one line of progress on standard error.

    Raises
    ------
    MissingExtra
        Where it is not installed.
    """
    need_workflow()
    process = subprocess.Popen(
        request.command(),
        env=_environment() | ({} if request.verbose else {FOLLOWED: "1"}),
        stdout=None if request.verbose else subprocess.PIPE,
        stderr=None if request.verbose else subprocess.STDOUT,
        text=None if request.verbose else True,
        encoding=None if request.verbose else "utf-8",
        errors=None if request.verbose else "replace",
    )
    progress, said = Progress(), []
    try:
        if process.stdout is not None:
            screen = screen_of(columns=shutil.get_terminal_size().columns)
            said = follow(_lines(process.stdout), screen, progress)
        code = process.wait()
    except KeyboardInterrupt:  # Snakemake has been told, too, and lets no half of a file stand
        _wait_once_more(process)
        print(file=sys.stderr)
        return Ended(process.returncode, interrupted=True)
    if code and not request.verbose:
        said += (more := faults(progress, said))
        for line in more:
            print(line, file=sys.stderr)
    return Ended(code, tuple(said), progress.total, tuple(progress.planned))


def _environment() -> dict[str, str]:
    """What Snakemake is started with: our logger, and in a checkout our sources."""
    base = workflow_folder()
    paths = [str(base / PLUGINS)]
    if (base / "siq").is_dir():
        paths.append(str(base))
    paths += [path for path in os.environ.get("PYTHONPATH", "").split(os.pathsep) if path]
    return os.environ | {"PYTHONPATH": os.pathsep.join(paths), "PYTHONIOENCODING": "utf-8"}


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


def _wait_once_more(process: subprocess.Popen[str] | subprocess.Popen[bytes], patience: float = 20.0) -> None:
    """Let an interrupted workflow clean up; end it when it is interrupted again, or takes too long."""
    try:
        process.wait(timeout=patience)
    except (KeyboardInterrupt, subprocess.TimeoutExpired):
        process.kill()
        process.wait()


def known_studies() -> Sequence[str]:
    """The names of the studies that come with the workflow."""
    return sorted(path.stem for path in (workflow_folder() / "config" / "studies").glob("*.yaml"))
