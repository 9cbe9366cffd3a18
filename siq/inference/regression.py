"""Regression of f on pairs of samples: weighted, by instruments, sparse.

A pair has ``Xh = Φ_h(X0; f) + noise`` with ``f = Θ Ξ`` and the flow Φ. Deferred correction makes this a
linear problem: with the current f the difference between the flow and ``X0 + h f(X0)`` is subtracted from the
data, and a few rounds reach the exact answer. All functions of a library are fitted first. Terms are dropped
by their own uncertainty, and under noise exchanged as long as that helps (`siq.inference.selection`). What
remains is fitted by generalised least squares with the covariance that the residuals show. Where D depends on
the state each pair has weights of its own: with one weight for all, standard errors would be wrong.

Where neighbouring errors are correlated, the regression of an increment on functions of the present sample is
biased. But a sample L steps earlier knows nothing of them, once L is the lag from which on the record is
Markovian (`siq.data.correlation`). Then

    ``Σ_t θ(x(t-L)) ⊗ (x(t+h) - Φ_h(x(t); f)) = 0``

holds in the mean for the true f and no other: the functions of the earlier state are instruments. Such pairs
overlap, and sums of their residuals have the long-run covariance ``Ω = C_0 + Σ_{k≤L} (C_k + C_kᵀ)``, from
which standard errors follow, and the process noise: over longer times it is white, Ω/h per time.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
import scipy.linalg
from scipy.special import erfc

from siq.data.recordings import Recordings, SnapshotPairs, StreamedPairs, parents_of
from siq.data.stationarity import even_stretches, lagged_covariances, long_run_covariance
from siq.errors import NumericalFailure
from siq.inference.diffusion_model import ResidualLikelihood
from siq.inference.field_estimate import HARMLESS_BIAS, NOISE_FREE, FieldEstimate
from siq.inference.library import CandidateLibrary, IdentificationOptions
from siq.inference.selection import (
    LinearProblem,
    all_coefficients,
    best_support,
    blocks_of,
    chosen_terms,
    critical_values,
    fit_significant,
    model_average,
    stability,
    stacked_triangle,
    strong_terms,
    triangles,
)
from siq.inference.transition_densities import Transitions
from siq.numerics.integration import FlowMap
from siq.numerics.randomness import positive
from siq.systems.diffusion import Diffusion
from siq.systems.formulas import compile_formulas

CORRECTION_ROUNDS = 25  # of deferred correction, each of which gains a factor of about h times the Jacobian
INSTRUMENT_ROUNDS = 6  # the same with instruments
WEIGHT_ROUNDS = 2  # of D by the residuals of f, and f by the weights of D: each changes the other by little
CHUNK, WEIGHTED_CHUNK = 4096, 20_000  # pairs worked on together
MIN_INSTRUMENT_CORRELATION = 0.1  # of a function that its instrument tells less well nothing is known
FORGOTTEN = 1e-3  # chance with which samples that know nothing of each other still pass for a motion
LOCAL = 1e-3  # of what noise moves a state by within a step: there f is a straight line
FLOW_SAMPLE = 500  # pairs by which the accuracy of the flow is judged


@dataclass(frozen=True)
class LaggedPairs(SnapshotPairs):
    """Neighbouring samples, each pair with the state L steps earlier, ``(n, d)``, L being the lag.

    The `number` is that of the stretch that a pair is from, ``(n,)``; pairs of a stretch follow each other.
    """

    earlier: np.ndarray
    number: np.ndarray
    lag: int

    @property
    def independent(self) -> float:
        """Number of pairs that tell as much as all of these, whose residuals are correlated."""
        return len(self.h) / (2 * self.lag + 1)

    def directions(self, library: CandidateLibrary) -> np.ndarray:
        """An orthonormal basis of the functions of earlier states, which are the instruments: ``(n, q)``."""
        values = library.evaluate(self.earlier)
        if not np.isfinite(values).all():
            raise NumericalFailure("a library function of the vector field is not finite on some pairs")
        return np.linalg.qr(values / positive(np.linalg.norm(values, axis=0)))[0]

    def long_run(self, rest: np.ndarray) -> np.ndarray:
        """Ω of residuals ``(n, d)``: positive definite."""
        covariances = lagged_covariances(rest - rest.mean(axis=0), self.number, self.lag)
        found = long_run_covariance(covariances, self.lag)
        found = (found + found.T) / 2
        if not np.linalg.eigvalsh(found)[0] > 0:
            raise NumericalFailure(
                f"beyond the {self.lag} steps over which the recordings are correlated no process noise is"
                " left; record longer, or sample more often"
            )
        return np.asarray(found)


def lagged_pairs(recordings: Recordings, lag: int) -> LaggedPairs:
    """All pairs of neighbouring samples that a sample `lag` steps earlier is known of: at least one."""
    stretches = even_stretches(recordings)
    at = stretches.within(lag)
    if not len(at):
        raise NumericalFailure(
            f"the recordings are correlated over {lag} steps, and none has as many even steps in a row;"
            " record longer without gaps"
        )
    now = at + lag
    x, t = recordings.values, recordings.t
    parents, copies = parents_of(recordings, recordings.recording[now])
    own = x[at], stretches.number[now], lag
    return LaggedPairs(x[now], x[now + 1], t[now + 1] - t[now], parents, *own, copies=copies)


def coarse_pairs(recordings: Recordings, lag: int, *, lost: float) -> SnapshotPairs:
    """Pairs so far apart that each begins where the last one ends, and none knows of the noise of the other.

    The recordings are Markovian from so many steps on. By the lost time (`lost_time`) less than the pairs are
    apart is their `h`: given where a pair begins, its mean and its variance are those of white noise in that
    shorter time, but for what circulates.
    """
    stretches = even_stretches(recordings)
    at = stretches.within(lag - 1)
    # The first of each stretch, and every one that is a whole number of lags later.
    _, begins, which = np.unique(stretches.number[at], return_index=True, return_inverse=True)
    at = at[(np.arange(len(at)) - begins[which]) % lag == 0]
    x, t = recordings.values, recordings.t
    h = np.maximum(t[at + lag] - t[at] - lost, 0.5 * stretches.step)
    parents, copies = parents_of(recordings, recordings.recording[at])
    return SnapshotPairs(x[at], x[at + lag], h, parents, copies=copies)


def lost_time(found: FieldEstimate, given: LaggedPairs) -> tuple[float, float]:
    """By how much correlations delay what noise does, and the standard error that it has where they do not.

    Over k steps the residuals add up to the variance ``kΩ - 2Σ_j j C_j``, as if ``2Σ_j j C_j / Ω`` steps were
    missing: the correlation time of coloured noise, a third of an integration time. Of n white residuals
    ``C_j`` has the error ``Ω/√n``.
    """
    rest = residuals(found, given)
    covariances = lagged_covariances(rest - rest.mean(axis=0), given.number, given.lag)
    steps = np.arange(len(covariances), dtype=float)
    whole = long_run_covariance(covariances, given.lag)
    missing = 2 * np.trace(np.linalg.solve(whole, np.einsum("k,kij->ij", steps, covariances)))
    step, error = float(np.median(given.h)), 2 * np.linalg.norm(steps) / np.sqrt(rest.size)
    return float(missing) / len(whole) * step, float(error) * step


class _PairRegression:
    """Pairs with the functions of a support, by default all, at X0, and what the current f makes of them."""

    def __init__(
        self, library: CandidateLibrary, pairs: SnapshotPairs | StreamedPairs,
        support: np.ndarray | None = None,
    ) -> None:  # fmt: skip
        self.library, self.pairs = library, pairs
        everything = all_coefficients(range(library.dimension), library.size)
        self.support = everything if support is None else support
        self.active, self.position = np.unique(self.support[:, 1], return_inverse=True)
        self._terms = compile_formulas([library.terms[k] for k in self.active], library.symbols)
        if isinstance(pairs, SnapshotPairs):
            self.x0, self.xh, self.h = np.ascontiguousarray(pairs.x0.T), pairs.xh.T, pairs.h
            self.theta = self._terms(self.x0)
            if not np.isfinite(self.theta).all():
                raise NumericalFailure("a library function of the vector field is not finite on some pairs")

    def _parts(self) -> Iterator[_PairRegression]:
        """Itself where the pairs are in memory; else one for each block of them."""
        for block in self.pairs.blocks():
            yield self if block is self.pairs else _PairRegression(self.library, block, self.support)

    @cached_property
    def _sample(self) -> tuple[np.ndarray, np.ndarray]:
        """X0 ``(d, n)`` and h of some pairs, by which the accuracy of the flow is judged."""
        some = self.pairs.take(slice(None, None, max(len(self.pairs) // FLOW_SAMPLE, 1)))
        return np.ascontiguousarray(some.x0.T), some.h

    def matrix(self, values: np.ndarray) -> np.ndarray:
        """Coefficients as a matrix ``(d, active)``."""
        matrix = np.zeros((self.library.dimension, len(self.active)))
        matrix[self.support[:, 0], self.position] = values
        return matrix

    def predicted(self, values: np.ndarray) -> np.ndarray:
        """f(X0), shape ``(n, d)``."""
        return (self.matrix(values) @ self.theta).T

    def flow(
        self, values: np.ndarray, rate: np.ndarray | None, *, tolerance: float,
        integrator_step: float | None = None,
    ) -> FlowMap:  # fmt: skip
        """The map over a step that is accurate enough, see `FlowMap.of`, for white noise of a rate.

        It is coarse where means or covariances of pairs are off by so much to the first order in h that a
        coefficient of f or D could be off by more than is harmless: by ``√(Σ b² / variance)`` standard errors
        at most, of shifts b of the mean, and ``√(Σ ½ tr (S⁻¹ΔS)²)`` of covariances S.
        """
        matrix, (x0, h) = self.matrix(values), self._sample
        found = FlowMap.of(
            lambda x: matrix @ self._terms(x), x0, h, integrator_step=integrator_step, tolerance=tolerance
        )
        if rate is None or found.euler or not np.linalg.eigvalsh(rate)[0] > NOISE_FREE * np.trace(rate):
            return found
        coarse = replace(found, coarse=True)
        mean, spread = coarse.moments(lambda x: matrix @ self._terms(x), x0, h, rate)
        shifted = self._shift(matrix, found, x0, h, rate) - ((mean - x0) / h - matrix @ self._terms(x0))
        squares, d = np.einsum("in,ij,jn->n", shifted, np.linalg.inv(rate), shifted) * h, len(rate)
        away = LOCAL * np.sqrt(np.diag(rate)[:, None] * h)  # of states, to differentiate f
        ways = [np.eye(d)[:, [k]] * away for k in range(d)]
        ends = [[matrix @ self._terms(x0 + sign * way) for sign in (1, -1)] for way in ways]
        step = np.stack([(one - two) / away[k] for k, (one, two) in enumerate(ends)]).transpose(2, 1, 0)
        step = step * h[:, None, None] / 4  # a half, of differences over twice the way
        kept = np.eye(d) + step + step @ step / 2
        first_order = kept @ rate @ kept.transpose(0, 2, 1) * h[:, None, None]
        known = np.isfinite(squares) & np.isfinite(spread + first_order).all(axis=(1, 2))
        known[known] = np.linalg.eigvalsh(spread[known])[:, 0] > 0  # elsewhere a trial f runs away
        off = np.linalg.solve(spread[known], first_order[known]) - np.eye(d)
        usual = squares[known] + np.einsum("nij,nji->n", off, off) / 2
        far = len(self.pairs) / max(len(usual), 1) * float(usual.sum()) > HARMLESS_BIAS**2
        return coarse if far else found

    def _shift(
        self, matrix: np.ndarray, flow: FlowMap, x0: np.ndarray, h: np.ndarray, rate: np.ndarray | None
    ) -> np.ndarray:
        """Mean velocity over a step less f(X0), of components ``(d, n)``."""
        begin = matrix @ self._terms(x0)

        def field(x: np.ndarray) -> np.ndarray:
            return begin if x is x0 else matrix @ self._terms(x)  # which every rule asks for first

        if flow.coarse and rate is not None:
            return np.asarray((flow.moments(field, x0, h, rate)[0] - x0) / h - begin)
        shift = (flow(field, x0, h) - x0) / h - begin
        if rate is not None and np.any(rate):
            # Σ_jk (εD)_jk ∂²θ/∂x_j∂x_k of the active functions, shape (active, n).
            second = self._second(x0).reshape(*rate.shape[-2:], len(self.active), -1)
            curvature = np.einsum("nij,ijkn->kn" if rate.ndim == 3 else "ij,ijkn->kn", rate, second)
            shift += flow.response_share * h / 2 * (matrix @ curvature)
        return np.asarray(shift)

    def noise_rate(
        self, values: np.ndarray, flow: FlowMap, guess: np.ndarray, rest: np.ndarray
    ) -> np.ndarray:
        """εD where residuals have the covariance `rest` per time; by a guess, which it need not be near.

        Of steps that are not coarse it is that of the residuals, see
        `siq.inference.diffusion_model.with_process_noise_rate`.
        """
        if not flow.coarse:
            return rest
        matrix, (x0, h) = self.matrix(values), self._sample
        _, spread = flow.moments(lambda x: matrix @ self._terms(x), x0, h, guess)
        kept = np.isfinite(spread).all(axis=(1, 2))
        seen = (spread / h[:, None, None])[kept].mean(axis=0) if kept.any() else np.zeros_like(guess)
        if not np.linalg.eigvalsh(seen)[0] > 0:  # a trial f that runs away
            return rest
        root = np.linalg.cholesky(guess) @ np.linalg.inv(np.linalg.cholesky(seen))
        return np.asarray(root @ rest @ root.T)

    def corrected(
        self, values: np.ndarray, flow: FlowMap | None, noise_rate: np.ndarray | None
    ) -> np.ndarray:
        """``(Xh - X0)/h`` less what the flow, and noise, add to f(X0): shape ``(n, d)``."""
        quotient = (self.xh - self.x0) / self.h
        if flow is None:
            return quotient.T
        matrix = self.matrix(values)
        most = 10 * np.abs(quotient).max(axis=1, keepdims=True)
        for begin in range(0, len(self.h), CHUNK):  # small enough to stay in the processor's cache
            part = slice(begin, begin + CHUNK)
            rate = noise_rate[part] if noise_rate is not None and noise_rate.ndim == 3 else noise_rate
            correction = self._shift(matrix, flow, self.x0[:, part], self.h[part], rate)
            # A trial f may run away on a few pairs; one round without their correction does no harm.
            correction[:, ~(np.abs(correction) <= most).all(axis=0)] = 0.0
            quotient[:, part] -= correction
        return quotient.T

    @cached_property
    def _second(self) -> Callable[[np.ndarray], np.ndarray]:
        by_states = zip(*self.library.second_derivatives(self.active.tolist()), strict=True)
        return compile_formulas([each for row in by_states for each in row], self.library.symbols)

    def triangle(
        self, values: np.ndarray, flow: FlowMap | None, rate: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """R of the QR decomposition of √h [Θ, velocity], on which every fit with one weight depends.

        And the mean square of the `corrected` velocities, shape ``(d,)``. Blocks are stacked below R.
        """
        squares = np.zeros(self.library.dimension)

        def rows(part: _PairRegression) -> np.ndarray:
            nonlocal squares
            velocity = part.corrected(values, flow, rate)
            squares = squares + (velocity**2).sum(axis=0)
            return np.concatenate([part.theta.T, velocity], axis=1) * np.sqrt(part.h)[:, None]

        return stacked_triangle(map(rows, self._parts())), squares / len(self.pairs)

    def residual_ratio(self, rate: np.ndarray) -> float:
        """Rms of residuals of a covariance per time over rms of the increments, each component by its own."""
        return float(np.sqrt((np.diag(rate) / positive(self.pairs.mean_square_speed)).mean()))

    def generalised(
        self, columns: np.ndarray, goals: np.ndarray, spread: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Generalised least squares of all components: values ``(p,)``, pseudoinverse, and sizes of columns.

        Columns ``(m, active)`` explain goals ``(m, d)``; `spread` is the covariance of a row of residuals.
        """
        whiten = scipy.linalg.solve_triangular(np.linalg.cholesky(spread), np.eye(len(spread)), lower=True)
        places = zip(self.support[:, 0], self.position, strict=True)
        design = np.stack([np.outer(whiten[:, i], columns[:, k]).ravel() for i, k in places], axis=1)
        # Scaled columns, for functions may differ by many orders of magnitude.
        scale = positive(np.linalg.norm(design, axis=0))
        inverse = np.linalg.pinv(design / scale) / scale[:, None]
        return inverse @ (whiten @ goals.T).ravel(), inverse, scale


