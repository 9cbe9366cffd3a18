"""How long the published sampling takes: 5000 trajectories of 50 pairs, and their representative subset.

    .venv/bin/python benchmarks/sampling.py

Prints seconds, and as a yardstick of the same machine in the same run the ratio to a plain numpy
integration with powers written as ``**``.
"""

import os

os.environ["OMP_NUM_THREADS"] = "1"

import time
from collections.abc import Callable

import numpy as np

from siq.numerics.integration import runge_kutta_step
from siq.numerics.randomness import representative_subset
from siq.systems.cards import load_system
from siq.systems.simulation import SimulationOptions, simulate_snapshots


def plain_field(x: np.ndarray) -> np.ndarray:
    """The archetypal vector field as one would type it."""
    return np.stack(
        [
            -2 * (x[0] ** 3 - x[0]) - x[1] - x[2],
            -x[1] + 2 * (x[0] ** 3 - x[0]),
            -x[2] + 2 * (x[0] ** 3 - x[0]),
        ]
    )


def seconds(function: Callable[[], object]) -> float:
    """Best of three."""
    times = []
    for _ in range(3):
        began = time.perf_counter()
        function()
        times.append(time.perf_counter() - began)
    return min(times)


def main() -> None:
    """Measure and print."""
    system = load_system("config/systems/archetype3d.yaml")
    options = SimulationOptions()
    recordings = simulate_snapshots(system, options=options, generator=np.random.default_rng(0))
    points = recordings.values[::2]
    x = np.random.default_rng(0).uniform(-1, 1, (3, options.trajectories))
    steps = 200

    def integrate(field: Callable[[np.ndarray], np.ndarray]) -> None:
        state = x
        for _ in range(steps):
            state = runge_kutta_step(field, state, 0.002)

    simulating = seconds(
        lambda: simulate_snapshots(system, options=options, generator=np.random.default_rng(0))
    )
    thinning = seconds(
        lambda: representative_subset(points, distance=0.1, generator=np.random.default_rng(0))
    )
    ratio = seconds(lambda: integrate(plain_field)) / seconds(lambda: integrate(system.drift_of_components))
    print(f"{os.cpu_count()} cores; simulation {simulating:.2f} s, thinning {thinning:.2f} s")
    print(f"a step of the plain field takes {ratio:.1f} times as long as the compiled one")


if __name__ == "__main__":
    main()
