"""Smooth functions of one or two coordinates as normal processes, and products of two of them.

All that is expected of a smooth function is that its values are alike where its coordinates are: a normal
process with the covariance ``s² exp(-½ Σ ((z_i - z'_i)/ℓ_i)²)`` (Rasmussen and Williams, Gaussian Processes
for Machine Learning, MIT Press 2006). It is written as a sum of Gaussian bumps as wide as the lengths ℓ,
which stand closely where the recordings have been; what is expected of their heights makes the sum such a
process there (Quiñonero-Candela and Rasmussen, J. Mach. Learn. Res. 6, 1939 (2005)). A length or so beyond,
the function goes to zero.

What depends on two coordinates is often a product ``f(x) g(y)``, which has far fewer heights than a surface.
A process of unit size is expected of f, and one of the size of the whole of g. Given one of them everything
is linear in the other, so that they are worked out in turn.

Along the trajectories of a fit everything is linear. The likelihood of a smooth function, averaged over
everything that it could be, tells its lengths and its size: one that is too rough could have been too much
else, and one that is too smooth explains too little (MacKay, Neural Computation 4, 415 (1992)).
"""

from __future__ import annotations

import itertools
import logging
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
import scipy.linalg
import sympy

from siq.diagnosis.evidence import (
    NUMERICAL_ERRORS,
    FittedCandidate,
    correlation_time_of,
    evidences_by_size,
    orthonormal,
)
from siq.diagnosis.mechanisms import MechanismCandidate
from siq.diagnosis.screening import PROBE_SUBSTEPS, levels_of, probe_response, projected
from siq.diagnosis.terms import (
    LARGEST_LINEARISATION,
    FunctionSite,
    Kind,
    Place,
    PlaceColumns,
    built,
    fresh_names,
    unit_in,
)
from siq.errors import NumericalFailure
from siq.inference.kalman_filter import Grid, Whitened, profile_likelihood, whiten
from siq.inference.maximum_likelihood import Fit
from siq.inference.measurements import Measurements
from siq.systems.dynamics import Dynamics, JointExpectation, symbol

LOGGER = logging.getLogger(__name__)
CURVE: Final = "curve"
SURFACE: Final = "surface"
MECHANISM: Final = "mechanism"
LENGTH_SCALES = (1 / 16, 1 / 8, 1 / 4, 1 / 2, 1.0, 2.0)  # of the range; beyond, a function is a parabola
MOST_BUMPS = 100  # a guard on the time of a fit
# Lengths between neighbours: a sum of bumps then has the variance of the process to 2e-5, that of two
# coordinates to 4 % (of points that are spread evenly).
BUMP_SPACING = 0.5
COVARIANCE_JITTER = 1e-6  # numerical: of the process's variance, added to it at every bump
PRODUCT_ITERATIONS = 30  # at most, of working out one factor after the other
PRODUCT_TOLERANCE = 1e-4  # of what is left, by which an iteration has to be better


@dataclass(frozen=True)
class _SmoothFunction:
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

    ground: FunctionSite
    centres: np.ndarray
    lengths: np.ndarray
    deviation: float = 1.0
    weight: float = 1.0

    @property
    def kind(self) -> Kind:
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
        bumps = []
        for height, centre in zip(heights, self.centres, strict=True):
            away = [
                ((z - _rounded(at)) / _rounded(length)) ** 2
                for z, at, length in zip(self.coordinates, centre, self.lengths, strict=True)
            ]
            bumps.append(height * sympy.exp(-sympy.Add(*away) / 2))
        return sympy.Add(*bumps)

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
        return _triangle_of(self.centres, self.lengths)

    def heights_of(self, values: np.ndarray) -> np.ndarray:
        """The heights with which it has given values ``(b,)`` at its centres."""
        return scipy.linalg.cho_solve((self.triangle, True), values)

    @property
    def limits(self) -> np.ndarray:
        """Where the recordings have been: lower and upper, shape ``(2, c)``."""
        return np.stack([self.ground.courses.min(axis=1), self.ground.courses.max(axis=1)])


