"""The invariant distribution of the run that is shown: Z by two ways, and against a long simulation."""

import logging
from typing import Any

import numpy as np

from siq.errors import NumericalFailure
from siq.invariant_distribution import (
    marginal_density,
    normalisation_bessel,
    normalisation_quadrature,
    total_variation,
)
from siq.model import read_model
from siq.plots import InvariantPanel, plot_invariant_distribution, save_figure
from siq.plots.style import sentence_figure
from siq.randomness import generator
from siq.simulate import simulate_stationary
from siq.study import load_published
from siq.symbolic import SymbolicDecomposition
from siq.systems import System, load_system
from siq.tables import as_table, read_table, write_table
from step import job, shown_formula

WALKERS = 4000
STEPS = 20_000  # of the simulation, after a fifth of them to settle
ACCURACY = 0.025  # step times the norm of the Jacobian where the walkers are


def simulate(system: System, intensity: float, *, seed: int) -> np.ndarray:
    """Samples of a long simulation of the system itself, walkers side by side, ``(d, times, walkers)``."""
    draw = generator(seed, "invariant", str(intensity))
    low, high = system.domain.T
    start = draw.uniform(low, high, (WALKERS, system.dimension)).T
    rate = np.linalg.norm(system.jacobian(start[:, :500]), axis=(0, 1))
    return simulate_stationary(
        system.vector_field, diffusion=system.diffusion, intensity=intensity, start=start,
        step=ACCURACY / float(np.median(rate)), burn_in=STEPS // 5, steps=STEPS, thin=STEPS // 50,
        generator=draw,
    )  # fmt: skip


def main(snakemake: Any) -> None:
    """Run as a rule's script."""
    source, target, study = snakemake.input, snakemake.output, snakemake.params.study
    intensities = study["invariant"]
    run, method = shown_formula(read_table(source.rrmse), source.models)
    if not intensities or run is None or not source.get("card"):
        write_table(target.table, as_table("invariant", []))
        save_figure(sentence_figure("No invariant distribution was asked for."), snakemake.params.figure)
        return
    system = load_system(source.card)
    published = load_published(source.published).figures if source.get("published") else {}
    identified: SymbolicDecomposition = read_model(source.models[run])[0][method]
    rows, panels = [], []
    for intensity in intensities:
        samples = simulate(system, intensity, seed=study["seed"])
        known = {"intensity": intensity, "box": system.domain}
        figure = published.get(f"Z:{intensity:g}")
        try:
            density = marginal_density(identified.quasipotential, identified.symbols, **known)
            quadrature = normalisation_quadrature(identified.quasipotential, identified.symbols, **known)
        except NumericalFailure as error:
            logging.warning("intensity %g: %s", intensity, error)
            continue
        compared = total_variation(density, samples)
        rows.append(
            {
                "run": run,
                "method": method,
                "intensity": intensity,
                "bessel": normalisation_bessel(
                    identified.quasipotential, identified.symbols, intensity=intensity
                ),
                "quadrature": quadrature,
                "simulated_distance": compared.total_variation,
                "sampling_floor": compared.sampling_floor,
                "published": figure.mean if figure else np.nan,
            }
        )
        panels.append(InvariantPanel(density, quadrature, compared))
    write_table(target.table, as_table("invariant", rows))
    save_figure(
        plot_invariant_distribution(panels, states=system.states, units=system.units),
        snakemake.params.figure,
    )


if __name__ == "__main__":
    with job(snakemake):  # type: ignore[name-defined]  # noqa: F821 (Snakemake puts it here)
        main(snakemake)  # type: ignore[name-defined]  # noqa: F821
