"""What of a short training makes the difference: one setting at a time is put back, on ten seeds.

    .venv/bin/python -m benchmarks.ablations
    .venv/bin/python -m benchmarks.ablations --table

The paper's system in three dimensions, runs 0 to 9 of the study ``archetype3d``. Every training is a cold
start of its own. Its row goes into ``results/ablations.csv`` as soon as it has ended; a row that is there is
not made again. ``--table`` writes the table of ``docs/how-the-method-works.md`` from what there is.

Asked is what output weights say at the first check: that V is right, that it is on a false branch, or that
the start led nowhere. Then the training goes on as in a study, with further checks and fresh networks. What
it ends with is compared with the exact U, which no training sees, and with the refined V, as every
certificate does. Where it is wrong, its published regression is put to the certificate, too.
"""

import os

os.environ["OMP_NUM_THREADS"] = "1"

import argparse
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import pandas as pd
import torch

from benchmarks.learning_curves import ROOT, RUNS, Run
from siq.networks.decomposition import TrainedNetworks, TrainingOptions
from siq.networks.networks import at_rest
from siq.networks.training import Block, start, train
from siq.numerics.randomness import Purpose, generator
from siq.quasipotential.certificate import certify, check_agreement
from siq.quasipotential.output_weights import OutputWeights
from siq.quasipotential.refinement import RefinementContext
from siq.workflow.pipeline import identify_run, regress_run
from siq.workflow.tables import Outcome, Step, StepResult

TABLE = ROOT / "results" / "ablations.csv"
WRONG = 0.05  # relative error of U above which V is wrong, whatever anything says of it
NO_STEPS, AS_LONG = "no steps", "as long"


@dataclass(frozen=True)
class Ablation:
    """What is put back, in the words of the table: options of the training, or another way to train."""

    name: str
    options: dict[str, Any] = field(default_factory=dict)
    way: str = ""
    steepness: float = 1.0


AS_USUAL = Ablation("as in the study")
ABLATIONS = (
    AS_USUAL,
    Ablation("no steps: V = η_v∣y∣²", way=NO_STEPS),
    Ablation("no steps, a tenth as steep", way=NO_STEPS, steepness=0.1),
    Ablation("no steps, ten times as steep", way=NO_STEPS, steepness=10.0),
    Ablation("published training for as many CPU seconds", way=AS_LONG),
    Ablation("no output weights: 900 steps of Adam", {"check": None}),
    Ablation("`potential_gain: 1`", {"potential_gain": 1.0}),
    Ablation("`normalise_on: pairs`", {"normalise_on": "pairs"}),
    Ablation("both", {"normalise_on": "pairs", "potential_gain": 1.0}),
    Ablation("`representative_share: 0`", {"representative_share": 0.0}),
    Ablation("`orthogonality_weight: 1`", {"orthogonality_weight": 1.0}),
    Ablation("`matching: explicit`", {"matching": "explicit"}),
    Ablation("`precision: float64`", {"precision": "float64"}),
    Ablation("`batch_size: 100`", {"batch_size": 100}),
    Ablation("`decay_rate: 1`", {"decay_rate": 1.0}),
    Ablation("`widths: [50, 50, 50]`", {"widths": (50, 50, 50)}),
    Ablation("`output_weights: 100`", {"output_weights": 100}),
    Ablation("`output_weights: 200`", {"output_weights": 200}),
    Ablation("`output_weights: 800`", {"output_weights": 800}),
)


class Watched(OutputWeights):
    """Output weights that keep what they said at every check."""

    said: tuple[str, ...] = ()
    false = False

    def accepted(self, networks: TrainedNetworks) -> TrainedNetworks | None:
        """As always."""
        self.false = False
        found = super().accepted(networks)
        self.said += ("right" if found is not None else "false" if self.false else "nowhere",)
        return found

    def _leaves(self, *of: Any) -> bool:  # asked only of a V that solves the equation
        leaves = super()._leaves(*of)
        self.false = self.false or not leaves
        return leaves


class Judge:
    """The refined V of a run, which no networks change, and what it says of networks."""

    def __init__(self, run: Run) -> None:
        self.run = run
        self.identified = identify_run(run.settings, run.recordings, number=run.number)
        assert self.identified.result is not None
        self.context = RefinementContext(
            run.recordings, self.identified.result, None, number=run.number, seed=run.settings.seed,
            pair_step=run.settings.sampling.pair_step, refinement=run.settings.refinement,
            limits=run.settings.certificate,
        )  # fmt: skip
        self.refined = self.context.refine_and_certify()

    def __call__(self, networks: TrainedNetworks, *, wrong: bool) -> dict[str, Any]:
        """Whether both routes agree; of networks that are wrong, whether their regression is certified."""
        evidence, formulas = self.context.evidence, self.refined.formulas
        assert formulas.potential is not None
        agreement = check_agreement(networks, formulas, evidence, error=self.refined.certificate.error)
        told = {"agrees": agreement.passed, "reason": agreement.reason, "certified": False}
        if wrong:
            trained = StepResult[Any](networks, Outcome(self.run.number, Step.TRAIN))
            regressed = regress_run(self.run.settings, self.run.recordings, trained).result
            told["certified"] = regressed is not None and certify(regressed, evidence).certified
        return told


