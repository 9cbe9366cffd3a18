"""What agreement of the two routes tells, where no training was selected by it.

    .venv/bin/python benchmarks/agreement.py

A study trains until the networks agree with the local route, so that the agreement of its certificates is no
evidence from elsewhere. Here many small networks are trained without that check, some of them far too
briefly, and the V of each is refined by the network route and held against the local route and the exact V.
"""

import os

os.environ["OMP_NUM_THREADS"] = "1"

import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from known_systems import (
    KnownSystem,
    archetype,
    as_system,
    double_well,
    exact_field,
    linear_system,
    maier_stein,
    portrait_of,
    potential_values,
)

from siq.errors import NumericalFailure
from siq.inference.field_estimate import FieldEstimate
from siq.networks.decomposition import TrainedNetworks, TrainingOptions
from siq.quasipotential.certificate import MIN_DIFFERENCE
from siq.quasipotential.certificate_tests import (
    Candidate,
    CertificateOptions,
)
from siq.quasipotential.hamilton_jacobi import LibraryBasis
from siq.quasipotential.refinement import RefinementOptions, local_wells, refine
from siq.systems.phase_portrait import PhasePortrait
from siq.systems.simulation import SimulationOptions, simulate_snapshots
from siq.workflow import training
from siq.workflow.study import PipelineSettings, Sampling, StateSpace

SYSTEMS = {
    "Maier–Stein, β = 1": (maier_stein(1), 3),
    "linear": (linear_system(2, rotation=1.0), 1),
    "linear, turning": (linear_system(2), 1),
    "double well": (double_well(2), 3),
    "archetype, 3 states": (archetype(3), 3),
}
TRAININGS = 20  # of each system and length
STEPS = (3, 50, 400)
WRONG = 0.05  # relative L2 difference from the exact V in a well, above which V is wrong
LIMITS = CertificateOptions()
SIMULATION = SimulationOptions(trajectories=60, pairs=20, pair_step=0.01, interval=0.1)


def networks_of(known: KnownSystem, steps: int) -> list[TrainedNetworks]:
    """Networks of `TRAININGS` runs, each with recordings of its own, trained side by side."""
    options = TrainingOptions(widths=(16, 16), steps=steps, check=None, batch_size=128)
    space = StateSpace(diffusion=known.diffusion.tolist())
    settings = PipelineSettings(seed=steps, space=space, sampling=Sampling(pair_step=0.01), training=options)
    runs = {}
    for number in range(TRAININGS):
        draw = np.random.default_rng([steps, number])
        recordings = simulate_snapshots(as_system(known), options=SIMULATION, generator=draw)
        runs[number] = training.RunToTrain(recordings, None)
    return list(training.train_block(settings, runs, device="cpu").networks.values())


def about_attractors(
    found: FieldEstimate, portrait: PhasePortrait, network: Callable[[np.ndarray], np.ndarray] | None
) -> list[Candidate] | None:
    """V about every attractor by one route; None where it found none."""
    options = RefinementOptions(routes=("local",) if network is None else ("network",))
    if network is None:
        wells, _ = local_wells(found, portrait, options=options)
    else:
        refined = refine(
            found, portrait, formula=None, network=network, points=portrait.points,
            options=options,
        )  # fmt: skip
        wells = refined.network_wells
        if refined.formula is not None:
            basis = LibraryBasis(refined.found.library, np.flatnonzero(refined.formula.potential))
            own = refined.formula.potential[basis.chosen]
            return [
                Candidate(
                    lambda x: basis.values(x) @ own, lambda x: basis.gradients(x) @ own,
                    lambda x: basis.hessians(x) @ own, None, portrait.points, [one],
                )
                for one in portrait.attractors
            ]  # fmt: skip
    if len(wells) < len(portrait.attractors):
        return None
    return [
        Candidate(well.values, well.gradients, well.hessians, None, well.inside(), [one])
        for well, one in zip(wells, portrait.attractors, strict=True)
    ]


def difference(one: Candidate, other: Callable[[np.ndarray], np.ndarray], x: np.ndarray) -> float:
    """Relative L2 difference of V on points of a well, both zero at its attractor."""
    center = one.attractors[0].position[None]
    mine, theirs = (values(x) - values(center) for values in (one.values, other))
    return float(np.linalg.norm(mine - theirs) / np.linalg.norm(theirs))


def judged(
    known: KnownSystem, found: FieldEstimate, local: Sequence[Candidate], network: Sequence[Candidate]
) -> list[str]:
    """What is to be counted of one training."""
    said, agree, wrong = ["formula"], True, False
    solve = True
    for one, two in zip(network, local, strict=True):
        x = two.points
        for candidate in (one, two):
            solve &= candidate.check_hamilton_jacobi(found, LIMITS).passed
        errors = (candidate.stated_error(found) for candidate in (one, two))
        limit = MIN_DIFFERENCE + sum(min(error, LIMITS.error) for error in errors)
        agree &= difference(one, two.values, x) <= limit
        wrong |= difference(one, lambda y: potential_values(known, y), x) > WRONG
    said += ["solve"] * solve + ["agree"] * agree + ["wrong"] * wrong
    said += ["solve, wrong"] * (solve and wrong) + ["agree, wrong"] * (agree and wrong)
    return said


def main() -> None:
    """Measure and print."""
    torch.set_num_threads(1)
    began = time.perf_counter()
    keys = ("formula", "solve", "agree", "solve, wrong", "agree, wrong")
    print("| system | steps | trainings | a formula | both solve | agree | solve, wrong | agree, wrong |")
    print("|---|---|---|---|---|---|---|---|")
    total: Counter[str] = Counter()
    for name, (known, degree) in SYSTEMS.items():
        found, portrait = exact_field(known, degree), portrait_of(known, 400, share=0.8)
        local = about_attractors(found, portrait, None)
        assert local is not None
        for steps in STEPS:
            counted: Counter[str] = Counter()
            for trained in networks_of(known, steps):
                counted["trainings"] += 1
                try:
                    network = about_attractors(found, portrait, trained.potential_at)
                except (NumericalFailure, np.linalg.LinAlgError):
                    network = None
                if network is not None:
                    counted.update(judged(known, found, local, network))
            total += counted
            row = " | ".join(str(counted[key]) for key in keys)
            print(f"| {name} | {steps} | {counted['trainings']} | {row} |", flush=True)
    row = " | ".join(str(total[key]) for key in keys)
    print(f"| all | | {total['trainings']} | {row} |")
    print(f"{time.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    main()
