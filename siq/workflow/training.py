"""The step that trains the two networks, runs of one block side by side.

A training ends as soon as its networks are good enough, or when its steps are spent. A killed one is resumed
where it stopped: from its checkpoint, and with the networks of the runs that had already passed the check.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from dataclasses import dataclass as plain_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from siq.data.recordings import Recordings, snapshot_pairs
from siq.errors import NumericalFailure
from siq.inference.field_estimate import FieldEstimate
from siq.networks.decomposition import TrainedNetworks
from siq.networks.training import Block, Checkpoints, TrainingData, choose_device, prepare_data
from siq.numerics.randomness import Purpose, generator
from siq.quasipotential.refinement import TrainingCheck
from siq.systems.diffusion import Diffusion
from siq.workflow.study import PipelineSettings
from siq.workflow.tables import Outcome, Status, Step, as_table

POSITION = "position"
"""In the details of an outcome: where the run stands among the networks of its block."""


@dataclass(frozen=True)
class TrainedRun:
    """The networks of a run, None where its training left none, and why."""

    networks: TrainedNetworks | None
    outcome: Outcome

    @property
    def missing(self) -> str:
        """Why there are no networks, in words."""
        return f"the training gave no networks ({self.outcome.reason})"


def _not_trained(number: int) -> TrainedRun:
    """A run for which no networks were asked."""
    return TrainedRun(None, Outcome(number, Step.TRAIN, Status.SKIPPED, "no networks were asked for"))


def trained_run(
    networks: Mapping[int, TrainedNetworks] | None, outcomes: Sequence[Outcome] | None, *, number: int
) -> TrainedRun:
    """The networks of run `number` from those of its block by position; None where none were asked for."""
    if networks is None or outcomes is None:
        return _not_trained(number)
    mine = next(one for one in outcomes if one.run == number)
    return TrainedRun(networks[mine.details[POSITION]] if mine.usable else None, mine)


MOST_POINTS = 10_000  # over which a D that depends on the state is averaged


@plain_dataclass(frozen=True)
class RunToTrain:
    """What a run brings to its training: its trajectories and its f, None where a step before failed."""

    recordings: Recordings | None
    record: FieldEstimate | None


@plain_dataclass(frozen=True)
class _Trained:
    """The networks of a block.

    Attributes
    ----------
    networks
        By run, of those that have data, in the order of their positions in the file.
    history
        The loss, see the table `training`.
    outcomes
        Of every run of the block.
    """

    networks: Mapping[int, TrainedNetworks]
    history: pd.DataFrame
    outcomes: tuple[Outcome, ...]

    def files(self) -> dict[str, Any]:
        """By the names of the rule."""
        networks = list(self.networks.values())
        return {"networks": networks or None, "history": self.history, "train_outcome": self.outcomes}


@plain_dataclass(frozen=True)
class _Checks:
    """When the training of each run may end; of those that have no check, why not."""

    ready: Mapping[int, TrainingCheck]
    faults: Mapping[int, str]


def train_block(
    settings: PipelineSettings,
    runs: Mapping[int, RunToTrain],
    *,
    folder: Path | None = None,
    device: str = "auto",
) -> _Trained:
    """Train the networks of a block of runs.

    Parameters
    ----------
    settings
        What the networks are told.
    runs
        By number.
    folder
        Where a killed training leaves what it goes on from; None keeps nothing. See `clean`.
    device
        ``auto``, ``cpu``, ``cuda``.
    """
    assert settings.training is not None  # networks are asked for
    data, outcomes = _training_data(settings, runs)
    if not data:
        return _Trained({}, as_table("training", []), tuple(outcomes))

    checks = _checks(settings, runs, data)
    block = Block(
        data,
        checks.ready,
        options=settings.training,
        diffusion=_diffusion(settings, runs, data),
        seed=settings.seed,
        checkpoints=Checkpoints(folder, _fingerprint(settings, runs, data)),
        device=choose_device(device),
        faults=checks.faults,
    )
    block.train()
    outcomes += [_outcome_of(block, number) for number in data]
    networks = {number: block.last[number] for number in data}
    return _Trained(networks, as_table("training", block.history()), tuple(outcomes))


def _outcome_of(block: Block, run: int) -> Outcome:
    """What became of a run."""
    details = {POSITION: list(block.data).index(run)}
    if run in block.failures:
        return Outcome(run, Step.TRAIN, Status.FAILED, block.failures[run], details)
    if block.options.check is None or run in block.passed:
        return Outcome(run, Step.TRAIN, Status.OK, "", details)
    return Outcome(run, Step.TRAIN, Status.WARNING, block.unchecked(run), details)


def _diffusion(
    settings: PipelineSettings, runs: Mapping[int, RunToTrain], data: Mapping[int, TrainingData]
) -> Diffusion:
    """D of all networks of a block: as given, or else the mean of what its runs show.

    Networks only lead to the right solution, which is then found with the D of its own run.
    """
    dimension = next(iter(data.values())).training.x0.shape[1]
    given = settings.space.constant_noise(dimension)
    if given is not None:
        return given
    records = [record for number in data if (record := runs[number].record) is not None]
    if not records:
        return Diffusion.identity(dimension)
    if not all(record.diffusion.constant for record in records):
        # Networks only lead to the right solution, which is then found with D as it is.
        points = np.concatenate([data[number].training.x0 for number in data])
        every = max(len(points) // MOST_POINTS, 1)
        noises = [record.diffusion.at(points[::every]).mean(axis=0) for record in records]
        return Diffusion(np.mean(noises, axis=0))
    return Diffusion(np.mean([record.diffusion.matrix for record in records], axis=0))


def _training_data(
    settings: PipelineSettings, runs: Mapping[int, RunToTrain]
) -> tuple[dict[int, TrainingData], list[Outcome]]:
    """The data of every run of the block that has some, and the outcomes of those that have none."""
    assert settings.training is not None
    data, outcomes = {}, []
    for number, one in runs.items():
        if one.recordings is None:
            reason = "the run has no trajectories"
            outcomes.append(Outcome(number, Step.TRAIN, Status.SKIPPED, reason))
            continue
        try:
            pairs = snapshot_pairs(one.recordings, pair_step=settings.sampling.pair_step)
            draw = generator(settings.seed, number, Purpose.DIVIDE)
            data[number] = prepare_data(pairs, options=settings.training, generator=draw)
        except NumericalFailure as error:
            outcomes.append(Outcome(number, Step.TRAIN, Status.FAILED, str(error)))
    return data, outcomes


def _checks(
    settings: PipelineSettings, runs: Mapping[int, RunToTrain], data: Mapping[int, TrainingData]
) -> _Checks:
    """The check of every run whose vector field is known; the others train for all their steps."""
    from siq.quasipotential.refinement import TrainingCheck

    assert settings.training is not None
    ready, faults = {}, {}
    for number, part in data.items():
        options, record = settings.training.check, runs[number].record
        if record is None or options is None:
            continue
        x = part.training.x0
        try:
            ready[number] = TrainingCheck(record, x, options=options, seed=number)
        except (NumericalFailure, np.linalg.LinAlgError) as error:
            faults[number] = f"the check of the training could not be prepared: {error}"
    return _Checks(ready, faults)


def _fingerprint(
    settings: PipelineSettings, runs: Mapping[int, RunToTrain], data: Mapping[int, TrainingData]
) -> str:
    """What everything kept by a killed training must share with the one that goes on from it."""
    told = settings.parts(("seed", "space", "sampling", "training"))
    digest = hashlib.sha256(json.dumps([list(data), told], sort_keys=True).encode())
    for number, part in data.items():
        record = runs[number].record
        arrays = [part.training.x0, part.training.xh, part.training.h]
        if record is not None:
            noise = record.diffusion.at(part.training.x0[:1])
            arrays += [record.coefficients, record.covariance, noise]
        for values in arrays:
            digest.update(np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()


def clean(folder: Path) -> None:
    """Remove what only a killed training would need."""
    for path in folder.glob("kept-*.npz"):
        path.unlink()