def _fit_everything(
    regression: _PairRegression, *, integrator_step: float | None
) -> tuple[np.ndarray, np.ndarray, float, FlowMap]:
    """Least squares of all functions: triangle, the residuals' covariance per time and their ratio, flow."""
    q, d, n = regression.library.size, regression.library.dimension, len(regression.pairs)
    flow, rate, values = None, None, np.zeros(d * q)
    for done in range(CORRECTION_ROUNDS):
        triangle, _ = regression.triangle(values, flow, rate)
        # Scaled columns, for functions differ by many orders of magnitude where units are small or large.
        scale = positive(np.linalg.norm(triangle[:q, :q], axis=0))
        solution = np.linalg.lstsq(triangle[:q, :q] / scale, triangle[:q, q:], rcond=1e-14)[0]
        change = np.abs(solution - values.reshape(d, q).T * scale[:, None])
        settled = np.all(change <= 1e-13 * np.abs(solution).max(axis=0))
        values = (solution / scale[:, None]).T.ravel()
        rest = triangle[q:, q:].T @ triangle[q:, q:] / n
        ratio = regression.residual_ratio(rest)
        rate = rest if flow is None or rate is None else regression.noise_rate(values, flow, rate, rest)
        if flow is None or ratio > NOISE_FREE:
            tolerance, forced = 1e-10 if ratio < 1e-2 else 1e-6, rate if ratio > NOISE_FREE else None
            flow = regression.flow(values, forced, integrator_step=integrator_step, tolerance=tolerance)
            if flow.coarse:
                _refuse_forgotten(regression.pairs)
        elif settled:
            break
        if ratio > 0.1 and done >= 3:
            break  # noise hides what further rounds would change
    assert flow is not None and rate is not None
    return triangle, rate, ratio, flow


