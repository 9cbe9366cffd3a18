"""Score the formulas of a run: files in, one step, files out."""

from workflow.warm import run_warm

run_warm()

from siq.quasipotential.formulas import read_model
from siq.systems.cards import load_system
from siq.workflow import scoring_step
from siq.workflow.scoring import exact_answer
from siq.workflow.training_step import read_trained
from step import job

if __name__ == "__main__":
    with job() as now:
        formulas, certificates = read_model(now.input.model)
        card = now.given("card")
        given = scoring_step.RunToScore(
            formulas,
            certificates,
            read_trained(now.given("networks"), now.given("training"), number=now.run),
            None if card is None else load_system(card),
            None if card is None else exact_answer(card),
        )
        scoring_step.write(
            scoring_step.run(now.settings(scoring_step.ScoreSettings), given),
            coefficients=now.output.coefficients,
            rrmse=now.output.rrmse,
            prediction=now.output.prediction,
            certificates=now.output.certificates,
            outcome=now.output.outcome,
        )
