"""Products of two smooth functions, of one coordinate each.

What depends on two coordinates is often a product: a force that friction or a valve scales, a rate that food
and temperature both limit. A product has far fewer heights than a surface, and where each
coordinate has been, if not both at a time, it is known all the same.

Of ``f(x) g(y)`` a normal process of unit size is expected of f, and one of the size of the whole of g. Given
one of them everything is linear in the other, so that they are worked out in turn.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg
import sympy

from siq.dynamics.dynamics import JointExpectation
from siq.errors import NumericalFailure
from siq.mismatch.grounds import Ground
from siq.mismatch.smooth_functions import SURFACE, SmoothFunction, smooth_function

TURNS = 30  # at most, of working out one factor after the other
SETTLED = 1e-4  # of what is left, by which a turn has to be better


@dataclass(frozen=True)
class ProductFunction:
    """A product of two smooth functions, as two sums of bumps.

    Attributes
    ----------
    ground
        Where it stands, and of which two coordinates it is a function.
    first, second
        The factors.
    begin
        Heights to begin with, of both, shape ``(b,)``: where both are zero nothing points anywhere.
    """

    ground: Ground
    first: SmoothFunction
    second: SmoothFunction
    begin: np.ndarray

    @property
    def kind(self) -> str:
        """What it looks like."""
        return SURFACE

    @property
    def width(self) -> int:
        """The number of bumps."""
        return self.first.width + self.second.width

    @property
    def linear(self) -> int:
        """In how many of its heights, the first ones, it is linear if the others are given."""
        return self.first.width

    def along(self, heights: np.ndarray, courses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See `siq.mismatch.smooth_functions.SmoothFunction.along`."""
        one, other = self.first.values(courses[:1]), self.second.values(courses[1:])
        f, g = heights[: self.linear] @ one, heights[self.linear :] @ other
        return f * g, np.concatenate([one * g, other * f]).T

    def formula(self, heights: tuple[sympy.Expr, ...]) -> sympy.Expr:
        """The product, heights being symbols."""
        return self.first.formula(heights[: self.linear]) * self.second.formula(heights[self.linear :])

    def units(self, whole: str) -> tuple[str, ...]:
        """Of the heights: the first factor has none."""
        return ("1",) * self.linear + (whole,) * (self.width - self.linear)

    def expected(self, names: tuple[str, ...]) -> tuple[JointExpectation, ...]:
        """What is expected of the heights, by their names."""
        first, second = names[: self.linear], names[self.linear :]
        return (*self.first.expected(first), *self.second.expected(second))

    @property
    def limits(self) -> np.ndarray:
        """Where the recordings have been: lower and upper, shape ``(2, 2)``."""
        return np.concatenate([self.first.limits, self.second.limits], axis=1)


def product_of(
    ground: Ground,
    shares: tuple[float, ...],
    *,
    points: np.ndarray,
    gram: np.ndarray,
    overlap: np.ndarray,
    deviation: float,
    weight: float = 1.0,
) -> ProductFunction:
    """The likeliest product, whose lengths may be any of several.

    Parameters
    ----------
    ground
        Where it stands.
    shares
        Lengths to choose among, as shares of the coordinates' ranges.
    points
        Where the recordings tell a function's values, shape ``(z, 2)``.
    gram, overlap
        Of what these values do to the innovations, in units of noise, with each other and with the
        innovations: shapes ``(z, z)`` and ``(z,)``.
    deviation, weight
        The size that is expected of the product, and how often that counts against the data
        (`siq.dynamics.dynamics.JointExpectation`).
    """
    grounds = [
        Ground(ground.place, (ground.coordinates[side],), (ground.words[side],), ground.courses[side, None])
        for side in range(2)
    ]
    bases = []
    for side, own in enumerate(grounds):
        functions = [smooth_function(own, (share,), weight=weight) for share in shares]
        along = [(each.triangle, each.values(points[:, side, None].T)) for each in functions]
        independent = [scipy.linalg.solve_triangular(*each, lower=True) for each in along]
        bases.append(list(zip(functions, independent, strict=True)))
    highest, best = -np.inf, None
    for (one, first), (other, second) in itertools.product(*bases):
        evidence, f, g = _in_turns(first, deviation * second, gram, overlap)
        if evidence > highest:
            heights = [
                scipy.linalg.solve_triangular(function.triangle, values, lower=True, trans="T")
                for function, values in ((one, f), (other, deviation * g))
            ]
            sized = replace(other, deviation=deviation)
            highest, best = evidence, ProductFunction(ground, one, sized, np.concatenate(heights))
    if best is None:
        raise NumericalFailure("no product of two functions has an evidence that is a number")
    return best


def _in_turns(
    first: np.ndarray, second: np.ndarray, gram: np.ndarray, overlap: np.ndarray
) -> tuple[float, np.ndarray, np.ndarray]:
    """Evidence and independent coefficients of two factors, given what each has at points ``(b, z)``.

    The evidence is averaged over all that the factors could be (Laplace's approximation).
    """
    g = np.linalg.lstsq(second.T, np.full(second.shape[1], np.sqrt((second**2).sum(axis=0).mean())))[0]
    f, before = np.zeros(len(first)), np.inf
    for _ in range(TURNS):
        f, _ = _given(first * (g @ second), gram, overlap)
        g, left = _given(second * (f @ first), gram, overlap)
        left += float(f @ f)
        if before - left < SETTLED * abs(left):
            break
        before = left
    both = np.concatenate([first * (g @ second), second * (f @ first)])
    told = np.linalg.eigvalsh(both @ gram @ both.T)
    return -0.5 * left - 0.5 * float(np.log1p(np.maximum(told, 0.0)).sum()), f, g


def _given(basis: np.ndarray, gram: np.ndarray, overlap: np.ndarray) -> tuple[np.ndarray, float]:
    """Normal coefficients of a basis ``(b, z)``, and what they leave of squares, over that of none."""
    inner, target = basis @ gram @ basis.T + np.eye(len(basis)), basis @ overlap
    found = scipy.linalg.solve(inner, target, assume_a="pos")
    return found, -float(found @ target)
