"""What the diagnosis says of cases that both generators of the proof draw, from a seed of their own."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import siq
from benchmarks.golden.table import tolerated
from benchmarks.proof.batches import write_batch
from benchmarks.proof.concealment import cases as concealment
from benchmarks.proof.foreign import cases as foreign

SEED = 20261124
WORK = 6e8  # allowed, a dozen seconds of a core: that of some cases is cut short, always at the same place
OWN_SHARES = {"null": 0.20, "shift": 0.15, "mechanism": 0.45, "process noise": 0.08, "withheld": 0.12}
SETS = (
    ("concealment", concealment, 32, OWN_SHARES),
    ("foreign", foreign, 8, {"null": 0.17, "shift": 0.17, "withheld": 0.66}),
)
TOLERANCES = {
    "diagnosis": {
        **tolerated("estimates recalibrated", 1e-4, 1e-9),
        **tolerated("held_out place_shares region", 1e-3, 1e-6),
        **tolerated("standard_errors recalibrated_errors share_described work", 1e-2, 1e-6),
        **tolerated("delta_chi2 log_odds", 1e-3, 0.05),
    }
}


def diagnosis(results: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    """Every case; the work, not the clock, is what ends one."""
    for name, generator, count, shares in SETS:
        settings = {"cases": count, "seed": SEED, "shares": shares, "batch": count}
        with TemporaryDirectory() as folder:
            cases = Path(folder) / "cases"
            write_batch(settings, 0, generator=generator, cases=cases, keys=Path(folder) / "keys")
            for case in sorted(each for each in cases.iterdir() if each.is_dir()):
                yield f"{name} {case.name}", diagnosed(case)


def diagnosed(folder: Path) -> dict[str, Any]:
    """The verdict of one case with its numbers."""
    with (folder / "study.yaml").open("a", encoding="utf-8") as study:
        study.write(f"budget: {{evaluations: {WORK}}}\n")
    case = siq.read_case(folder / "system.yaml", folder / "recordings.parquet", folder / "study.yaml")
    try:
        said = siq.solve_case(case, clock=lambda: 0.0).statement.as_data()
    except siq.NumericalFailure as error:
        return {"verdict": type(error).__name__}
    place, description, refitted = said["location"], said["description"], said["recalibration"]
    told: dict[str, Any] = {
        "verdict": said["verdict"],
        "partial": said["partial"],
        "work": said["budget"]["spent"],
        "held_out": {name: one for name, one in said["fit"].items() if name not in ("metric", "squares")},
        "recalibrated": [one["after"] for one in refitted.values()],
        "recalibrated_errors": [one["standard_error"] for one in refitted.values()],
        "excluded": len(said["excluded"]),
        "not_fitted": len(said["not_fitted"]),
    }
    for kind in ("mechanisms", "described"):
        parts = said[kind]
        told[kind] = [[*_called(one), sorted(one["equations"])] for one in parts]
        for name in ("estimate", "standard_error"):
            told[f"{name}s {kind}"] = [[each[name] for each in one["parameters"].values()] for one in parts]
        for name in ("delta_chi2", "log_odds"):
            told[f"{name} {kind}"] = [one["evidence"][name] for one in parts]
    if description is not None:
        told["share_described"] = description["share_described"]
        told["described_by"] = [one["name"] for one in description["by"]]
        told["random_forces"] = description["random_forces_admitted"]
    if place is not None:
        told["place_shares"] = place["equations"]
        told |= {name: place[name] for name in ("coordinate", "outputs", "region", "recordings")}
    return told


def _called(part: dict[str, Any]) -> list[Any]:
    """The name of a mechanism; of what has none, its kind and of which coordinates it is a function."""
    nameless = part.get("kind", "mechanism") != "mechanism"
    return [part["kind"], part["coordinates"]] if nameless else ["mechanism", part["name"]]
