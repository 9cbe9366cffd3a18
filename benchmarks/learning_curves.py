"""Error of the networks' V against steps and CPU seconds: the published training beside ours.

    .venv/bin/python benchmarks/learning_curves.py published --seconds 3600
    .venv/bin/python benchmarks/learning_curves.py ours
    .venv/bin/python benchmarks/learning_curves.py draw

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
from functools import cached_property
from pathlib import Path

import numpy as np
import pandas as pd
import torch

from siq.data.recordings import snapshot_pairs
from siq.networks.decomposition import TrainedNetworks, TrainingOptions
from siq.networks.networks import at_rest, side_by_side
from siq.networks.training import (
    TrainingData,
    _Batches,
    _load_checkpoint,
    _Objective,
    _save_checkpoint,
    prepare_data,
    start,
    train,
)
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
FIGURE = ROOT / "docs" / "images" / "learning_curves.png"
CARD = ROOT / "config" / "systems" / "archetype3d.yaml"
RUNS = 10
MARKS = (10, 20, 50, 100, 200, 300, 500, 700, 1000, 1500, *range(2000, 150_001, 500))  # steps, of a row each
GRID_POINTS = 30_000
SPACING = 0.1  # of the points at which residuals are taken: the paper's r
AXES = {
    "error": "relative L2 error of U over Ω",
    "residual": "median of |∇V·g| / (|∇V| |f|)",
    "held_out_loss": "published loss, held-out pairs",
}


class Run:
    """The data of one run of a study, and what is measured of networks with them."""

    def __init__(self, study: str, number: int) -> None:
        self.system, self.number = load_system(CARD), number
        self.settings = settings_of(load_study(ROOT / "config" / "studies" / f"{study}.yaml"), self.system)
        recordings = draw_run(self.settings, self.system, number=number).result
        assert recordings is not None and self.settings.training is not None
        self.options: TrainingOptions = self.settings.training
        self.recordings = recordings
        draw = generator(self.settings.seed, number, Purpose.DIVIDE)
        pairs = snapshot_pairs(recordings, pair_step=self.settings.sampling.pair_step)
        self.data: TrainingData = prepare_data(pairs, options=self.options, generator=draw)
        x = self.data.held_out.x0
        self.points = x[representative_subset(x, distance=SPACING, generator=draw)]

    @staticmethod
    def published() -> TrainingOptions:
        """The options of the published training."""
        told = load_study(ROOT / "config" / "studies" / "archetype3d-published.yaml").training
        assert told is not None
        return told

    @cached_property
    def _exact(self) -> tuple[np.ndarray, np.ndarray]:
        assert self.system.domain is not None
        grid = _domain_grid(self.system.domain, points=GRID_POINTS)
        return grid, compile_formulas([load_exact(CARD)], self.system.symbols)(grid)[0]

    def measured(self, networks: TrainedNetworks) -> dict[str, float]:
        """Loss, residual and error of networks."""
        published, tensors = self.published(), side_by_side([networks])
        kind = {"device": torch.device("cpu"), "dtype": tensors.mean.dtype}
        held_out = _Batches([self.data], options=published, seeds=[self.seed(0)], **kind).held_out()  # type: ignore[arg-type]
        objective = _Objective([self.data], options=published, diffusion=tensors.diffusion, **kind)  # type: ignore[arg-type]
        dynamics, orthogonality = objective(tensors, *held_out)
        _, circulatory, field = networks.evaluate(self.points)
        slope = networks.gradients_at(self.points)
        sizes = np.linalg.norm(slope, axis=1) * np.linalg.norm(field, axis=1)
        grid, exact = self._exact
        return {
            "held_out_loss": float(dynamics + published.orthogonality_weight * orthogonality),
            "residual": float(np.median(np.abs((slope * circulatory).sum(axis=1)) / sizes)),
            "error": relative_error(2 * networks.potential_at(grid.T), exact),
        }

    def seed(self, attempt: int) -> np.random.SeedSequence:
        """Of a training, as studies have it."""
        purpose = Purpose.TRAINING if attempt == 0 else f"{Purpose.TRAINING} {attempt}"
        return seed_sequence(self.settings.seed, self.number, purpose)


def published(seconds: float) -> None:
    """Train as published until that many CPU seconds are spent; the table and a checkpoint stay."""
    run, table, kept = Run("archetype3d-published", 0), FOLDER / "published.csv", FOLDER / "published.npz"
    seeds, data = [run.seed(0)], [run.data]
    state = _load_checkpoint(kept, fingerprint="published")
    rows = [] if state is None or not table.exists() else pd.read_csv(table).to_dict("records")
    if state is None:
        state = start(data, options=run.options, diffusion=run.system.diffusion, seeds=seeds)
    rows = [row for row in rows if row["step"] <= state.step]
    spent = float(rows[-1]["cpu_seconds"]) if rows else 0.0
    for mark in (mark for mark in MARKS if mark > state.step):
        if spent >= seconds:
            return
        began = time.process_time()
        state = train(state, data, options=replace(run.options, steps=mark), seeds=seeds, log_every=10**9)
        spent += time.process_time() - began
        rows.append(
            {"run": 0, "step": mark, "cpu_seconds": spent, **run.measured(at_rest(state.networks, 0))}
        )
        pd.DataFrame(rows).to_csv(table, index=False)
        _save_checkpoint(kept, replace(state, history=state.history[:0]), fingerprint="published")


def ours(number: int) -> Iterator[dict[str, float]]:
    """Rows of one of our trainings: some of the steps, and, as the last, the output weights."""
    run = Run("archetype3d", number)
    check = run.options.check
    assert check is not None
    began, measuring = time.process_time(), 0.0
    weights = OutputWeights(
        run.data, diffusion=run.system.diffusion, units=run.options.output_weights,
        generator=generator(run.settings.seed, number, Purpose.UNITS),
    )  # fmt: skip
    checks = range(check.first, run.options.steps + 1, check.every)
    marks = sorted({*checks, *(mark for mark in MARKS if mark <= run.options.steps)})
    for attempt in range(check.attempts):
        options, seeds = run.options.attempt(attempt), [run.seed(attempt)]
        state = start([run.data], options=options, diffusion=run.system.diffusion, seeds=seeds)
        for mark in marks:
            state = train(
                state, [run.data], options=replace(options, steps=mark), seeds=seeds, log_every=10**9
            )
            reached = [at_rest(state.networks, 0)]
            spent = [time.process_time() - began - measuring]
            if mark in checks and (found := weights.accepted(reached[0])) is not None:
                reached.append(found)
                spent.append(time.process_time() - began - measuring)
            for networks, seconds in zip(reached, spent, strict=True):
                paused = time.process_time()
                solved = networks is not reached[0]
                row = {
                    "run": number,
                    "attempt": attempt,
                    "step": mark,
                    "solved": solved,
                    "cpu_seconds": seconds,
                }
                yield row | run.measured(networks)
                measuring += time.process_time() - paused
            if len(reached) > 1:
                return


def draw() -> None:
    """The figure of both, from their tables."""
    from matplotlib.figure import Figure

    tables = {
        "published training, one run": pd.read_csv(FOLDER / "published.csv"),
        "ours, ten runs, with output weights as the last step": pd.read_csv(FOLDER / "ours.csv"),
    }
    figure = Figure(figsize=(10, 3.6), layout="constrained")
    for axes, (column, label) in zip(figure.subplots(1, len(AXES)), AXES.items(), strict=True):
        for place, (name, table) in enumerate(tables.items()):
            colour, style, marker = look(place)
            for number, one in table.groupby("run"):
                told = name if number == 0 else None
                axes.loglog(
                    one["cpu_seconds"], one[column], color=colour, linestyle=style, linewidth=1, label=told
                )
                axes.plot(
                    one["cpu_seconds"].iloc[-1],
                    one[column].iloc[-1],
                    color=colour,
                    marker=marker,
                    markersize=4,
                )
        axes.set_xlabel("CPU time / s")
        axes.set_ylabel(label)
    figure.legend(
        *figure.axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=2, frameon=False
    )
    figure.savefig(FIGURE, dpi=150)


def main() -> None:
    """Train, or draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("what", choices=("published", "ours", "draw"))
    parser.add_argument("--seconds", type=float, default=3600.0, help="CPU seconds of the published training")
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
