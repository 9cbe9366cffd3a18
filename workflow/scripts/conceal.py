"""Conceal effects in the cases of a batch; of their keys only the digests are left."""

from workflow.warm import run_warm

run_warm()

import json
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from siq.numerics.files import whole_file
from step import job
from workflow.proof.batches import write_batch
from workflow.proof.concealment import cases as generator


def main(snakemake: Any) -> None:
    """Run as a rule's script."""
    with TemporaryDirectory() as keys:
        digests = write_batch(
            snakemake.params.settings,
            int(snakemake.wildcards.batch),
            generator=generator,
            cases=Path(snakemake.output.cases),
            keys=Path(keys),
        )
    with whole_file(snakemake.output.digests) as partial:
        partial.write_text(json.dumps(digests, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    with job(snakemake):  # type: ignore[name-defined]  # noqa: F821 (Snakemake puts it here)
        main(snakemake)  # type: ignore[name-defined]  # noqa: F821
