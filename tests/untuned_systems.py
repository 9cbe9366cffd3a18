"""Systems for which nothing was ever tuned, and their recordings."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from known_systems import (
    KnownSystem,
    archetype,
    as_system,
    double_well,
    linear_system,
    maier_stein,
    polynomial_system,
)

from siq.data.recordings import Recordings
from siq.quasipotential.wells import Well
from siq.systems.equilibria import hessian_at
from siq.systems.simulation import SimulationOptions, simulate_snapshots
from siq.validation.mesh import mesh_quasipotential

SYSTEMS = {
    **{f"linear in {d} dimensions": linear_system(d) for d in range(2, 7)},
    "Maier–Stein, β = 1": maier_stein(1),
    **{
        f"polynomial in {d} dimensions, draw {s}": polynomial_system(d, seed=s)
        for d in (2, 3)
        for s in (0, 1, 2)
    },
    "archetype in 3 dimensions": archetype(3),
    "gradient system": double_well(2),
}


def simulated(
    known: KnownSystem, *, trajectories: int = 1000, pairs: int = 30, seed: int = 1
) -> tuple[Recordings, float]:
    """Recordings of a known system, sampled by its own time scales."""
    rates = [
        np.linalg.eigvals(known.dynamics.jacobian(one[None])[0]).real.max() for one in known.attractors
    ] or [-1.0]
    speed = np.quantile(
        np.linalg.norm(
            known.dynamics.jacobian(
                np.random.default_rng(0).uniform(
                    known.domain[:, 0], known.domain[:, 1], (500, len(known.domain))
                )
            ),
            axis=(1, 2),
        ),
        0.9,
    )
    relaxation = 1 / -max(rates)
    step = float(min(0.01, 0.1 / speed))
    # Where f is very fast somewhere, recordings that last until all is at rest would take too many steps.
    stride = min(max(math.ceil(3 * relaxation / pairs / (step / 5)), 6), 300)
    system = as_system(known)
    options = SimulationOptions(
        trajectories=trajectories, pairs=pairs, pair_step=step, interval=stride * step / 5
    )
    return simulate_snapshots(system, options=options, generator=np.random.default_rng(seed)), step


def error_beside_mesh(known: KnownSystem, wells: Sequence[Well]) -> float:
    """Relative L2 error of V where the wells claim to hold, against the mesh of two states; the worst."""
    x = np.random.default_rng(0).uniform(known.domain[:, 0], known.domain[:, 1], (20_000, 2))
    errors = []
    for well in wells:
        mesh = mesh_quasipotential(
            known.dynamics.drift, well.attractor, hessian=hessian_at(known.dynamics, well.attractor),
            box=known.domain, shape=(512, 512), diffusion=known.dynamics.diffusion, level=well.level,
            stop_at_boundary=False,
        )  # fmt: skip
        exact = mesh.evaluate(x)
        claimed = np.isfinite(exact) & (exact < 0.9 * well.level) & well.believed(x)
        assert claimed.sum() > 100
        own, exact = well.values(x[claimed]), exact[claimed]
        errors.append(float(np.linalg.norm(own - exact) / np.linalg.norm(exact)))
    return max(errors)
