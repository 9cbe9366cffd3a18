"""Hold the landscapes of all runs against the references: files in, one step, files out."""

from workflow.warm import run_warm

run_warm()

from siq.landscape.reference import read_reference
from siq.potential.storage import read_model
from siq.steps import landscape_errors
from siq.steps.landscapes import read_stored
from siq.steps.trained import read_trained
from siq.study.published import mesh_potential
from siq.study.published_figures import load_published
from siq.study.tables import write_table
from step import job

if __name__ == "__main__":
    with job() as now:
        settings = now.settings(landscape_errors.LandscapeErrorsSettings)
        source = now.input
        trained = list(zip(source.networks, source.training, strict=True))
        runs = [
            landscape_errors.RunToCompare(
                number,
                read_stored(field, landscape),
                read_model(model)[0],
                read_trained(*(trained[number] if trained else (None, None)), number=number).networks,
            )
            for number, (field, landscape, model) in enumerate(
                zip(source.fields, source.landscapes, source.models, strict=True)
            )
        ]
        published, mesh = None, None
        if (file := now.given("published")) is not None:
            figures = load_published(file)
            if (path := now.given("mesh")) is not None and figures.mesh is not None:
                mesh = mesh_potential(path, figures.mesh)
            published = landscape_errors.PublishedAnswers(figures.figures, mesh)
        table = landscape_errors.run(settings, read_reference(source.reference), runs, published)
        write_table(now.output.table, table)
