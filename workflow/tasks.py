"""Run a task as a job of the workflow: what Snakemake gave it, its log, its results, and how it fails.

A log begins with what the job was given. The same job runs again without Snakemake, under a debugger, by

    python -m workflow.tasks results/double-well/logs/000/identify.log
"""

from __future__ import annotations

import json
import logging
import os
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from benchmarks.proof import tasks as proof
from benchmarks.publication import tasks as publication
from siq.errors import InputError
from siq.workflow.answers import Provenance
from workflow import diagnosis, pages, steps
from workflow.task import TASKS, Given

__all__ = ["TASKS", "Job", "run"]

MODULES = (steps, pages, diagnosis, proof, publication)
"""Whose tasks there are."""

FOLLOWED = "SIQ_FOLLOWED"
"""Environment variable that `siq run` and `siq diagnose` set where they read events and show progress."""

MARK = "\x1e"  # begins a line that is an event, as those of Snakemake do there
GIVEN = "given "  # begins what a log says of the job


@dataclass(frozen=True)
class Job:
    """What a job was given, as plain data.

    Attributes
    ----------
    task
        Its name.
    input, output
        Paths by name; several where there is one of each run.
    params, wildcards
        What the rule says.
    threads, device
        On how many, and where networks are trained.
    log
        Its log.
    """

    task: str
    input: Mapping[str, Any]
    output: Mapping[str, Any]
    params: Mapping[str, Any]
    wildcards: Mapping[str, str]
    threads: int
    device: str
    log: str

    @classmethod
    def of(cls, snakemake: Any) -> Job:
        """What Snakemake put into the script."""
        plain = {
            name: {key: _plain(value) for key, value in getattr(snakemake, name).items()}
            for name in ("input", "output", "params", "wildcards")
        }
        device = snakemake.config.get("device", "auto")
        return cls(
            snakemake.params.task,
            **plain,
            threads=snakemake.threads,
            device=device,
            log=str(snakemake.log[0]),
        )

    def __call__(self) -> None:
        """Run the task and write its results."""
        from siq.workflow.study import PipelineSettings
        from workflow.files import write

        options = dict(self.params.get("options") or {})
        known = {each.name for each in fields(PipelineSettings)}
        settings = PipelineSettings(**{name: value for name, value in options.items() if name in known})
        first = self.wildcards.get("run") or self.wildcards.get("block", "0")
        given = Given(
            self.input, number=int(first.partition("-")[0]), options=options | dict(self.params),
            wildcards=self.wildcards, outputs=self.output, device=self.device, threads=self.threads,
            tell=_teller(self.wildcards.get("case", "")),
        )  # fmt: skip
        Provenance.check(self.input)
        made = TASKS[self.task].run(given, settings)
        for name, path in self.output.items():
            if name in made:
                write(name, path, made[name], settings)
        for then in given.afterwards:
            then()
        kept = Provenance(self.log.rpartition("/logs/")[0])
        kept.record(self.task, inputs=self.input, outputs=self.output, said=given.options)


def _plain(value: Any) -> Any:
    """Paths and lists of them without Snakemake's own types."""
    if isinstance(value, str):
        return str(value)
    if isinstance(value, Mapping):
        return {str(key): _plain(one) for key, one in value.items()}
    return [_plain(one) for one in value] if isinstance(value, Iterable) else value


def run(snakemake: Any) -> None:
    """Run the task that a rule names: log to the rule's file, tell bad input in one sentence.

    An `InputError` ends the job with exit code 1 and its sentence, without a traceback. Any other exception
    is a fault of ours and shows where it happened.
    """
    job = Job.of(snakemake)
    log = Path(job.log)
    log.parent.mkdir(parents=True, exist_ok=True)
    logging.basicConfig(
        filename=log, filemode="w", level=logging.INFO, format="%(asctime)s %(levelname)s %(message)s",
        force=True,
    )  # fmt: skip
    logging.captureWarnings(True)
    logging.info("%s%s", GIVEN, json.dumps(vars(job)))
    try:
        job()
    except (InputError, OSError) as error:  # of the system: a full disk, or what may not be read or written
        told = str(error)
        if isinstance(error, OSError):
            what = error.strerror or error
            told = f"{error.filename or log}: {what}; see to it, and give the same command again."
        logging.error("%s", told, exc_info=isinstance(error, OSError))
        print(told, file=sys.stderr)
        sys.exit(1)
    except BaseException:
        logging.exception("the step stopped")
        raise


def _teller(of: str) -> Callable[[str], None]:
    """Passes on what a long job is doing: into its log, and to whoever follows the workflow."""

    def tell(text: str) -> None:
        logging.info("%s", text)
        if os.environ.get(FOLLOWED):
            event = {"event": "doing", "of": of, "text": text}
            sys.stderr.write(f"\n{MARK}{json.dumps(event)}\n")
            sys.stderr.flush()

    return tell


if __name__ == "__main__":
    first_line = Path(sys.argv[1]).read_text(encoding="utf-8").splitlines()[0]
    Job(**json.loads(first_line.partition(GIVEN)[2]))()
