"""The training of a block of runs side by side, attempt by attempt, and what a killed job goes on from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import pandas as pd
import torch

from siq.dynamics.diffusion import Diffusion
from siq.networks.checkpoint import load_checkpoint, save_checkpoint
from siq.networks.data import TrainingData, slowest_part
from siq.networks.networks import Networks, at_rest
from siq.networks.options import TrainingOptions
from siq.networks.trained import TrainedNetworks, load_networks, save_networks
from siq.networks.training import TrainingState, failed_runs, start, train
from siq.numerics.randomness import Purpose, seed_sequence
from siq.potential.training_check import TrainingCheck
from siq.steps.outcomes import Outcome, Status, Step
from siq.steps.trained import POSITION
from siq.study.tables import as_table

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
