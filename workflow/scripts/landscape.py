"""Find the landscape of a run: files in, one step, files out."""

from workflow.warm import run_warm

run_warm()

from siq.inference.identification import read_field
from siq.workflow import landscape_step
from siq.workflow.recordings_step import read_run
from step import job

if __name__ == "__main__":
    with job() as now:
        recordings, record = read_run(now.input.recordings), read_field(now.input.field)
        settings = now.settings(landscape_step.LandscapeSettings)
        wells = landscape_step.read_wells(now.input.model)
        found = landscape_step.run(settings, recordings, record, wells=wells, number=now.run)
        landscape_step.write(
            found,
            quasipotential=now.output.quasipotential,
            table=now.output.table,
            degrees=now.output.degrees,
            outcome=now.output.outcome,
        )
