"""Score: how far are formulas and networks of a run from exact answers, and from unseen trajectories?

Where no exact answer is known the coefficients stand in the table without one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass as plain_dataclass
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

from siq.inference.library import candidate_library
from siq.inference.residuals import prediction_errors
from siq.networks.decomposition import TrainedNetworks, shuffled
from siq.numerics.randomness import Purpose, generator
from siq.quasipotential.formulas import SymbolicDecomposition
from siq.systems.dynamics import Dynamics
from siq.systems.simulation import SimulationOptions, simulate_snapshots
from siq.workflow.outcomes import METHODS, Method, Outcome, Status, Step
from siq.workflow.scoring import (
    coefficient_table,
    domain_grid,
    exact_values,
    relative_error,
    relative_root_mean_square_error,
    support_is_correct,
)
from siq.workflow.settings import PipelineSettings
from siq.workflow.tables import as_table, concatenate
from siq.workflow.training_step import TrainedRun

COARSE = 50_000  # points of the grid on which the randomised network is scored
UNSEEN = 1000  # trajectories that no run learns from (paper, section 3.1)


@plain_dataclass(frozen=True)
class RunToScore:
    """What is scored, and by what.

    Attributes
    ----------
    formulas, certificates
        Of the run, by method.
    trained
        Its networks.
    system
        Its card, None where there is none.
    exact
        The exact decomposition, None where the card does not know it.
    """

    formulas: Mapping[str, SymbolicDecomposition]
    certificates: Mapping[str, Mapping[str, Any]]
    trained: TrainedRun
    system: Dynamics | None = None
    exact: SymbolicDecomposition | None = None


@plain_dataclass(frozen=True)
class Scored:
    """The tables of a run, see `siq.workflow.tables.COLUMNS`, and the outcome."""

    coefficients: pd.DataFrame
    rrmse: pd.DataFrame
    prediction: pd.DataFrame
    certificates: pd.DataFrame
    outcome: Outcome

    def files(self) -> dict[str, Any]:
        """By the names of the rule."""
        names = ("coefficients", "rrmse", "prediction", "certificates")
        return {name: getattr(self, name) for name in names} | {"score_outcome": [self.outcome]}


def run(settings: PipelineSettings, given: RunToScore) -> Scored:
    """Scores of one run."""
    number, system, exact = given.trained.outcome.run, given.system, given.exact
    options, tables = settings.regression, []
    errors: dict[str, dict[str, Any]] = {
        # A method without a formula stays in the table, without an error to boast of.
        str(method): {"run": number, "method": str(method), "certified": False}
        for method in Method
        if method in settings.methods or method in given.certificates
    }
    for method, one in given.certificates.items():
        errors[method] |= {"certified": one["certified"], "stated_error": one["stated_error"]}
    for method, identified in given.formulas.items():
        library = candidate_library(
            [symbol.name for symbol in identified.symbols], degree=options.degree, further=options.functions
        )
        table = coefficient_table(number, method, identified, exact, terms=library.names)
        tables.append(table)
        errors[method] |= {
            "rrmse": relative_root_mean_square_error(table),
            "support_correct": support_is_correct(table),
        }
    if exact is not None and system is not None and given.trained.networks is not None:
        draw = generator(settings.seed, number, Purpose.SHUFFLE)
        known = _network_errors(given.trained.networks, system.box, exact, draw)
        for method, row in errors.items():
            row["network_error"] = known[method]
    predicted = as_table("prediction", [])
    if system is not None and settings.simulation is not None and given.formulas:
        predicted = _predictions(system, given.formulas, number, settings.simulation, settings.seed)
    return Scored(
        coefficients=concatenate("coefficients", tables),
        rrmse=as_table("rrmse", list(errors.values())),
        prediction=predicted,
        certificates=_certificate_table(number, given.certificates),
        outcome=_outcome(number, has_formulas=bool(given.formulas), known=exact is not None),
    )


def _outcome(number: int, *, has_formulas: bool, known: bool) -> Outcome:
    if not has_formulas:
        return Outcome(number, Step.SCORE, Status.SKIPPED, "there is no formula to score")
    if not known:
        return Outcome(number, Step.SCORE, Status.SKIPPED, "no exact answer is known")
    return Outcome(number, Step.SCORE)


def _network_errors(
    trained: TrainedNetworks, box: np.ndarray, exact: SymbolicDecomposition, draw: np.random.Generator
) -> dict[str, float]:
    """Relative L2 error on a grid over Ω of the U of the trained network, and of a randomised one."""
    randomised = shuffled(trained, generator=draw)

    def error_of(networks: TrainedNetworks, grid: np.ndarray) -> float:
        return relative_error(2 * networks.potential_at(grid.T), exact_values(exact, grid))

    error = error_of(trained, domain_grid(box))
    chance = error_of(randomised, domain_grid(box, points=COARSE))
    return dict.fromkeys(map(str, METHODS), error) | {str(Method.CONTROL): chance}


def _predictions(
    system: Dynamics,
    formulas: Mapping[str, SymbolicDecomposition],
    number: int,
    simulation: SimulationOptions,
    seed: int,
) -> pd.DataFrame:
    """Errors of long-term prediction of unseen trajectories of the system without noise."""
    options = replace(simulation, trajectories=UNSEEN, noise_intensity=0.0)
    unseen = simulate_snapshots(system, options=options, generator=generator(seed, Purpose.UNSEEN))
    tables = [
        pd.DataFrame(
            {
                "run": number,
                "method": method,
                "trajectory": np.arange(UNSEEN),
                "error": prediction_errors(Dynamics.of(one.symbols, one.vector_field), unseen),
            }
        )
        for method, one in formulas.items()
    ]
    return concatenate("prediction", tables)


def _certificate_table(number: int, certificates: Mapping[str, Mapping[str, Any]]) -> pd.DataFrame:
    """Every test of every formula, with its figure."""
    rows = [
        {"run": number, "method": method, "test": test} | verdict
        for method, one in certificates.items()
        for test, verdict in one["tests"].items()
    ]
    return as_table("certificates", rows)
