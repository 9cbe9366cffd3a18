"""Hold the landscapes of all runs against that of the card's equations: files in, one step, a table out."""

from workflow.warm import run_warm

run_warm()

from siq.systems.cards import load_system
from siq.workflow import comparison_steps
from siq.workflow.tables import write_table
from step import job, read_json

if __name__ == "__main__":
    with job() as now:
        settings = now.settings(comparison_steps.BesideEquationsSettings)
        runs = [read_json(path) for path in now.input.landscapes]
        write_table(
            now.output.table,
            comparison_steps.run_beside_equations(settings, load_system(now.input.card), runs),
        )
