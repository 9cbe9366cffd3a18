"""V about one attractor: the local route from f alone, grown outwards to the lowest saddle and beyond.

No single formula can hold over several wells, since V has a kink between them; about one attractor it is
smooth, below its lowest saddle and often beyond. Away from recorded states that lead to the attractor, and
where the formula does not solve the Hamilton–Jacobi equation, nothing is claimed.

At the attractor the Hessian of V is M, which follows from the Jacobian of f, and it is kept. The higher
powers are found by Gauss–Newton on the Hamilton–Jacobi equation, in a sublevel set that grows from a small
ellipsoid (`_grow_well`). From its saddle a formula is taken on to a higher level by robust fits
(`_extend_well`). Random units grow in the same way, from a paraboloid and without M
(`siq.quasipotential.output_weights`).

For given equations the path of least action to the lowest saddle comes first, so that the depth of the well
is known. V is grown once, in the lowest powers that follow it up there. From there every higher degree starts
on the whole sublevel set, from the formula of the degree below: grown by itself it would be an extrapolation
at each level, which of high powers is bad. `local_well` chooses the degree, or random units beside M where
these leave less of an error.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import sympy
from scipy.spatial import cKDTree

from siq.errors import NumericalFailure
from siq.numerics.randomness import positive
from siq.quasipotential.certificate_tests import LEVEL_SHARE, MIN_POINTS, Candidate
from siq.quasipotential.hamilton_jacobi import (
    SINGULAR_RATIO,
    Expansion,
    HamiltonJacobi,
    PowerBasis,
    affordable_degree,
)
from siq.quasipotential.path_chains import MinimumActionPath
from siq.systems.basins import Basin
from siq.systems.cycles import Cycle
from siq.systems.dynamics import Dynamics
from siq.systems.equilibria import Equilibrium, hessian_at, measure_at
from siq.systems.formulas import DIGITS, Formula
from siq.systems.phase_portrait import PhasePortrait, RecordedRegion

if TYPE_CHECKING:
    from siq.quasipotential.refinement import RefinementOptions

RESIDUAL_TOLERANCE = 0.05  # residual up to which a formula is believed: V is then off by some per cent
ROUNDING_SHARE = 1e-16  # of what is usual: |∇V| |f| so close to the attractor says nothing
NEGATIVE_VALUE_TOLERANCE = 1e-9  # of the level: V so far below zero is rounding
NEGLIGIBLE_COEFFICIENT = 1e-14  # of the largest coefficient, or of the size of a well: rounding of the fit


@dataclass(frozen=True)
class DegreeTrial:
    """One degree that was tried about an attractor, on points that took no part in the fit."""

    degree: int  #: highest power
    terms: int  #: number of coefficients
    residual: float  #: median relative Hamilton–Jacobi residual
    covered: float  #: where the formula is believed, as a share of what the widest degree reaches


@dataclass(frozen=True, eq=False)
class Well(Expansion):
    """V about an attractor, in powers about it. U is 2V."""

    #: The powers about the attractor; their `coefficients` have the shape ``(m,)``
    basis: PowerBasis
    #: f and D, and where V is zero, shape ``(d,)``
    dynamics: Dynamics
    attractor: np.ndarray
    #: V of the lowest saddle and its position; of the last point that recordings reach, and None, where they
    #: end before one
    level: float
    saddle: np.ndarray | None
    #: Relative Hamilton–Jacobi residual on the points of the fit, and those, shape ``(n, d)``; none where
    #: only the formula was kept
    residual: float
    points: np.ndarray
    #: V up to which the formula was sought, which may lie beyond the saddle; by default the level
    reach: float = 0.0
    #: Largest relative Hamilton–Jacobi residual at a point where the formula is believed
    tolerance: float = RESIDUAL_TOLERANCE
    #: Recorded states from which f leads to other attractors, shape ``(m, d)``; None for none
    elsewhere: np.ndarray | None = None
    #: The degrees that were tried
    trials: tuple[DegreeTrial, ...] = ()
    #: V in powers, of V over units, for where these are refused; otherwise None
    instead: Well | None = None

    def __post_init__(self) -> None:
        if not self.reach:
            object.__setattr__(self, "reach", self.level)

    @property
    def powers(self) -> dict[str, Any]:
        """Center, scale, exponents, units and coefficients as plain data."""
        names = ("center", "scale", "exponents", *["units"] * bool(len(self.basis.units)))
        parts = {name: getattr(self.basis, name).tolist() for name in names}
        return parts | {"coefficients": self.coefficients.tolist()}

    @property
    def degree(self) -> int:
        """Highest power."""
        return int(self.basis.exponents.sum(axis=1).max())

    def inside(self, share: float = 1.0) -> np.ndarray:
        """The points of the fit below a share of the level, shape ``(m, d)``."""
        return np.asarray(self.points[self.values(self.points) < share * self.level])

    def known_values(self, x: np.ndarray) -> np.ndarray:
        """V at points ``(n, d)``: shape ``(n,)``, NaN where the formula is not to be believed."""
        return np.where(self.believed(x), self.values(x), np.nan)

    def believed(self, x: np.ndarray) -> np.ndarray:
        """Mask of the points that the formula reaches, and where it solves the Hamilton–Jacobi equation.

        That has no meaning where a formula of D is no covariance.
        """
        believed = self.reaches(x) & self.dynamics.diffusion.positive_at(x)
        believed[believed] = self.residual_at(x[believed]) <= self.tolerance
        return believed

    def residual_at(self, x: np.ndarray) -> np.ndarray:
        """∣∇V·(f + D∇V)∣ / (∣∇V∣ ∣f∣) at points ``(n, d)``, in the metric of the noise: shape ``(n,)``."""
        numerator, size = self._terms(x)
        # At the attractor both vanish, and what is left of them is rounding.
        return np.asarray(numerator / np.maximum(size, ROUNDING_SHARE * self._size))

    def reaches(self, x: np.ndarray) -> np.ndarray:
        """Mask of the points below `reach`, and among recorded states that lead to the attractor.

        V is zero at the attractor and nowhere lower. Where a formula is, it runs away between two of its
        points. One state has nothing beside its points: what lies between two of them is reached, and so is
        the saddle, to which they lead as close as recordings do.
        """
        values = self.values(x)
        reached: np.ndarray = (values <= self.reach) & (values >= -NEGATIVE_VALUE_TOLERANCE * self.reach)
        if not len(self.points):
            return reached
        if x.shape[1] == 1:
            known = self.points if self.saddle is None else np.append(self.points, self.saddle[None], axis=0)
            return reached & (x[:, 0] >= known.min()) & (x[:, 0] <= known.max())
        return reached & self._region.recorded(x)

    def _terms(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        slope, flow, noise = self.gradients(x), self.dynamics.drift(x), self.dynamics.diffusion
        numerator = np.abs((slope * (flow + noise.push(x, slope))).sum(axis=1))
        measure = measure_at(self.dynamics, self.attractor)
        return numerator, np.sqrt(measure.contract(x, slope) * measure.squared_speed(x, flow))

    @cached_property
    def _size(self) -> float:
        size = float(np.median(self._terms(self.points)[1])) if len(self.points) else 0.0
        return size if size > 0 else float(np.finfo(float).tiny) / ROUNDING_SHARE

    @cached_property
    def _region(self) -> RecordedRegion:
        # Behind the ridge the formula would go on down to the other attractor.
        return RecordedRegion(self.points, self.elsewhere, np.ptp(self.points, axis=0))

    @property
    def formula(self) -> Formula:
        """V in offsets from the attractor, in powers and units, in those of the states, without rounding."""
        basis, (of_powers, of_units) = self.basis, np.split(self.coefficients, [len(self.basis.exponents)])
        size = np.abs(of_powers)
        formula = Formula.of_powers(
            "V", basis.symbols, scale=basis.scale, exponents=basis.exponents,
            center=np.where(np.abs(basis.center) > NEGLIGIBLE_COEFFICIENT * basis.scale, basis.center, 0.0),
            coefficients=np.where(size > NEGLIGIBLE_COEFFICIENT * size.max(), of_powers, 0.0),
            units=self.dynamics.units, title=f"U = 2V is the quasipotential, known up to V = {self.reach!r}",
        )  # fmt: skip
        scaled = [one / sympy.Float(s, DIGITS) for one, s in zip(basis.symbols, basis.scale, strict=True)]
        return replace(formula, expression=formula.expression + basis.sum_of_units(of_units, scaled))

    def to_latex(self, *, digits: int = DIGITS) -> str:
        """The formula as LaTeX, with so many significant digits."""
        return self.formula.to_latex(digits=digits)

    def to_sympy(self) -> sympy.Expr:
        """The formula as a sympy expression of the states."""
        return self.formula.to_sympy()

    def to_numpy(self) -> str:
        """Source of the functions ``V`` and ``V_gradient`` in numpy."""
        return self.formula.source("numpy")

    def to_jax(self) -> str:
        """Source of the functions ``V`` and ``V_gradient`` in JAX."""
        return self.formula.source("jax")

    def to_torch(self) -> str:
        """Source of the functions ``V`` and ``V_gradient`` of tensors in torch."""
        return self.formula.source("torch")

    def to_c(self) -> str:
        """Source of the functions ``V`` and ``V_gradient`` in C."""
        return self.formula.source("c")

    def to_julia(self) -> str:
        """Source of the functions ``V`` and ``V_gradient`` in Julia."""
        return self.formula.source("julia")

    def surveyed(self, dynamics: Dynamics, portrait: PhasePortrait, index: int) -> Well:
        """A formula read from a file, with the recorded states that tell where it holds."""
        basin = portrait.basins[index]
        along = self.values(basin.states.reshape(-1, basin.states.shape[2])).reshape(basin.states.shape[:2])
        return replace(
            self, dynamics=dynamics, points=basin.points(basin.below(along, self.reach)),
            elsewhere=portrait.states_elsewhere(index),
        )  # fmt: skip


FIRST_LEVEL_SHARE = 0.05  # of a known depth: the first level
LEVEL_GROWTH = 1.5  # of the level, from one fit to the next
POINT_REACH = 0.25  # of the distance at which the level lies: of new points from those of the last fit
MAX_POINTS = 6000  # of one fit
RECORDED_QUANTILE = 0.9  # share of the recorded starts below the level, where no saddle limits it
LEVEL_TOLERANCE = 0.01  # change of the level, and of the number of points, with which growing ends
REPEAT_TOLERANCE = 1e-4  # of a level: one that was tried before, from which the next would follow again
SADDLE_TOLERANCE = 0.05  # of a level: by so much V of the saddle that set it may change with the next fit
MAX_ROUNDS = 80  # of growing
COARSE_TOLERANCE = 1e-6  # relative change of coefficients with which Gauss–Newton ends on the way
MAX_RESIDUAL = 0.2  # relative residual from which on a start has led nowhere
SADDLE_DISTANCE = 0.1  # of the recorded box: a saddle so close to the points of the fit has been reached
ROBUST_GROWTH = 1.06  # of the level, from one robust fit to the next
MIN_OUTLIER_RESIDUAL = 1e-5  # residual below which nothing is an outlier
ROBUST_FIT: dict[str, Any] = {"finest": MIN_OUTLIER_RESIDUAL, "steps": 6}
# Few points lie where a well is narrow.
FIT_TO_KNOWN_DEPTH: dict[str, Any] = {"finest": 0.01, "steps": 8, "orthonormal": True}
PATH_DISTANCE = 0.05  # of the extent of the well: states so close to the path are as low as it
PATH_FROM, PATH_TO = 0.02, 0.98  # of the depth: where the path tells ∇V
MAX_POINTS_TO_KNOWN_DEPTH = 5000  # of one fit
RUNAWAY_LEVEL = 1.5  # of a level: where the lower degree's formula is higher, a lower V is an extrapolation
RUNAWAY_RATIO = 3.0  # times the residual of the degree below: a higher one so much worse has run away
MAX_IDLE_DEGREES = 2  # higher degrees in a row that do not improve: there is nothing more to be had
MAX_UNITS = 200  # of a well; more are slower and hardly closer
FEWEST_PER_UNIT, MOST_PER_UNIT = 4, 12  # points: with fewer there are fewer units, and of more some are drawn
UNIT_WIDTHS = 2.0  # of random units: so many times more or less than the distance of the level
COVERAGE_TOLERANCE = 0.005  # share of the states by which two formulas hold at as many
MIN_EXPLAINED_ERROR = 1e-3  # a stated error above this is worth an explanation, and a search for a better V
HELD_OUT_STRIDE = 4  # every so manieth point is kept for choosing the degree


def local_well(
    dynamics: Dynamics, portrait: PhasePortrait, index: int, *, options: RefinementOptions, seed: int = 0,
    saddle: Equilibrium | Cycle | None = None, path: MinimumActionPath | None = None,
) -> Well:  # fmt: skip
    """V about one attractor, of the lowest degree that no other betters by much.

    Parameters
    ----------
    dynamics, portrait, index
        f and D, their attractors, saddles and basins, and which attractor.
    options, seed
        Degrees, reach and tolerance; and what decides which points are used where there are too many.
    saddle, path
        The lowest saddle, or bounding cycle, and the path of least action to it, where that has told V there
        before, as it does for given equations.

    Raises
    ------
    NumericalFailure
        When no degree gives a formula.
    """
    attractor, basin = portrait.attractors[index], portrait.basins[index]
    saddles = portrait.saddles[index] if saddle is None else [saddle]
    depth = None if path is None else float(path.values[-1]) / 2
    rows = np.arange(len(basin.chosen))
    kept = rows[rows % HELD_OUT_STRIDE != 0]
    wells: list[Well] = []
    failure, idle = NumericalFailure(""), 0
    for degree in options.degrees:
        if degree > options.degrees[0] and affordable_degree(dynamics.dimension, degree) < degree:
            break
        generator = np.random.default_rng(seed)
        try:
            if depth is None or not wells:
                well = _grow_well(
                    dynamics, attractor, basin, saddles, degree=degree, generator=generator, depth=depth
                )
            else:  # the same formula in powers up to a higher degree; the lower ones come first
                well, old = wells[-1], wells[-1].basis
                basis = PowerBasis.up_to(degree, old.symbols, old.center, old.scale)
                coefficients = np.pad(well.coefficients, (0, basis.size - old.size))
                well = replace(well, basis=basis, coefficients=coefficients)
            if depth is not None:
                told = {"goal": options.reach * depth, "rows": kept, "path": path, "generator": generator}
                start, well = well, _extend_well(well, basin, **told)
                if wells and not well.residual < RUNAWAY_RATIO * wells[-1].residual:
                    again = _extend_well(start, basin, by_path=False, **told)  # by the path it began far off
                    well = min(well, again, key=lambda one: one.residual)
        except NumericalFailure as error:  # of one degree: another may do
            failure = error
            continue
        if depth is not None and wells and not well.residual < wells[-1].residual:
            idle += 1
            if idle == MAX_IDLE_DEGREES or not well.residual < RUNAWAY_RATIO * wells[-1].residual:
                break
            continue
        wells.append(well)
        idle = 0
        if well.residual < options.accuracy:
            break
    if not wells:
        raise failure
    if depth is None:
        # No formula tells V of the saddle as well as the finest does.
        goal = options.reach * wells[-1].level
        taken = [_extend_well(well, basin, goal=goal, rows=kept) for well in wells]  # some may run away
        wells = [new if new.level > 0 else old for new, old in zip(taken, wells, strict=True)]
    elsewhere = portrait.states_elsewhere(index)
    wells = [replace(well, tolerance=options.tolerance, elsewhere=elsewhere) for well in wells]
    x = basin.points(rows[rows % HELD_OUT_STRIDE == 0])
    reached = [well.reaches(x) for well in wells]
    most = max(int(mask.sum()) for mask in reached)
    trials = []
    for well, mask in zip(wells, reached, strict=True):
        residual = well.residual_at(x[mask])
        covered = int((residual <= well.tolerance).sum()) / max(most, 1)
        median = float(np.median(residual)) if len(residual) else np.inf
        trials.append(DegreeTrial(well.degree, well.basis.size, median, covered))
    well = replace(wells[best_trial(trials)], trials=tuple(trials))
    if options.about == "powers" or (options.about == "auto" and well.residual < options.accuracy):
        return well

    def stated(well: Well) -> tuple[float, float]:
        """The error that its residual leaves open below the saddle, and at which share it claims to hold."""
        below = x[(well.values(x) < LEVEL_SHARE * well.level) & well.reaches(x)]
        known = below[well.believed(below)]
        if len(known) < MIN_POINTS:
            return np.inf, 0.0
        candidate = Candidate(well.values, well.gradients, well.hessians, None, known, [attractor])
        return candidate.stated_error(dynamics, seed=seed), len(known) / len(below)

    left, claimed = (np.inf, 0.0) if options.about == "units" else stated(well)
    if left > MIN_EXPLAINED_ERROR:
        with contextlib.suppress(NumericalFailure, np.linalg.LinAlgError):  # powers stay
            other = _over_units(well, basin, kept, path, np.random.default_rng(seed))
            its, share = stated(other)
            if its < left and share >= claimed - COVERAGE_TOLERANCE:
                return replace(other, instead=None if options.about == "units" else well)
    return well


def _over_units(
    well: Well, basin: Basin, rows: np.ndarray, path: MinimumActionPath | None, draw: np.random.Generator
) -> Well:
    """V about an attractor over random tanh units, from a formula in powers that does not follow it.

    ``½ (x - A)·M (x - A)`` stays. Units, whose directions are drawn alike in the metric of M, begin with ∇V
    of the formula at that half of its points where it solves the Hamilton–Jacobi equation best, and are taken
    on from there as powers are.
    """
    residual, d = well.residual_at(well.points), len(well.attractor)
    x = well.points[residual <= np.median(residual)]
    count = min(MAX_UNITS, len(x) // FEWEST_PER_UNIT)
    metric = np.linalg.cholesky(hessian_at(well.dynamics, well.attractor)) / np.sqrt(2 * well.level)
    widths = UNIT_WIDTHS ** draw.uniform(-1, 1, count)
    directions = draw.normal(size=(count, d)) / np.sqrt(d) / widths[:, None] @ metric.T
    middles = well.points[draw.choice(len(well.points), count)] - well.attractor
    units = np.column_stack([directions * well.basis.scale, -(directions * middles).sum(axis=1)])
    basis = replace(PowerBasis.up_to(2, well.basis.symbols, well.attractor, well.basis.scale), units=units)
    start = np.where(basis.free, 0.0, np.resize(well.coefficients, basis.size))  # quadratic powers come first
    found, first = replace(well, basis=basis, coefficients=start), float(np.median(well.values(x)))
    found = replace(found, coefficients=_with_slopes(found, x, well))
    return _extend_well(found, basin, goal=well.reach, rows=rows, path=path, generator=draw, first=first)


def best_trial(trials: Sequence[DegreeTrial]) -> int:
    """Index of the first trial whose coverage and residual no other betters by much."""
    coverage = max(trial.covered for trial in trials)
    good = [index for index, trial in enumerate(trials) if trial.covered >= coverage - COVERAGE_TOLERANCE]
    finest = min(trials[index].residual for index in good)
    return next(index for index in good if trials[index].residual <= max(2 * finest, MIN_OUTLIER_RESIDUAL))


def _grow_well(
    dynamics: Dynamics, attractor: Equilibrium, basin: Basin, saddles: Sequence[Equilibrium | Cycle], *,
    degree: int, generator: np.random.Generator, depth: float | None = None,
) -> Well:  # fmt: skip
    """V about an attractor up to the lowest of the saddles, from M outwards; `depth` is V there, if known."""
    hessian = hessian_at(dynamics, attractor.position)
    extent = np.sqrt(np.diag(np.linalg.inv(hessian)))
    flat = basin.states.reshape(-1, basin.states.shape[2])
    offsets = flat - attractor.position
    quadratic = 0.5 * np.einsum("ni,ij,nj->n", offsets, hessian, offsets).reshape(basin.states.shape[:2])
    size = np.quantile(quadratic[:, 0], 0.5) if depth is None else depth
    basis = PowerBasis.up_to(degree, dynamics.symbols, attractor.position, extent * np.sqrt(2 * size))
    free, coefficients = basis.free, np.zeros(basis.size)
    i, j = np.array([np.repeat(np.arange(len(extent)), row) for row in basis.exponents[~free]]).T
    coefficients[~free] = np.where(i == j, 0.5, 1.0) * hessian[i, j] * basis.scale[i] * basis.scale[j]
    values = basis.values(flat) @ coefficients
    # The first level has points enough for all coefficients.
    reached = np.sort(basin.highest(values.reshape(basin.states.shape[:2]))[tuple(basin.chosen.T)])
    level = float(reached[min(4 * basis.size, len(reached) - 1)])
    if depth is not None:  # low, but with as many points as a fit needs
        enough = float(reached[min(2 * basis.size, len(reached) - 1)])
        level = min(level, max(FIRST_LEVEL_SHARE * depth, min(enough, depth / 2)))
    return grown(
        dynamics, basin, saddles, basis, coefficients, free=free, metric=hessian, level=level,
        fitted=np.zeros(0, dtype=int), generator=generator, depth=depth,
    )  # fmt: skip


def grown(
    dynamics: Dynamics, basin: Basin, saddles: Sequence[Equilibrium | Cycle], basis: PowerBasis,
    coefficients: np.ndarray, *, free: np.ndarray, metric: np.ndarray, level: float, fitted: np.ndarray,
    generator: np.random.Generator, depth: float | None = None, damping: float = 0.0, steps: int = 40,
) -> Well:  # fmt: skip
    """V grown from a start, level by level, to its lowest saddle or to the end of the recorded region.

    `metric` is the curvature of V at the attractor, in which distances are measured; `fitted` has the rows of
    ``basin.chosen`` on which the start was fitted. The damping is that of Gauss–Newton, and `steps` how many
    it takes at most where the well ends.
    """
    attractor = basis.center
    place = f"the attractor near {attractor.round(4)}"
    flat = basin.states.reshape(-1, len(attractor))
    functions, width = basis.values(flat), np.ptp(flat, axis=0)
    tops = np.array([one.position for one in saddles]).reshape(-1, len(attractor))
    at_tops = basis.values(tops)

    def along(current: np.ndarray) -> np.ndarray:
        return (functions @ current).reshape(basin.states.shape[:2])

    def close(points: np.ndarray) -> np.ndarray:
        """Mask of the saddles that points of a fit have reached."""
        return np.array([np.abs((points - top) / width).max(axis=1).min() for top in tops]) < SADDLE_DISTANCE

    values = along(coefficients)
    residual, points, last, recorded = np.inf, np.zeros((0, len(attractor))), False, 0.0
    places = basin.points(np.arange(len(basin.chosen))) @ np.linalg.cholesky(metric)
    spacing = cKDTree(places).query(places, k=2)[0][:, 1]
    ends: list[float] = []
    for _ in range(MAX_ROUNDS):
        rows, before = basin.below(values, level), len(fitted)
        if before:  # far from the last fit V is an extrapolation, and may be low by mistake
            away = cKDTree(places[fitted]).query(places[rows])[0]
            rows = rows[away < POINT_REACH * np.sqrt(2 * level) + 2 * spacing[rows]]
        fitted = rows
        if len(rows) > MAX_POINTS:
            rows = np.sort(generator.choice(rows, MAX_POINTS, replace=False))
        points = basin.points(rows)
        if len(points) < 2 * basis.size:
            if not before:
                raise NumericalFailure(f"only {len(points)} states lead to {place}")
            raise NumericalFailure(
                f"V about {place} leaves the states: it came from {before} to {len(points)} and"
                f" needs {2 * basis.size}"
            )
        equation = HamiltonJacobi.at(basis, points, dynamics, attractor=attractor)
        most, tolerance = (steps, 1e-13) if last else (8, COARSE_TOLERANCE)
        coefficients, residual = equation.gauss_newton(
            coefficients, free=free, steps=most, tolerance=tolerance, damping=damping
        )
        values = along(coefficients)
        # Of one state whatever lies below its highest start lies on the way down from it.
        recorded = float(np.quantile(basin.starts(values), RECORDED_QUANTILE if len(attractor) > 1 else 1.0))
        # Far from the points of the fit V is an extrapolation: a saddle that seems to lie lower than points
        # already reached does not count, unless they are close to it.
        heights = at_tops @ coefficients
        believed = (heights > (1 - SADDLE_TOLERANCE) * level) | close(points)
        limit = depth or min(float(heights[believed & (heights > 0)].min(initial=np.inf)), recorded)
        settled = last and abs(limit - level) < LEVEL_TOLERANCE * level
        if settled and len(fitted) <= (1 + LEVEL_TOLERANCE) * before:
            break
        if any(abs(limit - one) < REPEAT_TOLERANCE * level for one in ends):  # from here on in circles
            break
        if last:
            ends.append(level)
        last = LEVEL_GROWTH * level >= limit
        level = limit if last else LEVEL_GROWTH * level
    saddle = None
    if depth is not None:
        saddle = tops[0] if level == depth and residual < MAX_RESIDUAL else None
    elif len(tops):
        heights = at_tops @ coefficients
        nearest = int(np.argmin(np.abs(heights - level)))
        if abs(heights[nearest] - level) < (4 if close(points)[nearest] else 1) * SADDLE_TOLERANCE * level:
            saddle, level = tops[nearest], float(heights[nearest])
    # A V that vanishes is a solution too, and the end of what starts far from any other.
    short = saddle is None and level < (1 - LEVEL_TOLERANCE) * recorded
    if short or not (np.isfinite(residual) and level > 0):
        raise NumericalFailure(f"{basis.title} do not follow V from {place} up to a saddle")
    return Well(basis, coefficients, dynamics, attractor, level, saddle, residual, points)


def _extend_well(
    well: Well, basin: Basin, *, goal: float, rows: np.ndarray | None = None,
    path: MinimumActionPath | None = None, generator: np.random.Generator | None = None,
    by_path: bool = True, first: float | None = None,
) -> Well:  # fmt: skip
    """Take a formula on, from its well to a higher level `goal`, by robust fits of the equation.

    Only states that lead to the attractor are asked: across the ridge another well begins. Where the path to
    the saddle is known the formula may be one of lower powers in a basis of higher ones, and begins with ∇V
    along it. `first` is the level of the first fit, by default a little below that of the well.
    """
    allowed = np.arange(len(basin.chosen)) if rows is None else rows
    functions = well.basis.values(basin.states.reshape(-1, basin.states.shape[2]))
    shape, free = basin.states.shape[:2], well.basis.free
    coefficients, level = well.coefficients, min(0.9 * well.level if first is None else first, goal)
    with_units = len(well.basis.units) > 0
    options, rounds = (FIT_TO_KNOWN_DEPTH, 3) if with_units or path is not None else (ROBUST_FIT, 4)
    if path is not None:
        metric = np.linalg.cholesky(hessian_at(well.dynamics, well.attractor))
        places = basin.points(np.arange(len(basin.chosen))) @ metric
        lower = (functions @ coefficients).reshape(shape)
        fitted = basin.below(lower, level)
        # Where the well narrows towards its saddle, V in lower powers may be far off, and few states below.
        distance, nearest = cKDTree(path.points @ metric).query(places)
        near = distance < PATH_DISTANCE * np.sqrt(path.values[-1])
        beside = np.where(near, path.values[nearest] / 2, np.inf)
        if by_path:
            coefficients = _with_slopes(well, basin.points(fitted), well, path)
    while True:
        chosen = basin.below((functions @ coefficients).reshape(shape), level)
        if path is not None:
            chosen = np.intersect1d(chosen, basin.below(lower, RUNAWAY_LEVEL * level))
            if len(fitted) and len(chosen):
                away = cKDTree(places[fitted]).query(places[chosen])[0]
                chosen = chosen[away < POINT_REACH * np.sqrt(2 * level)]
            fitted = chosen = np.union1d(chosen, np.flatnonzero(beside < level))
        chosen = used = np.intersect1d(chosen, allowed)
        most = MOST_PER_UNIT * well.basis.size if with_units else MAX_POINTS_TO_KNOWN_DEPTH
        if generator is not None and len(used) > most:
            used = np.sort(generator.choice(used, most, replace=False))
        if len(used) < (1 if path is None else 2 * well.basis.size):
            raise NumericalFailure(
                f"V about the attractor near {well.attractor.round(4)} is told by {len(used)} states alone"
            )
        equation = HamiltonJacobi.at(well.basis, basin.points(used), well.dynamics, attractor=well.attractor)
        # On the way up one round keeps the formula close enough to be taken further.
        last = level >= goal
        coefficients = equation.robust_fit(coefficients, free, rounds=rounds if last else 1, **options)
        if last:
            break
        level = min(goal, (ROBUST_GROWTH**2 if with_units else ROBUST_GROWTH) * level)
    residual = float(np.median(equation.relative_residuals(coefficients)))
    if path is not None and not np.isfinite(residual):
        raise NumericalFailure(f"powers of degree {well.degree} do not follow V to its saddle")
    top = well.level if path is None else float(path.values[-1]) / 2
    if path is None and well.saddle is not None:
        # A formula that goes on smoothly behind a kink is above V, never below.
        top = min(top, float(well.basis.values(well.saddle[None])[0] @ coefficients))
    return replace(
        well, coefficients=coefficients, level=top, reach=goal, residual=residual, points=basin.points(chosen)
    )


def _with_slopes(well: Well, x: np.ndarray, other: Well, path: MinimumActionPath | None = None) -> np.ndarray:
    """A start: coefficients with the ∇V of another formula at points, and with that along a path."""
    if not len(x):
        return well.coefficients
    noise, free, slopes = measure_at(well.dynamics, well.attractor), well.basis.free, other.gradients(x)
    steep = np.sqrt(noise.contract(x, slopes))
    parts = [(x, slopes, 1 / np.maximum(steep, np.median(steep)))]
    if path is not None:
        depth = path.values[-1]
        rising = (path.values > PATH_FROM * depth) & (path.values < PATH_TO * depth)
        where, momenta = path.points[rising], path.momenta[rising]
        weight = np.sqrt(len(x) / max(len(where), 1)) / np.sqrt(noise.contract(where, momenta))
        parts.insert(0, (where, momenta, weight))
    rows, rest = [], []
    for points, gradients, weight in parts:
        root, along = noise.root_at(points), well.basis.gradients(points)
        rows.append(np.einsum("n,nij,nim->njm", weight, root, along[:, :, free], optimize=True))
        rest.append(np.einsum("n,nij,ni->nj", weight, root, gradients - along @ well.coefficients).ravel())
    matrix = np.concatenate([one.reshape(-1, one.shape[2]) for one in rows])
    scale = positive(np.linalg.norm(matrix, axis=0))
    coefficients = well.coefficients.copy()
    solution = np.linalg.lstsq(matrix / scale, np.concatenate(rest), rcond=SINGULAR_RATIO)[0]
    coefficients[free] += solution / scale
    return coefficients
