"""Refine the formulas of a run and certify them: files in, one step, files out."""

from workflow.warm import run_warm

run_warm()

from siq.quasipotential.formulas import read_model
from siq.workflow import identification_step, refinement_step
from siq.workflow.outcomes import Method
from siq.workflow.recordings_step import read_run
from siq.workflow.training_step import read_trained
from step import job

if __name__ == "__main__":
    with job() as now:
        model = now.given("model")
        given = refinement_step.RunToRefine(
            recordings=read_run(now.input.recordings),
            identified=identification_step.read(now.input.field, now.input.identified),
            trained=read_trained(now.given("networks"), now.given("outcome"), number=now.run),
            regressed=None if model is None else read_model(model)[0].get(Method.REGRESSION),
        )
        refined = refinement_step.run(now.settings(refinement_step.RefineSettings), given)
        names = ("model", "outcome", "record", "record_density")
        refinement_step.write(refined, **{name: now.output[name] for name in names})
