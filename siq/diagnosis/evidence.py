"""Evidence: is an explanation likelier than another, and could chance do as much?

**Chance.** White errors are those of a perfect simulation. Of one that lacks more than the mechanism in
question, errors are autocorrelated over a whole recording; only recordings, or blocks that are long compared
with the correlations, count as independent. Of n errors with an integral correlation time τ, n/τ are
independent; logarithms of likelihoods are divided by τ, as those of so many errors are.

**Marginal likelihoods.** Along the trajectories of a fit everything is linear, with normal priors K of the
coefficients: log L = -½ log det(1 + K G) - ½ν log(1 - q/total), q = bᵀ K (1 + G K)⁻¹ b, for columns with the
Gram matrix G and the overlap b with the innovations. How large an effect is nobody knows beforehand, so that
its size on the recordings is drawn evenly on a logarithmic scale. A smooth function could have been anything,
and pays for it the more, the more the recordings tell (MacKay, Information Theory, Inference, and Learning
Algorithms, chapter 28). Whole fits are compared by Schwarz's approximation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.stats

from siq.data.correlation import correlation_time_of
from siq.diagnosis.mechanisms import MechanismCandidate
from siq.errors import NumericalFailure
from siq.inference.kalman_filter import Noise, Whitened, solve, whiten
from siq.inference.maximum_likelihood import Fit
from siq.inference.measurements import Measurements
from siq.numerics.randomness import positive
from siq.remarks import Remark, sentence

BLOCK_CORRELATION_TIMES = 4.0  # correlation times in a block
# Of the range of the coordinate, over which a smooth function without a name changes. What is smoother is a
# constant, a straight line or a parabola, for which there are names.
SMOOTH_LENGTHS = (0.125, 0.25)
PRIOR_JITTER = 1e-9  # numerical: on the diagonal of a prior's covariance
BUDGET_SPENT, OVERFLOWS = Remark("diagnosis.not_reached"), Remark("diagnosis.overflows")
NUMERICAL_ERRORS = (ArithmeticError, ValueError, np.linalg.LinAlgError)
"""What ends a candidate, never the search: an overflow, a division by zero, a singular matrix."""


@dataclass(frozen=True)
class FittedCandidate:
    """A candidate with its fit, and how that compares with the simulation without it."""

    candidate: MechanismCandidate  #: what was added
    fit: Fit  #: of the simulation with it
    delta_chi2: float  #: twice the increase of the log-likelihood
    #: Change of the Bayesian information criterion; negative where it is worth its parameters.
    delta_bic: float
    p_white: float  #: probability of as much by chance, errors being independent
    p_cluster: float  #: the same where those of a recording belong together

    @classmethod
    def of(
        cls, trial: Fit, before: Fit, data: Measurements, candidate: MechanismCandidate, *, blocks: int
    ) -> FittedCandidate:
        """A candidate's fit with its evidence over the fit without it."""
        extra = len(trial.model.free) - len(before.model.free)
        # Where each recording begins in a state that the candidate brings is a parameter, too.
        beginnings = (trial.model.dimension - before.model.dimension) * len(data.labels)
        gained = 2 * (trial.log_likelihood - before.log_likelihood)
        count = trial.degrees_of_freedom + len(trial.model.free)
        return cls(
            candidate=candidate, fit=trial, delta_chi2=gained,
            delta_bic=-gained + extra * np.log(count) + beginnings * np.log(max(count / len(data.labels), 2)),
            p_white=float(scipy.stats.chi2.sf(max(gained, 0.0), extra + beginnings)),
            p_cluster=probability_by_chance(trial, before, data, candidate, blocks=blocks),
        )  # fmt: skip


@dataclass(frozen=True)
class NotFitted:
    """A candidate that promised something and could not be judged, and why."""

    mechanism: str
    label: str
    remark: Remark

    @classmethod
    def of(cls, candidate: MechanismCandidate, why: Remark | Exception) -> NotFitted:
        """Of a candidate, with a remark or what ended its fit."""
        if isinstance(why, Remark):
            return cls(candidate.name, candidate.label, why)
        kind = "" if isinstance(why, NumericalFailure) else type(why).__name__
        values = {"error": kind, "message": str(why)}
        return cls(candidate.name, candidate.label, Remark("diagnosis.fit_failed", values))

    @property
    def reason(self) -> str:
        """Why, in words."""
        return sentence(self.remark)


def residuals(
    fit: Fit, data: Measurements, noise: Noise | None = None
) -> tuple[Whitened, np.ndarray, np.ndarray]:
    """Whitened innovations of a fit, the last step of its parameters, and what they leave, in units of noise.

    The noise is that of the fit by default.
    """
    white = whiten(fit.linearisation, data, fit.noise if noise is None else noise)
    change, _ = solve(white.columns, white.innovations)
    return white, change, white.innovations - white.columns @ change


