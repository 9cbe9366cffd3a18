"""Draw the trajectories of a run: files in, one step, files out."""

from workflow.warm import run_warm

run_warm()

from siq.workflow import recordings_step
from step import job

if __name__ == "__main__":
    with job() as now:
        settings = now.settings(recordings_step.DrawSettings)
        drawn = recordings_step.run(
            settings, recordings_step.read(now.input.source, settings), number=now.run
        )
        recordings_step.write(drawn, recordings=now.output.recordings, outcome=now.output.outcome)
