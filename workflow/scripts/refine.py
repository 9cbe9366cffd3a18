"""Refine the formulas of a run and certify them: files in, one step, files out."""

from workflow.warm import run_warm

run_warm()

from siq.potential.storage import read_model
from siq.steps import identify, refine
from siq.steps.files import read_run
from siq.steps.outcomes import Method
from siq.steps.trained import read_trained
from step import job

if __name__ == "__main__":
    with job() as now:
        model = now.given("model")
        given = refine.RunToRefine(
            recordings=read_run(now.input.recordings),
            identified=identify.read(now.input.field, now.input.identified),
            trained=read_trained(now.given("networks"), now.given("outcome"), number=now.run),
            regressed=None if model is None else read_model(model)[0].get(Method.REGRESSION),
        )
        refined = refine.run(now.settings(refine.RefineSettings), given)
        names = ("model", "outcome", "record", "record_density")
        refine.write(refined, **{name: now.output[name] for name in names})
