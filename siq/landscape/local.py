"""Local quasipotentials: one formula of V about each attractor, and how far each may be believed.

No single formula can hold over several wells, since V has a kink between them; about one attractor it is
smooth, below its lowest saddle and often beyond. A formula found up to the saddle (`siq.local_route`) is
taken on to a higher level by a robust fit of the Hamilton–Jacobi equation: where V stops to be smooth, by
caustics or by a kink, the residual is large and counts for nothing, instead of spoiling the formula
elsewhere. Where it stays large, nothing is claimed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from siq.bases import affordable_degree
from siq.equilibria import Equilibrium
from siq.errors import NumericalFailure
from siq.hamilton_jacobi import HamiltonJacobi, equation_at, gauss_newton
from siq.landscape.options import LandscapeOptions
from siq.local_route import Region, Well, grow_well
from siq.outline import Outline
from siq.vector_field import VectorField

STEP = 1.06  # of the level, from one fit to the next
REWEIGHTINGS = 4
STEEP = 3.0  # of the median residual: what is larger counts less and less
ROUNDING = 1e-16  # of what is usual: |∇V| |f| so close to the attractor says nothing
FINEST = 1e-5  # residual below which nothing is an outlier
NEGATIVE = 1e-9  # of the level: V so far below zero is rounding
NEAR = 2.5  # of the spacing of the points: further away there were no points
HELD_OUT = 4  # every so manieth point is kept for choosing the degree


@dataclass(frozen=True)
class LocalQuasipotential:
    """V about an attractor as one formula, and where to believe it.

    Attributes
    ----------
    well
        The formula. Its level is V up to which it was sought, its points are those of the fit.
    field
        f.
    diffusion
        D.
    tolerance
        Largest relative Hamilton–Jacobi residual at a point where the formula is believed.
    elsewhere
        Recorded states from which f leads to other attractors, shape ``(m, d)``; None for none.
    """

    well: Well
    field: VectorField
    diffusion: np.ndarray
    tolerance: float
    elsewhere: np.ndarray | None = None

    def residual(self, x: np.ndarray) -> np.ndarray:
        """∣∇V·(f + D∇V)∣ / (∣∇V∣ ∣f∣) at points ``(n, d)``, in the metric of the noise: shape ``(n,)``.

        At the attractor, where both vanish, it is zero.
        """
        numerator, size = self._terms(x)
        # At the attractor both vanish, and what is left of them is rounding.
        return numerator / np.maximum(size, ROUNDING * self._size)

    def _terms(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        slope, flow = self.well.gradients(x), self.field(x)
        steepness = np.einsum("ni,ij,nj->n", slope, self.diffusion, slope)
        speed = np.einsum("ni,ij,nj->n", flow, np.linalg.inv(self.diffusion), flow)
        numerator = np.abs((slope * (flow + slope @ self.diffusion)).sum(axis=1))
        return numerator, np.sqrt(steepness * speed)

    @cached_property
    def _size(self) -> float:
        size = float(np.median(self._terms(self.well.points)[1])) if len(self.well.points) else 0.0
        return size if size > 0 else float(np.finfo(float).tiny) / ROUNDING

    def values(self, x: np.ndarray) -> np.ndarray:
        """V at points ``(n, d)``: shape ``(n,)``, NaN where the formula is not to be believed.

        That is above its level, away from the recorded states from which f leads to the attractor, and
        where it does not solve the Hamilton–Jacobi equation.
        """
        believed = self.reaches(x)
        believed[believed] = self.residual(x[believed]) <= self.tolerance
        return np.where(believed, self.well.values(x), np.nan)

    def reaches(self, x: np.ndarray) -> np.ndarray:
        """Mask of the points below the level, and among recorded states that lead to the attractor.

        V is zero at the attractor and nowhere lower. Where a formula is, it runs away between two of its
        points.
        """
        tree, spacing = self._points
        own, nearest = tree.query(x / self._width)
        values, level = self.well.values(x), self.well.level
        reached: np.ndarray = (values <= level) & (values >= -NEGATIVE * level)
        reached &= own <= NEAR * spacing[nearest]
        if self._others is not None:  # behind the ridge the formula would go on down to the other attractor
            reached &= own < self._others.query(x / self._width)[0]
        return reached

    @cached_property
    def _others(self) -> cKDTree | None:
        if self.elsewhere is None or not len(self.elsewhere):
            return None
        return cKDTree(self.elsewhere / self._width)

    @cached_property
    def _width(self) -> np.ndarray:
        width: np.ndarray = np.ptp(self.well.points, axis=0)
        return width

    @cached_property
    def _points(self) -> tuple[cKDTree, np.ndarray]:
        places = self.well.points / self._width
        tree = cKDTree(places)
        # Of the d-th neighbour: points on one descent lie closer to each other than descents do.
        spacing = tree.query(places, k=2 * places.shape[1] + 1)[0][:, -1]
        return tree, spacing


@dataclass(frozen=True)
class Trial:
    """One degree that was tried.

    Attributes
    ----------
    degree, terms
        Highest power, and number of coefficients.
    residual
        Median relative Hamilton–Jacobi residual on points that took no part in the fit.
    covered
        Points among them below the lowest level of all degrees at which the formula is believed, as a share
        of those that the degree which reaches most of them has there.
    """

    degree: int
    terms: int
    residual: float
    covered: float


def extend_well(
    field: VectorField,
    well: Well,
    region: Region,
    *,
    diffusion: np.ndarray,
    goal: float,
    rows: np.ndarray | None = None,
) -> Well:
    """Take a formula on, from its well to a higher level, by robust fits of the Hamilton–Jacobi equation.

    Parameters
    ----------
    field
        f.
    well
        V up to the lowest saddle; see `siq.local_route.grow_well`.
    region
        What leads to the attractor. Only such states are asked: across the ridge another well begins.
    diffusion
        D.
    goal
        Level of V to be reached.
    rows
        Rows of ``region.chosen`` that may be used; default all.
    """
    allowed = np.arange(len(region.chosen)) if rows is None else rows
    flat = region.states.reshape(-1, region.states.shape[2])
    functions = well.basis.values(flat)
    free = well.basis.exponents.sum(axis=1) > 2
    coefficients = well.coefficients
    level = min(0.9 * well.level, goal)
    while True:
        along = (functions @ coefficients).reshape(region.states.shape[:2])
        points = region.points(np.intersect1d(region.below(along, level), allowed))
        equation = equation_at(well.basis, points, field(points), diffusion=diffusion)
        # On the way up one round keeps the formula close enough to be taken further.
        coefficients = _robust(equation, coefficients, free, rounds=REWEIGHTINGS if level >= goal else 1)
        if level >= goal:
            break
        level = min(goal, STEP * level)
    residual = float(np.median(_relative(equation, coefficients)))
    return replace(well, coefficients=coefficients, level=goal, residual=residual, points=points)


def _relative(equation: HamiltonJacobi, coefficients: np.ndarray) -> np.ndarray:
    slope = equation.gradients @ coefficients
    size = np.sqrt(np.einsum("ni,ij,nj->n", slope, equation.diffusion, slope))
    relative: np.ndarray = np.abs(equation.residual(coefficients)) / np.where(size > 0, size, np.inf)
    return relative


def _robust(
    equation: HamiltonJacobi, coefficients: np.ndarray, free: np.ndarray, *, rounds: int
) -> np.ndarray:
    """Gauss–Newton with weights that fall with the square of what is left (Cauchy's)."""
    for _ in range(rounds):
        rest = _relative(equation, coefficients)
        scale = max(STEEP * float(np.median(rest)), FINEST)
        weight = equation.weight / np.sqrt(1 + (rest / scale) ** 2)
        solution = gauss_newton(replace(equation, weight=weight), coefficients, free=free, steps=6)
        coefficients = solution.coefficients
    return coefficients


def local_quasipotential(
    field: VectorField,
    outline: Outline,
    index: int,
    *,
    diffusion: np.ndarray,
    options: LandscapeOptions,
    seed: int = 0,
    barrier: float | None = None,
) -> tuple[LocalQuasipotential, tuple[Trial, ...]]:
    """V about one attractor, of the lowest degree that no other betters by much, and all that were tried.

    Parameters
    ----------
    field
        The identified f.
    outline
        Attractors, saddles and regions.
    index
        Which attractor.
    diffusion
        D.
    options
        Degrees, reach and tolerance.
    seed
        Decides which points are used where there are too many.
    barrier
        The lowest barrier of U out of the well, which no formula tells as well as a path of least action
        does; by default what each formula says of its saddle, or of where recordings end.

    Raises
    ------
    NumericalFailure
        When no degree gives a formula.
    """
    attractor, region = outline.attractors[index], outline.regions[index]
    rows = np.arange(len(region.chosen))
    unseen = region.points(rows[rows % HELD_OUT == 0])
    others = [one for number, one in enumerate(outline.regions) if number != index]
    elsewhere = np.concatenate([one.points(np.arange(len(one.chosen))) for one in others]) if others else None
    found: list[tuple[int, LocalQuasipotential]] = []
    failure = NumericalFailure("no degree is affordable")
    for degree in options.degrees:
        if found and affordable_degree(field.dimension, degree) < degree:
            break
        try:
            well = grow_well(
                field, attractor, region, outline.saddles[index],
                diffusion=diffusion, degree=degree, generator=np.random.default_rng(seed),
            )  # fmt: skip
        except NumericalFailure as error:  # of one degree: another may do
            failure = error
            continue
        top = well.level if barrier is None else barrier / 2
        well = extend_well(
            field, well, region, diffusion=diffusion, goal=options.reach * top,
            rows=rows[rows % HELD_OUT != 0],
        )  # fmt: skip
        local = LocalQuasipotential(well, field, diffusion, options.tolerance, elsewhere)
        found.append((degree, local))
    if not found:
        raise failure
    trials = _trials(found, unseen)
    return found[best_trial(trials)][1], trials


def _trials(found: Sequence[tuple[int, LocalQuasipotential]], x: np.ndarray) -> tuple[Trial, ...]:
    """What each degree is worth on points that took no part in its fit."""
    level = min(one.well.level for _, one in found)  # V of the saddle differs by some per cent
    reached = [one.reaches(x) & (one.well.values(x) <= level) for _, one in found]
    most = max(int(mask.sum()) for mask in reached)
    trials = []
    for (degree, one), mask in zip(found, reached, strict=True):
        residual = one.residual(x[mask])
        believed = int((residual <= one.tolerance).sum())
        median = float(np.median(residual)) if len(residual) else np.inf
        trials.append(Trial(degree, one.well.basis.size, median, believed / max(most, 1)))
    return tuple(trials)


def best_trial(trials: Sequence[Trial]) -> int:
    """Index of the first trial whose coverage and residual no other betters by much."""
    coverage = max(trial.covered for trial in trials)
    good = [index for index, trial in enumerate(trials) if trial.covered >= coverage - 0.005]
    finest = min(trials[index].residual for index in good)
    return next(index for index in good if trials[index].residual <= max(2 * finest, FINEST))


def lowest_saddle(local: LocalQuasipotential, saddles: Sequence[Equilibrium]) -> Equilibrium | None:
    """The saddle that bounds a well, None where recordings end before one."""
    if local.well.saddle is None:
        return None
    distances = [float(np.abs(one.position - local.well.saddle).max()) for one in saddles]
    return saddles[int(np.argmin(distances))]
