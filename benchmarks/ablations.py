"""What of a short training makes the difference: one setting at a time is put back, on ten seeds.

    .venv/bin/python -m benchmarks.ablations
    .venv/bin/python -m benchmarks.ablations 3 17
    .venv/bin/python -m benchmarks.ablations --table

The paper's system in three dimensions, runs 0 to 9 of the study ``archetype3d``; every training is a cold
start. Numbers are those of a run and of the ablations to be made of it, for processes side by side. A
row goes into the folder ``results/ablations``, or that of ``$OUT``, as soon as it has ended, and one that is
there is not made again. ``--table`` prints the table of ``docs/how-the-method-works.md`` from what there is.

Asked is what output weights say at the first check: that V is right, on a false branch, or nowhere. Then the
training goes on as in a study. What it ends with is compared with the exact U, which no training sees, and
with the refined V. Where it is wrong, its published regression is put to the certificate.
"""

import os

os.environ["OMP_NUM_THREADS"] = "1"

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any, Literal

import pandas as pd
import torch

from benchmarks.learning_curves import CPU, ROOT, RUNS, Run
from siq.networks.decomposition import TrainedNetworks
from siq.networks.networks import at_rest
from siq.networks.training import Block, Check, start, train
from siq.numerics.randomness import Purpose, generator
from siq.quasipotential.certificate import certify, check_agreement
from siq.quasipotential.output_weights import OutputWeights
from siq.quasipotential.refinement import RefinementContext
from siq.workflow.pipeline import identify_run, regress_run
from siq.workflow.tables import Outcome, Step, StepResult

TABLES = Path(os.environ.get("OUT", ROOT / "results")) / "ablations"
WRONG = 0.05  # relative error of U above which V is wrong, whatever anything says of it


@dataclass(frozen=True)
class Ablation:
    """What is put back, in the words of the table."""

    name: str
    options: dict[str, Any] = field(default_factory=dict)
    way: Literal["", "no steps", "as long"] = ""
    steepness: float = 1.0


AS_USUAL = Ablation("as in the study")
PAPERS_START = {"normalise_on": "pairs", "potential_gain": 1}
SINGLE: tuple[tuple[str, Any], ...] = (
    *PAPERS_START.items(), ("representative_share", 0), ("orthogonality_weight", 1), ("matching", "explicit"),
    ("precision", "float64"), ("batch_size", 100), ("decay_rate", 1), ("widths", [50, 50, 50]),
    ("output_weights", 100), ("output_weights", 200), ("output_weights", 800),
)  # fmt: skip
ABLATIONS = (
    AS_USUAL,
    Ablation("no steps: V = η_v∣y∣²", way="no steps"),
    Ablation("no steps, a tenth as steep", way="no steps", steepness=0.1),
    Ablation("no steps, ten times as steep", way="no steps", steepness=10.0),
    Ablation("published training for as many CPU seconds", way="as long"),
    Ablation("no output weights: 900 steps of Adam", {"check": None}),
    *(Ablation(f"`{name}: {value}`", {name: value}) for name, value in SINGLE),
    Ablation("`normalise_on: pairs` and `potential_gain: 1`", PAPERS_START),
)


class Watched(OutputWeights):
    """Output weights that keep what they said at every check."""

    said: tuple[str, ...] = ()

    def accepted(self, networks: TrainedNetworks) -> TrainedNetworks | None:
        """As always."""
        self.last = "nowhere"
        found = super().accepted(networks)
        self.said += (self.last if found is None else "right",)
        return found

    def _leaves(self, *of: Any) -> bool:  # asked only of a V that solves the equation
        leaves = super()._leaves(*of)
        self.last = self.last if leaves else "false"
        return leaves


@cache
def judge(number: int) -> tuple[Run, Callable[[TrainedNetworks, bool], dict[str, Any]]]:
    """A run, and what its refined V, which no networks change, says of right and wrong networks."""
    run = Run("archetype3d", number)
    its, found = run.settings, identify_run(run.settings, run.recordings, number=run.number).result
    assert found is not None
    context = RefinementContext(
        run.recordings, found, None, number=run.number, seed=its.seed,
        pair_step=its.sampling.pair_step, refinement=its.refinement, limits=its.certificate,
    )  # fmt: skip
    refined = context.refine_and_certify()

    def judged(networks: TrainedNetworks, wrong: bool) -> dict[str, Any]:
        said = check_agreement(networks, refined.formulas, context.evidence, error=refined.certificate.error)
        told = {"agrees": said.passed, "reason": said.reason, "certified": False}
        if wrong:
            trained = StepResult[Any](networks, Outcome(run.number, Step.TRAIN))
            regressed = regress_run(its, run.recordings, trained).result
            told["certified"] = regressed is not None and certify(regressed, context.evidence).certified
        return told

    return run, judged


