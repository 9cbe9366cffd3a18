"""Draw the figures of a study."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from siq.model import read_model
from siq.plots import (
    ComponentFields,
    plot_coefficient_distributions,
    plot_components,
    plot_error_distribution,
    plot_inclusion,
    plot_prediction,
    plot_training,
    save_figure,
)
from siq.plots.style import sentence_figure
from siq.prediction import predict
from siq.projection import project
from siq.randomness import generator
from siq.recordings import Recordings
from siq.simulate import SimulationOptions, simulate_snapshots
from siq.study import load_published
from siq.symbolic import SymbolicDecomposition, exact_decomposition
from siq.systems import System, load_system
from siq.tables import read_table
from siq.vector_field import VectorField
from step import METHODS, job, read_run, shown_formula

TRAJECTORIES = 5
PREDICTED = 6


def component_fields(
    recordings: Recordings, identified: SymbolicDecomposition | None, system: System | None
) -> tuple[ComponentFields, np.ndarray]:
    """What the figure of the components shows, and its limits."""
    low, high = recordings.values.min(axis=0), recordings.values.max(axis=0)
    domain = np.stack([low, high], axis=1) if system is None else system.domain
    chosen = np.linspace(0, len(recordings.labels) - 1, min(TRAJECTORIES, len(recordings.labels))).astype(int)
    paths = [recordings.values[recordings.recording == index] for index in chosen]
    if identified is None:
        nothing = ComponentFields(x1=np.array([]), x2=np.array([]), trajectories=[p[:, :2] for p in paths])
        return nothing, domain
    lowest = recordings.values[np.argmin(identified.evaluate(recordings.values.T)[0])]
    exact = exact_decomposition(system) if system is not None else None
    return project(identified, exact=exact, domain=domain, at=lowest, trajectories=paths), domain


def prediction_figure(
    errors: pd.DataFrame,
    identified: SymbolicDecomposition | None,
    system: System | None,
    study: dict[str, Any],
    published: str | None,
) -> Figure:
    """Unseen trajectories beside those of the identified f, and the errors over all of them."""
    if errors.empty or identified is None or system is None:
        return sentence_figure("Nothing was predicted: no system is known to simulate unseen trajectories.")
    options = SimulationOptions(**(study["simulation"] | {"trajectories": PREDICTED, "noise_intensity": 0.0}))
    unseen = simulate_snapshots(system, options=options, generator=generator(study["seed"], "unseen"))
    followed = predict(VectorField(identified.symbols, identified.vector_field), unseen)
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
    run, method = shown_formula(rrmse, source.models)
    recordings = read_run(source.recordings[run or 0])
    if recordings is None:
        recordings = Recordings(("x",), (None,), ("none",), np.zeros(1, int), np.zeros(1), np.zeros((1, 1)))
    identified = None if run is None else read_model(source.models[run])[0][method]
    fields, domain = component_fields(recordings, identified, system)
    units = system.units if system is not None else tuple(unit or "1" for unit in recordings.units)
    figure = plot_components(fields, states=recordings.names, units=units, domain=domain)
    save_figure(figure, folder / "components")
    prediction = read_table(source.prediction)
    save_figure(
        prediction_figure(prediction, identified, system, snakemake.params.study, source.get("published")),
        folder / "prediction",
    )


if __name__ == "__main__":
    with job(snakemake):  # type: ignore[name-defined]  # noqa: F821 (Snakemake puts it here)
        main(snakemake)  # type: ignore[name-defined]  # noqa: F821
