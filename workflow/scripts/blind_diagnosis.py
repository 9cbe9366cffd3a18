"""Diagnose the cases of a batch. Nothing here knows of keys, seeds, or how cases are made."""

from workflow.warm import run_warm

run_warm()

import json
import logging
import time
from pathlib import Path
from typing import Any

from siq.diagnosis.diagnosis import solve_case
from siq.diagnosis.study import read_case
from siq.diagnosis.verdict import statement_of_failure
from siq.errors import NumericalFailure
from siq.numerics.files import whole_file
from step import job

LOGGER = logging.getLogger(__name__)


def diagnosed(folder: Path) -> dict[str, Any]:
    """What the diagnosis says of a case; a failure is told in a sentence and stops nothing else."""
    begin = time.perf_counter()
    verdict, card, failure = None, "", ""
    try:
        case = read_case(folder / "system.yaml", folder / "recordings.parquet", folder / "study.yaml")
        try:
            diagnosis = solve_case(case)
            verdict, card = diagnosis.statement.as_data(), diagnosis.to_card()
        except NumericalFailure as error:  # which is a verdict, too, as for every user
            LOGGER.exception("%s: no fit has a result", folder.name)
            failure = str(error)
            verdict, card = statement_of_failure(failure).as_data(), case.system.to_card()
    except Exception as error:
        LOGGER.exception("%s failed", folder.name)
        failure = f"{type(error).__name__}: {error}"
    return {
        "case": folder.name,
        "verdict": verdict,
        "card": card,
        "seconds": time.perf_counter() - begin,
        "failure": failure,
    }


def main(snakemake: Any) -> None:
    """Run as a rule's script."""
    answers = [
        diagnosed(folder) for folder in sorted(Path(snakemake.input.cases).iterdir()) if folder.is_dir()
    ]
    with whole_file(snakemake.output[0]) as partial:
        partial.write_text(json.dumps(answers, indent=1, allow_nan=False) + "\n", encoding="utf-8")


if __name__ == "__main__":
    with job(snakemake):  # type: ignore[name-defined]  # noqa: F821 (Snakemake puts it here)
        main(snakemake)  # type: ignore[name-defined]  # noqa: F821
