"""Identify f of a run: files in, one step, files out."""

from workflow.warm import run_warm

run_warm()

from siq.workflow import identification_step
from siq.workflow.recordings_step import read_run
from step import job

if __name__ == "__main__":
    with job() as now:
        settings = now.settings(identification_step.IdentifySettings)
        found = identification_step.run(settings, read_run(now.input.recordings), number=now.run)
        identification_step.write(found, settings, field=now.output.field, outcome=now.output.outcome)
