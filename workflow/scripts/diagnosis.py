"""Diagnose one case: where a simulation and recordings differ, and what was left out."""

import json
from typing import Any

from siq.errors import InputError, NumericalFailure
from siq.files import whole_file
from siq.mismatch.case import read_case, solve_case, tables_of
from siq.tables import write_table
from step import job


def main(snakemake: Any) -> None:
    """Run as a rule's script."""
    study = snakemake.input.get("study")
    case = read_case(snakemake.input.card, snakemake.input.recordings, study or None)
    try:
        outcome = solve_case(case)
    except NumericalFailure as error:
        raise InputError(
            snakemake.input.card, "", f"the simulation cannot be fitted to the recordings: {error}",
            "begin with parameters and a domain that are closer to the system",
        ) from None  # fmt: skip
    for name, table in tables_of(case, outcome).items():
        write_table(snakemake.output[name], table)
    for name, card in (("system", outcome.card), ("recalibrated", outcome.recalibrated)):
        with whole_file(snakemake.output[name]) as partial:
            partial.write_text(card, encoding="utf-8")
    with whole_file(snakemake.output.verdict) as partial:
        text = json.dumps(outcome.verdict, indent=1, ensure_ascii=False, allow_nan=False)
        partial.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    with job(snakemake):  # type: ignore[name-defined]  # noqa: F821 (Snakemake puts it here)
        main(snakemake)  # type: ignore[name-defined]  # noqa: F821