def smooth_function(
    ground: FunctionSite,
    shares: tuple[float, ...],
    *,
    deviation: float = 1.0,
    weight: float = 1.0,
    most: int | None = None,
) -> _SmoothFunction:
    """A smooth function with its bumps where the recordings have been.

    Parameters
    ----------
    ground
        Where it stands.
    shares
        Its lengths, as shares of the coordinates' ranges.
    deviation, weight
        See `_SmoothFunction`.
    most
        So many bumps at most; those left out are nearest to others.
    """
    lengths = np.array(shares) * ground.ranges
    if len(shares) == 1:
        lower, upper = ground.courses.min(), ground.courses.max()
        centres = np.linspace(lower, upper, int(np.ceil(1 / (BUMP_SPACING * shares[0]))) + 1)[:most, None]
    else:
        apart = BUMP_SPACING * np.sqrt(len(shares))
        scaled = ground.courses / lengths[:, None]
        # So far apart, beginning in the middle of the points, each farthest from those before it.
        away = np.full(scaled.shape[1], np.inf)
        middle = np.median(scaled, axis=1)[:, None]
        chosen = [int(np.argmin(((scaled - middle) ** 2).sum(axis=0)))]
        while most is None or len(chosen) < most:
            away = np.minimum(away, ((scaled - scaled[:, chosen[-1:]]) ** 2).sum(axis=0))
            farthest = int(np.argmax(away))
            if away[farthest] < apart**2:
                break
            chosen.append(farthest)
        centres = ground.courses[:, chosen].T
    return _SmoothFunction(ground, centres, lengths, deviation, weight)


