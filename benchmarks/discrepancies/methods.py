"""All methods by name, and how one is run within its time: in a process of its own, on one core."""

from __future__ import annotations

import multiprocessing
import resource
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.discrepancies import gaussian, ours, sindy, universal
from benchmarks.discrepancies.answers import Answer, read_answer, write_answer
from benchmarks.discrepancies.cases import CaseFiles
from siq.diagnosis.study import Comparison

Report = Callable[[Answer], None]
Method = Callable[[Comparison, float, Report], Answer]
"""Takes a case, the seconds allowed, and a function that keeps the best answer so far."""

METHODS: Mapping[str, Method] = {
    "siq": lambda case, seconds, report: ours.diagnosed(case, seconds),
    "PySINDy": sindy.plain,
    "PySINDy, weak": sindy.weak,
    "Gaussian process": gaussian.gaussian_process,
    "universal differential equation": universal.universal,
}


PATIENCE = 10  # times the seconds of a core, by the clock: a process that waits for nothing ends, too


@dataclass(frozen=True)
class Question:
    """One method asked about one case.

    Attributes
    ----------
    case
        Which case.
    method
        A name of `METHODS`.
    seconds
        Of a core, after which the process ends; other processes that share it cost nothing.
    file
        Where the answer goes.
    commit
        Of the code.
    """

    case: CaseFiles
    method: str
    seconds: float
    file: Path
    commit: str

    def ask(self) -> Answer:
        """Ask, unless there is an answer already. What is not done in time is as good as it was."""
        if self.file.is_file():
            return read_answer(self.file)
        partial = self.file.with_suffix(".partial")
        partial.unlink(missing_ok=True)
        self.file.parent.mkdir(parents=True, exist_ok=True)
        # A copy of this process knows all libraries: their import is nobody's time.
        process = multiprocessing.get_context("fork").Process(target=self._answered, args=(partial,))
        before = _seconds_of_children()
        process.start()
        process.join(PATIENCE * self.seconds)
        if process.is_alive():
            process.kill()
            process.join()
        seconds = _seconds_of_children() - before
        late = (process.exitcode or 0) < 0
        answer = read_answer(partial) if partial.is_file() else Answer()
        if late:
            fault = f"not done within {self.seconds:.0f} s" + ("" if answer.answered else ", and no answer")
            answer = answer.model_copy(update={"fault": fault})
        elif not partial.is_file():
            answer = Answer(fault=f"the process ended with code {process.exitcode}")
        answer = answer.model_copy(update={"seconds": seconds, "commit": self.commit})
        write_answer(self.file, answer)
        partial.unlink(missing_ok=True)
        return answer

    def _answered(self, partial: Path) -> None:
        begin = time.process_time()
        allowed = int(np.ceil(self.seconds))
        resource.setrlimit(resource.RLIMIT_CPU, (allowed, allowed + 1))

        def report(answer: Answer) -> None:
            write_answer(partial, answer)

        try:
            case = self.case.read()
            report(METHODS[self.method](case, self.seconds - (time.process_time() - begin), report))
        except Exception as error:
            report(Answer(fault=f"{type(error).__name__}: {error}"))


def _seconds_of_children() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime
