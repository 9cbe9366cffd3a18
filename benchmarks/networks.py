"""What networks add as a second route to V: time, certificate and errors of V, without and with them.

    .venv/bin/python benchmarks/networks.py

All other settings are defaults. Systems with a card are simulated as a study of two lines would; the others
are those of ``tests/untuned_systems.py``. The errors of the refined V and of the networks' own are relative,
up to a constant, over the lowest three quarters of the recorded states; of the resonator, whose V nobody
knows, that of the barriers of the refined U against those by minimum action.
"""

import os

os.environ["OMP_NUM_THREADS"] = "1"

import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import sympy

sys.path.append(str(Path(__file__).parents[1] / "tests"))

from untuned_systems import SYSTEMS, simulated

from siq.data.recordings import Recordings, snapshot_pairs
from siq.networks.decomposition import TrainingOptions
from siq.systems.cards import load_exact, load_system
from siq.systems.formulas import compile_formulas
from siq.systems.simulation import SimulationEntry, simulate_snapshots
from siq.workflow.pipeline import Analysis, PipelineSettings, analyse
from siq.workflow.study import Sampling, StateSpace
from siq.workflow.tables import Method

ROOT = Path(__file__).parents[1]
CARDS = ("archetype3d", "resonator", "maier-stein")
UNTUNED = ("linear in 3 dimensions", "polynomial in 2 dimensions, draw 0", "gradient system")
LOWEST = 0.75  # quantile of V: beyond, hardly anything is recorded
RESONATOR_BARRIERS = (1.047e-8, 8.16e-9)  # of U from either well, by minimum action


def of_card(name: str) -> tuple[Recordings, PipelineSettings, sympy.Expr | None]:
    """Recordings of a card, what a study of two lines says of them, and the exact V where it is known."""
    path = ROOT / "config" / "systems" / f"{name}.yaml"
    system, exact = load_system(path), load_exact(path)
    options = SimulationEntry().completed(system).options()
    recordings = simulate_snapshots(system, options=options, generator=np.random.default_rng(0))
    space = StateSpace(system.states, None, system.diffusion.matrix.tolist())
    settings = PipelineSettings(space=space, sampling=Sampling(options.pair_step))
    return recordings, settings, None if exact is None else exact / 2


def of_known(name: str) -> tuple[Recordings, PipelineSettings, sympy.Expr | None]:
    """The same of a system that was never tuned for."""
    known = SYSTEMS[name]
    space = StateSpace(diffusion=known.diffusion.tolist())
    return simulated(known)[0], PipelineSettings(space=space), known.potential


def errors_of(found: Analysis, recordings: Recordings, exact: sympy.Expr | None) -> tuple[float, float]:
    """Relative errors of the refined V, or of barriers, and of the networks' own V; NaN for none."""
    if exact is None:
        assert found.landscape is not None and found.landscape.result is not None
        barriers = found.landscape.result.barriers()["barrier"].to_numpy()
        return float(np.abs(barriers / RESONATOR_BARRIERS - 1).max()), np.nan
    formulas, networks = found.refined.formulas[Method.REFINED], found.trained.result
    symbols = [sympy.Symbol(name, real=True) for name in recordings.names]
    x = np.ascontiguousarray(snapshot_pairs(recordings).x0.T)
    values = compile_formulas([exact], symbols)(x)[0]
    low = values < np.quantile(values, LOWEST)
    x, values = x[:, low], values[low]

    def error(own: np.ndarray) -> float:
        there = np.isfinite(own)  # networks by well hold in these alone
        difference = (own - values)[there]
        size = np.linalg.norm((values - values.min())[there])
        return float(np.linalg.norm(difference - difference.mean()) / size)

    return (
        np.nan if formulas.potential is None else error(formulas.evaluate(x)[0]),
        np.nan if networks is None else error(networks.potential_at(x.T)),
    )


def main() -> None:
    """Print one row for each system and way."""
    print(f"{'system':36s} {'networks':8s} {'seconds':>7s} certified  error    stated   networks", flush=True)
    for name in (*CARDS, *UNTUNED):
        recordings, settings, exact = of_card(name) if name in CARDS else of_known(name)
        for training in (None, TrainingOptions()):
            began = time.perf_counter()
            found = analyse(recordings, replace(settings, training=training), device="cpu")
            seconds = time.perf_counter() - began
            certificate = found.refined.certificates[Method.REFINED]
            (error, own), stated = errors_of(found, recordings, exact), certificate["stated_error"]
            print(
                f"{name:36s} {'no' if training is None else 'yes':8s} {seconds:7.0f}"
                f" {certificate['certified']!s:9s} {error:8.1e} {stated or np.nan:8.1e} {own:8.1e}"
                f" {certificate['reason']} {found.trained.outcome.reason}",
                flush=True,
            )


if __name__ == "__main__":
    main()
