"""The invariant distribution of equations: a card and its landscape in, one step, files out."""

from workflow.warm import run_warm

run_warm()

from pathlib import Path

from siq.dynamics.cards import load_system
from siq.landscape.storage import read_landscape
from siq.report.plots import plot_invariant_distribution, save_figure
from siq.steps import invariant
from siq.study.tables import write_table
from step import job

if __name__ == "__main__":
    with job() as now:
        settings = now.settings(invariant.InvariantSettings)
        system = load_system(now.input.card)
        stored = read_landscape(now.input.quasipotential, dynamics=system)
        shown = None if stored is None else invariant.LandscapeShown(0, stored)
        found = invariant.run(settings, system, shown, {})
        drawn = Path(now.output.drawn)
        drawn.mkdir(parents=True, exist_ok=True)
        if found.densities:
            names = system.states
            units = [settings.space.unit(name) for name in names]
            figure = plot_invariant_distribution(found.densities, states=names, units=units)
            if figure is not None:
                save_figure(figure, drawn / "invariant")
        write_table(now.output.table, found.table)
        write_table(now.output.shares, found.shares)
