"""Regress sparse formulas of V, g and f from the networks of a run."""

from typing import Any

import numpy as np

from siq.decomposition.trained import load_networks
from siq.errors import NumericalFailure
from siq.library import candidate_library
from siq.model import model_to_data, write_model
from siq.recordings import snapshot_pairs
from siq.regression import RegressionOptions, RegressionResult, points_below, sparse_decomposition
from siq.symbolic import SymbolicDecomposition, decomposition_from_coefficients
from siq.systems import diffusion_matrix
from step import job, outcome, pair_step, position_of, read_run, write_outcomes

UNCERTIFIED = {
    "certified": False,
    "tests": {},
    "reason": "no certificate is computed for this method; the formula may belong to a false decomposition",
}


def regress(
    recordings_path: str, networks_path: str, position: int, study: dict[str, Any]
) -> tuple[SymbolicDecomposition, RegressionResult]:
    """Formulas of one run."""
    options = RegressionOptions(**study["regression"])
    recordings = read_run(recordings_path)
    assert recordings is not None  # a run without trajectories has no networks, and is skipped
    points = snapshot_pairs(recordings, pair_step=pair_step(study)).x0
    values = load_networks(networks_path, run=position).evaluate(points)
    below = points_below(values.potential, level=options.level)
    library = candidate_library(
        recordings.names,
        degree=options.degree,
        potential_degree=options.potential_degree,
        circulatory_degree=options.circulatory_degree,
        further=options.functions,
    )
    result = sparse_decomposition(
        library,
        points[below],
        values.potential[below],
        values.circulatory[below],
        values.vector_field[below],
        diffusion=diffusion_matrix(study["metric"]["diffusion"], points.shape[1]),
        options=options,
    )
    formulas = decomposition_from_coefficients(
        library,
        potential=result.potential,
        circulatory=result.circulatory,
        vector_field=result.vector_field,
        points=points[below],
    )
    return formulas, result


def quality(result: RegressionResult) -> dict[str, Any]:
    """What the regression says of itself, for the outcome."""
    return {
        "points": result.points,
        "converged": result.converged,
        "iterations": result.iterations,
        "constraint_residual": result.constraint_residual,
        "sparse_constraint_residual": result.sparse_constraint_residual,
        "misfit": np.round(result.misfit, 12).tolist(),
    }


def main(snakemake: Any) -> None:
    """Run as a rule's script."""
    run = int(snakemake.wildcards.run)
    position, reason = position_of(run, snakemake.input.outcome)
    models: dict[str, SymbolicDecomposition] = {}
    if position is None:
        result = outcome(run, "regress", "skipped", f"the training gave no networks ({reason})")
    else:
        try:
            models["regression"], found = regress(
                snakemake.input.recordings, snakemake.input.networks, position, snakemake.params.study
            )
            status = "ok" if found.converged else "warning"
            reason = "" if found.converged else f"SR3 did not settle in {found.iterations - 1} iterations"
            result = outcome(run, "regress", status, reason, **quality(found))
        except NumericalFailure as error:
            result = outcome(run, "regress", "failed", str(error))
    write_model(snakemake.output.model, model_to_data(models, dict.fromkeys(models, UNCERTIFIED)))
    write_outcomes(snakemake.output.outcome, [result])


if __name__ == "__main__":
    with job(snakemake):  # type: ignore[name-defined]  # noqa: F821 (Snakemake puts it here)
        main(snakemake)  # type: ignore[name-defined]  # noqa: F821
