"""Figures of the landscape: U with wells, paths and validity; error maps; degrees; escape times."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import sympy

from landscapes import first_complete
from siq.decomposition.trained import load_networks
from siq.expressions import compile_formulas
from siq.landscape.comparison import overall_level
from siq.landscape.reference import ReferenceLandscape, read_reference
from siq.landscape.storage import StoredLandscape
from siq.model import read_model
from siq.plots.landscape import plot_error_maps, plot_landscape
from siq.plots.landscape_curves import plot_degrees, plot_escape
from siq.plots.saving import save_figure
from siq.plots.style import sentence_figure
from siq.published import mesh_potential, published_formula
from siq.recordings import read_recordings
from siq.study import load_published
from siq.tables import read_table
from step import METHODS, job, position_of

GRID = 161


def equilibria_table(data: Mapping[str, Any]) -> pd.DataFrame:
    """Equilibria with their labels, in the first two states."""
    labels = {tuple(well["attractor"]): f"A{index + 1}" for index, well in enumerate(data["wells"])}
    return pd.DataFrame(
        [
            {
                "kind": one["kind"], "x": one["position"][0], "y": one["position"][1],
                "label": labels.get(tuple(one["position"]), ""),
            }
            for one in data["equilibria"]
        ],
        columns=["kind", "x", "y", "label"],
    )  # fmt: skip


def error_maps(
    run: int, stored: StoredLandscape, reference: ReferenceLandscape, source: Any, below: float
) -> dict[str, np.ndarray]:
    """U by every source at the points of the reference, below a level."""
    x, exact = reference.points, reference.values
    inside = np.nan_to_num(exact, nan=np.inf) < below
    assert stored.quasipotential is not None
    maps = {"characteristics": exact, "mesh": reference.mesh_values}
    position, _ = position_of(run, source.training[run])
    if position is not None:
        maps["networks"] = 2 * load_networks(source.networks[run], run=position).evaluate(x).potential
    for method, one in read_model(source.models[run])[0].items():
        if method == METHODS[0] and one.potential is not None:
            maps[method] = 2 * one.evaluate(np.ascontiguousarray(x.T))[0]
    maps["local formulas"] = stored.quasipotential(x)
    return shifted(maps, inside, of_any_constant=("networks", METHODS[0]))


def published_maps(
    stored: StoredLandscape, reference: ReferenceLandscape, source: Any, states: list[str], below: float
) -> dict[str, np.ndarray]:
    """What was published of U at the points of the reference, below a level, and ours; empty without any."""
    x, exact = reference.points, reference.values
    inside = np.nan_to_num(exact, nan=np.inf) < below
    assert stored.quasipotential is not None
    if not source.get("published"):
        return {}
    published = load_published(source.published)
    symbols = [sympy.Symbol(name, real=True) for name in states]
    formula = published_formula(published.figures, "U", symbols)
    maps = {"characteristics": exact}
    if source.get("mesh") and published.mesh is not None:
        maps["published mesh"] = mesh_potential(source.mesh, published.mesh)(x)
    if formula is not None:
        maps["published formula"] = compile_formulas([formula], symbols)(np.ascontiguousarray(x.T))[0]
    if len(maps) == 1:
        return {}
    maps["local formulas"] = stored.quasipotential(x)
    return shifted(maps, inside, of_any_constant=("published mesh", "published formula"))


def shifted(
    maps: dict[str, np.ndarray], inside: np.ndarray, *, of_any_constant: tuple[str, ...]
) -> dict[str, np.ndarray]:
    """Maps of the points inside as squares; some shifted to the first by the median of their difference."""
    side = round(len(inside) ** 0.5)
    exact = next(iter(maps.values()))
    shown = {}
    for name, values in maps.items():
        shift = np.nanmedian((values - exact)[inside]) if name in of_any_constant else 0.0
        shown[name] = np.where(inside, values - shift, np.nan).reshape(side, side)
    return shown


def main(snakemake: Any) -> None:
    """Run as a rule's script."""
    source, study, folder = snakemake.input, snakemake.params.study, Path(snakemake.params.folder)
    found = first_complete(source.fields, source.landscapes, study["metric"]["diffusion"])
    landscape = sentence_figure("No run found U over all wells.")
    maps = sentence_figure("There is nothing to compare the landscape with.")
    published = sentence_figure("No landscape was published.")
    if found is not None and len(found[1].data["states"]) == 2:
        run, stored = found
        assert stored.quasipotential is not None
        recordings = read_recordings(source.recordings[run])
        units = tuple((study["metric"]["units"] or {}).get(name, "") for name in recordings.names)
        box = np.stack([recordings.values.min(axis=0), recordings.values.max(axis=0)], axis=1)
        axes = tuple(np.linspace(low, high, GRID) for low, high in box)
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
        ways = [way for way in stored.data["transitions"] if way["uphill"]]
        tops = [stored.data["wells"][way["start"]]["height"] + way["barrier"] for way in ways]
        landscape = plot_landscape(
            axes, stored.quasipotential(grid).reshape(GRID, GRID), names=recordings.names, units=units,
            energy_unit="", equilibria=equilibria_table(stored.data),
            paths=[(np.array(way["uphill"]), np.array(way["downhill"])) for way in ways],
            level=1.2 * max(tops) if tops else None,
        )  # fmt: skip
        if source.get("reference"):
            reference = read_reference(source.reference)
            below = study["landscape"]["compare_below"] or overall_level(reference)
            side = round(len(reference.points) ** 0.5)
            own = (reference.points[::side, 0], reference.points[:side, 1])
            maps = plot_error_maps(
                own, error_maps(run, stored, reference, source, below), names=recordings.names,
                units=units, energy_unit="",
            )  # fmt: skip
            if of_others := published_maps(stored, reference, source, list(recordings.names), below):
                published = plot_error_maps(
                    own, of_others, names=recordings.names, units=units, energy_unit=""
                )
    escape = read_table(source.escape) if source.get("escape") else pd.DataFrame()
    figures = {
        "landscape": landscape,
        "landscape_errors": maps,
        "landscape_published": published,
        "degrees": plot_degrees(read_table(source.degrees)),
        "escape": plot_escape(escape, time_unit=(study["metric"]["units"] or {}).get("t", "1"))
        if len(escape)
        else sentence_figure("No escape was simulated."),
    }
    for name, figure in figures.items():
        save_figure(figure, folder / name)


if __name__ == "__main__":
    with job(snakemake):  # type: ignore[name-defined]  # noqa: F821 (Snakemake puts it here)
        main(snakemake)  # type: ignore[name-defined]  # noqa: F821
