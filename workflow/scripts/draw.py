"""Draw the trajectories of a run: simulate its system, or resample its recordings."""

from pathlib import Path
from typing import Any

from siq.errors import NumericalFailure
from siq.randomness import generator
from siq.recordings import Recordings, read_pairs, resample_recordings, write_recordings
from siq.simulate import SimulationOptions, simulate_snapshots
from siq.systems import load_system
from step import job, outcome, pair_step, write_outcomes


def draw(source: str, run: int, study: dict[str, Any]) -> Recordings:
    """The recordings of one run; run 0 of recorded data takes them all, further runs resample them."""
    if study["recordings"] is None:
        options = SimulationOptions(**study["simulation"])
        return simulate_snapshots(
            load_system(source), options=options, generator=generator(study["seed"], run, "simulate")
        )
    metric = study["metric"]
    recordings, _ = read_pairs(
        source, states=metric["states"], units=metric["units"], pair_step=pair_step(study)
    )
    if run == 0:
        return recordings
    return resample_recordings(recordings, generator=generator(study["seed"], run, "resample"))


def main(snakemake: Any) -> None:
    """Run as a rule's script."""
    run = int(snakemake.wildcards.run)
    study = snakemake.params.study
    step = "simulate" if study["recordings"] is None else "resample"
    try:
        write_recordings(snakemake.output.recordings, draw(snakemake.input.source, run, study))
        result = outcome(run, step)
    except NumericalFailure as error:
        Path(snakemake.output.recordings).touch()
        result = outcome(run, step, "failed", str(error))
    write_outcomes(snakemake.output.outcome, [result])


if __name__ == "__main__":
    with job(snakemake):  # type: ignore[name-defined]  # noqa: F821 (Snakemake puts it here)
        main(snakemake)  # type: ignore[name-defined]  # noqa: F821
