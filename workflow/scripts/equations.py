"""Find the landscape of equations: a card in, one step, files out."""

from workflow.warm import run_warm

run_warm()

from siq.dynamics.cards import load_system
from siq.steps import equations
from step import job

if __name__ == "__main__":
    with job() as now:
        found = equations.run(now.settings(equations.EquationSettings), load_system(now.input.card))
        names = ("landscape", "degrees", "certificates", "outcomes")
        equations.write(
            found,
            quasipotential=now.output.quasipotential,
            tables={name: now.output[name] for name in names},
        )
