"""Score the diagnoses of a batch."""

from workflow.warm import run_warm

run_warm()

from pathlib import Path
from typing import Any

from siq.workflow.tables import write_table
from step import job
from workflow.proof.scoring import read_answers, score_case, score_table


def main(snakemake: Any) -> None:
    """Run as a rule's script."""
    folder, keys = Path(snakemake.input.cases), Path(snakemake.input.opened)
    answers = read_answers(snakemake.input.answers)
    rows = [score_case(name, folder / name, keys, answer) for name, answer in answers.items()]
    write_table(snakemake.output.table, score_table(rows))


if __name__ == "__main__":
    with job(snakemake):  # type: ignore[name-defined]  # noqa: F821 (Snakemake puts it here)
        main(snakemake)  # type: ignore[name-defined]  # noqa: F821
