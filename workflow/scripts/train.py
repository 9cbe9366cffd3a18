"""Train the networks of a block of runs, side by side, resuming where a killed job stopped."""

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import torch

from siq.decomposition.data import TrainingData, prepare_data
from siq.decomposition.options import TrainingOptions
from siq.decomposition.storage import load_checkpoint, save_checkpoint, save_networks
from siq.decomposition.training import TrainingState, choose_device, failed_runs, start, train
from siq.errors import NumericalFailure
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


def fingerprint(data: dict[int, TrainingData], study: dict[str, Any]) -> str:
    """What a checkpoint must share with the training that goes on from it."""
    digest = hashlib.sha256(json.dumps([list(data), study], sort_keys=True).encode())
    for run in data.values():
        for values in (run.training.x0, run.training.xh, run.training.h):
            digest.update(np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()


def main(snakemake: Any) -> None:
    """Run as a rule's script."""
    study = snakemake.params.study
    first = int(snakemake.wildcards.block.split("-")[0])
    data, outcomes = prepare(dict(enumerate(snakemake.input.recordings, start=first)), study)
    runs = list(data)
    options = TrainingOptions(**study["training"])
    history = as_table("training", [])
    if runs:
        torch.set_num_threads(snakemake.threads)
        seeds = [seed_sequence(study["seed"], run, "training") for run in runs]
        mark = fingerprint(data, {key: study[key] for key in ("seed", "training", "metric")})
        state = load_checkpoint(snakemake.params.checkpoint, fingerprint=mark)
        if state is None:
            dimension = next(iter(data.values())).training.x0.shape[1]
            diffusion = diffusion_matrix(study["metric"]["diffusion"], dimension)
            state = start(list(data.values()), options=options, diffusion=diffusion, seeds=seeds)

        def keep(state: TrainingState) -> None:
            save_checkpoint(snakemake.params.checkpoint, state, fingerprint=mark)

        state = train(
            state,
            list(data.values()),
            options=options,
            seeds=seeds,
            device=choose_device(snakemake.config.get("device", "auto")),
            log_every=max(options.steps // 100, 1),
            checkpoint_every=min(1000, max(options.steps // 10, 1)),
            checkpoint=keep,
        )
        failures = failed_runs(state)
        for position, run in enumerate(runs):
            reason = failures.get(position)
            status = "ok" if reason is None else "failed"
            outcomes.append(outcome(run, "train", status, reason or "", position=position))
        history = state.history.assign(run=state.history["run"].map(dict(enumerate(runs))))
        save_networks(snakemake.output.networks, state.networks)
    else:
        Path(snakemake.output.networks).touch()
    write_table(snakemake.output.history, as_table("training", history))
    write_outcomes(snakemake.output.outcome, outcomes)
    Path(snakemake.params.checkpoint).unlink(missing_ok=True)


if __name__ == "__main__":
    with job(snakemake):  # type: ignore[name-defined]  # noqa: F821 (Snakemake puts it here)
        main(snakemake)  # type: ignore[name-defined]  # noqa: F821
