"""A model of the diffusion D(x) from residuals.

Where the likelihood is from makes no difference: of residuals of pairs (`siq.inference.diffusion_model`), or
of the innovations of a filter (`siq.inference.state_dependent_diffusion`).

A residual r of f over a step h has the covariance ``h εD(x)``, up to what the step forgets. First it is asked
whether a constant εD can be held: by the score of a linear change of it with functions φ of the state, which
has the mean zero if it can,

    s = Σ_n (z_i z_j - δ_ij) φ_k(x_n),    z = (εD)^(-1/2) r/√h,    sᵀ B⁻¹ s ~ χ²,

where B is the score's own sum of squares, so that no normal law of the residuals is asked for. If it cannot,
the formula ``εD(x) = Σ_k S_k φ_k(x)`` is the one of the largest likelihood

    -½ Σ_n [log det εD(x_n) + rᵀ(εD(x_n))⁻¹ r/h],

which is minus infinity where D is not positive at a recorded state. Its terms are dropped one by one, as long
as one does not differ from zero by its own standard error. Over a step φ changes, too: in its place stands
``φ + h/2 (f·∇φ + ½ tr εD∇²φ)``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import Protocol

import numpy as np
import scipy.linalg
import scipy.special
import sympy

from siq.data.recordings import SnapshotPairs
from siq.errors import NumericalFailure
from siq.inference.field_estimate import IdentifiedField, NoiseFormula
from siq.inference.library import monomial_exponents
from siq.systems.formulas import compile_formulas

DEGREE = 2  # of the formulas: the least that can bend, and keep positive where a straight line does not
HARMLESS = 0.02  # relative change of D over the states below which a constant one will do, see `residuals`
FEW_STATES = 3  # of which correlations may depend on the state: sixty coefficients


def noise_functions(symbols: Sequence[sympy.Symbol]) -> list[sympy.Expr]:
    """The functions of the state in which D is sought, the constant first."""
    return [
        sympy.Mul(*(each**power for each, power in zip(symbols, powers, strict=True)))
        for powers in monomial_exponents(len(symbols), DEGREE)
    ]


def all_places(d: int, functions: int) -> np.ndarray:
    """Row, column and function of every coefficient that εD(x) may have, shape ``(p, 3)``."""
    # Of many states the correlations are constant: their formulas would be most of all coefficients.
    whole = d <= FEW_STATES
    return np.array(
        [(i, j, k) for i in range(d) for j in range(i, d) for k in range(functions if i == j or whole else 1)]
    )


class NoiseLikelihood(Protocol):
    """How likely recordings are under formulas of the noise.

    Attributes
    ----------
    symbols, terms
        The d states, and the functions of them.
    start
        εD where it is the same everywhere, shape ``(d, d)``.
    """

    @property
    def symbols(self) -> Sequence[sympy.Symbol]:
        """See above."""

    @property
    def terms(self) -> Sequence[sympy.Expr]:
        """See above."""

    @property
    def start(self) -> np.ndarray:
        """See above."""

    def positive(self, chosen: np.ndarray, values: np.ndarray) -> bool:
        """Whether D is positive definite at all recorded states."""

    def scored(self, chosen: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Coefficients of the largest likelihood from a start at which D is positive, with covariance."""

    def least_squares(self, chosen: np.ndarray) -> np.ndarray:
        """Coefficients at which D is positive, where no constant part makes it so."""


def selected_noise(data: NoiseLikelihood, *, false_terms: float, probability: float) -> NoiseFormula:
    """εD(x) of the largest likelihood, of the terms that differ from zero.

    Parameters
    ----------
    data
        The likelihood.
    false_terms
        Probability that chance brings any term into D.
    probability
        See `NoiseFormula`.

    Raises
    ------
    NumericalFailure
        When no formula of this kind is positive at all recorded states.
    """
    start = data.start
    chosen = all_places(len(start), len(data.terms))
    values = np.array([start[i, j] if k == 0 else 0.0 for i, j, k in chosen])
    critical = float(-scipy.special.ndtri(false_terms / (2 * len(chosen))))
    while True:
        values, covariance = data.scored(chosen, values)
        kept, values = _eliminated(chosen, values, covariance, critical)
        if len(kept) == len(chosen):
            break
        chosen = chosen[kept]
        # What is left may not be positive: then the others begin where they are sure to be, if they can.
        if not data.positive(chosen, values):
            values = np.array([start[i, j] * (i == j) if k == 0 else 0.0 for i, j, k in chosen])
        if not data.positive(chosen, values):
            values = data.least_squares(chosen)
    return NoiseFormula(
        tuple(data.symbols), chosen[:, :2], tuple(data.terms[k] for k in chosen[:, 2]), values, covariance,
        probability,
    )  # fmt: skip


