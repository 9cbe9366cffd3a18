"""Collect the tables of all runs of a study: files in, one step, files out."""

from workflow.warm import run_warm

run_warm()

from pathlib import Path

from siq.workflow import collection_steps
from siq.workflow.outcomes import read_outcomes
from siq.workflow.published import load_published
from siq.workflow.tables import read_table, write_table
from step import job

if __name__ == "__main__":
    with job() as now:
        parts = {name: [read_table(path) for path in now.input[name]] for name in collection_steps.OF_RUNS}
        outcomes = [one for path in now.input.outcomes for one in read_outcomes(path)]
        published = now.given("published")
        tables = collection_steps.run(
            parts,
            outcomes,
            {} if published is None else load_published(published).figures,
            benchmarks=Path(now.params.benchmarks),
        )
        for name, table in tables.items():
            write_table(now.output[name], table)
