"""The landscape at one point of a sweep: a card in, one step, a file out."""

from workflow.warm import run_warm

run_warm()

from siq.workflow.study import point_values
from siq.workflow.sweep_step import PointSettings, point_at, write_point
from step import job

if __name__ == "__main__":
    with job() as now:
        names, values = point_values(now.wildcards.point)
        write_point(now.output.point, point_at(now.input.card, names, values, now.settings(PointSettings)))
