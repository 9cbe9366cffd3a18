"""Landscape errors: how far are the landscapes of all runs from the references?

Beside them stand networks, the regression's formulas, and what was published.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from dataclasses import dataclass as plain_dataclass

import numpy as np
import pandas as pd
import sympy
from pydantic.dataclasses import dataclass

from siq.landscape.comparison import (
    ErrorInRegion,
    Potential,
    compare_estimate,
    compare_overall,
    compare_wells,
    overall_level,
    relative_l2,
)
from siq.landscape.options import LandscapeOptions
from siq.landscape.reference import ReferenceLandscape
from siq.landscape.storage import StoredLandscape
from siq.networks.trained import TrainedNetworks
from siq.numerics.randomness import Purpose, generator
from siq.potential.symbolic import SymbolicDecomposition
from siq.steps.settings import STRICT, StateSpace
from siq.study.published import published_potentials
from siq.study.published_figures import PublishedFigure
from siq.study.tables import as_table, concatenate

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


def run(
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