def _refuse_forgotten(pairs: SnapshotPairs | StreamedPairs) -> None:
    """Refuse pairs whose ends do not depend on their beginnings: any f that is fast enough made them.

    Bartlett's test of the last canonical correlation ρ between beginnings and ends (Biometrika 34 (1947) 33):
    of independent ones ``-n ln(1 - ρ²)`` has the law of χ² with one degree of freedom.
    """
    # R of [1, X0, Xh], less its first row, is that of X0 and Xh about their means.
    found = stacked_triangle(
        np.concatenate([np.ones((len(one), 1)), one.x0, one.xh], axis=1) for one in pairs.blocks()
    )
    d = len(found) // 2
    last = float(np.linalg.svd(np.linalg.qr(found[1:, 1 + d :])[0][:d], compute_uv=False)[-1])
    count = len(pairs) / pairs.copies
    if erfc(np.sqrt(-count * np.log1p(-(min(last, 1 - 1e-12) ** 2)) / 2)) > FORGOTTEN:
        raise NumericalFailure(
            f"within a step the state forgets where it was (a correlation of {last:.2g} is left, chance makes"
            f" {count**-0.5:.2g}), so that any fast f explains the recordings; record more often",
            claim="prediction",
        )


def _evenly(count: int, most: int) -> np.ndarray:
    """At most so many of `count` rows, evenly spread."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(int))


def carries_noise(
    library: CandidateLibrary, pairs: SnapshotPairs | StreamedPairs, *, options: IdentificationOptions,
    integrator_step: float | None = None,
) -> bool:  # fmt: skip
    """Whether pairs are more than an integrator's error away from any f in the library."""
    if len(pairs) < 2 * library.size:
        raise NumericalFailure(
            f"only {len(pairs)} pairs for {library.size} candidate functions of f;"
            " lower identification.degree or record more"
        )
    some = pairs.take(_evenly(len(pairs), max(options.pairs // 4, 4 * library.size)))
    return _fit_everything(_PairRegression(library, some), integrator_step=integrator_step)[2] >= NOISE_FREE


def identify_vector_field(
    library: CandidateLibrary, pairs: SnapshotPairs | StreamedPairs, *, options: IdentificationOptions,
    integrator_step: float | None = None,
) -> FieldEstimate:  # fmt: skip
    """f of pairs; by instruments of `LaggedPairs`, the library's functions of the earlier states.

    D is the unit matrix; f does not depend on it.

    Parameters
    ----------
    library, pairs, options
        The candidate functions; X0, Xh and h, in memory or streamed from a file, which gives the same to
        rounding; and what makes a term significant.
    integrator_step
        Step of the Euler–Maruyama simulation that made the pairs, None for everything else. Then the
        increment of each step is h f exactly, and f is that of the continuous process.

    Raises
    ------
    NumericalFailure
        When there are fewer pairs than functions, a function is not finite on them, or no term of an equation
        is significant.

    Notes
    -----
    The residuals of noisy pairs are independent, so that the standard errors fall with the number of
    pairs. Those of noise-free pairs are the error of integrators, the same in neighbouring pairs: their
    standard errors are given without that gain, as a bound.
    """
    if isinstance(pairs, LaggedPairs):
        return _identify_by_instruments(library, pairs, options)
    if not carries_noise(library, pairs, options=options, integrator_step=integrator_step):
        pairs = pairs.take(_evenly(len(pairs), options.pairs))
    regression = _PairRegression(library, pairs)
    triangle, rate, ratio, flow = _fit_everything(regression, integrator_step=integrator_step)
    noise_free = ratio < NOISE_FREE
    critical = critical_values(library, false_terms=options.false_terms)
    samples = len(pairs) / (1.0 if noise_free else pairs.copies)
    problems = LinearProblem.of_components(triangle, samples=samples, critical=critical)
    choose = partial(strong_terms, precision=options.precision) if noise_free else best_support
    everything, unit = regression.support, Diffusion.identity(library.dimension)
    values = np.concatenate([one.solve(range(library.size)) for one in problems])
    unknown = np.eye(len(values))
    found = FieldEstimate.on_support(library, everything, values, unknown, rate, ratio, flow, unit)
    if flow.coarse and isinstance(pairs, SnapshotPairs):
        with contextlib.suppress(NumericalFailure):  # then moments are left
            return Transitions(found, pairs).identified(false_terms=options.false_terms)
    chosen = chosen_terms(problems, library, choose)

    def fit(support: np.ndarray) -> tuple[FieldEstimate, np.ndarray]:
        nonlocal found
        regression = _PairRegression(library, pairs, support)
        values = np.array([problems[i].solve(support[support[:, 0] == i, 1])[k] for i, k in support])
        found = _fit_support(found.with_values(support, values), regression)
        if noise_free:
            terms = np.sqrt(regression.theta**2 @ regression.h)[regression.position]
            sizes = positive(np.sqrt(regression.h @ regression.predicted(found.values) ** 2))
            return found, np.abs(found.values) * terms / sizes[support[:, 0]] / options.precision
        return found, np.abs(found.values) / np.sqrt(np.diag(found.covariance)) / critical[support[:, 1]]

    # With the final support and flow a term may turn out to be superfluous after all.
    found, support = fit_significant(fit, chosen)
    return found if noise_free else replace(found, alternatives=model_average(problems, support, library))


def _fit_support(found: FieldEstimate, regression: _PairRegression) -> FieldEstimate:
    """Generalised least squares on a support, with flow, noise and covariance brought up to date."""
    if found.flow.by_density and isinstance(regression.pairs, SnapshotPairs):
        return Transitions(found, regression.pairs).fitted()[0]
    d, n, active = found.library.dimension, len(regression.pairs), len(regression.active)
    values, rate, rest, flow = found.values, found.noise_rate, found.noise_rate, found.flow
    if not flow.euler:
        forced = None if found.noise_free else rate
        flow = regression.flow(values, forced, tolerance=1e-11 if found.noise_free else 1e-6)
    for _ in range(CORRECTION_ROUNDS):
        triangle, squares = regression.triangle(values, flow, rate)
        # Where there is no noise only the relative weight of the components matters.
        spread = rest if not found.noise_free else np.diag(squares)
        solution, inverse, scale = regression.generalised(triangle[:, :active], triangle[:, active:], spread)
        change = (np.abs(solution - values) * scale).max() / (np.abs(solution) * scale).max()
        values = solution
        misfit = triangle[:, active:] - triangle[:, :active] @ regression.matrix(values).T
        rest = misfit.T @ misfit / n
        rate = regression.noise_rate(values, flow, rate, rest)
        if change < (1e-14 if found.noise_free else 1e-9):
            break
    covariance = inverse @ inverse.T
    if found.noise_free:
        # Columns were whitened by the size of the velocities: bring in the size of the residuals. They are
        # alike in neighbouring pairs and do not average out, hence the number of pairs.
        covariance = covariance * (float(np.trace(np.linalg.solve(spread, rest))) / d) * n
    else:
        covariance = covariance * regression.pairs.copies
    return found.with_values(
        found.support, values, covariance=covariance, noise_rate=rate,
        residual_ratio=regression.residual_ratio(rest), flow=flow,
    )  # fmt: skip


def refit(found: FieldEstimate, pairs: SnapshotPairs) -> FieldEstimate:
    """The terms of an estimate fitted to other pairs, such as those of the training recordings alone.

    With the weights of a D that depends on the state the noise stays as it is.
    """
    regression = _PairRegression(found.library, pairs, found.support)
    if isinstance(pairs, LaggedPairs):
        return _fit_by_instruments(regression, pairs, found.diffusion)
    if found.diffusion.constant or found.flow.by_density:
        return _fit_support(found, regression)
    for _ in range(WEIGHT_ROUNDS + 1):  # each brings the flow up to date
        triangle, intensity = weighted_triangle(found, pairs, found.support)
        scale = np.linalg.norm(triangle[:, :-1], axis=0)
        values = np.linalg.lstsq(triangle[:, :-1] / scale, triangle[:, -1], rcond=None)[0] / scale
        found = found.with_values(found.support, values)
    inverse = np.linalg.pinv(triangle[:, :-1] / scale) / scale[:, None]
    return replace(found, covariance=intensity * pairs.copies * inverse @ inverse.T)


def residuals(found: FieldEstimate, pairs: SnapshotPairs) -> np.ndarray:
    """``Xh - E[Xh | X0]`` of pairs, shape ``(n, d)``; correlated noise shifts no mean within a step.

    Where their densities are known, normal scores as large as these would be over a short step.
    """
    if found.flow.by_density and not isinstance(pairs, LaggedPairs):
        return Transitions(found, pairs).normal_increments()
    regression = _PairRegression(found.library, pairs, found.support)
    rate = None if isinstance(pairs, LaggedPairs) else found.noise_rate_at(found.on_the_way(pairs))
    velocity = regression.corrected(found.values, found.flow, rate)
    return (velocity - regression.predicted(found.values)) * pairs.h[:, None]


def with_stability(
    found: FieldEstimate, pairs: SnapshotPairs, *, options: IdentificationOptions,
    generator: np.random.Generator,
) -> FieldEstimate:  # fmt: skip
    """An estimate of noisy pairs with the share of resampled recordings in which each term is chosen."""
    regression = _PairRegression(found.library, pairs)
    velocity = regression.corrected(found.coefficients.T.ravel(), found.flow, found.noise_rate)
    order, weight = np.argsort(pairs.recording, kind="stable"), np.sqrt(pairs.h)[:, None]
    blocks = blocks_of(pairs.recording[order])
    parts = triangles((regression.theta.T * weight)[order], (velocity * weight)[order], blocks)
    critical = critical_values(found.library, false_terms=options.false_terms)
    samples = len(pairs.h) / pairs.copies
    problems_of = partial(LinearProblem.of_components, samples=samples, critical=critical)
    return replace(found, stability=stability(parts, problems_of, found.support, generator=generator))


def with_noise_formula(
    found: FieldEstimate, pairs: SnapshotPairs, *, false_terms: float, given: Diffusion | None = None
) -> FieldEstimate | None:
    """f and D for a noise that depends on the state; None where a constant one can be held.

    From f as it was found with one weight for all of its pairs; or f alone, where D is `given`. With the
    probability `false_terms` a constant D is given up by chance; or chance brings any false term into f, or
    into D. Over the recorded states the determinant of D has the geometric mean one.

    Raises
    ------
    NumericalFailure
        When D depends on the state, and no formula for it is positive at all recorded states; or when an
        equation of f has no significant term.
    """
    if given is not None:
        found = replace(found, diffusion=given)
        weighted = not (found.noise_free or given.constant)
        return _identify_weighted(found, pairs, false_terms=false_terms) if weighted else found
    if found.flow.by_density:
        with contextlib.suppress(NumericalFailure):
            constant = Transitions(found, pairs)
            by_state = constant.fitted_with_formula(false_terms=false_terms)
            if by_state is None:
                return None
            found_by_state = constant.identified(by_state, false_terms=false_terms)
            Transitions(found_by_state, pairs)  # whose D may need more cells than there can be
            return found_by_state
        found = replace(found, flow=replace(found.flow, by_density=False))
    rest = residuals(found, pairs)
    likelihood = ResidualLikelihood(found, pairs, rest)
    probability = likelihood.constant_probability()
    if probability >= false_terms:
        return None
    likelihood = ResidualLikelihood(found, pairs, rest, bent=False)
    for _ in range(WEIGHT_ROUNDS):
        formula = likelihood.selected(false_terms=false_terms, probability=probability)[0]
        found = _identify_weighted(found.with_formula(formula, pairs.x0), pairs, false_terms=false_terms)
        likelihood = ResidualLikelihood(found, pairs, residuals(found, pairs))
    formula = likelihood.selected(false_terms=false_terms, probability=probability)[0]
    return refit(found.with_formula(formula, pairs.x0), pairs)


def _identify_weighted(found: FieldEstimate, pairs: SnapshotPairs, *, false_terms: float) -> FieldEstimate:
    """The significant terms of f, sought anew among all of its library with the weights of its D."""
    library, (triangle, intensity) = found.library, weighted_triangle(found, pairs, None)
    critical = np.tile(critical_values(library, false_terms=false_terms), library.dimension)
    everything = all_coefficients(range(library.dimension), library.size)
    problem = LinearProblem(triangle[:, :-1], triangle[:, -1], intensity * pairs.copies, critical, everything)
    support = chosen_terms([problem], library)
    start = np.linalg.lstsq(triangle[:, problem.places(support)], triangle[:, -1], rcond=None)[0]
    found = refit(found.with_values(support, start, covariance=np.eye(len(support))), pairs)
    return replace(found, alternatives=model_average([problem], support, library))


def weighted_triangle(
    found: FieldEstimate, pairs: SnapshotPairs, places: np.ndarray | None, *, of_rest: bool = False
) -> tuple[np.ndarray, float]:
    """R of the design with the weights of D and its goal as the last column; and ε.

    The columns are those of some components and functions ``(p, 2)``, or of all. The goal are the velocities,
    less what f adds to a straight step; or what f leaves of them.
    """
    regression, d = _PairRegression(found.library, pairs, found.support), found.library.dimension
    middle = found.on_the_way(pairs)
    velocity = regression.corrected(found.values, found.flow, found.noise_rate_at(middle))
    left = velocity - regression.predicted(found.values)
    goal = left if of_rest else velocity
    places = all_coefficients(range(d), found.library.size) if places is None else places
    p, squares = len(places), 0.0

    def rows(begin: int) -> np.ndarray:
        nonlocal squares
        part = slice(begin, begin + WEIGHTED_CHUNK)
        x, h = pairs.x0[part], pairs.h[part]
        whitening = found.diffusion.whitening_at(middle[part]) * np.sqrt(h)[:, None, None]
        terms = found.library.evaluate(x)[:, places[:, 1]]
        block = np.empty((len(x), d, p + 1))
        block[:, :, :-1] = whitening[:, :, places[:, 0]] * terms[:, None, :]
        block[:, :, -1] = (whitening @ goal[part][:, :, None])[:, :, 0]
        squares += float(((whitening @ left[part][:, :, None]) ** 2).sum())
        return block.reshape(-1, p + 1)

    return stacked_triangle(map(rows, range(0, len(pairs.h), WEIGHTED_CHUNK))), squares / (len(pairs.h) * d)


def _identify_by_instruments(
    library: CandidateLibrary, pairs: LaggedPairs, options: IdentificationOptions
) -> FieldEstimate:
    """Two-stage least squares: functions and increments are projected on instruments, and fitted there."""
    q, h = library.size, pairs.h[:, None]
    if pairs.independent < 2 * q:
        raise NumericalFailure(
            f"only {pairs.independent:.0f} independent pairs for {q} candidate functions of f;"
            " lower identification.degree or record more"
        )
    regression = _PairRegression(library, pairs)
    directions = pairs.directions(library)
    # Of some function nothing may be known from an earlier state. Its coefficient would be chance, as large
    # as the error of its own instrument is small, and so would be all that is said of what is left.
    orthogonal, upper = np.linalg.qr(regression.theta.T * h)
    known = np.linalg.pinv(directions.T @ orthogonal, rcond=MIN_INSTRUMENT_CORRELATION)
    solution = np.linalg.lstsq(upper, known, rcond=1e-12)[0]
    values, flow = np.zeros(len(regression.support)), None
    for _ in range(2):
        moved = regression.corrected(values, flow, None) * h
        values = (solution @ (directions.T @ moved)).T.ravel()
        flow = regression.flow(values, None, tolerance=1e-6)
    variances = np.diag(pairs.long_run(moved - regression.predicted(values) * h) * pairs.copies)
    columns, goals = directions.T @ (regression.theta * pairs.h).T, directions.T @ moved
    critical = critical_values(library, false_terms=options.false_terms)
    problems = [
        LinearProblem(columns, goals[:, i], float(variance), critical, all_coefficients([i], q))
        for i, variance in enumerate(variances)
    ]
    reason = (
        f": the recordings are correlated over {pairs.lag} steps, and states so much earlier tell too little"
        " of its motion; record longer, or a quantity that fluctuates less"
    )
    chosen = chosen_terms(problems, library, reason=reason)

    def fit(support: np.ndarray) -> tuple[FieldEstimate, np.ndarray]:
        noise = Diffusion.identity(library.dimension)
        found = _fit_by_instruments(_PairRegression(library, pairs, support), pairs, noise)
        return found, np.abs(found.values) / np.sqrt(np.diag(found.covariance)) / critical[support[:, 1]]

    found, support = fit_significant(fit, chosen)
    return replace(found, alternatives=model_average(problems, support, library))


def _fit_by_instruments(
    regression: _PairRegression, pairs: LaggedPairs, diffusion: Diffusion
) -> FieldEstimate:
    """Generalised least squares of the projected problem on a support."""
    directions, h = pairs.directions(regression.library), pairs.h[:, None]
    columns = directions.T @ (regression.theta.T * h)
    spread, values, flow = np.eye(regression.library.dimension), np.zeros(len(regression.support)), None
    for _ in range(INSTRUMENT_ROUNDS):
        moved = regression.corrected(values, flow, None) * h
        previous = values
        values, inverse, _ = regression.generalised(columns, directions.T @ moved, spread)
        rest = moved - regression.predicted(values) * h
        spread = pairs.long_run(rest)
        settled = flow is not None and (np.abs(values - previous) <= 1e-6 * np.abs(values)).all()
        flow = regression.flow(values, None, tolerance=1e-6)
        if settled:
            break
    assert flow is not None
    size, rate = positive(((pairs.xh - pairs.x0) ** 2).mean(axis=0)), spread / float(np.median(pairs.h))
    ratio, covariance = np.sqrt(((rest**2).mean(axis=0) / size).mean()), inverse @ inverse.T * pairs.copies
    return FieldEstimate.on_support(
        regression.library, regression.support, values, covariance, rate, float(ratio), flow, diffusion
    )
