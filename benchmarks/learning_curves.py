"""Error of the networks' V against steps and CPU seconds: the published training beside ours.

    .venv/bin/python -m benchmarks.learning_curves published --seconds 3600
    .venv/bin/python -m benchmarks.learning_curves ours
    .venv/bin/python -m benchmarks.learning_curves draw

The paper's system in three dimensions. `published` trains run 0 of the study ``archetype3d-published`` for as
many CPU seconds on one core as are asked for. It keeps its table and a checkpoint in
``results/learning-curves``, and goes on from there when it is asked for more. `ours` trains runs 0 to 9 of
the study ``archetype3d`` to the end. Both are measured alike: by the published loss on held-out pairs, by
the median of ∣∇V·g∣/(∣∇V∣∣f∣), each with its own f, at evenly spread held-out points, and by the relative
L2 error of U over Ω. Only the last needs the exact U, and no training sees it. Time is that of the training
and of output weights, without what draws, divides or measures.
"""

import os

os.environ["OMP_NUM_THREADS"] = "1"

import argparse
import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
import torch._dynamo  # the first optimiser loads it, which is not to count

from siq.data.recordings import snapshot_pairs
from siq.networks import training as networks_training
from siq.networks.decomposition import TrainedNetworks, TrainingOptions
from siq.networks.networks import at_rest, side_by_side
from siq.networks.training import prepare_data, start, train
from siq.numerics.randomness import Purpose, generator, representative_subset, seed_sequence
from siq.quasipotential.output_weights import OutputWeights
from siq.report.plots.style import look
from siq.systems.cards import load_exact, load_system
from siq.systems.formulas import compile_formulas
from siq.workflow.pipeline import draw_run
from siq.workflow.study import load_study, settings_of
from workflow.scoring import _domain_grid, relative_error

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "results" / "learning-curves"
CARD_CURVES = Path(__file__).with_name("published_settings_curves.csv")
FIGURE = ROOT / "docs" / "images" / "learning_curves.png"
STUDIES, CARD = ROOT / "config" / "studies", ROOT / "config" / "systems" / "archetype3d.yaml"
RUNS = 10
MARKS = (10, 20, 50, 100, 200, 300, 500, 700, 1000, 1500, *range(2000, 150_001, 500))  # steps, of a row each
CPU = torch.device("cpu")
GRID_POINTS = 30_000  # of the grid over Ω
HOUR = 3600.0  # CPU seconds
SPACING = 0.1  # of the points at which residuals are taken: the paper's r
TIMES = {"cpu_seconds": "CPU time / s", "step": "steps of Adam"}
AXES = {
    "error": "relative L2 error of U over Ω",
    "residual": "median of |∇V·g| / (|∇V| |f|)",
    "held_out_loss": "published loss, held-out pairs",
}


class Run:
    """The data of one run of a study, and what is measured of networks with them."""

    def __init__(self, study: str, number: int) -> None:
        self.system, self.number = load_system(CARD), number
        self.settings = settings_of(load_study(STUDIES / f"{study}.yaml"), self.system)
        recordings = draw_run(self.settings, self.system, number=number).result
        assert recordings is not None and self.settings.training is not None
        self.options, self.recordings = self.settings.training, recordings
        draw = generator(self.settings.seed, number, Purpose.DIVIDE)
        pairs = snapshot_pairs(recordings, pair_step=self.settings.sampling.pair_step)
        self.data = prepare_data(pairs, options=self.options, generator=draw)
        x = self.data.held_out.x0
        self.points = x[representative_subset(x, distance=SPACING, generator=draw)]
        assert self.system.domain is not None
        _, self.grid = _domain_grid(self.system.domain, points=GRID_POINTS)
        self.exact = compile_formulas([load_exact(CARD)], self.system.symbols)(self.grid)[0]

    @staticmethod
    def published() -> TrainingOptions:
        """The options of the published training."""
        told = load_study(STUDIES / "archetype3d-published.yaml").training
        assert told is not None
        return told

    def measured(self, networks: TrainedNetworks) -> dict[str, float]:
        """Loss, residual and error of networks."""
        published, tensors = self.published(), side_by_side([networks])
        kind: dict[str, Any] = {"options": published, "device": CPU, "dtype": tensors.mean.dtype}
        held_out = networks_training._Batches([self.data], seeds=[self.seed(0)], **kind).held_out()
        objective = networks_training._Objective([self.data], diffusion=tensors.diffusion, **kind)
        dynamics, orthogonality = objective(tensors, *held_out)
        _, circulatory, field = networks.evaluate(self.points)
        slope = networks.gradients_at(self.points)
        sizes = np.linalg.norm(slope, axis=1) * np.linalg.norm(field, axis=1)
        return {
            "held_out_loss": float(dynamics + published.orthogonality_weight * orthogonality),
            "residual": float(np.median(np.abs((slope * circulatory).sum(axis=1)) / sizes)),
            "error": relative_error(2 * networks.potential_at(self.grid.T), self.exact),
        }

    def seed(self, attempt: int) -> np.random.SeedSequence:
        """Of a training, as studies have it."""
        purpose = Purpose.TRAINING if attempt == 0 else f"{Purpose.TRAINING} {attempt}"
        return seed_sequence(self.settings.seed, self.number, purpose)