def _triangle_of(points: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Lower triangle of the covariance of a process of unit size at points ``(b, c)``, shape ``(b, b)``."""
    likeness = np.exp(-0.5 * _squares(points / lengths, points / lengths))
    return np.linalg.cholesky(likeness + COVARIANCE_JITTER * np.eye(len(points)))


def _rounded(value: float) -> sympy.Expr:
    return sympy.Float(float(f"{value:.6g}"))


def _squares(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Squared distances of points ``(n, c)`` and ``(b, c)``, shape ``(n, b)``."""
    return ((one[:, None, :] - other[None, :, :]) ** 2).sum(axis=2)


@dataclass(frozen=True)
class _ProductFunction:
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

    ground: FunctionSite
    first: _SmoothFunction
    second: _SmoothFunction
    begin: np.ndarray

    @property
    def kind(self) -> Kind:
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


Smooth = _SmoothFunction | _ProductFunction
"""Functions of bumps, each with its site, heights to begin with, formula and expectation."""


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


def _product_of(
    ground: FunctionSite,
    shares: tuple[float, ...],
    *,
    points: np.ndarray,
    gram: np.ndarray,
    overlap: np.ndarray,
    deviation: float,
    weight: float = 1.0,
) -> _ProductFunction:
    """The likeliest product, whose lengths may be any of several."""
    grounds = [
        FunctionSite(
            ground.place, (ground.coordinates[side],), (ground.words[side],), ground.courses[side, None]
        )
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
            highest, best = evidence, _ProductFunction(ground, one, sized, np.concatenate(heights))
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
    for _ in range(PRODUCT_ITERATIONS):
        f, _ = _given(first * (g @ second), gram, overlap)
        g, left = _given(second * (f @ first), gram, overlap)
        left += float(f @ f)
        if before - left < PRODUCT_TOLERANCE * abs(left):
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


@dataclass(frozen=True)
class Term:
    """A part of a description.

    Attributes
    ----------
    trial
        What was added, fitted and judged.
    kind
        ``formula``, ``curve``, ``surface``, or ``mechanism``.
    cost
        Logarithm of the number of places, or mechanisms, that it was chosen among.
    place
        Where a function stands; None for a mechanism or a memory.
    smooth
        What a curve or a surface is made of: the amplitudes are the heights of its bumps.
    """

    trial: FittedCandidate
    kind: Kind
    cost: float
    place: Place | None = None
    smooth: Smooth | None = None


@dataclass(frozen=True)
class _SmoothData:
    """What a fit leaves says of a function's values, at a level of process noise.

    Attributes
    ----------
    level
        Relative to the process noise of the fit.
    fine
        The function, with bumps as narrow as any.
    correlated
        Correlation time τ of the innovations in samples, with such a function: n of them count as n/τ.
    gram, overlap
        Of what a unit of each bump does to the innovations, with each other and with the innovations; shapes
        ``(b, b)`` and ``(b,)``. Over τ, as are those that follow.
    total, freedom
        Sum of squares of the innovations, and degrees of freedom.
    likelihood
        Logarithm, without the function.
    """

    level: float
    fine: _SmoothFunction
    correlated: float
    gram: np.ndarray
    overlap: np.ndarray
    total: float
    freedom: float
    likelihood: float

    def over(self, correlated: float) -> _SmoothData:
        """The same where so many samples are autocorrelated."""
        return _SmoothData(
            self.level, self.fine, correlated, self.gram / correlated, self.overlap / correlated,
            self.total / correlated, self.freedom / correlated, self.likelihood / correlated,
        )  # fmt: skip


@dataclass(frozen=True)
class Smoothness:
    """How smooth a function is, as recordings tell it.

    Attributes
    ----------
    shares
        Its lengths, as shares of the ranges of its coordinates.
    deviation
        Its size.
    told
        What the recordings tell, at the level of process noise at which it is likeliest.
    noise
        Variance of the innovations then, in units of what the fit takes for it.
    log_evidence
        Logarithm of the odds for such a function, over none, each at its best level; averaged over all
        lengths and sizes.
    considered
        How many lengths and sizes these are.
    """

    shares: tuple[float, ...]
    deviation: float
    told: _SmoothData
    noise: float
    log_evidence: float
    considered: int


def smoothness_of(
    fit: Fit, data: Measurements, ground: FunctionSite, *, known: Term | None = None, alike: bool = False
) -> Smoothness | None:
    """The likeliest smoothness of a function on top of a fit; None where it cannot be worked out.

    Parameters
    ----------
    fit, data
        The fit along whose trajectories everything is linear, and what it was made for.
    ground
        Where the function stands.
    known
        A part of the fit that is a first description of this function, in whose stead it comes.
    alike
        Whether both lengths are the same share of the range.
    """
    least, fine = _finest(ground, data, fit.model)
    some = [share for share in LENGTH_SCALES if share >= least]
    choices = [(each,) * len(ground.words) for each in some]
    if not alike:
        choices = list(itertools.product(some, repeat=len(ground.words)))
    # What processes of these lengths have for values at the finest bumps, as heights of these.
    shapes = [fine.heights_of(_triangle_of(fine.centres, np.array(each) * ground.ranges)) for each in choices]
    alone = -np.inf
    values: list[np.ndarray] = []
    highest, best = -np.inf, None
    for told in _told(fit, data, fine, known):
        alone = max(alone, told.likelihood)
        for shares, shape in zip(choices, shapes, strict=True):
            gained, scale, rest = evidences_by_size(
                shape.T @ told.gram @ shape, shape.T @ told.overlap, told.total, freedom=told.freedom
            )
            values.append(told.likelihood + gained)
            place = int(np.argmax(gained))
            if values[-1][place] > highest:
                # The scale of the noise was at its best, too, and the size is one in units of it.
                highest, noise = values[-1][place], float(rest[place] / told.freedom)
                deviation = float(np.sqrt(scale[place] * noise))
                best = Smoothness(shares, deviation, told, noise, 0.0, len(gained) * len(choices))
    if best is None or not best.deviation > 0:
        return None
    whole = np.concatenate(values)
    mean = float(np.logaddexp.reduce(whole) - np.log(len(whole)))
    return replace(best, log_evidence=mean - alone)


def likeliest_product(asked: Smoothness, ground: FunctionSite, *, times: float = 1.0) -> _ProductFunction:
    """The likeliest product of two functions, where a function of two coordinates is asked for.

    Parameters
    ----------
    asked
        What the recordings say of a function of both.
    ground
        Where it stands.
    times
        Factor on the lengths to choose among.
    """
    told = asked.told
    by_value = told.fine.heights_of(told.fine.heights_of(told.gram).T)
    return _product_of(
        ground,
        tuple(times * share for share in LENGTH_SCALES),
        points=told.fine.centres,
        gram=(by_value + by_value.T) / (2 * asked.noise),
        overlap=told.fine.heights_of(told.overlap) / asked.noise,
        deviation=asked.deviation,
        weight=told.correlated,
    )


def _told(fit: Fit, data: Measurements, fine: _SmoothFunction, known: Term | None) -> list[_SmoothData]:
    """What is told at each level of process noise at which it can be worked out.

    Errors are as correlated as the likeliest level leaves them with such a function, at all levels.
    """
    grid = Grid(data, fit.substeps if known else min(fit.substeps, PROBE_SUBSTEPS))
    response = probe_response(fit.model, grid, fit, PlaceColumns(fit.model, grid, [fine]))
    found: list[_SmoothData] = []
    highest, correlated = -np.inf, 1.0
    for level in levels_of(fit):
        try:
            white = whiten(response, data, fit.noise.scaled(level))
            white, parameters = _without(white, fit, known)
            left, columns = projected(white, parameters)
        except NUMERICAL_ERRORS as error:
            LOGGER.info("no function of %s can be screened: %s", " and ".join(fine.ground.words), error)
            continue
        total, freedom = float(left @ left), white.degrees_of_freedom - parameters
        likelihood = profile_likelihood(total, freedom, white.log_determinant)
        found.append(
            _SmoothData(level, fine, 1.0, columns.T @ columns, columns.T @ left, total, freedom, likelihood)
        )
        basis = orthonormal(columns)
        rest = left - basis @ (basis.T @ left)
        likelihood = profile_likelihood(float(rest @ rest), freedom, white.log_determinant)
        if likelihood > highest:
            highest = likelihood
            correlated = correlation_time_of(rest, white.recording, outputs=len(fit.model.outputs))
    return [each.over(correlated) for each in found]


def _finest(ground: FunctionSite, data: Measurements, model: Dynamics) -> tuple[float, _SmoothFunction]:
    """The shortest length, as a share of the range, of which the recordings need not too many bumps."""
    room = LARGEST_LINEARISATION // (len(data.t) * (model.dimension + len(model.outputs)))
    most = max(min(MOST_BUMPS, room), 1)
    for share in LENGTH_SCALES:
        function = smooth_function(ground, (share,) * len(ground.words), most=most + 1)
        if function.width <= most:
            return share, function
    return LENGTH_SCALES[-1], smooth_function(ground, (LENGTH_SCALES[-1],) * len(ground.words), most=most)


def _without(white: Whitened, fit: Fit, known: Term | None) -> tuple[Whitened, int]:
    """Innovations as if a part were not there, its columns left out, and the number of parameters left."""
    names = [fit.model.parameters[place].name for place in fit.model.free]
    amplitudes = () if known is None else known.trial.candidate.amplitudes
    mine = [names.index(name) for name in amplitudes]
    linear = mine if known is None or known.smooth is None else mine[: known.smooth.linear]
    values = fit.model.values[[fit.model.free[place] for place in linear]]
    others = np.delete(white.columns, mine, axis=1)
    innovations = white.innovations + white.columns[:, linear] @ values
    return replace(white, innovations=innovations, columns=others), len(names) - len(mine)
