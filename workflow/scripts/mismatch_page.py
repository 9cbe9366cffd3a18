"""Write the report of a diagnosis: one page that needs nothing else."""

from workflow.warm import run_warm

run_warm()

import json
from pathlib import Path
from typing import Any

import pandas as pd

from siq.diagnosis.dictionary import dictionary_of
from siq.diagnosis.study import MismatchStudy, load_mismatch_study
from siq.numerics.files import whole_file
from siq.report.diagnosis_page import mismatch_answer, mismatch_page
from siq.report.diagnosis_sections import Findings
from siq.systems.cards import load_system
from siq.workflow.tables import read_table
from step import job, read_json


def main(snakemake: Any) -> None:
    """Run as a rule's script."""
    source = snakemake.input
    study = load_mismatch_study(source.study) if source.get("study") else MismatchStudy()
    findings = Findings(
        verdict=read_json(source.verdict),
        before=load_system(source.card),
        after=load_system(source.system),
        dictionary=dictionary_of(without=study.without, further=study.mechanisms, file="the study"),
        candidates=read_table(source.candidates),
        figures={
            Path(path).stem: Path(path).read_bytes() for path in sorted(Path(source.figures).glob("*.svg"))
        },
        wells=read_table(source.wells),
        escape=read_table(source.escape),
        notes=read_json(source.notes),
        scores=read_table(source.scores) if source.get("scores") else pd.DataFrame(),
        held_out=read_table(source.held_out),
        folder=str(Path(source.candidates).parent),
    )
    commands = [
        snakemake.params.command,
        f"# the simulation with what was found, a system card like any other: {source.system}",
    ]
    with whole_file(snakemake.output.html) as partial:
        partial.write_text(
            mismatch_page(findings, title=snakemake.params.title, commands=commands), encoding="utf-8"
        )
    answer = mismatch_answer(findings.verdict, title=snakemake.params.title)
    with whole_file(snakemake.output.answer) as partial:
        partial.write_text(json.dumps(answer, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


if __name__ == "__main__":
    with job(snakemake):  # type: ignore[name-defined]  # noqa: F821 (Snakemake puts it here)
        main(snakemake)  # type: ignore[name-defined]  # noqa: F821
