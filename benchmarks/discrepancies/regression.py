"""Which terms of a library explain what a card leaves over? Sequentially thresholded least squares.

What other values of the card's own free parameters can do is no discrepancy: their columns take part in every
fit without a penalty, by being projected out of the target and of the library. The threshold is the largest
whose errors on parts left out are within one standard error of the least ones.
"""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.stats

DEGREE = 3
THRESHOLDS = np.geomspace(1.0, 0.01, 10)  # of a term's size in that of the target
SURE = 2.0  # standard errors by which parts left out must be foreseen better than by the card
HARDLY = 1.0  # the same for one threshold against the best
DEPENDENT = 1e-4  # share of a column that parameters cannot do, below which it is theirs
FEWEST = 4  # blocks, from which on an improvement has a standard error


def powers(coordinates: int, degree: int = DEGREE) -> np.ndarray:
    """Exponents of all products of so many coordinates up to a degree, shape ``(L, coordinates)``."""
    chosen = (
        each
        for total in range(degree + 1)
        for each in itertools.combinations_with_replacement(range(coordinates), total)
    )
    return np.array([np.bincount(each, minlength=coordinates) for each in chosen], dtype=int)


@dataclass(frozen=True)
class Equation:
    """What is left of one equation, and what may explain it.

    Attributes
    ----------
    state
        Place of the equation.
    left
        Derivatives less what the card says, shape ``(n,)``.
    parameters
        Slopes of what the card says by its free parameters, shape ``(n, p)``.
    library
        Shape ``(n, L)``.
    block, fold
        As those of `SeenStates`, shape ``(n,)``.
    """

    state: int
    left: np.ndarray
    parameters: np.ndarray
    library: np.ndarray
    block: np.ndarray
    fold: np.ndarray


@dataclass(frozen=True)
class Found:
    """What regression says of one equation.

    Attributes
    ----------
    support
        Chosen terms, shape ``(L,)``.
    contributions
        Their size, root mean square, shape ``(L,)``.
    evidence
        By how many standard errors parts left out are foreseen better than by the card with other parameters.
    noise
        Deviation of what remains.
    """

    support: np.ndarray
    contributions: np.ndarray
    evidence: float
    noise: float

    @property
    def detected(self) -> bool:
        """Whether there is something beyond the card."""
        return self.evidence > SURE and bool(self.support.any())


def chosen_terms(equation: Equation) -> Found:
    """Choose terms for one equation by sequentially thresholded least squares and parts left out."""
    squares = np.full((len(THRESHOLDS) + 1, len(equation.left)), np.nan)
    for fold in np.unique(equation.fold):
        out = equation.fold == fold
        if out.all():
            continue
        for place, threshold in enumerate((np.inf, *THRESHOLDS)):
            coefficients, slopes = fitted(equation, ~out, threshold)
            remains = equation.left - equation.library @ coefficients - equation.parameters @ slopes
            squares[place, out] = remains[out] ** 2
    means = block_means(squares, equation.block)
    best = int(means.mean(axis=1).argmin())
    chosen = best
    for place in range(best):  # the sparsest that is hardly worse than the best
        if sureness(means[place], means[best]) <= HARDLY:
            chosen = place
            break
    everything = np.ones(len(equation.left), dtype=bool)
    threshold = (np.inf, *THRESHOLDS)[chosen]
    coefficients, slopes = fitted(equation, everything, threshold)
    remains = equation.left - equation.library @ coefficients - equation.parameters @ slopes
    return Found(
        coefficients != 0,
        np.abs(coefficients) * np.sqrt(np.mean(equation.library**2, axis=0)),
        sureness(means[0], means[chosen]),
        float(np.std(remains)) or 1e-300,
    )


def block_means(squares: np.ndarray, block: np.ndarray) -> np.ndarray:
    """Means ``(…, blocks)`` of squared errors ``(…, n)`` over blocks of neighbours."""
    return np.stack([squares[..., block == one].mean(axis=-1) for one in np.unique(block)], axis=-1)


