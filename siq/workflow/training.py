"""The step that trains the two networks, runs of one block side by side.

A training ends as soon as its networks are good enough, or when its steps are spent. A killed one is resumed
where it stopped: from its checkpoint, and with the networks of the runs that had already passed the check.
One without a check keeps its checkpoint at the end, and goes on from there when it is given more steps.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd

from siq.data.recordings import Recordings, snapshot_pairs
from siq.errors import NumericalFailure
from siq.inference.field_estimate import FieldEstimate
from siq.networks.decomposition import AnyNetworks, TrainingOptions
from siq.networks.training import Block, Check, TrainingData, prepare_data
from siq.numerics.randomness import Purpose, generator
from siq.quasipotential.output_weights import OutputWeights
from siq.systems.diffusion import Diffusion
from siq.workflow.study import PipelineSettings
from siq.workflow.tables import POSITION, Outcome, Status, Step, StepResult, as_table

MOST_POINTS = 10_000  # over which a D that depends on the state is averaged
Runs = Mapping[int, tuple[Recordings | None, FieldEstimate | None]]
"""What runs bring to their training, by number: trajectories and f, None where a step before failed."""


def train_block(
    settings: PipelineSettings, runs: Runs, *, folder: Path | None = None, device: str = "auto",
    version: int = 0,
) -> tuple[dict[int, StepResult[AnyNetworks]], list[AnyNetworks], pd.DataFrame]:  # fmt: skip
    """Train the networks of a block of runs, on the device ``auto``, ``cpu`` or ``cuda``.

    In the folder a killed training leaves what it goes on from, and one without a check what a training of
    more steps goes on from; see `clean`. Neither goes on from another version of the code. Given are the
    results of every run; the networks of those that have data, by their positions, be they good for anything
    or not; and the loss, the table `training`.
    """
    assert settings.training is not None  # networks are asked for
    data, results = _training_data(settings, runs)
    if not data:
        return results, [], as_table("training", [])
    diffusion = _diffusion(settings, runs, data)
    ready, faults = _checks(settings, runs, data, diffusion)
    import torch  # which takes seconds

    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "cpu"
    block = Block(
        data, ready, options=settings.training, diffusion=diffusion, seed=settings.seed, folder=folder,
        mark=f"{_fingerprint(settings, runs, data)} {version}", device=torch.device(device), faults=faults,
    )  # fmt: skip
    block.train()
    for number in data:
        outcome = _outcome_of(block, number)
        results[number] = StepResult(block.last[number] if outcome.usable else None, outcome)
    return results, [block.last[number] for number in data], as_table("training", block.history())


def _outcome_of(block: Block, run: int) -> Outcome:
    """What became of a run."""
    details = {POSITION: list(block.data).index(run)}
    if run in block.failures:
        return Outcome(run, Step.TRAIN, Status.FAILED, block.failures[run], details)
    if block.options.check is None or run in block.passed:
        return Outcome(run, Step.TRAIN, Status.OK, "", details)
    reason = block.faults.get(run, "no vector field was identified, so that nothing could be checked")
    if run in block.checks:
        reason = block.checks[run].hopeless() or (
            f"the check passed in none of {block.attempts} trainings of {block.options.steps} steps; raise"
            " training.steps or training.output_weights"
        )
    return Outcome(run, Step.TRAIN, Status.WARNING, reason, details)


def _diffusion(settings: PipelineSettings, runs: Runs, data: Mapping[int, TrainingData]) -> Diffusion:
    """D of all networks of a block: as given, or else the mean of what its runs show.

    Networks only lead to the right solution, which is then found with the D of its own run.
    """
    dimension = next(iter(data.values())).training.x0.shape[1]
    given = settings.space.constant_noise(dimension)
    if given is not None:
        return given
    records = [record for number in data if (record := runs[number][1]) is not None]
    if not records:
        return Diffusion.identity(dimension)
    if not all(record.diffusion.constant for record in records):
        points = np.concatenate([data[number].training.x0 for number in data])
        every = max(len(points) // MOST_POINTS, 1)
        noises = [record.diffusion.at(points[::every]).mean(axis=0) for record in records]
        return Diffusion(np.mean(noises, axis=0))
    return Diffusion(np.mean([record.diffusion.matrix for record in records], axis=0))


def _training_data(
    settings: PipelineSettings, runs: Runs
) -> tuple[dict[int, TrainingData], dict[int, StepResult[AnyNetworks]]]:
    """The data of every run of the block that has some, and the results of those that have none."""
    assert settings.training is not None
    data, failed = {}, dict[int, StepResult[AnyNetworks]]()
    for number, (recordings, _) in runs.items():
        if recordings is None:
            reason = "the run has no trajectories"
            failed[number] = StepResult(None, Outcome(number, Step.TRAIN, Status.SKIPPED, reason))
            continue
        try:
            pairs = snapshot_pairs(recordings, pair_step=settings.sampling.pair_step)
            draw = generator(settings.seed, number, Purpose.DIVIDE)
            data[number] = prepare_data(pairs, options=settings.training, generator=draw)
        except NumericalFailure as error:
            failed[number] = StepResult(None, Outcome(number, Step.TRAIN, Status.FAILED, str(error)))
    return data, failed


def _checks(
    settings: PipelineSettings, runs: Runs, data: Mapping[int, TrainingData], diffusion: Diffusion
) -> tuple[dict[int, Check], dict[int, str]]:
    """When the training of each run may end; of those that have no check, why not."""
    assert settings.training is not None
    ready, faults = dict[int, Check](), {}
    for number, part in data.items() if settings.training.check is not None else ():
        draw = generator(settings.seed, number, Purpose.UNITS)
        try:
            ready[number] = OutputWeights(
                part, diffusion=diffusion, units=settings.training.output_weights, generator=draw,
                found=runs[number][1],
            )  # fmt: skip
        except (NumericalFailure, np.linalg.LinAlgError) as error:
            faults[number] = f"the check of the training could not be prepared: {error}"
    return ready, faults


def _fingerprint(settings: PipelineSettings, runs: Runs, data: Mapping[int, TrainingData]) -> str:
    """What everything kept by a killed training must share with the one that goes on from it."""
    told = settings.parts(("seed", "space", "sampling", "training"))
    if told["training"]["check"] is None:
        del told["training"]["steps"]  # which say when it ends, and change no step before
    digest = hashlib.sha256(json.dumps([list(data), told], sort_keys=True).encode())
    for number, part in data.items():
        record = runs[number][1]
        arrays = [part.training.x0, part.training.xh, part.training.h]
        if record is not None:
            arrays += [record.coefficients, record.covariance, record.diffusion.at(part.training.x0[:1])]
        for values in arrays:
            digest.update(np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()


def clean(folder: Path, options: TrainingOptions | None = None) -> None:
    """Remove what only a killed training would need; what was kept last stays of one without a check."""
    kept = sorted(folder.glob("kept-*.npz"), key=lambda path: path.stat().st_mtime_ns)
    for path in kept[: len(kept) - (options is not None and options.check is None)]:
        path.unlink()
