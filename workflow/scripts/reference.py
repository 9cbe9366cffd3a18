"""References for the landscape of a card: files in, one step, files out."""

from workflow.warm import run_warm

run_warm()

from siq.quasipotential.landscape_comparison import write_reference
from siq.systems.cards import load_system
from siq.workflow import comparison_steps
from step import job

if __name__ == "__main__":
    with job() as now:
        found = comparison_steps.run(
            now.settings(comparison_steps.ReferenceSettings), load_system(now.input.card)
        )
        write_reference(now.output[0], found)
