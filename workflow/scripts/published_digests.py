"""Join the digests of all keys; no case is diagnosed before they are published."""

from workflow.warm import run_warm

run_warm()

import json
from typing import Any

from siq.numerics.files import whole_file
from step import job
from workflow.proof.batches import read_digests


def main(snakemake: Any) -> None:
    """Run as a rule's script."""
    joined: dict[str, str] = {}
    for path in snakemake.input.digests:
        joined |= read_digests(path)
    with whole_file(snakemake.output[0]) as partial:
        partial.write_text(json.dumps(joined, indent=1, sort_keys=True) + "\n", encoding="utf-8")


if __name__ == "__main__":
    with job(snakemake):  # type: ignore[name-defined]  # noqa: F821 (Snakemake puts it here)
        main(snakemake)  # type: ignore[name-defined]  # noqa: F821
