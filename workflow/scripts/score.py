"""Score the formulas of a run against exact answers and unseen trajectories, where these are known."""

from typing import Any

import numpy as np
import pandas as pd

from siq.decomposition.trained import TrainedNetworks, load_networks, shuffled
from siq.library import candidate_library
from siq.model import read_model
from siq.prediction import prediction_errors
from siq.randomness import generator
from siq.regression import RegressionOptions
from siq.scoring import (
    coefficient_table,
    domain_grid,
    relative_error,
    relative_root_mean_square_error,
    support_is_correct,
)
from siq.simulate import SimulationOptions, simulate_snapshots
from siq.symbolic import SymbolicDecomposition, exact_decomposition
from siq.systems import System, load_system
from siq.tables import as_table, concatenate, write_table
from siq.vector_field import VectorField
from step import CONTROL, METHODS, job, outcome, position_of, write_outcomes

COARSE = 50_000  # points of the grid on which the randomised network is scored
UNSEEN = 1000  # trajectories that no run learns from (paper, section 3.1)


def network_errors(
    system: System, networks_path: str, position: int, run: int, seed: int
) -> dict[str, float]:
    """Relative L2 error on a grid over Ω of the U of the trained network, and of a randomised one."""
    trained = load_networks(networks_path, run=position)
    randomised = shuffled(trained, generator=generator(seed, run, "shuffle"))

    def error_of(networks: TrainedNetworks, grid: np.ndarray) -> float:
        return relative_error(2 * networks.evaluate(grid.T).potential, system.exact_values(grid))

    error = error_of(trained, domain_grid(system.domain))
    chance = error_of(randomised, domain_grid(system.domain, points=COARSE))
    return dict.fromkeys(METHODS, error) | {CONTROL: chance}


def predictions(
    system: System, models: dict[str, SymbolicDecomposition], run: int, study: dict[str, Any]
) -> pd.DataFrame:
    """Errors of long-term prediction of unseen trajectories of the system without noise."""
    options = SimulationOptions(**(study["simulation"] | {"trajectories": UNSEEN, "noise_intensity": 0.0}))
    unseen = simulate_snapshots(system, options=options, generator=generator(study["seed"], "unseen"))
    tables = [
        pd.DataFrame(
            {
                "run": run,
                "method": method,
                "trajectory": np.arange(UNSEEN),
                "error": prediction_errors(VectorField(one.symbols, one.vector_field), unseen),
            }
        )
        for method, one in models.items()
    ]
    return concatenate("prediction", tables)


def certificate_table(run: int, certificates: dict[str, Any]) -> pd.DataFrame:
    """Every test of every formula, with its figure."""
    rows = [
        {"run": run, "method": method, "test": test} | verdict
        for method, one in certificates.items()
        for test, verdict in one["tests"].items()
    ]
    return as_table("certificates", rows)


def main(snakemake: Any) -> None:
    """Run as a rule's script."""
    run, study, target = int(snakemake.wildcards.run), snakemake.params.study, snakemake.output
    system = load_system(snakemake.input.card) if snakemake.input.get("card") else None
    exact = exact_decomposition(system) if system is not None else None
    decompositions, certificates = read_model(snakemake.input.model)
    options = RegressionOptions(**study["regression"])
    tables = []
    position, _ = position_of(run, snakemake.input.training)
    errors: dict[str, dict[str, Any]] = {
        # A method without a formula stays in the table, without an error to boast of.
        method: {"run": run, "method": method, "certified": False}
        for method in (*METHODS, *([CONTROL] if CONTROL in certificates else []))
    }
    for method, one in certificates.items():
        errors[method] |= {"certified": one["certified"], "stated_error": one["stated_error"]}
    for method, identified in decompositions.items():
        library = candidate_library(
            [symbol.name for symbol in identified.symbols], degree=options.degree, further=options.functions
        )
        table = coefficient_table(run, method, identified, exact, terms=library.names)
        tables.append(table)
        errors[method] |= {
            "rrmse": relative_root_mean_square_error(table),
            "support_correct": support_is_correct(table),
        }
    if exact is not None and system is not None and position is not None:
        known = network_errors(system, snakemake.input.networks, position, run, study["seed"])
        for method, row in errors.items():
            row["network_error"] = known[method]
    predicted = as_table("prediction", [])
    if system is not None and study["simulation"] is not None and decompositions:
        predicted = predictions(system, decompositions, run, study)
    write_table(target.coefficients, concatenate("coefficients", tables))
    write_table(target.rrmse, as_table("rrmse", list(errors.values())))
    write_table(target.prediction, predicted)
    write_table(target.certificates, certificate_table(run, certificates))
    if not decompositions:
        result = outcome(run, "score", "skipped", "there is no formula to score")
    elif exact is None:
        result = outcome(run, "score", "skipped", "no exact answer is known")
    else:
        result = outcome(run, "score")
    write_outcomes(target.outcome, [result])


if __name__ == "__main__":
    with job(snakemake):  # type: ignore[name-defined]  # noqa: F821 (Snakemake puts it here)
        main(snakemake)  # type: ignore[name-defined]  # noqa: F821
