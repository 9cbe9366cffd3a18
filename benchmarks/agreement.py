"""What agreement of the networks' own V with the refined one tells.

    .venv/bin/python benchmarks/agreement.py
    .venv/bin/python benchmarks/agreement.py --recordings 2 --system linear
    .venv/bin/python benchmarks/agreement.py --noise 0.02

The refined V follows from the identified f, without networks. Here networks are trained on many recordings,
as studies train them, which ends with output weights, and by steps of descent alone, most of them far too
few; with ``--noise`` on more recordings, with noise of that ε. Their V is compared with the refined one as in
every certificate, and with the exact one where agreement says something: of networks by well in each well by
itself, up to `LEVEL_SHARE` of its level.
"""

import os

os.environ["OMP_NUM_THREADS"] = "1"

import argparse
import sys
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from known_systems import (
    KnownSystem,
    archetype,
    as_system,
    double_well,
    linear_system,
    maier_stein,
    potential_values,
)

from siq.data.recordings import Recordings, snapshot_pairs
from siq.networks.decomposition import AnyNetworks, NetworksByWell, TrainingOptions
from siq.quasipotential.certificate_tests import LEVEL_SHARE
from siq.systems.simulation import SimulationOptions, simulate_snapshots
from siq.workflow.pipeline import analyse
from siq.workflow.study import PipelineSettings, Sampling, StateSpace
from siq.workflow.tables import Method

SYSTEMS = {
    "Maier–Stein, β = 1": maier_stein(1),
    "linear": linear_system(2, rotation=1.0),
    "linear, turning": linear_system(2),
    "double well": double_well(2),
    "archetype, 3 states": archetype(3),
}
TRAININGS = {
    "as in studies": TrainingOptions(output_weights=200),
    **{
        f"{steps} steps": TrainingOptions(widths=(16, 16), steps=steps, check=None, batch_size=128)
        for steps in (3, 50, 400)
    },
}
WRONG = 0.05  # relative difference from the exact V, in the lowest states, above which V is wrong
LOWEST = 0.75  # of the recorded states, by V, where one V stands for all
SIMULATION = SimulationOptions(trajectories=60, pairs=20, pair_step=0.01, interval=0.1)
NOISY_TRAJECTORIES, NOISY_UNITS = 3000, 100  # with noise pairs tell less of f, and of units
COUNTED = ("agree", "wrong", "agree, wrong", "the control agrees")


def error_of(networks: AnyNetworks, known: KnownSystem, recordings: Recordings) -> float:
    """Of the networks' V, up to a constant and relative to how much V varies; of the worst well by itself."""
    x = snapshot_pairs(recordings).x0
    exact = potential_values(known, x)
    parts = [x[exact < np.quantile(exact, LOWEST)]]
    if isinstance(networks, NetworksByWell):
        parts = [networks.below(LEVEL_SHARE, one.mean[0], x) for one in networks.parts]
    pairs = [(networks.potential_at(each), potential_values(known, each)) for each in parts]
    return max(float((own - exact).std() / exact.std()) for own, exact in pairs)


def judged(known: KnownSystem, training: TrainingOptions, number: int, *, noise: float = 0.0) -> list[str]:
    """What is to be counted of one training, with or without noise in the recordings."""
    simulation, sampling = SIMULATION, Sampling(pair_step=SIMULATION.pair_step)
    if noise:
        simulation = replace(simulation, trajectories=NOISY_TRAJECTORIES, noise_intensity=noise)
        sampling = replace(sampling, integrator_step=simulation.pair_step / simulation.substeps)
        training = replace(training, output_weights=NOISY_UNITS)
    recordings = simulate_snapshots(
        as_system(known), options=simulation, generator=np.random.default_rng(number)
    )
    settings = PipelineSettings(
        seed=number, space=StateSpace(diffusion=known.diffusion.tolist()), sampling=sampling,
        training=training, published_method=False, landscape=None,
    )  # fmt: skip
    found = analyse(recordings, settings, device="cpu")
    assert found.trained.result is not None
    agree, control = (
        found.refined.certificates[method]["tests"]["agreement"]["passed"]
        for method in (Method.REFINED, Method.CONTROL)
    )
    wrong = error_of(found.trained.result, known, recordings) > WRONG
    return [
        name for name, holds in zip(COUNTED, (agree, wrong, agree and wrong, control), strict=True) if holds
    ]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--recordings", type=int, default=5, help="sets of them, for each system")
    parser.add_argument("--system", choices=SYSTEMS, help="one of the systems alone")
    parser.add_argument("--noise", type=float, default=0.0, metavar="ε", help="intensity; none by default")
    asked = parser.parse_args()
    torch.set_num_threads(1)
    began = time.process_time()
    print(f"| system | training | trainings | {' | '.join(COUNTED)} |")
    print("|---|---|---|" + "---|" * len(COUNTED))
    total: Counter[str] = Counter()
    for name in [asked.system] if asked.system else SYSTEMS:
        for how, training in TRAININGS.items():
            counted: Counter[str] = Counter()
            for number in range(asked.recordings):
                counted.update(["trainings", *judged(SYSTEMS[name], training, number, noise=asked.noise)])
            total += counted
            row = " | ".join(str(counted[key]) for key in ("trainings", *COUNTED))
            print(f"| {name} | {how} | {row} |", flush=True)
    print(f"| all | | {' | '.join(str(total[key]) for key in ('trainings', *COUNTED))} |")
    print(f"{time.process_time() - began:.0f} CPU s")


if __name__ == "__main__":
    main()
