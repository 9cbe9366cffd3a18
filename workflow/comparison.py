"""Landscapes of all runs beside references, simulated escapes, equations, and the invariant distribution.

A reference is computed from the card's own f by methods that share no code with ours (`siq.validation`).
Networks, formulas of the regression, and what was published stand beside the runs. Scoring alone: what is
found here of the card is no input of any other step.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import sympy

from benchmarks.publication.publication import normalisation_bessel
from siq.errors import NumericalFailure
from siq.inference.field_estimate import read_field
from siq.networks.decomposition import AnyNetworks, NetworksByWell
from siq.numerics.integration import heun_step
from siq.numerics.randomness import Purpose, generator
from siq.quasipotential.formulas import SymbolicDecomposition
from siq.quasipotential.invariant_density import (
    SampledPotential,
    StationaryDensity,
    marginal_density,
    shares_by_rates,
)
from siq.quasipotential.landscape import Landscape, NoLandscape
from siq.quasipotential.landscape_assembly import EquationSettings, landscape_from_equations
from siq.quasipotential.landscape_comparison import (
    Potential,
    ReferenceLandscape,
    compare_estimate,
    compare_landscape,
    compare_overall,
    differences,
    reference_landscape,
)
from siq.quasipotential.landscape_files import landscape_from_data, read_landscape
from siq.quasipotential.transitions import Transition
from siq.remarks import sentence
from siq.systems.dynamics import Dynamics
from siq.systems.escapes import Neighbourhood, simulate_escapes
from siq.systems.phase_portrait import evenly_spread, phase_portrait
from siq.systems.simulation import simulate_stationary
from siq.validation.mesh import mesh_potential
from siq.workflow.study import PipelineSettings
from siq.workflow.tables import Method, as_table
from workflow.published import PublishedFigure, published_formula, published_potentials
from workflow.rows import concatenate


def read_stored(field: str | Path, landscape: str | Path) -> Landscape | None:
    """The landscape of a run, None where there is none."""
    record = read_field(field)
    if record is None:
        return None
    return read_landscape(landscape, dynamics=record.dynamics)


def first_stored(
    fields: Sequence[str | Path], landscapes: Sequence[str | Path]
) -> tuple[int, Landscape] | None:
    """The first run with a U over all wells; those after it are not read."""
    for run, (field, landscape) in enumerate(zip(fields, landscapes, strict=True)):
        stored = read_stored(field, landscape)
        if stored is not None and stored.global_quasipotential is not None:
            return run, stored
    return None


STARTS = 4000  # states over the domain, from which those are taken that cover it evenly
REACH = 1.2  # of the lowest barrier out of a well: landscapes are compared up to 1.1 of it


def reference_of_card(settings: PipelineSettings, system: Dynamics) -> ReferenceLandscape:
    """The reference for the landscape of a card; an empty one that says why where there is none."""
    draw = generator(settings.seed, Purpose.REFERENCE)
    low, high = system.box.T
    x = draw.uniform(low, high, size=(STARTS, system.dimension))
    points = x[evenly_spread(x, generator=draw)]
    try:
        portrait = phase_portrait(system, points)
        if not portrait.attractors and (fault := portrait.fault()) is not None:
            return ReferenceLandscape.missing(system.dimension, sentence(fault))
        return reference_landscape(
            system, portrait, box=system.box, reach=REACH, generator=draw,
            mesh=lambda attractor, level: mesh_potential(system, attractor, box=system.box, level=level),
        )  # fmt: skip
    except (NumericalFailure, np.linalg.LinAlgError) as error:
        return ReferenceLandscape.missing(system.dimension, str(error))


DRAWS = 100  # of the digits that a published formula does not print
NONE_OF_OURS = -1  # the run of what was published, or of a mesh
TABLE = "landscape_errors"


def run_landscape_errors(
    settings: PipelineSettings,
    reference: ReferenceLandscape,
    runs: Sequence[tuple[Landscape | None, Mapping[str, SymbolicDecomposition], AnyNetworks | None]],
    published: Mapping[str, PublishedFigure],
    published_mesh: Potential | None = None,
) -> pd.DataFrame:
    """The table `landscape_errors`; without a reference it has no rows.

    Parameters
    ----------
    settings
        Below which U landscapes are compared.
    reference
        Of the card.
    runs
        What each says of U: its landscape, its formulas by method, its networks, as far as there are any.
    published, published_mesh
        What was published of U: figures by quantity, and U on a mesh where that is at hand.
    """
    if reference.reason:
        return as_table(TABLE, [])
    below = None if settings.landscape is None else settings.landscape.compare_below
    tables = []
    for number, (landscape, formulas, networks) in enumerate(runs):
        if landscape is not None:
            compared = compare_landscape(reference, landscape, below=below)
            tables.append(_rows(number, "local formulas", compared))
        sources = {
            method: _twice(one.values) for method, one in formulas.items() if one.potential is not None
        }
        if networks is not None:
            sources["networks"] = _twice(networks.potential_at)
        regressed = formulas.get(Method.REGRESSION)
        if isinstance(networks, NetworksByWell) and regressed is not None and regressed.wells:
            lifted = partial(networks.lifted, potentials=[one.values for one in regressed.wells])
            sources["regression, by well"] = _twice(lifted)
        for source, potential in sources.items():
            tables.append(_rows(number, source, compare_estimate(reference, potential, below=below)))
    if np.isfinite(reference.mesh).any():
        tables.append(_rows(NONE_OF_OURS, "mesh", reference.compare_mesh(below=below)))
    formulas_of_others = published_potentials(
        published, [sympy.Symbol(name, real=True) for name in settings.space.names or ()],
        draws=DRAWS, generator=generator(settings.seed, Purpose.ROUNDING),
    )  # fmt: skip
    for number, one in enumerate(formulas_of_others):  # as printed, and with what the rounding leaves open
        label = "published formula" + (", digits not printed" if number else "")
        tables.append(_rows(number + NONE_OF_OURS, label, compare_estimate(reference, one, below=below)))
    if published_mesh is not None:
        compared = compare_estimate(reference, published_mesh, below=below)
        tables.append(_rows(NONE_OF_OURS, "published mesh", compared))
        if formulas_of_others:  # the paper's own comparison, in its Appendix E
            level = reference.level if below is None else below
            values, mesh = formulas_of_others[0](reference.points), published_mesh(reference.points)
            both = [compare_overall(mesh - np.nanmin(mesh), values, level, shifted=True)]
            tables.append(_rows(NONE_OF_OURS, "published formula, against the published mesh", both))
    return concatenate(TABLE, tables)


def _rows(number: int, source: str, comparisons: Sequence[Mapping[str, object]]) -> pd.DataFrame:
    return as_table(TABLE, [{"run": number, "source": source, **one} for one in comparisons])


def _twice(potential: Potential) -> Potential:
    """U of a V, both functions of points in rows."""
    return lambda x: 2 * potential(x)


WALKERS = 400
FOLLOWED = 1.5  # predicted mean times, after which who is left counts as censored
NEIGHBOURHOOD = 0.2  # of the barrier out of the well that is reached


def run_escapes(
    settings: PipelineSettings, system: Dynamics, landscapes: Sequence[Mapping[str, Any] | None]
) -> pd.DataFrame:
    """The table `escape`, of the first run that knows the height of all its wells.

    Parameters
    ----------
    settings
        Noise intensities, and the seed.
    system
        The card that is simulated.
    landscapes
        `quasipotential.json` of every run, None where there is none.
    """
    read = (None if one is None else landscape_from_data(one, system) for one in landscapes)
    complete = next((one for one in read if one is not None and np.isfinite(one.heights).all()), None)
    if complete is None:
        return as_table("escape", [])
    rows = []
    for way in complete.transitions:
        if np.isnan(way.exit.prefactor) or not np.isfinite(way.barrier) or way.end is None:
            continue
        for number, intensity in enumerate(settings.noises):
            draw = generator(settings.seed, Purpose.ESCAPE, str(way.start), str(number))
            row = _simulated(system, complete, way, intensity, draw)
            name = f"A{way.start + 1} to A{way.end + 1}"
            rows.append({"transition": name, "intensity": intensity} | row)
    return as_table("escape", rows)


def _simulated(
    system: Dynamics, landscape: Landscape, way: Transition, intensity: float, draw: np.random.Generator
) -> dict[str, object]:
    """The simulated mean time of one way out, at one intensity."""
    assert way.rate is not None and way.rate.prefactor is not None
    starts = [one.position for one in landscape.attractors]
    targets: list[Neighbourhood] = []
    for index, position in enumerate(starts):
        barriers = [one.barrier for one in landscape.transitions if one.start == index]
        barriers = [one for one in barriers if np.isfinite(one) and one]
        if index != way.start and barriers:
            targets.append(Neighbourhood.about(system, position, level=NEIGHBOURHOOD * min(barriers) / 2))
    predicted = way.rate.prefactor * np.exp(way.barrier / intensity)
    try:
        found = simulate_escapes(
            system, starts[way.start], targets, intensity=intensity,
            longest=FOLLOWED * predicted, generator=draw, walkers=WALKERS,
        )  # fmt: skip
    except (NumericalFailure, ValueError) as error:
        return {"predicted": predicted, "escapes": 0, "note": str(error)}
    return {
        "predicted": predicted, "simulated": found.mean, "simulated_error": found.standard_error,
        "escapes": found.escapes, "note": "",
    }  # fmt: skip


BESIDE_EQUATIONS_TABLE = "beside_equations"
NO_RUN = -1  # the run of a row that is of the equations alone


def run_beside_equations(
    settings: PipelineSettings, system: Dynamics, runs: Sequence[Mapping[str, Any] | None]
) -> pd.DataFrame:
    """The table `beside_equations`.

    Parameters
    ----------
    settings
        The seed, and ε for mean times: those of the study, or else that of each run.
    system
        The equations, as the card says.
    runs
        The landscape of each run as plain data, None where it has none.

    Returns
    -------
    pandas.DataFrame
        A row for each number of each run. Where the equations have no landscape, a single one that says why.
    """
    try:
        # Barriers and prefactors follow from paths of least action; formulas have references of their own.
        found = landscape_from_equations(system, EquationSettings(seed=settings.seed), formulas=False)
    except (NumericalFailure, np.linalg.LinAlgError) as error:
        reason = error.reason if isinstance(error, NoLandscape) else str(error)
        return as_table(
            BESIDE_EQUATIONS_TABLE, [{"run": NO_RUN, "note": f"the equations have no landscape: {reason}"}]
        )
    rows: list[dict[str, object]] = []
    for number, data in enumerate(runs):
        if data is None:
            rows.append({"run": number, "note": "the run has no landscape"})
            continue
        try:
            one = landscape_from_data(data, system)
            shown = () if one.noise is None else (one.noise.intensity,)
            noises = settings.noises or shown
            compared = differences(found, one, noises=noises)
        except ValueError as error:
            rows.append({"run": number, "note": str(error)})
            continue
        rows += [{"run": number} | row for row in compared]
    return as_table(BESIDE_EQUATIONS_TABLE, rows)


logger = logging.getLogger(__name__)

DENSITY_WALKERS = 4000
STEPS = 20_000  # of the simulation, after a fifth of them to settle
KEPT = 50  # samples of every walker
ACCURACY, HEUN_STEP = 0.025, 0.1  # step times the norm of the Jacobian where the walkers are, by either rule


def compare_invariant(
    settings: PipelineSettings,
    system: Dynamics,
    source: SymbolicDecomposition | Landscape,
    published: Mapping[str, PublishedFigure],
    *,
    run: int,
    method: str,
) -> tuple[pd.DataFrame, pd.DataFrame, list[StationaryDensity]]:
    """Z, and the density against a long simulation of the card, for all ε of the settings.

    Parameters
    ----------
    settings
        The intensities ε.
    system
        The card.
    source
        What the density follows from: one formula over the whole region, or the formulas of all wells.
    published
        Figures to be set beside ours.
    run, method
        Whose formulas these are.

    Returns
    -------
    table, shares
        The tables `invariant` and `well_shares`.
    densities
        To be drawn.
    """
    rows: list[dict[str, Any]] = []
    shares: list[dict[str, Any]] = []
    densities: list[StationaryDensity] = []
    try:
        at = _of_wells(source, system) if isinstance(source, Landscape) else _of_one_formula(source, system)
    except NumericalFailure as error:
        logger.warning("%s", error)
        at, settings = None, replace(settings, invariant=())
    for intensity in settings.invariant:
        assert at is not None
        try:
            density, samples, row, of_wells = at(
                intensity, generator(settings.seed, Purpose.INVARIANT, str(intensity))
            )
        except NumericalFailure as error:
            logger.warning("intensity %g: %s", intensity, error)
            continue
        densities.append(density)
        row = {"run": run, "method": method, "intensity": intensity} | row
        if not isinstance(source, Landscape):
            figure = published.get(f"Z:{intensity:g}")
            row["published"] = figure.mean if figure else np.nan
        rows += [row, *_density_of_published(published, system, samples, intensity)]
        shares += [{"run": run, "intensity": intensity} | one for one in of_wells]
    return as_table("invariant", rows), as_table("well_shares", shares), densities


AtIntensity = Callable[
    [float, np.random.Generator], tuple[StationaryDensity, np.ndarray, dict[str, Any], list[dict[str, Any]]]
]
"""For ε: the density with its comparison, samples, a row of the table, and rows of shares of wells."""


def _of_one_formula(formulas: SymbolicDecomposition, system: Dynamics) -> AtIntensity:
    """From one formula over the whole region; walkers start anywhere in it."""
    formula, symbols = formulas.quasipotential, formulas.symbols

    def at(
        intensity: float, draw: np.random.Generator
    ) -> tuple[StationaryDensity, np.ndarray, dict[str, Any], list[dict[str, Any]]]:
        low, high = system.box.T
        start = draw.uniform(low, high, (DENSITY_WALKERS, system.dimension)).T
        rate = np.linalg.norm(system.jacobian(start[:, :500].T), axis=(1, 2))
        samples = simulate_stationary(
            system, intensity=intensity, start=start,
            step=ACCURACY / float(np.median(rate)), burn_in=STEPS // 5, steps=STEPS, thin=STEPS // KEPT,
            generator=draw,
        )  # fmt: skip
        row, density = _density_row(formula, symbols, system, samples, intensity)
        return density, samples, row, []

    return at


def _density_row(
    formula: sympy.Expr,
    symbols: Sequence[sympy.Symbol],
    system: Dynamics,
    samples: np.ndarray,
    intensity: float,
) -> tuple[dict[str, Any], StationaryDensity]:
    """Z and the density of a formula of U over the whole domain, against samples."""
    known: dict[str, Any] = {"intensity": intensity, "box": system.box}
    density = marginal_density(formula, symbols, **known)
    compared = density.compare(samples)
    row = {
        "bessel": normalisation_bessel(formula, symbols, intensity=intensity),
        "quadrature": density.normalisation,
        "simulated_distance": compared.total_variation,
        "sampling_floor": compared.sampling_floor,
    }
    return row, replace(density, comparison=compared)


def _of_wells(landscape: Landscape, system: Dynamics) -> AtIntensity:
    """From the formulas of all wells, where these are believed; walkers start as the density says."""
    potential = landscape.global_quasipotential
    assert potential is not None
    identified, count = potential.wells[0].dynamics, len(potential.wells)
    fine = SampledPotential.of(potential, system.box)
    coarse = SampledPotential.of(potential, system.box, cells=len(fine.values) // 2)
    lowest = coarse.lowest_possible(identified)
    laws = [(way.start, way.end, way.barrier, way.exit.prefactor) for way in landscape.transitions]

    def at(
        intensity: float, draw: np.random.Generator
    ) -> tuple[StationaryDensity, np.ndarray, dict[str, Any], list[dict[str, Any]]]:
        density = fine.density(coarse, lowest, intensity=intensity)
        start = density.starting_states(DENSITY_WALKERS, generator=draw)
        rate = np.linalg.norm(system.jacobian(start.T), axis=(1, 2))
        # f turns many times while it descends: the rule of Euler and Maruyama would take damping away.
        samples = simulate_stationary(
            system, intensity=intensity, start=start, step=HEUN_STEP / float(np.median(rate)),
            burn_in=STEPS // 5, steps=STEPS, thin=STEPS // KEPT, generator=draw, rule=heun_step,
        )  # fmt: skip
        compared = density.compare(samples)
        row = {
            "quadrature": density.normalisation,
            "simulated_distance": compared.total_variation,
            "sampling_floor": compared.sampling_floor,
            "unknown_at_most": density.unknown,
            "simulated_unknown": compared.outside,
        }
        simulated, changed = fine.simulated_shares(start, samples)
        by_rates = shares_by_rates(laws, count, intensity=intensity)
        shares = [
            {
                "well": f"A{index + 1}",
                "share": density.shares[index],
                "by_rates": by_rates[index],
                "simulated": simulated[index],
                "changed": changed[index],
            }
            for index in range(count)
        ]
        return replace(density.marginal(), comparison=compared), samples, row, shares

    return at


def _density_of_published(
    published: Mapping[str, PublishedFigure], system: Dynamics, samples: np.ndarray, intensity: float
) -> list[dict[str, Any]]:
    """The published formula against the same simulation, over the whole domain."""
    formula = published_formula(published, "U", system.symbols)
    if formula is None:
        return []
    try:
        row, _ = _density_row(formula, system.symbols, system, samples, intensity)
    except NumericalFailure as error:
        logger.warning("published formula, intensity %g: %s", intensity, error)
        return []
    return [{"run": NONE_OF_OURS, "method": "published formula", "intensity": intensity} | row]
