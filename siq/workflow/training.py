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
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import torch

from siq.data.recordings import Recordings, snapshot_pairs
from siq.errors import NumericalFailure
from siq.inference.identification import FieldRecord
from siq.networks.decomposition import TrainedNetworks, TrainingOptions, load_networks, save_networks
from siq.networks.networks import Networks, at_rest
from siq.networks.training import (
    TrainingData,
    TrainingState,
    failed_runs,
    load_checkpoint,
    save_checkpoint,
    slowest_part,
    start,
    train,
)
from siq.numerics.randomness import Purpose, generator, seed_sequence
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


def not_trained(number: int) -> TrainedRun:
    """A run for which no networks were asked."""
    return TrainedRun(None, Outcome(number, Step.TRAIN, Status.SKIPPED, "no networks were asked for"))


def trained_run(
    networks: Mapping[int, TrainedNetworks] | None, outcomes: Sequence[Outcome] | None, *, number: int
) -> TrainedRun:
    """The networks of run `number` from those of its block by position; None where none were asked for."""
    if networks is None or outcomes is None:
        return not_trained(number)
    mine = next(one for one in outcomes if one.run == number)
    return TrainedRun(networks[mine.details[POSITION]] if mine.usable else None, mine)


LOGGED = 100  # times in a training at which its loss is logged
CHECKPOINT = 1000  # steps between two checkpoints, at most


@dataclass(frozen=True)
class Kept:
    """What a killed training leaves behind for the one that goes on from it.

    Attributes
    ----------
    folder
        Where its files lie; None keeps nothing.
    mark
        Fingerprint of the data and settings: files of another training are passed over.
    """

    folder: Path | None
    mark: str

    def _file(self, name: str) -> Path | None:
        return None if self.folder is None else self.folder / f"kept-{self.mark[:12]}-{name}.npz"

    def state(self, attempt: int) -> TrainingState | None:
        """How far an attempt had come."""
        file = self._file(f"attempt{attempt}")
        return None if file is None else load_checkpoint(file, fingerprint=self.mark)

    def keep_state(self, attempt: int, state: TrainingState) -> None:
        """Keep how far an attempt has come."""
        if (file := self._file(f"attempt{attempt}")) is not None:
            save_checkpoint(file, state, fingerprint=self.mark)

    def passed(self, attempt: int, run: int) -> TrainedNetworks | None:
        """Networks of a run that had passed the check in an attempt."""
        file = self._file(f"attempt{attempt}-run{run}")
        return load_networks(file) if file is not None and file.exists() else None

    def keep_passed(self, attempt: int, run: int, networks: TrainedNetworks) -> None:
        """Keep networks that have passed the check."""
        if (file := self._file(f"attempt{attempt}-run{run}")) is not None:
            save_networks(file, [networks])


