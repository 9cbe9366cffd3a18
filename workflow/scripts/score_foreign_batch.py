"""Score the diagnoses of a batch of random systems."""

from workflow.warm import run_warm

run_warm()

from pathlib import Path
from typing import Any

from siq.workflow.tables import write_table
from step import job
from workflow.proof.foreign_scores.scores import foreign_score_table, score_foreign_case
from workflow.proof.scoring import read_answers


def main(snakemake: Any) -> None:
    """Run as a rule's script."""
    folder, keys = Path(snakemake.input.cases), Path(snakemake.input.opened)
    answers = read_answers(snakemake.input.answers)
    rows = [score_foreign_case(name, folder / name, keys, answer) for name, answer in answers.items()]
    write_table(snakemake.output.table, foreign_score_table(rows))


if __name__ == "__main__":
    with job(snakemake):  # type: ignore[name-defined]  # noqa: F821 (Snakemake puts it here)
        main(snakemake)  # type: ignore[name-defined]  # noqa: F821
