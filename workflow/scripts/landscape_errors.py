"""The landscape of every run against the references, beside networks, regression and what was published."""

from dataclasses import asdict
from typing import Any

import numpy as np
import pandas as pd
import sympy

from siq.decomposition.trained import TrainedNetworks, load_networks
from siq.field_file import read_field
from siq.landscape.comparison import (
    Comparison,
    Potential,
    compare_estimate,
    compare_overall,
    compare_wells,
    overall_level,
    relative_l2,
)
from siq.landscape.reference import ReferenceLandscape, read_reference
from siq.landscape.storage import StoredLandscape, read_landscape
from siq.model import read_model
from siq.published import mesh_potential, published_potentials
from siq.randomness import generator
from siq.study import load_published
from siq.symbolic import SymbolicDecomposition
from siq.systems import diffusion_matrix
from siq.tables import as_table, concatenate, write_table
from step import job, position_of

DRAWS = 100  # of the digits that a published formula does not print
SAME = 0.02  # of the region: attractors of a run so close to the reference's are the same


def matching(reference: ReferenceLandscape, stored: StoredLandscape) -> dict[int, int]:
    """For each attractor of the reference, the well of the run that has it."""
    width = np.ptp(reference.points, axis=0)
    pairs = {}
    for place, well in enumerate(stored.data["wells"]):
        distance = np.abs((reference.attractors - np.array(well["attractor"])) / width).max(axis=1)
        if distance.min() < SAME:
            pairs[int(np.argmin(distance))] = place
    return pairs


def as_rows(run: int, source: str, comparisons: list[Comparison]) -> pd.DataFrame:
    """Comparisons as rows of the table."""
    rows = [{"run": run, "source": source} | asdict(one) for one in comparisons]
    return as_table("landscape_errors", rows)


def of_landscape(
    run: int, reference: ReferenceLandscape, stored: StoredLandscape, below: float | None
) -> list[pd.DataFrame]:
    """Local formulas, their minimum over all wells, and their barriers."""
    pairs = matching(reference, stored)
    local = {index: one for index, place in pairs.items() if (one := stored.local[place]) is not None}
    comparisons = compare_wells(reference, local)
    if stored.quasipotential is not None:
        comparisons.append(compare_overall(reference, stored.quasipotential(reference.points), below=below))
    for index, place in pairs.items():
        ways = [way for way in stored.data["transitions"] if way["start"] == place and way["barrier"]]
        lowest = min((way["barrier"] for way in ways), default=float("nan"))
        error = abs(lowest / reference.barriers[index] - 1)
        comparisons.append(Comparison(f"barrier from A{index + 1}", 1, float(np.isfinite(error)), error))
    return [as_rows(run, "local formulas", comparisons)]


def of_formula(one: SymbolicDecomposition) -> Potential:
    """U of a formula as a function of points in rows."""
    return lambda x: 2 * one.evaluate(np.ascontiguousarray(x.T))[0]


def of_networks(one: TrainedNetworks) -> Potential:
    """U of networks as a function of points in rows."""
    return lambda x: 2 * one.evaluate(x).potential


def of_two(values: np.ndarray, mesh: np.ndarray, level: float) -> Comparison:
    """An estimate of U against a mesh that is known up to a constant, below a level above its minimum."""
    exact = mesh - np.nanmin(mesh)
    inside = np.nan_to_num(exact, nan=np.inf) < level
    own, exact = values[inside], exact[inside]
    error = relative_l2(own - np.median(own - exact), exact)
    return Comparison(f"U < {level:.4g}", int(inside.sum()), 1.0, error)


def of_published(
    source: Any, reference: ReferenceLandscape, study: dict[str, Any], below: float | None
) -> list[pd.DataFrame]:
    """The published formula, as printed and with what its rounding leaves open, and the published mesh."""
    if not source.get("published"):
        return []
    published, names = load_published(source.published), study["metric"]["states"]
    formulas = published_potentials(
        published.figures, [sympy.Symbol(name, real=True) for name in names], draws=DRAWS,
        generator=generator(study["seed"], "rounding"),
    )  # fmt: skip
    tables = []
    for number, one in enumerate(formulas):
        label = "published formula" + (", digits not printed" if number else "")
        tables.append(as_rows(number - 1, label, compare_estimate(reference, one, below=below)))
    if source.get("mesh") and published.mesh is not None:
        mesh = mesh_potential(source.mesh, published.mesh)
        tables.append(as_rows(-1, "published mesh", compare_estimate(reference, mesh, below=below)))
        if formulas:  # the paper's own comparison, in its Appendix E
            level = overall_level(reference) if below is None else below
            tables.append(
                as_rows(
                    -1,
                    "published formula, against the published mesh",
                    [of_two(formulas[0](reference.points), mesh(reference.points), level)],
                )
            )
    return tables


def main(snakemake: Any) -> None:
    """Run as a rule's script."""
    source, study = snakemake.input, snakemake.params.study
    reference = read_reference(source.reference)
    diffusion = diffusion_matrix(study["metric"]["diffusion"], reference.points.shape[1])
    below = study["landscape"]["compare_below"]
    tables = []
    for run, paths in enumerate(
        zip(source.fields, source.landscapes, source.models, source.networks, source.training, strict=True)
    ):
        field_path, landscape_path, model_path, networks_path, training_path = paths
        record = read_field(field_path)
        if record is None:
            continue
        stored = read_landscape(landscape_path, field=record.found.field, diffusion=diffusion)
        if stored is not None:
            tables += of_landscape(run, reference, stored, below)
        for method, one in read_model(model_path)[0].items():
            if one.potential is not None:
                tables.append(as_rows(run, method, compare_estimate(reference, of_formula(one), below=below)))
        position, _ = position_of(run, training_path)
        if position is not None:
            potential = of_networks(load_networks(networks_path, run=position))
            tables.append(as_rows(run, "networks", compare_estimate(reference, potential, below=below)))
    if np.isfinite(reference.mesh).any():
        whole = compare_overall(reference, reference.mesh_values, below=below)
        error = np.abs(reference.mesh_barriers / reference.barriers - 1)
        barriers = [
            Comparison(f"barrier from A{index + 1}", 1, 1.0, float(one)) for index, one in enumerate(error)
        ]
        tables.append(as_rows(-1, "mesh", [whole, *barriers]))
    tables += of_published(source, reference, study, below)
    write_table(snakemake.output.table, concatenate("landscape_errors", tables))


if __name__ == "__main__":
    with job(snakemake):  # type: ignore[name-defined]  # noqa: F821 (Snakemake puts it here)
        main(snakemake)  # type: ignore[name-defined]  # noqa: F821
