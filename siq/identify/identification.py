"""The vector field, identified first: sparse regression of the flow over the step of the pairs.

``Xh = Φ_h(X0; f) + noise`` with ``f = Θ Ξ_f``. Deferred correction makes this a linear problem: with the
current f the difference between the flow and ``X0 + h f(X0)`` is subtracted from the data, and a few rounds
reach the exact answer. Terms are dropped by their own uncertainty, and what remains is fitted by generalised
least squares with the covariance that the residuals show, which attains the Cramér–Rao bound.

Not to be confused with the f of `siq.networks.regression`, which is that of the networks: here no network
takes part, and V and g are not known yet. That makes it the yardstick of the certificate.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass as plain_dataclass
from dataclasses import replace
from functools import cached_property
from typing import Annotated

import numpy as np
import scipy.linalg
import scipy.special
import sympy
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from siq.data.recordings import SnapshotPairs
from siq.dynamics.diffusion import Diffusion
from siq.dynamics.dynamics import Dynamics, Parameter
from siq.dynamics.formulas import compile_formulas
from siq.dynamics.parametric import symbol
from siq.errors import NumericalFailure
from siq.identify.flow import FlowMap, flow_map
from siq.identify.library import CandidateLibrary

ROUNDS = 25  # of deferred correction, each of which gains a factor of about h times the Jacobian
CHUNK = 4096  # pairs worked on together
NOISE_FREE = 1e-6  # residuals below this share of the increments are the integrator's and the rounding's


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class IdentificationOptions:
    """In which functions the vector field is sought, and what makes a term significant.

    Attributes
    ----------
    degree
        Highest degree of the monomials.
    functions
        Further functions of the states, as formulas: roots, fractions and whatever else.
    false_terms
        Probability that noise alone brings any false term into f. Each candidate is judged by its own
        standard error, at this probability divided by the number of candidates.
    precision
        A term that contributes less than this share of f is dropped also from data without noise, whose
        residuals are the integrator's error and not random.
    pairs
        Most pairs used where the data carry no noise; with noise all are.
    """

    degree: Annotated[int, Field(ge=1, le=12)] = 5
    functions: tuple[str, ...] = ()
    false_terms: Annotated[float, Field(gt=0, lt=0.5)] = 0.01
    precision: Annotated[float, Field(gt=0, lt=0.1)] = 1e-7
    pairs: Annotated[int, Field(ge=100)] = 8_000


@plain_dataclass(frozen=True)
class IdentifiedField:
    """A vector field ``f = Θ Ξ`` with its uncertainty.

    Attributes
    ----------
    library
        The q functions.
    coefficients
        Ξ, shape ``(q, d)``: column i holds the coefficients of f_i.
    support
        Shape ``(p, 2)``: the pair (component i, term k) of each of the p coefficients that are not zero.
    covariance
        Shape ``(p, p)``: their covariance.
    noise_rate
        Shape ``(d, d)``: covariance of the residual per unit of time. For process noise it is ε D.
    residual_ratio
        Rms of the residuals over rms of the increments.
    flow
        The map over a pair's step that was fitted.
    diffusion
        D, which recordings do not tell apart from ε: of these only the product, `noise_rate`, is identified.
    """

    library: CandidateLibrary
    coefficients: np.ndarray
    support: np.ndarray
    covariance: np.ndarray
    noise_rate: np.ndarray
    residual_ratio: float
    flow: FlowMap
    diffusion: Diffusion

    @property
    def noise_free(self) -> bool:
        """Whether the residuals are those of the integrator and of rounding."""
        return self.residual_ratio < NOISE_FREE

    @cached_property
    def dynamics(self) -> Dynamics:
        """F and D, with the p coefficients that are not zero as parameters, and their covariance."""
        prefix = "c"
        while any(f"{prefix}{place}" in self.library.states for place in range(len(self.support))):
            prefix += "_"
        names = [f"{prefix}{place}" for place in range(len(self.support))]
        equations = [sympy.S.Zero] * self.library.dimension
        for (component, term), name in zip(self.support, names, strict=True):
            equations[component] += symbol(name) * self.library.terms[term]
        return Dynamics(
            states=self.library.states,
            equations=tuple(equations),
            diffusion=self.diffusion,
            parameters=tuple(
                Parameter(name, float(value)) for name, value in zip(names, self.values, strict=True)
            ),
            covariance=self.covariance,
        )

    @property
    def values(self) -> np.ndarray:
        """The p coefficients that are not zero."""
        return self.coefficients[self.support[:, 1], self.support[:, 0]]

    @property
    def standard_errors(self) -> np.ndarray:
        """Shape ``(q, d)``: standard error of each coefficient, zero where there is no term."""
        errors = np.zeros_like(self.coefficients)
        errors[self.support[:, 1], self.support[:, 0]] = np.sqrt(np.diag(self.covariance))
        return errors


def identify_vector_field(
    library: CandidateLibrary,
    pairs: SnapshotPairs,
    *,
    options: IdentificationOptions,
    diffusion: Diffusion | None = None,
    integrator_step: float | None = None,
) -> IdentifiedField:
    """Find f from pairs.

    Parameters
    ----------
    library
        The candidate functions.
    pairs
        X0, Xh and h.
    options
        What makes a term significant.
    diffusion
        D, by default the unit matrix; f does not depend on it.
    integrator_step
        Step of the Euler–Maruyama simulation that made the pairs, None for everything else. Then the
        increment of each step is h f exactly, and f is that of the continuous process.

    Raises
    ------
    NumericalFailure
        When there are fewer pairs than functions, or a function is not finite on them.

    Notes
    -----
    The residuals of noisy pairs are independent, so that the standard errors fall with the number of
    pairs. Those of noise-free pairs are the error of integrators, the same in neighbouring pairs: their
    standard errors are given without that gain, as a bound.
    """
    if not carries_noise(library, pairs, options=options, integrator_step=integrator_step):
        pairs = _rows(pairs, evenly(len(pairs.h), options.pairs))
    noise = Diffusion.identity(library.dimension) if diffusion is None else diffusion
    return _identify(library, pairs, options, noise, integrator_step)


def carries_noise(
    library: CandidateLibrary,
    pairs: SnapshotPairs,
    *,
    options: IdentificationOptions,
    integrator_step: float | None = None,
) -> bool:
    """Whether pairs are more than an integrator's error away from any f in the library.

    The arguments are those of `identify_vector_field`.
    """
    _check_count(library, pairs)
    some = _rows(pairs, evenly(len(pairs.h), max(options.pairs // 4, 4 * library.size)))
    return _fit_everything(library, some, integrator_step).ratio >= NOISE_FREE


def refit(found: IdentifiedField, pairs: SnapshotPairs) -> IdentifiedField:
    """The same terms fitted to other pairs, such as those of the training recordings alone."""
    return _fit_support(found, _Problem(found.library, pairs, found.support))


def residuals(found: IdentifiedField, pairs: SnapshotPairs) -> np.ndarray:
    """``Xh - E[Xh | X0]`` of pairs, shape ``(n, d)``."""
    problem = _Problem(found.library, pairs, found.support)
    velocity = problem.corrected(found.values, found.flow, found.noise_rate)
    return (velocity - problem.predicted(found.values)) * pairs.h[:, None]


def copies(pairs: SnapshotPairs) -> float:
    """Factor by which copies of resampled recordings make pairs look more than they are: 1 without any.

    A pair that stands m times counts with weight m, but has only one residual: variances grow by Σm²/Σm,
    which is about 2 for a bootstrap sample.
    """
    _, counts = np.unique(np.column_stack([pairs.x0, pairs.xh]), axis=0, return_counts=True)
    return float((counts**2).sum() / counts.sum())


def evenly(count: int, most: int) -> np.ndarray:
    """At most so many of `count` rows, evenly spread."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(int))


