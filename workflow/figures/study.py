"""The figures of a study, from its tables, runs and landscapes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
import sympy
from matplotlib.figure import Figure

from siq.data.recordings import Recordings, snapshot_pairs
from siq.inference.checks import predict
from siq.networks.decomposition import AnyNetworks
from siq.networks.regression import highest_used
from siq.numerics.randomness import Purpose, generator
from siq.quasipotential.formulas import SymbolicDecomposition
from siq.quasipotential.global_formula import GlobalQuasipotential
from siq.quasipotential.landscape import Landscape
from siq.quasipotential.landscape_comparison import Potential, ReferenceLandscape
from siq.report.plots.prediction import residuals_figure
from siq.report.plots.quasipotential import quasipotential_figure
from siq.report.plots.sweep import plot_sweep
from siq.report.summary import LandscapeSummary, energy_unit
from siq.systems.dynamics import Dynamics
from siq.systems.formulas import compile_formulas
from siq.systems.simulation import simulate_snapshots
from siq.workflow.study import PipelineSettings, StateSpace, Study, SweepOptions
from siq.workflow.tables import METHODS, Method, ModelFiles, Shown
from workflow.figures.comparison import plot_degrees, plot_error_curves, plot_error_maps, plot_escape
from workflow.figures.prediction import plot_prediction, plot_record
from workflow.figures.recorded import ComponentFields, Dataset, plot_components, plot_dataset
from workflow.figures.runs import (
    plot_coefficient_distributions,
    plot_error_distribution,
    plot_inclusion,
    plot_training,
)
from workflow.published import PublishedFigure, published_formula


def _project(
    identified: SymbolicDecomposition,
    *,
    exact: SymbolicDecomposition | None,
    domain: np.ndarray,
    at: np.ndarray,
    trajectories: Sequence[np.ndarray],
    resolution: int = 81,
) -> ComponentFields:
    """Fields of a decomposition on the plane of the first two states through `at`."""
    dimension = len(domain)
    shown = min(dimension, 2)
    axes = [np.linspace(domain[axis, 0], domain[axis, 1], resolution) for axis in range(shown)]
    x1 = axes[0]
    x2 = axes[1] if shown == 2 else np.array([at[0]])
    mesh = np.meshgrid(x1, x2)
    points = np.broadcast_to(np.asarray(at)[:, None, None], (dimension, len(x2), len(x1))).copy()
    for axis in range(shown):
        points[axis] = mesh[axis]
    values = identified.evaluate(points)
    gradient = identified.evaluate_gradient(points)
    return ComponentFields(
        x1=x1,
        x2=x2,
        minus_gradient=-gradient[:shown],
        circulatory=values[1 : 1 + shown],
        quasipotential=2 * values[0],
        exact_quasipotential=None if exact is None else 2 * exact.evaluate(points)[0],
        trajectories=[path[:, :shown] for path in trajectories],
    )


def _project_landscape(
    potential: GlobalQuasipotential,
    *,
    domain: np.ndarray,
    trajectories: Sequence[np.ndarray],
    resolution: int = 161,
) -> ComponentFields:
    """Fields of the formulas of all wells, for two states or one: of the one that gives U at a point."""
    axes = [np.linspace(low, high, resolution) for low, high in domain]
    x = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, len(axes))
    x1, x2 = (*axes, np.zeros(0))[:2]
    by_well = potential.by_well(x)
    values = np.where(np.isfinite(by_well), by_well, np.inf)
    least, which = values.min(axis=0), values.argmin(axis=0)
    gradient, circulatory = np.full(x.shape, np.nan), np.full(x.shape, np.nan)
    for index, one in enumerate(potential.wells):
        mine = np.isfinite(least) & (which == index)
        gradient[mine] = one.gradients(x[mine])
        circulatory[mine] = one.dynamics.drift(x[mine]) + one.dynamics.diffusion.push(x[mine], gradient[mine])
    shape = (resolution if len(axes) > 1 else 1, resolution)
    return ComponentFields(
        x1=x1,
        x2=x2,
        minus_gradient=-gradient.T.reshape(len(axes), *shape),
        circulatory=circulatory.T.reshape(len(axes), *shape),
        quasipotential=np.where(np.isfinite(least), least, np.nan).reshape(shape),
        trajectories=list(trajectories),
    )


def landscape_figures(
    space: StateSpace,
    *,
    compare_below: float | None = None,
    degrees: pd.DataFrame,
    escape: pd.DataFrame,
    landscape: Landscape | None = None,
    reference: ReferenceLandscape | None = None,
    networks: AnyNetworks | None = None,
    formulas: Mapping[str, SymbolicDecomposition] | None = None,
    published: Mapping[str, PublishedFigure] | None = None,
    mesh: Potential | None = None,
) -> dict[str, Figure | None]:
    """All figures of a landscape by name, None for one that has nothing to show.

    Parameters
    ----------
    space
        Units.
    compare_below
        U below which errors are drawn, by default 1.1 of the highest saddle.
    degrees, escape
        The tables; `escape` is empty where nothing was simulated.
    landscape
        Of the run that is shown; None where no run knows U over all wells.
    reference
        Of the card, with which U is compared on a plane or along a line.
    networks, formulas
        Other sources of U: networks, and formulas by method.
    published, mesh
        Published figures by quantity, and a U that was published on a mesh.
    """
    time_unit = space.unit("t", unknown="1")
    figures: dict[str, Figure | None] = {
        "degrees": plot_degrees(degrees),
        "escape": plot_escape(escape, time_unit=time_unit),
    }
    if landscape is None or reference is None or reference.reason or reference.points.shape[1] > 2:
        return figures
    names, x, potential = landscape.dynamics.states, reference.points, landscape.global_quasipotential
    assert potential is not None  # U is known over all wells
    below = compare_below or reference.level
    inside = np.nan_to_num(reference.values, nan=np.inf) < below
    ours = {"characteristics": reference.values, "mesh": reference.mesh_values}
    if networks is not None:
        ours["networks"] = 2 * networks.potential_at(x)
    regression = (formulas or {}).get(Method.REGRESSION)
    if regression is not None and regression.potential is not None:
        ours[str(Method.REGRESSION)] = 2 * regression.values(x)
    ours["local formulas"] = potential(x)
    maps = {"landscape_errors": _shifted(ours, inside, of_any_constant=("networks", str(Method.REGRESSION)))}
    symbols = [sympy.Symbol(name, real=True) for name in names]
    formula = published_formula(published or {}, "U", symbols)
    theirs = {"characteristics": reference.values}
    if mesh is not None:
        theirs["published mesh"] = mesh(x)
    if formula is not None:
        theirs["published formula"] = compile_formulas([formula], symbols)(np.ascontiguousarray(x.T))[0]
    if len(theirs) > 1:
        theirs["local formulas"] = ours["local formulas"]
        constants = ("published mesh", "published formula")
        maps["landscape_published"] = _shifted(theirs, inside, of_any_constant=constants)
    units = tuple(space.unit(name, unknown="1") for name in names)
    energy = energy_unit(units, time_unit)
    if len(names) == 1:
        return figures | {
            figure: plot_error_curves(x[:, 0], one, name=names[0], unit=units[0], energy_unit=energy)
            for figure, one in maps.items()
        }
    side = round(len(x) ** 0.5)
    axes = (x[::side, 0], x[:side, 1])
    return figures | {
        figure: plot_error_maps(
            axes,
            {name: values.reshape(side, side) for name, values in one.items()},
            names=tuple(names),
            units=units,
            energy_unit=energy,
        )
        for figure, one in maps.items()
    }


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


TRAJECTORIES = 5
PREDICTED = 6
GRID = 161  # on which the level of the regression is drawn


@dataclass(frozen=True)
class RepresentativeRun:
    """The run whose figures are shown.

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
    networks: AnyNetworks | None = None
    exact: SymbolicDecomposition | None = None