def _eliminated(
    chosen: np.ndarray, values: np.ndarray, covariance: np.ndarray, critical: float
) -> tuple[np.ndarray, np.ndarray]:
    """Backward elimination about the largest likelihood: the coefficients that stay, and what they become.

    The last term of a state's own noise stays: without it there would be none.
    """
    kept = np.arange(len(chosen))
    while len(kept):
        own = chosen[kept, 0] == chosen[kept, 1]
        count = np.array([(own & (chosen[kept, 0] == i)).sum() for i in chosen[kept, 0]])
        strength = np.abs(values) / np.sqrt(np.maximum(np.diag(covariance), np.finfo(float).tiny))
        strength[own & (count == 1)] = np.inf
        weakest = int(np.argmin(strength))
        if strength[weakest] >= critical:
            break
        along = covariance[:, weakest] / covariance[weakest, weakest]
        values = np.delete(values - along * values[weakest], weakest)
        covariance = covariance - np.outer(along, covariance[weakest])
        covariance = np.delete(np.delete(covariance, weakest, axis=0), weakest, axis=1)
        kept = np.delete(kept, weakest)
    return kept, values


MOST_NUMBERS = 2e7  # numerical: of an array in memory, 160 MB
FEWEST = 20  # residuals for each coefficient of D: fewer do not show its sum of squares
STEPS, HALVINGS = 60, 30  # numerical: most steps of Fisher's scoring, each halved until it gains
SETTLED = 1e-9  # numerical: gain of the log-likelihood, per residual, with which scoring ends
LONGEST = 0.5  # of Jh/2: beyond that a residual hardly knows where its step began


def constant_noise_probability(found: IdentifiedField, pairs: SnapshotPairs, rest: np.ndarray) -> float:
    """The probability that residuals under a constant D speak as much for one that depends on the state.

    Parameters
    ----------
    found
        f.
    pairs
        X0, Xh and h.
    rest
        The residuals, shape ``(n, d)``; see `siq.inference.flow_regression.residuals`.

    Returns
    -------
    float
        1 where the residuals are too few to tell, or the change that they speak for is harmless.
    """
    data = _Residuals(found, *_affordable(pairs, rest))
    n, d = data.rest.shape
    entries = d * (d + 1) // 2
    if n < FEWEST * entries * data.functions.shape[1]:
        return 1.0
    rate = data.rest.T @ data.rest / n
    z = scipy.linalg.solve_triangular(np.linalg.cholesky(rate), data.rest.T, lower=True).T
    functions = data.functions[:, 1:] - data.functions[:, 1:].mean(axis=0)
    size = functions.std(axis=0)
    functions = functions[:, size > 0] / size[size > 0]
    products = np.stack([z[:, i] * z[:, j] - (i == j) for i in range(d) for j in range(i + 1)], axis=1)
    score = (products[:, :, None] * functions[:, None, :]).reshape(n, -1)
    change = np.linalg.lstsq(functions, products, rcond=None)[0]
    if np.sqrt(((functions @ change) ** 2).mean(axis=0)).max() < HARMLESS:
        return 1.0
    total = score.sum(axis=0)
    statistic = float(total @ np.linalg.pinv(score.T @ score, hermitian=True) @ total)
    rank = np.linalg.matrix_rank(score.T @ score, hermitian=True)
    return float(scipy.special.chdtrc(rank, statistic))


