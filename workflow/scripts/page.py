"""Write the report of a study: files in, one function, files out."""

from workflow.warm import run_warm

run_warm()

from importlib.metadata import version
from pathlib import Path

import siq
from siq.files.whole import whole_file
from siq.report.answer import answer_of, write_answer
from siq.report.page import render_report
from siq.report.settings import PageSettings
from siq.report.study_page import StudyResults, study_page
from siq.steps.outcomes import Method
from siq.steps.shown import ModelFiles, shown_formula
from siq.study.scoring import exact_answer
from siq.study.tables import COLUMNS, read_table
from step import job

PACKAGES = ("torch", "numpy", "pysindy", "snakemake")

if __name__ == "__main__":
    with job() as now:
        tables = {name: read_table(path) for name in COLUMNS if (path := now.given(name)) is not None}
        models = ModelFiles(tuple(now.input.models))
        shown, card = shown_formula(tables["rrmse"], models), now.given("card")
        images = [*now.input.figures, *now.input.landscape_figures]
        results = StudyResults(
            tables,
            Path(now.input.summary).parent,
            models,
            shown if shown.run is not None else models.first_wells(),
            None if card is None else exact_answer(card),
            {Path(path).stem: Path(path).read_bytes() for path in images},
        )
        study = now.settings(PageSettings).study
        page = study_page(
            study,
            results,
            command=now.params.command,
            versions={"siq": siq.__version__} | {name: version(name) for name in PACKAGES},
        )
        with whole_file(now.output.html) as partial:
            partial.write_text(render_report(page), encoding="utf-8")
        answer = answer_of(
            page.title,
            " ".join(page.answer[:1]),
            rrmse=tables["rrmse"],
            outcomes=tables["outcomes"],
            formulas=len(models.with_any_formula(Method.REFINED)),
            runs=study.runs,
        )
        write_answer(now.output.answer, answer)
