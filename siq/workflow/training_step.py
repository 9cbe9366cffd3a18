"""The step that trains the two networks, runs of one block side by side.

A training ends as soon as its networks are good enough, or when its steps are spent. A killed one is resumed
where it stopped: from its checkpoint, and with the networks of the runs that had already passed the check.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from dataclasses import dataclass as plain_dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from pydantic import TypeAdapter
from pydantic.dataclasses import dataclass as pydantic_dataclass

from siq.data.recordings import Recordings, snapshot_pairs
from siq.errors import NumericalFailure
from siq.inference.identification import FieldRecord, read_field
from siq.networks.decomposition import TrainedNetworks, TrainingOptions, load_networks, save_networks
from siq.networks.training import Block, Checkpoints, TrainingData, choose_device, prepare_data
from siq.numerics.randomness import Purpose, generator
from siq.quasipotential.refinement import TrainingCheck
from siq.systems.diffusion import Diffusion
from siq.workflow.outcomes import Outcome, Status, Step, read_outcomes, write_outcomes
from siq.workflow.recordings_step import read_run
from siq.workflow.settings import STRICT, Sampling, StateSpace
from siq.workflow.tables import as_table, write_table

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


def not_trained(number: int) -> TrainedRun:
    """A run for which no networks were asked."""
    return TrainedRun(None, Outcome(number, Step.TRAIN, Status.SKIPPED, "no networks were asked for"))


def read_trained(networks: str | Path | None, outcome: str | Path | None, *, number: int) -> TrainedRun:
    """The networks of run `number` from those of its block; no files where no networks were asked for."""
    if networks is None or outcome is None:
        return not_trained(number)
    mine = next(one for one in read_outcomes(outcome) if one.run == number)
    if not mine.usable:
        return TrainedRun(None, mine)
    return TrainedRun(load_networks(networks, run=mine.details[POSITION]), mine)


if TYPE_CHECKING:
    from siq.quasipotential.refinement import TrainingCheck

MOST_POINTS = 10_000  # over which a D that depends on the state is averaged


@pydantic_dataclass(frozen=True, config=STRICT)
class TrainSettings:
    """What a training depends on."""

    seed: int
    space: StateSpace
    sampling: Sampling
    training: TrainingOptions


@plain_dataclass(frozen=True)
class RunToTrain:
    """What a run brings to its training: its trajectories and its f, None where a step before failed."""

    recordings: Recordings | None
    record: FieldRecord | None


@plain_dataclass(frozen=True)
class Trained:
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

    def of(self, number: int) -> TrainedRun:
        """What one run has of it."""
        mine = next(one for one in self.outcomes if one.run == number)
        return TrainedRun(self.networks[number] if mine.usable else None, mine)


@plain_dataclass(frozen=True)
class Checks:
    """When the training of each run may end; of those that have no check, why not."""

    ready: Mapping[int, TrainingCheck]
    faults: Mapping[int, str]


def run(
    settings: TrainSettings,
    runs: Mapping[int, RunToTrain],
    *,
    folder: Path | None = None,
    device: str = "auto",
) -> Trained:
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
    data, outcomes = _training_data(settings, runs)
    if not data:
        return Trained({}, as_table("training", []), tuple(outcomes))

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
    outcomes += [outcome_of(block, number) for number in data]
    networks = {number: block.last[number] for number in data}
    return Trained(networks, as_table("training", block.history()), tuple(outcomes))


def outcome_of(block: Block, run: int) -> Outcome:
    """What became of a run."""
    details = {POSITION: list(block.data).index(run)}
    if run in block.failures:
        return Outcome(run, Step.TRAIN, Status.FAILED, block.failures[run], details)
    if block.options.check is None or run in block.passed:
        return Outcome(run, Step.TRAIN, Status.OK, "", details)
    return Outcome(run, Step.TRAIN, Status.WARNING, block.unchecked(run), details)


def _diffusion(
    settings: TrainSettings, runs: Mapping[int, RunToTrain], data: Mapping[int, TrainingData]
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
    if not all(record.found.diffusion.constant for record in records):
        # Networks only lead to the right solution, which is then found with D as it is.
        points = np.concatenate([data[number].training.x0 for number in data])
        every = max(len(points) // MOST_POINTS, 1)
        noises = [record.found.diffusion.at(points[::every]).mean(axis=0) for record in records]
        return Diffusion(np.mean(noises, axis=0))
    return Diffusion(np.mean([record.found.diffusion.matrix for record in records], axis=0))


def _training_data(
    settings: TrainSettings, runs: Mapping[int, RunToTrain]
) -> tuple[dict[int, TrainingData], list[Outcome]]:
    """The data of every run of the block that has some, and the outcomes of those that have none."""
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
    settings: TrainSettings, runs: Mapping[int, RunToTrain], data: Mapping[int, TrainingData]
) -> Checks:
    """The check of every run whose vector field is known; the others train for all their steps."""
    from siq.quasipotential.refinement import TrainingCheck

    ready, faults = {}, {}
    for number, part in data.items():
        options, record = settings.training.check, runs[number].record
        if record is None or options is None:
            continue
        x = part.training.x0
        try:
            ready[number] = TrainingCheck(record.found, x, options=options, seed=number)
        except (NumericalFailure, np.linalg.LinAlgError) as error:
            faults[number] = f"the check of the training could not be prepared: {error}"
    return Checks(ready, faults)


def _fingerprint(
    settings: TrainSettings, runs: Mapping[int, RunToTrain], data: Mapping[int, TrainingData]
) -> str:
    """What everything kept by a killed training must share with the one that goes on from it."""
    told = TypeAdapter(TrainSettings).dump_python(settings, mode="json")
    digest = hashlib.sha256(json.dumps([list(data), told], sort_keys=True).encode())
    for number, part in data.items():
        record = runs[number].record
        arrays = [part.training.x0, part.training.xh, part.training.h]
        if record is not None:
            noise = record.found.diffusion.at(part.training.x0[:1])
            arrays += [record.found.coefficients, record.found.covariance, noise]
        for values in arrays:
            digest.update(np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()


def read(
    recordings: Iterable[str | Path], fields: Iterable[str | Path], *, first: int
) -> dict[int, RunToTrain]:
    """The runs of a block, of which `first` is the first."""
    pairs = zip(recordings, fields, strict=True)
    return {
        number: RunToTrain(read_run(one), read_field(field))
        for number, (one, field) in enumerate(pairs, start=first)
    }


def write(trained: Trained, *, networks: str | Path, history: str | Path, outcome: str | Path) -> None:
    """Write the networks of a block, an empty file where there are none, their loss and outcomes."""
    if trained.networks:
        save_networks(networks, list(trained.networks.values()))
    else:
        Path(networks).touch()
    write_table(history, trained.history)
    write_outcomes(outcome, trained.outcomes)


def clean(folder: Path) -> None:
    """Remove what only a killed training would need."""
    for path in folder.glob("kept-*.npz"):
        path.unlink()