@cache
def prepared(run: Run, units: int) -> tuple[Watched, float]:
    """What checks the trainings of a run, which none of them changes, and the CPU seconds that it took."""
    began, draw = time.process_time(), generator(run.settings.seed, run.number, Purpose.UNITS)
    check = Watched(run.data, diffusion=run.system.diffusion, units=units, generator=draw)
    return check, time.process_time() - began


def networks_of(
    ablation: Ablation, run: Run, *, seconds: float
) -> tuple[TrainedNetworks, tuple[str, ...], float]:
    """What a training ends with, what was said at its checks, and the CPU seconds of all of it."""
    options: TrainingOptions = replace(run.options, **ablation.options)
    check, spent = (None, 0.0) if options.check is None else prepared(run, options.output_weights)
    began, seeds = time.process_time(), [run.seed(0)]
    if ablation.way == AS_LONG:
        options, check, spent = Run.published(), None, 0.0
        state = start([run.data], options=options, diffusion=run.system.diffusion, seeds=seeds)
        while time.process_time() - began < seconds:
            further = replace(options, steps=state.step + 5)
            state = train(state, [run.data], options=further, seeds=seeds, log_every=10**9)
        networks: Any = at_rest(state.networks, 0)
    elif ablation.way == NO_STEPS:
        assert check is not None
        state = start([run.data], options=options, diffusion=run.system.diffusion, seeds=seeds)
        first = at_rest(state.networks, 0)
        weights, biases = first.potential[-1]
        first = replace(
            first,
            potential=(*first.potential[:-1], (0 * weights, 0 * biases)),
            potential_scale=ablation.steepness * first.potential_scale,
        )
        check.said = ()
        networks = check.accepted(first) or first
    else:
        if check is not None:
            check.said = ()
        block = Block(
            {run.number: run.data}, {} if check is None else {run.number: check}, options=options,
            diffusion=run.system.diffusion, seed=run.settings.seed, folder=None, mark="",
            device=torch.device("cpu"),
        )  # fmt: skip
        block.train()
        networks = block.last[run.number]
    said = () if check is None else check.said
    return networks, said, spent + time.process_time() - began


def rows(number: int, done: dict[str, float]) -> Iterator[dict[str, Any]]:
    """What is measured of one run, but for what is done, with its CPU seconds."""
    if len(done) == len(ABLATIONS):
        return
    run = Run("archetype3d", number)
    judge = Judge(run)
    networks_of(AS_USUAL, run, seconds=0)  # what a first training imports is not to count
    for ablation in ABLATIONS:
        if ablation.name in done:
            continue
        networks, said, seconds = networks_of(ablation, run, seconds=done.get(AS_USUAL.name, 0.0))
        done[ablation.name] = seconds
        told = {"ablation": ablation.name, "run": number, "first_check": said[0] if said else ""}
        told |= {"checks": len(said), "cpu_seconds": seconds, **run.measured(networks)}
        yield told | judge(networks, wrong=told["error"] > WRONG)


def table() -> str:
    """All rows that there are, one line an ablation."""
    made = pd.read_csv(TABLE, keep_default_na=False)
    lines = [
        "| put back | seeds | first check: right, false, nowhere | error of U, median | worst | CPU s |"
        " agrees | wrong | of these agree, certified |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for ablation in ABLATIONS:
        of = made[made["ablation"] == ablation.name]
        first = [(of["first_check"] == one).sum() for one in ("right", "false", "nowhere")]
        said = ", ".join(map(str, first)) if sum(first) else "–"
        wrong = of["error"] > WRONG
        figures = [
            ablation.name, len(of), said, f"{of['error'].median():.1e}", f"{of['error'].max():.1e}",
            f"{of['cpu_seconds'].median():.1f}", of["agrees"].sum(), wrong.sum(),
            f"{(of['agrees'] & wrong).sum()}, {(of['certified'] & wrong).sum()}",
        ]  # fmt: skip
        lines.append(f"| {' | '.join(map(str, figures))} |")
    return "\n".join(lines)


def main() -> None:
    """Measure what is not there yet, or print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--table", action="store_true", help="print the table")
    if parser.parse_args().table:
        print(table())
        return
    torch.set_num_threads(1)
    TABLE.parent.mkdir(exist_ok=True)
    made = pd.read_csv(TABLE, keep_default_na=False).to_dict("records") if TABLE.exists() else []
    for number in range(RUNS):
        done = {one["ablation"]: one["cpu_seconds"] for one in made if one["run"] == number}
        for row in rows(number, done):
            made.append(row)
            pd.DataFrame(made).to_csv(TABLE, index=False)


if __name__ == "__main__":
    main()