def _blocks_of(recording: np.ndarray, left: np.ndarray, *, least: int) -> np.ndarray:
    """The block of each residual, numbered from 0; recordings are cut into at least so many."""
    recordings = np.unique(recording)
    block, begun = np.empty(len(recording), dtype=int), 0
    for place in recordings:
        rows = np.flatnonzero(recording == place)
        lasting = correlation_time_of(left[rows], recording[rows], least=0.0)
        parts = max(-(-least // len(recordings)), int(len(rows) / (BLOCK_CORRELATION_TIMES * lasting)))
        block[rows] = begun + (np.arange(len(rows)) * parts) // len(rows)
        begun += parts
    return block


def probability_by_chance(
    fit: Fit, before: Fit | None, data: Measurements, candidate: MechanismCandidate, *, blocks: int
) -> float:
    """Probability of a mechanism by chance, where errors of a recording are autocorrelated.

    Among many recordings each counts as one (`_clustered_probability`). Of a few, blocks are too few to know
    a covariance from them; how long errors are correlated is known all the same (`_correlated_probability`).

    Parameters
    ----------
    fit, before
        With the mechanism and without it; None where there is no such fit.
    data, candidate
        The recordings, and the mechanism.
    blocks
        Where there are fewer recordings than half of it, they are few.
    """
    few = len(data.labels) < blocks // 2
    if few and not (before is None or fit.has_process_noise or before.has_process_noise):
        gained = 2 * (fit.log_likelihood - before.log_likelihood)
        return _correlated_probability(fit, data, candidate, gained=gained)
    white, change, left = residuals(fit, data)
    tested = np.array(candidate.places(fit, linear=True), dtype=int)
    values = fit.model.values[[fit.model.free[place] for place in tested]] + change[tested]
    owner = _blocks_of(white.recording, left, least=blocks) if few else white.recording
    nuisance = orthonormal(np.delete(white.columns, tested, axis=1))
    columns = white.columns[:, tested] - nuisance @ (nuisance.T @ white.columns[:, tested])
    scale = positive(np.sqrt((columns**2).sum(axis=0)))
    columns = columns / scale
    scores = np.stack([np.bincount(owner, column * left) for column in columns.T], axis=1)
    count, width = len(scores), len(tested)
    if count <= width + 1:
        return 1.0
    spread = scores.T @ scores * count / (count - 1)
    # Wald: a' (G⁻¹ S G⁻¹)⁻¹ a = (G a)' S⁻¹ (G a).
    weighted = columns.T @ columns @ (values * scale)
    statistic = float(weighted @ np.linalg.lstsq(spread, weighted, rcond=1e-10)[0])
    factor = (count - width) / (width * (count - 1))
    return float(scipy.stats.f.sf(statistic * factor, width, count - width))


def _correlated_probability(
    fit: Fit, data: Measurements, candidate: MechanismCandidate, *, gained: float
) -> float:
    """Probability by chance of a gain in twice the log-likelihood, where errors are autocorrelated.

    It weighs less by their correlation time. Places at which a shape was looked for are chances, too.
    """
    white, _, left = residuals(fit, data)
    weights = np.bincount(white.recording)
    parts = [white.recording == place for place in range(len(weights))]
    times = [correlation_time_of(left[rows], white.recording[rows], least=0.0) for rows in parts]
    together = float(np.average(times, weights=weights))
    # Frequencies up to four samples a period, each a turn over all recordings from the next.
    told = int(np.ptp(data.t) / np.median(data.step[data.begins]) / 4)
    places = [
        max(each.frequencies, told) if each.frequencies else len(each.at) for each in candidate.searches
    ]
    alone = float(scipy.stats.chi2.sf(max(gained, 0.0) / together, max(len(candidate.new), 1)))
    return min(1.0, float(np.prod(places)) * alone)


def orthonormal(columns: np.ndarray) -> np.ndarray:
    """Orthonormal basis of what columns span, shape ``(n, r)``."""
    if not columns.shape[1]:
        return columns
    scale = positive(np.sqrt((columns**2).sum(axis=0)))
    basis, values, _ = np.linalg.svd(columns / scale, full_matrices=False)
    return basis[:, values > 1e-9 * values[0]] if values[0] > 0 else basis[:, :0]


def sizes_of_effects(total: float) -> np.ndarray:
    """Expected squares of an effect's size on the recordings, in units of noise, evenly on a logarithm."""
    return np.exp2(np.arange(0.0, max(np.log2(max(total, 2.0)), 1.0) + 2))


def smooth_prior(knots: np.ndarray, length: float) -> np.ndarray:
    """Covariance of a smooth function at knots, as a share of whose range the length is given."""
    distance = np.subtract.outer(knots, knots) / np.ptp(knots)
    return np.exp(-0.5 * (distance / length) ** 2) + PRIOR_JITTER * np.eye(len(knots))


def averaged_evidence(
    gram: np.ndarray, overlap: np.ndarray, priors: Sequence[np.ndarray], total: float, freedom: float
) -> float:
    """Log-likelihood of columns with normal coefficients over that without them, averaged over priors."""
    values = []
    for prior in priors:
        inner = np.eye(len(gram)) + gram @ prior
        sign, determinant = np.linalg.slogdet(inner)
        left = max(total - float(overlap @ (prior @ np.linalg.solve(inner, overlap))), 1e-12 * total)
        value = float(-0.5 * determinant - 0.5 * freedom * np.log(left / total))
        values.append(value if sign > 0 else -np.inf)
    return float(scipy.special.logsumexp(values) - np.log(len(values)))


def evidences_by_size(
    gram: np.ndarray, overlap: np.ndarray, total: float, *, freedom: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Log-likelihood of columns with independent normal coefficients, over that of none, by their size.

    Parameters
    ----------
    gram, overlap
        Of the columns with each other and with the target, in units of noise; shapes ``(k, k)`` and ``(k,)``.
    total, freedom
        Sum of squares of the target, and its degrees of freedom.

    Returns
    -------
    gained, variance, rest
        Shape ``(s,)`` each: the log-likelihood; the variance of the coefficients, in units of the noise as it
        is with the columns; and the sum of squares then. All zero where no column does anything.
    """
    # In the eigenvectors of what the recordings tell, the evidence is a sum for every size.
    told, vectors = np.linalg.eigh(gram)
    told = np.maximum(told, 0.0)
    sizes = sizes_of_effects(total)
    if not told.any():
        return np.zeros(len(sizes)), np.zeros(len(sizes)), np.full(len(sizes), total)
    seen = (vectors.T @ overlap) ** 2
    scale = sizes[:, None] / told.sum()
    left = np.maximum(total - (scale * seen / (1 + scale * told)).sum(axis=1), 1e-12 * total)
    gained = -0.5 * np.log1p(scale * told).sum(axis=1) - 0.5 * freedom * np.log(left / total)
    return gained, scale[:, 0], left


def evidence_of_function(
    columns: np.ndarray, target: np.ndarray, knots: np.ndarray, *, freedom: float
) -> float:
    """Log-likelihood of a smooth function, averaged over its values, size and smoothness, to that of nothing.

    Parameters
    ----------
    columns
        What its value at each knot does to the innovations, in units of noise, shape ``(n, k)``.
    target
        The innovations, shape ``(n,)``.
    knots
        Shape ``(k,)``.
    freedom
        Degrees of freedom of the target.
    """
    total, values = float(target @ target), []
    for length in SMOOTH_LENGTHS:
        along = columns @ np.linalg.cholesky(smooth_prior(knots, length))
        values.append(evidences_by_size(along.T @ along, along.T @ target, total, freedom=freedom)[0])
    return float(scipy.special.logsumexp(values) - np.log(np.size(values)))


def _log_evidence_of(fit: Fit, data: Measurements, *, correlated: float = 1.0) -> float:
    """Log-likelihood of an explanation, less what its parameters gain by chance: log L/τ - ½ k log(n/τ).

    Schwarz's approximation of the marginal likelihood, with process noise counted as parameters and those
    left out of which the recordings tell nothing. Of parameters of which something is expected together, such
    as the heights of a smooth function, the likelihood is averaged over that (Laplace's approximation, -½ log
    det(1 + K G)), so that they count as few as the data tell. Where a recording begins is a parameter for
    each state, told or not, so that one more hidden state has to be worth its beginnings. Errors have the
    correlation time τ in samples.
    """
    white = whiten(fit.linearisation, data, fit.noise)
    names = [fit.model.parameters[place].name for place in fit.model.free]
    smooth = {name for each in fit.model.expected_together for name in each.names}
    basis = orthonormal(white.columns[:, [name not in smooth for name in names]])
    variances = int((fit.noise.process > 0).sum())
    count = max(float(white.known.sum()) / correlated, 2.0)
    price = 0.5 * (basis.shape[1] + variances) * np.log(count)
    price += 0.5 * fit.model.dimension * len(data.labels) * np.log(max(count / len(data.labels), 2.0))
    if smooth:
        together = fit.model.expected_together
        own = white.columns[:, [names.index(name) for each in together for name in each.names]]
        own = own - basis @ (basis.T @ own)
        roots = scipy.linalg.block_diag(*(each.roots for each in together))
        told = np.linalg.svd(scipy.linalg.solve(roots.T, own.T), compute_uv=False) ** 2
        price += 0.5 * float(np.log1p(told / correlated).sum())
    return float(fit.log_likelihood / correlated - price)


def log_evidences(fits: Sequence[Fit], data: Measurements) -> list[float]:
    """The evidence of whole explanations that are compared (`_log_evidence_of`).

    Errors are as correlated as the likeliest leaves them: what the others leave is rather the effect that
    they lack.
    """
    known, correlated = [each for each in fits if np.isfinite(each.log_likelihood)], 1.0
    if known:
        closest = max(known, key=lambda each: each.log_likelihood)
        white, _, left = residuals(closest, data)
        correlated = correlation_time_of(left, white.recording, outputs=len(closest.model.outputs))
    return [_log_evidence_of(each, data, correlated=correlated) for each in fits]
