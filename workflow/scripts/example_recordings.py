"""Make the recordings of the example: trajectories of the archetypal system, as if they were measured."""

from typing import Any

from siq.randomness import generator
from siq.recordings import write_recordings
from siq.simulate import SimulationOptions, simulate_snapshots
from siq.systems import load_system
from step import job


def main(snakemake: Any) -> None:
    """Run as a rule's script."""
    params = snakemake.params
    recordings = simulate_snapshots(
        load_system(snakemake.input.card),
        options=SimulationOptions(**params.simulation),
        generator=generator(params.seed, params.run, "simulate"),
    )
    write_recordings(snakemake.output.recordings, recordings)


if __name__ == "__main__":
    with job(snakemake):  # type: ignore[name-defined]  # noqa: F821 (Snakemake puts it here)
        main(snakemake)  # type: ignore[name-defined]  # noqa: F821
