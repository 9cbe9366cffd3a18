"""Train the networks of a block of runs side by side: files in, one step, files out."""

from workflow.warm import run_warm

run_warm()

from pathlib import Path

import torch
import torch._dynamo  # the first optimiser loads it: once for all runs

from siq.workflow import training_step
from step import job

if __name__ == "__main__":
    with job() as now:
        torch.set_num_threads(now.threads)
        folder = Path(now.output.networks).parent
        first = int(now.wildcards.block.split("-")[0])
        runs = training_step.read(now.input.recordings, now.input.fields, first=first)
        device = now.config.get("device", "auto")
        trained = training_step.run(
            now.settings(training_step.TrainSettings), runs, folder=folder, device=device
        )
        training_step.write(
            trained, networks=now.output.networks, history=now.output.history, outcome=now.output.outcome
        )
        training_step.clean(folder)
