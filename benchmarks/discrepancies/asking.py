"""Every method is asked about every case, one after the other, unless it has answered already."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Sequence
from pathlib import Path

from benchmarks.discrepancies.answers import answer_file
from benchmarks.discrepancies.cases import CaseFiles
from benchmarks.discrepancies.methods import Question


def ask(cases: Sequence[CaseFiles], folder: Path, methods: Sequence[str], *, seconds: float) -> None:
    """Ask, and tell what went wrong and how far it is.

    Parameters
    ----------
    cases
        Which cases.
    folder
        Gets the answers.
    methods
        Names of `benchmarks.discrepancies.methods.METHODS`.
    seconds
        Of a core, allowed for each case and method.
    """
    warm()
    commit, began = commit_now(), time.perf_counter()
    for done, case in enumerate(cases, start=1):
        for method in methods:
            file = answer_file(folder, case.generator, case.name, method)
            answer = Question(case, method, seconds, file, commit).ask()
            if answer.fault:
                print(f"{case.generator} {case.name}, {method}: {answer.fault}", flush=True)
        print(f"{done} of {len(cases)} cases, {(time.perf_counter() - began) / 60:.0f} min", flush=True)


def warm() -> None:
    """Load what methods load, so that it is nobody's time."""
    import pysindy  # noqa: F401
    import sklearn.gaussian_process  # noqa: F401


def commit_now() -> str:
    """The commit of the code, with a mark where it has been changed since; empty outside a repository."""
    command = ["git", "describe", "--always", "--dirty", "--abbrev=10", "--exclude=*"]
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()
