"""Tables as files: Parquet with a CSV beside it, whole or not at all."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import pandas as pd

from siq.errors import InputError
from siq.numerics.files import whole_file

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


def concatenate(name: str, tables: Sequence[pd.DataFrame]) -> pd.DataFrame:
    """Tables of one kind below each other, in the order given; also of none."""
    filled = [table for table in tables if len(table)]
    return as_table(name, pd.concat(filled, ignore_index=True) if filled else [])


def write_table(path: str | Path, table: pd.DataFrame) -> None:
    """Write a table as Parquet to `path`, and as CSV beside it.

    Numbers in the CSV have as many digits as it takes to read the same numbers back.
    """
    path = Path(path)
    with whole_file(path.with_suffix(".csv")) as partial:
        table.to_csv(partial, index=False)
    with whole_file(path) as partial:
        table.to_parquet(partial, index=False)


def read_table(path: str | Path) -> pd.DataFrame:
    """Read a table that `write_table` wrote.

    Raises
    ------
    InputError
        When the file is missing or is not Parquet.
    """
    try:
        return pd.read_parquet(path)
    except (OSError, ValueError):
        raise InputError(path, "", "it is not a Parquet table", "make it again") from None
