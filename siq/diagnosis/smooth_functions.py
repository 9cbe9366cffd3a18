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

**Shapes.** A function that is in proportion to its coordinate, saturates or repeats has a name for that: the
simplest formula that the recordings allow in its place, by least squares in what they tell of its values.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg
import scipy.optimize
import scipy.stats
import sympy
from scipy.spatial.distance import cdist

from siq.data.correlation import correlation_time_of
from siq.diagnosis.evidence import FittedCandidate, evidences_by_size
from siq.diagnosis.mechanisms import CURVE, SURFACE, Kind, MechanismCandidate, along, fresh_names
from siq.diagnosis.screening import PROBE_SUBSTEPS, at_noise_levels, linearised_with
from siq.diagnosis.terms import Place
from siq.errors import NumericalFailure
from siq.inference.kalman_filter import Whitened
from siq.inference.maximum_likelihood import Fit
from siq.inference.measurements import Measurements
from siq.numerics.randomness import positive
from siq.systems.dynamics import Dynamics, JointExpectation, symbol
from siq.systems.formulas import compile_values

LENGTH_SCALES = (1 / 16, 1 / 8, 1 / 4, 1 / 2, 1.0, 2.0)  # of the range; beyond, a function is a parabola
LARGEST_LINEARISATION = 40_000_000  # numbers held at a time, which is a third of a gigabyte
MOST_BUMPS = 100  # a guard on the time of a fit
# Lengths between neighbours: a sum of bumps then has the variance of the process to 2e-5, that of two
# coordinates to 4 % (of points that are spread evenly).
BUMP_SPACING = 0.5
COVARIANCE_JITTER = 1e-6  # numerical: of the process's variance, added to it at every bump
PRODUCT_ITERATIONS = 30  # at most, of working out one factor after the other
PRODUCT_TOLERANCE = 1e-4  # of what is left, by which an iteration has to be better


@dataclass(frozen=True)
class _Bumps:
    """A smooth function as a sum of bumps, and what is expected of it: a `siq.diagnosis.terms.Basis`."""

    coordinates: tuple[sympy.Expr, ...]  #: what it is a function of
    limits: np.ndarray  #: where the recordings have been: lower and upper, shape ``(2, c)``
    centres: np.ndarray  #: of the bumps, shape ``(b, c)``
    lengths: np.ndarray  #: over which it changes, how wide the bumps are, shape ``(c,)``
    deviation: float = 1.0  #: s, the size that is expected of it
    weight: float = 1.0  #: see `siq.systems.dynamics.JointExpectation`

    @classmethod
    def along(
        cls, coordinates: tuple[sympy.Expr, ...], courses: np.ndarray, shares: tuple[float, ...], *,
        deviation: float = 1.0, weight: float = 1.0, most: int | None = None,
    ) -> _Bumps:  # fmt: skip
        """A smooth function with its bumps where the recordings have been.

        Parameters
        ----------
        coordinates, courses
            What it is a function of, and their values along the recordings, shape ``(c, n)``.
        shares
            Its lengths, as shares of the coordinates' ranges.
        deviation, weight
            See above.
        most
            So many bumps at most; those left out are nearest to others.
        """
        lengths = np.array(shares) * np.ptp(courses, axis=1)
        limits = np.stack([courses.min(axis=1), courses.max(axis=1)])
        if len(shares) == 1:
            (lower,), (upper,) = limits
            centres = np.linspace(lower, upper, int(np.ceil(1 / (BUMP_SPACING * shares[0]))) + 1)[:most, None]
        else:
            apart = BUMP_SPACING * np.sqrt(len(shares))
            scaled = courses / lengths[:, None]
            # So far apart, beginning in the middle of the points, each farthest from those before it.
            away = np.full(scaled.shape[1], np.inf)
            chosen = [int(np.argmin(((scaled - np.median(scaled, axis=1)[:, None]) ** 2).sum(axis=0)))]
            while most is None or len(chosen) < most:
                away = np.minimum(away, ((scaled - scaled[:, chosen[-1:]]) ** 2).sum(axis=0))
                farthest = int(np.argmax(away))
                if away[farthest] < apart**2:
                    break
                chosen.append(farthest)
            centres = courses[:, chosen].T
        return cls(coordinates, limits, centres, lengths, deviation, weight)

    @property
    def width(self) -> int:
        """The number of bumps."""
        return len(self.centres)

    def formula(self, heights: tuple[sympy.Expr, ...]) -> sympy.Expr:
        """The sum of the bumps, heights being symbols."""
        bumps = []
        for height, centre in zip(heights, self.centres, strict=True):
            away = [
                ((z - _rounded(at)) / _rounded(length)) ** 2
                for z, at, length in zip(self.coordinates, centre, self.lengths, strict=True)
            ]
            bumps.append(height * sympy.exp(-sympy.Add(*away) / 2))
        return sympy.Add(*bumps)

    def values(self, courses: np.ndarray) -> np.ndarray:
        """Every bump along courses ``(c, n)`` of the coordinates, shape ``(b, n)``."""
        return np.exp(-0.5 * cdist(courses.T / self.lengths, self.centres / self.lengths, "sqeuclidean")).T

    def expected(self, names: tuple[str, ...]) -> JointExpectation:
        """What is expected of the heights, by their names."""
        return JointExpectation(names, self.triangle.T / self.deviation, self.weight)

    @cached_property
    def triangle(self) -> np.ndarray:
        """Lower triangle L of the process's covariance at the centres over s², shape ``(b, b)``."""
        return _triangle_of(self.centres, self.lengths)

    def heights_of(self, values: np.ndarray) -> np.ndarray:
        """The heights with which it has given values ``(b,)`` at its centres."""
        return scipy.linalg.cho_solve((self.triangle, True), values)


