"""What every script shares: what its job was given, its log, and how it fails."""

from __future__ import annotations

import json
import logging
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from pydantic import TypeAdapter

from siq.errors import InputError

Settings = TypeVar("Settings")
FOLLOWED = "SIQ_FOLLOWED"
"""Environment variable that `siq run` and `siq diagnose` set where they read events and show progress."""

MARK = "\x1e"  # begins a line that is an event, as those of Snakemake do there


@dataclass(frozen=True)
class Job:
    """What Snakemake gave a job: its files by name, and what its rule says.

    Attributes
    ----------
    input, output, params, wildcards
        By the names that the rule has for them.
    threads
        How many it may use.
    config
        The configuration of the workflow.
    """

    input: Any
    output: Any
    params: Any
    wildcards: Any
    threads: int
    config: dict[str, Any]

    @property
    def run(self) -> int:
        """Number of the run that the job is of."""
        return int(self.wildcards.run)

    def settings(self, cls: type[Settings]) -> Settings:
        """The settings that the rule derived from the study, as the step's own object."""
        return TypeAdapter(cls).validate_python(self.params.settings)

    def given(self, name: str) -> str | None:
        """An input that only some studies have, None where there is none."""
        return self.input.get(name) or None


@contextmanager
def job(snakemake: Any = None) -> Iterator[Job]:
    """Run the body of a script: log to the rule's file, tell bad input in one sentence.

    An `InputError` ends the script with exit code 1 and its sentence, without a traceback. Any other
    exception is a fault of ours and shows where it happened. Snakemake puts what the job was given into the
    script itself, as `snakemake`; it is taken from there.
    """
    given = sys.modules["__main__"].snakemake if snakemake is None else snakemake
    log = Path(given.log[0])
    log.parent.mkdir(parents=True, exist_ok=True)
    logging.basicConfig(
        filename=log, filemode="w", level=logging.INFO, format="%(asctime)s %(levelname)s %(message)s"
    )
    logging.captureWarnings(True)
    try:
        yield Job(given.input, given.output, given.params, given.wildcards, given.threads, given.config)
    except InputError as error:
        logging.error("%s", error)
        print(error, file=sys.stderr)
        sys.exit(1)
    except BaseException:
        logging.exception("the step stopped")
        raise


def teller(of: str) -> Callable[[str], None]:
    """What passes on what a long job is doing: into its log, and to whoever follows the workflow.

    Parameters
    ----------
    of
        What the job is about, as the message of its rule begins.
    """

    def tell(text: str) -> None:
        logging.info("%s", text)
        if os.environ.get(FOLLOWED):
            event = {"event": "doing", "of": of, "text": text}
            sys.stderr.write(f"\n{MARK}{json.dumps(event)}\n")
            sys.stderr.flush()

    return tell


def read_json(path: str | Path) -> Any:
    """A JSON file's content, None where the file is empty since there was nothing to write."""
    text = Path(path).read_text(encoding="utf-8")
    return json.loads(text) if text else None
