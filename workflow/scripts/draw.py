"""Draw the trajectories of a run: files in, one step, files out."""

from workflow.warm import run_warm

run_warm()

from siq.steps import draw
from step import job

if __name__ == "__main__":
    with job() as now:
        settings = now.settings(draw.DrawSettings)
        drawn = draw.run(settings, draw.read(now.input.source, settings), number=now.run)
        draw.write(drawn, recordings=now.output.recordings, outcome=now.output.outcome)
