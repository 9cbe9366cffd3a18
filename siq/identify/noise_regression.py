"""Is the noise stronger here than there, and by which formula? D(x) from the residuals of f.

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

from functools import cached_property

import numpy as np
import scipy.linalg
import scipy.special

from siq.data.recordings import SnapshotPairs
from siq.dynamics.formulas import compile_formulas
from siq.errors import NumericalFailure
from siq.identify.identified_field import IdentifiedField
from siq.identify.library import monomial_exponents
from siq.identify.noise_formula import NoiseFormula
from siq.identify.noise_selection import DEGREE, HARMLESS, noise_functions, selected_noise

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
        The residuals, shape ``(n, d)``; see `siq.identify.flow_regression.residuals`.

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
