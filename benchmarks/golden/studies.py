"""What a finished run of the workflow left: the tables and the answer of every study that has results.

Histories, times and sentences are left out; of formulas the terms are written down that they have.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from benchmarks.golden.table import LEARNED, tolerated

STUDIES = Path(__file__).parents[2] / "config" / "studies"
BY: dict[str, tuple[str, ...]] = {  # what names an item, by table
    **dict.fromkeys(("coefficients", "rrmse", "certificates", "prediction", "invariant"), ("run", "method")),
    **dict.fromkeys(("landscape", "record", "outcomes", "well_shares"), ("run",)),
    "summary": ("method",),
    **dict.fromkeys(("landscape_errors", "beside_equations", "escape", "sweep", "sweep_ways"), ()),
    **dict.fromkeys(("branches", "bifurcations", "bifurcation_curves"), ()),
}
WORDS = ["title", "sentence", "note", "reason"]
OVER_RUNS = ["mean", "standard_deviation", "median", "inclusion_frequency"]
TOLERANCES = {
    "studies": {
        **tolerated("coefficients prediction rrmse.rrmse rrmse.stated_error over_runs", 1e-6, 1e-8),
        **tolerated("invariant.bessel invariant.quadrature invariant.unknown_at_most", 1e-6, 1e-9),
        **tolerated(
            "invariant.simulated_distance invariant.sampling_floor invariant.simulated_unknown", 0.02, 1e-6
        ),
        **tolerated("rrmse.network_error network_error", 0.1),  # of which refined formulas are free
        **tolerated(
            "learned_coefficients learned_prediction learned_over_runs learned_network_error", 1e-4, 1e-6
        ),
        **tolerated("learned_rrmse.rrmse learned_rrmse.network_error learned_rrmse.stated_error", 1e-4),
    }
}


def studies(results: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    """The answer of every study, formulas, errors and verdicts of every run, and whole tables."""
    for study in sorted(path.stem for path in STUDIES.glob("*.yaml")):
        if not _has_results(study, results):
            continue
        answer = json.loads((results / study / "answer.json").read_text(encoding="utf-8"))
        yield f"{study}: answer", {key: value for key, value in answer.items() if key not in WORDS}
        parts: dict[str, dict[str, Any]] = {}
        for name, keys in BY.items():
            for values, rows in _parts(results / study / "tables" / f"{name}.parquet", keys):
                called = " ".join([study + ":", *(keys[:1] or (name,)), *map(str, values)])
                learned = LEARNED if "regression" in values else ""
                said = {learned + each: value for each, value in _quantities(name, rows).items()}
                parts.setdefault(called, {}).update(said)
        yield from parts.items()


def skipped(known: Iterable[str], results: Path) -> list[str]:
    """The items whose studies have no results."""
    return [item for item in known if not _has_results(item.split(":")[0], results)]


def _has_results(study: str, results: Path) -> bool:
    return (results / study / "answer.json").is_file()


def _parts(path: Path, keys: Sequence[str]) -> Iterator[tuple[tuple[Any, ...], pd.DataFrame]]:
    table = pd.read_parquet(path) if path.is_file() else pd.DataFrame()
    if len(table) and keys:
        for values, rows in table.groupby(list(keys)):
            yield tuple(values), rows.drop(columns=list(keys))
    elif len(table):
        yield (), table


def _quantities(name: str, rows: pd.DataFrame) -> dict[str, Any]:
    if name == "coefficients":
        parts = rows[rows["estimate"] != 0].sort_values(["component", "term"]).groupby("component")
        supports = {f"support {component}": part["term"] for component, part in parts}
        return supports | {f"coefficients {component}": part["estimate"] for component, part in parts}
    if name == "summary":
        found = rows[rows["mean"].notna() & (rows["mean"] != 0)].set_index("quantity")[OVER_RUNS]
        found.index = [
            "network_error" if one == "network_error" else f"over_runs {one}" for one in found.index
        ]
        return {str(quantity): numbers for quantity, numbers in found.T.items()}
    if name == "prediction":
        return {"prediction": rows["error"].median()}
    if name == "certificates":
        failed = rows["test"][~rows["passed"].astype(bool)]
        return {"tests": sorted(rows["test"]), "tests_failed": sorted(failed)}
    columns = rows.drop(columns=WORDS, errors="ignore").astype(object)
    lists = columns.where(columns.notna(), None).to_dict("list")
    return {f"{name}.{column}": one[0] if len(one) == 1 else one for column, one in lists.items()}
