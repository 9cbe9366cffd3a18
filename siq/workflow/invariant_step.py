"""Invariant: which invariant distribution follows from U, and is it that of a long simulation?"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass as plain_dataclass
from dataclasses import replace
from typing import Annotated, Any

import numpy as np
import pandas as pd
from pydantic import Field
from pydantic.dataclasses import dataclass

from siq.errors import NumericalFailure
from siq.numerics.randomness import Purpose, generator
from siq.quasipotential.cell_density import (
    CELLS,
    known_density,
    lowest_possible,
    sample_potential,
    shares_by_rates,
    walk,
)
from siq.quasipotential.formulas import SymbolicDecomposition
from siq.quasipotential.invariant_density import (
    StationaryDensity,
    marginal_density,
    normalisation_bessel,
    normalisation_quadrature,
)
from siq.quasipotential.landscape import Landscape
from siq.systems.dynamics import Dynamics
from siq.systems.simulation import simulate_stationary
from siq.workflow.published import PublishedFigure, published_formula
from siq.workflow.settings import STRICT, StateSpace
from siq.workflow.tables import as_table

logger = logging.getLogger(__name__)

WALKERS = 4000
STEPS = 20_000  # of the simulation, after a fifth of them to settle
KEPT = 50  # samples of every walker
NONE_OF_OURS = -1  # the run of what was published
ACCURACY = 0.025  # step times the norm of the Jacobian where the walkers are


@dataclass(frozen=True, config=STRICT)
class InvariantSettings:
    """What the invariant distribution depends on; `invariant` has the intensities ε."""

    seed: int
    space: StateSpace
    invariant: tuple[Annotated[float, Field(gt=0)], ...]


@plain_dataclass(frozen=True)
class Invariant:
    """The invariant distribution for all ε: tables `invariant` and `well_shares`, and densities to draw."""

    table: pd.DataFrame
    shares: pd.DataFrame
    densities: list[StationaryDensity]


@plain_dataclass(frozen=True)
class FormulaShown:
    """One formula over the whole region: of which run, by which method."""

    run: int
    method: str
    formulas: SymbolicDecomposition


@plain_dataclass(frozen=True)
class LandscapeShown:
    """The formulas of all wells of a run."""

    run: int
    landscape: Landscape


Shown = FormulaShown | LandscapeShown


def run(
    settings: InvariantSettings,
    system: Dynamics | None,
    shown: Shown | None,
    published: Mapping[str, PublishedFigure],
) -> Invariant:
    """Z, and the density against a long simulation of the card.

    It follows from a refined formula where one holds over the whole region, otherwise from the landscape
    where there is one, otherwise from the published method's formula.

    Parameters
    ----------
    settings
        The intensities ε; none asks for nothing.
    system
        The card, None where there is none to simulate.
    shown
        What it follows from.
    published
        Figures to be set beside ours.
    """
    found = _Rows([], [], [])
    if settings.invariant and system is not None and shown is not None:
        asked: dict[str, Any] = {"published": published, "seed": settings.seed}
        if isinstance(shown, LandscapeShown):
            found = _of_landscape(shown, system, settings.invariant, **asked)
        else:
            found = _of_formula(shown, system, settings.invariant, **asked)
    return Invariant(
        as_table("invariant", found.rows), as_table("well_shares", found.shares), found.densities
    )


@plain_dataclass(frozen=True)
class _Rows:
    """What the tables and the figure have for all ε."""

    rows: list[dict[str, Any]]
    densities: list[StationaryDensity]
    shares: list[dict[str, Any]]


def _simulate(system: Dynamics, intensity: float, *, seed: int) -> np.ndarray:
    """Samples of a long simulation of the system itself, walkers side by side, ``(d, times, walkers)``."""
    draw = generator(seed, Purpose.INVARIANT, str(intensity))
    low, high = system.box.T
    start = draw.uniform(low, high, (WALKERS, system.dimension)).T
    rate = np.linalg.norm(system.jacobian(start[:, :500].T), axis=(1, 2))
    return simulate_stationary(
        system, intensity=intensity, start=start,
        step=ACCURACY / float(np.median(rate)), burn_in=STEPS // 5, steps=STEPS, thin=STEPS // KEPT,
        generator=draw,
    )  # fmt: skip


def _of_formula(
    shown: FormulaShown,
    system: Dynamics,
    intensities: Sequence[float],
    *,
    published: Mapping[str, PublishedFigure],
    seed: int,
) -> _Rows:
    """From one formula over the whole region."""
    identified = shown.formulas
    rows, densities = [], []
    for intensity in intensities:
        samples = _simulate(system, intensity, seed=seed)
        known: dict[str, Any] = {"intensity": intensity, "box": system.box}
        figure = published.get(f"Z:{intensity:g}")
        try:
            density = marginal_density(identified.quasipotential, identified.symbols, **known)
            quadrature = normalisation_quadrature(identified.quasipotential, identified.symbols, **known)
        except NumericalFailure as error:
            logger.warning("intensity %g: %s", intensity, error)
            continue
        compared = density.compare(samples)
        rows.append(
            {
                "run": shown.run,
                "method": shown.method,
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
        densities.append(replace(density, normalisation=quadrature, comparison=compared))
        rows += _of_published(published, system, samples, intensity)
    return _Rows(rows, densities, [])


def _of_landscape(
    shown: LandscapeShown,
    system: Dynamics,
    intensities: Sequence[float],
    *,
    published: Mapping[str, PublishedFigure],
    seed: int,
) -> _Rows:
    """From the formulas of all wells, where these are believed."""
    stored, potential = shown.landscape, shown.landscape.global_quasipotential
    assert potential is not None
    identified, count = potential.wells[0].dynamics, len(potential.wells)
    try:
        fine = sample_potential(potential, system.box)
        coarse = sample_potential(potential, system.box, cells=CELLS[system.dimension] // 2)
    except NumericalFailure as error:
        logger.warning("%s", error)
        return _Rows([], [], [])
    lowest = lowest_possible(coarse, identified)
    laws = [(way.start, way.end, way.barrier, way.exit.prefactor) for way in stored.transitions]
    rows, densities, shares = [], [], []
    for intensity in intensities:
        try:
            density = known_density(fine, coarse, lowest, intensity=intensity)
        except NumericalFailure as error:
            logger.warning("intensity %g: %s", intensity, error)
            continue
        draw = generator(seed, Purpose.INVARIANT, str(intensity))
        start = density.starting_states(WALKERS, generator=draw)
        samples = walk(
            system, start, intensity=intensity, burn_in=STEPS // 5, steps=STEPS,
            thin=STEPS // KEPT, generator=draw,
        )  # fmt: skip
        compared = density.compare(samples)
        rows.append(
            {
                "run": shown.run,
                "method": "local formulas",
                "intensity": intensity,
                "quadrature": density.normalisation,
                "simulated_distance": compared.total_variation,
                "sampling_floor": compared.sampling_floor,
                "unknown_at_most": density.unknown,
                "simulated_unknown": compared.outside,
            }
        )
        densities.append(replace(density.marginal(), comparison=compared))
        rows += _of_published(published, system, samples, intensity)
        simulated, changed = fine.simulated_shares(start, samples)
        by_rates = shares_by_rates(laws, count, intensity=intensity)
        shares += [
            {
                "run": shown.run,
                "intensity": intensity,
                "well": f"A{index + 1}",
                "share": density.shares[index],
                "by_rates": by_rates[index],
                "simulated": simulated[index],
                "changed": changed[index],
            }
            for index in range(count)
        ]
    return _Rows(rows, densities, shares)


def _of_published(
    published: Mapping[str, PublishedFigure], system: Dynamics, samples: np.ndarray, intensity: float
) -> list[dict[str, Any]]:
    """The published formula against the same simulation, over the whole domain."""
    formula = published_formula(published, "U", system.symbols)
    if formula is None:
        return []
    known: dict[str, Any] = {"intensity": intensity, "box": system.box}
    try:
        compared = marginal_density(formula, system.symbols, **known).compare(samples)
        quadrature = normalisation_quadrature(formula, system.symbols, **known)
    except NumericalFailure as error:
        logger.warning("published formula, intensity %g: %s", intensity, error)
        return []
    row = {
        "run": NONE_OF_OURS,
        "method": "published formula",
        "intensity": intensity,
        "bessel": normalisation_bessel(formula, system.symbols, intensity=intensity),
        "quadrature": quadrature,
        "simulated_distance": compared.total_variation,
        "sampling_floor": compared.sampling_floor,
    }
    return [row]
