"""Do the estimator's standard errors cover, whatever the ratio of the two noises?

    python -m benchmarks.laboratories.coverage [--seeds 200] [--estimator NAME ...]
    python -m benchmarks.laboratories.coverage --landscapes [--bent] [--first 0] [--seeds 200]

The ratio is R/(Qh): the variance of the sensor over that of the process noise within a step. A linear system
and a double well, of which f has free coefficients, and both noises are unknown. The bar is 90 to 98 % of all
coefficients within 1.96 of their standard errors. What has not converged counts as no fit.

With ``--landscapes`` it is asked of what a user reads: coefficients of f, ε, positions of wells, barriers
ΔU/ε and mean times, by their intervals of 68 and 95 %. Each seed is a laboratory of its own (`drawn`): tilted
double wells of one state, or of two with a force that circulates, recorded coarsely or finely, with and
without a noisy sensor, long enough for one passage from well to well or for forty. With ``--bent`` all have
two states and a valley that is bent, so that f has many terms. Parts that begin at another seed may be made
side by side: each has a file, and the table is of all that are in the folder.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np
import sympy

from benchmarks.hostile.records import Law
from benchmarks.laboratories.bounds import OTHER_SEEDS, SUBSTEPS, inverse
from benchmarks.laboratories.information import information
from benchmarks.laboratories.models import Laboratory
from benchmarks.laboratories.one import read, write
from benchmarks.laboratories.records import crossings, generator, recorded, table
from siq.data.preparation import in_stretches
from siq.data.recordings import Recordings
from siq.errors import InputError, NumericalFailure
from siq.inference import maximum_likelihood
from siq.inference.kalman_filter import Noise
from siq.inference.maximum_likelihood import Fit
from siq.inference.measurements import Measurements
from siq.quasipotential.landscape import Landscape
from siq.quasipotential.landscape_assembly import find_landscape
from siq.quasipotential.rates import NoiseStrength
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics, Parameter, symbol
from siq.systems.phase_portrait import phase_portrait
from siq.workflow import pipeline

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


DRAWN_WITH = 34  # the seed of all laboratories that are drawn
MOST_SAMPLES = 30_000  # of all records of one
FINE = 1e-3  # of the simulation: what its steps leave out of ε is two thousandths
CONFIDENCES = {"68 %": 0.994458, "95 %": 1.959964}  # half widths in standard errors
PASSAGES = {"1 to 10": (1, 10), "more": (11, 10**9)}  # seen from well to well
Figure = tuple[str, float]
"""What is asked, and by how many standard errors the answer is off."""


def drawn(seed: int, *, bent: bool = False) -> Laboratory:
    """A laboratory of its own, of one state or two: ``f = -∇V + turn (V_y, -V_x)`` with

    ``V = (x² - 1)²/4 - tilt x + k (y - lx - bx²)²/2``. Unless it is `bent`, k = 1 and l = b = 0; if it is, f
    has up to twelve terms, small ones among them.
    """
    draw = np.random.default_rng([DRAWN_WITH, seed])
    intensity, tilt = 0.5 / draw.uniform(1.7, 3.0), draw.uniform(-0.05, 0.05)
    step, passages = 10 ** draw.uniform(-1.7, -0.7), 10 ** draw.uniform(0, 1.6)
    records, turn = int(draw.choice([1, 4])), float(draw.choice([0.0, 0.0, 0.5, 1.5]))
    sensor = float(draw.choice([0.0, 0.0, 0.1, 0.2]))
    stiffness, lean, bend = 1.0, 0.0, 0.0
    if bent:
        turn, stiffness, lean, bend = draw.uniform([-1, 0.7, -0.5, -0.4], [1, 2, 0.5, 0.4])
    stay = np.sqrt(2) * np.pi * np.exp(0.5 / intensity)
    samples = int(np.clip(passages * stay / step, 1_000, MOST_SAMPLES)) // records
    x, y = symbol("x"), symbol("y")
    own = (x**2 - 1) ** 2 / 4 - tilt * x
    height, states = (
        (own + stiffness * (y - lean * x - bend * x**2) ** 2 / 2, (x, y)) if turn else (own, (x,))
    )
    slope = [-height.diff(state) for state in states]
    # f·∇V + |∇V|² vanishes, for what circulates is orthogonal to ∇V: U = 2V.
    force = [slope[0] - turn * slope[1], slope[1] + turn * slope[0]] if turn else slope
    drift = tuple(
        {powers: float(value) for powers, value in sympy.Poly(one, *states).terms()} for one in force
    )
    places = sorted(np.roots([-1.0, 0.0, 1.0, tilt]).real)
    left, top, right = ((float(one), lean * one + bend * one**2)[: len(states)] for one in places)
    return Laboratory(
        f"drawn-{seed}", "a tilted double well", ("x", "y")[: len(drift)], drift,
        {(0,) * len(drift): intensity}, attractors=(left, right), saddles=(top,), records=records,
        samples=samples, step=step, within=int(np.ceil(step / FINE)),
        sensor_noise=(sensor,) * len(drift) if sensor else (),
    )  # fmt: skip


def landscape_figures(seed: int, *, bent: bool = False) -> dict[str, object]:
    """Passages seen in a drawn laboratory, by how many standard errors each answer is off, and faults."""
    laboratory = drawn(seed, bent=bent)
    seen = recorded(laboratory, generator(laboratory, seed))
    began = time.process_time()
    found: dict[str, object] = {"passages": crossings(laboratory, seen), "figures": [], "fault": ""}
    recordings = in_stretches(Recordings.from_frame(table(laboratory, seen)))
    try:
        identified = pipeline.identify_run(pipeline.PipelineSettings(), recordings, number=seed)
        estimate = identified.result
        if estimate is None or estimate.noise_strength is None:
            return found | {"fault": identified.outcome.reason or "no process noise"}
        portrait = phase_portrait(
            estimate.dynamics, recordings.values[:: -(-len(recordings.t) // 2000)], seed=0
        )
        noise = NoiseStrength(*estimate.noise_strength, source="estimated")
        landscape = find_landscape(estimate, portrait, wells=(), noise=noise)
        found["figures"] = list(_figures(laboratory, landscape))
    except (NumericalFailure, InputError, np.linalg.LinAlgError) as error:
        found["fault"] = str(error)
    return found | {"seconds": time.process_time() - began}


def _figures(laboratory: Laboratory, landscape: Landscape) -> Iterator[Figure]:
    estimate, noise = landscape.field_estimate, landscape.noise
    assert estimate is not None and noise is not None
    library, errors = estimate.library, estimate.standard_errors
    for (place, powers), true in zip(laboratory.terms, laboratory.coefficients, strict=True):
        symbols = zip(library.symbols, powers, strict=True)
        column = library.terms.index(sympy.prod(one**power for one, power in symbols))
        if errors[column, place] > 0:
            yield "f", float((estimate.coefficients[column, place] - true) / errors[column, place])
    true_noise = float(laboratory.intensities[0])
    yield "ε", (noise.intensity - true_noise) / noise.standard_error
    wells = np.array(laboratory.attractors)
    heights = [2 * ((one[0] ** 2 - 1) ** 2 / 4 - laboratory.drift[0].get((0,) * len(one), 0.0) * one[0])
               for one in (*laboratory.attractors, *laboratory.saddles)]  # fmt: skip
    assert landscape.position_errors is not None
    for place, one in enumerate(landscape.attractors):
        away = np.linalg.norm(wells - one.position, axis=1)
        own = int(away.argmin())
        yield "position", float((one.position[0] - wells[own, 0]) / landscape.position_errors[place, 0])
        for way in landscape.transitions:
            if way.start != place or way.end is None or not np.isfinite(way.barrier):
                continue
            true = (heights[-1] - heights[own]) / true_noise
            height = way.barrier / noise.intensity
            parts = way.error / way.barrier, way.leverage * noise.standard_error / noise.intensity
            yield "barrier", float((height - true) / (height * np.hypot(*parts)))
            time_of = way.exit.mean_exit_time(noise)
            if laboratory.dimension == 1 and time_of is not None:
                grid = np.linspace(-2.5, 2.5, 5001)
                force = np.sum(
                    [value * grid ** powers[0] for powers, value in laboratory.drift[0].items()], axis=0
                )
                law = Law(grid, force, np.full(len(grid), true_noise))
                spread = np.hypot(time_of.data_error, time_of.law_error)
                true = law.time(float(wells[own, 0]), float(wells[1 - own, 0]))
                yield "time", float(np.log(time_of.value / true) / spread)


def landscape_table(found: dict[str, dict[str, object]]) -> str:
    """How often intervals hold, by what is asked and the passages seen.

    The figures of one laboratory err together.
    """
    lines = [
        "| what | passages | laboratories | figures | 68 % | 95 % | rms z |",
        "|---|---|---|---|---|---|---|",
    ]
    for what, (name, (low, high)) in product(("f", "ε", "position", "barrier", "time"), PASSAGES.items()):
        each = [
            [off for asked, off in one["figures"] if asked == what]  # type: ignore[attr-defined]
            for one in found.values() if low <= one["passages"] <= high  # type: ignore[operator]
        ]  # fmt: skip
        z = np.array([off for one in each for off in one if off is not None])
        shares = (
            " | ".join(f"{(np.abs(z) <= half).mean():.0%}" for half in CONFIDENCES.values())
            if len(z)
            else " | "
        )
        size = f"{np.sqrt((z**2).mean()):.2f}" if len(z) else ""
        lines.append(f"| {what} | {name} | {sum(map(bool, each))} | {len(z)} | {shares} | {size} |")
    faults = [str(one["fault"]) for one in found.values() if one["fault"]]
    never = sum(one["passages"] == 0 for one in found.values())
    seconds = [float(str(one["seconds"])) for one in found.values() if "seconds" in one]
    lines.append(f"{len(found)} laboratories, {never} without a passage, {len(faults)} without a landscape")
    lines.append(f"{np.median(seconds):.1f} s each" if seconds else "")
    return "\n".join([*lines, *sorted(set(faults))])


def main(arguments: Sequence[str] | None = None) -> None:
    """Estimate what is missing, and say what came out."""
    parser = argparse.ArgumentParser(prog="benchmarks.laboratories.coverage")
    parser.add_argument("--seeds", type=int, default=200)
    parser.add_argument("--first", type=int, default=0, help="the first seed, of landscapes")
    parser.add_argument("--ratios", type=float, nargs="+", default=list(RATIOS))
    parser.add_argument("--systems", nargs="+", default=list(SYSTEMS), choices=list(SYSTEMS))
    parser.add_argument("--estimator", nargs="+", default=list(ESTIMATORS), choices=list(ESTIMATORS))
    parser.add_argument("--cores", type=int, default=2)
    parser.add_argument("--folder", type=Path, default=Path("results/laboratories/coverage"))
    parser.add_argument("--landscapes", action="store_true", help="intervals of what a user reads")
    parser.add_argument("--bent", action="store_true", help="of landscapes: two states with a bent valley")
    chosen = parser.parse_args(arguments)
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    if chosen.landscapes:
        kind = "bent" if chosen.bent else "landscapes"
        file = chosen.folder / f"{kind}-{chosen.first}.json"
        found = read(file)
        for seed in range(chosen.first, chosen.seeds):
            if str(seed) not in found:
                found[str(seed)] = landscape_figures(seed, bent=chosen.bent)
                write(file, found)
        parts = [read(each) for each in sorted(chosen.folder.glob(f"{kind}*.json"))]
        print(landscape_table({seed: one for part in parts for seed, one in part.items()}))
        return
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
