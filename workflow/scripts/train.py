"""Train the networks of a block of runs, side by side, until they are good enough or the steps are spent.

A killed job resumes where it stopped: from its checkpoint, and with the networks of the runs that had
already passed the check.
"""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch

from siq.decomposition.check import TrainingCheck, training_check
from siq.decomposition.checkpoint import load_checkpoint, save_checkpoint
from siq.decomposition.data import TrainingData, prepare_data, slowest_part
from siq.decomposition.networks import Networks, at_rest
from siq.decomposition.options import TrainingOptions
from siq.decomposition.trained import TrainedNetworks, load_networks, save_networks
from siq.decomposition.training import TrainingState, choose_device, failed_runs, start, train
from siq.errors import NumericalFailure
from siq.field_file import read_field
from siq.randomness import generator, seed_sequence
from siq.recordings import snapshot_pairs
from siq.systems import diffusion_matrix
from siq.tables import as_table, write_table
from step import job, outcome, pair_step, read_run, write_outcomes


def prepare(paths: dict[int, str], study: dict[str, Any]) -> tuple[dict[int, TrainingData], list[Any]]:
    """The data of every run of the block that has some, and the outcomes of those that have none."""
    options = TrainingOptions(**study["training"])
    data, outcomes = {}, []
    for run, path in paths.items():
        recordings = read_run(path)
        if recordings is None:
            outcomes.append(outcome(run, "train", "skipped", "the run has no trajectories"))
            continue
        try:
            pairs = snapshot_pairs(recordings, pair_step=pair_step(study))
            data[run] = prepare_data(
                pairs, options=options, generator=generator(study["seed"], run, "divide")
            )
        except NumericalFailure as error:
            outcomes.append(outcome(run, "train", "failed", str(error)))
    return data, outcomes


def prepare_checks(
    fields: dict[int, str], data: Mapping[int, TrainingData], study: dict[str, Any]
) -> dict[int, TrainingCheck]:
    """The check of every run whose vector field is known; the others train for all their steps."""
    options = TrainingOptions(**study["training"]).check
    checks = {}
    for run, part in data.items():
        record = None if options is None else read_field(fields[run])
        if record is None or options is None:
            continue
        x = part.training.x0
        try:
            checks[run] = training_check(
                record.found, x, diffusion=diffusion_matrix(study["metric"]["diffusion"], x.shape[1]),
                options=options, seed=run,
            )  # fmt: skip
        except (NumericalFailure, np.linalg.LinAlgError):
            continue
    return checks


def fingerprint(data: Mapping[int, TrainingData], fields: Mapping[int, str], study: dict[str, Any]) -> str:
    """What everything kept by a killed training must share with the one that goes on from it."""
    digest = hashlib.sha256(json.dumps([list(data), study], sort_keys=True).encode())
    for run, part in data.items():
        for values in (part.training.x0, part.training.xh, part.training.h):
            digest.update(np.ascontiguousarray(values).tobytes())
        digest.update(Path(fields[run]).read_bytes())
    return digest.hexdigest()


