"""Find the landscape of a run: files in, one step, files out."""

from workflow.warm import run_warm

run_warm()

from siq.identify.storage import read_field
from siq.steps import landscape
from siq.steps.files import read_run
from step import job

if __name__ == "__main__":
    with job() as now:
        recordings, record = read_run(now.input.recordings), read_field(now.input.field)
        settings = now.settings(landscape.LandscapeSettings)
        wells = landscape.read_wells(now.input.model)
        found = landscape.run(settings, recordings, record, wells=wells, number=now.run)
        landscape.write(
            found,
            quasipotential=now.output.quasipotential,
            table=now.output.table,
            degrees=now.output.degrees,
            outcome=now.output.outcome,
        )
