"""Hold the landscapes of all runs against the references: files in, one step, files out."""

from workflow.warm import run_warm

run_warm()

from siq.quasipotential.formulas import read_model
from siq.quasipotential.landscape_comparison import read_reference
from siq.workflow import comparison_steps
from siq.workflow.comparison_steps import read_stored
from siq.workflow.published import load_published, mesh_potential
from siq.workflow.tables import write_table
from siq.workflow.training_step import read_trained
from step import job

if __name__ == "__main__":
    with job() as now:
        settings = now.settings(comparison_steps.LandscapeErrorsSettings)
        source = now.input
        trained = list(zip(source.networks, source.training, strict=True))
        runs = [
            comparison_steps.RunToCompare(
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
            published = comparison_steps.PublishedAnswers(figures.figures, mesh)
        table = comparison_steps.run_landscape_errors(
            settings, read_reference(source.reference), runs, published
        )
        write_table(now.output.table, table)
