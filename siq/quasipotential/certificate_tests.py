"""The tests of a certificate, one by one.

Nothing is asked here of any V: descents along f from recorded states tell.

With ``R = ∇V·(f + D∇V)``, and V* the true one, both zero at an attractor:

- following ``dx/dt = f + 2D∇V`` up to x costs the action ``V(x) - ∫R dt``, so that V*(x) is not more;
- along the true minimum action path, Young's inequality gives ``V*(x) ≥ V(x) - ∫R dt``.

The first integral can be computed. Where residuals are small the two paths are close, and the integral of
∣R∣ over the first, with a factor for safety, bounds the error; no independent solution is needed.

Each test can refuse what the others cannot see. The Hamilton–Jacobi equation has false solutions that are
just as exact as the true one, so that no residual of it, however small, decides alone. All tests share f, to
which `prediction` belongs. `characteristics` shares nothing else with a fit of V, and no formula is
certified without it.

=================  ===========================================================================================
`identity`         f, V, g as stored satisfy f = -D∇V + g, with f identified apart from V and g
`hamilton_jacobi`  ∇V·(f + D∇V) vanishes on held-out points, and ∇V does not
`branch`           the Hessian at every attractor is M = W⁻¹, within the error that f leaves open; J is stable
`descent`          V falls along held-out recordings, from sample to sample or in the mean over their noise
`error`            the error that V's own residual leaves is small, and that from f small enough to be known
`existence`        stable states and saddles stay where f is changed within its uncertainty
`characteristics`  V is that which characteristics carry, within that error
`agreement`        both routes give the same V within their errors. Networks that do not agree with the local
                   route are trained again: a test of consistency, and no evidence from elsewhere
`prediction`       f predicts held-out recordings, and its residuals are white
`record`           held-out recordings hop, and are spread, as f and D say (`occupancy`). Only
                   where they show random forces and two states, and where they hop or should
=================  ===========================================================================================

`characteristics` stands in `siq.quasipotential.certificate_characteristics`, the others here.

It asks what the recordings did from one sample to the next, and not what the identified f says of it.

A well that the next recording might not show is no well. f is drawn from its distribution, rivals of its
terms included, and every equilibrium is followed from the identified f to the drawn one by Newton's method,
in small steps. It is lost where it vanishes together with another one, where its stability changes, and where
it has jumped to another one that is followed as well.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from dataclasses import dataclass as plain_dataclass
from typing import Annotated, Any

import numpy as np
import scipy.special
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass as pydantic_dataclass
from scipy.spatial import cKDTree

from siq.data.recordings import SnapshotPairs
from siq.inference.field_estimate import AnyField, GivenField, IdentifiedField
from siq.numerics.randomness import normal_draws
from siq.numerics.text import percent, place_text
from siq.quasipotential.wells import Well
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics
from siq.systems.equilibria import Equilibrium, hessian_at, measure_at
from siq.systems.formulas import compile_formulas
from siq.systems.phase_portrait import PhasePortrait

NEAR = 2.5  # of the spacing of the states, as for the points of a well: further away nothing was recorded


@dataclass(frozen=True, eq=False)
class BasinRegion:
    """The states that lead to one attractor, and those that lead elsewhere, for comparisons of distance.

    Attributes
    ----------
    width
        Of the recorded box, shape ``(d,)``: distances are shares of it.
    own
        States on descents to the attractor.
    spacing
        Of each from its neighbours, on other descents too.
    elsewhere
        Starts of descents that end elsewhere or nowhere, and states on those to other attractors; None
        where there are none.
    """

    width: np.ndarray
    own: cKDTree
    spacing: np.ndarray
    elsewhere: cKDTree | None

    def across(self, x: np.ndarray) -> np.ndarray:
        """Mask of points ``(n, d)`` that lie closer to states which lead elsewhere."""
        if self.elsewhere is None:
            return np.zeros(len(x), dtype=bool)
        others = self.elsewhere.query(x / self.width)[0]
        return np.asarray(others < self.own.query(x / self.width)[0])

    def recorded(self, x: np.ndarray) -> np.ndarray:
        """Mask of points ``(n, d)`` among the states that lead to the attractor."""
        distance, nearest = self.own.query(x / self.width)
        return np.asarray((distance <= NEAR * self.spacing[nearest]) & ~self.across(x))


def basin_region(portrait: PhasePortrait, index: int) -> BasinRegion:
    """The region of one attractor, ``portrait.attractors[index]``."""
    width = portrait.box[:, 1] - portrait.box[:, 0]
    width = np.where(width > 0, width, 1.0)
    states = [basin.points(np.arange(len(basin.chosen))) / width for basin in portrait.basins]
    descents = portrait.descents
    away = [descents.paths[descents.ends != index][:, 0] / width]
    away += [points for number, points in enumerate(states) if number != index]
    elsewhere = np.concatenate(away)
    own = cKDTree(states[index])
    # Of the 2d-th neighbour: states on one descent lie closer to each other than descents do.
    neighbours = min(2 * len(width) + 1, len(states[index]))
    spacing = np.atleast_2d(own.query(states[index], k=neighbours)[0])[:, -1]
    return BasinRegion(width, own, spacing, cKDTree(elsewhere) if len(elsewhere) else None)


SAFETY = 2.0
STEPS = 400
RELAXATIONS = 12.0
RUNAWAY = 3.0  # of the box's width from its middle: a path so far out does not come back to its attractor


def residual_integral(
    gradient: Callable[[np.ndarray], np.ndarray],
    dynamics: Dynamics,
    x: np.ndarray,
    *,
    box: np.ndarray,
    slowest: float,
    fastest: float,
) -> np.ndarray:
    """∫∣∇V·(f + D∇V)∣ dt along the ascending paths that end at points.

    Parameters
    ----------
    gradient
        ∇V, points ``(n, d)`` to ``(n, d)``.
    dynamics
        f and D.
    x
        Where the paths end, shape ``(n, d)``.
    box
        Shape ``(d, 2)``: of the states where V is asked for, and of its attractors. A path that leaves it by
        `RUNAWAY` times its width in any state has run away, whatever the units.
    slowest, fastest
        Rates that set how long, and how finely, the paths are followed back.

    Returns
    -------
    numpy.ndarray
        Shape ``(n,)``; infinite where a path runs away instead of coming from the attractor.
    """
    steps = int(np.clip(RELAXATIONS / slowest * fastest / 0.3, STEPS, 4000))
    step = RELAXATIONS / slowest / steps
    total = np.zeros(len(x))
    width = box[:, 1] - box[:, 0]
    middle, far = box.mean(axis=1), RUNAWAY * np.where(width > 0, width, 1.0)

    def rate(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        slope, flow = gradient(points), dynamics.drift(points)
        push = dynamics.diffusion.push(points, slope)
        return -(flow + 2 * push), np.abs((slope * (flow + push)).sum(axis=1))

    with np.errstate(over="ignore", invalid="ignore"):
        velocity, residual = rate(x)
        for _ in range(steps):  # Heun's rule: the integrand is a bound, not a result
            ahead, _later = rate(x + step * velocity)
            moved = x + step / 2 * (velocity + ahead)
            lost = ~(np.abs(moved - middle) < far).all(axis=1)
            x = np.where(lost[:, None], x, moved)
            velocity, following = rate(x)
            total += step / 2 * (residual + following)
            total[lost] = np.inf
            residual = following
    return total


Function = Callable[[np.ndarray], np.ndarray]

ERROR_POINTS = 300
FINEST_ERROR = 1e-9  # relative, of V
LARGEST_FROM_FIELD = 0.5  # of V: half of it, with 95 % confidence, is more than a first order can tell
STATED = 2.0  # standard errors of V from f: kept in 95 of 100 times
DRAWS = 40  # of f from its distribution, for the error of M
STANDARD_ERRORS = 4.0  # exceeded by chance once in 16 000 times
UNPREDICTED = "f does not predict held-out recordings"


@pydantic_dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class PredictionLimits:
    """Limits of the test of f.

    Attributes
    ----------
    prediction
        Median error of long-term prediction, for recordings without noise.
    held_out_ratio
        Mean square of the residuals of f on held-out recordings over that on its own, for recordings with
        noise. The default, a tenth more, is what a systematic error of √0.1 of the noise adds.
    false_alarms
        Probability with which the noise alone refuses what is right; `descent` has it too. The default is
        one in ten thousand runs.
    """

    prediction: Annotated[float, Field(gt=0)] = 0.01
    held_out_ratio: Annotated[float, Field(gt=1)] = 1.1
    false_alarms: Annotated[float, Field(gt=0, lt=0.5)] = 1e-4

    @property
    def of_f(self) -> PredictionLimits:
        """These alone."""
        return PredictionLimits(self.prediction, self.held_out_ratio, self.false_alarms)


@pydantic_dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class CertificateOptions(PredictionLimits):
    """Limits of the tests; those of the first three are widened by what the uncertainty of f explains.

    Attributes
    ----------
    identity
        Rms of f + D∇V - g over rms of f, both in the metric of D⁻¹.
    hamilton_jacobi
        Rms of ``∣∇V·(f + D∇V)∣ / (∣∇V∣ (∣f∣ + ∣D∇V∣))``.
    branch
        Largest relative difference of the Hessian from M, in the metric of M.
    descent
        Share of the held-out pairs of samples along which V rises, for recordings without noise.
    error
        Largest relative error of V that a certificate may state.
    prediction, held_out_ratio, false_alarms
        See `PredictionLimits`.
    """

    identity: Annotated[float, Field(gt=0)] = 1e-3
    hamilton_jacobi: Annotated[float, Field(gt=0)] = 0.05
    branch: Annotated[float, Field(gt=0)] = 0.01
    descent: Annotated[float, Field(ge=0, lt=1)] = 0.01
    error: Annotated[float, Field(gt=0)] = 0.15


@plain_dataclass(frozen=True)
class Verdict:
    """One test: the figure, its limit, the verdict, and what it means in words."""

    value: float
    limit: float
    passed: bool
    reason: str = ""

    def as_data(self) -> dict[str, Any]:
        """As it stands in model.json; a figure that is not finite becomes null."""
        value = float(self.value) if np.isfinite(self.value) else None
        return {
            "value": value, "limit": float(self.limit), "passed": bool(self.passed), "reason": self.reason
        }  # fmt: skip


@plain_dataclass(frozen=True)
class Candidate:
    """A V to be tested, with g, on the points for which it claims to hold.

    Attributes
    ----------
    values, gradients, hessians
        V, ∇V and ∇²V: points ``(n, d)`` to ``(n,)``, ``(n, d)`` and ``(n, d, d)``.
    circulatory
        g, points to ``(n, d)``; None where g is f + D∇V by definition, and identity is no test.
    points
        Held-out states where it claims to hold, shape ``(n, d)``.
    attractors
        Those within.
    relative_error
        Relative standard error of V on the points, from the uncertainty of f.
    """

    values: Function
    gradients: Function
    hessians: Function
    circulatory: Function | None
    points: np.ndarray
    attractors: Sequence[Equilibrium]
    relative_error: float = 0.0


def check_identity(candidate: Candidate, found: IdentifiedField, *, limit: float) -> Verdict:
    """Whether the stored V and g make up the f that was identified without them."""
    flow = found.dynamics.drift(candidate.points)
    assert candidate.circulatory is not None
    x, noise = candidate.points, found.diffusion
    built = candidate.circulatory(x) - noise.push(x, candidate.gradients(x))
    squares = noise.squared_speed(x, flow - built).mean()
    value = float(np.sqrt(squares / noise.squared_speed(x, flow).mean()))
    allowed = limit + STANDARD_ERRORS * _relative_error_of_drift(found, x, noise)
    return Verdict(
        value, allowed, bool(value <= allowed), "" if value <= allowed else "V and g do not make up f"
    )


def check_hamilton_jacobi(candidate: Candidate, found: AnyField, *, limit: float) -> Verdict:
    """Whether ∇V·(f + D∇V) vanishes where ∇V does not.

    The cosine of ∇V and g would be 0/0 for gradient systems, in which g vanishes; this measure is not.
    """
    flow, gradient = found.dynamics.drift(candidate.points), candidate.gradients(candidate.points)
    down = found.diffusion.push(candidate.points, gradient)
    measure = found.diffusion
    if candidate.attractors:
        measure = measure_at(found.dynamics, candidate.attractors[0].position)
    slope = np.sqrt(np.maximum(measure.contract(candidate.points, gradient), 0))
    speed, fall = (np.sqrt(measure.squared_speed(candidate.points, one)) for one in (flow, down))
    # Where V falls it falls by f: a V that hardly varies while states move is no potential.
    if not np.isfinite(slope).all() or np.median(slope / np.where(speed > 0, speed, np.inf)) < 1e-6:
        return Verdict(np.inf, limit, False, "∇V vanishes, or is not finite, on the held-out points")
    residual = np.abs((gradient * (flow + down)).sum(axis=1))
    size = slope * (speed + fall)
    value = float(np.sqrt(np.mean((residual / np.where(size > 0, size, 1.0)) ** 2)))
    allowed = limit + STANDARD_ERRORS * _relative_error_of_drift(found, candidate.points, measure)
    reason = "" if value <= allowed else "V does not solve the Hamilton–Jacobi equation of f"
    return Verdict(value, allowed, value <= allowed, reason)


def check_branch(candidate: Candidate, found: AnyField, *, limit: float, seed: int = 0) -> Verdict:
    """Whether V has the right curvature at every attractor: the test that exposes exact false solutions."""
    if not candidate.attractors:
        return Verdict(np.inf, limit, False, "there is no stable equilibrium at which V could be tested")
    worst, allowed, place = 0.0, limit, candidate.attractors[0]
    for one in candidate.attractors:
        expected = hessian_at(found.dynamics, one.position)
        root = np.linalg.inv(np.linalg.cholesky(expected))
        difference = root @ (candidate.hessians(one.position[None])[0] - expected) @ root.T
        value = float(np.abs(np.linalg.eigvalsh((difference + difference.T) / 2)).max())
        bound = limit
        if not isinstance(found, GivenField) and not found.noise_free:
            bound += STANDARD_ERRORS * _hessian_error(found, one, root, seed)
        if value / bound >= worst / allowed:
            worst, allowed, place = value, bound, one
    passed = worst <= allowed
    reason = f"the curvature of V at the stable state {place_text(place.position)} is not what f asks for"
    return Verdict(worst, allowed, passed, "" if passed else reason)


def stated_error(candidate: Candidate, found: AnyField, *, seed: int = 0) -> tuple[float, np.ndarray | None]:
    """Relative error of V that its own residual and the uncertainty of f leave open.

    Returns
    -------
    error
        Relative L2 error on the points; infinite where ascending paths do not lead to them, and never below
        what any recording can tell: its own integrator, or instrument, made f different by as much.
    worst
        Where the residual along the path contributes most, shape ``(d,)``.
    """
    if not candidate.attractors:
        return np.inf, None
    generator = np.random.default_rng(seed)
    rows = generator.choice(len(candidate.points), min(ERROR_POINTS, len(candidate.points)), replace=False)
    x = candidate.points[rows]
    slowest = min(-one.eigenvalues.real.max() for one in candidate.attractors)
    width = np.ptp(x, axis=0)
    width = np.where(width > 0, width, 1.0)
    jacobian = found.dynamics.jacobian(x) * width / width[:, None]
    fastest = float(np.quantile(np.linalg.norm(jacobian, axis=(1, 2)), 0.99))
    places = np.concatenate([candidate.points, [one.position for one in candidate.attractors]])
    box = np.stack([places.min(axis=0), places.max(axis=0)], axis=1)
    integral = residual_integral(
        candidate.gradients, found.dynamics, x, box=box, slowest=slowest, fastest=fastest
    )
    values = candidate.values(x)
    lowest = min(float(candidate.values(one.position[None])[0]) for one in candidate.attractors)
    reached = np.isfinite(integral)
    if reached.mean() < 0.9:
        return np.inf, None
    size = np.linalg.norm(values[reached] - lowest)
    error = SAFETY * float(np.linalg.norm(integral[reached]) / size) if size > 0 else np.inf
    worst = x[reached][int(np.argmax(integral[reached]))]
    return max(error + STATED * candidate.relative_error, FINEST_ERROR), worst


def check_error(error: float, *, limit: float, from_field: float = 0.0) -> Verdict:
    """Whether the error that has to be stated is small enough to state.

    Parameters
    ----------
    error
        Relative, that V's own residual leaves open.
    limit
        Of that: a formula that is off by more is no solution.
    from_field
        What the uncertainty of f adds. It is no fault of the formula and is stated, whatever its size, as
        long as it is known; from `LARGEST_FROM_FIELD` on its first order says nothing any more.
    """
    passed = bool(error <= limit and from_field <= LARGEST_FROM_FIELD)
    reason = "" if passed else "the error of V that its residual leaves open is too large"
    if error <= limit and not passed:
        reason = "f is not known well enough to tell V: record more"
    return Verdict(error if from_field <= LARGEST_FROM_FIELD else from_field, limit, passed, reason)


def check_agreement(
    first: Function, wells: Sequence[Well], points: Sequence[np.ndarray], *, limit: float
) -> Verdict:
    """Whether another route gives the same V in every well, up to a constant.

    Parameters
    ----------
    first
        V by that route.
    wells
        V by the local route, zero at each attractor.
    points
        Of each well, shape ``(n, d)``.
    limit
        Relative L2 difference that the errors of both explain.
    """
    worst, where = 0.0, None
    for well, x in zip(wells, points, strict=True):
        one = first(x) - first(well.attractor[None])
        two = well.values(x)
        value = float(np.linalg.norm(one - two) / np.linalg.norm(two))
        if value >= worst:
            worst, where = value, x[int(np.argmax(np.abs(one - two)))]
    passed = bool(worst <= limit)
    shown = "" if where is None else place_text(where)
    return Verdict(worst, limit, passed, "" if passed else f"the two routes disagree most at {shown}")


def check_prediction(
    *,
    noise_fault: str | None,
    errors: np.ndarray | None,
    mean_probability: float | None,
    held_out_ratio: float,
    limits: PredictionLimits,
) -> Verdict:
    """Whether f, which every V here is made from, holds for recordings that it was not fitted to.

    Parameters
    ----------
    noise_fault
        What `siq.inference.residuals` objects to.
    errors
        Errors of long-term prediction of held-out recordings, where these carry no noise.
    mean_probability
        Probability of the mean of the held-out residuals, where they carry noise.
    held_out_ratio
        Mean square of the held-out residuals over that of the others.
    limits
        Of the three.

    Returns
    -------
    Verdict
        Its figure is the median error; or how much larger the mean square is, as a share; or, where the mean
        of the residuals refuses, how many powers of ten its probability lies below 1.
    """
    if noise_fault is not None:
        return Verdict(np.inf, limits.prediction, False, noise_fault)
    if errors is not None:
        value, limit = float(np.median(errors)), limits.prediction
        return Verdict(value, limit, value <= limit, "" if value <= limit else UNPREDICTED)
    assert mean_probability is not None
    value, limit = max(held_out_ratio - 1, 0.0), limits.held_out_ratio - 1
    if not value <= limit:
        return Verdict(value, limit, False, "f fits held-out recordings worse than its own")
    rarity, rare = -float(np.log10(max(mean_probability, 1e-300))), -float(np.log10(limits.false_alarms))
    if not rarity <= rare:
        reason = (
            "the residuals of f on held-out recordings have a mean, of a probability of"
            f" {mean_probability:.1g}: f misses a term"
        )
        return Verdict(rarity, rare, False, reason)
    return Verdict(value, limit, True)


def _relative_error_of_drift(found: AnyField, points: np.ndarray, measure: Diffusion) -> float:
    """Rms over points of the standard error of f, over rms of f, speeds being measured by D or by another."""
    if isinstance(found, GivenField) or found.noise_free:
        return 0.0
    components, functions = found.support.T
    terms = found.library.evaluate(points)[:, functions]
    if measure.constant:
        weighted = measure.precision[np.ix_(components, components)] * found.covariance
        total = np.einsum("np,pr,nr->n", terms, weighted, terms).mean()
    else:
        precision = measure.precision_at(points)[:, components[:, None], components]
        total = np.einsum("np,npr,pr,nr->n", terms, precision, found.covariance, terms, optimize=True).mean()
    return float(np.sqrt(total / measure.squared_speed(points, found.dynamics.drift(points)).mean()))


def _hessian_error(found: IdentifiedField, one: Equilibrium, root: np.ndarray, seed: int) -> float:
    """Standard deviation of M, in its own metric, over draws of f from its distribution."""
    generator = np.random.default_rng(seed)
    draws = normal_draws(found.values, found.covariance, DRAWS, generator=generator)
    reference = hessian_at(found.dynamics, one.position)
    spread = []
    for draw in draws:
        dynamics = found.dynamics.with_values(draw)
        position = one.position.copy()
        for _ in range(8):
            position = position - np.linalg.solve(
                dynamics.jacobian(position[None])[0], dynamics.drift(position[None])[0]
            )
        difference = root @ (hessian_at(dynamics, position) - reference) @ root.T
        spread.append(np.abs(np.linalg.eigvalsh((difference + difference.T) / 2)).max())
    return float(np.sqrt(np.mean(np.square(spread))))


MOST_PAIRS = 10_000  # evenly taken: memory, not accuracy
FEWEST = 30  # pairs, of a bin too: so many increments have a mean that is normal enough
BINS = 8  # in V, of equally many pairs; a choice, by which the limit is made stricter
LOWEST = 1e-3  # of the range of V: closer to its minimum a fall cannot be told from rounding
ROUNDING = 1e-12  # of the largest V: that of formulas of many terms
BELOW = 0.02  # of the range of V: so far below the attractors nothing may lie
FLAT = "V does not vary on the held-out points"
RISES = "V does not fall along the recordings"


def check_descent(
    candidate: Candidate,
    found: IdentifiedField,
    pairs: SnapshotPairs,
    *,
    options: CertificateOptions,
    error: float = 0.0,
) -> Verdict:
    """Whether V falls along recordings that no fit saw.

    Parameters
    ----------
    candidate
        V, and the points on which it may lie nowhere below the attractors.
    found
        Says whether recordings carry noise, and how much.
    pairs
        Consecutive samples whose first one lies where the candidate claims to hold.
    options
        `descent`, the share of pairs that may rise, without noise; `false_alarms` with it.
    error
        Relative error of V that its certificate states.

    Notes
    -----
    Without noise a pair rises where ``V(x_h) - V(x_0)`` is more than the residuals of f over such a pair, and
    rounding, explain. With noise the mean of ``∇V(X)·ΔX/h`` at the left point (Itô) is ``-∇V·D∇V``, as g is
    orthogonal to ∇V; the standard error of its mean over a bin in V is known, as increments are independent
    given the state from which they start. Largest of the bins' deviations, in standard errors, and the limit
    that all of them keep by chance except with probability `false_alarms`. Two things are allowed for: of a V
    with the relative error e the term ``∇V·D∇V`` is off by 2e; and over a pair of length h the drift
    differs from f by ``(h/2) Lf`` with ``Lf = Jf + ½ Σ:∇²f``, Σ being the noise per unit of time.
    """
    rows = np.unique(np.linspace(0, max(len(pairs.h) - 1, 0), MOST_PAIRS).astype(int))[: len(pairs.h)]
    x0, xh, h = pairs.x0[rows], pairs.xh[rows], pairs.h[rows]
    if len(h) < FEWEST:
        reason = f"only {len(h)} pairs of held-out samples start where V claims to hold: record more there"
        return Verdict(1.0, 0.0, False, reason)
    values = candidate.values(x0)
    bottoms = [float(candidate.values(one.position[None])[0]) for one in candidate.attractors]
    lowest, size = min(bottoms, default=float(values.min())), float(np.ptp(values))
    if not size > 0:
        return Verdict(1.0, 0.0, False, FLAT)
    below = (candidate.values(candidate.points) < lowest - BELOW * size).mean() if bottoms else 0.0
    if below > options.descent:
        return Verdict(float(below), options.descent, False, RISES)
    slope = candidate.gradients(x0)
    if found.noise_rate.any() and not found.noise_free:
        return _in_the_mean(found, x0, xh, h, values, slope, options, error)
    counts = values - lowest > LOWEST * size
    if not counts.any():
        return Verdict(1.0, options.descent, False, FLAT)
    unexplained = np.sqrt(np.einsum("ni,ij,nj->n", slope, found.noise_rate, slope) * h)
    allowed = STANDARD_ERRORS * unexplained + ROUNDING * np.abs(values).max()
    share = max(float((candidate.values(xh) - values > allowed)[counts].mean()), float(below))
    passed = share <= options.descent
    return Verdict(share, options.descent, passed, "" if passed else RISES)


def _in_the_mean(
    found: IdentifiedField,
    x0: np.ndarray,
    xh: np.ndarray,
    h: np.ndarray,
    values: np.ndarray,
    slope: np.ndarray,
    options: CertificateOptions,
    error: float,
) -> Verdict:
    """Whether ∇V·ΔX/h has the mean -∇V·D∇V, in bins of V."""
    claimed = found.diffusion.contract(x0, slope)
    excess = (slope * (xh - x0)).sum(axis=1) / h + claimed
    forces = np.broadcast_to(found.noise_rate, (len(h), *found.noise_rate.shape))
    if found.noise is not None:  # each increment has the noise of the state where it starts
        forces = found.intensity * found.diffusion.at(x0)
    variance = np.einsum("ni,nij,nj->n", slope, forces, slope) / h
    dynamics = found.dynamics
    change = np.einsum("nij,nj->ni", dynamics.jacobian(x0), dynamics.drift(x0))
    change += 0.5 * np.einsum("nkij,nij->nk", dynamics.hessian(x0), forces)
    curved = (slope * change).sum(axis=1) * h / 2
    bins = np.array_split(np.argsort(values), max(min(BINS, len(h) // FEWEST), 1))
    limit = float(-scipy.special.ndtri(options.false_alarms / (2 * len(bins))))
    worst = 0.0
    for rows in bins:
        explained = 2 * min(error, options.error) * claimed[rows].mean() + abs(curved[rows].mean())
        spread = float(np.sqrt(variance[rows].sum())) / len(rows)
        beyond = max(abs(float(excess[rows].mean())) - explained, 0.0)
        worst = max(worst, beyond / spread if spread > 0 else np.inf)
    if not claimed.max() > 0:
        return Verdict(np.inf, limit, False, FLAT)
    worst = float(worst)
    passed = bool(worst <= limit)
    reason = "" if passed else "in the mean over its noise V does not fall along the recordings as it has to"
    return Verdict(worst, limit, passed, reason)


EXISTENCE_DRAWS = 200  # of f: a share of one in twenty is then known to ±0.015
EXISTENCE_STEPS = 10  # from the identified f to a drawn one
NEWTON = 6  # steps of Newton's method at each
SAME = 1e-3  # of the recorded box: closer equilibria are one
SETTLED = 1e-6  # of the recorded box, by which Newton's last step may still move
EXISTENCE_ROUNDING = 1e-13  # of a Jacobian: one that is singular to rounding need not stop the others
LARGEST_SHARE = 0.05  # of the draws in which an equilibrium may be lost: what is claimed is claimed at 95 %


def lost_shares(
    found: IdentifiedField, equilibria: Sequence[Equilibrium], *, box: np.ndarray, seed: int = 0
) -> np.ndarray:
    """In which share of the f that the data allow each equilibrium does not exist: shape ``(k,)``.

    Parameters
    ----------
    found
        f with its uncertainty.
    equilibria
        Of the identified f.
    box
        Shape ``(d, 2)``: the recorded region.
    seed
        Of the draws.
    """
    if found.noise_free or not equilibria:
        return np.zeros(len(equilibria))
    changes = _drawn_changes(found, np.random.default_rng(seed))
    followed = [_followed(found, one, changes, box) for one in equilibria]
    places = np.array([place for place, _ in followed])
    lost = np.array([gone for _, gone in followed])
    width = box[:, 1] - box[:, 0]
    far = np.array(
        [np.abs((at - one.position) / width).max(axis=1) for at, one in zip(places, equilibria, strict=True)]
    )
    met = np.zeros_like(lost)
    for one, two in itertools.combinations(range(len(equilibria)), 2):
        same = (np.abs((places[one] - places[two]) / width).max(axis=1) < SAME) & ~lost[one] & ~lost[two]
        # Whichever came from afar has jumped; both have where they come from equally far.
        met[one] |= same & (far[one] > far[two] / 2)
        met[two] |= same & (far[two] > far[one] / 2)
    return np.asarray((lost | met).mean(axis=1))


def check_existence(found: IdentifiedField, portrait: PhasePortrait, *, seed: int = 0) -> Verdict:
    """Whether attractors and the saddles between them exist with the whole uncertainty of f.

    Parameters
    ----------
    found
        f with its uncertainty.
    portrait
        Its equilibria.
    seed
        Of the draws.
    """
    saddles = {one.position.tobytes(): one for around in portrait.saddles for one in around}
    claimed = [*portrait.attractors, *saddles.values()]
    shares = lost_shares(found, claimed, box=portrait.box, seed=seed)
    if not len(shares):
        return Verdict(0.0, LARGEST_SHARE, True)
    worst = int(np.argmax(shares))
    value, one = float(shares[worst]), claimed[worst]
    if value <= LARGEST_SHARE:
        return Verdict(value, LARGEST_SHARE, True)
    kind = "stable state" if one.kind == "attractor" else "saddle"
    reason = (
        f"the recordings do not tell whether there is a {kind} at {place_text(one.position)}: it is missing"
        f" in {percent(value)} of the f that they allow for; record more about it"
    )
    return Verdict(value, LARGEST_SHARE, False, reason)


def _drawn_changes(found: IdentifiedField, draw: np.random.Generator) -> np.ndarray:
    """Changes of all coefficients, shape ``(n, q, d)``."""
    changes = np.zeros((EXISTENCE_DRAWS, found.library.size, found.library.dimension))
    own = normal_draws(np.zeros(len(found.support)), found.covariance, EXISTENCE_DRAWS, generator=draw)
    changes[:, found.support[:, 1], found.support[:, 0]] = own
    if found.rivals is not None:
        changes += found.rivals.drawn(EXISTENCE_DRAWS, generator=draw)
    return changes


def _followed(
    found: IdentifiedField, one: Equilibrium, changes: np.ndarray, box: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Where changes of f lead an equilibrium, shape ``(n, d)``, and a mask of those that lose it."""
    library, width = found.library, box[:, 1] - box[:, 0]
    d = library.dimension
    first = [term.diff(symbol) for term in library.terms for symbol in library.symbols]
    derivative = compile_formulas(first, library.symbols)

    def jacobians(x: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
        slopes = derivative(np.ascontiguousarray(x.T)).T.reshape(len(x), library.size, d)
        return np.einsum("nqj,nqi->nij", slopes, coefficients)

    x = np.repeat(one.position[None], len(changes), axis=0)
    lost = np.zeros(len(changes), dtype=bool)
    for step in range(1, EXISTENCE_STEPS + 1):
        coefficients = found.coefficients + changes * step / EXISTENCE_STEPS
        moved = np.full(len(x), np.inf)
        for _ in range(NEWTON):
            value = np.einsum("nq,nqi->ni", library.evaluate(x), coefficients)
            matrix = jacobians(x, coefficients)
            matrix = matrix + EXISTENCE_ROUNDING * np.abs(matrix).max(axis=(1, 2), keepdims=True) * np.eye(d)
            change = np.linalg.solve(matrix, value[..., None])[..., 0]
            moved = np.abs(change / width).max(axis=1)
            lost |= ~(moved < 1.0)
            x = np.where(lost[:, None], one.position, x - change)
        unstable = (np.linalg.eigvals(jacobians(x, coefficients)).real > 0).sum(axis=1)
        lost |= (moved > SETTLED) | (unstable != one.unstable)
        x = np.where(lost[:, None], one.position, x)
    return x, lost
