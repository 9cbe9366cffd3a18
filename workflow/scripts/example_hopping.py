"""Make the hopping recordings of the example: those that `siq example` writes."""

from workflow.warm import run_warm

run_warm()

from siq.cli.examples import double_well_recordings
from siq.numerics.files import whole_file
from step import job

if __name__ == "__main__":
    with job() as now, whole_file(now.output.recordings) as partial:
        partial.write_text(double_well_recordings(), encoding="utf-8")