class _Problem:
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


def _identify(
    library: CandidateLibrary,
    pairs: SnapshotPairs,
    options: IdentificationOptions,
    diffusion: Diffusion,
    integrator_step: float | None,
) -> IdentifiedField:
    _check_count(library, pairs)
    q, d, n = library.size, library.dimension, len(pairs.h)
    dense = _fit_everything(library, pairs, integrator_step)
    triangle, values, noise_free = dense.triangle, dense.values, dense.ratio < NOISE_FREE
    repeated = 1.0 if noise_free else copies(pairs)
    chosen = [
        (i, k)
        for i in range(d)
        for k in _significant(
            triangle, q, i, n / repeated, options=options, noise_free=noise_free, candidates=d * q
        )
    ]
    if len({i for i, _ in chosen}) < d:
        missing = next(i for i in range(d) if i not in {j for j, _ in chosen})
        raise NumericalFailure(f"no term of the equation of {library.states[missing]} is significant")
    coefficients = np.zeros((q, d))
    support = np.array(chosen)
    for i, k in chosen:
        coefficients[k, i] = values[i * q + k]
    found = IdentifiedField(
        library, coefficients, support, np.eye(len(support)), dense.rate, dense.ratio, dense.flow, diffusion
    )
    problem = _Problem(library, pairs, support)
    found = _fit_support(found, problem)
    # With the final support and flow a term may turn out to be superfluous after all.
    while (weak := _weakest(found, problem, options)) is not None:
        support = np.delete(found.support, weak, axis=0)
        coefficients = np.zeros_like(found.coefficients)
        coefficients[support[:, 1], support[:, 0]] = found.coefficients[support[:, 1], support[:, 0]]
        problem = _Problem(library, pairs, support)
        found = _fit_support(replace(found, coefficients=coefficients, support=support), problem)
    return found


def _check_count(library: CandidateLibrary, pairs: SnapshotPairs) -> None:
    if len(pairs.h) < 2 * library.size:
        raise NumericalFailure(
            f"only {len(pairs.h)} pairs for {library.size} candidate functions of f;"
            " lower identification.degree or record more"
        )


