"""Regress formulas from the networks of a run: files in, one step, files out."""

from workflow.warm import run_warm

run_warm()

import pysindy  # noqa: F401 (once for all runs: it takes seconds)

from siq.workflow import regression_step
from siq.workflow.recordings_step import read_run
from siq.workflow.training_step import read_trained
from step import job

if __name__ == "__main__":
    with job() as now:
        trained = read_trained(now.input.networks, now.input.outcome, number=now.run)
        settings = now.settings(regression_step.RegressSettings)
        regressed = regression_step.run(settings, read_run(now.input.recordings), trained)
        regression_step.write(regressed, model=now.output.model, outcome=now.output.outcome)
