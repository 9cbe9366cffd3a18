"""The steps that hold landscapes of all runs against references, simulated escapes and given equations.

Beside them stand networks, the regression's formulas, and what was published.

Scoring alone: what is found here of the card is no input of any other step.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from dataclasses import dataclass as plain_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import sympy
from pydantic.dataclasses import dataclass

from siq.errors import NumericalFailure
from siq.inference.identification import read_field
from siq.networks.decomposition import TrainedNetworks
from siq.numerics.randomness import Purpose, generator
from siq.quasipotential.formulas import SymbolicDecomposition
from siq.quasipotential.landscape import Landscape, LandscapeOptions, NoLandscape
from siq.quasipotential.landscape_comparison import (
    ErrorInRegion,
    Potential,
    ReferenceLandscape,
    check_same_noise,
    compare_estimate,
    compare_overall,
    compare_wells,
    difference_rows,
    differences,
    no_reference,
    overall_level,
    reference_landscape,
    relative_l2,
)
from siq.quasipotential.landscape_files import StoredLandscape, landscape_data, read_landscape
from siq.systems.dynamics import Dynamics
from siq.systems.phase_portrait import evenly_spread, phase_portrait
from siq.validation.escapes import Neighbourhood, neighbourhood, simulate_escapes
from siq.validation.mesh import mesh_potential
from siq.workflow.equations_step import EquationSettings, landscape_of_equations
from siq.workflow.published import PublishedFigure, published_potentials
from siq.workflow.settings import STRICT, StateSpace
from siq.workflow.tables import as_table, concatenate


def read_stored(field: str | Path, landscape: str | Path) -> StoredLandscape | None:
    """The landscape of a run, None where there is none."""
    record = read_field(field)
    if record is None:
        return None
    return read_landscape(landscape, dynamics=record.found.dynamics)


def first_stored(
    fields: Sequence[str | Path], landscapes: Sequence[str | Path]
) -> tuple[int, StoredLandscape] | None:
    """The first run with a U over all wells; those after it are not read."""
    for run, (field, landscape) in enumerate(zip(fields, landscapes, strict=True)):
        stored = read_stored(field, landscape)
        if stored is not None and stored.quasipotential is not None:
            return run, stored
    return None


STARTS = 4000  # states over the domain, from which those are taken that cover it evenly
REACH = 1.2  # of the lowest barrier out of a well: landscapes are compared up to 1.1 of it


@dataclass(frozen=True, config=STRICT)
class ReferenceSettings:
    """What a reference depends on beside the card."""

    seed: int


def run(settings: ReferenceSettings, system: Dynamics) -> ReferenceLandscape:
    """The reference for the landscape of a card; an empty one that says why where there is none."""
    draw = generator(settings.seed, Purpose.REFERENCE)
    low, high = system.box.T
    x = draw.uniform(low, high, size=(STARTS, system.dimension))
    points = x[evenly_spread(x, generator=draw)]
    try:
        portrait = phase_portrait(system, points)
        if not portrait.attractors and (fault := portrait.fault()) is not None:
            return no_reference(system.dimension, fault)
        return reference_landscape(
            system, portrait, box=system.box, reach=REACH, generator=draw,
            mesh=lambda attractor, level: mesh_potential(system, attractor, box=system.box, level=level),
        )  # fmt: skip
    except (NumericalFailure, np.linalg.LinAlgError) as error:
        return no_reference(system.dimension, str(error))


DRAWS = 100  # of the digits that a published formula does not print
SAME = 0.02  # of the region: attractors of a run so close to the reference's are the same
NONE_OF_OURS = -1  # the run of what was published, or of a mesh
TABLE = "landscape_errors"


@dataclass(frozen=True, config=STRICT)
class LandscapeErrorsSettings:
    """What the comparison depends on."""

    seed: int
    space: StateSpace
    landscape: LandscapeOptions


@plain_dataclass(frozen=True)
class RunToCompare:
    """What a run says of U: its landscape, its formulas by method, its networks, as far as there are any."""

    number: int
    landscape: StoredLandscape | None
    formulas: Mapping[str, SymbolicDecomposition]
    networks: TrainedNetworks | None


@plain_dataclass(frozen=True)
class PublishedAnswers:
    """What was published of U: figures by quantity, and U on a mesh where that is at hand."""

    figures: Mapping[str, PublishedFigure]
    mesh: Potential | None = None


def run_landscape_errors(
    settings: LandscapeErrorsSettings,
    reference: ReferenceLandscape,
    runs: Sequence[RunToCompare],
    published: PublishedAnswers | None,
) -> pd.DataFrame:
    """The table `landscape_errors`; without a reference it has no rows."""
    if reference.reason:
        return as_table(TABLE, [])
    below = settings.landscape.compare_below
    tables = []
    for one in runs:
        if one.landscape is not None:
            tables.append(_of_landscape(one.number, reference, one.landscape, below))
        for method, formulas in one.formulas.items():
            if formulas.potential is not None:
                compared = compare_estimate(reference, _of_formula(formulas), below=below)
                tables.append(_rows(one.number, method, compared))
        if one.networks is not None:
            compared = compare_estimate(reference, _of_networks(one.networks), below=below)
            tables.append(_rows(one.number, "networks", compared))
    if np.isfinite(reference.mesh).any():
        tables.append(_of_mesh(reference, below))
    if published is not None:
        tables += _of_published(settings, published, reference)
    return concatenate(TABLE, tables)


def _rows(number: int, source: str, comparisons: Sequence[ErrorInRegion]) -> pd.DataFrame:
    return as_table(TABLE, [{"run": number, "source": source} | asdict(one) for one in comparisons])


def _matching(reference: ReferenceLandscape, stored: StoredLandscape) -> dict[int, int]:
    """For each attractor of the reference, the well of the run that has it."""
    width = np.ptp(reference.points, axis=0)
    pairs = {}
    for place, well in enumerate(stored.data["wells"]):
        distance = np.abs((reference.attractors - np.array(well["attractor"])) / width).max(axis=1)
        if distance.min() < SAME:
            pairs[int(np.argmin(distance))] = place
    return pairs


def _of_landscape(
    number: int, reference: ReferenceLandscape, stored: StoredLandscape, below: float | None
) -> pd.DataFrame:
    """Local formulas, their minimum over all wells, and their barriers."""
    pairs = _matching(reference, stored)
    local = {index: one for index, place in pairs.items() if (one := stored.wells[place]) is not None}
    comparisons = compare_wells(reference, local)
    if stored.quasipotential is not None:
        comparisons.append(compare_overall(reference, stored.quasipotential(reference.points), below=below))
    for index, place in pairs.items():
        ways = [way for way in stored.data["transitions"] if way["start"] == place and way["barrier"]]
        lowest = min((way["barrier"] for way in ways), default=float("nan"))
        error = abs(lowest / reference.barriers[index] - 1)
        comparisons.append(ErrorInRegion(f"barrier from A{index + 1}", 1, float(np.isfinite(error)), error))
    return _rows(number, "local formulas", comparisons)


def _of_mesh(reference: ReferenceLandscape, below: float | None) -> pd.DataFrame:
    """The reference's own mesh against its characteristics, and its barriers against the least action."""
    whole = compare_overall(reference, reference.mesh_values, below=below)
    errors = np.abs(reference.mesh_barriers / reference.barriers - 1)
    barriers = [
        ErrorInRegion(f"barrier from A{index + 1}", 1, 1.0, float(one)) for index, one in enumerate(errors)
    ]
    return _rows(NONE_OF_OURS, "mesh", [whole, *barriers])


