"""Score the diagnosis of a case that somebody else made."""

from workflow.warm import run_warm

run_warm()

from pathlib import Path
from typing import Any

from siq.workflow.tables import write_table
from step import job, read_json
from workflow.proof.scoring import Answer, score_case, score_table


def answer_of(verdict: str | Path, card: str | Path) -> Answer:
    """What the diagnosis of a case left behind."""
    said = read_json(verdict)
    if said is None:
        return Answer(None, "", failure="there is no verdict")
    return Answer(said, Path(card).read_text(encoding="utf-8"))


def main(snakemake: Any) -> None:
    """Run as a rule's script."""
    source = snakemake.input
    row = score_case(
        snakemake.wildcards.case,
        Path(source.card).parent,
        Path(source.key[0] if isinstance(source.key, list) else source.key).parent,
        answer_of(source.verdict, source.system),
    )
    write_table(snakemake.output.table, score_table([row]))


if __name__ == "__main__":
    with job(snakemake):  # type: ignore[name-defined]  # noqa: F821 (Snakemake puts it here)
        main(snakemake)  # type: ignore[name-defined]  # noqa: F821
