"""How much faster a training step is than the published one, side by side in one run.

    .venv/bin/python benchmarks/training_step.py

The published step has batches of 5000, double precision, the second-order Runge–Kutta rule, and takes ∇V by
automatic differentiation, so that the loss needs second derivatives.

    .venv/bin/python benchmarks/training_step.py --pairs pairs.npz
    .venv/bin/python benchmarks/training_step.py --pairs pairs.npz --devices cpu cuda --runs 50

The second form times as many trainings side by side, on two threads and on a graphics card. The first
makes the pairs for a machine that has no Numba.
"""

import argparse
import os

os.environ["OMP_NUM_THREADS"] = "1"

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
import torch
import yaml

from siq.data.recordings import SnapshotPairs, snapshot_pairs
from siq.networks import networks as networks_module
from siq.networks.decomposition import TrainingOptions
from siq.networks.networks import Layer
from siq.networks.training import prepare_data, start, train
from siq.systems.cards import load_system

Gradient = Callable[[tuple[Layer, ...], torch.Tensor], tuple[torch.Tensor, torch.Tensor]]


def automatic_gradient(layers: tuple[Layer, ...], y: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Value and gradient of the network, the gradient by a second pass of automatic differentiation."""
    with torch.enable_grad():
        y = y if y.requires_grad else y.detach().requires_grad_()
        value = networks_module._hidden(layers, y)[-1]
        (gradient,) = torch.autograd.grad(value.sum(), y, create_graph=True)
    return value, gradient


def drawn_pairs(file: Path | None) -> SnapshotPairs:
    """Pairs of the three-dimensional system, from the file where there is one, else written to it."""
    if file is not None and file.exists():
        with np.load(file) as kept:
            return SnapshotPairs(kept["x0"], kept["xh"], kept["h"], kept["recording"])
    from siq.systems.simulation import SimulationOptions, simulate_snapshots  # needs Numba

    system = load_system("config/systems/archetype3d.yaml")
    recordings = simulate_snapshots(system, options=SimulationOptions(), generator=np.random.default_rng(0))
    pairs = snapshot_pairs(recordings, pair_step=0.01)
    if file is not None:
        np.savez(file, x0=pairs.x0, xh=pairs.xh, h=pairs.h, recording=pairs.recording)
    return pairs


def training_options(study: str) -> TrainingOptions:
    """How a study of `config/studies` trains."""
    return TrainingOptions(**yaml.safe_load(Path(f"config/studies/{study}.yaml").read_text())["training"])


def compare_devices(pairs: SnapshotPairs, devices: list[str], runs: int) -> None:
    """Print what a step of all runs takes on each device, and what is left of the loss."""
    torch.set_num_threads(2)
    system = load_system("config/systems/archetype3d.yaml")
    seeds = [np.random.SeedSequence([0, run]) for run in range(runs)]
    for study, steps in (("archetype3d", 100), ("archetype3d-published", 4)):
        options = training_options(study)
        data = [
            prepare_data(pairs, options=options, generator=np.random.default_rng(run)) for run in range(runs)
        ]
        for device in devices:
            state = start(data, options=options, diffusion=system.diffusion, seeds=seeds)
            state = train(
                state, data, options=replace(options, steps=3), seeds=seeds, device=device, log_every=10**9
            )
            began = time.perf_counter()
            state = train(
                state,
                data,
                options=replace(options, steps=3 + steps),
                seeds=seeds,
                device=device,
                log_every=steps,
            )
            step = 1e3 * (time.perf_counter() - began) / steps
            loss = state.history.groupby("step")["held_out_loss"].median().iloc[-1]
            print(
                f"{study}, {runs} runs, {device}: {step:.2f} ms a step, median held-out loss {loss:.2e}",
                flush=True,
            )


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--pairs", type=Path)
    parser.add_argument("--devices", nargs="*", default=[])
    parser.add_argument("--runs", type=int, default=50)
    arguments = parser.parse_args()
    pairs = drawn_pairs(arguments.pairs)
    if arguments.devices:
        compare_devices(pairs, arguments.devices, arguments.runs)
        return
    torch.set_num_threads(1)
    system = load_system("config/systems/archetype3d.yaml")
    published = training_options("archetype3d-published")
    ours = training_options("archetype3d")
    by_hand = networks_module._value_and_gradient

    def milliseconds(options: TrainingOptions, steps: int, *, gradient: Gradient = by_hand) -> float:
        data = [prepare_data(pairs, options=options, generator=np.random.default_rng(0))]
        seeds = [np.random.SeedSequence(0)]
        state = start(data, options=options, diffusion=system.diffusion, seeds=seeds)
        with patch.object(networks_module, "_value_and_gradient", gradient):
            state = train(state, data, options=replace(options, steps=3), seeds=seeds, log_every=10**9)
            began = time.perf_counter()
            train(state, data, options=replace(options, steps=3 + steps), seeds=seeds, log_every=10**9)
        return 1e3 * (time.perf_counter() - began) / steps

    automatic = milliseconds(published, 10, gradient=automatic_gradient)
    hand = milliseconds(published, 10)
    short = milliseconds(ours, 200)
    print(f"one thread of {os.cpu_count()} cores, milliseconds a step")
    print(f"published settings, gradient by automatic differentiation {automatic:8.1f}")
    print(f"published settings, gradient by hand                      {hand:8.1f}  ({automatic / hand:.1f}x)")
    print(
        f"settings of archetype3d.yaml                              {short:8.1f}  ({automatic / short:.0f}x)"
    )


if __name__ == "__main__":
    main()
