"""Simulate escapes beside the law: files in, one step, files out."""

from workflow.warm import run_warm

run_warm()

from siq.dynamics.cards import load_system
from siq.steps import escapes
from siq.study.tables import write_table
from step import job, read_json

if __name__ == "__main__":
    with job() as now:
        landscapes = [read_json(path) for path in now.input.landscapes]
        settings = now.settings(escapes.EscapesSettings)
        write_table(now.output.table, escapes.run(settings, load_system(now.input.card), landscapes))
