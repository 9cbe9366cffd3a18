"""Do the estimator's standard errors cover, whatever the ratio of the two noises?

    python -m benchmarks.laboratories.coverage [--seeds 200] [--estimator NAME ...]

The ratio is R/(Qh): the variance of the sensor over that of the process noise within a step. A linear system
and a double well, of which f has free coefficients, and both noises are unknown. The bar is 90 to 98 % of all
coefficients within 1.96 of their standard errors. What has not converged counts as no fit.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np
import sympy

from benchmarks.laboratories.bounds import OTHER_SEEDS, SUBSTEPS, inverse
from benchmarks.laboratories.information import information
from benchmarks.laboratories.models import Laboratory
from benchmarks.laboratories.one import read, write
from benchmarks.laboratories.records import generator, recorded
from siq.inference import maximum_likelihood
from siq.inference.kalman_filter import Noise
from siq.inference.maximum_likelihood import Fit
from siq.inference.measurements import Measurements
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics, Parameter, symbol

RATIOS = (0.01, 0.1, 1.0, 10.0, 100.0)
START = 0.7  # of the true coefficients: where a fit begins
INTERVAL = 1.96
COVERED = (0.90, 0.98)  # what is asked
SIMULATED = 4  # records from which the bound is taken

LINEAR = Laboratory(
    name="linear",
    title="relaxation of two coupled states",
    states=("x", "y"),
    drift=({(1, 0): -1.0, (0, 1): 0.5}, {(1, 0): -0.5, (0, 1): -1.0}),
    intensity={(0, 0): 0.2},
    attractors=((0.0, 0.0),),
    saddles=((1.0, 1.0),),  # there is none, and nobody asks
    records=4,
    samples=1_000,
    step=0.05,
)
DOUBLE_WELL = Laboratory(
    name="double-well",
    title="a double well in one state",
    states=("x",),
    drift=({(1,): 1.0, (3,): -1.0},),
    intensity={(0,): 0.2},
    attractors=((1.0,), (-1.0,)),
    saddles=((0.0,),),
    records=4,
    samples=2_500,
    step=0.05,
)
SYSTEMS = {each.name: each for each in (LINEAR, DOUBLE_WELL)}


def with_ratio(laboratory: Laboratory, ratio: float) -> Laboratory:
    """The same with a sensor of this noise."""
    spread = float(np.sqrt(ratio * laboratory.intensities[0] * laboratory.step))
    name = f"{laboratory.name}-{ratio:g}"
    return replace(laboratory, name=name, sensor_noise=(spread,) * laboratory.dimension)


def model_of(laboratory: Laboratory) -> Dynamics:
    """F with free coefficients, away from the truth."""
    names = [f"c{place}" for place in range(len(laboratory.terms))]
    equations = [sympy.S.Zero] * laboratory.dimension
    for name, (place, powers) in zip(names, laboratory.terms, strict=True):
        factors = [symbol(each) ** one for each, one in zip(laboratory.states, powers, strict=True)]
        equations[place] += symbol(name) * sympy.prod(factors)
    return Dynamics(
        states=laboratory.states,
        equations=tuple(equations),
        diffusion=Diffusion.identity(laboratory.dimension),
        parameters=tuple(
            Parameter(name, START * value) for name, value in zip(names, laboratory.coefficients, strict=True)
        ),
    )


def measured(laboratory: Laboratory, seen: np.ndarray) -> Measurements:
    """Records as the estimation takes them."""
    records, samples, d = seen.shape
    return Measurements(
        labels=tuple(f"r{place}" for place in range(records)),
        first=np.arange(records + 1) * samples,
        t=np.tile(np.arange(samples) * laboratory.step, records),
        outputs=np.ascontiguousarray(seen.reshape(-1, d)),
        courses=((),) * records,
    )


def first_noise(laboratory: Laboratory, seen: np.ndarray) -> Noise:
    """Both noises as increments over one step and over ten show them, where f hardly acts."""
    short, long = (np.diff(seen[:, ::lag], axis=1).var(axis=(0, 1)) for lag in (1, 10))
    process = np.maximum(long - short, short / 100) / (9 * laboratory.step)
    sensor = np.maximum(short - process * laboratory.step, short / 100) / 2
    return Noise(sensor, process)


def by_multiple_shooting(model: Dynamics, data: Measurements, noise: Noise) -> Fit:
    """The fit that diagnoses use."""
    return maximum_likelihood.fit_by_multiple_shooting(
        model, data, x=data.outputs, noise=noise, estimate_process=True
    )


def by_filter(model: Dynamics, data: Measurements, noise: Noise) -> Fit:
    """The fit that identifies f beside a noisy sensor."""
    return maximum_likelihood.fit_by_filter(model, data, x=data.outputs, noise=noise)


# A further estimator is a line here: a function of the model, the data, and the noises to begin with.
ESTIMATORS: dict[str, Callable[[Dynamics, Measurements, Noise], Fit]] = {
    "multiple-shooting": by_multiple_shooting,
    "filter": by_filter,
}


@dataclass(frozen=True)
class Case:
    """One system with one ratio, and who is asked."""

    system: str
    ratio: float
    estimator: str

    @property
    def laboratory(self) -> Laboratory:
        """With its sensor."""
        return with_ratio(SYSTEMS[self.system], self.ratio)

    def file(self, folder: Path) -> Path:
        """Where its estimates are."""
        return folder / f"{self.system}-{self.ratio:g}-{self.estimator}.json"


def estimate(case: Case, seed: int) -> dict[str, object]:
    """Coefficients less the true ones, with their standard errors."""
    laboratory = case.laboratory
    seen = recorded(laboratory, generator(laboratory, seed))
    began = time.process_time()
    fit = ESTIMATORS[case.estimator](
        model_of(laboratory), measured(laboratory, seen), first_noise(laboratory, seen)
    )
    seconds = time.process_time() - began
    if fit.fault:
        return {"fault": fit.fault, "seconds": seconds}
    return {
        "errors": (fit.model.values - laboratory.coefficients).tolist(),
        "standard_errors": fit.standard_errors.tolist(),
        "converged": fit.converged,
        "seconds": seconds,
    }


def best(laboratory: Laboratory) -> np.ndarray:
    """The Cramér–Rao bound of each coefficient of f."""
    seeds = range(OTHER_SEEDS, OTHER_SEEDS + SIMULATED)
    matrices = [
        information(laboratory, recorded(laboratory, generator(laboratory, seed)), substeps=SUBSTEPS).matrix
        for seed in seeds
    ]
    return np.sqrt(np.diag(inverse(np.mean(matrices, axis=0))))[: len(laboratory.terms)]


def row(case: Case, found: dict[str, dict[str, list[float]]]) -> str:
    """A line of the table."""
    known = [each for each in found.values() if each.get("converged")]
    if not known:
        return f"| {case.system} | {case.ratio:g} | {case.estimator} | 0 of {len(found)} |" + " |" * 6
    errors = np.array([each["errors"] for each in known], dtype=float)
    stated = np.array([each["standard_errors"] for each in known], dtype=float)
    bound = best(case.laboratory)
    covered = float((np.abs(errors) <= INTERVAL * stated).mean())
    cells = [
        case.system, f"{case.ratio:g}", case.estimator, f"{len(known)} of {len(found)}",
        f"{covered:.1%}" + ("" if COVERED[0] <= covered <= COVERED[1] else " !"),
        f"{np.sqrt(np.nanmean((errors / stated) ** 2)):.2f}",
        " ".join(f"{one:+.2f}" for one in errors.mean(axis=0) / bound),
        f"{np.sqrt(((errors / bound) ** 2).mean()):.2f}", f"{np.nanmedian(stated / bound):.2f}",
        f"{np.median([each['seconds'] for each in known]):.1f}",
    ]  # fmt: skip
    return "| " + " | ".join(cells) + " |"


HEAD = (
    "| system | R/(Qh) | estimator | fits | covered | rms z | mean error / bound | rms error / bound"
    " | stated / bound | s |\n|---|---|---|---|---|---|---|---|---|---|"
)


def main(arguments: Sequence[str] | None = None) -> None:
    """Estimate what is missing, and say what came out."""
    parser = argparse.ArgumentParser(prog="benchmarks.laboratories.coverage")
    parser.add_argument("--seeds", type=int, default=200)
    parser.add_argument("--ratios", type=float, nargs="+", default=list(RATIOS))
    parser.add_argument("--systems", nargs="+", default=list(SYSTEMS), choices=list(SYSTEMS))
    parser.add_argument("--estimator", nargs="+", default=list(ESTIMATORS), choices=list(ESTIMATORS))
    parser.add_argument("--cores", type=int, default=2)
    parser.add_argument("--folder", type=Path, default=Path("results/laboratories/coverage"))
    chosen = parser.parse_args(arguments)
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    print(HEAD, flush=True)
    with ProcessPoolExecutor(chosen.cores) as pool:
        for system, ratio, estimator in product(chosen.systems, chosen.ratios, chosen.estimator):
            case = Case(system, ratio, estimator)
            found = read(case.file(chosen.folder))
            missing = [seed for seed in range(chosen.seeds) if str(seed) not in found]
            for number, (seed, one) in enumerate(
                zip(missing, pool.map(partial(estimate, case), missing), strict=True), start=1
            ):
                found[str(seed)] = one
                if number % 20 == 0 or number == len(missing):
                    write(case.file(chosen.folder), found)
                    print(
                        f"{system} {ratio:g} {estimator}: {number} of {len(missing)}",
                        end="\r",
                        file=sys.stderr,
                    )
            print(row(case, found), flush=True)


if __name__ == "__main__":
    main()
