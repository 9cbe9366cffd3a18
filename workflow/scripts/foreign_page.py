"""The page of the second proof: every target, what was measured, and the cases that count against it."""

from workflow.warm import run_warm

run_warm()

from pathlib import Path
from typing import Any

import yaml

from proof_page import HELP, answer
from siq.numerics.files import whole_file
from siq.report.page import ReportContent, ReportFigure, ReportSection, ReportTable, render_report
from siq.report.plots.style import save_figure
from siq.workflow.tables import read_table, write_table
from step import job
from workflow.proof.foreign_scores.rulers import NEAR
from workflow.proof.foreign_scores.scores import ENOUGH
from workflow.proof.foreign_scores.targets import foreign_failures, foreign_targets
from workflow.proof.plots import plot_foreign_proof
from workflow.proof.targets import target_table

QUESTION = (
    "What does the diagnosis say where no dictionary has what is missing? Systems are drawn at random, and so"
    " are the functions that they lack: of one coordinate or two, in an equation or a sensor. Sensors round,"
    " lose samples, and have clocks that jitter.",
    "Beside each diagnosis stands an oracle: scipy's least squares with the drawn function in place. A place"
    " is asked for where the oracle can tell it, and a gain where that is twice its error. A name is right"
    f" only if the named function is the drawn one within {100 * NEAR:.0f} %, up to what free parameters do.",
)
CAPTION = (
    "Left: share of the oracle's gain on held-out recordings; dashed: what was to be reached. Right: share of"
    " right places, with the number of cases."
)


def main(snakemake: Any) -> None:
    """Run as a rule's script."""
    scores = read_table(snakemake.input.scores)
    targets = foreign_targets(scores)
    stem = Path(snakemake.output.figure).with_suffix("")
    write_table(snakemake.output.targets, target_table(targets))
    save_figure(plot_foreign_proof(scores, enough=ENOUGH), stem)
    lists = [
        ReportTable(said, frame, rows_shown=200) for said, frame in foreign_failures(scores) if len(frame)
    ]
    settings = snakemake.params.settings
    content = ReportContent(
        title=snakemake.params.title,
        answer=answer(targets, scores),
        sections=[
            ReportSection(
                "What was asked, and what was measured",
                QUESTION,
                tables=[
                    ReportTable("Targets and what was measured.", target_table(targets), HELP, rows_shown=100)
                ],
                figures=[ReportFigure(CAPTION, CAPTION, stem.with_suffix(".png").read_bytes(), "png")],
            ),
            ReportSection("Cases that count against it", tables=lists),
            ReportSection("How to run it again", listing=snakemake.params.command),
            ReportSection("Settings", listing=yaml.safe_dump(settings, sort_keys=False), folded=True),
        ],
    )
    with whole_file(snakemake.output.html) as partial:
        partial.write_text(render_report(content), encoding="utf-8")


if __name__ == "__main__":
    with job(snakemake):  # type: ignore[name-defined]  # noqa: F821 (Snakemake puts it here)
        main(snakemake)  # type: ignore[name-defined]  # noqa: F821
