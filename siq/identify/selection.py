"""Which terms of one equation do noisy pairs ask for, and which others would do nearly as well?

Backward elimination (`siq.identify.identification`) ends where no single term is superfluous. Where two terms
are nearly the same function on the recorded states, as x²y and x⁴y are about x² = 1, it may have dropped the
wrong one on its way and never looks back. Here supports are compared as wholes, by

    score = χ² + Σ c_k²,

χ² being that of the residuals and c_k the number of standard errors that the term k has to be from zero.
Terms are added, dropped and exchanged as long as that lowers the score. Of two terms that fit equally well
the one of the lower degree is taken: the probability of a false term is shared among the degrees k as 1/k!,
by which the coefficients of a Taylor series fall, and among the terms of a degree evenly.

A price for each term is too much for terms that are needed together: where the origin of a state is far from
its wells, a cubic is four monomials, none of which does much without the others. So a support is not taken
that all functions of some degree fit better than chance would let them (`lacks_terms`).

What other supports that do nearly as well make of f is told by `siq.identify.rival_terms`.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg
import scipy.special

from siq.identify.library import CandidateLibrary, total_degree

MOST_MOVES = 200  # numerical, a guard: each lowers the score
BREADTH = 50  # numerical: supports whose neighbours are looked at; twice as many find no better ones
SAME = 1e-10  # of a term's square: what is left of it beside the others is rounding
TOGETHER = 0.1  # of the probability of a false term: a second way to get one should hardly add to the first
FURTHER_DEGREE = 1  # of a function that the user named: it is no less likely than a state itself


def critical_values(library: CandidateLibrary, *, false_terms: float) -> np.ndarray:
    """How many standard errors each function has to be from zero, in any equation: shape ``(q,)``.

    Parameters
    ----------
    library
        The q functions of d states.
    false_terms
        Probability that noise alone brings any false term into f.
    """
    symbols = library.symbols
    degrees = np.array(
        [
            total_degree(library, place) if term.is_polynomial(*symbols) else FURTHER_DEGREE
            for place, term in enumerate(library.terms)
        ]
    )
    present, counts = np.unique(degrees, return_counts=True)
    shares = 1 / scipy.special.factorial(present)
    budget = false_terms * shares / shares.sum() / (counts * library.dimension)
    each = budget[np.searchsorted(present, degrees)]
    return np.asarray(-scipy.special.ndtri(each / 2))


@dataclass(frozen=True)
class Equation:
    """The regression of one component of f, through the triangle on which everything depends.

    Attributes
    ----------
    columns
        Of the q functions, shape ``(m, q)``.
    goal
        Of the velocities, shape ``(m,)``.
    variance
        Of a residual, as the fit of all functions leaves it.
    critical
        Shape ``(q,)``.
    """

    columns: np.ndarray
    goal: np.ndarray
    variance: float
    critical: np.ndarray

    @classmethod
    def of_triangle(
        cls, triangle: np.ndarray, component: int, *, samples: float, critical: np.ndarray
    ) -> Equation:
        """From the triangle ``(q + d, q + d)`` of the fit of all functions, of so many independent pairs."""
        q = len(critical)
        columns, goal = triangle[:, :q], triangle[:, q + component]
        left = triangle[q:, q + component]
        return cls(columns, goal, float(left @ left) / max(samples - q, 1.0), critical)

    def fitted(self, support: Sequence[int]) -> np.ndarray:
        """Coefficients on a support, shape ``(q,)``."""
        coefficients = np.zeros(self.columns.shape[1])
        if not len(support):
            return coefficients
        places = list(support)
        chosen = self.columns[:, places]
        scale = np.linalg.norm(chosen, axis=0)
        scale = np.where(scale > 0, scale, 1.0)
        coefficients[places] = np.linalg.lstsq(chosen / scale, self.goal, rcond=None)[0] / scale
        return coefficients

    def score(self, support: Sequence[int]) -> float:
        """χ² and the price of the terms."""
        return self.chi_square(support) + float((self.critical[list(support)] ** 2).sum())

    def chi_square(self, support: Sequence[int]) -> float:
        """Of the residuals."""
        misfit = self.goal - self.columns @ self.fitted(support)
        return float(misfit @ misfit / self.variance)

    def neighbours(self, support: Sequence[int]) -> Iterator[tuple[float, tuple[int, ...]]]:
        """Scores of all supports that one term more, one less, or another one makes of this one."""
        yield from self._with_one_more(support)
        for left_out in support:
            others = tuple(one for one in support if one != left_out)
            yield self.score(others), others
            yield from self._with_one_more(others, but=left_out)

    def _with_one_more(
        self, support: Sequence[int], *, but: int | None = None
    ) -> Iterator[tuple[float, tuple[int, ...]]]:
        columns, goal = self.columns, self.goal
        if len(support):
            orthogonal = np.linalg.qr(columns[:, list(support)])[0]
            columns = columns - orthogonal @ (orthogonal.T @ columns)
            goal = goal - orthogonal @ (orthogonal.T @ goal)
        squares = (columns**2).sum(axis=0)
        usable = squares > SAME * (self.columns**2).sum(axis=0)
        usable[list(support)] = False
        if but is not None:
            usable[but] = False
        gains = (columns[:, usable].T @ goal) ** 2 / squares[usable]
        scores = (goal @ goal - gains) / self.variance + self.critical[usable] ** 2
        price = float((self.critical[list(support)] ** 2).sum())
        for score, place in zip(scores + price, np.flatnonzero(usable), strict=True):
            yield float(score), tuple(sorted((*support, int(place))))


def strong_terms(equation: Equation, *, among: np.ndarray | None = None) -> tuple[int, ...]:
    """What is left when the weakest term leaves again and again, until all are significant.

    Parameters
    ----------
    equation
        Of q functions.
    among
        The functions that are begun with, shape ``(q,)``; by default all.
    """
    present = np.linalg.norm(equation.columns, axis=0) > 0
    active = np.flatnonzero(present if among is None else present & among)
    while len(active):
        chosen = equation.columns[:, active]
        size = np.linalg.norm(chosen, axis=0)
        orthogonal, upper = np.linalg.qr(chosen / size)
        coefficients = scipy.linalg.solve_triangular(upper, orthogonal.T @ equation.goal)
        errors = np.linalg.norm(scipy.linalg.solve_triangular(upper, np.eye(len(active))), axis=1)
        strength = np.abs(coefficients) / errors / np.sqrt(equation.variance) / equation.critical[active]
        weakest = int(np.argmin(strength))
        if strength[weakest] >= 1:
            break
        active = np.delete(active, weakest)
    return tuple(int(place) for place in active)


def best_support(equation: Equation) -> tuple[int, ...]:
    """The support of the lowest score that is found; an empty one only where nothing else is significant.

    Elimination from a rich library may leave many terms that make up together what a few of low degree would
    do, none of which it still has, and exchanges of single terms do not lead back. So it begins from every
    library of lower degree as well, and from nothing. From where these end the search goes on to neighbours
    of neighbours, as long as that leads to any of the `BREADTH` best.
    """
    ends = {improved_support(equation, ())}
    for most in np.unique(equation.critical):
        strong = strong_terms(equation, among=equation.critical <= most)
        ends |= {strong, improved_support(equation, strong)}
    scores = {one: equation.score(one) for one in ends}
    visited: set[tuple[int, ...]] = set()
    while waiting := [one for one in scores if one not in visited]:
        following = min(waiting, key=scores.__getitem__)
        visited.add(following)
        scores.update((other, score) for score, other in equation.neighbours(following))
        scores = {one: scores[one] for one in heapq.nsmallest(BREADTH, scores, key=scores.__getitem__)}
    ranked = sorted({*scores, *ends}, key=equation.score)
    best = next((one for one in ranked if not lacks_terms(equation, one)), ranked[0])
    return best or min((one for one in ends if one), key=equation.score, default=())


def lacks_terms(equation: Equation, support: Sequence[int]) -> bool:
    """Whether all functions of some degree fit better than chance would let them, once those are there.

    Chance may do so a tenth as often as it may bring in a false term, which the critical values say; the
    degrees share that.
    """
    levels = np.unique(equation.critical)
    chance = TOGETHER * 2 * scipy.special.ndtr(-equation.critical).sum() / len(levels)
    own = equation.chi_square(support)
    for most in levels:
        whole = np.union1d(np.flatnonzero(equation.critical <= most), np.array(support, dtype=int))
        further = len(whole) - len(support)
        gain = own - equation.chi_square(whole.tolist())
        if further and scipy.special.chdtrc(further, max(gain, 0.0)) < chance:
            return True
    return False


def improved_support(equation: Equation, start: Sequence[int]) -> tuple[int, ...]:
    """The support of the lowest score that exchanges of single terms reach from a start."""
    support = tuple(sorted(int(place) for place in start))
    score = equation.score(support)
    for _ in range(MOST_MOVES):
        best, following = min(equation.neighbours(support), default=(np.inf, support))
        if not best < score:
            break
        score, support = best, following
    return support


def weakest_term(strength: np.ndarray, support: np.ndarray) -> int | None:
    """The least significant coefficient that is not significant, nor the last of its equation; None of none.

    Parameters
    ----------
    strength
        Of each coefficient, shape ``(p,)``: below one it is not significant.
    support
        Component and term of each, shape ``(p, 2)``.
    """
    for place in np.argsort(strength):
        if strength[place] >= 1:
            return None
        if np.sum(support[:, 0] == support[place, 0]) > 1:
            return int(place)
    return None
