"""Does the identification find the terms that f has, and no others?

    python -m benchmarks.laboratories.supports [--seeds 100] [--systems NAME ...] [--cores 2]

Records of process noise, with a noisy sensor or without, through the step *identify* as `siq run` takes it. A
record counts where every true term exceeds five of its standard errors when the true terms alone are fitted:
in others the evidence is not there. The bar is 93 of 100; `false_terms` alone may cost five.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.laboratories.coverage import DOUBLE_WELL
from benchmarks.laboratories.models import ARCHETYPE, Laboratory, maier_stein, resonator
from benchmarks.laboratories.one import read, write
from benchmarks.laboratories.records import generator, recorded, table
from siq.data.recordings import Recordings, snapshot_pairs
from siq.inference.field_estimate import FieldEstimate
from siq.inference.kalman_filter import Noise
from siq.inference.library import CandidateLibrary, IdentificationOptions, field_library
from siq.inference.observation import ObservationModel, unbroken
from siq.inference.regression import refit
from siq.numerics.integration import FlowMap
from siq.systems.diffusion import Diffusion
from siq.workflow.pipeline import identify_run
from siq.workflow.study import PipelineSettings, Sampling, StateSpace

STRONG = 5.0  # standard errors of the weakest true term of a record that counts
WANTED = 0.93

SYSTEMS = {
    each.name: each
    for each in (
        DOUBLE_WELL,
        replace(DOUBLE_WELL, name="double-well-sensor", sensor_noise=(0.05,)),
        replace(maier_stein("hop", 0.1, 0.0), samples=40_000),
        maier_stein("hop-often", 0.2, 0.0),
        maier_stein("hop-often-02", 0.2, 0.02),
        replace(resonator(), name="resonator-clean", samples=2_000, sensor_noise=()),
        replace(resonator(), samples=2_000),
        replace(ARCHETYPE, name="archetype-clean", sensor_noise=()),
        ARCHETYPE,
    )
}


def true_terms(laboratory: Laboratory, library: CandidateLibrary) -> dict[tuple[int, int], float]:
    """The coefficient of each true term, by its state and its place in the library."""
    places = {library.terms[k].as_poly(*library.symbols).monoms()[0]: k for k in range(library.size)}
    rows = zip(laboratory.terms, laboratory.coefficients, strict=True)
    return {(state, places[powers]): float(value) for (state, powers), value in rows}


def weakest(laboratory: Laboratory, recordings: Recordings, library: CandidateLibrary) -> float:
    """Standard errors that the weakest true term exceeds, of the fit of the true terms alone."""
    true = true_terms(laboratory, library)
    support, values = np.array(list(true)), np.array(list(true.values()))
    unit = Diffusion.identity(laboratory.dimension)
    noise = laboratory.intensities[0] * np.ones(laboratory.dimension)
    if any(laboratory.sensor_noise):
        observation, start = ObservationModel(library, unit), Noise(laboratory.sensor**2, noise)
        fit = observation.fitted(support, values, unbroken(recordings), noise=start, x=recordings.values)
        return float((np.abs(fit.model.values) / fit.standard_errors).min())
    known = FieldEstimate.on_support(
        library, support, values, np.eye(len(support)), np.diag(noise), 1.0, FlowMap(), unit
    )
    found = refit(known, snapshot_pairs(recordings))
    return float((np.abs(found.values) / np.sqrt(np.diag(found.covariance))).min())


def identified(laboratory: Laboratory, seed: int) -> dict[str, Any]:
    """Which terms one record shows too few and too many, and how strong its weakest true one is."""
    seen = recorded(laboratory, generator(laboratory, seed))
    recordings, options = Recordings.from_frame(table(laboratory, seen)), IdentificationOptions()
    library = field_library(recordings.names, options)
    settings = PipelineSettings(
        seed=seed,
        space=StateSpace(diffusion="identity"),
        sampling=Sampling(),
        identification=options,
    )
    began = time.process_time()
    step = identify_run(settings, recordings, number=0)
    seconds = time.process_time() - began
    found = set() if step.result is None else {(int(i), int(k)) for i, k in step.result.support}
    true = set(true_terms(laboratory, library))
    return {
        "missing": _named(true - found, library),
        "false": _named(found - true, library),
        "weakest": weakest(laboratory, recordings, library),
        "seconds": seconds,
        "said": step.outcome.reason,
    }


def _named(places: set[tuple[int, int]], library: CandidateLibrary) -> list[str]:
    return sorted(f"{library.names[term]} in {library.states[state]}" for state, term in places)


HEAD = (
    "| system | records | every term strong | of these found | false terms only | weakest (median) | s |\n"
    "|---|---|---|---|---|---|---|"
)


def row(name: str, found: Sequence[dict[str, Any]]) -> str:
    """A line of the table."""
    strong = [each for each in found if each["weakest"] > STRONG]
    right = sum(not each["missing"] and not each["false"] for each in strong)
    more = sum(not each["missing"] and bool(each["false"]) for each in strong)
    mark = "" if right >= WANTED * len(strong) else " !"
    middle, seconds = (np.median([each[key] for each in found]) for key in ("weakest", "seconds"))
    return (
        f"| {name} | {len(found)} | {len(strong)} | {right}{mark} | {more} | {middle:.1f} | {seconds:.1f} |"
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Identify what is missing, and say what came out."""
    parser = argparse.ArgumentParser(prog="benchmarks.laboratories.supports")
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--systems", nargs="+", default=list(SYSTEMS), choices=list(SYSTEMS))
    parser.add_argument("--cores", type=int, default=2)
    parser.add_argument("--folder", type=Path, default=Path("results/laboratories/supports"))
    chosen = parser.parse_args(arguments)
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    print(HEAD, flush=True)
    with ProcessPoolExecutor(chosen.cores) as pool:
        for name in chosen.systems:
            file = chosen.folder / f"{name}.json"
            found = read(file)
            missing = [seed for seed in range(chosen.seeds) if str(seed) not in found]
            for seed, one in zip(missing, pool.map(partial(identified, SYSTEMS[name]), missing), strict=True):
                found[str(seed)] = one
                write(file, found)
            print(row(name, list(found.values())), flush=True)


if __name__ == "__main__":
    main()
