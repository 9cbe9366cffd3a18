"""The local route to the end: V about an attractor, of the degree that points kept apart ask for.

A formula grown to its saddle (`siq.potential.local_route`) is taken on to a higher level by a robust fit of
the Hamilton–Jacobi equation: where V stops to be smooth, by caustics or by a kink, the residual is large and
counts for nothing, instead of spoiling the formula elsewhere. Where it stays large, nothing is claimed. This
is the V of an attractor for all that follows: certificate, landscape, files.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from siq.dynamics.basins import Basin
from siq.dynamics.dynamics import Dynamics
from siq.dynamics.phase_portrait import PhasePortrait
from siq.errors import NumericalFailure
from siq.potential.bases import affordable_degree
from siq.potential.hamilton_jacobi import (
    HamiltonJacobi,
    equation_at,
    gauss_newton,
    relative_residuals,
    robust,
)
from siq.potential.local_route import grow_well
from siq.potential.raised_wells import Depth, raised_wells
from siq.potential.well import TOLERANCE, DegreeTrial, Well

STEP = 1.06  # of the level, from one fit to the next
REWEIGHTINGS = 4
FINEST = 1e-5  # residual below which nothing is an outlier
HELD_OUT = 4  # every so manieth point is kept for choosing the degree

Degree = Annotated[int, Field(ge=2, le=16)]


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class WellOptions:
    """How V about an attractor is sought, and where it is believed.

    Attributes
    ----------
    degrees
        Highest powers that are tried, one after the other.
    accuracy
        Relative Hamilton–Jacobi residual below which no higher power is tried.
    reach
        Level up to which a formula is sought, as a share of V at the lowest saddle.
    tolerance
        Largest relative Hamilton–Jacobi residual at a point where a formula is believed.
    """

    degrees: Annotated[tuple[Degree, ...], Field(min_length=1)] = (4, 6, 8, 10, 12)
    accuracy: Annotated[float, Field(gt=0)] = FINEST
    reach: Annotated[float, Field(gt=0, le=3)] = 1.2
    tolerance: Annotated[float, Field(gt=0, lt=1)] = TOLERANCE


def local_well(
    dynamics: Dynamics,
    portrait: PhasePortrait,
    index: int,
    *,
    options: WellOptions,
    seed: int = 0,
    depth: Depth | None = None,
) -> Well:
    """V about one attractor, of the lowest degree that no other betters by much.

    Parameters
    ----------
    dynamics
        f and D.
    portrait
        Attractors, saddles and basins.
    index
        Which attractor.
    options
        Degrees, reach and tolerance.
    seed
        Decides which points are used where there are too many.
    depth
        The lowest saddle with V there, where the path of least action has told it before, as it does for
        given equations.

    Raises
    ------
    NumericalFailure
        When no degree gives a formula.
    """
    basin = portrait.basins[index]
    rows = np.arange(len(basin.chosen))
    elsewhere = states_elsewhere(portrait, index)
    kept = rows[rows % HELD_OUT != 0]
    if depth is None:
        grown = _grown_wells(dynamics, portrait, index, options, seed)
        # No formula tells V of the saddle as well as the finest does.
        goal = options.reach * grown[-1].level
        extended = [extend_well(well, basin, goal=goal, rows=kept) for well in grown]
    else:
        extended = raised_wells(
            dynamics, portrait.attractors[index], basin, depth, options=options, rows=kept, seed=seed
        )
    wells = [replace(well, tolerance=options.tolerance, elsewhere=elsewhere) for well in extended]
    trials = _trials(wells, basin.points(rows[rows % HELD_OUT == 0]))
    return replace(wells[best_trial(trials)], trials=trials)


def states_elsewhere(portrait: PhasePortrait, index: int) -> np.ndarray | None:
    """Recorded states from which f leads to other attractors, shape ``(m, d)``; None for none."""
    others = [one for number, one in enumerate(portrait.basins) if number != index]
    return np.concatenate([one.points(np.arange(len(one.chosen))) for one in others]) if others else None


def surveyed(well: Well, dynamics: Dynamics, portrait: PhasePortrait, index: int) -> Well:
    """A formula read from a file, with the recorded states that tell where it holds.

    Parameters
    ----------
    well
        The formula; it stays as it is.
    dynamics
        f and D.
    portrait, index
        Of the recordings, and which of its attractors is the well's.
    """
    basin = portrait.basins[index]
    along = well.values(basin.states.reshape(-1, basin.states.shape[2])).reshape(basin.states.shape[:2])
    return replace(
        well,
        dynamics=dynamics,
        points=basin.points(basin.below(along, well.reach)),
        elsewhere=states_elsewhere(portrait, index),
    )


def _grown_wells(
    dynamics: Dynamics, portrait: PhasePortrait, index: int, options: WellOptions, seed: int
) -> list[Well]:
    """V up to the saddle by the degrees in their order, until one is exact or the next is too many powers."""
    wells: list[Well] = []
    failure = NumericalFailure("no degree is affordable")
    for degree in options.degrees:
        if wells and affordable_degree(dynamics.dimension, degree) < degree:
            break
        try:
            well = grow_well(
                dynamics, portrait.attractors[index], portrait.basins[index], portrait.saddles[index],
                degree=degree, generator=np.random.default_rng(seed),
            )  # fmt: skip
        except NumericalFailure as error:  # of one degree: another may do
            failure = error
            continue
        wells.append(well)
        if well.residual < options.accuracy:
            break
    if not wells:
        raise failure
    return wells


def extend_well(well: Well, basin: Basin, *, goal: float, rows: np.ndarray | None = None) -> Well:
    """Take a formula on, from its well to a higher level, by robust fits of the Hamilton–Jacobi equation.

    Parameters
    ----------
    well
        V up to the lowest saddle; see `siq.potential.local_route.grow_well`.
    basin
        What leads to the attractor. Only such states are asked: across the ridge another well begins.
    goal
        Level of V to be reached.
    rows
        Rows of ``basin.chosen`` that may be used; default all.
    """
    allowed = np.arange(len(basin.chosen)) if rows is None else rows
    functions = well.basis.values(basin.states.reshape(-1, basin.states.shape[2]))
    free = well.basis.exponents.sum(axis=1) > 2
    coefficients = well.coefficients
    level = min(0.9 * well.level, goal)
    while True:
        along = (functions @ coefficients).reshape(basin.states.shape[:2])
        points = basin.points(np.intersect1d(basin.below(along, level), allowed))
        equation = equation_at(well.basis, points, well.dynamics, attractor=well.attractor)
        # On the way up one round keeps the formula close enough to be taken further.
        coefficients = _robust(equation, coefficients, free, rounds=REWEIGHTINGS if level >= goal else 1)
        if level >= goal:
            break
        level = min(goal, STEP * level)
    residual = float(np.median(relative_residuals(equation, coefficients)))
    top = well.level
    if well.saddle is not None:  # a formula that goes on smoothly behind a kink is above V, never below
        top = min(top, float(well.basis.values(well.saddle[None])[0] @ coefficients))
    return replace(well, coefficients=coefficients, level=top, reach=goal, residual=residual, points=points)


def _robust(
    equation: HamiltonJacobi, coefficients: np.ndarray, free: np.ndarray, *, rounds: int
) -> np.ndarray:
    """Gauss–Newton with weights that fall with what is left."""
    for _ in range(rounds):
        weighted = robust(equation, coefficients, finest=FINEST)
        coefficients = gauss_newton(weighted, coefficients, free=free, steps=6).coefficients
    return coefficients


def _trials(wells: Sequence[Well], x: np.ndarray) -> tuple[DegreeTrial, ...]:
    """What each degree is worth on points that took no part in its fit."""
    reached = [well.reaches(x) for well in wells]
    most = max(int(mask.sum()) for mask in reached)
    trials = []
    for well, mask in zip(wells, reached, strict=True):
        residual = well.residual_at(x[mask])
        believed = int((residual <= well.tolerance).sum())
        median = float(np.median(residual)) if len(residual) else np.inf
        trials.append(DegreeTrial(well.degree, well.basis.size, median, believed / max(most, 1)))
    return tuple(trials)


def best_trial(trials: Sequence[DegreeTrial]) -> int:
    """Index of the first trial whose coverage and residual no other betters by much."""
    coverage = max(trial.covered for trial in trials)
    good = [index for index, trial in enumerate(trials) if trial.covered >= coverage - 0.005]
    finest = min(trials[index].residual for index in good)
    return next(index for index in good if trials[index].residual <= max(2 * finest, FINEST))
