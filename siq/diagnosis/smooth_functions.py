"""Smooth functions of one or two coordinates as normal processes.

A smooth function could be anything. All that is expected of it is that its values are alike where its
coordinates are, and know nothing of each other far apart: a normal process with the covariance
``s² exp(-½ Σ ((z_i - z'_i)/ℓ_i)²)`` (Rasmussen and Williams, Gaussian Processes for Machine Learning, MIT
Press 2006). It is written as a sum of Gaussian bumps as wide as the lengths ℓ, which stand closely where the
recordings have been; what is expected of their heights is what makes the sum such a process there
(Quiñonero-Candela and Rasmussen, J. Mach. Learn. Res. 6, 1939 (2005)). A length or so beyond, the function
goes to zero.

Lengths and size are taken from the recordings (`siq.diagnosis.unnamed_models`).

What depends on two coordinates is often a product: a force that friction or a valve scales, a rate that food
and temperature both limit. A product has far fewer heights than a surface, and where each
coordinate has been, if not both at a time, it is known all the same.

Of ``f(x) g(y)`` a normal process of unit size is expected of f, and one of the size of the whole of g. Given
one of them everything is linear in the other, so that they are worked out in turn.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np
import scipy.linalg
import sympy

from siq.diagnosis.function_sites import Ground, built, fresh_names, unit_in
from siq.diagnosis.mechanisms import MechanismCandidate
from siq.errors import NumericalFailure
from siq.systems.dynamics import Dynamics, JointExpectation, symbol

CURVE, SURFACE = "curve", "surface"
# Lengths between neighbours: a sum of bumps then has the variance of the process to 2e-5, that of two
# coordinates to 4 % (of points that are spread evenly).
APART = 0.5
ROUNDING = 1e-6  # numerical: of the process's variance, added to it at every bump


class Smooth(Protocol):
    """A smooth function with its bumps; see `SmoothFunction`."""

    @property
    def ground(self) -> Ground:
        """Where it stands."""

    @property
    def kind(self) -> str:
        """What it looks like."""

    @property
    def width(self) -> int:
        """The number of bumps."""

    @property
    def linear(self) -> int:
        """In how many of its heights, the first ones, it is linear if the others are given."""

    @property
    def begin(self) -> np.ndarray:
        """Heights to begin with."""

    @property
    def limits(self) -> np.ndarray:
        """Where the recordings have been."""

    def along(self, heights: np.ndarray, courses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The function along courses, and its derivatives by the heights."""

    def formula(self, heights: tuple[sympy.Expr, ...]) -> sympy.Expr:
        """As a formula, heights being symbols."""

    def expected(self, names: tuple[str, ...]) -> tuple[JointExpectation, ...]:
        """What is expected of the heights."""

    def units(self, whole: str) -> tuple[str, ...]:
        """Of the heights, of a function with a unit."""


