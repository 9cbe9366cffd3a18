"""Tests of a certificate: each takes a candidate V with the field that it is of, and returns a verdict.

The Hamilton–Jacobi equation has false solutions that are just as exact as the true one, so that no residual
of it, however small, decides alone. Each test can refuse what the others cannot see. All share f, to which
`prediction` belongs; `characteristics` shares nothing else with a fit of V, and no formula is certified
without it.

=================  ===========================================================================================
`identity`         f, V, g as stored satisfy f = -D∇V + g, with f identified apart from V and g
`hamilton_jacobi`  ∇V·(f + D∇V) vanishes on held-out points, and ∇V does not
`branch`           the Hessian at every attractor is M = W⁻¹, within the error that f leaves open; J is stable
`descent`          V falls along held-out recordings, from sample to sample or in the mean over their noise
`error`            the error that V's own residual leaves is small, and that from f small enough to be known
`existence`        stable states and saddles stay where f is changed within its uncertainty
`characteristics`  V is that which characteristics carry, within that error
`agreement`        the networks' own V is the same within the errors of both: two routes from the same
                   recordings, see `siq.quasipotential.certificate.check_agreement`
`prediction`       f predicts held-out recordings, and its residuals are white
`connected`        recordings passed from well to well, where they show process noise (`occupancy`)
`times`            they hop, and `record`: are spread, as f of other recordings and D say
`one_system`       and `unchanged`, `state_complete`, `gaussian_increments`: nothing but the state predicts
                   the next sample, where there is process noise (`siq.inference.claims`)
=================  ===========================================================================================

The error of a V with ``R = ∇V·(f + D∇V)``, V* being the true one and both zero at an attractor: following
``dx/dt = f + 2D∇V`` up to x costs the action ``V(x) - ∫R dt``, so that V*(x) is not more; and along the true
minimum action path Young's inequality gives ``V*(x) ≥ V(x) - ∫R dt``. The first integral can be computed.
Where residuals are small the two paths are close, and ∫∣R∣ dt over the first, with a factor for safety,
bounds the error. Where V is lowest elsewhere than at the attractor A, paths begin at rest elsewhere, and R
does not vanish there: that integral grows for as long as they are followed. From any state b on, a path shows
that ``V*(x) ≤ V*(b) + V(x) - V(b) - ∫R dt``, so that ``V*(b) + ∣V(b) - V(A)∣`` with ∫∣R∣ dt from b on bounds
the error as well, V*(b) being that of the Hessian at A. The least of these bounds counts.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
import scipy.special
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass as pydantic_dataclass

from siq.data.recordings import SnapshotPairs
from siq.inference.checks import PredictionLimits
from siq.inference.field_estimate import AnyField, FieldEstimate, Verdict, dynamics_of
from siq.numerics.randomness import normal_draws
from siq.numerics.text import percent, place_text
from siq.quasipotential.characteristics import ascending_integrals, fastest_rate
from siq.remarks import Remark
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics
from siq.systems.equilibria import Equilibrium, hessian_at, measure_at
from siq.systems.formulas import compile_formulas
from siq.systems.phase_portrait import PhasePortrait

Function = Callable[[np.ndarray], np.ndarray]

LEVEL_SHARE = 0.9  # of the level of a well: at the saddle itself V is stationary, and curves hardly get on
MIN_POINTS = 30  # points or pairs: their mean is normal enough, their root mean square known to 13 %
ERROR_POINTS = 300
SAFETY_FACTOR = 2.0  # factor of the integral of the residual
MIN_PATH_STEPS = 400  # of an ascending path
MIN_ERROR = 1e-9  # relative, of V
MAX_ERROR_FROM_FIELD = 0.5  # of V: half of it, with 95 % confidence, is more than a first order can tell
STATED_SIGMAS = 2.0  # standard errors of V from f: kept in 95 of 100 times
FIELD_DRAWS = 40  # of f from its distribution, for the error of M
STANDARD_ERRORS = 4.0  # exceeded by chance once in 16 000 times


@pydantic_dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class CertificateOptions(PredictionLimits):
    """Limits of the tests; those of the first three are widened by what the uncertainty of f explains."""

    #: Rms of f + D∇V - g over rms of f, both in the metric of D⁻¹
    identity: Annotated[float, Field(gt=0)] = 1e-3
    #: Rms of ``∣∇V·(f + D∇V)∣ / (∣∇V∣ (∣f∣ + ∣D∇V∣))``
    hamilton_jacobi: Annotated[float, Field(gt=0)] = 0.05
    #: Largest relative difference of the Hessian from M, in the metric of M
    branch: Annotated[float, Field(gt=0)] = 0.01
    #: Share of the held-out pairs of samples along which V rises, for recordings without noise
    descent: Annotated[float, Field(ge=0, lt=1)] = 0.01
    #: Largest relative error of V that a certificate may state
    error: Annotated[float, Field(gt=0)] = 0.15


@dataclass(frozen=True, eq=False)
class Reference:
    """V about one attractor at points that characteristics reach.

    The relative error of the values is the steps of a curve times their tolerance, and the margin of the
    sheets where there was more than one.
    """

    attractor: np.ndarray  #: shape (d,); V is zero there
    points: np.ndarray  #: shape (n, d)
    values: np.ndarray  #: shape (n,)
    level: float  #: V up to which they were followed, NaN where they could not be
    error: float
    fault: str = ""  #: why there is nothing to compare with, and what would help; empty where there is
    caustic: Remark | None = None  #: the lowest place at which they cross, None where they do not

    def below(self, level: float) -> tuple[np.ndarray, np.ndarray]:
        """Points and values up to `LEVEL_SHARE` of a level that a formula claims, if it is the lower one."""
        kept = self.values <= LEVEL_SHARE * level
        return self.points[kept], self.values[kept]


@dataclass(frozen=True)
class Candidate:
    """A V to be tested, with g, on the points for which it claims to hold."""

    values: Function  #: V of points (n, d), shape (n,)
    gradients: Function  #: ∇V, shape (n, d)
    hessians: Function  #: ∇²V, shape (n, d, d)
    circulatory: Function | None  #: g, shape (n, d); None where it is f + D∇V by definition
    points: np.ndarray  #: held-out states where it claims to hold, shape (n, d)
    attractors: Sequence[Equilibrium]  #: those within
    relative_error: float = 0.0  #: standard error of V on the points, from the uncertainty of f
    pairs: SnapshotPairs | None = None  #: of which the first state is such; None where no motion was recorded
    references: Sequence[Reference] = ()  #: V by characteristics about the attractors
    level: float = np.inf  #: V up to which it claims to hold
    claimed: float = 1.0  #: at which share of the states of its region it does
    tested_on: str = ""  #: the points, in words

    def stated_error(self, found: AnyField, *, seed: int = 0) -> float:
        """Relative L2 error of V on its points that its own residual and the uncertainty of f leave open.

        Infinite where ascending paths do not lead to them, and never below what any recording can tell: its
        own integrator, or instrument, made f different by as much.
        """
        if not self.attractors:
            return np.inf
        dynamics, generator = dynamics_of(found), np.random.default_rng(seed)
        rows = generator.choice(len(self.points), min(ERROR_POINTS, len(self.points)), replace=False)
        x = self.points[rows]
        attractors = np.array([one.position for one in self.attractors])
        places, bottoms = np.concatenate([self.points, attractors]), self.values(attractors)
        hessians = np.array([hessian_at(dynamics, one) for one in attractors])

        def beginning(b: np.ndarray) -> np.ndarray:
            """V*(b) + ∣V(b) - V(A)∣, by the attractor A for which that is least."""
            offsets = b[:, None] - attractors
            expected = np.einsum("nki,kij,nkj->nk", offsets, hessians, offsets) / 2
            deviation = np.abs(self.values(b)[:, None] - bottoms)
            return np.asarray((expected + deviation).min(axis=1, keepdims=True))

        integral = _residual_integral(
            self.gradients, dynamics, x, beginning=beginning,
            box=np.stack([places.min(axis=0), places.max(axis=0)], axis=1),
            slowest=min(-one.eigenvalues.real.max() for one in self.attractors),
            fastest=fastest_rate(dynamics, x, np.ptp(x, axis=0)),
        )  # fmt: skip
        values = self.values(x)
        reached = np.isfinite(integral)
        if reached.mean() < 0.9:
            return np.inf
        size = np.linalg.norm(values[reached] - bottoms.min())
        error = SAFETY_FACTOR * float(np.linalg.norm(integral[reached]) / size) if size > 0 else np.inf
        return max(error + STATED_SIGMAS * self.relative_error, MIN_ERROR)

    def check(
        self, found: AnyField, options: CertificateOptions, *, seed: int = 0
    ) -> tuple[dict[str, Verdict], float]:
        """The tests that apply, by name, and the error of V that has to be stated after them."""
        # Characteristics follow the same f: what f's uncertainty adds explains no difference from them.
        error = self.stated_error(found, seed=seed)
        followed, error = _check_characteristics(self, found, options, error=error, seed=seed)
        tests = {
            "hamilton_jacobi": self.check_hamilton_jacobi(found, options),
            "branch": _check_branch(self, found, options, seed=seed),
        }
        if self.pairs is not None and not isinstance(found, Dynamics):
            tests["descent"] = _check_descent(self, found, options, error=error)
        tests["characteristics"] = followed
        if self.circulatory is not None:
            tests["identity"] = _check_identity(self, found, options)
        return tests, error

    def check_hamilton_jacobi(self, found: AnyField, options: CertificateOptions) -> Verdict:
        """Whether ∇V·(f + D∇V) vanishes where ∇V does not.

        The cosine of ∇V and g would be 0/0 for gradient systems, in which g vanishes; this measure is not.
        """
        x, dynamics, measure = self.points, dynamics_of(found), found.diffusion
        flow, gradient = dynamics.drift(x), self.gradients(x)
        down = found.diffusion.push(x, gradient)
        if self.attractors:
            measure = measure_at(dynamics, self.attractors[0].position)
        slope = np.sqrt(np.maximum(measure.contract(x, gradient), 0))
        speed, fall = (np.sqrt(measure.squared_speed(x, one)) for one in (flow, down))
        # Where V falls it falls by f: a V that hardly varies while states move is no potential.
        if not np.isfinite(slope).all() or np.median(slope / np.where(speed > 0, speed, np.inf)) < 1e-6:
            return Verdict.refused(
                "∇V vanishes, or is not finite, on the held-out points", options.hamilton_jacobi
            )
        residual = np.abs((gradient * (flow + down)).sum(axis=1))
        size = slope * (speed + fall)
        value = float(np.sqrt(np.mean((residual / np.where(size > 0, size, 1.0)) ** 2)))
        limit = options.hamilton_jacobi + STANDARD_ERRORS * _relative_error_of_drift(found, x, measure)
        return Verdict.of(value, limit, "V does not solve the Hamilton–Jacobi equation of f")


def _check_identity(candidate: Candidate, found: AnyField, options: CertificateOptions) -> Verdict:
    """Whether the stored V and g make up the f that was identified without them."""
    assert candidate.circulatory is not None
    x, noise = candidate.points, found.diffusion
    flow = dynamics_of(found).drift(x)
    built = candidate.circulatory(x) - noise.push(x, candidate.gradients(x))
    value = float(np.sqrt(noise.squared_speed(x, flow - built).mean() / noise.squared_speed(x, flow).mean()))
    limit = options.identity + STANDARD_ERRORS * _relative_error_of_drift(found, x, noise)
    return Verdict.of(value, limit, "V and g do not make up f")


def _relative_error_of_drift(found: AnyField, points: np.ndarray, measure: Diffusion) -> float:
    """Rms over points of the standard error of f, over rms of f, speeds being measured by D or by another."""
    if isinstance(found, Dynamics) or found.noise_free:
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


def _check_branch(
    candidate: Candidate, found: AnyField, options: CertificateOptions, *, seed: int = 0
) -> Verdict:
    """Whether V has the right curvature at every attractor: the test that exposes exact false solutions."""
    if not candidate.attractors:
        return Verdict.refused("there is no stable equilibrium at which V could be tested", options.branch)
    verdicts = []
    for one in candidate.attractors:
        expected = hessian_at(dynamics_of(found), one.position)
        root = np.linalg.inv(np.linalg.cholesky(expected))

        def deviation(hessian: np.ndarray, expected: np.ndarray, root: np.ndarray) -> float:
            difference = root @ (hessian - expected) @ root.T
            return float(np.abs(np.linalg.eigvalsh((difference + difference.T) / 2)).max())

        value = deviation(candidate.hessians(one.position[None])[0], expected, root)
        bound = options.branch
        if not isinstance(found, Dynamics) and not found.noise_free:
            # The standard deviation of M over draws of f, whose attractor is found again by Newton's method.
            draws = normal_draws(
                found.values, found.covariance, FIELD_DRAWS, generator=np.random.default_rng(seed)
            )
            spread = []
            for draw in draws:
                dynamics, position = found.dynamics.with_values(draw), one.position.copy()
                for _ in range(8):
                    position = position - np.linalg.solve(
                        dynamics.jacobian(position[None])[0], dynamics.drift(position[None])[0]
                    )
                spread.append(deviation(hessian_at(dynamics, position), expected, root))
            bound += STANDARD_ERRORS * float(np.sqrt(np.mean(np.square(spread))))
        reason = f"the curvature of V at the stable state {place_text(one.position)} is not what f asks for"
        verdicts.append(Verdict.of(value, bound, reason))
    return Verdict.worst(verdicts)


def _residual_integral(
    gradient: Function, dynamics: Dynamics, x: np.ndarray, *, box: np.ndarray, slowest: float, fastest: float,
    beginning: Function | None = None,
) -> np.ndarray:  # fmt: skip
    """∫∣∇V·(f + D∇V)∣ dt along the ascending paths to points ``(n, d)``, infinite where one runs away."""
    total, _, lost = ascending_integrals(
        gradient, dynamics, x,
        lambda _, slope, flow, push: np.abs((slope * (flow + push)).sum(axis=1))[:, None],
        middle=box.mean(axis=1), width=box[:, 1] - box[:, 0], slowest=slowest, fastest=fastest,
        fewest_steps=MIN_PATH_STEPS, beginning=beginning,
    )  # fmt: skip
    return np.where(lost, np.inf, total[:, 0])


def _check_characteristics(
    candidate: Candidate, found: AnyField, options: CertificateOptions, *, error: float, seed: int = 0
) -> tuple[Verdict, float]:
    """Whether V is the one that characteristics carry, and the error to be stated.

    The figure is the largest relative L2 difference about any attractor. Where it is more than the error of
    the region, at least that is stated which the residual leaves open about this attractor.
    """
    if not candidate.references or len(candidate.references) < len(candidate.attractors):
        reason = "characteristics were not followed from every attractor, or there is none"
        return Verdict.refused(reason), error
    verdicts = []
    for one in candidate.references:
        x, expected = one.below(candidate.level)
        few = f"only {len(x)} points of characteristics lie below the level of V: the level is too low"
        if one.fault or len(x) < MIN_POINTS:
            verdicts.append(Verdict.refused(one.fault or few))
            continue
        difference = candidate.values(x) - candidate.values(one.attractor[None]) - expected
        value = float(np.linalg.norm(difference) / np.linalg.norm(expected))
        if not value <= error + one.error:  # a mean over a region says little of its deepest part
            error = max(error, replace(candidate, points=x).stated_error(found, seed=seed))
        # An error that cannot be stated explains nothing: a false solution, whose ascending paths run away.
        from_field = STATED_SIGMAS * candidate.relative_error  # of a formula that was fitted together with f
        own = error - from_field if error - from_field <= options.error else 0.0
        limit = own + (from_field if np.isfinite(error) else 0.0) + one.error
        reason = (
            f"V is not what characteristics give, most of all at {place_text(x[np.abs(difference).argmax()])}"
        )
        verdicts.append(Verdict.of(value, limit, reason))
    return Verdict.worst(verdicts), error


MAX_PAIRS = 10_000  # evenly taken: memory, not accuracy
DESCENT_BINS = 8  # in V, of equally many pairs; a choice, by which the limit is made stricter
MIN_DEPTH_SHARE = 1e-3  # of the range of V: closer to its minimum a fall cannot be told from rounding
VALUE_ROUNDING = 1e-12  # of the largest V: that of formulas of many terms
MAX_DEPTH_BELOW = 0.02  # of the range of V: so far below the attractors nothing may lie
FLAT = "V does not vary on the held-out points"
RISES = "V does not fall along the recordings"


def _check_descent(
    candidate: Candidate, found: FieldEstimate, options: CertificateOptions, *, error: float = 0.0
) -> Verdict:
    """Whether V falls along held-out recordings; `error` is the relative one of V that is stated.

    Under noise the f that V follows from was fitted to them as well: what f makes of recordings that it did
    not see, `prediction` and ``times`` ask.

    Without noise a pair rises where ``V(x_h) - V(x_0)`` is more than the residuals of f over such a pair, and
    rounding, explain; a share of them may. With noise the mean of ``∇V(X)·ΔX/h`` at the left point (Itô) is
    ``-∇V·D∇V``, as g is orthogonal to ∇V. The figure is the largest deviation of its mean over a bin in V, in
    standard errors; all bins keep the limit by chance except with the probability `each` of the options.
    Allowed for are 2e of ``∇V·D∇V``, e being the relative error of V; and over a pair of length h the drift's
    difference from f, ``(h/2) Lf`` with ``Lf = Jf + ½ Σ:∇²f``, Σ being the noise per unit of time.
    """
    pairs = candidate.pairs
    assert pairs is not None
    pairs = pairs.take(
        np.unique(np.linspace(0, max(len(pairs.h) - 1, 0), MAX_PAIRS).astype(int))[: len(pairs.h)]
    )
    x0, xh, h = pairs.x0, pairs.xh, pairs.h
    if len(h) < MIN_POINTS:
        reason = f"only {len(h)} pairs of held-out samples start where V claims to hold: record more there"
        return Verdict(1.0, 0.0, False, reason)
    values = candidate.values(x0)
    bottoms = [float(candidate.values(one.position[None])[0]) for one in candidate.attractors]
    lowest, size = min(bottoms, default=float(values.min())), float(np.ptp(values))
    if not size > 0:
        return Verdict(1.0, 0.0, False, FLAT)
    below = (candidate.values(candidate.points) < lowest - MAX_DEPTH_BELOW * size).mean() if bottoms else 0.0
    if below > options.descent:
        return Verdict(float(below), options.descent, False, RISES)
    slope = candidate.gradients(x0)
    if not found.noise_rate.any() or found.noise_free:
        counts = values - lowest > MIN_DEPTH_SHARE * size
        if not counts.any():
            return Verdict(1.0, options.descent, False, FLAT)
        unexplained = np.sqrt(np.einsum("ni,ij,nj->n", slope, found.noise_rate, slope) * h)
        allowed = STANDARD_ERRORS * unexplained + VALUE_ROUNDING * np.abs(values).max()
        share = max(float((candidate.values(xh) - values > allowed)[counts].mean()), float(below))
        return Verdict.of(share, options.descent, RISES)
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
    bins = np.array_split(np.argsort(values), max(min(DESCENT_BINS, len(h) // MIN_POINTS), 1))
    limit = float(-scipy.special.ndtri(options.each / (2 * len(bins))))
    worst = 0.0
    for rows in bins:
        explained = 2 * min(error, options.error) * claimed[rows].mean() + abs(curved[rows].mean())
        spread = float(np.sqrt(variance[rows].sum())) / len(rows)
        beyond = max(abs(float(excess[rows].mean())) - explained, 0.0)
        worst = max(worst, beyond / spread if spread > 0 else np.inf)
    if not claimed.max() > 0:
        return Verdict.refused(FLAT, limit)
    reason = "in the mean over its noise V does not fall along the recordings as it has to"
    return Verdict.of(float(worst), limit, reason)


EXISTENCE_DRAWS = 200  # of f: a share of one in twenty is then known to ±0.015
EXISTENCE_STEPS = 10  # from the identified f to a drawn one
NEWTON_STEPS = 6  # steps of Newton's method at each
EQUILIBRIUM_MERGE_TOLERANCE = 1e-3  # of the recorded box: closer equilibria are one
NEWTON_TOLERANCE = 1e-6  # of the recorded box, by which Newton's last step may still move
SINGULAR_SHIFT = 1e-13  # of a Jacobian: one that is singular to rounding need not stop the others
MAX_LOST_SHARE = 0.05  # of the draws in which an equilibrium may be lost: what is claimed is claimed at 95 %


def _lost_shares(
    found: FieldEstimate, equilibria: Sequence[Equilibrium], *, box: np.ndarray, seed: int = 0
) -> np.ndarray:
    """Share of the f that the data allow in which each equilibrium does not exist: shape ``(k,)``.

    Each is followed by Newton's method. It is lost where it vanishes together with another one, where its
    stability changes, and where it has jumped.
    """
    if found.noise_free or not equilibria:
        return np.zeros(len(equilibria))
    generator, library, width = np.random.default_rng(seed), found.library, box[:, 1] - box[:, 0]
    changes = np.zeros((EXISTENCE_DRAWS, library.size, library.dimension))
    own = normal_draws(np.zeros(len(found.support)), found.covariance, EXISTENCE_DRAWS, generator=generator)
    changes[:, found.support[:, 1], found.support[:, 0]] = own
    changes += found.drawn_alternatives(EXISTENCE_DRAWS, generator=generator)
    starts = np.array([one.position for one in equilibria])
    unstable = np.repeat([one.unstable for one in equilibria], EXISTENCE_DRAWS)
    first = [term.diff(symbol) for term in library.terms for symbol in library.symbols]
    derivative, d = compile_formulas(first, library.symbols), library.dimension

    def jacobians(x: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
        slopes = derivative(np.ascontiguousarray(x.T)).T.reshape(len(x), library.size, d)
        return np.einsum("nqj,nqi->nij", slopes, coefficients)

    start = x = np.repeat(starts, EXISTENCE_DRAWS, axis=0)
    lost = np.zeros(len(x), dtype=bool)
    for step in range(1, EXISTENCE_STEPS + 1):
        coefficients = np.tile(found.coefficients + changes * step / EXISTENCE_STEPS, (len(starts), 1, 1))
        moved = np.full(len(x), np.inf)
        for _ in range(NEWTON_STEPS):
            value = np.einsum("nq,nqi->ni", library.evaluate(x), coefficients)
            matrix = jacobians(x, coefficients)
            matrix = matrix + SINGULAR_SHIFT * np.abs(matrix).max(axis=(1, 2), keepdims=True) * np.eye(d)
            change = np.linalg.solve(matrix, value[..., None])[..., 0]
            moved = np.abs(change / width).max(axis=1)
            lost |= ~(moved < 1.0)
            x = np.where(lost[:, None], start, x - change)
        positive_rates = (np.linalg.eigvals(jacobians(x, coefficients)).real > 0).sum(axis=1)
        lost |= (moved > NEWTON_TOLERANCE) | (positive_rates != unstable)
        x = np.where(lost[:, None], start, x)
    places, gone = x.reshape(len(starts), -1, d), lost.reshape(len(starts), -1)
    far = np.abs((places - starts[:, None]) / width).max(axis=2)
    same = np.abs((places[:, None] - places) / width).max(axis=3) < EQUILIBRIUM_MERGE_TOLERANCE
    same &= ~gone[:, None] & ~gone & ~np.eye(len(starts), dtype=bool)[:, :, None]
    # Whichever came from afar has jumped; both have where they come from equally far.
    return np.asarray((gone | (same & (far[:, None] > far / 2)).any(axis=1)).mean(axis=1))


def check_existence(found: FieldEstimate, portrait: PhasePortrait, *, seed: int = 0) -> Verdict:
    """Whether attractors and the saddles between them exist with the whole uncertainty of f."""
    saddles = {one.position.tobytes(): one for around in portrait.saddles for one in around}
    claimed = [*portrait.attractors, *saddles.values()]
    shares = _lost_shares(found, claimed, box=portrait.box, seed=seed)
    if not len(shares):
        return Verdict(0.0, MAX_LOST_SHARE, True)
    worst = int(np.argmax(shares))
    value, one = float(shares[worst]), claimed[worst]
    kind = "stable state" if one.kind == "attractor" else "saddle"
    return Verdict.of(
        value, MAX_LOST_SHARE,
        f"the recordings do not tell whether there is a {kind} at {place_text(one.position)}: it is missing"
        f" in {percent(value)} of the f that they allow for; record more about it",
    )  # fmt: skip
