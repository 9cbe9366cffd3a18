"""Figures of the landscape: error maps, degrees, escape times; `siq.report.study_figures` draws U itself."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

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
from siq.report.plots.landscape import plot_error_maps
from siq.report.plots.landscape_curves import plot_degrees, plot_escape
from siq.report.plots.one_state import plot_error_curves
from siq.report.said_landscape import SaidLandscape
from siq.report.settings import LandscapeFiguresSettings
from siq.steps.outcomes import Method
from siq.study.published import published_formula
from siq.study.published_figures import PublishedFigure


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
) -> dict[str, Figure | None]:
    """All figures of a landscape by name, None for one that has nothing to show.

    Nothing is `shown` where no run knows U over all wells.
    """
    time_unit = settings.space.unit("t", unknown="1")
    figures: dict[str, Figure | None] = {
        "degrees": plot_degrees(beside.degrees),
        "escape": plot_escape(beside.escape, time_unit=time_unit),
    }
    if shown is None or beside.reference is None or beside.reference.reason:
        return figures
    if len(shown.recordings.names) > 2:  # errors are drawn on a plane, or along a line
        return figures
    return figures | _maps(settings, shown, beside, beside.reference)


def _maps(
    settings: LandscapeFiguresSettings,
    shown: LandscapeRun,
    beside: LandscapeComparisons,
    reference: ReferenceLandscape,
) -> dict[str, Figure | None]:
    """U by every source beside the reference: ours, and what was published."""
    names = shown.recordings.names
    below = settings.landscape.compare_below or overall_level(reference)
    inside = np.nan_to_num(reference.values, nan=np.inf) < below
    maps = {"landscape_errors": _error_maps(shown, reference, inside)}
    if of_others := _published_maps(shown.landscape, reference, beside, inside, names):
        maps["landscape_published"] = of_others
    units = tuple(settings.space.unit(name, unknown="1") for name in names)
    said = {"states": names, "units": units, "time_unit": settings.space.unit("t", unknown="1")}
    energy = SaidLandscape(said).energy_unit
    if len(names) == 1:
        x = reference.points[:, 0]
        return {
            figure: plot_error_curves(x, one, name=names[0], unit=units[0], energy_unit=energy)
            for figure, one in maps.items()
        }
    side = round(len(reference.points) ** 0.5)
    axes = (reference.points[::side, 0], reference.points[:side, 1])
    return {
        figure: plot_error_maps(
            axes,
            {name: values.reshape(side, side) for name, values in one.items()},
            names=names,
            units=units,
            energy_unit=energy,
        )
        for figure, one in maps.items()
    }


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
