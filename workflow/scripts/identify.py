"""Identify f of a run: files in, one step, files out."""

from workflow.warm import run_warm

run_warm()

from siq.steps import identify
from siq.steps.files import read_run
from step import job

if __name__ == "__main__":
    with job() as now:
        settings = now.settings(identify.IdentifySettings)
        found = identify.run(settings, read_run(now.input.recordings), number=now.run)
        identify.write(found, settings, field=now.output.field, outcome=now.output.outcome)
