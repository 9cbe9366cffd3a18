"""A double well on which a slow force acts that was not recorded: what is found, and what is true.

    python -m benchmarks.slow_forces [--times 0.3 1 3 10] [--sizes 0.25 0.4] [--seeds 0 1] [--samples 20000]

``dx = (x - x³ + z) dt + √ε dW``, ``dz = -z/τ dt + s √(2/τ) dW`` with ε = 0.2, sampled every 0.1: τ is 3 to
100 samples. Of x alone siq has to find the force, its τ, barriers in the plane of both, and mean visits. The
true barriers are those of the equations; true visits are counted in 20 times as many samples of x and z, from
core to core of what was found. Each line of the table has by how many standard errors an answer is off.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pandas as pd
import sympy

from siq.data.recordings import Recordings
from siq.quasipotential.landscape import Landscape
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics
from siq.workflow.pipeline import analyse

INTENSITY, STEP, WITHIN, LONGER = 0.2, 0.1, 10, 20


@numba.njit(cache=True)
def _simulated(
    count: int, time: float, size: float, step: float, within: int, draw: np.random.Generator
) -> np.ndarray:
    path, x, z = np.empty((count, 2)), 1.0, 0.0
    for place in range(-200, count):
        for _ in range(within):
            x += step * (x - x**3 + z) + np.sqrt(INTENSITY * step) * draw.standard_normal()
            z += -step * z / time + size * np.sqrt(2 * step / time) * draw.standard_normal()
        if place >= 0:
            path[place] = x, z
    return path


def true_barrier(time: float, size: float) -> float:
    """ΔU/ε of the equations."""
    x, z = sympy.symbols("x z", real=True)
    noise = Diffusion(np.diag([INTENSITY, 2 * size**2 / time]))
    deviation = 6 * size
    system = Dynamics.of(
        (x, z), (x - x**3 + z, -z / time), domain=[(-2, 2), (-deviation, deviation)], diffusion=noise
    )
    return float(Landscape.from_equations(system).barriers()["barrier"].min())


def counted(found: Landscape, path: np.ndarray) -> dict[int, tuple[float, int]]:
    """Mean visit and number of visits to each core, in a path ``(n, 2)`` of x and z."""
    assert found.noise is not None
    heights = np.array([one.height(path.T) for one in found._cores(found.noise.intensity)])
    core = np.where(heights.min(axis=0) <= 1, heights.argmin(axis=0), -1)
    known = np.maximum.accumulate(np.where(core >= 0, np.arange(len(core)), 0))
    side = core[known]
    return {
        well: ((side == well).sum() * STEP / max(ends, 1), ends)
        for well in range(len(heights))
        for ends in [int(((side[:-1] == well) & (side[1:] != well)).sum())]
    }


def row(time_of: float, size: float, seed: int, samples: int) -> dict[str, Any]:
    """What is found of one record, and by how many standard errors it is off."""
    draw, began = (
        np.random.default_rng([seed, round(1000 * time_of), round(1000 * size)]),
        time.process_time(),
    )
    path = _simulated(samples, time_of, size, STEP / WITHIN, WITHIN, draw)
    done = analyse(Recordings.from_arrays([STEP * np.arange(samples)], [path[:, :1]], names=["x"]))
    told: dict[str, Any] = {"time": time_of, "size": size, "seed": seed, "samples": samples}
    certificate, estimate = done.refined.certificate, done.identified.result
    landscape = None if done.landscape is None else done.landscape.result
    told["certified"] = certificate is not None and certificate.certified
    told["slow_force"] = 0.0 if estimate is None else estimate.slow_force
    told["rung"] = 0 if landscape is None else landscape.rung
    told["refused"] = " ".join(
        name for name, one in (certificate.tests if certificate else {}).items() if not one.passed
    )
    if estimate is not None and estimate.slow_force:
        rate, error = -float(estimate.values[-1]), float(np.sqrt(estimate.covariance[-1, -1]))
        told |= {"rate": rate, "rate_off": (rate - 1 / time_of) / error}
        told["size_found"] = float(estimate.slow_force * np.sqrt(estimate.noise_rate[1, 1] / (2 * rate)))
    if landscape is not None and landscape.noise is not None and told["slow_force"]:
        noise, true = landscape.noise, true_barrier(time_of, size)
        longer = counted(landscape, _simulated(LONGER * samples, time_of, size, STEP / WITHIN, WITHIN, draw))
        told["barrier"] = true
        for way in landscape.transitions:
            height = way.barrier / noise.intensity
            error = np.hypot(
                way.error / noise.intensity, height * way.leverage * noise.standard_error / noise.intensity
            )
            told |= {f"barrier_{way.start}": height, f"barrier_off_{way.start}": (height - true) / error}
        for one in landscape.visits:
            mean, ends = longer[one.well]
            spread = np.hypot(one.error, 1 / np.sqrt(max(ends, 1)))
            told |= {f"visit_{one.well}": one.predicted, f"visit_true_{one.well}": mean}
            told[f"visit_off_{one.well}"] = float(np.log(one.predicted / mean) / spread)
    return told | {"seconds": time.process_time() - began}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run all cases, and write them into one table."""
    parser = argparse.ArgumentParser(prog="benchmarks.slow_forces")
    parser.add_argument("--times", type=float, nargs="+", default=[0.3, 1.0, 3.0, 10.0])
    parser.add_argument("--sizes", type=float, nargs="+", default=[0.25, 0.4])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--samples", type=int, default=20_000)
    parser.add_argument("--file", type=Path, default=Path("results/slow_forces.csv"))
    chosen = parser.parse_args(arguments)
    chosen.file.parent.mkdir(parents=True, exist_ok=True)
    rows = []
    for case in product(chosen.times, chosen.sizes, chosen.seeds):
        rows.append(row(*case, chosen.samples))
        pd.DataFrame(rows).to_csv(chosen.file, index=False)
    print(pd.DataFrame(rows).round(3).to_string())


if __name__ == "__main__":
    main()
