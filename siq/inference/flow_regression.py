"""Regression of the flow over the step of a pair, with weights where the noise depends on the state.

``Xh = Φ_h(X0; f) + noise`` with ``f = Θ Ξ_f``. Deferred correction makes this a linear problem: with the
current f the difference between the flow and ``X0 + h f(X0)`` is subtracted from the data, and a few rounds
reach the exact answer.

With one weight for all, coefficients remain right on average, but their standard errors do not, and terms are
taken as significant that are none. With the right weights both are at the Cramér–Rao bound.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg
import scipy.special

from siq.data.recordings import SnapshotPairs
from siq.errors import NumericalFailure
from siq.inference.diffusion_model import constant_noise_probability, fitted_noise, random_forces_of
from siq.inference.field_estimate import NOISE_FREE, FlowMap, IdentifiedField, NoiseFormula, flow_map
from siq.inference.library import CandidateLibrary
from siq.inference.selection import Equation, best_support, critical_values, rivals_of_all
from siq.systems.diffusion import Diffusion
from siq.systems.formulas import compile_formulas

ROUNDS = 25  # of deferred correction, each of which gains a factor of about h times the Jacobian
CHUNK = 4096  # pairs worked on together


class FlowRegression:
    """Pairs with the active library functions at X0, and what the current f makes of them."""

    def __init__(self, library: CandidateLibrary, pairs: SnapshotPairs, support: np.ndarray) -> None:
        self.library, self.pairs, self.support = library, pairs, support
        self.active, self.position = np.unique(support[:, 1], return_inverse=True)
        terms = [library.terms[k] for k in self.active]
        self._terms = compile_formulas(terms, library.symbols)
        self._second: Callable[[np.ndarray], np.ndarray] | None = None
        self.x0, self.xh, self.h = np.ascontiguousarray(pairs.x0.T), pairs.xh.T, pairs.h
        self.theta = self._terms(self.x0)
        if not np.isfinite(self.theta).all():
            raise NumericalFailure("a library function of the vector field is not finite on some pairs")

    def matrix(self, values: np.ndarray) -> np.ndarray:
        """Coefficients as a matrix ``(d, active)``."""
        matrix = np.zeros((self.library.dimension, len(self.active)))
        matrix[self.support[:, 0], self.position] = values
        return matrix

    def predicted(self, values: np.ndarray) -> np.ndarray:
        """f(X0), shape ``(n, d)``."""
        return (self.matrix(values) @ self.theta).T

    def field(self, values: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
        """F as a function of states ``(d, n)``, of the same shape."""
        matrix = self.matrix(values)
        return lambda x: matrix @ self._terms(x)

    def corrected(
        self, values: np.ndarray, flow: FlowMap | None, noise_rate: np.ndarray | None
    ) -> np.ndarray:
        """``(Xh - X0)/h`` less what the flow, and noise, add to f(X0): shape ``(n, d)``."""
        quotient = (self.xh - self.x0) / self.h
        if flow is None:
            return quotient.T
        matrix, field = self.matrix(values), self.field(values)
        most = 10 * np.abs(quotient).max(axis=1, keepdims=True)
        for begin in range(0, len(self.h), CHUNK):  # small enough to stay in the processor's cache
            part = slice(begin, begin + CHUNK)
            x0, h = self.x0[:, part], self.h[part]
            correction = (flow(field, x0, h) - x0) / h - matrix @ self.theta[:, part]
            if noise_rate is not None and np.any(noise_rate):
                curvature = self._curvature(x0, noise_rate)
                correction += flow.curvature_weight * h / 4 * (matrix @ curvature)
            # A trial f may run away on a few pairs; one round without their correction does no harm.
            correction[:, ~(np.abs(correction) <= most).all(axis=0)] = 0.0
            quotient[:, part] -= correction
        return quotient.T

    def _curvature(self, x0: np.ndarray, noise_rate: np.ndarray) -> np.ndarray:
        """Σ_jk (εD)_jk ∂²θ/∂x_j∂x_k of the active functions, shape ``(active, n)``."""
        symbols = self.library.symbols
        d = len(symbols)
        if self._second is None:
            second = [
                self.library.terms[k].diff(symbols[i], symbols[j])
                for i in range(d)
                for j in range(d)
                for k in self.active
            ]
            self._second = compile_formulas(second, symbols)
        values = self._second(x0).reshape(d, d, len(self.active), -1)
        return np.einsum("ij,ijkn->kn", noise_rate, values)


@dataclass(frozen=True)
class DenseFit:
    """The fit of all functions of a library: coefficients, and the triangle of the last least squares."""

    values: np.ndarray
    triangle: np.ndarray
    rate: np.ndarray
    ratio: float
    flow: FlowMap


def fit_everything(
    library: CandidateLibrary, pairs: SnapshotPairs, *, integrator_step: float | None
) -> DenseFit:
    """Least squares over all functions of a library, each round with the correction by the last f.

    Parameters
    ----------
    library
        The q functions.
    pairs
        X0, Xh and h.
    integrator_step
        See `siq.inference.identification.identify_vector_field`.

    Raises
    ------
    NumericalFailure
        When a function is not finite on some pairs.
    """
    q, d, n = library.size, library.dimension, len(pairs.h)
    everything = np.array([(i, k) for i in range(d) for k in range(q)])
    full = FlowRegression(library, pairs, everything)
    weight = np.sqrt(pairs.h)
    flow: FlowMap | None = None
    values = np.zeros(d * q)
    rate: np.ndarray | None = None
    triangle = np.zeros((0, 0))
    for done in range(ROUNDS):
        velocity = full.corrected(values, flow, rate)
        triangle = _triangle(full.theta, velocity, weight)
        # Scaled columns, for functions differ by many orders of magnitude where units are small or large.
        scale = positive(np.linalg.norm(triangle[:q, :q], axis=0))
        solution = np.linalg.lstsq(triangle[:q, :q] / scale, triangle[:q, q:], rcond=1e-14)[0]
        change = np.abs(solution - values.reshape(d, q).T * scale[:, None])
        settled = np.all(change <= 1e-13 * np.abs(solution).max(axis=0))
        values = (solution / scale[:, None]).T.ravel()
        leftover = triangle[q:, q:]
        rate = leftover.T @ leftover / n
        ratio = _residual_ratio(rate, pairs)
        if flow is None or ratio > NOISE_FREE:
            flow = flow_map(
                full.field(values), full.x0[:, :: max(n // 500, 1)], pairs.h[:: max(n // 500, 1)],
                integrator_step=integrator_step, tolerance=1e-10 if ratio < 1e-2 else 1e-6,
            )  # fmt: skip
        elif settled:
            break
        if ratio > 0.1 and done >= 3:
            break  # noise hides what further rounds would change
    assert flow is not None and rate is not None
    return DenseFit(values, triangle, rate, float(ratio), flow)


def _triangle(theta: np.ndarray, velocity: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """R of the QR decomposition of √h [Θ, velocity], on which everything further depends."""
    stacked = np.empty((theta.shape[1], theta.shape[0] + velocity.shape[1]))
    stacked[:, : theta.shape[0]] = theta.T
    stacked[:, theta.shape[0] :] = velocity
    stacked *= weight[:, None]
    return np.asarray(np.linalg.qr(stacked, mode="r"))


def fit_support(found: IdentifiedField, problem: FlowRegression) -> IdentifiedField:
    """Generalised least squares on a support, with flow, noise and covariance brought up to date."""
    d, n, active = found.library.dimension, len(problem.h), len(problem.active)
    weight = np.sqrt(problem.h)
    values, rate = found.values, found.noise_rate
    sample = slice(None, None, max(n // 500, 1))
    tolerance = 1e-11 if found.noise_free else 1e-6
    flow = found.flow
    if not flow.euler:
        flow = flow_map(
            problem.field(values), problem.x0[:, sample], problem.h[sample],
            integrator_step=None, tolerance=tolerance,
        )  # fmt: skip
    design = np.zeros((0, 0))
    for _ in range(ROUNDS):
        velocity = problem.corrected(values, flow, rate)
        triangle = _triangle(problem.theta, velocity, weight)
        # Where there is no noise only the relative weight of the components matters.
        spread = rate if not found.noise_free else np.diag((velocity**2).mean(axis=0))
        whiten = scipy.linalg.solve_triangular(np.linalg.cholesky(spread), np.eye(d), lower=True)
        design = np.stack(
            [
                np.outer(whiten[:, i], triangle[:, k]).ravel()
                for i, k in zip(found.support[:, 0], problem.position, strict=True)
            ],
            axis=1,
        )
        goal = (whiten @ triangle[:, active:].T).ravel()
        # Scaled columns, for functions may differ by many orders of magnitude.
        scale = np.linalg.norm(design, axis=0)
        solution = np.linalg.lstsq(design / scale, goal, rcond=None)[0] / scale
        change = (np.abs(solution - values) * scale).max() / (np.abs(solution) * scale).max()
        values = solution
        misfit = triangle[:, active:] - triangle[:, :active] @ problem.matrix(values).T
        rate = misfit.T @ misfit / n
        if change < (1e-14 if found.noise_free else 1e-9):
            break
    coefficients = np.zeros_like(found.coefficients)
    coefficients[found.support[:, 1], found.support[:, 0]] = values
    inverse = np.linalg.pinv(design / scale)
    covariance = (inverse @ inverse.T) / np.outer(scale, scale)
    if found.noise_free:
        # `design` was whitened by the size of the velocities: bring in the size of the residuals. They are
        # alike in neighbouring pairs and do not average out, hence the number of pairs.
        relative = float(np.trace(np.linalg.solve(spread, rate))) / d
        covariance = covariance * relative * n
    else:
        covariance = covariance * copies(problem.pairs)
    return replace(
        found,
        coefficients=coefficients,
        covariance=covariance,
        noise_rate=rate,
        residual_ratio=_residual_ratio(rate, problem.pairs),
        flow=flow,
    )


def positive(sizes: np.ndarray) -> np.ndarray:
    """Sizes to divide by: one where they vanish."""
    return np.where(sizes > 0, sizes, 1.0)


def _residual_ratio(rate: np.ndarray, pairs: SnapshotPairs) -> float:
    """Rms of the residuals over rms of the increments, each component by its own."""
    size = ((pairs.xh - pairs.x0) ** 2 / pairs.h[:, None]).mean(axis=0)
    return float(np.sqrt((np.diag(rate) / positive(size)).mean()))


def refit(found: IdentifiedField, pairs: SnapshotPairs) -> IdentifiedField:
    """The same terms fitted to other pairs, such as those of the training recordings alone."""
    return fit_support(found, FlowRegression(found.library, pairs, found.support))


def residuals(found: IdentifiedField, pairs: SnapshotPairs) -> np.ndarray:
    """``Xh - E[Xh | X0]`` of pairs, shape ``(n, d)``."""
    problem = FlowRegression(found.library, pairs, found.support)
    velocity = problem.corrected(found.values, found.flow, found.noise_rate)
    return (velocity - problem.predicted(found.values)) * pairs.h[:, None]


def copies(pairs: SnapshotPairs) -> float:
    """Factor by which copies of resampled recordings make pairs look more than they are: 1 without any.

    A pair that stands m times counts with weight m, but has only one residual: variances grow by Σm²/Σm,
    which is about 2 for a bootstrap sample.
    """
    _, counts = np.unique(np.column_stack([pairs.x0, pairs.xh]), axis=0, return_counts=True)
    return float((counts**2).sum() / counts.sum())


WEIGHTED_REGRESSION_ROUNDS = (
    2  # of D by the residuals of f, and f by the weights of D: each changes the other by little
)
WEIGHTED_REGRESSION_CHUNK = 20_000  # residuals worked on together
MOST_TERMS = 10  # of an equation: above, terms are only dropped, which is fast


def with_noise_formula(
    found: IdentifiedField, pairs: SnapshotPairs, *, false_terms: float
) -> IdentifiedField | None:
    """The same identification for a noise that depends on the state; None where a constant one can be held.

    Parameters
    ----------
    found
        f as it was found with one weight for all.
    pairs
        The pairs that it was fitted to.
    false_terms
        Probability that a constant D is given up by chance; and that chance brings any false term into f, or
        into D.

    Returns
    -------
    IdentifiedField or None
        f with its D, of which the geometric mean of the determinant over the recorded states is one, and εD.

    Raises
    ------
    NumericalFailure
        When D depends on the state, and no formula for it is positive at all recorded states; or when an
        equation of f has no significant term.
    """
    if found.noise_free:
        return None
    rest = residuals(found, pairs)
    probability = constant_noise_probability(found, pairs, rest)
    if probability >= false_terms:
        return None
    formula = fitted_noise(found, pairs, rest, false_terms=false_terms, probability=probability)
    for _ in range(WEIGHTED_REGRESSION_ROUNDS):
        found = identify_weighted(with_formula(found, formula, pairs.x0), pairs, false_terms=false_terms)
        formula = fitted_noise(
            found, pairs, residuals(found, pairs), false_terms=false_terms, probability=probability
        )
    return fit_weighted(with_formula(found, formula, pairs.x0), pairs)


def with_formula(found: IdentifiedField, formula: NoiseFormula, x: np.ndarray) -> IdentifiedField:
    """The field with D of a formula, and the mean of εD over recorded states in the place of the noise rate.

    Raises
    ------
    NumericalFailure
        Where εD is not positive at one of the states.
    """
    whole = formula.diffusion(1.0)
    matrices = whole.at(x)
    signs, logarithms = np.linalg.slogdet(matrices)
    if not (signs > 0).all():
        raise NumericalFailure("the formula of the noise is not positive at all recorded states")
    intensity = float(np.exp(logarithms.mean() / len(matrices[0])))
    diffusion, mean = formula.diffusion(intensity), matrices.mean(axis=0)
    return replace(found, diffusion=diffusion, noise_rate=mean, noise=formula, constant_noise=None)


def identify_weighted(found: IdentifiedField, pairs: SnapshotPairs, *, false_terms: float) -> IdentifiedField:
    """The significant terms of f, sought anew among all of its library with the weights of its D.

    Parameters
    ----------
    found
        A first f, which says how the flow differs from a straight step, with its D.
    pairs, false_terms
        See `with_noise_formula`.

    Raises
    ------
    NumericalFailure
        When an equation has no significant term.
    """
    q, d = found.library.size, found.library.dimension
    everything = np.array([(i, k) for i in range(d) for k in range(q)])
    triangle, intensity = _triangle_weighted_regression(found, pairs, everything)
    critical = np.tile(critical_values(found.library, false_terms=false_terms), d)
    together = Equation(triangle[:, :-1], triangle[:, -1], intensity * copies(pairs), critical)
    kept = list(best_support(together))
    support = everything[kept]
    for i, name in enumerate(found.library.states):
        if not (support[:, 0] == i).any():
            raise NumericalFailure(f"no term of the equation of {name} is significant; record longer")
    coefficients = np.zeros_like(found.coefficients)
    start = np.linalg.lstsq(triangle[:, kept], triangle[:, -1], rcond=None)[0]
    coefficients[support[:, 1], support[:, 0]] = start
    found = replace(found, coefficients=coefficients, support=support, covariance=np.eye(len(support)))
    return replace(fit_weighted(found, pairs), rivals=rivals_of_all(together, support, dimension=d))


def fit_weighted(found: IdentifiedField, pairs: SnapshotPairs) -> IdentifiedField:
    """The same terms, fitted with the weights of D; with their covariance.

    Also where D is constant, for which `refit` does the same.
    """
    for _ in range(
        WEIGHTED_REGRESSION_ROUNDS + 1
    ):  # each brings the difference between the flow and a straight step up to date
        triangle, intensity = _triangle_weighted_regression(found, pairs, found.support)
        design, goal = triangle[:, :-1], triangle[:, -1]
        scale = np.linalg.norm(design, axis=0)
        values = np.linalg.lstsq(design / scale, goal, rcond=None)[0] / scale
        coefficients = np.zeros_like(found.coefficients)
        coefficients[found.support[:, 1], found.support[:, 0]] = values
        found = replace(found, coefficients=coefficients)
    inverse = np.linalg.pinv(design / scale) / scale[:, None]
    return replace(found, covariance=intensity * copies(pairs) * inverse @ inverse.T)


def with_given_noise(
    found: IdentifiedField, pairs: SnapshotPairs, diffusion: Diffusion, *, false_terms: float
) -> IdentifiedField:
    """The same identification with the weights of a given D; see `with_noise_formula`."""
    found = replace(found, diffusion=diffusion)
    if found.noise_free or diffusion.constant:
        return found
    return identify_weighted(found, pairs, false_terms=false_terms)


def whitened(found: IdentifiedField, pairs: SnapshotPairs, rest: np.ndarray) -> np.ndarray:
    """Residuals as random forces ``σ(x)⁻¹ r/√h``, of the variance ε everywhere: shape ``(n, d)``."""
    forces = random_forces_of(found, pairs, rest)
    return np.asarray((found.diffusion.whitening_at(pairs.x0) @ forces[:, :, None])[:, :, 0])


def weighted_residual_probability(found: IdentifiedField, pairs: SnapshotPairs) -> float:
    """Probability of held-out residuals having no mean left that f's library could express.

    As `siq.inference.residuals.mean_residual_probability`, which is for a constant D: an F test of the
    regression of the residuals on the library, here of all states at once and with the weights of D.
    """
    q, d, n = found.library.size, found.library.dimension, len(pairs.h)
    everything = np.array([(i, k) for i in range(d) for k in range(q)])
    triangle, _ = _triangle_weighted_regression(found, pairs, everything, of_rest=True)
    explained = float((triangle[:-1, -1] ** 2).sum())
    left = float(triangle[-1, -1] ** 2)
    freedom = n * d - q * d
    ratio = (explained / (q * d)) / (left / freedom)
    return float(scipy.special.fdtrc(q * d, freedom, ratio))


def _triangle_weighted_regression(
    found: IdentifiedField, pairs: SnapshotPairs, places: np.ndarray, *, of_rest: bool = False
) -> tuple[np.ndarray, float]:
    """R of the weighted design with its goal as the last column, on which everything depends; and ε.

    The goal are velocities, corrected for the curvature of the flow, or what f leaves of them.
    """
    problem = FlowRegression(found.library, pairs, found.support)
    velocity = problem.corrected(found.values, found.flow, found.noise_rate)
    left = velocity - problem.predicted(found.values)
    p, d = len(places), found.library.dimension
    triangle, squares = np.zeros((0, p + 1)), 0.0
    for begin in range(0, len(pairs.h), WEIGHTED_REGRESSION_CHUNK):
        part = slice(begin, begin + WEIGHTED_REGRESSION_CHUNK)
        x, h = pairs.x0[part], pairs.h[part]
        whitening = found.diffusion.whitening_at(x) * np.sqrt(h)[:, None, None]
        terms = found.library.evaluate(x)[:, places[:, 1]]
        block = np.empty((len(x), d, p + 1))
        block[:, :, :-1] = whitening[:, :, places[:, 0]] * terms[:, None, :]
        goal = left if of_rest else velocity
        block[:, :, -1] = (whitening @ goal[part][:, :, None])[:, :, 0]
        squares += float(((whitening @ left[part][:, :, None]) ** 2).sum())
        stacked = np.concatenate([triangle, block.reshape(-1, p + 1)])
        triangle = np.asarray(np.linalg.qr(stacked, mode="r"))
    return triangle, squares / (len(pairs.h) * d)