def _triangle_of(points: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Lower triangle of the covariance of a process of unit size at points ``(b, c)``, shape ``(b, b)``."""
    likeness = np.exp(-0.5 * cdist(points / lengths, points / lengths, "sqeuclidean"))
    return np.linalg.cholesky(likeness + COVARIANCE_JITTER * np.eye(len(points)))


def _rounded(value: float) -> sympy.Expr:
    return sympy.Float(float(f"{value:.6g}"))


@dataclass(frozen=True)
class SmoothFunction:
    """A smooth function in a place, or a product of two, of one coordinate each.

    It begins with heights ``(b,)`` of all bumps: of a product none, since where both factors are zero nothing
    points anywhere.
    """

    place: Place
    factors: tuple[_Bumps, ...]
    begin: np.ndarray

    @property
    def width(self) -> int:
        """The number of bumps."""
        return sum(each.width for each in self.factors)

    @property
    def linear(self) -> int:
        """In how many of its heights, the first ones, it is linear if the others are given."""
        return self.factors[0].width

    @property
    def limits(self) -> np.ndarray:
        """Where the recordings have been: lower and upper, shape ``(2, c)``."""
        return np.concatenate([each.limits for each in self.factors], axis=1)

    def along(self, heights: np.ndarray, courses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The function along courses ``(c, n)``, ``(n,)``, and its derivatives by the heights, ``(n, b)``."""
        if len(self.factors) == 1:
            values = self.factors[0].values(courses)
            return heights @ values, values.T
        one, other = (each.values(courses[side, None]) for side, each in enumerate(self.factors))
        f, g = heights[: self.linear] @ one, heights[self.linear :] @ other
        return f * g, np.concatenate([one * g, other * f]).T

    def added_to(self, model: Dynamics) -> MechanismCandidate:
        """A simulation with it, as it begins; the heights of its bumps are the amplitudes."""
        names = tuple(fresh_names("b", self.width, model.names))
        split = (names,) if len(self.factors) == 1 else (names[: self.linear], names[self.linear :])
        pairs = list(zip(self.factors, split, strict=True))
        formula = sympy.prod([each.formula(tuple(map(symbol, own))) for each, own in pairs])
        whole = self.place.unit(model, 0, len(self.place.words) - len(self.place.coordinates))
        last = self.factors[-1].width  # a first factor of two has no unit
        candidate = self.place.added_to(model, formula, names, ("1",) * (self.width - last) + (whole,) * last)
        together = (*candidate.model.expected_together, *(each.expected(own) for each, own in pairs))
        begun = candidate.begun(candidate.model, dict(zip(names, self.begin, strict=True)))
        kind: Kind = CURVE if len(self.place.coordinates) == 1 else SURFACE
        return replace(candidate, model=replace(begun, expected_together=together), kind=kind, smooth=self)


def _product_of(
    place: Place, courses: np.ndarray, shares: tuple[float, ...], *, points: np.ndarray, gram: np.ndarray,
    overlap: np.ndarray, deviation: float, weight: float = 1.0,
) -> SmoothFunction:  # fmt: skip
    """The likeliest product, whose lengths may be any of several."""

    def basis(side: int, share: float) -> tuple[_Bumps, np.ndarray]:
        """A factor, and what a unit of each of its independent coefficients is at the points."""
        bumps = _Bumps.along((place.coordinates[side],), courses[side, None], (share,), weight=weight)
        values = bumps.values(points[:, side, None].T)
        return bumps, scipy.linalg.solve_triangular(bumps.triangle, values, lower=True)

    bases = [[basis(side, share) for share in shares] for side in range(2)]
    highest, best = -np.inf, None
    for (one, first), (other, second) in itertools.product(*bases):
        second = deviation * second
        g = np.linalg.lstsq(second.T, np.full(second.shape[1], np.sqrt((second**2).sum(axis=0).mean())))[0]
        f, before = np.zeros(len(first)), np.inf
        for _ in range(PRODUCT_ITERATIONS):
            f, _ = _given(first * (g @ second), gram, overlap)
            g, left = _given(second * (f @ first), gram, overlap)
            left += float(f @ f)
            if before - left < PRODUCT_TOLERANCE * abs(left):
                break
            before = left
        # The evidence is averaged over all that the factors could be (Laplace's approximation).
        both = np.concatenate([first * (g @ second), second * (f @ first)])
        told = np.linalg.eigvalsh(both @ gram @ both.T)
        evidence = -0.5 * left - 0.5 * float(np.log1p(np.maximum(told, 0.0)).sum())
        if evidence > highest:
            heights = [
                scipy.linalg.solve_triangular(function.triangle, values, lower=True, trans="T")
                for function, values in ((one, f), (other, deviation * g))
            ]
            sized = replace(other, deviation=deviation)
            highest, best = evidence, SmoothFunction(place, (one, sized), np.concatenate(heights))
    if best is None:
        raise NumericalFailure("no product of two functions has an evidence that is a number")
    return best


def _given(basis: np.ndarray, gram: np.ndarray, overlap: np.ndarray) -> tuple[np.ndarray, float]:
    """Normal coefficients of a basis ``(b, z)``, and what they leave of squares, over that of none."""
    inner, target = basis @ gram @ basis.T + np.eye(len(basis)), basis @ overlap
    found = scipy.linalg.solve(inner, target, assume_a="pos")
    return found, -float(found @ target)


@dataclass(frozen=True)
class Smoothness:
    """How smooth a function is, as recordings tell it at the likeliest level of process noise."""

    place: Place  #: where it stands
    courses: np.ndarray  #: its coordinates along the recordings, shape ``(c, n)``
    shares: tuple[float, ...]  #: its lengths, as shares of the ranges of its coordinates
    deviation: float  #: its size
    noise: float  #: variance of the innovations with it, in units of what the fit takes for it
    level: float  #: process noise, likewise
    #: Correlation time τ of the innovations in samples, with such a function: n of them count as n/τ.
    correlated: float
    considered: int  #: how many lengths and sizes were compared
    fine: _Bumps  #: the function with bumps as narrow as any
    gram: np.ndarray  #: what a unit of each does to the innovations, with each other, over τ: ``(b, b)``
    overlap: np.ndarray  #: the same with the innovations, ``(b,)``
    #: Logarithm of the odds for such a function, over none, each at its best level; averaged over all lengths
    #: and sizes.
    log_evidence: float = float("nan")

    @classmethod
    def of(
        cls, fit: Fit, data: Measurements, place: Place, *, known: FittedCandidate | None = None,
        alike: bool = False,
    ) -> Smoothness | None:  # fmt: skip
        """The likeliest smoothness of a function on top of a fit; None where it cannot be worked out.

        Parameters
        ----------
        fit, data, place
            The fit along whose trajectories everything is linear, its data, and where the function stands.
        known
            A part of the fit that is a first description of this function, in whose stead it comes.
        alike
            Whether both lengths are the same share of the range.
        """
        courses = along(place.coordinates, fit.model, data, fit.x)
        ranges = np.ptp(courses, axis=1)
        if not (np.isfinite(courses).all() and (ranges > 0).all()):
            return None
        # The shortest length of which the recordings need not too many bumps.
        count = len(place.coordinates)
        room = LARGEST_LINEARISATION // (len(data.t) * (fit.model.dimension + len(fit.model.outputs)))
        most = max(min(MOST_BUMPS, room), 1)
        for least in LENGTH_SCALES:
            fine = _Bumps.along(place.coordinates, courses, (least,) * count, most=most + 1)
            if fine.width <= most:
                break
        else:
            fine = _Bumps.along(place.coordinates, courses, (least,) * count, most=most)
        some = [share for share in LENGTH_SCALES if share >= least]
        choices = [(each,) * count for each in some] if alike else list(itertools.product(some, repeat=count))
        # What processes of these lengths have for values at the finest bumps, as heights of these.
        shapes = [fine.heights_of(_triangle_of(fine.centres, np.array(each) * ranges)) for each in choices]
        # What is told at each level of process noise at which it can be worked out. Errors are as correlated
        # as the likeliest level leaves them with such a function, at all levels.
        response, _ = linearised_with(
            fit, data, [replace(place, basis=fine)], substeps=fit.substeps if known else PROBE_SUBSTEPS
        )
        levels: list[tuple[float, np.ndarray, np.ndarray, float, float, float]] = []
        highest, correlated = -np.inf, 1.0
        for level, problem in at_noise_levels(response, fit, data, lambda white: _without(white, fit, known)):
            gram, total = problem.columns.T @ problem.columns, problem.total
            levels.append((level, gram, problem.overlap, total, problem.freedom, problem.likelihood(total)))
            rest = problem.unexplained
            likelihood = problem.likelihood(float(rest @ rest))
            if likelihood > highest:
                highest = likelihood
                recording, outputs = problem.white.recording, len(fit.model.outputs)
                correlated = correlation_time_of(rest, recording, outputs=outputs)
        alone, values = -np.inf, list[np.ndarray]()
        highest, best = -np.inf, None
        for level, gram, overlap, total, degrees, likelihood in levels:
            gram, overlap, total = gram / correlated, overlap / correlated, total / correlated
            degrees, likelihood = degrees / correlated, likelihood / correlated
            alone = max(alone, likelihood)
            for shares, shape in zip(choices, shapes, strict=True):
                gained, scale, rest = evidences_by_size(
                    shape.T @ gram @ shape, shape.T @ overlap, total, freedom=degrees
                )
                values.append(likelihood + gained)
                size = int(np.argmax(gained))
                if values[-1][size] > highest:
                    # The scale of the noise was at its best, too, and the size is one in units of it.
                    highest, noise = values[-1][size], float(rest[size] / degrees)
                    deviation = float(np.sqrt(scale[size] * noise))
                    best = cls(
                        place, courses, shares, deviation, noise, level, correlated,
                        len(gained) * len(choices), fine, gram, overlap,
                    )  # fmt: skip
        if best is None or not best.deviation > 0:
            return None
        whole = np.concatenate(values)
        return replace(best, log_evidence=float(np.logaddexp.reduce(whole) - np.log(len(whole))) - alone)

    def function(self, *, product: bool = False, times: float = 1.0) -> SmoothFunction:
        """The function, or the likeliest product of two, with lengths that are longer by a factor."""
        place, weight = self.place, self.correlated
        if not product:
            shares = tuple(times * share for share in self.shares)
            bumps = _Bumps.along(
                place.coordinates, self.courses, shares, deviation=self.deviation, weight=weight
            )
            return SmoothFunction(place, (bumps,), np.zeros(bumps.width))
        gram, overlap = self._by_value
        return _product_of(
            place, self.courses, tuple(times * share for share in LENGTH_SCALES), points=self.fine.centres,
            gram=gram, overlap=overlap, deviation=self.deviation, weight=weight,
        )  # fmt: skip

    @property
    def _by_value(self) -> tuple[np.ndarray, np.ndarray]:
        """Gram matrix and overlap of values at the finest bumps, in units of noise."""
        gram = self.fine.heights_of(self.fine.heights_of(self.gram).T)
        return (gram + gram.T) / (2 * self.noise), self.fine.heights_of(self.overlap) / self.noise

    def fitting_forms(
        self, forms: Sequence[_Form] | None = None
    ) -> list[tuple[_Form, dict[sympy.Symbol, tuple[float, float]]]]:
        """The simplest formulas that the function may be, by default of all that have names (`FORMS`).

        What recordings tell of its values f at the finest bumps are normal equations ``G f = b``. With the
        covariance ``K = L Lᵀ`` that is expected of the function, λ and U the eigenvalues and eigenvectors of
        ``Lᵀ G L``, a formula is the function as far as ``(1 + λ)^-½ Uᵀ Lᵀ (b - G f)`` is noise, with ``Σ λ/(1
        + λ)`` degrees of freedom: a difference counts as far as such a function could be it.

        Returns
        -------
        list of (form, dict)
            Of those that fit with as few coefficients as any, the nearest first, with these and their errors.
            Empty where none fits.
        """
        (gram, overlap), ranges = self._by_value, np.ptp(self.courses, axis=1)
        root = self.deviation * _triangle_of(self.fine.centres, np.array(self.shares) * ranges)
        seen, vectors = np.linalg.eigh(root.T @ gram @ root)
        seen = np.maximum(seen, 0.0)
        turned, freedom = (vectors / np.sqrt(1 + seen)).T @ root.T, float((seen / (1 + seen)).sum())
        asked = FORMS if forms is None else forms
        return _fitting(self.fine.centres[:, 0], turned @ gram, turned @ overlap, freedom, asked)


def _without(white: Whitened, fit: Fit, known: FittedCandidate | None) -> tuple[Whitened, int]:
    """Innovations as if a part were not there, its columns left out, and the number of parameters left."""
    names = [fit.model.parameters[place].name for place in fit.model.free]
    amplitudes = () if known is None else known.candidate.amplitudes
    mine = [names.index(name) for name in amplitudes]
    smooth = None if known is None else known.candidate.smooth
    linear = mine if smooth is None else mine[: smooth.linear]
    values = fit.model.values[[fit.model.free[place] for place in linear]]
    others = np.delete(white.columns, mine, axis=1)
    innovations = white.innovations + white.columns[:, linear] @ values
    return replace(white, innovations=innovations, columns=others), len(names) - len(mine)


Z, A, B, D, C = sympy.symbols("z a b d c", real=True, cls=sympy.Dummy)  # no names of a system
THRESHOLD = "threshold"  # whose c is a place, and no length
KNOWN_ERRORS = 2.0  # standard errors from zero, from which on a length is known
FITS = 0.05  # p-value from which on a formula is all that the recordings tell of a function


class _Form(NamedTuple):
    """A formula of a coordinate z, linear in a, b and d. Values of c are tried, as shares of the range of z.

    The unit of a is divided by a power of that of z.
    """

    name: str
    formula: sympy.Expr
    power: int = 0
    tried: tuple[float, ...] = ()
    positive: tuple[sympy.Symbol, ...] = ()  #: coefficients that may not be negative


def _forms() -> Iterator[_Form]:
    """The shapes that have names, each alone and above a constant."""
    inside, scales = tuple(np.linspace(0, 1, 26)[1:-1]), tuple(np.geomspace(1 / 16, 2, 21))
    turn = 2 * sympy.pi * Z / C  # a whole one at least has to be seen
    alone = (
        _Form("constant", A), _Form("proportional", A * Z, 1), _Form("square", A * Z**2, 2),
        _Form("signed square", A * Z * sympy.Abs(Z), 2), _Form("cube", A * Z**3, 3),
        _Form("fourth power", A * Z**4, 4), _Form("exponential", A * sympy.exp(Z / C), 0, scales),
        _Form("exponential", A * sympy.exp(-Z / C), 0, scales),
        _Form("saturating", A * Z / (C + sympy.Abs(Z)), 0, scales),
        _Form("saturating", A * sympy.tanh(Z / C), 0, scales),
        _Form(THRESHOLD, A * sympy.Max(Z - C, 0), 1, inside),
        _Form(THRESHOLD, A * sympy.Max(C - Z, 0), 1, inside),
        _Form("periodic", A * sympy.sin(turn) + B * sympy.cos(turn), 0, tuple(1 / np.linspace(1, 8, 57))),
    )  # fmt: skip
    yield from alone
    for each in alone[1:]:
        name = "straight line" if each.name == "proportional" else each.name
        yield each._replace(name=name, formula=each.formula + D)


FORMS = tuple(_forms())


def _fitting(
    at: np.ndarray, weights: np.ndarray, goal: np.ndarray, freedom: float, forms: Sequence[_Form]
) -> list[tuple[_Form, dict[sympy.Symbol, tuple[float, float]]]]:
    """The simplest formulas that a function may be, with coefficients and their errors, the nearest first.

    A formula with values f at places ``(k,)`` may be the function where ``|goal - weights @ f|²`` is as large
    as chance makes it: χ² of so many degrees of freedom, less its coefficients. Weights are ``(r, k)``.
    """
    width = float(np.ptp(at))
    fitting: list[tuple[int, float, _Form, dict[sympy.Symbol, tuple[float, float]]]] = []
    for form in sorted(forms, key=lambda each: len(each.formula.free_symbols)):
        if fitting and len(form.formula.free_symbols) > 1 + fitting[0][0]:  # z is none of its coefficients
            break
        linear = [each for each in (A, B, D) if each in form.formula.free_symbols]
        slopes = compile_values([form.formula.diff(each) for each in linear], [Z, C])

        def solved(c: float, slopes: Any = slopes) -> tuple[float, np.ndarray, np.ndarray]:
            """χ² at its best, linear coefficients, and the form, weighted."""
            with np.errstate(all="ignore"):
                columns = weights @ np.stack(
                    [np.broadcast_to(each, at.shape) for each in slopes(at, c)], axis=1
                )
            if not np.isfinite(columns).all():
                return np.inf, np.zeros(columns.shape[1]), columns
            scale = positive(np.sqrt((columns**2).sum(axis=0)))
            found = np.linalg.lstsq(columns / scale, goal, rcond=1e-12)[0] / scale
            return float(((goal - columns @ found) ** 2).sum()), found, columns

        places, c = (at.min() if form.name == THRESHOLD else 0) + width * np.array(form.tried), np.nan
        if len(places):
            best = int(np.argmin([solved(one)[0] for one in places]))
            near = np.sort(places[max(best - 1, 0) : best + 2])
            c = scipy.optimize.minimize_scalar(
                lambda one, of=solved: of(one)[0], bounds=(near[0], near[-1]), method="bounded"
            ).x
        total, found, columns = solved(c)
        if len(places):
            bent = solved(c + 1e-4 * width)[2] - solved(c - 1e-4 * width)[2]
            columns, found = np.column_stack([columns, bent @ found / (2e-4 * width)]), np.append(found, c)
        errors = np.sqrt(np.diag(np.linalg.pinv(columns.T @ columns)))
        values = dict(zip([*linear, C], zip(found, errors, strict=True), strict=False))
        if any(values[each][0] < 0 for each in form.positive):
            continue
        # A length that may as well be any other is none that a function has.
        if len(places) and form.name != THRESHOLD and abs(found[-1]) < KNOWN_ERRORS * errors[-1]:
            continue
        if scipy.stats.chi2.sf(total, max(freedom - len(found), 1.0)) >= FITS:
            fitting.append((len(found), total, form, values))
    return [(form, values) for *_, form, values in sorted(fitting, key=lambda each: each[1])]