@dataclass(frozen=True)
class SmoothFunction:
    """A smooth function as a sum of bumps, and what is expected of it.

    Attributes
    ----------
    ground
        Where it stands, and of what it is a function.
    centres
        Of the bumps, shape ``(b, c)``.
    lengths
        Over which it changes, and how wide the bumps are, shape ``(c,)``.
    deviation
        s, the size that is expected of it.
    weight
        See `siq.systems.dynamics.JointExpectation`.
    """

    ground: Ground
    centres: np.ndarray
    lengths: np.ndarray
    deviation: float = 1.0
    weight: float = 1.0

    @property
    def kind(self) -> str:
        """What it looks like."""
        return CURVE if len(self.lengths) == 1 else SURFACE

    @property
    def equations(self) -> tuple[tuple[str, sympy.Expr], ...]:
        """What it is multiplied by in each equation in which it stands."""
        return self.ground.place.equations

    @property
    def outputs(self) -> tuple[tuple[str, sympy.Expr], ...]:
        """The same of outputs."""
        return self.ground.place.outputs

    @property
    def coordinates(self) -> tuple[sympy.Expr, ...]:
        """What it is a function of."""
        return self.ground.coordinates

    @property
    def width(self) -> int:
        """The number of bumps."""
        return len(self.centres)

    @property
    def linear(self) -> int:
        """In how many of its heights it is linear: in all of them."""
        return self.width

    @property
    def begin(self) -> np.ndarray:
        """Heights to begin with, shape ``(b,)``."""
        return np.zeros(self.width)

    def along(self, heights: np.ndarray, courses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The function along courses ``(c, n)``, ``(n,)``, and its derivatives by the heights, ``(n, b)``."""
        values = self.values(courses)
        return heights @ values, values.T

    def formula(self, heights: tuple[sympy.Expr, ...]) -> sympy.Expr:
        """The sum of its bumps, heights being symbols."""
        return sympy.Add(
            *(height * self._bump(centre) for height, centre in zip(heights, self.centres, strict=True))
        )

    def _bump(self, centre: np.ndarray) -> sympy.Expr:
        away = [
            ((z - _number(at)) / _number(length)) ** 2
            for z, at, length in zip(self.coordinates, centre, self.lengths, strict=True)
        ]
        return sympy.exp(-sympy.Add(*away) / 2)

    def units(self, whole: str) -> tuple[str, ...]:
        """Of the heights, of a function with a unit."""
        return (whole,) * self.width

    def expected(self, names: tuple[str, ...]) -> tuple[JointExpectation, ...]:
        """What is expected of the heights, by their names."""
        return (JointExpectation(names, self.triangle.T / self.deviation, self.weight),)

    def values(self, courses: np.ndarray) -> np.ndarray:
        """Every bump along courses ``(c, n)`` of the coordinates, shape ``(b, n)``."""
        return np.exp(-0.5 * _squares(courses.T / self.lengths, self.centres / self.lengths)).T

    @cached_property
    def triangle(self) -> np.ndarray:
        """Lower triangle L of the process's covariance at the centres over s², shape ``(b, b)``."""
        return triangle_of(self.centres, self.lengths)

    def heights_of(self, values: np.ndarray) -> np.ndarray:
        """The heights with which it has given values ``(b,)`` at its centres."""
        return scipy.linalg.cho_solve((self.triangle, True), values)

    @property
    def limits(self) -> np.ndarray:
        """Where the recordings have been: lower and upper, shape ``(2, c)``."""
        return np.stack([self.ground.courses.min(axis=1), self.ground.courses.max(axis=1)])


def smooth_function(
    ground: Ground,
    shares: tuple[float, ...],
    *,
    deviation: float = 1.0,
    weight: float = 1.0,
    most: int | None = None,
) -> SmoothFunction:
    """A smooth function with its bumps where the recordings have been.

    Parameters
    ----------
    ground
        Where it stands.
    shares
        Its lengths, as shares of the coordinates' ranges.
    deviation, weight
        See `SmoothFunction`.
    most
        So many bumps at most; those left out are nearest to others.
    """
    lengths = np.array(shares) * ground.ranges
    if len(shares) == 1:
        lower, upper = ground.courses.min(), ground.courses.max()
        centres = np.linspace(lower, upper, int(np.ceil(1 / (APART * shares[0]))) + 1)[:most, None]
    else:
        apart = APART * np.sqrt(len(shares))
        scaled = ground.courses / lengths[:, None]
        centres = ground.courses[:, spread_out(scaled, apart=apart, most=most)].T
    return SmoothFunction(ground, centres, lengths, deviation, weight)


def spread_out(points: np.ndarray, *, apart: float, most: int | None = None) -> np.ndarray:
    """Indices of points ``(c, n)`` that are so far apart, beginning in their middle."""
    away = np.full(points.shape[1], np.inf)
    chosen = [int(np.argmin(((points - np.median(points, axis=1)[:, None]) ** 2).sum(axis=0)))]
    while most is None or len(chosen) < most:
        away = np.minimum(away, ((points - points[:, chosen[-1:]]) ** 2).sum(axis=0))
        farthest = int(np.argmax(away))
        if away[farthest] < apart**2:
            break
        chosen.append(farthest)
    return np.array(chosen)


def with_smooth_function(model: Dynamics, function: Smooth) -> MechanismCandidate:
    """The simulation with a smooth function, as it begins; the heights of its bumps are the amplitudes."""
    place = function.ground.place
    names = tuple(fresh_names("b", function.width, model))
    factors = len(place.words) - len(function.ground.words)
    units = function.units(unit_in(place, model, 0, factors))
    candidate = built(model, place, function.formula(tuple(map(symbol, names))), names, units)
    together = (*candidate.model.expected_together, *function.expected(names))
    known = dict(zip(names, function.begin, strict=True))
    values = [known.get(each.name, each.value) for each in candidate.model.parameters]
    begun = replace(candidate.model, expected_together=together).with_values(np.array(values))
    return replace(candidate, model=begun)


def triangle_of(points: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Lower triangle of the covariance of a process of unit size at points ``(b, c)``, shape ``(b, b)``."""
    likeness = np.exp(-0.5 * _squares(points / lengths, points / lengths))
    return np.linalg.cholesky(likeness + ROUNDING * np.eye(len(points)))


def _number(value: float) -> sympy.Expr:
    return sympy.Float(float(f"{value:.6g}"))


def _squares(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Squared distances of points ``(n, c)`` and ``(b, c)``, shape ``(n, b)``."""
    return ((one[:, None, :] - other[None, :, :]) ** 2).sum(axis=2)


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
        """See `siq.diagnosis.smooth_functions.SmoothFunction.along`."""
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
        (`siq.systems.dynamics.JointExpectation`).
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
