"""Draw and write the page of a study of equations: files in, one function, files out."""

from workflow.warm import run_warm

run_warm()

import shutil
from importlib.metadata import version
from pathlib import Path

from markupsafe import Markup

import siq
from siq.numerics.files import whole_file
from siq.quasipotential.landscape_files import read_landscape
from siq.report.answers import write_answer
from siq.report.equations_page import (
    TABLES,
    EquationsResults,
    answer_of_equations,
    drawn_of,
    equations_figures,
    equations_page,
)
from siq.report.page import interactive_view, render_report
from siq.report.plots import save_figure
from siq.report.settings import PageSettings
from siq.systems.cards import load_system
from siq.workflow.tables import read_table
from step import job

if __name__ == "__main__":
    with job() as now:
        system = load_system(now.input.card)
        stored = read_landscape(now.input.quasipotential, dynamics=system)
        names = ("landscape", "degrees", "certificates", "outcomes")
        tables = {name: read_table(now.input[name]) for name in names}
        asked = (*TABLES, "invariant", "well_shares")
        tables |= {name: read_table(path) for name in asked if (path := now.given(name)) is not None}
        study = now.settings(PageSettings).study
        drawn = Path(now.output.figures)
        drawn.mkdir(parents=True, exist_ok=True)
        for name, figure in equations_figures(system, stored, tables, study).items():
            if figure is not None:
                save_figure(figure, drawn / name)
        if (density := now.given("density")) is not None:
            shutil.copytree(density, drawn, dirs_exist_ok=True)
        view = None
        if stored is not None and system.dimension > 2:
            view = Markup(interactive_view(drawn_of(system, stored)))
        results = EquationsResults(
            system,
            stored,
            tables,
            Path(now.input.landscape).parent,
            images={path.stem: path.read_bytes() for path in sorted(drawn.glob("*.png"))},
            vectors={path.stem: path.read_bytes() for path in sorted(drawn.glob("*.svg"))},
            interactive=view,
        )
        versions = {"siq": siq.__version__} | {name: version(name) for name in ("numpy", "snakemake")}
        page = equations_page(study, results, command=now.params.command, versions=versions)
        with whole_file(now.output.html) as partial:
            partial.write_text(render_report(page), encoding="utf-8")
        write_answer(now.output.answer, answer_of_equations(page, results))
