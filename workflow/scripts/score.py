"""Score the formulas of a run against exact answers, where the card knows any."""

from typing import Any

import torch

from siq.decomposition.networks import evaluate_points, select_run
from siq.decomposition.storage import load_networks
from siq.library import candidate_library
from siq.model import read_model
from siq.regression import RegressionOptions
from siq.scoring import (
    coefficient_table,
    domain_grid,
    relative_error,
    relative_root_mean_square_error,
    support_is_correct,
)
from siq.symbolic import exact_decomposition
from siq.systems import System, load_system
from siq.tables import as_table, concatenate, write_table
from step import job, outcome, position_of, write_outcomes


def network_error(system: System, networks_path: str, position: int) -> float:
    """Relative L2 error of the network's U on a grid over Ω, U zero at its minimum."""
    grid = domain_grid(system.domain)
    exact = system.exact_values(grid)
    networks = select_run(load_networks(networks_path), position)
    return relative_error(2 * evaluate_points(networks, grid.T).potential, exact)


def main(snakemake: Any) -> None:
    """Run as a rule's script."""
    run = int(snakemake.wildcards.run)
    torch.set_num_threads(snakemake.threads)
    system = load_system(snakemake.input.card) if snakemake.input.get("card") else None
    exact = exact_decomposition(system) if system is not None else None
    decompositions, certificates = read_model(snakemake.input.model)
    options = RegressionOptions(**snakemake.params.study["regression"])
    tables, errors = [], []
    for method, identified in decompositions.items():
        library = candidate_library(
            [symbol.name for symbol in identified.symbols], degree=options.degree, further=options.functions
        )
        table = coefficient_table(run, method, identified, exact, terms=library.names)
        tables.append(table)
        errors.append(
            {
                "run": run,
                "method": method,
                "rrmse": relative_root_mean_square_error(table),
                "support_correct": support_is_correct(table),
                "certified": certificates[method]["certified"],
            }
        )
    if not decompositions:  # the run stays in the table, without an error to boast of
        errors.append({"run": run, "method": "regression", "certified": False})
    position, _ = position_of(run, snakemake.input.training)
    if exact is not None and system is not None and position is not None:
        for row in errors:
            row["network_error"] = network_error(system, snakemake.input.networks, position)
    write_table(snakemake.output.coefficients, concatenate("coefficients", tables))
    write_table(snakemake.output.rrmse, as_table("rrmse", errors))
    if not decompositions:
        result = outcome(run, "score", "skipped", "there is no formula to score")
    elif exact is None:
        result = outcome(run, "score", "skipped", "no exact answer is known")
    else:
        result = outcome(run, "score")
    write_outcomes(snakemake.output.outcome, [result])


if __name__ == "__main__":
    with job(snakemake):  # type: ignore[name-defined]  # noqa: F821 (Snakemake puts it here)
        main(snakemake)  # type: ignore[name-defined]  # noqa: F821
