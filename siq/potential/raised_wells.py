"""V about an attractor whose depth is known beforehand, degree by degree.

For given equations the path of least action to the lowest saddle comes first, so that the depth of the well
is known. V is grown once, in the lowest powers that follow it up there (`siq.potential.local_route`). From
there every higher degree starts on the whole sublevel set, from the formula of the degree below: grown by
itself it would be an extrapolation at each level, which of high powers is bad. The fits are made in
combinations of powers that are orthonormal over the sublevel set.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from siq.dynamics.basins import Basin
from siq.dynamics.cycles import Cycle
from siq.dynamics.dynamics import Dynamics
from siq.dynamics.equilibria import Equilibrium, hessian_at
from siq.dynamics.reach import measure_at
from siq.errors import NumericalFailure
from siq.potential.bases import affordable_degree, power_basis
from siq.potential.hamilton_jacobi import (
    UNTOLD,
    HamiltonJacobi,
    equation_at,
    gauss_newton,
    orthonormalised,
    relative_residuals,
    robust,
)
from siq.potential.local_route import grow_well
from siq.potential.well import Well

if TYPE_CHECKING:
    from siq.potential.local_wells import WellOptions

STEP = 1.06  # of the level, from one fit to the next
REWEIGHTINGS = 3
ITERATIONS = 8  # of Gauss–Newton between two reweightings
FINEST = 0.01  # residual below which nothing is an outlier: few points lie where a well is narrow
BESIDE = 0.05  # of the extent of the well: states so close to the path are below a level where the path is
PATH_FROM, PATH_TO = 0.02, 0.98  # of the depth: where the path tells ∇V
MOST_POINTS = 5000  # of one fit
RUNAWAY = 1.5  # of a level: where the formula of the degree below is higher, a lower V is an extrapolation
GAP = 0.25  # of the distance at which the level lies: as far new points may be from those of the last fit
WORSE = 3.0  # times the residual of the degree below: a higher one that is worse by that has run away
ENDED = 2  # higher degrees in a row that do not improve: there is nothing more to be had


@dataclass(frozen=True, eq=False)
class Depth:
    """How deep a well is, as the path of least action to its lowest saddle tells.

    Attributes
    ----------
    saddle
        That saddle, or the unstable cycle that bounds the well.
    points
        Along the path, shape ``(n, d)``.
    values, slopes
        V and ∇V there, shape ``(n,)`` and ``(n, d)``.
    """

    saddle: Equilibrium | Cycle
    points: np.ndarray
    values: np.ndarray
    slopes: np.ndarray

    @property
    def value(self) -> float:
        """V at the saddle."""
        return float(self.values[-1])


def raised_wells(
    dynamics: Dynamics,
    attractor: Equilibrium,
    basin: Basin,
    depth: Depth,
    *,
    options: WellOptions,
    rows: np.ndarray,
    seed: int = 0,
) -> list[Well]:
    """V about an attractor by rising degree, each sought up to ``options.reach`` of the depth.

    Parameters
    ----------
    dynamics
        f and D.
    attractor
        Where V is zero.
    basin
        States that lead there.
    depth
        Of the well.
    options
        Degrees, accuracy and reach.
    rows
        Rows of ``basin.chosen`` that may be used.
    seed
        Decides which points are used where there are too many.

    Raises
    ------
    NumericalFailure
        When no degree follows V up to the saddle.
    """
    wells: list[Well] = []
    failure, idle = NumericalFailure("no degree is affordable"), 0
    for degree in options.degrees:
        if wells and affordable_degree(dynamics.dimension, degree) < degree:
            break
        generator = np.random.default_rng(seed)
        try:
            if wells:
                start = _embedded(wells[-1], degree)
            else:
                start = grow_well(
                    dynamics, attractor, basin, [depth.saddle], degree=degree, generator=generator,
                    depth=depth.value,
                )  # fmt: skip
            well = _raised(start, basin, depth, options.reach, rows, generator)
            if wells and not well.residual < WORSE * wells[-1].residual:  # the path may start it too far off
                again = _raised(start, basin, depth, options.reach, rows, generator, by_path=False)
                well = min(well, again, key=lambda one: one.residual)
        except NumericalFailure as error:  # of one degree: another may do
            failure = error
            continue
        if wells and not well.residual < wells[-1].residual:
            idle += 1
            if idle == ENDED or not well.residual < WORSE * wells[-1].residual:
                break
            continue
        wells.append(well)
        idle = 0
        if well.residual < options.accuracy:
            break
    if not wells:
        raise failure
    return wells


def _embedded(well: Well, degree: int) -> Well:
    """The same formula in powers up to a higher degree; the lower ones come first."""
    basis = power_basis(well.basis.symbols, well.basis.center, well.basis.scale, degree=degree)
    coefficients = np.zeros(basis.size)
    coefficients[: well.basis.size] = well.coefficients
    return replace(well, basis=basis, coefficients=coefficients)


def _raised(
    start: Well,
    basin: Basin,
    depth: Depth,
    reach: float,
    rows: np.ndarray,
    generator: np.random.Generator,
    *,
    by_path: bool = True,
) -> Well:
    """A formula fitted from 0.9 of the depth to its reach, level by level; begun on the path, or not."""
    goal, level = reach * depth.value, min(0.9 * start.level, reach * depth.value)
    shape, flat = basin.states.shape[:2], basin.states.reshape(-1, basin.states.shape[2])
    functions = start.basis.values(flat)
    before = (functions @ start.coefficients).reshape(shape)
    free = start.basis.exponents.sum(axis=1) > 2
    metric = np.linalg.cholesky(hessian_at(start.dynamics, start.attractor))
    places = basin.points(np.arange(len(basin.chosen))) @ metric
    fitted = basin.below(before, level)
    # Where the well narrows towards its saddle, V in lower powers may be far off, and few states be below it.
    way = depth.points @ metric
    distance, nearest = cKDTree(way).query(places)
    beside = np.where(distance < BESIDE * np.sqrt(2 * depth.value), depth.values[nearest], np.inf)
    coefficients = start.coefficients
    if by_path:
        coefficients = _towards_path(start, basin.points(fitted), depth, free)
    while True:
        along = (functions @ coefficients).reshape(shape)
        chosen = np.intersect1d(basin.below(along, level), basin.below(before, RUNAWAY * level))
        if len(fitted) and len(chosen):
            away = cKDTree(places[fitted]).query(places[chosen])[0]
            chosen = chosen[away < GAP * np.sqrt(2 * level)]
        fitted = chosen = np.union1d(chosen, np.flatnonzero(beside < level))
        used = np.intersect1d(chosen, rows)
        if len(used) > MOST_POINTS:
            used = np.sort(generator.choice(used, MOST_POINTS, replace=False))
        if len(used) < 2 * start.basis.size:
            raise NumericalFailure(
                f"V about the attractor near {start.attractor.round(4)} is told by {len(used)} states alone"
            )
        equation = equation_at(start.basis, basin.points(used), start.dynamics, attractor=start.attractor)
        last = level >= goal
        coefficients = _robust(equation, coefficients, free, rounds=REWEIGHTINGS if last else 1)
        if last:
            break
        level = min(goal, STEP * level)
    residual = float(np.median(relative_residuals(equation, coefficients)))
    if not np.isfinite(residual):
        raise NumericalFailure(f"powers of degree {start.degree} do not follow V to its saddle")
    return replace(
        start, coefficients=coefficients, level=depth.value, reach=goal, residual=residual,
        points=basin.points(np.intersect1d(fitted, rows)),
    )  # fmt: skip


def _towards_path(well: Well, x: np.ndarray, depth: Depth, free: np.ndarray) -> np.ndarray:
    """Coefficients of a formula that is left as it is at points, but for the path, whose ∇V is known.

    They are but a start: what is fitted from there is the equation alone.
    """
    noise = measure_at(well.dynamics, well.attractor)
    rising = (depth.values > PATH_FROM * depth.value) & (depth.values < PATH_TO * depth.value)
    where, slopes = depth.points[rising], depth.slopes[rising]
    if not len(where) or not len(x):
        return well.coefficients
    old, along = well.basis.gradients(x), well.basis.gradients(where)
    size = np.sqrt(noise.steepness(where, slopes))
    weight = np.sqrt(len(x) / len(where)) / size
    rest = slopes - along @ well.coefficients
    steep = np.sqrt(noise.steepness(x, old @ well.coefficients))
    steep = np.maximum(steep, np.median(steep))
    roots = noise.root_at(where), noise.root_at(x)
    rows = [
        np.einsum("n,nij,nim->njm", weight, roots[0], along[:, :, free], optimize=True),
        np.einsum("n,nij,nim->njm", 1 / steep, roots[1], old[:, :, free], optimize=True),
    ]
    wanted = np.einsum("n,nij,ni->nj", weight, roots[0], rest).ravel()
    matrix = np.concatenate([one.reshape(-1, one.shape[2]) for one in rows])
    right = np.concatenate([wanted, np.zeros(len(matrix) - len(wanted))])
    scale = np.linalg.norm(matrix, axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    coefficients = well.coefficients.copy()
    coefficients[free] += np.linalg.lstsq(matrix / scale, right, rcond=UNTOLD)[0] / scale
    return coefficients


def _robust(
    equation: HamiltonJacobi, coefficients: np.ndarray, free: np.ndarray, *, rounds: int
) -> np.ndarray:
    """Gauss–Newton in orthonormal combinations, with weights that fall with what is left."""
    turned_equation, turned = orthonormalised(equation, free)
    stay = int((~free).sum())
    moving = np.arange(turned.shape[1]) < turned.shape[1] - stay
    theta = np.linalg.lstsq(turned[free], coefficients[free], rcond=None)[0]
    theta[~moving] = coefficients[~free]
    for _ in range(rounds):
        weighted = robust(turned_equation, theta, finest=FINEST)
        theta = gauss_newton(weighted, theta, free=moving, steps=ITERATIONS).coefficients
    return np.asarray(turned @ theta)
