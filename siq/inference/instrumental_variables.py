"""Instrumental variables: f from recordings whose neighbouring errors are correlated.

The increment from one sample to the next is not told by the present sample alone, and the regression of it on
functions of that sample is biased: of a state that coloured forces drive it gives no f at all. But a sample
L steps earlier knows nothing of what is remembered, once L is the lag from which on the record is Markovian
(`siq.data.correlation`). Then

    ``Σ_t θ(x(t-L)) ⊗ (x(t+h) - Φ_h(x(t); f)) = 0``

holds in the mean for the true f and no other: the functions of the earlier state are instruments. Every
sample begins such a pair, so that they overlap, and their residuals are correlated up to the lag L. Sums of
them have the long-run covariance ``Ω = C_0 + Σ_{k≤L} (C_k + C_kᵀ)``, from which standard errors follow, and
the strength of the forces: they act over longer times as white ones of the covariance Ω/h per time.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg
import scipy.special

from siq.data.correlation import MarkovLag
from siq.data.recordings import Recordings, SnapshotPairs, parent_recordings, select_recordings
from siq.data.stationarity import even_stretches, lagged_covariances, long_run_covariance
from siq.errors import NumericalFailure
from siq.inference.field_estimate import IdentifiedField, flow_map
from siq.inference.flow_regression import FlowRegression, copies, positive
from siq.inference.identification import IdentificationOptions
from siq.inference.library import CandidateLibrary
from siq.inference.residuals import NoiseDiagnosis
from siq.inference.selection import Equation, best_support, critical_values, rivals_by_equation, weakest_term
from siq.systems.diffusion import Diffusion

ROUNDS = 6  # of deferred correction, each of which gains a factor of about h times the Jacobian
TELLING = 0.1  # a correlation, as in `siq.data.correlation`: of a function that is told less well nothing is
FEW, MANY = 3, 60  # numerical: terms left of so many functions, of which all exchanges are tried in passing
SAMPLE = 500  # pairs by which the accuracy of the flow is judged


@dataclass(frozen=True)
class LaggedPairs:
    """Neighbouring samples, each pair with the sample some steps earlier.

    Attributes
    ----------
    earlier
        Shape ``(n, d)``: the states L steps before the pairs begin.
    pairs
        The pairs.
    number
        Shape ``(n,)``: the stretch that a pair is from; pairs of a stretch follow each other.
    lag
        L.
    """

    earlier: np.ndarray
    pairs: SnapshotPairs
    number: np.ndarray
    lag: int

    @property
    def independent(self) -> float:
        """Number of pairs that tell as much as all of these, whose residuals go together."""
        return len(self.pairs.h) / (2 * self.lag + 1)


def lagged_pairs(recordings: Recordings, lag: int) -> LaggedPairs:
    """All pairs of neighbouring samples that a sample `lag` steps earlier is known of.

    Raises
    ------
    NumericalFailure
        When there is none.
    """
    stretches = even_stretches(recordings)
    at = stretches.within(lag)
    if not len(at):
        raise NumericalFailure(
            f"the recordings remember for {lag} steps, and none has as many even steps in a row; record"
            " longer without gaps"
        )
    now = at + lag
    x, t = recordings.values, recordings.t
    recording = parent_recordings(recordings.labels)[recordings.recording[now]]
    pairs = SnapshotPairs(x[now], x[now + 1], t[now + 1] - t[now], recording)
    return LaggedPairs(x[at], pairs, stretches.number[now], lag)


def lagged_parts(recordings: Recordings, lag: int, held: np.ndarray) -> tuple[LaggedPairs, LaggedPairs]:
    """Those of recordings that are not held out, and of those that are, by a mask over the recordings."""
    return (
        lagged_pairs(select_recordings(recordings, np.flatnonzero(~held)), lag),
        lagged_pairs(select_recordings(recordings, np.flatnonzero(held)), lag),
    )


def coarse_pairs(recordings: Recordings, lag: int, *, lost: float) -> SnapshotPairs:
    """Pairs so far apart that each begins where the last one ends, and none knows of the noise of the other.

    Parameters
    ----------
    recordings
        Trajectories that remember.
    lag
        For so many steps.
    lost
        See `lost_time`. By so much less than the pairs are apart is their `h`: given where a pair begins, its
        mean and its variance are those of white forces in that shorter time, but for what circulates.
    """
    stretches = even_stretches(recordings)
    at = stretches.within(lag - 1)
    # The first of each stretch, and every one that is a whole number of lags later.
    _, begins, which = np.unique(stretches.number[at], return_index=True, return_inverse=True)
    at = at[(np.arange(len(at)) - begins[which]) % lag == 0]
    x, t = recordings.values, recordings.t
    h = np.maximum(t[at + lag] - t[at] - lost, 0.5 * stretches.step)
    return SnapshotPairs(
        x[at], x[at + lag], h, parent_recordings(recordings.labels)[recordings.recording[at]]
    )


def lost_time(found: IdentifiedField, given: LaggedPairs) -> float:
    """By how much the memory delays what forces do: the time that a displacement lags behind a white one's.

    Over k steps the residuals add up to the variance ``kΩ - 2Σ_j j C_j``, as if ``2Σ_j j C_j / Ω`` steps were
    missing: the memory of coloured forces, a third of an exposure.
    """
    rest = residuals_from_earlier(found, given)
    covariances = lagged_covariances(rest - rest.mean(axis=0), given.number, given.lag)
    weighted = 2 * np.einsum("k,kij->ij", np.arange(len(covariances), dtype=float), covariances)
    whole = long_run_covariance(covariances, given.lag)
    share = float(np.trace(np.linalg.solve(whole, weighted))) / len(whole)
    return share * float(np.median(given.pairs.h))


class _Moments:
    """Increments and functions, as far as functions of earlier states know them."""

    def __init__(self, library: CandidateLibrary, given: LaggedPairs) -> None:
        self.library, self.given = library, given
        instruments = library.evaluate(given.earlier)
        if not np.isfinite(instruments).all():
            raise NumericalFailure("a library function of the vector field is not finite on some pairs")
        instruments = instruments / positive(np.linalg.norm(instruments, axis=0))
        self.directions = np.linalg.qr(instruments)[0]
        everything = np.array([(i, k) for i in range(library.dimension) for k in range(library.size)])
        self.all_terms = FlowRegression(library, given.pairs, everything)
        self.functions = self.directions.T @ (self.all_terms.theta * given.pairs.h).T
        # Residuals of copies of resampled recordings are no further evidence.
        self.repeated = copies(given.pairs)

    def told(self) -> np.ndarray:
        """From increments along the instruments to coefficients of those functions that these tell of.

        Of some function nothing may be known from an earlier state. Its coefficient would be chance, as large
        as the error of its own instrument is small, and so would be all that is said of what is left.
        """
        orthogonal, upper = np.linalg.qr(self.all_terms.theta.T * self.given.pairs.h[:, None])
        known = np.linalg.pinv(self.directions.T @ orthogonal, rcond=TELLING)
        return np.asarray(np.linalg.lstsq(upper, known, rcond=1e-12)[0])

    def increments(self, problem: FlowRegression, values: np.ndarray | None) -> np.ndarray:
        """``h f(X0)`` as the pairs have it, once their flow is taken into account: shape ``(n, d)``."""
        h = self.given.pairs.h
        if values is None:
            return problem.corrected(np.zeros(len(problem.support)), None, None) * h[:, None]
        every = slice(None, None, max(len(h) // SAMPLE, 1))
        flow = flow_map(
            problem.field(values), problem.x0[:, every], h[every], integrator_step=None, tolerance=1e-6
        )
        return problem.corrected(values, flow, None) * h[:, None]

    def long_run(self, rest: np.ndarray) -> np.ndarray:
        """Ω of residuals: positive definite."""
        covariances = lagged_covariances(rest - rest.mean(axis=0), self.given.number, self.given.lag)
        found = long_run_covariance(covariances, self.given.lag)
        found = (found + found.T) / 2
        if not np.linalg.eigvalsh(found)[0] > 0:
            raise NumericalFailure(
                f"beyond the {self.given.lag} steps for which the recordings remember no random forces are"
                " left; record longer, or sample more often"
            )
        return np.asarray(found)


def identify_from_earlier(
    library: CandidateLibrary,
    given: LaggedPairs,
    *,
    options: IdentificationOptions,
    diffusion: Diffusion | None = None,
) -> IdentifiedField:
    """Find f by instruments.

    Parameters
    ----------
    library
        The candidate functions; those of the earlier states are the instruments.
    given
        Pairs with earlier states.
    options
        What makes a term significant.
    diffusion
        D, by default the unit matrix; f does not depend on it.

    Raises
    ------
    NumericalFailure
        When there are fewer independent pairs than functions, or no term of an equation is significant.

    Notes
    -----
    Two-stage least squares: functions and increments are projected on the instruments, and fitted there. The
    terms of each equation are chosen there (`siq.inference.selection`).
    """
    q, d = library.size, library.dimension
    if given.independent < 2 * q:
        raise NumericalFailure(
            f"only {given.independent:.0f} independent pairs for {q} candidate functions of f;"
            " lower identification.degree or record more"
        )
    moments = _Moments(library, given)
    critical = critical_values(library, false_terms=options.false_terms)
    values: np.ndarray | None = None
    for _ in range(2):
        moved = moments.increments(moments.all_terms, values)
        values = (moments.told() @ (moments.directions.T @ moved)).T.ravel()
    assert values is not None
    rest = moved - (moments.all_terms.matrix(values) @ (moments.all_terms.theta * given.pairs.h)).T
    spread = moments.long_run(rest) * moments.repeated
    equations = [
        Equation(moments.functions, moments.directions.T @ moved[:, i], float(spread[i, i]), critical)
        for i in range(d)
    ]
    support = [(i, k) for i, one in enumerate(equations) for k in best_support(one)]
    missing = sorted(set(range(d)) - {i for i, _ in support})
    if missing:
        raise NumericalFailure(
            f"no term of the equation of {library.states[missing[0]]} is significant: what is recorded"
            f" remembers for {given.lag} steps, and states so much earlier tell too little of its motion;"
            " record longer, or a quantity that fluctuates less"
        )
    noise = Diffusion.identity(d) if diffusion is None else diffusion
    while True:
        found = _fitted(moments, np.array(support), noise)
        strength = np.abs(found.values) / np.sqrt(np.diag(found.covariance)) / critical[found.support[:, 1]]
        weak = weakest_term(strength, found.support)
        if weak is None:
            return replace(found, rivals=rivals_by_equation(equations, found.support))
        del support[weak]


def refit_from_earlier(found: IdentifiedField, given: LaggedPairs) -> IdentifiedField:
    """The same terms fitted to other pairs."""
    return _fitted(_Moments(found.library, given), found.support, found.diffusion)


def residuals_from_earlier(found: IdentifiedField, given: LaggedPairs) -> np.ndarray:
    """``Xh - Φ_h(X0; f)``, shape ``(n, d)``; forces with a memory shift no mean within a step."""
    problem = FlowRegression(found.library, given.pairs, found.support)
    velocity = problem.corrected(found.values, found.flow, None)
    return (velocity - problem.predicted(found.values)) * given.pairs.h[:, None]


def mean_probability_from_earlier(fitted: IdentifiedField, unseen: LaggedPairs, *, seen: int) -> float:
    """Probability of the held-out residuals having no mean left that f's library could express.

    Parameters
    ----------
    fitted
        f, without the held-out pairs.
    unseen
        These.
    seen
        Number of the pairs that f was fitted to: its own error adds the share ``len(unseen)/seen`` at most.

    Returns
    -------
    float
        Smallest over the states, corrected for their number: tiny where f misses a term.
    """
    moments = _Moments(fitted.library, unseen)
    rest = residuals_from_earlier(fitted, unseen)
    spread = np.diag(fitted.noise_rate) * float(np.median(unseen.pairs.h)) * moments.repeated
    squares = ((moments.directions.T @ rest) ** 2).sum(axis=0) / spread / (1 + len(rest) / seen)
    q = fitted.library.size
    return float(min(scipy.special.chdtrc(q, squares).min() * rest.shape[1], 1.0))


def _fitted(moments: _Moments, support: np.ndarray, diffusion: Diffusion) -> IdentifiedField:
    """Generalised least squares of the projected problem on a support."""
    library, given = moments.library, moments.given
    d, h = library.dimension, given.pairs.h
    problem = FlowRegression(library, given.pairs, support)
    spread = np.eye(d)
    values: np.ndarray | None = None
    for _ in range(ROUNDS):
        moved = moments.increments(problem, values)
        whiten = scipy.linalg.solve_triangular(np.linalg.cholesky(spread), np.eye(d), lower=True)
        design = np.stack(
            [np.outer(whiten[:, i], moments.functions[:, k]).ravel() for i, k in support], axis=1
        )
        goal = (whiten @ (moments.directions.T @ moved).T).ravel()
        # Scaled columns, for functions may differ by many orders of magnitude.
        scale = positive(np.linalg.norm(design, axis=0))
        inverse = np.linalg.pinv(design / scale) / scale[:, None]
        previous, values = values, inverse @ goal
        rest = moved - (problem.matrix(values) @ (problem.theta * h)).T
        spread = moments.long_run(rest)
        if previous is not None and (np.abs(values - previous) <= 1e-6 * np.abs(values)).all():
            break
    assert values is not None
    coefficients = np.zeros((library.size, d))
    coefficients[support[:, 1], support[:, 0]] = values
    every = slice(None, None, max(len(h) // SAMPLE, 1))
    flow = flow_map(
        problem.field(values), problem.x0[:, every], h[every], integrator_step=None, tolerance=1e-6
    )
    moved_size = ((given.pairs.xh - given.pairs.x0) ** 2).mean(axis=0)
    ratio = float(np.sqrt(((rest**2).mean(axis=0) / positive(moved_size)).mean()))
    return IdentifiedField(
        library, coefficients, support, inverse @ inverse.T * moments.repeated,
        spread / float(np.median(h)), ratio, flow, diffusion,
    )  # fmt: skip


NEAR = 0.05  # of an exposure, as exactly as residuals show it of some thousand samples
CAUSES = {
    "blur": "each sample is the mean over an exposure of {memory}",
    "coloured": "the random forces, or a slow sensor, have a memory of {memory}",
    "memory": "what is recorded remembers for some steps, as with an oscillation or a state not recorded",
    "either": "samples are means over an exposure, or the random forces have a memory",
}


def possible_exposures(found: MarkovLag) -> list[float]:
    """Exposures that samples may be means over, the likeliest first; none where they are no such means.

    A camera is mostly exposed for a whole number of steps: where the memory is near one, that is tried first.
    One that may be as well that of coloured forces says no more than that; only a whole step is tried then.
    """
    if found.kind == "either":
        return [found.step]
    if found.kind != "blur":
        return []
    steps = found.memory / found.step
    whole = round(steps)
    near = [whole * found.step] if abs(steps - whole) < NEAR * steps else []
    return [*near, found.memory]


def memory_text(found: MarkovLag, *, time_unit: str | None = None) -> str:
    """Why a record remembers, for how long, and what is made of it: a clause without a full stop."""
    unit = f" {time_unit}" if time_unit else ""
    cause = CAUSES[found.kind].format(memory=f"{found.memory:.2g}{unit}")
    return (
        f"{cause}: from {found.lag} sampling steps ({found.time:.2g}{unit}) on the recordings are"
        " Markovian, and f was identified by what samples so much earlier tell of each increment"
    )


def lagged_noise(
    found: IdentifiedField, memory: MarkovLag, *, independent: int, time_unit: str | None = None
) -> NoiseDiagnosis:
    """The random forces as they act beyond their memory, held against D.

    Parameters
    ----------
    found
        f with D, and the long-run covariance of its residuals.
    memory
        Why the recordings remember.
    independent
        Number of independent residuals that the covariance is known from.
    time_unit
        Of the recordings.
    """
    noise, d = found.diffusion, found.library.dimension
    intensity = noise.intensity(found.noise_rate)
    covariance = found.noise_rate / intensity
    excess = np.abs(noise.whitening @ covariance @ noise.whitening.T - np.eye(d))
    score = float((excess / np.sqrt((1 + np.eye(d)) / independent)).max())
    state = int(np.argmax(np.abs(memory.correlations[0])))
    correlation = float(memory.correlations[0, state])
    return NoiseDiagnosis(
        "process", intensity, covariance, float(excess.max()), score,
        correlation, correlation / float(memory.errors[0, state]), np.zeros(d),
        memory=memory_text(memory, time_unit=time_unit),
    )  # fmt: skip
