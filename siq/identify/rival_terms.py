"""Which other terms would do nearly as well, and what do they make of f?

The terms that `siq.identify.selection` chooses make a formula. To be chosen a term has to be so strong that
noise hardly brings it, and one that is there and a little weaker is left out: whatever follows from the
formula is then off by more than its error. So what follows from f is a mean over supports. Each has the odds

    exp(-(χ² + Σ κ_k)/2),

χ² being that of its residuals and κ_k the price of the term k. The prices are those of an observer who holds
one further term as likely as not, among low degrees rather than among high ones: of a term that is not there
and not significant, the odds ``exp(-(κ - z²)/2)`` have the mean ``√(2/π) c exp(-κ/2)``, c being the number of
standard errors that make it significant, and the prices make these means add up to one.

A first-order shift and a spread are all that is kept of the mean: the formula stays short.

References
----------
J. A. Hoeting et al., Bayesian model averaging: a tutorial, Statistical Science 14 (1999) 382, eqs. (1)-(4).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.special

from siq.identify.selection import Equation, improved_support

LEAST_ODDS = 0.01  # numerical: supports less likely than this share of the best are not followed
MOST_FOLLOWED = 400  # numerical, a guard: supports whose neighbours are looked at
NEGLIGIBLE = 1e-6  # of the largest variance, in units in which all functions have one size


@dataclass(frozen=True)
class RivalTerms:
    """What the mean over supports adds to the f of the chosen one.

    Attributes
    ----------
    mean_change
        By how much f changes in the mean, shape ``(q, d)``.
    spread
        Changes whose outer products add up to the covariance about that mean, less the covariance of the
        coefficients of the chosen support: shape ``(r, q, d)``.
    """

    mean_change: np.ndarray
    spread: np.ndarray

    def drawn(self, count: int, *, generator: np.random.Generator) -> np.ndarray:
        """Changes of f beside those of its own coefficients, shape ``(count, q, d)``."""
        draws = generator.standard_normal((count, len(self.spread)))
        return np.asarray(self.mean_change + np.tensordot(draws, self.spread, axes=1))


def rivals_by_equation(equations: Sequence[Equation], support: np.ndarray) -> RivalTerms:
    """The mean over supports, equation by equation.

    Parameters
    ----------
    equations
        One for each component of f.
    support
        Component and term of each coefficient, shape ``(p, 2)``.
    """
    functions, count = equations[0].columns.shape[1], len(equations)
    mean = np.zeros((functions, count))
    spread = []
    for i, equation in enumerate(equations):
        own = support[support[:, 0] == i, 1].tolist()
        mean[:, i], changes = mean_over_supports(equation, own, further=1 / count)
        spread.append(np.zeros((*changes.shape, count)))
        spread[-1][:, :, i] = changes
    return RivalTerms(mean, np.concatenate(spread))


def rivals_of_all(together: Equation, support: np.ndarray, *, dimension: int) -> RivalTerms:
    """The same where all components are one problem, its columns one component after the other."""
    functions = together.columns.shape[1] // dimension
    own = (support[:, 0] * functions + support[:, 1]).tolist()
    mean, changes = mean_over_supports(together, own, further=1.0)
    return RivalTerms(
        mean.reshape(dimension, functions).T, changes.reshape(-1, dimension, functions).transpose(0, 2, 1)
    )


def prices(critical: np.ndarray, *, further: float) -> np.ndarray:
    """κ of each term, see the module: shape ``(q,)``.

    Parameters
    ----------
    critical
        Number of standard errors that make a term significant, shape ``(q,)``.
    further
        How many terms more there are, in the mean.
    """
    chance = scipy.special.ndtr(-critical)
    expected = further * chance / chance.sum()
    return np.asarray(np.maximum(2 * np.log(np.sqrt(2 / np.pi) * critical / expected), 0.0))


def mean_over_supports(
    equation: Equation, support: Sequence[int], *, further: float
) -> tuple[np.ndarray, np.ndarray]:
    """Mean change ``(q,)`` and spread ``(r, q)`` of the coefficients of an equation; see `RivalTerms`.

    Parameters
    ----------
    equation
        Its regression.
    support
        The terms that were chosen.
    further
        How many terms more there are, in the mean.
    """
    priced = replace(equation, critical=np.sqrt(prices(equation.critical, further=further)))
    size = np.linalg.norm(equation.columns, axis=0)
    size = np.where(size > 0, size, 1.0)
    chosen = equation.fitted(support)
    odds = likely_supports(priced, support)
    weights = np.array(list(odds.values()))
    weights /= weights.sum()
    changes = np.array([equation.fitted(one) - chosen for one in odds])
    mean = weights @ changes
    apart = (changes - mean) * size
    total = (apart * weights[:, None]).T @ apart - _covariance(equation, support, size)
    for weight, one in zip(weights, odds, strict=True):
        total += weight * _covariance(equation, one, size)
    values, vectors = np.linalg.eigh(total)
    kept = values > NEGLIGIBLE * max(values[-1], 0.0)
    return mean, np.asarray((vectors[:, kept] * np.sqrt(values[kept])).T / size)


def likely_supports(equation: Equation, start: Sequence[int]) -> dict[tuple[int, ...], float]:
    """Supports with their odds against the likeliest, as far as exchanges of single terms lead to them."""
    best = improved_support(equation, start)
    scores = {best: equation.score(best)}
    followed: set[tuple[int, ...]] = set()
    reach = -2 * np.log(LEAST_ODDS)
    while len(followed) < MOST_FOLLOWED:
        limit = min(scores.values()) + reach
        open_ended = [one for one, score in scores.items() if score < limit and one not in followed]
        if not open_ended:
            break
        nearest = min(open_ended, key=lambda one: scores[one])
        followed.add(nearest)
        for score, one in equation.neighbours(nearest):
            if score < limit:
                scores.setdefault(one, score)
    lowest = min(scores.values())
    odds = {one: float(np.exp(-(score - lowest) / 2)) for one, score in scores.items()}
    return {one: share for one, share in odds.items() if share > LEAST_ODDS}


def _covariance(equation: Equation, support: Sequence[int], size: np.ndarray) -> np.ndarray:
    """Of the coefficients on a support times the sizes of their functions, shape ``(q, q)``."""
    places = list(support)
    whole = np.zeros((len(size), len(size)))
    if places:
        inverse = np.linalg.pinv(equation.columns[:, places] / size[places])
        whole[np.ix_(places, places)] = equation.variance * inverse @ inverse.T
    return whole