@plain_dataclass(frozen=True)
class _Dense:
    """The fit of all functions of a library: coefficients, and the triangle of the last least squares."""

    values: np.ndarray
    triangle: np.ndarray
    rate: np.ndarray
    ratio: float
    flow: FlowMap


def _fit_everything(library: CandidateLibrary, pairs: SnapshotPairs, integrator_step: float | None) -> _Dense:
    q, d, n = library.size, library.dimension, len(pairs.h)
    everything = np.array([(i, k) for i in range(d) for k in range(q)])
    full = _Problem(library, pairs, everything)
    weight = np.sqrt(pairs.h)
    flow: FlowMap | None = None
    values = np.zeros(d * q)
    rate: np.ndarray | None = None
    triangle = np.zeros((0, 0))
    for done in range(ROUNDS):
        velocity = full.corrected(values, flow, rate)
        triangle = _triangle(full.theta, velocity, weight)
        # Scaled columns, for functions differ by many orders of magnitude where units are small or large.
        scale = _positive(np.linalg.norm(triangle[:q, :q], axis=0))
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
    return _Dense(values, triangle, rate, float(ratio), flow)


def _triangle(theta: np.ndarray, velocity: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """R of the QR decomposition of √h [Θ, velocity], on which everything further depends."""
    stacked = np.empty((theta.shape[1], theta.shape[0] + velocity.shape[1]))
    stacked[:, : theta.shape[0]] = theta.T
    stacked[:, theta.shape[0] :] = velocity
    stacked *= weight[:, None]
    return np.asarray(np.linalg.qr(stacked, mode="r"))


def _critical(options: IdentificationOptions, candidates: int) -> float:
    return float(-scipy.special.ndtri(options.false_terms / (2 * candidates)))


def _significant(
    triangle: np.ndarray,
    q: int,
    component: int,
    n: float,
    *,
    options: IdentificationOptions,
    noise_free: bool,
    candidates: int,
) -> np.ndarray:
    """Backward elimination of one equation: the least significant term leaves, until all are significant."""
    critical = _critical(options, candidates)
    goal = triangle[:, q + component]
    size = np.linalg.norm(goal)
    active = np.arange(q)
    while len(active):
        orthogonal, upper = np.linalg.qr(triangle[:, active])
        coefficients = scipy.linalg.solve_triangular(upper, orthogonal.T @ goal)
        misfit = goal - triangle[:, active] @ coefficients
        variance = misfit @ misfit / max(n - len(active), 1)
        inverse = scipy.linalg.solve_triangular(upper, np.eye(len(active)))
        errors = np.sqrt(variance) * np.linalg.norm(inverse, axis=1)
        contribution = np.abs(coefficients) * np.linalg.norm(triangle[:, active], axis=0) / (size or 1.0)
        strength = np.minimum(np.abs(coefficients) / np.where(errors > 0, errors, 1e-300) / critical, 1e30)
        if noise_free:
            strength = contribution / options.precision
        weakest = int(np.argmin(strength))
        if strength[weakest] >= 1 and contribution.min() >= options.precision:
            break
        active = np.delete(active, weakest)
    return active


def _weakest(found: IdentifiedField, problem: _Problem, options: IdentificationOptions) -> int | None:
    """The least significant term, if it is not significant, and not the last of its equation."""
    if found.noise_free:
        terms = np.sqrt(problem.theta**2 @ problem.h)[problem.position]
        sizes = np.sqrt(problem.h @ problem.predicted(found.values) ** 2)
        strength = np.abs(found.values) * terms / _positive(sizes)[found.support[:, 0]] / options.precision
    else:
        critical = _critical(options, found.library.size * found.library.dimension)
        strength = np.abs(found.values) / np.sqrt(np.diag(found.covariance)) / critical
    for index in np.argsort(strength):
        if strength[index] >= 1:
            return None
        if np.sum(found.support[:, 0] == found.support[index, 0]) > 1:
            return int(index)
    return None


def _fit_support(found: IdentifiedField, problem: _Problem) -> IdentifiedField:
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


def _positive(sizes: np.ndarray) -> np.ndarray:
    """Sizes to divide by: one where they vanish."""
    return np.where(sizes > 0, sizes, 1.0)


def _residual_ratio(rate: np.ndarray, pairs: SnapshotPairs) -> float:
    """Rms of the residuals over rms of the increments, each component by its own."""
    size = ((pairs.xh - pairs.x0) ** 2 / pairs.h[:, None]).mean(axis=0)
    return float(np.sqrt((np.diag(rate) / _positive(size)).mean()))


def _rows(pairs: SnapshotPairs, rows: np.ndarray) -> SnapshotPairs:
    return SnapshotPairs(pairs.x0[rows], pairs.xh[rows], pairs.h[rows], pairs.recording[rows])
