"""Hold the landscapes of all runs against that of the card's equations: files in, one step, a table out."""

from workflow.warm import run_warm

run_warm()

from siq.dynamics.cards import load_system
from siq.steps import beside_equations
from siq.study.tables import write_table
from step import job, read_json

if __name__ == "__main__":
    with job() as now:
        settings = now.settings(beside_equations.BesideEquationsSettings)
        runs = [read_json(path) for path in now.input.landscapes]
        write_table(now.output.table, beside_equations.run(settings, load_system(now.input.card), runs))
