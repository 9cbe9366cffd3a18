"""Diagnose one case: where a simulation and recordings differ, and what was left out."""

from workflow.warm import run_warm

run_warm()

import json
import logging
from typing import Any

from siq.diagnosis.diagnosis import solve_case, tables_of, tables_of_failure
from siq.diagnosis.study import read_case
from siq.diagnosis.verdict import statement_of_failure
from siq.errors import NumericalFailure
from siq.numerics.files import whole_file
from siq.workflow.tables import write_table
from step import job, teller

LOGGER = logging.getLogger(__name__)


def main(snakemake: Any) -> None:
    """Run as a rule's script."""
    study = snakemake.input.get("study")
    case = read_case(snakemake.input.card, snakemake.input.recordings, study or None)
    try:
        diagnosis = solve_case(case, tell=teller(snakemake.wildcards.case))
        statement, tables = diagnosis.statement, tables_of(diagnosis)
        after, recalibrated = diagnosis.augmented, diagnosis.recalibrated
    except NumericalFailure as error:  # which is a verdict, too: the page says what happened
        LOGGER.exception("no fit has a result")
        statement, tables = statement_of_failure(str(error)), tables_of_failure(case)
        after = recalibrated = case.system
    for name, table in tables.items():
        write_table(snakemake.output[name], table)
    for name, system in (("system", after), ("recalibrated", recalibrated)):
        with whole_file(snakemake.output[name]) as partial:
            partial.write_text(system.to_card(), encoding="utf-8")
    with whole_file(snakemake.output.verdict) as partial:
        text = json.dumps(statement.as_data(), indent=1, ensure_ascii=False, allow_nan=False)
        partial.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    with job(snakemake):  # type: ignore[name-defined]  # noqa: F821 (Snakemake puts it here)
        main(snakemake)  # type: ignore[name-defined]  # noqa: F821