def sureness(first: np.ndarray, second: np.ndarray) -> float:
    """How surely the one of two errors exceeds the other, in standard errors: Wilcoxon's signed-rank test.

    Ranks, since a few blocks of large motion may have nearly all of the gain: the standard error of the mean
    gain would then be as large as the gain.

    Parameters
    ----------
    first, second
        Mean squared errors of blocks, shape ``(blocks,)``.
    """
    gain = first - second
    if len(gain) < FEWEST or not gain.any() or not np.isfinite(gain).all():
        return 0.0
    chance = scipy.stats.wilcoxon(gain, alternative="greater", method="asymptotic").pvalue
    return float(scipy.stats.norm.isf(chance))


def fitted(equation: Equation, rows: np.ndarray, threshold: float) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients ``(L,)`` of the library and changes ``(p,)`` of parameters, told by some rows."""
    from pysindy import STLSQ

    left, parameters, library = equation.left[rows], equation.parameters[rows], equation.library[rows]
    coefficients = np.zeros(library.shape[1])
    if np.isfinite(threshold):
        basis = orthonormal(parameters)
        beyond, target = library - basis @ (basis.T @ library), left - basis @ (basis.T @ left)
        size, scale = _rms(beyond), float(_rms(target[:, None])[0])
        free = np.flatnonzero(size > DEPENDENT * np.maximum(_rms(library), 1e-300))
        if len(free) and scale > 0:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # that no term is left is an answer
                found = STLSQ(threshold=threshold, alpha=1e-3).fit(
                    beyond[:, free] / size[free], target / scale
                )
            coefficients[free] = found.coef_.ravel() * scale / size[free]
    slopes = least_squares(parameters, left - library @ coefficients)
    return coefficients, slopes


def joint(equations: Sequence[Equation], found: Sequence[Found]) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients ``(equations, L)`` of chosen terms, and changes ``(p,)`` of parameters, of all equations.

    Parameters are shared by equations; each is weighed by what remains of it.
    """
    terms = [(k, term) for k, one in enumerate(found) if one.detected for term in np.flatnonzero(one.support)]
    p = equations[0].parameters.shape[1]
    blocks, targets = [], []
    for k, (equation, one) in enumerate(zip(equations, found, strict=True)):
        columns = np.zeros((len(equation.left), p + len(terms)))
        columns[:, :p] = equation.parameters
        for place, (where, term) in enumerate(terms):
            if where == k:
                columns[:, p + place] = equation.library[:, term]
        blocks.append(columns / one.noise)
        targets.append(equation.left / one.noise)
    solution = least_squares(np.concatenate(blocks), np.concatenate(targets))
    coefficients = np.zeros((len(equations), equations[0].library.shape[1]))
    for place, (where, term) in enumerate(terms):
        coefficients[where, term] = solution[p + place]
    return coefficients, solution[:p]


def least_squares(columns: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Least squares of columns that are scaled alike, so that faint ones count."""
    size = np.linalg.norm(columns, axis=0)
    kept = size > 0
    solution = np.zeros(columns.shape[1])
    if kept.any():
        solution[kept] = np.linalg.lstsq(columns[:, kept] / size[kept], target, rcond=1e-10)[0] / size[kept]
    return solution


def orthonormal(columns: np.ndarray) -> np.ndarray:
    """An orthonormal basis of the span of some columns."""
    size = np.linalg.norm(columns, axis=0)
    kept = columns[:, size > 0] / size[size > 0]
    if not kept.shape[1]:
        return np.zeros((len(columns), 0))
    left, values, _ = np.linalg.svd(kept, full_matrices=False)
    return left[:, values > 1e-9 * values[0]]


def _rms(columns: np.ndarray) -> np.ndarray:
    return np.sqrt(np.mean(columns**2, axis=0))
