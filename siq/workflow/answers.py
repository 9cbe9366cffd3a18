"""The answer of a study or a diagnosis in one sentence and an exit code, and the provenance of its files.

Beside every page lies ``provenance.jsonl``: a line for each job, with the digests of all that it read and
made, the versions of the programs, seed, machine and time.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import platform
import shutil
import sys
import time
from collections.abc import Mapping
from enum import IntEnum
from functools import cached_property
from pathlib import Path
from typing import Any

from siq.errors import InputError, version


class Exit(IntEnum):
    """Codes with which ``siq`` ends.

    ``ANSWERED``: there is an answer; that a formula is not certified is one, too. ``FAULT``: a file cannot be
    used, something is not installed, or a step stopped. ``USAGE``: the command line was not understood.
    ``NO_ANSWER``: everything ran, and there is a page that says why, but it has no formula, or the
    simulation cannot be compared. ``INTERRUPTED``: it was stopped, and goes on where it stopped.
    """

    ANSWERED = 0
    FAULT = 1
    USAGE = 2
    NO_ANSWER = 3
    INTERRUPTED = 130


CERTIFIED = {
    "all": "Every formula passed its certificate.",
    "some": "Some of the formulas passed their certificates; the page says which.",
    "none": "No formula passed its certificate: read on the page why, before you rely on the numbers.",
}


def answer_of_page(page: Path) -> tuple[list[str], Exit]:
    """What to say of a page and how to end, from the file ``answer.json`` beside it.

    Parameters
    ----------
    page
        ``results/NAME/report.html`` or ``results/mismatch/NAME/report.html``.
    """
    try:
        answer = json.loads((page.parent / "answer.json").read_text(encoding="utf-8"))
        if "verdict" not in answer:
            return _of_study(answer)
        return [str(answer["sentence"])], Exit.ANSWERED if answer.get("compared", True) else Exit.NO_ANSWER
    except (OSError, ValueError, KeyError, TypeError):  # of an earlier version: the page is all we know of
        return [], Exit.ANSWERED


def _of_study(answer: Mapping[str, Any]) -> tuple[list[str], Exit]:
    sentence = str(answer["sentence"])
    lines = [sentence] if sentence else []
    if not answer["formulas"] and answer.get("states"):
        return [*lines, "No formula was found: the states and their times are the answer."], Exit.ANSWERED
    if not answer["formulas"]:
        return [*lines, "No formula was found; the page says at which step, and what to do."], Exit.NO_ANSWER
    if answer["runs"] == 1 and answer["certified"] == "all":
        lines.append("The formula passed its certificate.")
    else:
        lines.append(CERTIFIED[answer["certified"]])
    if answer["failed"]:
        lines.append(f"{answer['failed']} of {answer['runs']} runs failed at some step.")
    return lines, Exit.ANSWERED


PROVENANCE = "provenance.jsonl"
UNRECORDED = (PROVENANCE, ".snakemake_timestamp")
"""Files that no job has made, or that stand for no result."""

PROGRAMS = ("numpy", "scipy", "sympy", "pandas", "pyarrow", "numba", "snakemake", "torch", "pysindy")


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _paths(named: Mapping[str, Any]) -> list[Path]:
    several = ([value] if isinstance(value, str) else value for value in named.values())
    return [Path(path) for paths in several for path in paths if path]


class Provenance:
    """What every file of a folder of results came from.

    Paths are those from the folder. Each line ends in a digest of itself. It protects from accidents and from
    careless edits; who edits a file and computes all digests anew is found by deriving the result again.

    Parameters
    ----------
    folder
        ``results/NAME``.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self.file = self.folder / PROVENANCE

    @cached_property
    def _lines(self) -> tuple[list[dict[str, Any]], int]:
        """The lines that are whole, and how many others there are."""
        jobs, broken = [], 0
        content = self.file.read_bytes() if self.file.is_file() else b""
        for text in filter(None, content.split(b"\n")):
            try:
                line = json.loads(text)
                whole = line.pop("digest") == _digest(json.dumps(line, sort_keys=True).encode())
                jobs += [line] if whole else []
            except (ValueError, KeyError, AttributeError):
                whole = False
            broken += not whole
        return jobs, broken

    @property
    def broken(self) -> int:
        """How many lines are damaged."""
        return self._lines[1]

    @cached_property
    def made(self) -> dict[str, dict[str, Any]]:
        """The job that has made each file or folder last."""
        return {path: job for job in self._lines[0] for path in job["outputs"]}

    def _is_as_made(self, path: str) -> bool:
        job = self.made.get(path)
        return job is None or Provenance.digest_of(self.folder / path) == job["outputs"][path]

    def record(
        self, task: str, *, inputs: Mapping[str, Any], outputs: Mapping[str, Any], said: Mapping[str, Any]
    ) -> None:
        """Add a job that has ended: the files of its rule by name, one or several, and its options.

        The table beside a Parquet file counts as its output, too.
        """
        made = _paths(outputs)
        made += [
            path.with_suffix(".csv") for path in made
            if path.suffix == ".parquet" and path.with_suffix(".csv").is_file()
        ]  # fmt: skip
        from importlib.metadata import version as installed

        loaded = {name: installed(name) for name in PROGRAMS if name in sys.modules or name == "snakemake"}
        line = {
            "task": task,
            **{key: said[key] for key in ("seed", "study", "command", "version") if key in said},
            "inputs": {self._own(path): Provenance.digest_of(path) for path in _paths(inputs)},
            "outputs": {self._own(path): Provenance.digest_of(path) for path in made},
            "versions": {"siq": version(), "python": platform.python_version()} | loaded,
            "machine": f"{platform.system()} {platform.release()} {platform.machine()}",
            "ended": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        }
        line = json.loads(json.dumps(line))
        line["digest"] = _digest(json.dumps(line, sort_keys=True).encode())
        # One write, after the end of whatever half a line a killed process left.
        text = b"\n" + json.dumps(line).encode() + b"\n"
        number = os.open(self.file, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o666)
        try:
            if (written := os.write(number, text)) < len(text):
                os.ftruncate(number, os.fstat(number).st_size - written)
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self.file))
        finally:
            os.close(number)

    @staticmethod
    def digest_of(path: Path) -> str | None:
        """SHA-256 of a file, or of names and digests of all in a folder; None where there is nothing."""
        if path.is_dir():
            inside = sorted(
                each for each in path.rglob("*") if each.is_file() and each.name not in UNRECORDED
            )
            named = [f"{each.relative_to(path).as_posix()} {Provenance.digest_of(each)}" for each in inside]
            return _digest("\n".join(named).encode())
        try:
            with path.open("rb") as file:
                return hashlib.file_digest(file, "sha256").hexdigest()
        except FileNotFoundError:
            return None

    def _own(self, path: str | Path) -> str:
        return Path(os.path.relpath(path, self.folder)).as_posix()

    def changed(self) -> list[str]:
        """Files that are not as their job has made them."""
        return [path for path in self.made if not self._is_as_made(path)]

    def set_aside(self, *, remove: bool = True) -> list[str]:
        """Remove what is damaged, with all that the same job has made, so that it is made again.

        It gives a sentence for each damaged file; without `remove` that is all. What is not there at all is
        for the workflow to see.
        """
        damaged = [path for path in self.changed() if (self.folder / path).exists() or path.endswith(".csv")]
        for place in {self.folder / other for path in damaged for other in self.made[path]["outputs"]}:
            if not remove:
                break
            if place.is_dir():
                shutil.rmtree(place)
            else:
                place.unlink(missing_ok=True)
        return [f"{self.folder / path} is not as it was written; it is made again." for path in damaged]

    @classmethod
    def mend(cls, root: Path, *, planned: bool) -> None:
        """Say what is damaged in folders below a root, and set it aside unless that is only planned."""
        for depth in ("*", "*/*"):
            for file in root.glob(f"{depth}/{PROVENANCE}"):
                for told in cls(file.parent).set_aside(remove=not planned):
                    print(told, file=sys.stderr)

    @classmethod
    def check(cls, inputs: Mapping[str, Any]) -> None:
        """Refuse files of results that are not as they were written, before anything is built upon them.

        They are those of a rule by name, one or several.

        Raises
        ------
        InputError
            For the first of them.
        """
        known: dict[Path, Provenance] = {}
        for path in _paths(inputs):
            for folder in path.parents:
                if folder not in known:
                    known[folder] = cls(folder)
                if not known[folder]._is_as_made(known[folder]._own(path)):
                    remedy = "give the same command again, and it is made again"
                    raise InputError(path, "", "the file is not as it was written", remedy)

    def origin(self) -> str:
        """In one line what the results came from: files, seed, programs, machine."""
        jobs = list(self.made.values())
        outside = {
            path: digest for job in jobs for path, digest in job["inputs"].items() if path not in self.made
        }
        files = [f"{Path(path).name} (SHA-256 {digest[:16]})" for path, digest in outside.items() if digest]
        seeds = sorted({job["seed"] for job in jobs if job.get("seed") is not None})
        seed = f", seed {', '.join(map(str, seeds))}" if seeds else ""
        return f"{', '.join(files) or 'no file'}{seed}"
