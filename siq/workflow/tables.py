"""Tables of results: their columns; and outcomes, which say what became of the steps of a run."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, Generic, TypeVar

import pandas as pd


class Step(StrEnum):
    """The steps of a run, in the order of the table `outcomes`; a run either simulates or resamples."""

    SIMULATE = "simulate"
    RESAMPLE = "resample"
    IDENTIFY = "identify"
    TRAIN = "train"
    REGRESS = "regress"
    REFINE = "refine"
    SCORE = "score"
    LANDSCAPE = "landscape"


class Status(StrEnum):
    """How a step ended: a result, one with a reservation, none, or never begun as a step before failed."""

    OK = "ok"
    WARNING = "warning"
    FAILED = "failed"
    SKIPPED = "skipped"


class Method(StrEnum):
    """Whose formulas they are.

    ``regression`` is the published method, ``refined`` ours. ``randomised network`` is no method but the
    control, a network with its weights in random order, refined as the real one is: no other V than the
    refined one may come of it with a certificate.
    """

    REGRESSION = "regression"
    REFINED = "refined"
    CONTROL = "randomised network"


METHODS = (Method.REGRESSION, Method.REFINED)
"""The paper's formulas, and ours, in the order of the tables."""


@dataclass(frozen=True)
class Outcome:
    """What became of one step of one run.

    Attributes
    ----------
    run
        Its number.
    step, status
        Which step, and how it ended.
    reason
        Why it is not ``ok``, in words; of one that is, what has to be known of it.
    details
        What else the step says of itself, as plain data.
    """

    run: int
    step: Step
    status: Status = Status.OK
    reason: str = ""
    details: Mapping[str, Any] = field(default_factory=dict)

    @property
    def usable(self) -> bool:
        """Whether the step left a result, be it with a reservation."""
        return self.status in (Status.OK, Status.WARNING)

    def as_data(self) -> dict[str, Any]:
        """As it stands in the file."""
        plain = {"run": self.run, "step": str(self.step), "status": str(self.status), "reason": self.reason}
        return plain | dict(self.details)

    @classmethod
    def from_data(cls, data: Mapping[str, Any]) -> Outcome:
        """The outcome that `as_data` gave."""
        details = {
            key: value for key, value in data.items() if key not in ("run", "step", "status", "reason")
        }
        return cls(int(data["run"]), Step(data["step"]), Status(data["status"]), data["reason"], details)


Result = TypeVar("Result", covariant=True)


@dataclass(frozen=True)
class StepResult(Generic[Result]):
    """What a step of a run found, None where it failed, and what became of it."""

    result: Result | None
    outcome: Outcome


def why_no_landscape(outcomes: Iterable[Outcome]) -> str:
    """Why steps left no landscape: what the one said that came as far as any, without a full stop."""
    outcomes = [one for one in outcomes if one.reason]
    for status in (Status.FAILED, Status.WARNING, Status.SKIPPED):
        mine = [one for one in outcomes if one.status == status]
        for one in sorted(mine, key=lambda each: each.step != Step.LANDSCAPE):
            return one.reason.rstrip(".")
    return "the recorded states lead to no stable state"


