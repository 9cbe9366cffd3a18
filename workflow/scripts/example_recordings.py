"""Make the recordings of the example: trajectories of a card, as if they were measured."""

from workflow.warm import run_warm

run_warm()

from siq.data.recordings import write_recordings
from siq.numerics.randomness import Purpose, generator
from siq.systems.cards import load_system
from siq.systems.simulation import SimulationOptions, simulate_snapshots
from step import job

if __name__ == "__main__":
    with job() as now:
        recordings = simulate_snapshots(
            load_system(now.input.card),
            options=SimulationOptions(**now.params.simulation),
            generator=generator(now.params.seed, now.params.run, Purpose.SIMULATE),
        )
        write_recordings(now.output.recordings, recordings)