class Block:
    """The training of a block of runs, attempt by attempt."""

    def __init__(
        self,
        data: dict[int, TrainingData],
        checks: dict[int, TrainingCheck],
        *,
        study: dict[str, Any],
        folder: Path,
        mark: str,
        device: torch.device,
    ) -> None:
        self.data, self.checks, self.study = data, checks, study
        self.options = TrainingOptions(**study["training"])
        self.folder, self.mark, self.device = folder, mark, device
        self.passed: dict[int, TrainedNetworks] = {}
        self.last: dict[int, TrainedNetworks] = {}
        self.failures: dict[int, str] = {}
        self.histories: list[pd.DataFrame] = []

    @property
    def attempts(self) -> int:
        """How many trainings a run may have."""
        return self.options.check.attempts if self.options.check is not None and self.checks else 1

    def kept(self, name: str) -> Path:
        """A file of this very training, which a killed job leaves behind."""
        return self.folder / f"kept-{self.mark[:12]}-{name}.npz"

    def train(self) -> None:
        """All attempts, as far as they are needed."""
        for attempt in range(self.attempts):
            runs = [run for run in self.data if run not in self.passed and self.needs(run, attempt)]
            if runs:
                self._attempt(attempt, runs)

    def needs(self, run: int, attempt: int) -> bool:
        """A first training needs every run; a further one, those whose check could yet pass."""
        return attempt == 0 or (run in self.checks and self.checks[run].hopeless() is None)

    def _attempt(self, attempt: int, runs: list[int]) -> None:
        options = self.options.attempt(attempt)
        purpose = "training" if attempt == 0 else f"training {attempt}"
        seeds = [seed_sequence(self.study["seed"], run, purpose) for run in runs]
        data = [slowest_part(self.data[run], options.slowest_share) for run in runs]
        checkpoint = self.kept(f"attempt{attempt}")
        state = load_checkpoint(checkpoint, fingerprint=self.mark)
        if state is None:
            diffusion = diffusion_matrix(self.study["metric"]["diffusion"], data[0].training.x0.shape[1])
            state = start(data, options=options, diffusion=diffusion, seeds=seeds)
        early: dict[int, TrainedNetworks] = {}
        for run in runs:  # what had passed before the job was killed
            if self.kept(f"attempt{attempt}-run{run}").exists():
                early[run] = load_networks(self.kept(f"attempt{attempt}-run{run}"))

        def finished(step: int, networks: Networks) -> bool:
            for position, run in enumerate(runs):
                if run in self.checks and run not in early:
                    one = at_rest(networks, position)
                    if self.checks[run].passes(one):
                        early[run] = one
                        save_networks(self.kept(f"attempt{attempt}-run{run}"), [one])
            return len(early) == len(runs)

        if len(early) < len(runs):
            state = train(
                state, data, options=options, seeds=seeds, device=self.device,
                log_every=max(options.steps // 100, 1),
                checkpoint_every=min(1000, max(options.steps // 10, 1)),
                checkpoint=lambda state: save_checkpoint(checkpoint, state, fingerprint=self.mark),
                finished=finished,
            )  # fmt: skip
        # Kept until all attempts are over: a killed job must not train this one again.
        save_checkpoint(checkpoint, state, fingerprint=self.mark)
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

    def outcome(self, run: int, position: int) -> dict[str, Any]:
        """What became of a run."""
        if run in self.failures:
            return outcome(run, "train", "failed", self.failures[run], position=position)
        if self.options.check is None or run in self.passed:
            return outcome(run, "train", position=position)
        fault = "no vector field was identified, so that nothing could be checked"
        if run in self.checks:
            fault = self.checks[run].hopeless() or (
                f"the check passed in none of {self.attempts} trainings of {self.options.steps} steps"
            )
        return outcome(run, "train", "warning", fault, position=position)

    def history(self) -> pd.DataFrame:
        """The loss of the last training of every run."""
        latest: dict[int, pd.DataFrame] = {}
        for table in self.histories:
            latest |= {int(run): table[table["run"] == run] for run in table["run"].unique()}
        return pd.concat([latest[run] for run in sorted(latest)]) if latest else as_table("training", [])

    def clean(self) -> None:
        """Remove what only a killed job would need."""
        for path in self.folder.glob("kept-*.npz"):
            path.unlink()


def main(snakemake: Any) -> None:
    """Run as a rule's script."""
    study = snakemake.params.study
    first = int(snakemake.wildcards.block.split("-")[0])
    data, outcomes = prepare(dict(enumerate(snakemake.input.recordings, start=first)), study)
    fields = dict(enumerate(snakemake.input.fields, start=first))
    history = as_table("training", [])
    if data:
        torch.set_num_threads(snakemake.threads)
        parts = {key: study[key] for key in ("seed", "training", "metric")}
        block = Block(
            data, prepare_checks(fields, data, study), study=study,
            folder=Path(snakemake.output.networks).parent, mark=fingerprint(data, fields, parts),
            device=choose_device(snakemake.config.get("device", "auto")),
        )  # fmt: skip
        block.train()
        outcomes += [block.outcome(run, position) for position, run in enumerate(data)]
        save_networks(snakemake.output.networks, [block.last[run] for run in data])
        history = block.history()
        write_table(snakemake.output.history, as_table("training", history))
        write_outcomes(snakemake.output.outcome, outcomes)
        block.clean()
    else:
        Path(snakemake.output.networks).touch()
        write_table(snakemake.output.history, as_table("training", history))
        write_outcomes(snakemake.output.outcome, outcomes)


if __name__ == "__main__":
    with job(snakemake):  # type: ignore[name-defined]  # noqa: F821 (Snakemake puts it here)
        main(snakemake)  # type: ignore[name-defined]  # noqa: F821
