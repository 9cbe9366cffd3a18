"""Write the report of a study: files in, one function, files out."""

from workflow.warm import run_warm

run_warm()

from collections.abc import Iterable
from importlib.metadata import version
from pathlib import Path

from markupsafe import Markup

import siq
from siq.inference.identification import read_field
from siq.numerics.files import whole_file
from siq.report.figures import read_inspection, read_seen
from siq.report.page import render_report
from siq.report.study_page import PageSettings, StudyResults, answer_data, study_page, write_answer
from siq.report.summary import summarise
from siq.workflow.collection_steps import ModelFiles, shown_formula
from siq.workflow.scoring import exact_answer
from siq.workflow.tables import COLUMNS, read_table
from step import job, read_json

PACKAGES = ("numpy", "snakemake")
OF_NETWORKS = ("torch", "pysindy")


def files(folders: Iterable[str], suffix: str) -> dict[str, bytes]:
    """What was drawn, by name."""
    found = [path for folder in folders for path in sorted(Path(folder).glob(f"*{suffix}"))]
    return {path.stem: path.read_bytes() for path in found}


if __name__ == "__main__":
    with job() as now:
        source, study = now.input, now.settings(PageSettings).study
        tables = {name: read_table(path) for name in COLUMNS if (path := now.given(name)) is not None}
        models = ModelFiles(tuple(source.models))
        shown, card = shown_formula(tables["rrmse"], models), now.given("card")
        shown = shown if shown.run is not None else models.first_wells()
        overview = read_json(source.overview)
        landscape = None if overview is None else summarise(overview, record=tables["record"])
        run = shown.run if shown.run is not None else (overview or {}).get("run", 0)
        view = Path(source.drawn) / "interactive.html"
        folders = [source.drawn, *source.drawn_landscape, source.drawn_density]
        results = StudyResults(
            tables,
            Path(source.summary).parent,
            images=files(folders, ".png"),
            vectors=files(folders, ".svg"),
            landscape=landscape,
            models=models,
            shown=shown,
            exact=None if card is None else exact_answer(card),
            record=read_field(source.fields[run]),
            inspection=read_inspection(source.drawn),
            seen=read_seen(source.drawn),
            interactive=Markup(view.read_text(encoding="utf-8")) if view.is_file() else None,
        )
        programs = PACKAGES if study.training is None else (*PACKAGES, *OF_NETWORKS)
        versions = {"siq": siq.__version__} | {name: version(name) for name in programs}
        page = study_page(study, results, command=now.params.command, versions=versions)
        gathered = Path(now.output.figures)
        gathered.mkdir(parents=True, exist_ok=True)
        for suffix in (".png", ".svg"):
            for name, content in files(folders, suffix).items():
                (gathered / f"{name}{suffix}").write_bytes(content)
        with whole_file(now.output.html) as partial:
            partial.write_text(render_report(page), encoding="utf-8")
        write_answer(now.output.answer, answer_data(page, study, results))
