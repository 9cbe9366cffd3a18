"""How much faster a training step is than the published one, side by side in one run.

    .venv/bin/python benchmarks/training_step.py

The published step has batches of 5000, double precision, the second-order Runge–Kutta rule, and takes ∇V by
automatic differentiation, so that the loss needs second derivatives.
"""

import os

os.environ["OMP_NUM_THREADS"] = "1"

import time
from collections.abc import Callable
from dataclasses import replace
from unittest.mock import patch

import numpy as np
import torch

from siq.data.recordings import snapshot_pairs
from siq.networks import networks as networks_module
from siq.networks.decomposition import TrainingOptions
from siq.networks.networks import Layer
from siq.networks.training import prepare_data, start, train
from siq.systems.cards import load_system
from siq.systems.simulation import SimulationOptions, simulate_snapshots
from siq.workflow.study import load_study

Gradient = Callable[[tuple[Layer, ...], torch.Tensor], tuple[torch.Tensor, torch.Tensor]]


def automatic_gradient(layers: tuple[Layer, ...], y: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Value and gradient of the network, the gradient by a second pass of automatic differentiation."""
    with torch.enable_grad():
        y = y if y.requires_grad else y.detach().requires_grad_()
        value = networks_module._hidden(layers, y)[-1]
        (gradient,) = torch.autograd.grad(value.sum(), y, create_graph=True)
    return value, gradient


def main() -> None:
    """Measure and print."""
    torch.set_num_threads(1)
    system = load_system("config/systems/archetype3d.yaml")
    recordings = simulate_snapshots(system, options=SimulationOptions(), generator=np.random.default_rng(0))
    pairs = snapshot_pairs(recordings, pair_step=0.01)
    published = load_study("config/studies/archetype3d-published.yaml").training
    ours = load_study("config/studies/archetype3d.yaml").training
    assert published is not None and ours is not None
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
