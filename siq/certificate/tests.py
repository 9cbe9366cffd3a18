"""The certificate: the tests that decide whether a formula of V may be believed.

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
`record`           held-out recordings hop, and are spread, as f and D say: `siq.landscape.record_test`. Only
                   where they show random forces and two states, and where they hop or should
=================  ===========================================================================================

`siq.certificate.characteristics`, `siq.certificate.descent` and `siq.certificate.existence` have those three
tests, this module all others.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass as plain_dataclass
from typing import Annotated, Any

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from siq.certificate.error_bound import SAFETY, residual_integral
from siq.dynamics.diffusion import Diffusion
from siq.dynamics.equilibria import Equilibrium, hessian_at
from siq.dynamics.reach import measure_at
from siq.identify.given_field import AnyField, GivenField
from siq.identify.identified_field import IdentifiedField
from siq.numerics.measured_text import place_text
from siq.numerics.normal_draws import normal_draws
from siq.potential.well import Well

Function = Callable[[np.ndarray], np.ndarray]

ERROR_POINTS = 300
FINEST_ERROR = 1e-9  # relative, of V
LARGEST_FROM_FIELD = 0.5  # of V: half of it, with 95 % confidence, is more than a first order can tell
STATED = 2.0  # standard errors of V from f: kept in 95 of 100 times
DRAWS = 40  # of f from its distribution, for the error of M
STANDARD_ERRORS = 4.0  # exceeded by chance once in 16 000 times
UNPREDICTED = "f does not predict held-out recordings"


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
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


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
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
    slope = np.sqrt(np.maximum(measure.steepness(candidate.points, gradient), 0))
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
        What `siq.identify.residuals` objects to.
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
