"""Regress: which sparse formulas are the networks of a run? The published method, by constrained SR3."""

from __future__ import annotations

from dataclasses import dataclass as plain_dataclass
from typing import Any

import numpy as np

from siq.data.recordings import Recordings, snapshot_pairs
from siq.errors import NumericalFailure
from siq.inference.library import candidate_library
from siq.networks.decomposition import TrainedNetworks
from siq.networks.regression import RegressionResult, points_below, sparse_decomposition
from siq.quasipotential.formulas import (
    SymbolicDecomposition,
    decomposition_from_coefficients,
)
from siq.systems.diffusion import Diffusion
from siq.workflow.outcomes import Method, Outcome, Status, Step
from siq.workflow.settings import PipelineSettings
from siq.workflow.training_step import TrainedRun

UNCERTIFIED = {
    "certified": False,
    "tests": {},
    "reason": "no certificate is computed for this method; the formula may belong to a false decomposition",
}


@plain_dataclass(frozen=True)
class Regressed:
    """The formulas of a run, None where there are none."""

    formulas: SymbolicDecomposition | None
    outcome: Outcome

    def files(self) -> dict[str, Any]:
        """By the names of the rule."""
        models = {} if self.formulas is None else {Method.REGRESSION: self.formulas}
        return {"regression": (models, dict.fromkeys(models, UNCERTIFIED)), "regress_outcome": [self.outcome]}


def run(settings: PipelineSettings, recordings: Recordings | None, trained: TrainedRun) -> Regressed:
    """Formulas of the networks of one run."""
    number = trained.outcome.run
    if trained.networks is None or recordings is None:
        return Regressed(None, Outcome(number, Step.REGRESS, Status.SKIPPED, trained.missing))
    try:
        formulas, found = _regressed(settings, recordings, trained.networks)
    except NumericalFailure as error:
        return Regressed(None, Outcome(number, Step.REGRESS, Status.FAILED, str(error)))
    status = Status.OK if found.converged else Status.WARNING
    reason = "" if found.converged else f"SR3 did not settle in {found.iterations - 1} iterations"
    return Regressed(formulas, Outcome(number, Step.REGRESS, status, reason, _quality(found)))


def _regressed(
    settings: PipelineSettings, recordings: Recordings, networks: TrainedNetworks
) -> tuple[SymbolicDecomposition, RegressionResult]:
    options = settings.regression
    points = snapshot_pairs(recordings, pair_step=settings.sampling.pair_step).x0
    values = networks.evaluate(points)
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
        # D that nobody gave is that of the networks, in their precision.
        diffusion=settings.space.constant_noise(points.shape[1]) or Diffusion(networks.diffusion),
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


def _quality(result: RegressionResult) -> dict[str, Any]:
    """What the regression says of itself, for the outcome."""
    return {
        "points": result.points,
        "converged": result.converged,
        "iterations": result.iterations,
        "constraint_residual": result.constraint_residual,
        "sparse_constraint_residual": result.sparse_constraint_residual,
        "misfit": np.round(result.misfit, 12).tolist(),
    }
