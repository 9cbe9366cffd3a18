"""Choose the landscape that the page opens with, or find it: files in, one step, files out."""

from workflow.warm import run_warm

run_warm()

from functools import partial

from siq.identify.storage import read_field
from siq.steps import overview
from siq.steps.files import read_run
from siq.steps.landscape import LandscapeSettings, read_wells
from siq.steps.shown import ModelFiles, shown_formula
from siq.study.tables import read_table
from step import job, read_json

if __name__ == "__main__":
    with job() as now:
        source, models = now.input, ModelFiles(tuple(now.input.models))
        shown = shown_formula(read_table(source.rrmse), models)
        number = shown.run if shown.run is not None else models.first_wells().run
        found = None
        if now.params.every_run:
            chosen = overview.choose(number, [partial(read_json, path) for path in source.landscapes])
            if chosen is not None:
                found = overview.of_stored(chosen, read_json(source.landscapes[chosen]))
        elif number is not None:
            given = overview.RunToShow(
                number,
                read_run(source.recordings[number]),
                read_field(source.fields[number]),
                read_wells(source.models[number]),
            )
            found = overview.run(now.settings(LandscapeSettings), given)
        overview.write(now.output.overview, found)
