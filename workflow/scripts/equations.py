"""Find the landscape of equations: a card in, one step, files out."""

from workflow.warm import run_warm

run_warm()

from siq.quasipotential.landscape_assembly import EquationSettings
from siq.systems.cards import load_system
from siq.workflow import equations_step
from step import job

if __name__ == "__main__":
    with job() as now:
        found = equations_step.run(now.settings(EquationSettings), load_system(now.input.card))
        names = ("landscape", "degrees", "certificates", "outcomes")
        equations_step.write(
            found,
            quasipotential=now.output.quasipotential,
            tables={name: now.output[name] for name in names},
        )
