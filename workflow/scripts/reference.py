"""References for the landscape of a card: files in, one step, files out."""

from workflow.warm import run_warm

run_warm()

from siq.dynamics.cards import load_system
from siq.landscape.reference import write_reference
from siq.steps import reference
from step import job

if __name__ == "__main__":
    with job() as now:
        found = reference.run(now.settings(reference.ReferenceSettings), load_system(now.input.card))
        write_reference(now.output[0], found)