def leading_figures(
    summary: LandscapeSummary, dynamics: Dynamics, recordings: Recordings
) -> dict[str, Figure | None]:
    """What a page opens with, `quasipotential`, and the first of its evidence, `residuals`."""
    time_unit = summary.time_unit if summary.time_unit != "1" else recordings.time_unit or "1"
    return {
        "quasipotential": quasipotential_figure(summary),
        "residuals": residuals_figure(dynamics, recordings, units=summary.units, time_unit=time_unit),
    }


DRAWN_TABLES = ("coefficients", "rrmse", "training", "prediction", "record", "record_density")
"""Tables of a study that are drawn, see `siq.workflow.tables.COLUMNS`."""


def representative_run(
    shown: Shown, models: ModelFiles, complete: tuple[int, Landscape] | None
) -> RepresentativeRun:
    """The refined formula, or else the landscape, or else the formula as published.

    Parameters
    ----------
    shown
        The formula that is shown, see `siq.workflow.tables.ModelFiles.representative`.
    models
        The formulas of all runs.
    complete
        A run with a U over all wells; asked for where no refined formula holds.
    """
    (run, method), landscape = shown, None
    if complete is not None:
        run, landscape = complete[0], complete[1].global_quasipotential
    if run is None:
        return RepresentativeRun(0, None, None, None)
    formulas = models.formulas(run)
    own = formulas.get(Method.REFINED, formulas.get(method))
    dynamics = None if own is None else Dynamics.of(own.symbols, own.vector_field)
    return RepresentativeRun(run, formulas.get(method), landscape, dynamics)