class Block:
    """The training of a block of runs.

    Parameters
    ----------
    data
        Pairs by run.
    checks
        When the training of a run may end, for those where that is known.
    options
        What the networks are told.
    diffusion
        D.
    seed
        Of the study.
    kept
        What is left behind for a job that goes on from here.
    device
        Where it is computed.
    faults
        Why some runs have no check, in words.
    """

    def __init__(
        self,
        data: Mapping[int, TrainingData],
        checks: Mapping[int, TrainingCheck],
        *,
        options: TrainingOptions,
        diffusion: Diffusion,
        seed: int,
        kept: Kept,
        device: torch.device,
        faults: Mapping[int, str] | None = None,
    ) -> None:
        self.data, self.checks, self.options = data, checks, options
        self.diffusion, self.seed = diffusion, seed
        self.kept, self.device, self.faults = kept, device, faults or {}
        self.passed: dict[int, TrainedNetworks] = {}
        self.last: dict[int, TrainedNetworks] = {}
        self.failures: dict[int, str] = {}
        self.histories: list[pd.DataFrame] = []

    @property
    def attempts(self) -> int:
        """How many trainings a run may have."""
        return self.options.check.attempts if self.options.check is not None and self.checks else 1

    def train(self) -> None:
        """All attempts, as far as they are needed."""
        for attempt in range(self.attempts):
            runs = [run for run in self.data if run not in self.passed and self._needs(run, attempt)]
            if runs:
                self._attempt(attempt, runs)

    def _needs(self, run: int, attempt: int) -> bool:
        """A first training needs every run; a further one, those whose check could yet pass."""
        return attempt == 0 or (run in self.checks and self.checks[run].hopeless() is None)

    def _attempt(self, attempt: int, runs: list[int]) -> None:
        options = self.options.attempt(attempt)
        purpose = Purpose.TRAINING if attempt == 0 else f"{Purpose.TRAINING} {attempt}"
        seeds = [seed_sequence(self.seed, run, purpose) for run in runs]
        data = [slowest_part(self.data[run], options.slowest_share) for run in runs]
        state = self.kept.state(attempt)
        if state is None:
            state = start(data, options=options, diffusion=self.diffusion, seeds=seeds)
        early: dict[int, TrainedNetworks] = {}
        for run in runs:  # what had passed before the job was killed
            if (before := self.kept.passed(attempt, run)) is not None:
                early[run] = before

        def finished(step: int, networks: Networks) -> bool:
            for position, run in enumerate(runs):
                if run in self.checks and run not in early:
                    one = at_rest(networks, position)
                    if self.checks[run].passes(one):
                        early[run] = one
                        self.kept.keep_passed(attempt, run, one)
            return len(early) == len(runs)

        if len(early) < len(runs):
            state = train(
                state, data, options=options, seeds=seeds, device=self.device,
                log_every=max(options.steps // LOGGED, 1),
                checkpoint_every=min(CHECKPOINT, max(options.steps // 10, 1)),
                checkpoint=lambda state: self.kept.keep_state(attempt, state),
                finished=finished,
            )  # fmt: skip
        # Kept until all attempts are over: a killed job must not train this one again.
        self.kept.keep_state(attempt, state)
        self._conclude(state, runs, early)

    def _conclude(self, state: TrainingState, runs: list[int], early: dict[int, TrainedNetworks]) -> None:
        self.passed |= early
        lost = failed_runs(state)
        for position, run in enumerate(runs):
            self.last[run] = early.get(run, at_rest(state.networks, position))
            self.failures.pop(run, None)
            if run not in early and position in lost:
                self.failures[run] = lost[position]
        history = state.history
        self.histories.append(history.assign(run=history["run"].map(dict(enumerate(runs)))))

    def outcome(self, run: int) -> Outcome:
        """What became of a run."""
        details = {POSITION: list(self.data).index(run)}
        if run in self.failures:
            return Outcome(run, Step.TRAIN, Status.FAILED, self.failures[run], details)
        if self.options.check is None or run in self.passed:
            return Outcome(run, Step.TRAIN, Status.OK, "", details)
        return Outcome(run, Step.TRAIN, Status.WARNING, self._unchecked(run), details)

    def _unchecked(self, run: int) -> str:
        """Why the check of a run has not passed."""
        if run in self.checks:
            return self.checks[run].hopeless() or (
                f"the check passed in none of {self.attempts} trainings of {self.options.steps} steps"
            )
        return self.faults.get(run, "no vector field was identified, so that nothing could be checked")

    def history(self) -> pd.DataFrame:
        """The loss of the last training of every run."""
        latest: dict[int, pd.DataFrame] = {}
        for table in self.histories:
            latest |= {int(run): table[table["run"] == run] for run in table["run"].unique()}
        return pd.concat([latest[run] for run in sorted(latest)]) if latest else as_table("training", [])


if TYPE_CHECKING:
    from siq.networks.training import TrainingData
    from siq.quasipotential.refinement import TrainingCheck

MOST_POINTS = 10_000  # over which a D that depends on the state is averaged


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

    def files(self) -> dict[str, Any]:
        """By the names of the rule."""
        networks = list(self.networks.values())
        return {"networks": networks or None, "history": self.history, "train_outcome": self.outcomes}


@plain_dataclass(frozen=True)
class Checks:
    """When the training of each run may end; of those that have no check, why not."""

    ready: Mapping[int, TrainingCheck]
    faults: Mapping[int, str]


def train_block(
    settings: PipelineSettings,
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
    assert settings.training is not None  # networks are asked for
    data, outcomes = _training_data(settings, runs)
    if not data:
        return Trained({}, as_table("training", []), tuple(outcomes))

    from siq.networks.training import choose_device  # torch takes seconds to import

    checks = _checks(settings, runs, data)
    block = Block(
        data,
        checks.ready,
        options=settings.training,
        diffusion=_diffusion(settings, runs, data),
        seed=settings.seed,
        kept=Kept(folder, _fingerprint(settings, runs, data)),
        device=choose_device(device),
        faults=checks.faults,
    )
    block.train()
    outcomes += [block.outcome(number) for number in data]
    networks = {number: block.last[number] for number in data}
    return Trained(networks, as_table("training", block.history()), tuple(outcomes))


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
    if not all(record.found.diffusion.constant for record in records):
        # Networks only lead to the right solution, which is then found with D as it is.
        points = np.concatenate([data[number].training.x0 for number in data])
        every = max(len(points) // MOST_POINTS, 1)
        noises = [record.found.diffusion.at(points[::every]).mean(axis=0) for record in records]
        return Diffusion(np.mean(noises, axis=0))
    return Diffusion(np.mean([record.found.diffusion.matrix for record in records], axis=0))


def _training_data(
    settings: PipelineSettings, runs: Mapping[int, RunToTrain]
) -> tuple[dict[int, TrainingData], list[Outcome]]:
    """The data of every run of the block that has some, and the outcomes of those that have none."""
    from siq.networks.training import prepare_data

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
) -> Checks:
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
            ready[number] = TrainingCheck(record.found, x, options=options, seed=number)
        except (NumericalFailure, np.linalg.LinAlgError) as error:
            faults[number] = f"the check of the training could not be prepared: {error}"
    return Checks(ready, faults)


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
            noise = record.found.diffusion.at(part.training.x0[:1])
            arrays += [record.found.coefficients, record.found.covariance, noise]
        for values in arrays:
            digest.update(np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()


def clean(folder: Path) -> None:
    """Remove what only a killed training would need."""
    for path in folder.glob("kept-*.npz"):
        path.unlink()
