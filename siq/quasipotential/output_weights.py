"""The decomposition over one hidden layer of random tanh units, of which the output weights are solved for.

A short training of the two networks (paper, section 2.2) leaves V far from exact, but on the right branch of
the Hamilton–Jacobi equation ``∇V·(f + D∇V) = 0``. From there on no steps of descent are needed. Over hidden
units that are drawn at random and stay as they are (random features; Rahimi and Recht 2007, NeurIPS 20) f is
linear in the output weights, and follows from the pairs by least squares; the equation is quadratic in those
of V, and a few steps of Gauss–Newton end where it holds; ``g = f + D∇V`` is linear
again. What comes out are networks of the paper's form, ``V = η_v (V^NN(y) + |y|²)``, with one hidden layer.

Neither the Hessian of V at the attractors nor an f that is identified elsewhere takes part. Whether the
branch is the right one is asked where f comes to rest: about an attractor A the quasipotential has
``∂f(A) + 2D ∂²V(A)`` with the eigenvalues of ``-∂f(A)ᵀ``, so that paths of least action leave it. On a false
branch, where V is flat along a direction, some of them do not.

Where V has a kink between wells no single set of weights follows it, and no training leads to one. V is then
solved for about each attractor, without trained networks: Newton's method on the residual is policy iteration
(Kleinman 1968, IEEE Trans. Autom. Control 13), and from any multiple of ``|x - A|²`` from which all paths of
least action leave A it leads to the right branch. The well grows outwards as in the local route
(`siq.quasipotential.wells`). The identified f tells which states lead to which attractor, and nothing else.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import scipy.linalg

from siq.data.recordings import SnapshotPairs
from siq.errors import NumericalFailure
from siq.inference.field_estimate import FieldEstimate
from siq.networks.decomposition import NetworksByWell, TrainedNetworks
from siq.numerics.integration import runge_kutta_step
from siq.quasipotential.certificate_tests import LEVEL_SHARE
from siq.quasipotential.global_formula import heights_of_attractors
from siq.quasipotential.hamilton_jacobi import HamiltonJacobi, PowerBasis
from siq.quasipotential.wells import Well, grown
from siq.systems.basins import STARTS_NEAR_ATTRACTOR, Basin, basin_of
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics
from siq.systems.equilibria import find_equilibria, hessian_at
from siq.systems.phase_portrait import LEVEL_BEYOND_SADDLE, PhasePortrait, evenly_spread, phase_portrait

if TYPE_CHECKING:  # needs torch, which the mathematics does without
    from siq.networks.training import TrainingData

logger = logging.getLogger(__name__)

SPREADS = (0.1, 0.2, 0.4, 0.8)  # of the units' weights on normalised states; the held-out pairs choose
CORRECTIONS = 3  # of f, for the integrator's error; each gains about two digits
SINGULAR_RATIO = 1e-12  # damping of least squares: combinations of units that the points leave open
# With noise in the pairs, which the error on held-out pairs shows, all of them take part, and held-out pairs
# choose the damping. Tried on the paper's noisy system, with 50 to 400 units.
NOISY_ERROR = 0.01  # held-out error of f, relative to the mean velocities
DAMPINGS = (1e-5, 1e-4, 1e-3)
SLOW_SHARE = 0.04  # of the points, by their speed: below it residuals are not divided by the speed alone
RIDGE = 1e-8  # of the mean square gradient of a unit: how far the start may be from the networks' own V
POINTS_PER_UNIT = 10  # representative pairs that are used, at most
STARTS = 100  # points, the slowest among them, from which fixed points of f are sought
# Measured on the paper's archetypal system in three dimensions, in 50 runs and some trials before them.
STEPS = 25  # of Gauss–Newton; a right start takes about ten
MAX_RESIDUAL = 1e-3  # median of |∇V·(f + D∇V)|/(|∇V||f|): about 1e-5 on the right branch
MAX_START_RESIDUAL = 0.1  # the same, above which no other units would help: the start leads nowhere
# Of the slowest rate of approach, how fast paths of least action leave: 1 on the right branch, -1 where V is
# flat along that direction, and in between a choice.
ESCAPE_SHARE = 0.5
# Chosen on the paper's resonator, and used as they are for the systems of the tests.
WELL_SPREAD = 1.0  # of the units of a well, on states divided by `WELL_SCALE`
WELL_SCALE = 0.6  # of the distance of the nearest saddle
FINER = 0.1  # of the spread, where V leaves too much of a residual: in many states units are to be smooth
WELL_DRAWS = 4  # of units, until some take V to the saddle
NEAREST_STATES = 10  # recorded ones: to the saddle has come what has one of those that lie nearest to it
GROWTH_STEPS = 8  # of Gauss–Newton on each level; the last fit comes afterwards
WELL_FIT: dict[str, Any] = {"rounds": 4, "finest": 1e-5, "steps": 8}
WELL_DAMPING = 1e-7  # of Gauss–Newton: keeps V from running away outside the points of a fit
WELL_REACH = 1.1  # of the level of a well: V beyond its saddle counts up to there
MAX_WELL_RESIDUAL = 0.01  # as `MAX_RESIDUAL`, below `LEVEL_SHARE` of the level: V is less smooth near saddles
STATES_PER_UNIT = 5  # in a well, at least: with fewer there are fewer units
STEEPER = 1.2  # a paraboloid, until all paths leave the attractor


@dataclass(frozen=True)
class _UnitBasis:
    """Random tanh units ``tanh(y W + b)`` and ``|y|²`` of normalised states ``y = (x - μ)/σ``."""

    weights: np.ndarray  #: W, shape ``(d, units)``
    biases: np.ndarray  #: b, shape ``(units,)``
    center: np.ndarray  #: μ, shape ``(d,)``
    scale: np.ndarray  #: σ, shape ``(d,)``
    #: Whether each function has no slope at μ either, as V has none at an attractor. Then the first d units
    #: take up that of each other one, and are no functions of their own.
    flat: bool = False

    def hidden(self, x: np.ndarray) -> np.ndarray:
        """The units alone, shape ``(n, units)``."""
        return np.tanh(self._normalised(x) @ self.weights + self.biases)

    @property
    def size(self) -> int:
        """Number of functions, the units and the square."""
        return len(self.biases) + 1 - len(self._taken)

    @property
    def title(self) -> str:
        """The functions in words."""
        return f"{len(self.biases)} random units"

    def values(self, x: np.ndarray) -> np.ndarray:
        """Points ``(n, d)`` to functions ``(n, m)``, each of which is zero at μ."""
        square = (self._normalised(x) ** 2).sum(axis=1)
        return np.column_stack([self._functions(self.hidden(x) - np.tanh(self.biases)), square])

    def gradients(self, x: np.ndarray) -> np.ndarray:
        """Points ``(n, d)`` to gradients ``(n, d, m)``."""
        of_units = (1 - self.hidden(x) ** 2)[:, None] * (self.weights / self.scale[:, None])
        square = (2 * self._normalised(x) / self.scale)[:, :, None]
        return np.concatenate([self._functions(of_units), square], axis=2)

    def hessians(self, x: np.ndarray) -> np.ndarray:
        """Points ``(n, d)`` to Hessians ``(n, d, d, m)``."""
        hidden, slopes = self.hidden(x), self.weights / self.scale[:, None]
        of_units = (-2 * hidden * (1 - hidden**2))[:, None, None] * slopes[:, None] * slopes
        square = np.broadcast_to(np.diag(2 / self.scale**2)[:, :, None], (*of_units.shape[:3], 1))
        return np.concatenate([self._functions(of_units), square], axis=3)

    def design(self, x: np.ndarray) -> np.ndarray:
        """Functions for f, ``[tanh(y W + b), 1, y]``: points ``(n, d)`` to ``(n, units + 1 + d)``."""
        return np.column_stack([self.hidden(x), np.ones(len(x)), self._normalised(x)])

    def of_units(self, coefficients: np.ndarray) -> np.ndarray:
        """The weights of the units, shape ``(units,)``, in a sum of the functions."""
        return np.concatenate([-self._taken @ coefficients[:-1], coefficients[:-1]])

    def _functions(self, of_units: np.ndarray) -> np.ndarray:
        """Functions ``(..., m - 1)`` of units ``(..., units)``."""
        first = len(self._taken)
        return of_units[..., first:] - of_units[..., :first] @ self._taken if first else of_units

    @cached_property
    def _taken(self) -> np.ndarray:
        """How much of each other unit the first ones take up, shape ``(d, units - d)``; ``(0, units)``."""
        d = len(self.weights) if self.flat else 0
        slopes = self.weights * (1 - np.tanh(self.biases) ** 2)
        return np.linalg.solve(slopes[:d, :d], slopes[:d, d:])

    def _normalised(self, x: np.ndarray) -> np.ndarray:
        return (x - self.center) / self.scale


class OutputWeights:
    """The output weights of one run, solved for from where its networks have come.

    Parameters
    ----------
    data
        The pairs of the run.
    diffusion
        D, constant.
    units
        Number of units.
    generator
        Draws the units, and the points where there are too many.
    found
        The identified f, which tells the wells apart where they are solved for one by one; None for none.
    """

    def __init__(
        self, data: TrainingData, *, diffusion: Diffusion, units: int, generator: np.random.Generator,
        found: FieldEstimate | None = None,
    ) -> None:  # fmt: skip
        self.diffusion, self.units, self.generator, self.found = diffusion, units, generator, found
        most = POINTS_PER_UNIT * units
        pairs, others = (
            part
            if len(part.h) <= most
            else part.take(np.sort(generator.choice(len(part.h), most, replace=False)))
            for part in (data.representative, data.held_out)
        )
        self.points = pairs.x0
        weights = generator.normal(size=(self.points.shape[1], units))
        biases = generator.uniform(-2, 2, units)
        mean, width = self.points.mean(axis=0), self.points.std(axis=0)
        bases = [_UnitBasis(one * weights, one * biases, mean, width) for one in SPREADS]
        # Without noise the evenly spread pairs are enough.
        self._fit_field(bases, pairs, others, noisy=False)
        if self.field_error > NOISY_ERROR:
            self._fit_field(bases, data.training, data.held_out, noisy=True)
        # V is sought over the units that suit f; if they follow it badly, over those of another spread.
        self._bases = [self.basis, *(one for one in bases if one is not self.basis)]
        self._flow = self.drift(self.points)
        self.squared_speed = diffusion.squared_speed(self.points, self._flow)

    def _fit_field(
        self, bases: Sequence[_UnitBasis], pairs: SnapshotPairs, held_out: SnapshotPairs, *, noisy: bool
    ) -> None:
        """f over the units, and with the damping, that suit held-out pairs best, and how uncertain it is."""
        velocity, observed = ((each.xh - each.x0) / each.h[:, None] for each in (pairs, held_out))
        self.field_error = np.inf

        def corrected(
            basis: _UnitBasis, problem: _LeastSquares, coefficients: np.ndarray, damping: float
        ) -> np.ndarray:
            """Coefficients after deferred corrections of what the integrator is off by."""
            for _ in range(CORRECTIONS):
                rest = velocity - _mean_velocity(basis, coefficients, pairs.x0, pairs.h)
                coefficients = coefficients + problem.solve(rest, damping)
            return coefficients

        for basis in bases:
            problem = _LeastSquares(basis.design(pairs.x0))
            at_held_out = basis.design(held_out.x0) if noisy else None
            for damping in DAMPINGS if noisy else (SINGULAR_RATIO,):
                coefficients = problem.solve(velocity, damping)
                if at_held_out is not None:  # the integrator's error is the same for all, and below the noise
                    rest = observed - at_held_out @ coefficients
                else:
                    coefficients = corrected(basis, problem, coefficients, damping)
                    rest = observed - _mean_velocity(basis, coefficients, held_out.x0, held_out.h)
                error = float(np.sqrt((rest**2).sum() / (observed**2).sum()))
                logger.info("damped by %g: held-out error of f %.2e", damping, error)
                if error < self.field_error:
                    self.field_error, self.basis, self.coefficients = error, basis, coefficients
                    best, unexplained = (problem, damping), rest
        if noisy:
            self.coefficients = corrected(self.basis, best[0], self.coefficients, best[1])
        # The standard error of f at the points, of independent errors in the velocities, as a share of f.
        spread = ((self.basis.design(self.points) @ best[0].inverse(best[1])) ** 2).sum(axis=1).mean()
        size = (self.drift(self.points) ** 2).sum(axis=1).mean()
        self.uncertainty = float(np.sqrt(spread * (unexplained**2).mean(axis=0).sum() / size))
        logger.info("f is uncertain by %.1e of itself", self.uncertainty)

    def drift(self, x: np.ndarray) -> np.ndarray:
        """f at points ``(n, d)``, shape ``(n, d)``."""
        return self.basis.design(x) @ self.coefficients

    def jacobian(self, x: np.ndarray) -> np.ndarray:
        """∂f_i/∂x_j at points ``(n, d)``, shape ``(n, d, d)``."""
        units = len(self.basis.biases)
        slopes = self.basis.gradients(x)[:, :, :units] @ self.coefficients[:units]
        return np.swapaxes(slopes + self.coefficients[units + 1 :] / self.basis.scale[:, None], 1, 2)

    def hopeless(self) -> str | None:
        """Why no networks can lead to a solution, in words; None where they can."""
        if not self.field_error < 1:
            return (
                "f over random units is as far from the held-out pairs as no f at all; record with less"
                " noise, or write 'training: {check: null}'"
            )
        if not self._attractors:
            return (
                "f over random units comes to rest nowhere within the recorded states, so that the branch of"
                " V cannot be tested; write 'training: {check: null}'"
            )
        return None

    def accepted(self, networks: TrainedNetworks) -> TrainedNetworks | None:
        """Networks with the output weights solved for; None where they lead to a false branch, or cannot."""
        if self.hopeless() is not None:
            return None
        _, circulatory, vector_field = networks.evaluate(self.points)
        slopes = (circulatory - vector_field) @ self.diffusion.precision
        if not np.isfinite(slopes).all():  # of a training whose loss was lost
            return None
        steepness = float(networks.potential_scale[0, 0])
        # Where f vanishes so does what is divided by its speed; about fixed points everything counts alike.
        weight = 1 / (self.squared_speed + np.quantile(self.squared_speed, SLOW_SHARE))
        for basis in self._bases:
            # V over the units as the networks have it, by its gradient; |y|² keeps the weight that it has.
            gradients = basis.gradients(self.points)
            equation = HamiltonJacobi(
                self.points, gradients, self._flow, self.diffusion, weight, self.diffusion
            )
            n, d, m = equation.gradients.shape
            flat = equation.gradients.reshape(n * d, m)
            units, rest = flat[:, :-1], slopes.ravel() - steepness * flat[:, -1]
            start = np.linalg.solve(units.T @ units + RIDGE * n * np.eye(m - 1), units.T @ rest)
            weights = equation.robust_fit(
                np.append(start, steepness), np.arange(m) < m - 1,
                rounds=1, finest=np.inf, steps=STEPS, orthonormal=True,
            )  # fmt: skip
            unweighted = replace(equation, weight=1 / np.sqrt(self.squared_speed))
            residual = float(np.median(unweighted.relative_residuals(weights)))
            logger.info("output weights: median Hamilton–Jacobi residual %.1e", residual)
            if not residual < MAX_START_RESIDUAL:
                return None
            if residual < max(MAX_RESIDUAL, self.uncertainty):
                leaving = all(self._leaves(one, basis, weights) for one in self._attractors)
                return self._networks(basis, weights, self.points) if leaving else None
        return None

    def by_wells(self) -> NetworksByWell | None:
        """Networks about each attractor of the identified f; None where some well has no solution."""
        if self.found is None or self.hopeless() is not None:
            return None
        states = self.points[evenly_spread(self.points, generator=self.generator)]
        portrait = phase_portrait(self.found.dynamics, states)
        count = len(portrait.attractors)
        if portrait.fault() is not None or not count:
            return None
        portrait = replace(portrait, basins=tuple(self._basin(portrait, one) for one in range(count)))
        barriers, levels, parts, places, known = np.full((count, count), np.inf), [], [], [], []
        for index, generator in enumerate(self.generator.spawn(count)):
            try:
                well = self._well(portrait, index, generator)
            except NumericalFailure as failure:
                logger.info("%s", failure)
                return None
            basis, basin = cast(_UnitBasis, well.basis), portrait.basins[index]
            if not self._leaves(well.attractor, basis, well.coefficients):
                return None
            saddle = well.saddle
            for other in range(count) if saddle is not None else ():
                if any(
                    np.array_equal(cast(np.ndarray, saddle), one.position) for one in portrait.saddles[other]
                ):
                    barriers[index, other] = well.level
            x = basin.points(np.arange(len(basin.chosen)))
            parts.append(self._networks(basis, well.coefficients, well.points))
            levels.append(well.level)
            places.append(x)
            known.append(np.where(well.reaches(x), index, NetworksByWell.NOWHERE))
        np.fill_diagonal(barriers, np.inf)
        try:
            heights = heights_of_attractors(barriers)
        except NumericalFailure:  # wells that their lowest saddles do not connect stand side by side
            heights = np.zeros(count)
        joined = np.concatenate(places), np.concatenate(known)
        return NetworksByWell(tuple(parts), heights, np.array(levels), *joined)

    def _basin(self, portrait: PhasePortrait, index: int) -> Basin:
        """What leads to an attractor, with more states about it where few lie in its well."""
        assert self.found is not None
        attractor, basin = portrait.attractors[index].position, portrait.basins[index]
        x = np.array([one.position for one in portrait.saddles[index]]).reshape(-1, len(attractor))
        offsets = np.concatenate([x, basin.points(np.arange(len(basin.chosen)))]) - attractor
        heights = np.einsum("ni,ij,nj->n", offsets, hessian_at(self.found.dynamics, attractor), offsets) / 2
        level = LEVEL_BEYOND_SADDLE * float(heights[: len(x)].min(initial=np.inf))
        if not len(x) or (heights[len(x) :] < level).sum() >= STATES_PER_UNIT * self.units:
            return basin
        return basin_of(
            self.found.dynamics, portrait.descents, index, portrait.attractors,
            box=portrait.box, generator=self.generator, near=(STARTS_NEAR_ATTRACTOR, level),
        )  # fmt: skip

    def _well(self, portrait: PhasePortrait, index: int, generator: np.random.Generator) -> Well:
        """V about an attractor, of the first units that take it to a saddle, or that end closest to one."""
        basin, saddles = portrait.basins[index], portrait.saddles[index]
        made: dict[float, Well] = {}
        failure, spread, width = NumericalFailure("no units were drawn"), WELL_SPREAD, portrait.box @ [-1, 1]

        def distances(x: np.ndarray) -> np.ndarray:
            """How far states lie from each saddle, in order: shape ``(saddles, n)``."""
            places = np.array([one.position for one in saddles]).reshape(-1, 1, x.shape[1])
            return np.sort(np.abs((x - places) / width).max(axis=2), axis=1)

        near = distances(basin.points(np.arange(len(basin.chosen))))[:, :NEAREST_STATES][:, -1]
        for _ in range(WELL_DRAWS):
            try:
                well = self._well_of_draw(portrait, index, generator, spread)
                x = well.inside(LEVEL_SHARE)
                residual = float(np.median(well.residual_at(x))) if len(x) else np.inf
                logger.info("about %s: V up to %.4g, residual %.1e", well.attractor, well.level, residual)
                if not residual < max(MAX_WELL_RESIDUAL, self.uncertainty):
                    raise NumericalFailure(f"V leaves a residual of {residual:.1g}")
            except NumericalFailure as error:
                failure, spread = error, FINER * spread
                continue
            # Extrapolated, V may seem to be as low at a saddle as where the well ends, far from it. Two draws
            # that end at the same state end where recordings do.
            away = distances(well.points)[:, 0]
            closest, reached = float(away.min(initial=np.inf)), bool((away <= near).any())
            done = reached or closest in made or not saddles
            made.setdefault(closest, well if reached else replace(well, saddle=None))
            if done:
                break
        if not made:
            raise failure
        return made[min(made)]

    def _well_of_draw(
        self, portrait: PhasePortrait, index: int, generator: np.random.Generator, spread: float
    ) -> Well:
        """V about an attractor over units of its own, grown from the square ``|y|²`` of offsets from it."""
        attractor, basin = portrait.attractors[index].position, portrait.basins[index]
        saddles, width = portrait.saddles[index], np.ptp(portrait.box, axis=1)
        flat, shape = basin.states.reshape(-1, len(attractor)), basin.states.shape[:2]
        tops = [one.position for one in saddles]
        places = np.array(tops) if tops else basin.states[:, 0]
        distance = np.linalg.norm((places - attractor) / width, axis=1)
        scale = WELL_SCALE * (distance.min() if tops else np.median(distance)) * width
        units = min(self.units, len(basin.chosen) // STATES_PER_UNIT)
        weights = spread * generator.normal(size=(len(attractor), units))
        biases = spread * generator.uniform(-2, 2, units)
        # Those whose slopes span all directions best come first.
        order = scipy.linalg.qr(weights * (1 - np.tanh(biases) ** 2), mode="r", pivoting=True)[1]
        basis = _UnitBasis(weights[:, order], biases[order], attractor, scale, flat=True)
        coefficients = np.zeros(basis.size)
        slope = self.jacobian(attractor[None])[0]
        square = 2 * self.diffusion.matrix @ np.diag(2 / scale**2)
        approach = -np.linalg.eigvals(slope).real.max()
        coefficients[-1] = approach / np.linalg.eigvals(square).real.max()
        while np.linalg.eigvals(slope + coefficients[-1] * square).real.min() < approach:
            coefficients[-1] *= STEEPER
        values = (coefficients[-1] * (((flat - attractor) / scale) ** 2).sum(axis=1)).reshape(shape)
        heights = np.sort(basin.highest(values)[tuple(basin.chosen.T)])
        free = np.arange(basis.size) < basis.size - 1
        # What a well is grown with has the methods that these types are asked for.
        field, functions = cast(Dynamics, self), cast(PowerBasis, basis)
        well = grown(
            field, basin, saddles, functions, coefficients,
            free=free, metric=np.diag(2 * coefficients[-1] / scale**2),
            level=float(heights[min(3 * basis.size, len(heights) - 1)]),
            fitted=np.zeros(0, dtype=int), generator=generator, damping=WELL_DAMPING, steps=GROWTH_STEPS,
        )  # fmt: skip
        # About its saddle V is hardly smooth. The last fit gives these points less weight.
        equation = HamiltonJacobi.at(functions, well.points, field, attractor=attractor)
        coefficients = equation.robust_fit(well.coefficients, free, damping=WELL_DAMPING, **WELL_FIT)
        level = well.level
        if well.saddle is not None:
            level = float(basis.values(well.saddle[None])[0] @ coefficients)
        return replace(well, coefficients=coefficients, level=level, reach=WELL_REACH * level)

    def _networks(self, basis: _UnitBasis, weights: np.ndarray, points: np.ndarray) -> TrainedNetworks:
        """V over units as a network, with one for g of the same units, fitted at points."""
        steepness, flow, of_units = float(weights[-1]), self.drift(points), basis.of_units(weights)
        circulatory = flow + self.diffusion.push(points, basis.gradients(points) @ weights)
        of_g = _LeastSquares(np.column_stack([basis.hidden(points), np.ones(len(points))])).solve(circulatory)
        layers = (basis.weights, basis.biases[None])
        lowest = -(np.tanh(basis.biases) @ of_units) / steepness  # V is zero at μ
        return TrainedNetworks(
            potential=(layers, (of_units[:, None] / steepness, np.full((1, 1), lowest))),
            circulatory=(layers, (of_g[:-1], of_g[-1:])), mean=basis.center[None], scale=basis.scale[None],
            potential_scale=np.array([[steepness]]), circulatory_scale=np.ones((1, 1)),
            diffusion=self.diffusion.matrix,
        )  # fmt: skip

    def _leaves(self, attractor: np.ndarray, basis: _UnitBasis, weights: np.ndarray) -> bool:
        """Whether paths of least action leave an attractor at which f comes to rest."""
        slope = self.jacobian(attractor[None])[0]
        curvature = basis.hessians(attractor[None])[0] @ weights
        leaving = float(np.linalg.eigvals(slope + 2 * self.diffusion.matrix @ curvature).real.min())
        approach = -float(np.linalg.eigvals(slope).real.max())
        logger.info(
            "about %s paths leave at rates of %.2g, f approaches at %.2g", attractor, leaving, approach
        )
        return leaving >= ESCAPE_SHARE * approach

    @cached_property
    def _attractors(self) -> list[np.ndarray]:
        """Stable fixed points of f within the recorded states."""
        starts = self.points[np.argsort(self.squared_speed)[:: max(len(self.points) // STARTS, 1)]]
        box = np.stack([self.points.min(axis=0), self.points.max(axis=0)], axis=1)
        found = find_equilibria(self, starts, box=box, margin=0.0)
        return [one.position for one in found if one.kind == "attractor"]


def formulas_by_well(networks: NetworksByWell, dynamics: Dynamics, *, degree: int) -> tuple[Well, ...]:
    """V of networks in powers about each attractor, up to a degree, by least squares.

    Nothing is refined: the formulas are as good as the networks. `dynamics` has the symbols, and the f and D
    of which a residual would be.
    """
    wells = []
    for part, rows in zip(networks.parts, networks.of_wells(networks.states), strict=True):
        x, attractor = networks.states[rows], part.mean[0]
        values = part.potential_at(x)
        basis = PowerBasis.up_to(degree, dynamics.symbols, attractor, np.abs(x - attractor).max(axis=0))
        functions = basis.values(x)
        coefficients = np.linalg.lstsq(functions, values, rcond=None)[0]
        level = float(values.max()) / WELL_REACH
        misfit = float(np.linalg.norm(functions @ coefficients - values) / np.linalg.norm(values))
        logger.info("about %s powers up to %d miss the networks by %.1e", attractor, degree, misfit)
        wells.append(Well(basis, coefficients, dynamics, attractor, level, None, misfit, x))
    return tuple(wells)


class _LeastSquares:
    """Least squares with one matrix ``(n, m)`` and many right-hand sides, damped where it is singular."""

    def __init__(self, matrix: np.ndarray) -> None:
        self.q, upper = np.linalg.qr(matrix)
        self.left, self.sizes, self.right = np.linalg.svd(upper, full_matrices=False)

    def solve(self, right: np.ndarray, damping: float = SINGULAR_RATIO) -> np.ndarray:
        """Coefficients ``(m, s)`` of right-hand sides ``(n, s)``; damping is a share of the largest size."""
        return self.inverse(damping) @ (self.q.T @ right)

    def inverse(self, damping: float) -> np.ndarray:
        """What turns independent errors of variance one in the data into coefficients."""
        factors = self.sizes / (self.sizes**2 + (damping * self.sizes[0]) ** 2)
        return np.asarray((self.right.T * factors) @ self.left.T)


def _mean_velocity(basis: _UnitBasis, coefficients: np.ndarray, x0: np.ndarray, h: np.ndarray) -> np.ndarray:
    """(Φ_h(x0) - x0)/h by one step of the classical Runge–Kutta rule, shape ``(n, d)``."""
    with np.errstate(all="ignore"):  # f that was fitted to noise, undamped, may lead anywhere
        reached = runge_kutta_step(lambda x: (basis.design(x.T) @ coefficients).T, x0.T, h).T
    return (reached - x0) / h[:, None]