def study_figures(
    settings: PipelineSettings,
    tables: Mapping[str, pd.DataFrame],
    shown: RepresentativeRun,
    system: Dynamics | None,
    published: Mapping[str, PublishedFigure],
) -> dict[str, Figure | None]:
    """All figures of a study by name, None for one that has nothing to show."""
    rrmse = tables["rrmse"][tables["rrmse"]["method"].isin(METHODS)]
    figures: dict[str, Figure | None] = {}
    for method in METHODS:
        coefficients = tables["coefficients"]
        figures[f"coefficients_{method}"] = plot_coefficient_distributions(coefficients, method=method)
        figures[f"inclusion_{method}"] = plot_inclusion(coefficients, method=method)
    known, error = published.get("rrmse"), published.get("prediction_error")
    band = None
    if known is not None and known.standard_deviation is not None:
        band = (known.mean, known.standard_deviation)
    figures["error_distribution"] = plot_error_distribution(rrmse, published=band)
    figures["training"] = plot_training(tables["training"])
    figures["components"] = _components_figure(shown, system)
    figures["prediction"] = _prediction_figure(settings, tables["prediction"], shown, system, error)
    recordings = shown.recordings
    if recordings is not None:
        names, units = recordings.names, _units(recordings, system)
        data = _dataset(settings, recordings, shown.networks, system)
        figures["dataset"] = plot_dataset(data, states=names, units=units)
        record, density = (
            tables[name][tables[name]["run"] == shown.number] for name in ("record", "record_density")
        )
        figures["record"] = plot_record(
            record, density, units=dict(zip(names, units, strict=True)), time_unit=recordings.time_unit or "1"
        )
    return figures


def _some(recordings: Recordings) -> np.ndarray:
    """Places of a few recordings, spread over all."""
    count = len(recordings.labels)
    return np.linspace(0, count - 1, min(TRAJECTORIES, count)).astype(int)


def _units(recordings: Recordings, system: Dynamics | None) -> tuple[str, ...]:
    return system.units if system is not None else tuple(unit or "1" for unit in recordings.units)


def _components_figure(shown: RepresentativeRun, system: Dynamics | None) -> Figure | None:
    """The decomposition on the plane of the first two states."""
    recordings = shown.recordings
    if recordings is None:
        recordings = Recordings(("x",), (None,), ("none",), np.zeros(1, int), np.zeros(1), np.zeros((1, 1)))
    fields, domain = _component_fields(recordings, shown, system)
    units = _units(recordings, system)
    time_unit = recordings.time_unit or ("1" if system is None else system.time_unit)
    energy = energy_unit(units, time_unit)
    return plot_components(fields, states=recordings.names, units=units, domain=domain, energy_unit=energy)


def _component_fields(
    recordings: Recordings, shown: RepresentativeRun, system: Dynamics | None
) -> tuple[ComponentFields, np.ndarray]:
    """What the figure of the components shows, and its limits."""
    low, high = recordings.values.min(axis=0), recordings.values.max(axis=0)
    domain = np.stack([low, high], axis=1) if system is None else system.box
    chosen = _some(recordings)
    paths = [recordings.values[recordings.recording == index] for index in chosen]
    if shown.landscape is not None and len(domain) <= 2:
        whole = _project_landscape(shown.landscape, domain=domain, trajectories=())
        domain = _limits_of(whole, domain)
        return _project_landscape(shown.landscape, domain=domain, trajectories=paths), domain
    if shown.formula is None:
        nothing = ComponentFields(x1=np.array([]), x2=np.array([]), trajectories=[p[:, :2] for p in paths])
        return nothing, domain
    lowest = recordings.values[np.argmin(shown.formula.evaluate(recordings.values.T)[0])]
    return _project(shown.formula, exact=shown.exact, domain=domain, at=lowest, trajectories=paths), domain


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
    settings: PipelineSettings,
    errors: pd.DataFrame,
    shown: RepresentativeRun,
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


def _dataset(
    settings: PipelineSettings, recordings: Recordings, networks: AnyNetworks | None, system: Dynamics | None
) -> Dataset:
    """The recorded states of a run, and those that its regression sees."""
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
    potential = networks.potential_at(x)
    threshold = highest_used(potential, level=settings.regression.level)
    marked = replace(plain, below=potential < threshold)
    if x.shape[1] != 2:
        return marked
    across, upwards = np.linspace(x.min(axis=0), x.max(axis=0), GRID).T
    grid = np.stack(np.meshgrid(across, upwards), axis=-1).reshape(-1, 2)
    values = networks.potential_at(grid).reshape(GRID, GRID)
    return replace(marked, axes=(across, upwards), potential=values, threshold=threshold)


def _sweep_figure(system: Dynamics, options: SweepOptions, tables: Mapping[str, pd.DataFrame]) -> Figure:
    """The figure of a sweep, with the units of the card."""
    units = dict(zip(system.states, system.units, strict=True)) | {"t": system.time_unit}
    units |= {each.name: each.unit for each in system.parameters}
    return plot_sweep(
        tables["sweep"], tables["branches"], tables["bifurcations"], parameters=options.names,
        states=system.states, units=units, curves=tables["bifurcation_curves"],
    )  # fmt: skip


def equations_figures(
    system: Dynamics, summary: LandscapeSummary | None, tables: Mapping[str, pd.DataFrame], study: Study
) -> dict[str, Figure | None]:
    """The figures of a study of equations by name, None for one that has nothing to show."""
    return {
        "quasipotential": None if summary is None else quasipotential_figure(summary),
        "degrees": plot_degrees(tables["degrees"]) if len(tables["degrees"]) else None,
        "sweep": None if study.sweep is None else _sweep_figure(system, study.sweep, tables),
    }