def published(seconds: float) -> None:
    """Train as published until that many CPU seconds are spent; the table and a checkpoint stay."""
    run, table, kept = Run("archetype3d-published", 0), FOLDER / "published.csv", FOLDER / "published.npz"
    seeds, data = [run.seed(0)], [run.data]
    state = networks_training._load_checkpoint(kept, fingerprint="published")
    if state is None:
        state = start(data, options=run.options, diffusion=run.system.diffusion, seeds=seeds)
    made: list[Any] = pd.read_csv(table).to_dict("records") if state.step else []
    rows = [row for row in made if row["step"] <= state.step]
    spent = float(rows[-1]["cpu_seconds"]) if rows else 0.0
    for mark in (mark for mark in MARKS if mark > state.step):
        if spent >= seconds:
            return
        began = time.process_time()
        state = train(state, data, options=replace(run.options, steps=mark), seeds=seeds, log_every=10**9)
        spent += time.process_time() - began
        reached = at_rest(state.networks, 0)
        rows.append({"run": 0, "step": mark, "cpu_seconds": spent, **run.measured(reached)})
        pd.DataFrame(rows).to_csv(table, index=False)
        bare = replace(state, history=state.history[:0])
        networks_training._save_checkpoint(kept, bare, fingerprint="published")


def ours(number: int) -> Iterator[dict[str, float]]:
    """Rows of one of our trainings: some of the steps, and, as the last, the output weights."""
    run = Run("archetype3d", number)
    check, weights, spent = run.options.check, None, 0.0
    assert check is not None
    checks = range(check.first, run.options.steps + 1, check.every)
    marks = sorted({*checks, *(mark for mark in MARKS if mark <= run.options.steps)})
    for attempt in range(check.attempts):
        options, told = run.options.attempt(attempt), {"run": number, "attempt": attempt}
        seeds, data = [run.seed(attempt)], [run.data]
        state = start(data, options=options, diffusion=run.system.diffusion, seeds=seeds)
        for mark in marks:
            began = time.process_time()
            state = train(state, data, options=replace(options, steps=mark), seeds=seeds, log_every=10**9)
            spent += time.process_time() - began
            reached = at_rest(state.networks, 0)
            yield {**told, "step": mark, "solved": False, "cpu_seconds": spent, **run.measured(reached)}
            if mark in checks:
                began, draw = time.process_time(), generator(run.settings.seed, number, Purpose.UNITS)
                weights = weights or OutputWeights(
                    run.data, diffusion=run.system.diffusion, units=options.output_weights, generator=draw
                )
                found = weights.accepted(reached)
                spent += time.process_time() - began
                if found is not None:
                    yield {**told, "step": mark, "solved": True, "cpu_seconds": spent, **run.measured(found)}
                    return


def draw() -> None:
    """The figure of both, from their tables."""
    from matplotlib.figure import Figure

    names = {"published.csv": "published training, one run", "ours.csv": "ours, ten runs, to output weights"}
    figure, looks = Figure(figsize=(10, 6), layout="constrained"), ("color", "linestyle", "marker")
    panels = figure.subplots(2, len(AXES), sharey="col").flat
    card, reached = pd.read_csv(CARD_CURVES), pd.read_csv(FOLDER / "published.csv").iloc[-1]
    card["cpu_seconds"] = card["step"] * reached["cpu_seconds"] / reached["step"]  # what its steps take here
    for axes, ((x, below), (y, beside)) in zip(panels, product(TIMES.items(), AXES.items()), strict=True):
        for place, (file, name) in enumerate(names.items()):
            told: dict[str, Any] = dict(zip(looks, look(place), strict=True))
            for number, one in pd.read_csv(FOLDER / file).groupby("run"):
                axes.loglog(one[x], one[y], markevery=[-1], label="" if number else name, **told)
        if x == "cpu_seconds":
            axes.axvline(HOUR, color="0.8", linewidth=0.7, zorder=0)
        if y in card:
            for number, one in card.groupby("run"):
                label = "" if number else "published, fifty runs on a card"
                axes.loglog(one[x], one[y], color="0.6", linestyle=":", linewidth=0.7, label=label, zorder=0)
        axes.set(xlabel=below, ylabel=beside)
    figure.legend(*figure.axes[-3].get_legend_handles_labels(), loc="outside upper center", ncols=3)
    figure.savefig(FIGURE, dpi=150)


def main() -> None:
    """Train, or draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("what", choices=("published", "ours", "draw"))
    parser.add_argument("--seconds", type=float, default=HOUR, help="of the CPU, for the published one")
    asked = parser.parse_args()
    torch.set_num_threads(1)
    FOLDER.mkdir(parents=True, exist_ok=True)
    if asked.what == "published":
        published(asked.seconds)
    elif asked.what == "ours":
        rows = list[dict[str, float]]()
        for number in range(RUNS):
            rows += ours(number)
            pd.DataFrame(rows).to_csv(FOLDER / "ours.csv", index=False)
    else:
        draw()


if __name__ == "__main__":
    main()