def fitted_noise(
    found: IdentifiedField, pairs: SnapshotPairs, rest: np.ndarray, *, false_terms: float, probability: float
) -> NoiseFormula:
    """εD(x) of the largest likelihood, of the terms that differ from zero.

    Parameters
    ----------
    found, pairs, rest
        As for `constant_noise_probability`.
    false_terms
        Probability that chance brings any term into D.
    probability
        See `NoiseFormula`.

    Raises
    ------
    NumericalFailure
        When no formula of this kind is positive at all recorded states.
    """
    data = _Residuals(found, *_affordable(pairs, rest))
    return selected_noise(data, false_terms=false_terms, probability=probability)


def remembered(found: IdentifiedField) -> float:
    """The mean time, as a share of a step, for which the system goes on after a kick within the step."""
    return (1 - 1 / found.flow.steps) / 2 if found.flow.euler else 0.5


def random_forces_of(found: IdentifiedField, pairs: SnapshotPairs, rest: np.ndarray) -> np.ndarray:
    """Residuals per root of time, with what the system forgot within the step put back: shape ``(n, d)``.

    ``∫₀ʰ e^{Js} D e^{Jᵀs} ds`` is ``h e^{Jh/2} D e^{Jᵀh/2}`` but for the second order in Jh.
    """
    d = rest.shape[1]
    step = found.dynamics.jacobian(pairs.x0) * (remembered(found) * pairs.h)[:, None, None]
    if not np.isfinite(step).all() or np.abs(step).max(initial=0.0) > LONGEST:
        step = np.zeros_like(step)
    back = np.eye(d) - step + step @ step / 2
    return np.asarray((back @ rest[:, :, None])[:, :, 0] / np.sqrt(pairs.h)[:, None])


def _affordable(pairs: SnapshotPairs, rest: np.ndarray) -> tuple[SnapshotPairs, np.ndarray]:
    """Pairs and residuals, evenly thinned where there are more than memory has room for."""
    n, d = rest.shape
    functions = len(monomial_exponents(d, DEGREE))
    most = int(MOST_NUMBERS / (functions * d * (d + 1)))
    rows = np.unique(np.linspace(0, n - 1, min(n, most)).astype(int))
    return (pairs, rest) if len(rows) == n else (pairs.take(rows), rest[rows])


