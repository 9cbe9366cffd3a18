"""Draw the figures of a study."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from landscapes import first_complete
from siq.decomposition.trained import load_networks
from siq.landscape.combined import GlobalQuasipotential
from siq.model import read_model
from siq.plots import (
    ComponentFields,
    Dataset,
    plot_coefficient_distributions,
    plot_components,
    plot_dataset,
    plot_error_distribution,
    plot_inclusion,
    plot_prediction,
    plot_training,
    save_figure,
)
from siq.plots.style import sentence_figure
from siq.prediction import predict
from siq.projection import project, project_landscape
from siq.randomness import generator
from siq.recordings import Recordings, snapshot_pairs
from siq.regression import points_below
from siq.simulate import SimulationOptions, simulate_snapshots
from siq.study import load_published
from siq.symbolic import SymbolicDecomposition, exact_decomposition
from siq.systems import System, load_system
from siq.tables import read_table
from siq.vector_field import VectorField
from step import METHODS, job, pair_step, position_of, read_run, shown_formula

TRAJECTORIES = 5
PREDICTED = 6
GRID = 161  # on which the level of the regression is drawn


@dataclass(frozen=True)
class Shown:
    """The run that is shown: its formula, its landscape where no single refined formula holds, and its f."""

    run: int | None
    formula: SymbolicDecomposition | None
    landscape: GlobalQuasipotential | None
    vector_field: VectorField | None


def what_is_shown(rrmse: pd.DataFrame, source: Any, study: dict[str, Any]) -> Shown:
    """The refined formula, or else the landscape, or else the formula as published."""
    run, method = shown_formula(rrmse, source.models)
    landscape = None
    if run is None or method == METHODS[0]:
        complete = first_complete(source.fields, source.landscapes, study["metric"]["diffusion"])
        if complete is not None:
            run, landscape = complete[0], complete[1].quasipotential
    if run is None:
        return Shown(None, None, None, None)
    decompositions = read_model(source.models[run])[0]
    own = decompositions.get(METHODS[1], decompositions.get(method))
    field = None if own is None else VectorField(own.symbols, own.vector_field)
    return Shown(run, decompositions.get(method), landscape, field)


def component_fields(
    recordings: Recordings, shown: Shown, system: System | None
) -> tuple[ComponentFields, np.ndarray]:
    """What the figure of the components shows, and its limits."""
    low, high = recordings.values.min(axis=0), recordings.values.max(axis=0)
    domain = np.stack([low, high], axis=1) if system is None else system.domain
    chosen = np.linspace(0, len(recordings.labels) - 1, min(TRAJECTORIES, len(recordings.labels))).astype(int)
    paths = [recordings.values[recordings.recording == index] for index in chosen]
    if shown.landscape is not None and len(domain) == 2:
        whole = project_landscape(shown.landscape, domain=domain, trajectories=())
        domain = limits_of(whole, domain)
        return project_landscape(shown.landscape, domain=domain, trajectories=paths), domain
    if shown.formula is None:
        nothing = ComponentFields(x1=np.array([]), x2=np.array([]), trajectories=[p[:, :2] for p in paths])
        return nothing, domain
    lowest = recordings.values[np.argmin(shown.formula.evaluate(recordings.values.T)[0])]
    exact = exact_decomposition(system) if system is not None else None
    return project(shown.formula, exact=exact, domain=domain, at=lowest, trajectories=paths), domain


def limits_of(fields: ComponentFields, domain: np.ndarray) -> np.ndarray:
    """The part of a domain in which U is known, and somewhat more."""
    if fields.quasipotential is None or not np.isfinite(fields.quasipotential).any():
        return domain
    known = np.isfinite(fields.quasipotential)
    seen = [fields.x1[known.any(axis=0)], fields.x2[known.any(axis=1)]]
    margin = 0.1 * np.array([np.ptp(one) for one in seen])
    inner = np.array([[one.min(), one.max()] for one in seen]) + margin[:, None] * [-1, 1]
    return np.clip(inner, domain[:, :1], domain[:, 1:])


def prediction_figure(
    errors: pd.DataFrame,
    identified: VectorField | None,
    system: System | None,
    study: dict[str, Any],
    published: str | None,
) -> Figure:
    """Unseen trajectories beside those of the identified f, and the errors over all of them."""
    if errors.empty or identified is None or system is None:
        return sentence_figure("Nothing was predicted: no system is known to simulate unseen trajectories.")
    options = SimulationOptions(**(study["simulation"] | {"trajectories": PREDICTED, "noise_intensity": 0.0}))
    unseen = simulate_snapshots(system, options=options, generator=generator(study["seed"], "unseen"))
    followed = predict(identified, unseen)
    paths = [unseen.recording == index for index in range(PREDICTED)]
    figure = load_published(published).figures.get("prediction_error") if published else None
    return plot_prediction(
        [unseen.values[rows] for rows in paths],
        [followed[rows] for rows in paths],
        errors,
        states=system.states,
        units=system.units,
        published=None if figure is None else (figure.mean, figure.standard_deviation or 0.0),
    )


def dataset(
    run: int, recordings: Recordings, system: System | None, study: dict[str, Any], source: Any
) -> Dataset:
    """The recorded states of a run, and those that its regression sees."""
    chosen = np.linspace(0, len(recordings.labels) - 1, min(TRAJECTORIES, len(recordings.labels))).astype(int)
    rows = np.isin(recordings.recording, chosen)
    paths = [recordings.values[recordings.recording == index, :2] for index in chosen]
    quiet: list[np.ndarray] = []
    simulation = study["simulation"]
    if system is not None and simulation is not None and simulation["noise_intensity"] > 0:
        label = recordings.recording[rows]
        some = replace(recordings, recording=label, t=recordings.t[rows], values=recordings.values[rows])
        followed = predict(VectorField(system.symbols, system.equations), some)
        quiet = [followed[label == index, :2] for index in chosen]
    x = snapshot_pairs(recordings, pair_step=pair_step(study)).x0
    plain = Dataset(paths, quiet, x[:, :2])
    position, _ = position_of(run, source.blocks[run])
    if position is None:
        return plain
    networks, level = load_networks(source.networks[run], run=position), study["regression"]["level"]
    potential = networks.evaluate(x).potential
    shown = replace(plain, below=points_below(potential, level=level))
    if x.shape[1] != 2:
        return shown
    across, upwards = np.linspace(x.min(axis=0), x.max(axis=0), GRID).T
    grid = np.stack(np.meshgrid(across, upwards), axis=-1).reshape(-1, 2)
    values = networks.evaluate(grid).potential.reshape(GRID, GRID)
    return replace(shown, axes=(across, upwards), potential=values, threshold=float(potential.min()) + level)


def main(snakemake: Any) -> None:
    """Run as a rule's script."""
    source = snakemake.input
    folder = Path(snakemake.params.folder)
    coefficients, rrmse = read_table(source.coefficients), read_table(source.rrmse)
    published = load_published(source.published).figures.get("rrmse") if source.get("published") else None
    band = None
    if published is not None and published.standard_deviation is not None:
        band = (published.mean, published.standard_deviation)
    rrmse = rrmse[rrmse["method"].isin(METHODS)]
    for method in METHODS:
        save_figure(
            plot_coefficient_distributions(coefficients, method=method), folder / f"coefficients_{method}"
        )
        save_figure(plot_inclusion(coefficients, method=method), folder / f"inclusion_{method}")
    save_figure(plot_error_distribution(rrmse, published=band), folder / "error_distribution")
    save_figure(plot_training(read_table(source.training)), folder / "training")

    system = load_system(source.card) if source.get("card") else None
    study = snakemake.params.study
    shown = what_is_shown(rrmse, source, study)
    run = shown.run or 0
    recordings = read_run(source.recordings[run])
    data = sentence_figure("No trajectories were drawn.")
    if recordings is not None:
        units = system.units if system is not None else tuple(unit or "1" for unit in recordings.units)
        states = dataset(run, recordings, system, study, source)
        data = plot_dataset(states, states=recordings.names, units=units)
    save_figure(data, folder / "dataset")
    if recordings is None:
        recordings = Recordings(("x",), (None,), ("none",), np.zeros(1, int), np.zeros(1), np.zeros((1, 1)))
    fields, domain = component_fields(recordings, shown, system)
    units = system.units if system is not None else tuple(unit or "1" for unit in recordings.units)
    figure = plot_components(fields, states=recordings.names, units=units, domain=domain)
    save_figure(figure, folder / "components")
    prediction = read_table(source.prediction)
    save_figure(
        prediction_figure(prediction, shown.vector_field, system, study, source.get("published")),
        folder / "prediction",
    )


if __name__ == "__main__":
    with job(snakemake):  # type: ignore[name-defined]  # noqa: F821 (Snakemake puts it here)
        main(snakemake)  # type: ignore[name-defined]  # noqa: F821