COLUMNS: Mapping[str, Mapping[str, str]] = {
    "coefficients": {
        "run": "int64",
        "method": "str",
        "component": "str",
        "term": "str",
        "estimate": "float64",
        "exact": "float64",
        "standard_error": "float64",
    },
    "prediction": {"run": "int64", "method": "str", "trajectory": "int64", "error": "float64"},
    "certificates": {
        "run": "int64",
        "method": "str",
        "test": "str",
        "value": "float64",
        "limit": "float64",
        "passed": "bool",
        "reason": "str",
    },
    "invariant": {
        "run": "int64",
        "method": "str",
        "intensity": "float64",
        "bessel": "float64",
        "quadrature": "float64",
        "simulated_distance": "float64",
        "sampling_floor": "float64",
        "published": "float64",
        "unknown_at_most": "float64",
        "simulated_unknown": "float64",
    },
    "well_shares": {
        "run": "int64",
        "intensity": "float64",
        "well": "str",
        "share": "float64",
        "by_rates": "float64",
        "simulated": "float64",
        "changed": "float64",
    },
    "landscape": {
        "run": "int64",
        "item": "str",
        "kind": "str",
        "position": "str",
        "eigenvalues": "str",
        "U": "float64",
        "basin": "float64",
        "barrier": "float64",
        "standard_error": "float64",
        "formula_share": "float64",
        "minimum_action": "float64",
        "prefactor": "float64",
        "noise": "float64",
        "barrier_over_noise": "float64",
        "mean_time": "float64",
        "mean_time_error": "float64",
        "note": "str",
    },
    "degrees": {
        "run": "int64",
        "attractor": "str",
        "degree": "int64",
        "terms": "int64",
        "residual": "float64",
        "covered": "float64",
        "chosen": "bool",
    },
    "record": {
        "run": "int64",
        "attractor": "str",
        "visits": "int64",
        "time": "float64",
        "counted": "float64",
        "lowest": "float64",
        "highest": "float64",
        "held_out_visits": "int64",
        "held_out_time": "float64",
        "held_out_counted": "float64",
        "predicted": "float64",
        "predicted_error": "float64",
        "method": "str",
        "probability": "float64",
    },
    "record_density": {
        "run": "int64",
        "attractor": "str",
        "state": "str",
        "lower": "float64",
        "upper": "float64",
        "counted": "float64",
        "predicted": "float64",
        "distance": "float64",
        "independent": "float64",
        "probability": "float64",
    },
    "landscape_errors": {
        "run": "int64",
        "source": "str",
        "region": "str",
        "points": "int64",
        "covered": "float64",
        "error": "float64",
        "error_everywhere": "float64",
    },
    "beside_equations": {
        "run": "int64",
        "item": "str",
        "quantity": "str",
        "noise": "float64",
        "equations": "float64",
        "trajectories": "float64",
        "standard_error": "float64",
        "relative_difference": "float64",
        "in_errors": "float64",
        "note": "str",
    },
    "sweep": {
        "value": "float64",
        "second_value": "float64",
        "well": "int64",
        "attractor": "str",
        "relaxation": "float64",
        "barrier": "float64",
        "exit": "Int64",
        "noise": "float64",
        "mean_time": "float64",
        "law_error": "float64",
        "weight": "float64",
        "note": "str",
    },
    "sweep_ways": {
        "value": "float64",
        "second_value": "float64",
        "well": "int64",
        "exit": "Int64",
        "barrier": "float64",
        "prefactor": "float64",
        "relaxation": "float64",
        "note": "str",
    },
    "branches": {
        "branch": "int64",
        "well": "int64",
        "value": "float64",
        "position": "str",
        "unstable": "int64",
        "growth": "float64",
        "frequency": "float64",
    },
    "bifurcations": {
        "kind": "str",
        "value": "float64",
        "position": "str",
        "branch": "int64",
        "frequency": "float64",
        "residual": "float64",
    },
    "bifurcation_curves": {
        "curve": "int64",
        "kind": "str",
        "value": "float64",
        "second_value": "float64",
        "position": "str",
        "frequency": "float64",
    },
    "escape": {
        "transition": "str",
        "intensity": "float64",
        "predicted": "float64",
        "simulated": "float64",
        "simulated_error": "float64",
        "escapes": "int64",
        "note": "str",
    },
    "rrmse": {
        "run": "int64",
        "method": "str",
        "rrmse": "float64",
        "support_correct": "boolean",
        "certified": "bool",
        "network_error": "float64",
        "stated_error": "float64",
    },
    "outcomes": {"run": "int64", "step": "str", "status": "str", "reason": "str"},
    "timings": {"run": "int64", "step": "str", "seconds": "float64"},
    "training": {
        "run": "int64",
        "step": "int64",
        "training_loss": "float64",
        "held_out_loss": "float64",
        "dynamics": "float64",
        "orthogonality": "float64",
        "learning_rate": "float64",
    },
    "summary": {
        "method": "str",
        "quantity": "str",
        "exact": "float64",
        "mean": "float64",
        "standard_deviation": "float64",
        "median": "float64",
        "inclusion_frequency": "float64",
        "runs": "int64",
        "published": "float64",
        "published_standard_deviation": "float64",
        "source": "str",
    },
}
"""Columns of every table, in order, with their types: the contract with whoever reads the results."""


def as_table(name: str, rows: pd.DataFrame | list[dict[str, object]]) -> pd.DataFrame:
    """Rows in the columns and types of a table of the contract; further columns are refused."""
    columns = COLUMNS[name]
    frame = pd.DataFrame(rows, columns=None if len(rows) else list(columns))
    unknown = set(frame.columns) - set(columns)
    if unknown:
        raise ValueError(
            f"the table '{name}' has no columns {sorted(unknown)}; see siq.workflow.tables.COLUMNS"
        )
    return frame.reindex(columns=list(columns)).astype(dict(columns)).reset_index(drop=True)
