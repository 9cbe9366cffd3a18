"""Draw and write the page of a study of equations: files in, one function, files out."""

from workflow.warm import run_warm

run_warm()

import shutil
from importlib.metadata import version
from pathlib import Path

import numpy as np

import siq
from siq.numerics.files import whole_file
from siq.quasipotential.landscape_files import read_landscape
from siq.report.figures import equations_figures
from siq.report.page import interactive_view, render_report
from siq.report.plots import save_figure
from siq.report.study_page import PageSettings, StudyResults, answer_data, study_page, write_answer
from siq.report.summary import summarise
from siq.systems.cards import load_system
from siq.workflow.tables import COLUMNS, read_table
from step import job

if __name__ == "__main__":
    with job() as now:
        system = load_system(now.input.card)
        stored = read_landscape(now.input.quasipotential, dynamics=system)
        tables = {name: read_table(path) for name in COLUMNS if (path := now.given(name)) is not None}
        summary = None if stored is None else summarise(stored, np.zeros((0, system.dimension)))
        study = now.settings(PageSettings).study
        drawn = Path(now.output.figures)
        drawn.mkdir(parents=True, exist_ok=True)
        for name, figure in equations_figures(system, summary, tables, study).items():
            if figure is not None:
                save_figure(figure, drawn / name)
        if (density := now.given("density")) is not None:
            shutil.copytree(density, drawn, dirs_exist_ok=True)
        view = None
        if summary is not None and system.dimension > 2:
            view = interactive_view(summary)
        certificate = None if stored is None else stored.certificate
        results = StudyResults(
            tables,
            Path(now.input.landscape).parent,
            images={path.stem: path.read_bytes() for path in sorted(drawn.glob("*.png"))},
            vectors={path.stem: path.read_bytes() for path in sorted(drawn.glob("*.svg"))},
            landscape=summary,
            interactive=view,
            system=system,
            certificate=None if certificate is None else certificate.as_data(),
        )
        versions = {"siq": siq.__version__} | {name: version(name) for name in ("numpy", "snakemake")}
        page = study_page(study, results, command=now.params.command, versions=versions)
        with whole_file(now.output.html) as partial:
            partial.write_text(render_report(page), encoding="utf-8")
        write_answer(now.output.answer, answer_data(page, study, results))