def _of_formula(one: SymbolicDecomposition) -> Potential:
    """U of a formula as a function of points in rows."""
    return lambda x: 2 * one.evaluate(np.ascontiguousarray(x.T))[0]


def _of_networks(one: TrainedNetworks) -> Potential:
    """U of networks as a function of points in rows."""
    return lambda x: 2 * one.evaluate(x).potential


def _of_two(values: np.ndarray, mesh: np.ndarray, level: float) -> ErrorInRegion:
    """An estimate of U against a mesh that is known up to a constant, below a level above its minimum."""
    exact = mesh - np.nanmin(mesh)
    inside = np.nan_to_num(exact, nan=np.inf) < level
    own, exact = values[inside], exact[inside]
    error = relative_l2(own - np.median(own - exact), exact)
    return ErrorInRegion(f"U < {level:.4g}", int(inside.sum()), 1.0, error)


def _of_published(
    settings: LandscapeErrorsSettings, published: PublishedAnswers, reference: ReferenceLandscape
) -> list[pd.DataFrame]:
    """The published formula, as printed and with what its rounding leaves open, and the published mesh."""
    below = settings.landscape.compare_below
    formulas = published_potentials(
        published.figures, [sympy.Symbol(name, real=True) for name in settings.space.names or ()],
        draws=DRAWS, generator=generator(settings.seed, Purpose.ROUNDING),
    )  # fmt: skip
    tables = []
    for number, one in enumerate(formulas):
        label = "published formula" + (", digits not printed" if number else "")
        compared = compare_estimate(reference, one, below=below)
        tables.append(_rows(number + NONE_OF_OURS, label, compared))
    if published.mesh is not None:
        compared = compare_estimate(reference, published.mesh, below=below)
        tables.append(_rows(NONE_OF_OURS, "published mesh", compared))
        if formulas:  # the paper's own comparison, in its Appendix E
            level = overall_level(reference) if below is None else below
            values = formulas[0](reference.points)
            both = [_of_two(values, published.mesh(reference.points), level)]
            tables.append(_rows(NONE_OF_OURS, "published formula, against the published mesh", both))
    return tables


