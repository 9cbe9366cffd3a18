"""The figures of a study: its data, its formulas over the runs, its decomposition, its predictions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from siq.data.recordings import Recordings, snapshot_pairs
from siq.dynamics.dynamics import Dynamics
from siq.dynamics.simulation import simulate_snapshots
from siq.identify.prediction import predict
from siq.landscape.global_quasipotential import GlobalQuasipotential
from siq.landscape.storage import StoredLandscape
from siq.networks.regression import highest_used, points_below
from siq.networks.trained import TrainedNetworks
from siq.numerics.randomness import Purpose, generator
from siq.potential.symbolic import SymbolicDecomposition
from siq.report.drawn_landscape import DrawnLandscape, drawn_data
from siq.report.plots import (
    ComponentFields,
    Dataset,
    plot_coefficient_distributions,
    plot_components,
    plot_dataset,
    plot_error_distribution,
    plot_inclusion,
    plot_prediction,
    plot_training,
)
from siq.report.plots.quasipotential import quasipotential_figure
from siq.report.plots.record import plot_record
from siq.report.plots.residuals import residuals_figure
from siq.report.projection import project, project_landscape
from siq.report.said_landscape import SaidLandscape
from siq.report.settings import FiguresSettings
from siq.steps.outcomes import METHODS, Method
from siq.steps.shown import ModelFiles, Shown
from siq.study.published_figures import PublishedFigure

TRAJECTORIES = 5
PREDICTED = 6
GRID = 161  # on which the level of the regression is drawn


@dataclass(frozen=True)
class ShownRun:
    """The run that is shown.

    Attributes
    ----------
    number
        Of the run; the first where none has a formula.
    formula
        Its formula, None where there is none.
    landscape
        U over all wells, where no single refined formula holds.
    dynamics
        Its f.
    recordings, networks
        Its trajectories and its networks, None where there are none.
    exact
        The exact decomposition, where a card knows it.
    """

    number: int
    formula: SymbolicDecomposition | None
    landscape: GlobalQuasipotential | None
    dynamics: Dynamics | None
    recordings: Recordings | None = None
    networks: TrainedNetworks | None = None
    exact: SymbolicDecomposition | None = None


@dataclass(frozen=True)
class PicturedRun:
    """The run of the first picture: what of its landscape is drawn, its f, its recordings with their units.

    Attributes
    ----------
    overview
        Its landscape as plain data, None where f has no attractor.
    stored
        The same with the formulas about the attractors.
    formula
        Its refined formula, None where there is none.
    dynamics
        Its f and D.
    recordings
        Its trajectories.
    """

    overview: Mapping[str, Any] | None
    stored: StoredLandscape | None
    formula: SymbolicDecomposition | None
    dynamics: Dynamics
    recordings: Recordings

    def drawn(self) -> DrawnLandscape:
        """What is drawn of it."""
        data = self.overview
        if data is None:
            units = [unit or "1" for unit in self.recordings.units]
            data = {
                "states": self.recordings.names, "units": units,
                "time_unit": self.recordings.time_unit or "1",
                "wells": [], "equilibria": [], "transitions": [],
            }  # fmt: skip
        return drawn_data(
            data, wells=() if self.stored is None else self.stored.wells, dynamics=self.dynamics,
            points=self.recordings.values, formula=self.formula,
        )  # fmt: skip


def leading_figures(run: PicturedRun) -> dict[str, Figure | None]:
    """What a page opens with, `quasipotential`, and the first of its evidence, `residuals`."""
    shown = run.drawn()
    time_unit = str((run.overview or {}).get("time_unit") or run.recordings.time_unit or "1")
    return {
        "quasipotential": quasipotential_figure(shown),
        "residuals": residuals_figure(run.dynamics, run.recordings, units=shown.units, time_unit=time_unit),
    }


@dataclass(frozen=True)
class StudyTables:
    """The tables that are drawn, see `siq.study.tables.COLUMNS`."""

    coefficients: pd.DataFrame
    rrmse: pd.DataFrame
    training: pd.DataFrame
    prediction: pd.DataFrame
    record: pd.DataFrame
    record_density: pd.DataFrame


def what_is_shown(shown: Shown, models: ModelFiles, complete: tuple[int, StoredLandscape] | None) -> ShownRun:
    """The refined formula, or else the landscape, or else the formula as published.

    Parameters
    ----------
    shown
        The formula that is shown, see `siq.steps.shown.shown_formula`.
    models
        The formulas of all runs.
    complete
        A run with a U over all wells; asked for where no refined formula holds.
    """
    run, landscape = shown.run, None
    if complete is not None:
        run, landscape = complete[0], complete[1].quasipotential
    if run is None:
        return ShownRun(0, None, None, None)
    formulas = models.formulas(run)
    own = formulas.get(Method.REFINED, formulas.get(shown.method))
    dynamics = None if own is None else Dynamics.of(own.symbols, own.vector_field)
    return ShownRun(run, formulas.get(shown.method), landscape, dynamics)


def study_figures(
    settings: FiguresSettings,
    tables: StudyTables,
    shown: ShownRun,
    system: Dynamics | None,
    published: Mapping[str, PublishedFigure],
) -> dict[str, Figure | None]:
    """All figures of a study by name, None for one that has nothing to show."""
    rrmse = tables.rrmse[tables.rrmse["method"].isin(METHODS)]
    figures: dict[str, Figure | None] = {}
    for method in METHODS:
        coefficients = tables.coefficients
        figures[f"coefficients_{method}"] = plot_coefficient_distributions(coefficients, method=method)
        figures[f"inclusion_{method}"] = plot_inclusion(coefficients, method=method)
    known = published.get("rrmse")
    band = None
    if known is not None and known.standard_deviation is not None:
        band = (known.mean, known.standard_deviation)
    figures["error_distribution"] = plot_error_distribution(rrmse, published=band)
    figures["training"] = plot_training(tables.training)
    figures["dataset"] = _dataset_figure(settings, shown, system)
    figures["components"] = _components_figure(shown, system)
    error = published.get("prediction_error")
    figures["record"] = _record_figure(tables, shown, system)
    figures["prediction"] = _prediction_figure(settings, tables.prediction, shown, system, error)
    return figures


def _record_figure(tables: StudyTables, shown: ShownRun, system: Dynamics | None) -> Figure | None:
    """The test against the record, of the run that is shown."""
    recordings = shown.recordings
    if recordings is None:
        return None
    one, two = (table[table["run"] == shown.number] for table in (tables.record, tables.record_density))
    units = dict(zip(recordings.names, _units(recordings, system), strict=True))
    return plot_record(one, two, units=units, time_unit=recordings.time_unit or "1")


def _some(recordings: Recordings) -> np.ndarray:
    """Places of a few recordings, spread over all."""
    count = len(recordings.labels)
    return np.linspace(0, count - 1, min(TRAJECTORIES, count)).astype(int)


def _units(recordings: Recordings, system: Dynamics | None) -> tuple[str, ...]:
    return system.units if system is not None else tuple(unit or "1" for unit in recordings.units)


def _components_figure(shown: ShownRun, system: Dynamics | None) -> Figure | None:
    """The decomposition on the plane of the first two states."""
    recordings = shown.recordings
    if recordings is None:
        recordings = Recordings(("x",), (None,), ("none",), np.zeros(1, int), np.zeros(1), np.zeros((1, 1)))
    fields, domain = _component_fields(recordings, shown, system)
    units = _units(recordings, system)
    time_unit = recordings.time_unit or ("1" if system is None else system.time_unit)
    said = SaidLandscape({"states": recordings.names, "units": units, "time_unit": time_unit})
    return plot_components(
        fields, states=recordings.names, units=units, domain=domain, energy_unit=said.energy_unit
    )


def _component_fields(
    recordings: Recordings, shown: ShownRun, system: Dynamics | None
) -> tuple[ComponentFields, np.ndarray]:
    """What the figure of the components shows, and its limits."""
    low, high = recordings.values.min(axis=0), recordings.values.max(axis=0)
    domain = np.stack([low, high], axis=1) if system is None else system.box
    chosen = _some(recordings)
    paths = [recordings.values[recordings.recording == index] for index in chosen]
    if shown.landscape is not None and len(domain) <= 2:
        whole = project_landscape(shown.landscape, domain=domain, trajectories=())
        domain = _limits_of(whole, domain)
        return project_landscape(shown.landscape, domain=domain, trajectories=paths), domain
    if shown.formula is None:
        nothing = ComponentFields(x1=np.array([]), x2=np.array([]), trajectories=[p[:, :2] for p in paths])
        return nothing, domain
    lowest = recordings.values[np.argmin(shown.formula.evaluate(recordings.values.T)[0])]
    return project(shown.formula, exact=shown.exact, domain=domain, at=lowest, trajectories=paths), domain


def _limits_of(fields: ComponentFields, domain: np.ndarray) -> np.ndarray:
    """The part of a domain in which U is known, and somewhat more."""
    if fields.quasipotential is None or not np.isfinite(fields.quasipotential).any():
        return domain
    known = np.isfinite(fields.quasipotential)
    seen = [fields.x1[known.any(axis=0)]]
    if len(domain) > 1:
        seen.append(fields.x2[known.any(axis=1)])
    margin = 0.1 * np.array([np.ptp(one) for one in seen])
    inner = np.array([[one.min(), one.max()] for one in seen]) + margin[:, None] * [-1, 1]
    return np.clip(inner, domain[:, :1], domain[:, 1:])


def _prediction_figure(
    settings: FiguresSettings,
    errors: pd.DataFrame,
    shown: ShownRun,
    system: Dynamics | None,
    published: PublishedFigure | None,
) -> Figure | None:
    """Unseen trajectories beside those of the identified f, and the errors over all of them."""
    if errors.empty or shown.dynamics is None or system is None or settings.simulation is None:
        return None
    options = replace(settings.simulation, trajectories=PREDICTED, noise_intensity=0.0)
    draw = generator(settings.seed, Purpose.UNSEEN)
    unseen = simulate_snapshots(system, options=options, generator=draw)
    followed = predict(shown.dynamics, unseen)
    paths = [unseen.recording == index for index in range(PREDICTED)]
    return plot_prediction(
        [unseen.values[rows] for rows in paths],
        [followed[rows] for rows in paths],
        errors,
        states=system.states,
        units=system.units,
        published=None if published is None else (published.mean, published.standard_deviation or 0.0),
    )


def _dataset_figure(settings: FiguresSettings, shown: ShownRun, system: Dynamics | None) -> Figure | None:
    """The recorded states of a run, and those that its regression sees."""
    recordings = shown.recordings
    if recordings is None:
        return None
    data = _dataset(settings, recordings, shown.networks, system)
    return plot_dataset(data, states=recordings.names, units=_units(recordings, system))


def _dataset(
    settings: FiguresSettings,
    recordings: Recordings,
    networks: TrainedNetworks | None,
    system: Dynamics | None,
) -> Dataset:
    chosen = _some(recordings)
    rows = np.isin(recordings.recording, chosen)
    paths = [recordings.values[recordings.recording == index, :2] for index in chosen]
    quiet: list[np.ndarray] = []
    simulation = settings.simulation
    if system is not None and simulation is not None and simulation.noise_intensity > 0:
        label = recordings.recording[rows]
        some = replace(recordings, recording=label, t=recordings.t[rows], values=recordings.values[rows])
        followed = predict(system, some)
        quiet = [followed[label == index, :2] for index in chosen]
    x = snapshot_pairs(recordings, pair_step=settings.sampling.pair_step).x0
    plain = Dataset(paths, quiet, x[:, :2])
    if networks is None:
        return plain
    level = settings.regression.level
    potential = networks.evaluate(x).potential
    marked = replace(plain, below=points_below(potential, level=level))
    if x.shape[1] != 2:
        return marked
    across, upwards = np.linspace(x.min(axis=0), x.max(axis=0), GRID).T
    grid = np.stack(np.meshgrid(across, upwards), axis=-1).reshape(-1, 2)
    values = networks.evaluate(grid).potential.reshape(GRID, GRID)
    return replace(
        marked, axes=(across, upwards), potential=values, threshold=highest_used(potential, level=level)
    )
