"""Choose the landscape that the page opens with, or find it: files in, one step, files out."""

from workflow.warm import run_warm

run_warm()

from functools import partial

from siq.inference.identification import read_field
from siq.workflow import collection_steps
from siq.workflow.collection_steps import ModelFiles, shown_formula
from siq.workflow.landscape_step import LandscapeSettings, read_wells
from siq.workflow.recordings_step import read_run
from siq.workflow.tables import read_table
from step import job, read_json

if __name__ == "__main__":
    with job() as now:
        source, models = now.input, ModelFiles(tuple(now.input.models))
        shown = shown_formula(read_table(source.rrmse), models)
        number = shown.run if shown.run is not None else models.first_wells().run
        found = None
        if now.params.every_run:
            chosen = collection_steps.choose(number, [partial(read_json, path) for path in source.landscapes])
            if chosen is not None:
                found = collection_steps.of_stored(chosen, read_json(source.landscapes[chosen]))
        elif number is not None:
            given = collection_steps.RunToShow(
                number,
                read_run(source.recordings[number]),
                read_field(source.fields[number]),
                read_wells(source.models[number]),
            )
            found = collection_steps.run_overview(now.settings(LandscapeSettings), given)
        collection_steps.write(now.output.overview, found)