WALKERS = 400
FOLLOWED = 1.5  # predicted mean times, after which who is left counts as censored
NEIGHBOURHOOD = 0.2  # of the barrier out of the well that is reached


@dataclass(frozen=True, config=STRICT)
class EscapesSettings:
    """What the simulations of escapes depend on beside the card."""

    seed: int
    landscape: LandscapeOptions


def run_escapes(
    settings: EscapesSettings, system: Dynamics, landscapes: Sequence[Mapping[str, Any] | None]
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
    complete = [
        one
        for one in landscapes
        if one is not None and all(well["height"] is not None for well in one["wells"])
    ]
    rows = []
    for way in complete[0]["transitions"] if complete else []:
        if way["prefactor"] is None or way["barrier"] is None or way["end"] is None:
            continue
        for number, intensity in enumerate(settings.landscape.noise_intensities):
            draw = generator(settings.seed, Purpose.ESCAPE, str(way["start"]), str(number))
            row = _simulated(system, complete[0], way, intensity, draw)
            name = f"A{way['start'] + 1} to A{way['end'] + 1}"
            rows.append({"transition": name, "intensity": intensity} | row)
    return as_table("escape", rows)


def _simulated(
    system: Dynamics,
    landscape: Mapping[str, Any],
    way: Mapping[str, Any],
    intensity: float,
    draw: np.random.Generator,
) -> dict[str, object]:
    """The simulated mean time of one way out, at one intensity."""
    starts = [np.array(well["attractor"]) for well in landscape["wells"]]
    targets: list[Neighbourhood] = []
    for index, position in enumerate(starts):
        barriers = [
            one["barrier"] for one in landscape["transitions"] if one["start"] == index and one["barrier"]
        ]
        if index != way["start"] and barriers:
            targets.append(neighbourhood(system, position, level=NEIGHBOURHOOD * min(barriers) / 2))
    predicted = way["prefactor"] * np.exp(way["barrier"] / intensity)
    try:
        found = simulate_escapes(
            system, starts[way["start"]], targets, intensity=intensity,
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


@dataclass(frozen=True, config=STRICT)
class BesideEquationsSettings:
    """What the comparison depends on beside the card."""

    seed: int
    landscape: LandscapeOptions


def compared(equations: Landscape, learned: Landscape, *, noise: float | None = None) -> pd.DataFrame:
    """What `siq.quasipotential.landscape.Landscape.beside` says.

    Parameters
    ----------
    equations, learned
        The landscapes by either.
    noise
        ε of mean times; None for none.

    Raises
    ------
    ValueError
        When the states are not the same, or D is not.
    """
    both = (landscape_data(one, dynamics=one.dynamics) for one in (equations, learned))
    found = differences(*both, box=equations.dynamics.box, noises=() if noise is None else (noise,))
    places = np.array([one.position for one in (*equations.attractors, *equations.equilibria)])
    check_same_noise(equations.dynamics, learned.dynamics, places, found=learned.found)
    return as_table(BESIDE_EQUATIONS_TABLE, [{"run": 0} | row for row in difference_rows(found)]).drop(
        columns="run"
    )


def run_beside_equations(
    settings: BesideEquationsSettings, system: Dynamics, runs: Sequence[Mapping[str, Any] | None]
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
        found = landscape_of_equations(system, EquationSettings(seed=settings.seed), formulas=False)
    except (NumericalFailure, np.linalg.LinAlgError) as error:
        reason = error.reason if isinstance(error, NoLandscape) else str(error)
        return as_table(
            BESIDE_EQUATIONS_TABLE, [{"run": NO_RUN, "note": f"the equations have no landscape: {reason}"}]
        )
    equations = landscape_data(found, dynamics=system)
    rows: list[dict[str, object]] = []
    for number, one in enumerate(runs):
        if one is None:
            rows.append({"run": number, "note": "the run has no landscape"})
            continue
        shown = one.get("noise")
        noises = settings.landscape.noise_intensities or (() if shown is None else (shown["intensity"],))
        try:
            compared = differences(equations, one, box=system.box, noises=noises)
        except ValueError as error:
            rows.append({"run": number, "note": str(error)})
            continue
        rows += [{"run": number} | row for row in difference_rows(compared)]
    return as_table(BESIDE_EQUATIONS_TABLE, rows)
