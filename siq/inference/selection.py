"""Selection of terms, their stability under resampling, and alternative models.

Backward elimination (`siq.inference.identification`) ends where no single term is superfluous. Where two
terms are nearly the same function on the recorded states, as x²y and x⁴y are about x² = 1, it may have
dropped the wrong one on its way and never looks back. Here supports are compared as wholes, by

    score = χ² + Σ c_k²,

χ² being that of the residuals and c_k the number of standard errors that the term k has to be from zero.
Terms are added, dropped and exchanged as long as that lowers the score. Of two terms that fit equally well
the one of the lower degree is taken: the probability of a false term is shared among the degrees k as 1/k!,
by which the coefficients of a Taylor series fall, and among the terms of a degree evenly.

A price for each term is too much for terms that are needed together: where the origin of a state is far from
its wells, a cubic is four monomials, none of which does much without the others. So a support is not taken
that all functions of some degree fit better than chance would let them (`lacks_terms`).

What other supports that do nearly as well make of f is told by `siq.inference.selection`.

Evidence judges a term by the noise that the model has. Resampled recordings judge it by how much they differ
from each other, whatever made them differ: a term that one recording alone asks for is in few of them.

The terms that `siq.inference.selection` chooses make a formula. To be chosen a term has to be so strong that
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

import heapq
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg
import scipy.special

from siq.inference.library import CandidateLibrary, total_degree
from siq.numerics.least_squares import triangle_of

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


DRAWS = 40  # numerical: a share of one half is known to 0.08
MOST_BLOCKS = 20  # numerical: what is drawn; more would be slower and tell nothing new
FEWEST_RECORDINGS = 4  # below that their parts are drawn instead
PARTS = 10  # of few recordings: each longer than what neighbouring samples remember, or nothing is learned


def blocks_of(recording: np.ndarray) -> np.ndarray:
    """The block of each row, shape ``(n,)``: whole recordings, or parts where there are few.

    Parameters
    ----------
    recording
        The place of the recording of each row, shape ``(n,)``; it never decreases.
    """
    _, place = np.unique(recording, return_inverse=True)
    if place.max(initial=0) + 1 < FEWEST_RECORDINGS:
        return np.arange(len(place)) * PARTS // max(len(place), 1)
    return np.asarray(place % MOST_BLOCKS)


def triangles(columns: np.ndarray, goals: np.ndarray, block: np.ndarray) -> tuple[np.ndarray, ...]:
    """R of the QR decomposition of each block of rows, on which every fit to it depends.

    Parameters
    ----------
    columns, goals
        What explains, shape ``(n, c)``, and what is to be explained, shape ``(n,)`` or ``(n, g)``.
    block
        Of each row, shape ``(n,)``.
    """
    return tuple(triangle_of(columns[block == one], goals[block == one]) for one in np.unique(block))


def stability(
    parts: Sequence[np.ndarray],
    equations_of: Callable[[np.ndarray], Sequence[Equation]],
    chosen: Sequence[Sequence[int]],
    *,
    generator: np.random.Generator,
) -> list[np.ndarray]:
    """Share of resampled recordings in which each chosen term is chosen again, by equation.

    Parameters
    ----------
    parts
        Triangles of the blocks, see `triangles`.
    equations_of
        The equations of a triangle of all of them.
    chosen
        The support of each equation, from which each search begins.
    generator
        Draws the blocks, with replacement.

    Returns
    -------
    list of numpy.ndarray
        For each equation an array like its support.
    """
    counts = [np.zeros(len(one)) for one in chosen]
    for _ in range(DRAWS):
        drawn = generator.integers(len(parts), size=len(parts))
        triangle = np.asarray(np.linalg.qr(np.concatenate([parts[place] for place in drawn]), mode="r"))
        for count, equation, support in zip(counts, equations_of(triangle), chosen, strict=True):
            count += np.isin(support, improved_support(equation, support))
    return [count / DRAWS for count in counts]


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
