"""The barriers that QPot publishes for a consumer and its resource, beside ours and direct simulation.

    .venv/bin/python benchmarks/published_barriers.py

Published are Φ = U/2 at the saddle above each stable state (Moore, Stieha, Nolting, Cameron and Abbott 2016,
The R Journal 8: 19, step 4 of their first example), from an ordered upwind method on 4100 × 4100 nodes.
Direct simulation takes no side: the logarithm of the mean escape time rises by ΔU for each unit of 1/ε.
"""

import os

os.environ["OMP_NUM_THREADS"] = "1"

from pathlib import Path

import numpy as np

from siq.quasipotential.landscape_assembly import EquationSettings, landscape_from_equations
from siq.systems.cards import load_system
from siq.systems.escapes import Neighbourhood, simulate_escapes

CARD = Path(__file__).parents[1] / "config" / "systems" / "consumer-resource.yaml"
PUBLISHED = (0.007056, 0.00092975)  # Φ of the saddle from (1.4049, 2.8081) and from (4.9040, 4.0619)
SIMULATED = ((2.0e-3, 1000), (1.6e-3, 1000), (1.4e-3, 600))  # ε and walkers, out of the first
DEEP = 0.2  # of the other barrier: so near to its attractor somebody has arrived
FOLLOWED = 60  # times the mean that the law foretells


if __name__ == "__main__":
    system = load_system(CARD)
    found = landscape_from_equations(system, EquationSettings(), formulas=False)
    for way, published in zip(found.transitions, PUBLISHED, strict=True):
        ours = way.barrier / 2
        print(f"from A{way.start + 1}: ours {ours:.8f}, published {published:g}, {published / ours - 1:+.1%}")
    first, second = found.transitions
    assert first.rate is not None
    start, end = (one.position for one in found.attractors)
    target = Neighbourhood.about(system, end, level=DEEP * second.barrier / 2)
    inverse, logarithm, error = [], [], []
    for number, (noise, walkers) in enumerate(SIMULATED):
        foretold = first.rate.prefactor * np.exp(first.barrier / noise)
        seen = simulate_escapes(
            system, start, [target], intensity=noise, longest=FOLLOWED * foretold, walkers=walkers,
            generator=np.random.default_rng(number),
        )  # fmt: skip
        print(
            f"ε = {noise:g}: {seen.mean:.0f} ± {seen.standard_error:.0f}, {seen.escapes} escapes", flush=True
        )
        inverse.append(1 / noise)
        logarithm.append(np.log(seen.mean))
        error.append(seen.standard_error / seen.mean)
    (slope, _), covariance = np.polyfit(inverse, logarithm, 1, w=1 / np.array(error), cov="unscaled")
    print(
        f"ΔU by the slope {slope:.5f} ± {covariance[0, 0] ** 0.5:.5f}; ours {first.barrier:.5f}, published",
        f"{2 * PUBLISHED[0]:.5f}",
    )
