"""Figures of the landscape: U with wells, paths and validity; error maps; degrees; escape times."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
import sympy
from matplotlib.figure import Figure

from siq.data.recordings import Recordings
from siq.dynamics.formulas import compile_formulas
from siq.landscape.comparison import Potential, overall_level
from siq.landscape.reference import ReferenceLandscape
from siq.landscape.storage import StoredLandscape
from siq.networks.trained import TrainedNetworks
from siq.potential.symbolic import SymbolicDecomposition
from siq.report.plots.landscape import plot_error_maps, plot_landscape
from siq.report.plots.landscape_curves import plot_degrees, plot_escape
from siq.report.plots.one_state import DrawnBarrier, plot_error_curves, plot_landscape_curve
from siq.report.plots.style import sentence_figure
from siq.report.settings import LandscapeFiguresSettings
from siq.steps.outcomes import Method
from siq.steps.settings import StateSpace
from siq.study.published import published_formula
from siq.study.study import PublishedFigure

GRID = 161


@dataclass(frozen=True)
class LandscapeRun:
    """The run whose landscape is shown: U over all wells, its trajectories, formulas by method, networks."""

    landscape: StoredLandscape
    recordings: Recordings
    formulas: Mapping[str, SymbolicDecomposition]
    networks: TrainedNetworks | None


@dataclass(frozen=True)
class LandscapeComparisons:
    """What a landscape is held against, as far as it is known.

    Attributes
    ----------
    reference
        Of the card.
    escape, degrees
        The tables; `escape` is empty where nothing was simulated.
    published
        Published figures by quantity.
    mesh
        U on a mesh that was published.
    """

    reference: ReferenceLandscape | None
    escape: pd.DataFrame
    degrees: pd.DataFrame
    published: Mapping[str, PublishedFigure]
    mesh: Potential | None


def landscape_figures(
    settings: LandscapeFiguresSettings, shown: LandscapeRun | None, beside: LandscapeComparisons
) -> dict[str, Figure]:
    """All figures of a landscape by name; None is shown where no run knows U over all wells."""
    space, escape = settings.space, beside.escape
    figures = {
        "landscape": sentence_figure("No run found U over all wells."),
        "landscape_errors": sentence_figure("There is nothing to compare the landscape with."),
        "landscape_published": sentence_figure("No landscape was published."),
        "degrees": plot_degrees(beside.degrees),
        "escape": plot_escape(escape, time_unit=space.unit("t", unknown="1"))
        if len(escape)
        else sentence_figure("No escape was simulated."),
    }
    if beside.reference is not None and beside.reference.reason:
        figures["landscape_errors"] = sentence_figure(
            f"There is no reference for the landscape: {beside.reference.reason}."
        )
    if shown is None:
        return figures
    if len(shown.recordings.names) > 2:
        of_more = "U is drawn of one state or of two, and these are {}."
        figures["landscape"] = sentence_figure(of_more.format(len(shown.recordings.names)))
        return figures
    one_state = len(shown.recordings.names) == 1
    figures["landscape"] = (_curve_figure if one_state else _landscape_figure)(space, shown)
    if beside.reference is not None and not beside.reference.reason:
        figures |= _maps(settings, shown, beside, beside.reference)
    return figures


def _curve_figure(space: StateSpace, shown: LandscapeRun) -> Figure:
    """U over the only state, with its wells and barriers."""
    stored, recordings = shown.landscape, shown.recordings
    assert stored.quasipotential is not None
    x = np.linspace(recordings.values.min(), recordings.values.max(), 4 * GRID)
    equilibria = _equilibria_table(stored.data)
    wells = stored.data["wells"]
    barriers = [
        DrawnBarrier(
            wells[way["start"]]["attractor"][0], way["saddle"][0], wells[way["start"]]["height"],
            wells[way["start"]]["height"] + way["barrier"],
        )
        for way in stored.data["transitions"]
        if way["barrier"] is not None
    ]  # fmt: skip
    return plot_landscape_curve(
        x, stored.quasipotential(x[:, None]), name=recordings.names[0], unit=space.unit(recordings.names[0]),
        equilibria=equilibria.assign(y=stored.quasipotential(equilibria[["x"]].to_numpy(float))),
        barriers=barriers,
    )  # fmt: skip


def _landscape_figure(space: StateSpace, shown: LandscapeRun) -> Figure:
    """U over both states, with equilibria and paths."""
    stored, recordings = shown.landscape, shown.recordings
    assert stored.quasipotential is not None
    box = np.stack([recordings.values.min(axis=0), recordings.values.max(axis=0)], axis=1)
    axes = tuple(np.linspace(low, high, GRID) for low, high in box)
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    ways = [way for way in stored.data["transitions"] if way["uphill"]]
    tops = [stored.data["wells"][way["start"]]["height"] + way["barrier"] for way in ways]
    return plot_landscape(
        axes, stored.quasipotential(grid).reshape(GRID, GRID), names=recordings.names,
        units=tuple(space.unit(name) for name in recordings.names), energy_unit="",
        equilibria=_equilibria_table(stored.data),
        paths=[(np.array(way["uphill"]), np.array(way["downhill"])) for way in ways],
        level=1.2 * max(tops) if tops else None,
    )  # fmt: skip


def _maps(
    settings: LandscapeFiguresSettings,
    shown: LandscapeRun,
    beside: LandscapeComparisons,
    reference: ReferenceLandscape,
) -> dict[str, Figure]:
    """U by every source beside the reference: ours, and what was published."""
    names = shown.recordings.names
    below = settings.landscape.compare_below or overall_level(reference)
    inside = np.nan_to_num(reference.values, nan=np.inf) < below
    maps = {"landscape_errors": _error_maps(shown, reference, inside)}
    if of_others := _published_maps(shown.landscape, reference, beside, inside, names):
        maps["landscape_published"] = of_others
    units = tuple(settings.space.unit(name) for name in names)
    if len(names) == 1:
        x = reference.points[:, 0]
        return {
            figure: plot_error_curves(x, one, name=names[0], unit=units[0]) for figure, one in maps.items()
        }
    side = round(len(reference.points) ** 0.5)
    axes = (reference.points[::side, 0], reference.points[:side, 1])
    return {
        figure: plot_error_maps(
            axes,
            {name: values.reshape(side, side) for name, values in one.items()},
            names=names,
            units=units,
            energy_unit="",
        )
        for figure, one in maps.items()
    }


def _equilibria_table(data: Mapping[str, Any]) -> pd.DataFrame:
    """Equilibria with their labels, of two states or one."""
    labels = {tuple(well["attractor"]): f"A{index + 1}" for index, well in enumerate(data["wells"])}
    return pd.DataFrame(
        [
            {
                "kind": one["kind"], "x": one["position"][0], "y": one["position"][-1],
                "label": labels.get(tuple(one["position"]), ""),
            }
            for one in data["equilibria"]
        ],
        columns=["kind", "x", "y", "label"],
    )  # fmt: skip


def _error_maps(
    shown: LandscapeRun, reference: ReferenceLandscape, inside: np.ndarray
) -> dict[str, np.ndarray]:
    """U by every source at the points of the reference, those inside."""
    x, potential = reference.points, shown.landscape.quasipotential
    assert potential is not None
    maps = {"characteristics": reference.values, "mesh": reference.mesh_values}
    if shown.networks is not None:
        maps["networks"] = 2 * shown.networks.evaluate(x).potential
    regression = shown.formulas.get(Method.REGRESSION)
    if regression is not None and regression.potential is not None:
        maps[str(Method.REGRESSION)] = 2 * regression.evaluate(np.ascontiguousarray(x.T))[0]
    maps["local formulas"] = potential(x)
    return _shifted(maps, inside, of_any_constant=("networks", str(Method.REGRESSION)))


def _published_maps(
    stored: StoredLandscape,
    reference: ReferenceLandscape,
    beside: LandscapeComparisons,
    inside: np.ndarray,
    names: tuple[str, ...],
) -> dict[str, np.ndarray]:
    """What was published of U at the points of the reference, those inside, and ours; empty without any."""
    x, potential = reference.points, stored.quasipotential
    assert potential is not None
    symbols = [sympy.Symbol(name, real=True) for name in names]
    formula = published_formula(beside.published, "U", symbols)
    maps = {"characteristics": reference.values}
    if beside.mesh is not None:
        maps["published mesh"] = beside.mesh(x)
    if formula is not None:
        maps["published formula"] = compile_formulas([formula], symbols)(np.ascontiguousarray(x.T))[0]
    if len(maps) == 1:
        return {}
    maps["local formulas"] = potential(x)
    return _shifted(maps, inside, of_any_constant=("published mesh", "published formula"))


def _shifted(
    maps: dict[str, np.ndarray], inside: np.ndarray, *, of_any_constant: tuple[str, ...]
) -> dict[str, np.ndarray]:
    """Maps of the points inside; some shifted to the first by the median of their difference."""
    exact = next(iter(maps.values()))
    shown = {}
    for name, values in maps.items():
        shift = np.nanmedian((values - exact)[inside]) if name in of_any_constant else 0.0
        shown[name] = np.where(inside, values - shift, np.nan)
    return shown
