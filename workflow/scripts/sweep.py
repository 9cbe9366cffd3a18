"""Put the points of a sweep together: files in, one step, tables out."""

from workflow.warm import run_warm

run_warm()

from siq.systems.cards import load_system
from siq.workflow.sweep_step import SweepSettings, collected, read_point, write_tables
from step import job

if __name__ == "__main__":
    with job() as now:
        settings = now.settings(SweepSettings)
        points = [read_point(path) for path in now.input.points]
        found = collected(load_system(now.input.card), settings.names, points, noise=settings.noise)
        names = ("sweep", "sweep_ways", "branches", "bifurcations", "bifurcation_curves")
        write_tables(found, {name: now.output[name] for name in names})
