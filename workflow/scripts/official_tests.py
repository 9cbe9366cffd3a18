"""How far simulations of a public benchmark are off in its official tests, in its own units."""

from workflow.warm import run_warm

run_warm()

from typing import Any

from siq.data.public_recordings import BENCHMARKS
from siq.diagnosis.study import read_case
from siq.systems.cards import load_system
from siq.workflow.tables import read_table, write_table
from step import job
from workflow.reproduction.official_scores import official_tables


def main(snakemake: Any) -> None:
    """Run as a rule's script."""
    source = snakemake.input
    case = read_case(source.card, source.recordings, source.get("study") or None)
    noise = read_table(source.noise)
    own = noise[(noise["stage"] == "recalibrated") & (noise["kind"] == "measurement")]
    errors, runs = official_tables(
        BENCHMARKS[snakemake.params.benchmark],
        {"recalibrated": load_system(source.recalibrated), "augmented": load_system(source.system)},
        case.kept,
        variance=own["variance"].to_numpy(float),
    )
    write_table(snakemake.output.table, errors)
    write_table(snakemake.output.runs, runs)


if __name__ == "__main__":
    with job(snakemake):  # type: ignore[name-defined]  # noqa: F821 (Snakemake puts it here)
        main(snakemake)  # type: ignore[name-defined]  # noqa: F821
