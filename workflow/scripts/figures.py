"""Draw the figures of a study: files in, one function, files out."""

from workflow.warm import run_warm

run_warm()

from dataclasses import replace
from pathlib import Path

from siq.inference.identification import read_field
from siq.quasipotential.landscape_files import read_landscape
from siq.report.figures import (
    DRAWN_TABLES,
    FiguresSettings,
    inspection_drawn,
    leading_figures,
    representative_run,
    study_figures,
)
from siq.report.page import interactive_view
from siq.report.plots import save_figure
from siq.report.summary import summarise
from siq.systems.cards import load_system
from siq.workflow.collection_steps import ModelFiles, shown_formula
from siq.workflow.comparison_steps import first_stored
from siq.workflow.outcomes import Method
from siq.workflow.published import load_published
from siq.workflow.recordings_step import read_run, read_states
from siq.workflow.scoring import exact_answer
from siq.workflow.tables import read_table
from siq.workflow.training_step import read_trained
from step import job, read_json

if __name__ == "__main__":
    with job() as now:
        source, settings = now.input, now.settings(FiguresSettings)
        card, published = now.given("card"), now.given("published")
        tables = {name: read_table(source[name]) for name in DRAWN_TABLES}
        models = ModelFiles(tuple(source.models))
        chosen = shown_formula(tables["rrmse"], models)
        complete = None
        if chosen.run is None or chosen.method == Method.REGRESSION:
            complete = first_stored(source.fields, source.landscapes)
        shown = representative_run(chosen, models, complete)
        run = shown.number
        trained = (source.networks[run], source.blocks[run]) if source.networks else (None, None)
        shown = replace(
            shown,
            recordings=read_states(source.recordings[run], source.every_field[run]),
            networks=read_trained(*trained, number=run).networks,
            exact=None if card is None else exact_answer(card),
        )
        figures = study_figures(
            settings,
            tables,
            shown,
            None if card is None else load_system(card),
            {} if published is None else load_published(published).figures,
        )
        overview, view = read_json(source.overview), None
        first = run if overview is None else overview["run"]
        record, recorded = read_field(source.every_field[first]), read_run(source.recordings[first])
        if record is not None and recorded is not None:
            dynamics, own = record.found.dynamics, models.formulas(first).get(Method.REFINED)
            stored = read_landscape(source.overview, dynamics=dynamics)
            states = read_states(source.recordings[first], source.every_field[first]) or recorded
            summary = summarise(stored, states, dynamics=dynamics, formula=own)
            figures |= leading_figures(summary, dynamics, states)
            view = interactive_view(summary) if dynamics.dimension > 2 else None
        drawn = Path(now.params.folder)
        drawn.mkdir(parents=True, exist_ok=True)
        if settings.simulation is None and recorded is not None:
            figures |= inspection_drawn(recorded, folder=drawn)
        if view is not None:
            (drawn / "interactive.html").write_text(view, encoding="utf-8")
        for name, figure in figures.items():
            if figure is not None:
                save_figure(figure, drawn / name)
