"""f where the noise is stronger here than there: least squares with the weight D(x)⁻¹ of each residual.

With one weight for all, coefficients remain right on average, but their standard errors do not, and terms are
taken as significant that are none. With the right weights both are at the Cramér–Rao bound.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy.special

from siq.data.recordings import SnapshotPairs
from siq.dynamics.diffusion import Diffusion
from siq.errors import NumericalFailure
from siq.identify.flow_regression import FlowRegression, copies, residuals
from siq.identify.identified_field import IdentifiedField
from siq.identify.noise_formula import NoiseFormula
from siq.identify.noise_regression import constant_noise_probability, fitted_noise, random_forces_of
from siq.identify.rival_terms import rivals_of_all
from siq.identify.selection import Equation, best_support, critical_values

ROUNDS = 2  # of D by the residuals of f, and f by the weights of D: each changes the other by little
CHUNK = 20_000  # residuals worked on together
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
    for _ in range(ROUNDS):
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
    triangle, intensity = _triangle(found, pairs, everything)
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

    Also where D is constant, for which `siq.identify.flow_regression.refit` does the same.
    """
    for _ in range(ROUNDS + 1):  # each brings the difference between the flow and a straight step up to date
        triangle, intensity = _triangle(found, pairs, found.support)
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

    As `siq.identify.residuals.mean_residual_probability`, which is for a constant D: an F test of the
    regression of the residuals on the library, here of all states at once and with the weights of D.
    """
    q, d, n = found.library.size, found.library.dimension, len(pairs.h)
    everything = np.array([(i, k) for i in range(d) for k in range(q)])
    triangle, _ = _triangle(found, pairs, everything, of_rest=True)
    explained = float((triangle[:-1, -1] ** 2).sum())
    left = float(triangle[-1, -1] ** 2)
    freedom = n * d - q * d
    ratio = (explained / (q * d)) / (left / freedom)
    return float(scipy.special.fdtrc(q * d, freedom, ratio))


def _triangle(
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
    for begin in range(0, len(pairs.h), CHUNK):
        part = slice(begin, begin + CHUNK)
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
