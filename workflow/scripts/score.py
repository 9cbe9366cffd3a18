"""Score the formulas of a run: files in, one step, files out."""

from workflow.warm import run_warm

run_warm()

from siq.dynamics.cards import load_system
from siq.potential.storage import read_model
from siq.steps import score
from siq.steps.trained import read_trained
from siq.study.scoring import exact_answer
from step import job

if __name__ == "__main__":
    with job() as now:
        formulas, certificates = read_model(now.input.model)
        card = now.given("card")
        given = score.RunToScore(
            formulas,
            certificates,
            read_trained(now.given("networks"), now.given("training"), number=now.run),
            None if card is None else load_system(card),
            None if card is None else exact_answer(card),
        )
        score.write(
            score.run(now.settings(score.ScoreSettings), given),
            coefficients=now.output.coefficients,
            rrmse=now.output.rrmse,
            prediction=now.output.prediction,
            certificates=now.output.certificates,
            outcome=now.output.outcome,
        )
