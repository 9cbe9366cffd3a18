"""Sparse least squares of f: a linear problem, selection of its terms, stability, and model averaging.

Backward elimination may drop the wrong one of two terms that are nearly the same function on the recorded
states, as x²y and x⁴y are about x² = 1. Here supports are compared as wholes, by

    score = χ² + Σ c_k²,

χ² being that of the residuals and c_k the number of standard errors that the term k has to be from zero.
Terms are added, dropped and exchanged as long as that lowers the score. Of two terms that fit equally well
the one of the lower degree is taken: the probability of a false term is shared among the degrees k as 1/k!,
by which the coefficients of a Taylor series fall, and among the terms of a degree evenly. Terms may be needed
together: where the origin of a state is far from its wells, a cubic is four monomials, none of which does
much without the others. So a support is not taken that all functions of some degree fit better than chance
would let them.

To be chosen a term has to be so strong that noise hardly brings it, and one that is there and a little weaker
is left out: whatever follows from the formula is then off by more than its error. So what follows from f is a
mean over supports (Hoeting et al., eqs. 1-4) with the odds ``exp(-(χ² + Σ κ_k)/2)``. The prices κ_k are those
of an observer who holds one further term as likely as not, among low degrees rather than among high ones: of
a term that is not there and not significant, the odds ``exp(-(κ - z²)/2)`` have the mean
``√(2/π) c exp(-κ/2)``, and the prices make these means add up to one. A first-order shift and a spread are
all that is kept of the mean: the formula stays short.

The score judges a term by the noise that the model has. Resampled recordings judge it by how much they differ
from each other, whatever made them differ: a term that one recording alone asks for is in few of them.

References
----------
J. A. Hoeting et al., Bayesian model averaging: a tutorial, Statistical Science 14 (1999) 382.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
import scipy.linalg
import scipy.special

from siq.errors import NumericalFailure
from siq.inference.library import CandidateLibrary
from siq.numerics.randomness import positive

Result = TypeVar("Result")

MAX_MOVES = 200  # numerical, a guard: each lowers the score
SEARCH_BREADTH = 50  # numerical: supports whose neighbours are looked at; twice as many find no better ones
COLLINEARITY_TOLERANCE = 1e-10  # of a term's square: what the others leave of it is rounding
JOINT_TERMS_SHARE = 0.1  # of the probability of a false term: a second way to get one should hardly add
FURTHER_DEGREE = 1  # of a function that the user named: it is no less likely than a state itself
DRAWS = 40  # numerical: a share of one half is known to 0.08
MAX_BLOCKS = 20  # numerical: what is drawn; more would be slower and tell nothing new
MIN_RECORDINGS = 4  # below that their parts are drawn instead
PARTS = 10  # of few recordings: each longer than what neighbouring samples remember, or nothing is learned
MIN_ODDS = 0.01  # numerical: supports less likely than this share of the best are not followed
MAX_FOLLOWED = 400  # numerical, a guard: supports whose neighbours are looked at
NEGLIGIBLE_VARIANCE = 1e-6  # of the largest, in units in which all functions have one size


def critical_values(library: CandidateLibrary, *, false_terms: float) -> np.ndarray:
    """Number of standard errors that each function has to be from zero, in any equation: shape ``(q,)``.

    Then noise alone brings any false term into f with the probability `false_terms`.
    """
    powers = [term.is_polynomial(*library.symbols) for term in library.terms]
    degrees = np.array([library.total_degree(k) if one else FURTHER_DEGREE for k, one in enumerate(powers)])
    present, counts = np.unique(degrees, return_counts=True)
    shares = 1 / scipy.special.factorial(present)
    budget = false_terms * shares / shares.sum() / (counts * library.dimension)
    return np.asarray(-scipy.special.ndtri(budget[np.searchsorted(present, degrees)] / 2))


@dataclass(frozen=True)
class LinearProblem:
    """A linear least-squares problem of coefficients of f, by the triangle on which everything depends."""

    #: Of the q coefficients, shape ``(m, q)``; what they explain, shape ``(m,)``; and that of a residual.
    columns: np.ndarray
    goal: np.ndarray
    variance: float
    #: Standard errors that each coefficient has to be from zero, shape ``(q,)``; and its component of f and
    #: function, shape ``(q, 2)``.
    critical: np.ndarray
    labels: np.ndarray

    @classmethod
    def of_components(
        cls, triangle: np.ndarray, *, samples: float, critical: np.ndarray
    ) -> list[LinearProblem]:
        """One for each component of f, from the triangle ``(q + d, q + d)`` of the fit of all functions.

        The variance of a residual is that of this fit to so many independent samples.
        """
        q = len(critical)
        variances = (triangle[q:, q:] ** 2).sum(axis=0) / max(samples - q, 1.0)
        return [
            cls(triangle[:, :q], triangle[:, q + i], float(variance), critical, all_coefficients([i], q))
            for i, variance in enumerate(variances)
        ]

    def solve(self, support: Sequence[int]) -> np.ndarray:
        """Coefficients on a support, shape ``(q,)``."""
        coefficients, places = np.zeros(self.columns.shape[1]), list(support)
        if places:
            chosen = self.columns[:, places]
            scale = positive(np.linalg.norm(chosen, axis=0))
            coefficients[places] = np.linalg.lstsq(chosen / scale, self.goal, rcond=None)[0] / scale
        return coefficients

    def places(self, support: np.ndarray) -> list[int]:
        """Places of the columns of a support ``(p, 2)``, those that the problem has."""
        known = {tuple(label): place for place, label in enumerate(self.labels.tolist())}
        return [known[label] for label in map(tuple, support.tolist()) if label in known]

    def chi_square(self, support: Sequence[int]) -> float:
        """Of the residuals."""
        misfit = self.goal - self.columns @ self.solve(support)
        return float(misfit @ misfit / self.variance)

    def score(self, support: Sequence[int]) -> float:
        """χ² and the price of the terms."""
        return self.chi_square(support) + float((self.critical[list(support)] ** 2).sum())

    def neighbours(self, support: Sequence[int]) -> Iterator[tuple[float, tuple[int, ...]]]:
        """Scores of all supports that one term more, one less, or another one makes of this one."""
        yield from self._with_one_more(support)
        for dropped in support:
            others = tuple(one for one in support if one != dropped)
            yield self.score(others), others
            yield from self._with_one_more(others, without=dropped)

    def _with_one_more(
        self, support: Sequence[int], *, without: int | None = None
    ) -> Iterator[tuple[float, tuple[int, ...]]]:
        columns, goal = self.columns, self.goal
        if len(support):
            orthogonal = np.linalg.qr(columns[:, list(support)])[0]
            columns = columns - orthogonal @ (orthogonal.T @ columns)
            goal = goal - orthogonal @ (orthogonal.T @ goal)
        squares = (columns**2).sum(axis=0)
        usable = squares > COLLINEARITY_TOLERANCE * (self.columns**2).sum(axis=0)
        usable[list(support)] = False
        if without is not None:
            usable[without] = False
        gains = (columns[:, usable].T @ goal) ** 2 / squares[usable]
        scores = (goal @ goal - gains) / self.variance + self.critical[usable] ** 2
        price = float((self.critical[list(support)] ** 2).sum())
        for score, place in zip(scores + price, np.flatnonzero(usable), strict=True):
            yield float(score), tuple(sorted((*support, int(place))))

    def _covariance(self, support: Sequence[int], size: np.ndarray) -> np.ndarray:
        """Of the coefficients on a support times the sizes of their functions, shape ``(q, q)``."""
        places = list(support)
        whole = np.zeros((len(size), len(size)))
        if places:
            inverse = np.linalg.pinv(self.columns[:, places] / size[places])
            whole[np.ix_(places, places)] = self.variance * inverse @ inverse.T
        return whole


def all_coefficients(components: Sequence[int], functions: int) -> np.ndarray:
    """Component and function of all coefficients of some components, one component after the other."""
    return np.array([(i, k) for i in components for k in range(functions)])


def strong_terms(
    problem: LinearProblem, *, among: np.ndarray | None = None, precision: float | None = None
) -> tuple[int, ...]:
    """Backward elimination from all functions, or from some of them, shape ``(q,)``.

    The weakest leaves, by its standard error, until all count; without noise, by the share of the goal that
    it makes, until all make as much as the precision.
    """
    present = np.linalg.norm(problem.columns, axis=0) > 0
    active = np.flatnonzero(present if among is None else present & among)
    while len(active):
        chosen = problem.columns[:, active]
        orthogonal, upper = np.linalg.qr(chosen / np.linalg.norm(chosen, axis=0))
        strength = np.abs(scipy.linalg.solve_triangular(upper, orthogonal.T @ problem.goal))
        if precision is None:
            errors = np.linalg.norm(scipy.linalg.solve_triangular(upper, np.eye(len(active))), axis=1)
            strength = strength / errors / np.sqrt(problem.variance) / problem.critical[active]
        else:
            strength = strength / (np.linalg.norm(problem.goal) or 1.0) / precision
        weakest = int(np.argmin(strength))
        if strength[weakest] >= 1:
            break
        active = np.delete(active, weakest)
    return tuple(int(place) for place in active)


def best_support(problem: LinearProblem) -> tuple[int, ...]:
    """The support of the lowest score that is found; an empty one only where nothing else is significant.

    It begins by elimination from the libraries of every degree, since that of a rich one may leave many terms
    for a few of low degree, and from nothing. From where these end the search goes on to neighbours of
    neighbours, as long as that leads to any of the `SEARCH_BREADTH` best.
    """
    ends = {_improved_support(problem, ())}
    for most in np.unique(problem.critical):
        strong = strong_terms(problem, among=problem.critical <= most)
        ends |= {strong, _improved_support(problem, strong)}
    scores = {one: problem.score(one) for one in ends}
    visited: set[tuple[int, ...]] = set()
    while waiting := [one for one in scores if one not in visited]:
        following = min(waiting, key=scores.__getitem__)
        visited.add(following)
        scores.update((other, score) for score, other in problem.neighbours(following))
        scores = {one: scores[one] for one in heapq.nsmallest(SEARCH_BREADTH, scores, key=scores.__getitem__)}
    ranked = sorted({*scores, *ends}, key=problem.score)
    best = next((one for one in ranked if not _lacks_terms(problem, one)), ranked[0])
    return best or min((one for one in ends if one), key=problem.score, default=())


def chosen_terms(
    problems: Sequence[LinearProblem], library: CandidateLibrary,
    choose: Callable[[LinearProblem], Sequence[int]] = best_support, *, reason: str = "; record longer",
) -> np.ndarray:  # fmt: skip
    """The support ``(p, 2)`` of independent problems; a NumericalFailure where an equation has no term."""
    chosen = np.concatenate([problem.labels[list(choose(problem))] for problem in problems])
    for component in np.unique(np.concatenate([problem.labels[:, 0] for problem in problems])):
        if component not in chosen[:, 0]:
            name = library.states[component]
            raise NumericalFailure(f"no term of the equation of {name} is significant{reason}")
    return chosen


def _lacks_terms(problem: LinearProblem, support: Sequence[int]) -> bool:
    """Whether all functions of some degree fit better than chance would let them, once those are there."""
    # Chance may do so a tenth as often as it may bring in a false term; the degrees share that.
    levels = np.unique(problem.critical)
    chance = JOINT_TERMS_SHARE * 2 * scipy.special.ndtr(-problem.critical).sum() / len(levels)
    own = problem.chi_square(support)
    for most in levels:
        whole = np.union1d(np.flatnonzero(problem.critical <= most), np.array(support, dtype=int))
        further = len(whole) - len(support)
        gain = own - problem.chi_square(whole.tolist())
        if further and scipy.special.chdtrc(further, max(gain, 0.0)) < chance:
            return True
    return False


def _improved_support(problem: LinearProblem, start: Sequence[int]) -> tuple[int, ...]:
    """The support of the lowest score that exchanges of single terms reach from a start."""
    support = tuple(sorted(int(place) for place in start))
    score = problem.score(support)
    for _ in range(MAX_MOVES):
        best, following = min(problem.neighbours(support), default=(np.inf, support))
        if not best < score:
            break
        score, support = best, following
    return support


def fit_significant(
    fit: Callable[[np.ndarray], tuple[Result, np.ndarray]], support: np.ndarray
) -> tuple[Result, np.ndarray]:
    """Fit a support ``(p, 2)``, and again without its weakest term, until all terms are significant.

    A fit leads to what was fitted, and the strength of each coefficient: below one it is not significant. The
    last term of an equation stays. What remains of the support is given back with the fit.
    """
    while True:
        fitted, strength = fit(support)
        several = (support[:, :1] == support[:, 0]).sum(axis=0) > 1
        weak = [place for place in np.argsort(strength) if strength[place] < 1 and several[place]]
        if not weak:
            return fitted, support
        support = np.delete(support, weak[0], axis=0)


def blocks_of(recording: np.ndarray) -> np.ndarray:
    """The block of each row ``(n,)``: whole recordings, whose places never decrease; parts of a few."""
    _, place = np.unique(recording, return_inverse=True)
    if place.max(initial=0) + 1 < MIN_RECORDINGS:
        return np.arange(len(place)) * PARTS // max(len(place), 1)
    return np.asarray(place % MAX_BLOCKS)


def triangles(columns: np.ndarray, goals: np.ndarray, block: np.ndarray) -> tuple[np.ndarray, ...]:
    """R of the QR decomposition of each block of rows, see `triangle_of`."""
    return tuple(triangle_of(columns[block == one], goals[block == one]) for one in np.unique(block))


def stability(
    parts: Sequence[np.ndarray], problems_of: Callable[[np.ndarray], Sequence[LinearProblem]],
    support: np.ndarray, *, generator: np.random.Generator,
) -> np.ndarray:  # fmt: skip
    """Share of resampled recordings in which each term of a support ``(p, 2)`` is chosen again: ``(p,)``.

    Blocks, of which the triangles are known (`triangles`), are drawn with replacement; the search in the
    problems of the triangle of all of them begins from the support.
    """
    counts = np.zeros(len(support))
    for _ in range(DRAWS):
        drawn = generator.integers(len(parts), size=len(parts))
        triangle = np.asarray(np.linalg.qr(np.concatenate([parts[place] for place in drawn]), mode="r"))
        for problem in problems_of(triangle):
            again = problem.labels[list(_improved_support(problem, problem.places(support)))]
            counts += (support[:, None] == again).all(axis=2).any(axis=1)
    return counts / DRAWS


def model_average(
    problems: Sequence[LinearProblem], support: np.ndarray, library: CandidateLibrary
) -> tuple[np.ndarray, np.ndarray]:
    """Bias and spread that the mean over supports of independent problems adds to the f of the chosen one.

    By how much f changes in the mean, shape ``(q, d)``; and changes whose outer products add up to the
    covariance about that mean, less that of the coefficients of the chosen support: ``(r, q, d)``. A constant
    costs nothing, since exact symmetry is the exception.
    """
    bias, spread = np.zeros((library.size, library.dimension)), []
    for problem in problems:
        i, k = problem.labels.T
        free = np.array([library.terms[place] == 1 for place in k])
        own, further = problem.places(support), 1 / len(problems)
        bias[k, i], changes = _mean_over_supports(problem, own, further=further, free=free)
        spread.append(np.zeros((len(changes), *bias.shape)))
        spread[-1][:, k, i] = changes
    return bias, np.concatenate(spread)


def _prices(critical: np.ndarray, *, further: float) -> np.ndarray:
    """κ of each term, shape ``(q,)``, where there are so many terms more in the mean."""
    chance = scipy.special.ndtr(-critical)
    expected = further * chance / chance.sum()
    return np.asarray(np.maximum(2 * np.log(np.sqrt(2 / np.pi) * critical / expected), 0.0))


def _mean_over_supports(
    problem: LinearProblem, support: Sequence[int], *, further: float, free: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Mean change ``(q,)`` and spread ``(r, q)`` of the coefficients about those of a chosen support.

    Supports count with their odds, as far as exchanges of single terms lead from the chosen one; terms that
    are `free`, shape ``(q,)``, have no price.
    """
    prices = np.where(free, 0.0, _prices(problem.critical, further=further))
    priced = replace(problem, critical=np.sqrt(prices))
    best = _improved_support(priced, support)
    scores = {best: priced.score(best)}
    followed: set[tuple[int, ...]] = set()
    while len(followed) < MAX_FOLLOWED:
        limit = min(scores.values()) - 2 * np.log(MIN_ODDS)
        open_ended = [one for one, score in scores.items() if score < limit and one not in followed]
        if not open_ended:
            break
        nearest = min(open_ended, key=scores.__getitem__)
        followed.add(nearest)
        for score, one in priced.neighbours(nearest):
            if score < limit:
                scores.setdefault(one, score)
    size, lowest = positive(np.linalg.norm(problem.columns, axis=0)), min(scores.values())
    odds = {one: float(np.exp(-(score - lowest) / 2)) for one, score in scores.items()}
    odds = {one: share for one, share in odds.items() if share > MIN_ODDS}
    weights = np.array(list(odds.values()))
    weights /= weights.sum()
    changes = np.array([problem.solve(one) for one in odds]) - problem.solve(support)
    mean = weights @ changes
    apart = (changes - mean) * size
    total = (apart * weights[:, None]).T @ apart - problem._covariance(support, size)
    for weight, one in zip(weights, odds, strict=True):
        total += weight * problem._covariance(one, size)
    values, vectors = np.linalg.eigh(total)
    kept = values > NEGLIGIBLE_VARIANCE * max(values[-1], 0.0)
    return mean, np.asarray((vectors[:, kept] * np.sqrt(values[kept])).T / size)


ROWS_AT_ONCE = 1 << 14  # numerical: worked on together, so that no second copy of all rows is in memory


def triangle_of(columns: np.ndarray, goals: np.ndarray) -> np.ndarray:
    """R of the QR decomposition of columns ``(n, c)`` with their goals ``(n,)`` or ``(n, g)`` behind them.

    Shape ``(c + g, c + g)``, or ``(n, c + g)`` of fewer rows.
    """
    goals = goals.reshape(len(goals), -1)
    rows = max(ROWS_AT_ONCE, 8 * (columns.shape[1] + goals.shape[1]))
    parts = [slice(begin, begin + rows) for begin in range(0, max(len(goals), 1), rows)]
    return stacked_triangle(np.concatenate([columns[part], goals[part]], axis=1) for part in parts)


def stacked_triangle(blocks: Iterable[np.ndarray]) -> np.ndarray:
    """R of the QR decomposition of blocks of rows ``(n, c)``, at least one, below each other."""
    found: np.ndarray | None = None
    for block in blocks:
        found = np.asarray(np.linalg.qr(block if found is None else np.concatenate([found, block]), mode="r"))
    assert found is not None
    return found