@cache
def prepared(run: Run, units: int) -> tuple[Watched, float]:
    """What checks the trainings of a run, which none of them changes, and the CPU seconds that it took."""
    began, draw = time.process_time(), generator(run.settings.seed, run.number, Purpose.UNITS)
    check = Watched(run.data, diffusion=run.system.diffusion, units=units, generator=draw)
    return check, time.process_time() - began


def networks_of(ablation: Ablation, run: Run, *, seconds: float) -> tuple[Any, tuple[str, ...], float]:
    """What a training ends with, what was said at its checks, and the CPU seconds of all of it."""
    options = Run.published() if ablation.way == "as long" else replace(run.options, **ablation.options)
    check, spent = (None, 0.0) if options.check is None else prepared(run, options.output_weights)
    before = 0 if check is None else len(check.said)
    checks: dict[int, Check] = {} if check is None else {run.number: check}
    began, seeds, data = time.process_time(), [run.seed(0)], [run.data]
    if not ablation.way:
        block = Block(
            {run.number: run.data}, checks, options=options, diffusion=run.system.diffusion,
            seed=run.settings.seed, folder=None, mark="", device=CPU,
        )  # fmt: skip
        block.train()
        networks = block.last[run.number]
    else:
        state = start(data, options=options, diffusion=run.system.diffusion, seeds=seeds)
        while ablation.way == "as long" and time.process_time() - began < seconds:
            more = replace(options, steps=state.step + 5)
            state = train(state, data, options=more, seeds=seeds, log_every=10**9)
        networks = first = at_rest(state.networks, 0)
        if check is not None:
            steep, last = ablation.steepness * first.potential_scale, first.potential[-1]
            layers = (*first.potential[:-1], (0 * last[0], 0 * last[1]))
            first = replace(first, potential=layers, potential_scale=steep)
            networks = check.accepted(first) or first
    return networks, () if check is None else check.said[before:], spent + time.process_time() - began


def row(ablation: Ablation, number: int, *, seconds: float) -> dict[str, Any]:
    """What is measured of one training; some take as many CPU seconds as they are told."""
    run, judged = judge(number)
    networks, said, spent = networks_of(ablation, run, seconds=seconds)
    told: dict[str, Any] = {"ablation": ablation.name, "run": number, "first_check": said[0] if said else ""}
    told |= {"checks": len(said), "cpu_seconds": spent, **run.measured(networks)}
    return told | judged(networks, told["error"] > WRONG)


def kept() -> pd.DataFrame:
    """All rows that there are."""
    texts = {"first_check": str}  # "false" is the name of a branch here
    paths = sorted(TABLES.glob("*.csv"))
    tables = [pd.read_csv(path, keep_default_na=False, dtype=texts) for path in paths]
    return pd.concat(tables, ignore_index=True) if tables else pd.DataFrame({"ablation": [], "run": []})


def table() -> str:
    """All rows that there are, one line an ablation."""
    made = kept()
    lines = [
        "| put back | seeds | first check: right, false, nowhere | error of U, median | worst | CPU s |"
        " agrees | wrong | of these agree | certified |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for ablation in ABLATIONS:
        of = made[made["ablation"] == ablation.name]
        first, wrong = of["first_check"].value_counts(), of["error"] > WRONG
        counts = [str(first.get(one, 0)) for one in ("right", "false", "nowhere")]
        figures = [
            ablation.name, len(of), "–" if "" in first else ", ".join(counts),
            f"{of['error'].median():.1e}", f"{of['error'].max():.1e}", f"{of['cpu_seconds'].median():.1f}",
            of["agrees"].sum(), wrong.sum(), (of["agrees"] & wrong).sum(), (of["certified"] & wrong).sum(),
        ]  # fmt: skip
        lines.append(f"| {' | '.join(map(str, figures))} |")
    return "\n".join(lines)


def main(chosen: Sequence[str]) -> None:
    """Measure what is not there yet, or print the table."""
    if chosen == ["--table"]:
        print(table())
        return
    torch.set_num_threads(1)
    TABLES.mkdir(parents=True, exist_ok=True)
    pairs = product(range(RUNS), range(len(ABLATIONS)))
    if chosen:
        pairs = product([int(chosen[0])], map(int, chosen[1:]))
    before: list[Any] = kept().to_dict("records")
    seconds, warm = {(one["ablation"], one["run"]): one["cpu_seconds"] for one in before}, False
    for number, place in pairs:
        ablation = ABLATIONS[place]
        if (ablation.name, number) in seconds:
            continue
        if not warm:  # what a first training imports is not to count
            networks_of(AS_USUAL, judge(number)[0], seconds=0)
            warm = True
        made = row(ablation, number, seconds=seconds.get((AS_USUAL.name, number), 0.0))
        seconds[ablation.name, number] = made["cpu_seconds"]
        pd.DataFrame([made]).to_csv(TABLES / f"{number}-{place:02d}.csv", index=False)


if __name__ == "__main__":
    main(sys.argv[1:])
