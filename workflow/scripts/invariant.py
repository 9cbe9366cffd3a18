"""The invariant distribution of the run that is shown: files in, one step, files out."""

from workflow.warm import run_warm

run_warm()

from pathlib import Path

from siq.quasipotential.landscape_files import read_landscape
from siq.report.plots import plot_invariant_distribution, save_figure
from siq.systems.cards import load_system
from siq.workflow import invariant_step
from siq.workflow.collection_steps import ModelFiles, shown_formula
from siq.workflow.comparison_steps import first_stored
from siq.workflow.outcomes import Method
from siq.workflow.published import load_published
from siq.workflow.tables import read_table, write_table
from step import Job, job


def shown_in(now: Job) -> invariant_step.Shown | None:
    """What the invariant distribution follows from: see `siq.workflow.invariant_step.run`.

    Equations have one landscape, and nothing else that could be shown.
    """
    if (landscape := now.given("quasipotential")) is not None:
        stored = read_landscape(landscape, dynamics=load_system(now.input.card))
        return None if stored is None else invariant_step.LandscapeShown(0, stored)
    models = ModelFiles(tuple(now.input.models))
    shown = shown_formula(read_table(now.input.rrmse), models)
    if shown.run is None or shown.method == Method.REGRESSION:
        complete = first_stored(now.input.fields, now.input.landscapes)
        if complete is not None:
            return invariant_step.LandscapeShown(*complete)
    if shown.run is None:
        return None
    return invariant_step.FormulaShown(shown.run, shown.method, models.formulas(shown.run)[shown.method])


if __name__ == "__main__":
    with job() as now:
        settings = now.settings(invariant_step.InvariantSettings)
        card, published = now.given("card"), now.given("published")
        asked = bool(settings.invariant) and card is not None
        found = invariant_step.run(
            settings,
            load_system(card) if card is not None else None,
            shown_in(now) if asked else None,
            {} if published is None else load_published(published).figures,
        )
        drawn = Path(now.output.drawn)
        drawn.mkdir(parents=True, exist_ok=True)
        if found.densities:
            names, space = settings.space.names or (), settings.space
            units = [space.unit(name) for name in names]
            figure = plot_invariant_distribution(found.densities, states=names, units=units)
            if figure is not None:
                save_figure(figure, drawn / "invariant")
        write_table(now.output.table, found.table)
        write_table(now.output.shares, found.shares)
