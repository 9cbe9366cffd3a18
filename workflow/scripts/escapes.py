"""Simulate escapes beside the law: files in, one step, files out."""

from workflow.warm import run_warm

run_warm()

from siq.systems.cards import load_system
from siq.workflow import comparison_steps
from siq.workflow.tables import write_table
from step import job, read_json

if __name__ == "__main__":
    with job() as now:
        landscapes = [read_json(path) for path in now.input.landscapes]
        settings = now.settings(comparison_steps.EscapesSettings)
        write_table(
            now.output.table, comparison_steps.run_escapes(settings, load_system(now.input.card), landscapes)
        )
