"""Draw the landscape: files in, one function, files out."""

from workflow.warm import run_warm

run_warm()

from pathlib import Path

import pandas as pd

from siq.quasipotential.formulas import read_model
from siq.quasipotential.landscape_comparison import read_reference
from siq.report.figures import LandscapeFiguresSettings, landscape_figures
from siq.report.plots.style import save_figure
from siq.workflow.comparison_steps import first_stored
from siq.workflow.published import load_published, mesh_potential
from siq.workflow.tables import read_table
from siq.workflow.training_step import read_trained
from step import job

if __name__ == "__main__":
    with job() as now:
        source, settings = now.input, now.settings(LandscapeFiguresSettings)
        found, networks, formulas = first_stored(source.fields, source.landscapes), None, None
        if found is not None:
            run = found[0]
            trained = (source.networks[run], source.training[run]) if source.networks else (None, None)
            formulas, networks = (
                read_model(source.models[run])[0],
                read_trained(*trained, number=run).networks,
            )
        figures, mesh = None, None
        if (file := now.given("published")) is not None:
            figures = load_published(file)
            if (path := now.given("mesh")) is not None and figures.mesh is not None:
                mesh = mesh_potential(path, figures.mesh)
        reference, escape = now.given("reference"), now.given("escape")
        made = landscape_figures(
            settings,
            degrees=read_table(source.degrees),
            escape=pd.DataFrame() if escape is None else read_table(escape),
            landscape=None if found is None else found[1],
            reference=None if reference is None else read_reference(reference),
            networks=networks,
            formulas=formulas,
            published=None if figures is None else figures.figures,
            mesh=mesh,
        )
        drawn = Path(now.params.folder)
        drawn.mkdir(parents=True, exist_ok=True)
        for name, figure in made.items():
            if figure is not None:
                save_figure(figure, drawn / name)
