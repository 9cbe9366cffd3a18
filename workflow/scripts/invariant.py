"""The invariant distribution of the run that is shown: Z, and the density against a long simulation.

It follows from a refined formula where one holds over the whole region, otherwise from the landscape where
there is one, otherwise from the published method's formula.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from landscapes import first_complete
from siq.density_comparison import total_variation
from siq.errors import NumericalFailure
from siq.invariant_distribution import (
    marginal_density,
    normalisation_bessel,
    normalisation_quadrature,
)
from siq.landscape.invariant import (
    CELLS,
    compare_with_samples,
    known_density,
    lowest_possible,
    marginal_of,
    sample_potential,
)
from siq.landscape.storage import StoredLandscape
from siq.landscape.walkers import shares_by_rates, simulated_shares, starting_states, walk
from siq.model import read_model
from siq.plots import InvariantPanel, plot_invariant_distribution, save_figure
from siq.plots.style import sentence_figure
from siq.published import published_formula
from siq.randomness import generator
from siq.simulate import simulate_stationary
from siq.study import PublishedFigure, load_published
from siq.symbolic import SymbolicDecomposition
from siq.systems import System, load_system
from siq.tables import as_table, read_table, write_table
from siq.vector_field import VectorField
from step import METHODS, job, shown_formula

WALKERS = 4000
STEPS = 20_000  # of the simulation, after a fifth of them to settle
KEPT = 50  # samples of every walker
ACCURACY = 0.025  # step times the norm of the Jacobian where the walkers are


@dataclass(frozen=True)
class Found:
    """What the table and the figure have for all ε."""

    rows: list[dict[str, Any]]
    panels: list[InvariantPanel]
    shares: list[dict[str, Any]]


def simulate(system: System, intensity: float, *, seed: int) -> np.ndarray:
    """Samples of a long simulation of the system itself, walkers side by side, ``(d, times, walkers)``."""
    draw = generator(seed, "invariant", str(intensity))
    low, high = system.domain.T
    start = draw.uniform(low, high, (WALKERS, system.dimension)).T
    rate = np.linalg.norm(system.jacobian(start[:, :500]), axis=(0, 1))
    return simulate_stationary(
        system.vector_field, diffusion=system.diffusion, intensity=intensity, start=start,
        step=ACCURACY / float(np.median(rate)), burn_in=STEPS // 5, steps=STEPS, thin=STEPS // KEPT,
        generator=draw,
    )  # fmt: skip


def of_formula(
    run: int,
    method: str,
    identified: SymbolicDecomposition,
    system: System,
    intensities: Sequence[float],
    *,
    published: dict[str, PublishedFigure],
    seed: int,
) -> Found:
    """From one formula over the whole region."""
    rows, panels = [], []
    for intensity in intensities:
        samples = simulate(system, intensity, seed=seed)
        known: dict[str, Any] = {"intensity": intensity, "box": system.domain}
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
        rows += of_published(published, system, samples, intensity)
    return Found(rows, panels, [])


def of_landscape(
    run: int,
    stored: StoredLandscape,
    system: System,
    intensities: Sequence[float],
    *,
    published: dict[str, PublishedFigure],
    seed: int,
) -> Found:
    """From the formulas of all wells, where these are believed."""
    potential = stored.quasipotential
    assert potential is not None
    identified, count = potential.local[0].field, len(potential.local)
    field = VectorField(system.symbols, system.equations)
    try:
        fine = sample_potential(potential, system.domain)
        coarse = sample_potential(potential, system.domain, cells=CELLS[system.dimension] // 2)
    except NumericalFailure as error:
        logging.warning("%s", error)
        return Found([], [], [])
    lowest = lowest_possible(coarse, identified)
    rows, panels, shares = [], [], []
    for intensity in intensities:
        try:
            density = known_density(fine, coarse, lowest, intensity=intensity)
        except NumericalFailure as error:
            logging.warning("intensity %g: %s", intensity, error)
            continue
        draw = generator(seed, "invariant", str(intensity))
        start = starting_states(density, fine, WALKERS, generator=draw)
        samples = walk(
            field, start, diffusion=system.diffusion, intensity=intensity, burn_in=STEPS // 5, steps=STEPS,
            thin=STEPS // KEPT, generator=draw,
        )  # fmt: skip
        compared = compare_with_samples(density, fine, samples)
        rows.append(
            {
                "run": run,
                "method": "local formulas",
                "intensity": intensity,
                "quadrature": density.normalisation,
                "simulated_distance": compared.total_variation,
                "sampling_floor": compared.sampling_floor,
                "unknown_at_most": density.unknown,
                "simulated_unknown": compared.outside,
            }
        )
        panels.append(
            InvariantPanel(marginal_of(density, fine), density.normalisation, compared, density.unknown)
        )
        rows += of_published(published, system, samples, intensity)
        simulated = simulated_shares(fine, start, samples)
        by_rates = shares_by_rates(stored.data["transitions"], count, intensity=intensity)
        shares += [
            {
                "run": run,
                "intensity": intensity,
                "well": f"A{index + 1}",
                "share": density.shares[index],
                "by_rates": by_rates[index],
                "simulated": simulated.simulated[index],
                "changed": simulated.changed[index],
            }
            for index in range(count)
        ]
    return Found(rows, panels, shares)


def of_published(
    published: dict[str, PublishedFigure], system: System, samples: np.ndarray, intensity: float
) -> list[dict[str, Any]]:
    """The published formula against the same simulation, over the whole domain."""
    formula = published_formula(published, "U", system.symbols)
    if formula is None:
        return []
    known: dict[str, Any] = {"intensity": intensity, "box": system.domain}
    try:
        compared = total_variation(marginal_density(formula, system.symbols, **known), samples)
        quadrature = normalisation_quadrature(formula, system.symbols, **known)
    except NumericalFailure as error:
        logging.warning("published formula, intensity %g: %s", intensity, error)
        return []
    row = {
        "run": -1,
        "method": "published formula",
        "intensity": intensity,
        "bessel": normalisation_bessel(formula, system.symbols, intensity=intensity),
        "quadrature": quadrature,
        "simulated_distance": compared.total_variation,
        "sampling_floor": compared.sampling_floor,
    }
    return [row]


def find(source: Any, study: dict[str, Any]) -> tuple[System, Found] | None:
    """What can be said, None where nothing was asked or there is no card to simulate."""
    if not study["invariant"] or not source.get("card"):
        return None
    system = load_system(source.card)
    published = load_published(source.published).figures if source.get("published") else {}
    run, method = shown_formula(read_table(source.rrmse), source.models)
    asked: dict[str, Any] = {"published": published, "seed": study["seed"]}
    complete = None
    if run is None or method == METHODS[0]:
        complete = first_complete(source.fields, source.landscapes, study["metric"]["diffusion"])
    if complete is not None:
        return system, of_landscape(*complete, system, study["invariant"], **asked)
    if run is None:
        return None
    identified = read_model(source.models[run])[0][method]
    return system, of_formula(run, method, identified, system, study["invariant"], **asked)


def main(snakemake: Any) -> None:
    """Run as a rule's script."""
    target, found = snakemake.output, find(snakemake.input, snakemake.params.study)
    figure = sentence_figure("No invariant distribution was asked for.")
    rows: list[dict[str, Any]] = []
    shares: list[dict[str, Any]] = []
    if found is not None:
        system, result = found
        rows, shares = result.rows, result.shares
        figure = plot_invariant_distribution(result.panels, states=system.states, units=system.units)
    write_table(target.table, as_table("invariant", rows))
    write_table(target.shares, as_table("well_shares", shares))
    save_figure(figure, snakemake.params.figure)


if __name__ == "__main__":
    with job(snakemake):  # type: ignore[name-defined]  # noqa: F821 (Snakemake puts it here)
        main(snakemake)  # type: ignore[name-defined]  # noqa: F821
