"""The table of recordings of a public benchmark, from its file as downloaded."""

from workflow.warm import run_warm

run_warm()

from typing import Any

from siq.data.public_recordings import BENCHMARKS
from siq.data.recordings import write_recordings
from step import job


def main(snakemake: Any) -> None:
    """Run as a rule's script."""
    one = BENCHMARKS[snakemake.wildcards.benchmark]
    write_recordings(snakemake.output.recordings, one.read(snakemake.input.file))


if __name__ == "__main__":
    with job(snakemake):  # type: ignore[name-defined]  # noqa: F821 (Snakemake puts it here)
        main(snakemake)  # type: ignore[name-defined]  # noqa: F821
