"""The figures of a study and their captions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any

import numpy as np
import pandas as pd
import sympy
from matplotlib.figure import Figure

from siq.data.recordings import Recordings, snapshot_pairs
from siq.inference.residuals import predict
from siq.networks.decomposition import TrainedNetworks
from siq.networks.regression import highest_used, points_below
from siq.numerics.randomness import Purpose, generator
from siq.quasipotential.formulas import SymbolicDecomposition
from siq.quasipotential.landscape import GlobalQuasipotential
from siq.quasipotential.landscape_comparison import Potential, ReferenceLandscape, overall_level
from siq.quasipotential.landscape_files import StoredLandscape
from siq.report.landscape_summary import DrawnLandscape, SaidLandscape, drawn_data
from siq.report.page import ReportFigure
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
from siq.report.plots.errors import plot_degrees, plot_error_maps, plot_escape
from siq.report.plots.prediction import plot_record, residuals_figure
from siq.report.plots.quasipotential import plot_error_curves, quasipotential_figure
from siq.report.settings import FiguresSettings, LandscapeFiguresSettings
from siq.systems.dynamics import Dynamics
from siq.systems.formulas import compile_formulas
from siq.systems.simulation import simulate_snapshots
from siq.workflow.collection_steps import ModelFiles, Shown
from siq.workflow.outcomes import METHODS, Method
from siq.workflow.published import PublishedFigure, published_formula


def project(
    identified: SymbolicDecomposition,
    *,
    exact: SymbolicDecomposition | None,
    domain: np.ndarray,
    at: np.ndarray,
    trajectories: Sequence[np.ndarray],
    resolution: int = 81,
) -> ComponentFields:
    """Fields of a decomposition on the plane of the first two states.

    Parameters
    ----------
    identified, exact
        The formulas, and the exact ones where known.
    domain
        Shape ``(d, 2)``: the plane's limits are the first two rows.
    at
        Shape ``(d,)``: where the plane cuts the other states.
    trajectories
        States along some trajectories, each of shape ``(k, d)``.
    resolution
        Points along each axis.

    Returns
    -------
    siq.report.plots.ComponentFields
        With the exact U missing where it is not known.
    """
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


def project_landscape(
    potential: GlobalQuasipotential,
    *,
    domain: np.ndarray,
    trajectories: Sequence[np.ndarray],
    resolution: int = 161,
) -> ComponentFields:
    """Fields of the formulas of all wells, for two states or one; NaN where none is believed.

    Parameters
    ----------
    potential
        U over all wells. At each point the formula counts that gives U there.
    domain
        Shape ``(d, 2)``: the limits of the states.
    trajectories
        States along some trajectories, each of shape ``(k, d)``.
    resolution
        Points along each axis.
    """
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


class Part(StrEnum):
    """Where a figure stands."""

    LEAD = "lead"
    EVIDENCE = "evidence"
    RECORD = "record"
    LANDSCAPE = "landscape"
    RUNS = "runs"
    PUBLISHED = "published"
    WORKINGS = "workings"


@dataclass(frozen=True)
class Caption:
    """Of one figure.

    Attributes
    ----------
    part
        Where it stands.
    text
        What it shows, panel by panel.
    paper
        The figure of the paper that it answers to; said only where a study is set beside the paper.
    """

    part: Part
    text: str
    paper: str = ""


CAPTIONS: Mapping[str, Caption] = {
    "quasipotential": Caption(
        Part.LEAD,
        "The quasipotential U where it is known, with the stable states (letters), the saddles between them"
        " (crosses), the most likely ways from one to the other, and recorded states (dots).",
    ),
    "landscape": Caption(
        Part.LANDSCAPE,
        "U over all wells where its formulas hold, with stable states, saddles, and the ways of least"
        " action: solid"
        " on the way up, dashed on the way down.",
    ),
    "residuals": Caption(
        Part.EVIDENCE,
        "What f leaves of the recorded increments, a panel for each state. Without a trend, nothing in f is"
        " missing.",
    ),
    "prediction": Caption(
        Part.EVIDENCE,
        "Prediction of recordings that were held out: trajectories, recorded and computed from the same first"
        " states by f; and the relative errors at their ends, with the median.",
        "Fig. 4a",
    ),
    "record": Caption(
        Part.RECORD,
        "The record beside what f, D and ε say of it: (a) mean visits to each well, counted on all recordings"
        " and predicted; below, how a state is spread during the visits to a well, on held-out recordings.",
    ),
    "escape": Caption(
        Part.EVIDENCE,
        "Mean escape times against the strength of the noise: lines by the law of Eyring and Kramers,"
        " points by"
        " direct simulation of the card, with standard errors.",
    ),
    "landscape_errors": Caption(
        Part.EVIDENCE,
        "U by every source, and below each its difference from U along characteristics of the exact vector"
        " field.",
        "fig2b, c to e, and Appendix E",
    ),
    "invariant": Caption(
        Part.LANDSCAPE,
        "The density of states exp(−U/ε) that follows from U, a panel for each ε; below each, a long"
        " simulation"
        " with lines of the same density.",
        "fig1b and fig2c, b to d",
    ),
    "degrees": Caption(
        Part.WORKINGS,
        "How well formulas of rising degree solve the equation of U about each stable state, on points"
        " that took no"
        " part in the fit, against their number of terms. The ring marks the degree that was chosen.",
    ),
    "sweep": Caption(
        Part.LANDSCAPE,
        "Equilibria against the parameter, stable ones as lines of the colour of their well, and where they"
        " begin and end; below, the lowest barrier of each stable state, and, for the noise that the study"
        " gives, how long each lasts and its share of time in the long run. Against two parameters, maps of"
        " the number of stable states and of the lowest barrier.",
    ),
    "error_distribution": Caption(
        Part.RUNS, "Relative error of the coefficients of U, one dot for each run and method.", "Fig. 3"
    ),
    "coefficients_refined": Caption(
        Part.RUNS,
        "Coefficients of U over the runs, a panel for each term that belongs there; the last panel shows"
        " the terms"
        " that do not.",
        "Fig. 2",
    ),
    "inclusion_refined": Caption(Part.RUNS, "How often each term was found, by component."),
    "coefficients_regression": Caption(
        Part.PUBLISHED,
        "Coefficients of U over the runs by the published regression, from the networks as they are; a"
        " panel for"
        " each term that belongs there, and one for those that do not.",
    ),
    "inclusion_regression": Caption(
        Part.PUBLISHED, "How often the published regression found each term, by component."
    ),
    "landscape_published": Caption(
        Part.PUBLISHED,
        "What was published of U, as a formula and, where it is at hand, on a mesh; below each, its"
        " difference from U"
        " along characteristics of the exact vector field.",
    ),
    "training": Caption(
        Part.PUBLISHED,
        "The networks' training, one line for each run: loss on training pairs and on held-out pairs, its"
        " two parts,"
        " and the learning rate.",
    ),
    "dataset": Caption(
        Part.WORKINGS,
        "The recordings: some trajectories; all recorded states; and, where networks were regressed, the"
        " states below"
        " the level of the regression.",
        "fig2a; fig1_noisy a",
    ),
    "components": Caption(
        Part.WORKINGS,
        "The decomposition of f on the plane of the first two states: trajectories, the downhill part"
        " −D∇V, the"
        " circulatory part g, and U; where it is known, the exact U beside it.",
        "Fig. 1",
    ),
}

OF_INSPECTION = ("record", "visited", "memory")
"""Figures of the first section, see `siq.report.study_page`."""

OF_NETWORKS = ("coefficients_regression", "inclusion_regression", "training")
"""Figures that say nothing where no networks were asked for."""

OF_RUNS = ("coefficients_refined", "inclusion_refined", "coefficients_regression", "inclusion_regression",
           "error_distribution")  # fmt: skip
"""Figures of a scatter over runs, of which there is none in one."""

OF_ONE_STATE = (
    "The quasipotential U where it is known, with a band of two standard errors; the stable states (letters),"
    " the saddles between them (crosses), the depth of each (arrows), and recorded states (ticks)."
)
"""What the first picture shows where there is one state: a curve, and no ways beside it."""

OF_EQUATIONS = (
    "The quasipotential U where it is known, with the stable states (letters), the saddles between them"
    " (crosses), and the most likely ways from one to the other."
)
"""What it shows of given equations: nothing was recorded."""

OF_ONE_EQUATION = (
    "The quasipotential U where it is known; the stable states (letters), the saddles between them (crosses)"
    " and the depth of each (arrows)."
)
"""The same of one state."""

LEADING = ("quasipotential", "landscape")
"""Figures that a page can open with, the best first."""


def shown_figures(names: set[str], *, runs: int, networks: bool, published: bool) -> set[str]:
    """Which figures a page shows of those that exist.

    Parameters
    ----------
    names
        Of the figures that were drawn.
    runs
        Number of runs.
    networks
        Whether networks were asked for.
    published
        Whether the study names published figures.
    """
    names = names - set(OF_INSPECTION)
    if not published:
        names = names - {"landscape_published"}
    if not networks:
        names = names - set(OF_NETWORKS)
    if runs == 1:
        names = names - set(OF_RUNS)
    return names - {"landscape"} if "quasipotential" in names else names


def figure_place(name: str) -> Part:
    """In which part of the page a figure stands; one that nobody described, with the workings."""
    return CAPTIONS[name].part if name in CAPTIONS else Part.WORKINGS


def figures_of(
    part: Part, images: Mapping[str, bytes], vectors: Mapping[str, bytes], *, beside_paper: bool
) -> list[ReportFigure]:
    """The figures of a part of the page, in the order of `CAPTIONS`; one that nobody described comes last.

    Parameters
    ----------
    part
        Of the page; figures without a caption stand with the workings.
    images, vectors
        PNG and SVG by name.
    beside_paper
        Whether to name the figures of the paper.
    """
    names = [name for name, caption in CAPTIONS.items() if caption.part == part and name in images]
    if part == Part.WORKINGS:
        names += sorted(set(images) - set(CAPTIONS))
    return [figure_of(name, images, vectors, beside_paper=beside_paper) for name in names]


def figure_of(
    name: str, images: Mapping[str, bytes], vectors: Mapping[str, bytes], *, beside_paper: bool
) -> ReportFigure:
    """One figure with its caption."""
    caption = CAPTIONS.get(name, Caption(Part.WORKINGS, f"{name.replace('_', ' ').capitalize()}."))
    text = caption.text
    if beside_paper and caption.paper:
        text += f" In the paper: {caption.paper}."
    return ReportFigure(text, caption.text, images[name], "png", vectors.get(name))


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
    """The tables that are drawn, see `siq.workflow.tables.COLUMNS`."""

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
        The formula that is shown, see `siq.workflow.collection_steps.shown_formula`.
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
