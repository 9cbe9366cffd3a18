"""The page of a proof: every target, what was measured, and the cases that count against it."""

from workflow.warm import run_warm

run_warm()

from pathlib import Path
from typing import Any

import pandas as pd
import yaml

from siq.numerics.files import whole_file
from siq.numerics.text import number_text
from siq.report.page import ReportContent, ReportFigure, ReportSection, ReportTable, render_report
from siq.report.plots.style import save_figure
from siq.workflow.tables import read_table, write_table
from step import job
from workflow.proof.plots import plot_proof
from workflow.proof.targets import STRONG, Target, failures_of, target_table, targets_of

QUESTION = (
    "Does the diagnosis say rightly whether, where and in which way a simulation lacks physics? Each case is"
    " a simulation and recordings in which an effect was concealed, or nothing. The diagnosis had the cases"
    " alone; the keys were opened when it had ended.",
    "Beside each diagnosis stands the oracle: the fit of the true simulation, begun at the true parameters."
    " What it gains in χ² over the recalibrated simulation says how much can be known; from"
    f" {STRONG:g} on, a mechanism has to be named.",
)
HELP = {
    "target": "What was to be reached.",
    "from": "Lower 95 % bound: by Clopper and Pearson for shares, by order statistics for quantiles.",
    "to": "Upper 95 % bound.",
    "of": "Cases, or intervals, that the figure is of.",
    "met": "Whether the measured figure keeps the target.",
}
CAPTION = (
    "Left: the verdicts on each kind of case, numbers of cases; the right verdict is framed. Right: share"
    " of concealed mechanisms within the reported class, against what the oracle gains; dashed: 100."
)


def answer(targets: list[Target], scores: pd.DataFrame) -> list[str]:
    """The answer in sentences."""
    judged = [each for each in targets if each.met is not None]
    missed = [each for each in judged if not each.met]
    sentences = [f"{len(judged) - len(missed)} of {len(judged)} targets are met, in {len(scores)} cases."]
    sentences += [
        f"Not met: {each.name}, {number_text(each.measured)} ({number_text(each.low)} to"
        f" {number_text(each.high)}) instead of {each.limit}."
        for each in missed
    ]
    return sentences


def main(snakemake: Any) -> None:
    """Run as a rule's script."""
    scores = read_table(snakemake.input.scores)
    targets = targets_of(scores)
    stem = Path(snakemake.output.figure).with_suffix("")
    write_table(snakemake.output.targets, target_table(targets))
    save_figure(plot_proof(scores, strong=STRONG), stem)
    settings = snakemake.params.settings
    lists = [(said, frame) for said, frame in failures_of(scores) if len(frame)]
    failed = scores[scores["note"] != ""]
    asked = [*QUESTION]
    if settings is not None and len(scores) < settings["cases"]:
        missing = settings["cases"] - len(scores)
        asked.append(
            f"{missing} of the {settings['cases']} cases are missing, since their motion was not bounded."
        )
    failures = pd.DataFrame({"case": failed["case"], "verdict": failed["verdict"], "reason": failed["note"]})
    tables = [ReportTable(said, frame, rows_shown=200) for said, frame in lists]
    if len(failures):
        tables.append(ReportTable("Cases that the diagnosis could not finish.", failures, rows_shown=200))
    content = ReportContent(
        title=snakemake.params.title,
        answer=answer(targets, scores),
        sections=[
            ReportSection(
                "What was asked, and what was measured",
                asked,
                tables=[
                    ReportTable("Targets and what was measured.", target_table(targets), HELP, rows_shown=100)
                ],
                figures=[ReportFigure(CAPTION, CAPTION, stem.with_suffix(".png").read_bytes(), "png")],
            ),
            ReportSection("Cases that count against it", tables=tables),
            ReportSection("How to run it again", listing=snakemake.params.command),
            *(
                []
                if settings is None
                else [
                    ReportSection("Settings", listing=yaml.safe_dump(settings, sort_keys=False), folded=True)
                ]
            ),
        ],
    )
    with whole_file(snakemake.output.html) as partial:
        partial.write_text(render_report(content), encoding="utf-8")


if __name__ == "__main__":
    with job(snakemake):  # type: ignore[name-defined]  # noqa: F821 (Snakemake puts it here)
        main(snakemake)  # type: ignore[name-defined]  # noqa: F821
