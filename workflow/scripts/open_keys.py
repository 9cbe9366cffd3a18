"""Make the keys of a batch again, after every diagnosis, and hold them against the published digests."""

from workflow.warm import run_warm

run_warm()

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from step import job
from workflow.proof.batches import check_digests, read_digests, write_batch
from workflow.proof.concealment import cases as generator


def main(snakemake: Any) -> None:
    """Run as a rule's script."""
    with TemporaryDirectory() as cases:
        found = write_batch(
            snakemake.params.settings,
            int(snakemake.wildcards.batch),
            generator=generator,
            cases=Path(cases),
            keys=Path(snakemake.output[0]),
        )
    check_digests(found, read_digests(snakemake.input.digests), file=snakemake.input.digests)


if __name__ == "__main__":
    with job(snakemake):  # type: ignore[name-defined]  # noqa: F821 (Snakemake puts it here)
        main(snakemake)  # type: ignore[name-defined]  # noqa: F821
