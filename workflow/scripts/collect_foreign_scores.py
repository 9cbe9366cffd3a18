"""Join the scores of all batches of random systems in one table."""

from workflow.warm import run_warm

run_warm()

from typing import Any

import pandas as pd

from siq.workflow.tables import read_table, write_table
from step import job
from workflow.proof.foreign_scores.scores import foreign_score_table


def main(snakemake: Any) -> None:
    """Run as a rule's script."""
    tables: list[pd.DataFrame] = [read_table(path) for path in snakemake.input]
    rows = [{str(name): row[name] for name in row} for table in tables for row in table.to_dict("records")]
    write_table(snakemake.output.table, foreign_score_table(rows))


if __name__ == "__main__":
    with job(snakemake):  # type: ignore[name-defined]  # noqa: F821 (Snakemake puts it here)
        main(snakemake)  # type: ignore[name-defined]  # noqa: F821