class _Residuals:
    """Residuals per root of time, what a step forgets put back, and the functions of D where they began."""

    def __init__(self, found: IdentifiedField, pairs: SnapshotPairs, rest: np.ndarray) -> None:
        self.found = found
        symbols, d = found.library.symbols, found.library.dimension
        self.symbols, self.terms = symbols, noise_functions(symbols)
        x, h = pairs.x0, pairs.h
        self.rest, share = random_forces_of(found, pairs, rest), remembered(found)
        first = [term.diff(one) for term in self.terms for one in symbols]
        second = [term.diff(one, other) for term in self.terms for one in symbols for other in symbols]
        components, m = np.ascontiguousarray(x.T), len(self.terms)
        values = compile_formulas(self.terms, symbols)(components)
        slopes = compile_formulas(first, symbols)(components).reshape(m, d, -1)
        bends = compile_formulas(second, symbols)(components).reshape(m, d * d, -1)
        moved = np.einsum("kin,ni->kn", slopes, found.dynamics.drift(x))
        moved += 0.5 * np.einsum("kan,a->kn", bends, found.noise_rate.ravel())
        self.functions = (values + share * h * moved).T
        self.plain = values.T

    @cached_property
    def start(self) -> np.ndarray:
        """The constant εD, shape ``(d, d)``."""
        return np.asarray(self.rest.T @ self.rest / len(self.rest))

    @cached_property
    def size(self) -> np.ndarray:
        """Rms of each function, shape ``(m,)``."""
        size = np.sqrt((self.functions**2).mean(axis=0))
        return np.where(size > 0, size, 1.0)

    def matrices(self, chosen: np.ndarray, values: np.ndarray, *, plain: bool = False) -> np.ndarray:
        """ΕD at the residuals, ``(n, d, d)``."""
        functions = self.plain if plain else self.functions
        d = self.rest.shape[1]
        found = np.zeros((len(functions), d, d))
        for (i, j, k), value in zip(chosen, values, strict=True):
            found[:, i, j] += value * functions[:, k]
            if i != j:
                found[:, j, i] += value * functions[:, k]
        return found

    def positive(self, chosen: np.ndarray, values: np.ndarray) -> bool:
        """Whether D is positive definite wherever there are residuals."""
        return np.isfinite(self.likelihood(chosen, values))

    def likelihood(self, chosen: np.ndarray, values: np.ndarray) -> float:
        """The logarithm of the likelihood, per residual and up to a constant."""
        matrices = self.matrices(chosen, values)
        try:
            # Neither may D vanish at the states themselves, which are where it is going to be used.
            np.linalg.cholesky(self.matrices(chosen, values, plain=True))
            factor = np.linalg.cholesky(matrices)
        except np.linalg.LinAlgError:
            return -np.inf
        pulled = (np.linalg.inv(matrices) @ self.rest[:, :, None])[:, :, 0]
        logarithm = np.log(np.einsum("nii->ni", factor)).sum(axis=1)
        return float(-(logarithm + 0.5 * (pulled * self.rest).sum(axis=1)).mean())

    def least_squares(self, chosen: np.ndarray) -> np.ndarray:
        """Coefficients by least squares of the squares of residuals: a start for the likelihood."""
        values = np.zeros(len(chosen))
        for i, j in {(int(i), int(j)) for i, j, _ in chosen}:
            rows = (chosen[:, 0] == i) & (chosen[:, 1] == j)
            product = self.rest[:, i] * self.rest[:, j]
            values[rows] = np.linalg.lstsq(self.functions[:, chosen[rows, 2]], product, rcond=None)[0]
        if not self.positive(chosen, values):
            raise NumericalFailure(
                "the noise depends on the state, and no formula of low degree for it is positive at all"
                " recorded states; give D as 'recordings.diffusion', in numbers or formulas"
            )
        return values

    def scored(self, chosen: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The largest likelihood from a start by Fisher's scoring, and the covariance of the coefficients.

        The covariance is the one that holds whatever the law of the residuals: ``F⁻¹ B F⁻¹`` with the
        information F and the sum of squares B of the score.
        """
        size, reached = self.size[chosen[:, 2]], self.likelihood(chosen, values)
        for _ in range(STEPS):
            precision = np.linalg.inv(self.matrices(chosen, values))
            total = self._score(chosen, precision).sum(axis=0)
            step = np.linalg.pinv(self._information(chosen, precision), hermitian=True) @ total / size
            gain = 0.0
            for _ in range(HALVINGS):
                attempt = self.likelihood(chosen, values + step)
                if attempt > reached:
                    gain, values, reached = attempt - reached, values + step, attempt
                    break
                step = step / 2
            if gain < SETTLED:
                break
        precision = np.linalg.inv(self.matrices(chosen, values))
        score = self._score(chosen, precision)
        inverse = np.linalg.pinv(self._information(chosen, precision), hermitian=True) / size[:, None]
        return values, inverse @ (score.T @ score) @ inverse.T

    def _score(self, chosen: np.ndarray, precision: np.ndarray) -> np.ndarray:
        """The score of each residual, ``(n, p)``, by the coefficients times the sizes of their functions."""
        pulled = (precision @ self.rest[:, :, None])[:, :, 0]
        score = np.empty((len(pulled), len(chosen)))
        for column, (i, j, k) in enumerate(chosen):
            half = 0.5 if i == j else 1.0
            score[:, column] = half * (pulled[:, i] * pulled[:, j] - precision[:, i, j])
            score[:, column] *= self.functions[:, k] / self.size[k]
        return score

    def _information(self, chosen: np.ndarray, precision: np.ndarray) -> np.ndarray:
        """Fisher's information ``½ Σ tr D⁻¹∂D D⁻¹∂D`` of the same coefficients, ``(p, p)``."""
        information = np.empty((len(chosen), len(chosen)))
        functions = self.functions / self.size
        entries = sorted({(int(i), int(j)) for i, j, _ in chosen})
        for i, j in entries:
            rows = np.flatnonzero((chosen[:, :2] == (i, j)).all(axis=1))
            for k, m in entries:
                columns = np.flatnonzero((chosen[:, :2] == (k, m)).all(axis=1))
                share = (0.5 if i == j else 1.0) * (0.5 if k == m else 1.0)
                weight = share * (
                    precision[:, i, k] * precision[:, j, m] + precision[:, i, m] * precision[:, j, k]
                )
                left = functions[:, chosen[rows, 2]] * weight[:, None]
                information[np.ix_(rows, columns)] = left.T @ functions[:, chosen[columns, 2]]
        return information


PAIRS = 500  # to average over: the mean of a smooth function of the state, to a few per cent of a small term
RANDOM_FORCES_LONGEST = 2.0  # rates of J times h: beyond that a residual hardly knows how its step began
TERMS = 24  # of the exponential series, which then is exact to ten digits


def with_random_forces(found: IdentifiedField, pairs: SnapshotPairs) -> IdentifiedField:
    """The same field, its `noise_rate` that of the random forces and no longer that of the residuals.

    Along a step the system forgets a part of what kicked it: a residual has the covariance
    ``∫₀ʰ e^{Js} εD e^{Jᵀs} ds`` with the Jacobian J of f, and not hεD. Per time that is less than εD, by the
    share hλ for relaxation at the rate λ: by four per cent where λ = 2/s is sampled every 0.02 s. The mean of
    that map over the pairs is inverted. What is left is of second order in the step, where the noise moves J
    itself. An Euler–Maruyama simulation forgets in steps of its own, and nothing within one.

    Parameters
    ----------
    found
        f with the covariance of its residuals per time.
    pairs
        The pairs that it was fitted to.
    """
    if found.noise_free or not len(pairs.h):
        return found
    every = max(len(pairs.h) // PAIRS, 1)
    jacobian = found.dynamics.jacobian(pairs.x0[::every])
    step = jacobian * pairs.h[::every, None, None]
    if not np.isfinite(step).all() or np.abs(np.linalg.eigvals(step)).max() > RANDOM_FORCES_LONGEST:
        return found
    seen = (_forgotten_by_euler(step, found.flow.steps) if found.flow.euler else _forgotten(step)).mean(
        axis=0
    )
    d = len(found.noise_rate)
    try:
        rate = np.linalg.solve(seen, found.noise_rate.ravel()).reshape(d, d)
    except np.linalg.LinAlgError:
        return found
    rate = (rate + rate.T) / 2
    if np.linalg.eigvalsh(rate)[0] < 0:
        return found  # of forces on a part of the states the residuals have rounding, too
    return replace(found, noise_rate=rate)


def _forgotten(step: np.ndarray) -> np.ndarray:
    """``∫₀¹ e^{As} ⊗ e^{As} ds`` for ``A = hJ``: from ``(n, d, d)`` to ``(n, d², d²)``."""
    n, d, _ = step.shape
    unit = np.eye(d)
    # e^{As} ⊗ e^{As} = e^{(A ⊗ 1 + 1 ⊗ A) s}
    generator = np.einsum("nij,kl->nikjl", step, unit) + np.einsum("ij,nkl->nikjl", unit, step)
    generator = generator.reshape(n, d * d, d * d)
    term = np.broadcast_to(np.eye(d * d), generator.shape)
    total = term.copy()
    for order in range(1, TERMS):
        term = term @ generator / order
        total += term / (order + 1)
    return total


def _forgotten_by_euler(step: np.ndarray, steps: int) -> np.ndarray:
    """The mean of ``M^k ⊗ M^k`` for the steps k of a simulation, ``M = 1 + hJ/steps``."""
    n, d, _ = step.shape
    forward = np.eye(d) + step / steps
    both = np.einsum("nij,nkl->nikjl", forward, forward).reshape(n, d * d, d * d)
    term = np.broadcast_to(np.eye(d * d), both.shape)
    total = np.zeros_like(both)
    for _ in range(steps):
        total += term / steps
        term = term @ both
    return total
