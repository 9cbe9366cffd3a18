"""f and D of one state by the density of each transition, where a step is as long as the state remembers.

From sample to sample f bends what noise does on the way, so that no law of residuals is known. But the
density ``p(x, h | x₀)`` solves the equation of Fokker and Planck. On cells of the state that equation is a
Markov chain (`TransitionDensity`). Coefficients of f and of εD are those of the largest likelihood of all
pairs, by steps of the sum of squares of single scores; terms are chosen by these scores.

Behind a noisy sensor a pair shows two states and the noise of both. Then the density is that of a measured
value given all earlier ones of its record: a filter follows what is known of the state from cell to cell, and
needs neither a straight f nor a normal law, as that of Kalman does. The variance of the sensor is one more
parameter. A value that is a mean over an exposure is supposed to be normal, given where the state was at both
ends of it: that is exact of a linear force, and otherwise has the right mean and variance.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cached_property

import numpy as np
import scipy.special
from scipy.ndimage import map_coordinates
from scipy.special import ndtri

from siq.data.recordings import SnapshotPairs
from siq.errors import NumericalFailure
from siq.inference.diffusion_model import DEGREE, HARMLESS_CHANGE, constant_noise
from siq.inference.field_estimate import FieldEstimate, NoiseDiagnosis, NoiseFormula
from siq.inference.measurements import Measurements
from siq.inference.selection import (
    LinearProblem,
    all_coefficients,
    chosen_terms,
    critical_values,
    fit_significant,
    model_average,
    stacked_triangle,
)
from siq.numerics.integration import machine_code
from siq.numerics.randomness import positive
from siq.systems.diffusion import Diffusion
from siq.systems.formulas import compile_formulas

SHORT = 0.5  # mean number of jumps of a chain, of which a series of so many terms is exact
SERIES_TERMS, MAX_DOUBLINGS = 14, 40
NEARLY_THE_SAME = 0.02  # relative, of steps: what is off by so much in both directions is right in the mean
UNLIKELY, FAR_AWAY = 1e-9, 6.5  # numerical: of what else is possible; standard deviations, the same
EXPOSED = 1e-3  # numerical: of a step, that passes at least before it
FAR = 8.0  # standard deviations, beyond which a normal law has nothing
LEAST = 1e-300  # of a probability, so that it has a logarithm
LEAST_CELLS, MOST_CELLS = 80, 400  # numerical: of the range of a state
CELLS_PER_NOISE, FEWEST_PER_NOISE = 1.25, 0.6  # numerical: of a sensor's, to begin with, and at least
CELLS_PER_SPREAD = 6  # numerical: of what noise spreads it by in a step; most densities are right to 1 %
CELLS_IF_BLURRED = 3  # numerical: the least; enough behind a sensor (0.03 errors, of four double wells)
SLIGHT_NOISE = 1e-3  # numerical: of the least where states were recorded
BEYOND = 1.5  # spreads by which a state may have been outside of what was recorded
MUCH_FORGOTTEN = 0.3  # of Jh: a normal law has the variance to 1 % at 0.4, and to 3 to 5 % at 0.8
LONGEST_EXPOSURE = 1.001  # of a step: no two exposures overlap
MOST_PRODUCTS, DEARER = 2e9, 3  # numerical: of a filter along all samples, a second; of means three
NATURAL_GRID = 2001  # numerical: of the scale on which a sensor's noise is normal
MOST_STEPS = 24  # of different length: each takes a matrix
RATES = tuple(2.0 ** np.arange(-2, 5))  # of the noise of residuals, with which a search may begin
MOST_DENSITY_STEPS, FEW_HALVINGS = 15, 6  # numerical: from a start that is any good a few are enough
DENSITY_STEP = 0.02  # numerical: of a standard error, for differences of the likelihood
DENSITY_SETTLED = 1e-3  # numerical: twice the log-likelihood that is still to gain
SENSOR_SHARES = (0.45, 0.15, 0.05, 0.015, 0.005)  # of a sensor, in what moves a state from sample to sample


class TransitionDensity:
    """The law ``p(x, h | x₀)`` that one state has a time h later, of ``dx = f dt + √(εD) dW``.

    On N cells between reflecting ends the equation of Fokker and Planck,
    ``∂p/∂t = -∂(f p)/∂x + ½ ∂²(εD p)/∂x²``, is a Markov chain, with the fluxes that f and D have where they
    change little from cell to cell (Scharfetter and Gummel, IEEE Trans. Electron Devices 16 (1969) 64). Its
    matrix over h is that over a short time, squared again and again. All terms are positive, so that small
    probabilities are as accurate as large ones.

    Parameters
    ----------
    edges
        Of cells of one width, shape ``(N + 1,)``.
    drift, between, inside
        f and εD between cells, shape ``(N - 1,)``, and εD in their middles, ``(N,)``.
    """

    def __init__(self, edges: np.ndarray, drift: np.ndarray, between: np.ndarray, inside: np.ndarray) -> None:
        self.first, self.width = edges[0], edges[1] - edges[0]
        drop = 2 * drift * self.width / between
        with np.errstate(all="ignore"):  # of a trial f
            back = np.where(np.abs(drop) < 1e-8, 1 - drop / 2, drop / np.expm1(drop))
        rates = inside / (2 * self.width**2)
        self.up, self.down = rates[:-1] * (back + drop), rates[1:] * back  # to the next cell, and from it

    @staticmethod
    def distinct(h: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Means of steps that are nearly the same, and which of them each step is, shape ``(n,)``."""
        _, which = np.unique(np.round(np.log(h) / NEARLY_THE_SAME), return_inverse=True)
        return np.bincount(which, h) / np.bincount(which), which

    def _short_steps(self, steps: np.ndarray) -> Iterator[tuple[np.ndarray, int]]:
        """The chain's matrix ``(N, N)`` over a short step, and how often that is doubled to reach each step.

        None where f is too steep.
        """
        leaving = np.append(self.up, 0.0) + np.append(0.0, self.down)
        fastest = float(leaving.max())
        if not fastest * steps.max() < SHORT * 2**MAX_DOUBLINGS:
            return
        stays, up, down = 1 - leaving / fastest, self.up / fastest, self.down / fastest
        for one in steps:
            doublings = max(int(np.ceil(np.log2(fastest * one / SHORT))), 0)
            jumps = fastest * one / 2**doublings
            term = np.exp(-jumps) * np.eye(len(leaving))
            matrix = term.copy()
            for order in range(1, SERIES_TERMS):
                further = term * stays
                further[:, 1:] += term[:, :-1] * up
                further[:, :-1] += term[:, 1:] * down
                term = jumps / order * further
                matrix += term
            yield matrix, doublings

    def _matrices(self, steps: np.ndarray) -> Iterator[np.ndarray]:
        """The chain's matrix ``(N, N)`` over each step; none where f is too steep."""
        for matrix, doublings in self._short_steps(steps):
            for _ in range(doublings):
                matrix = matrix @ matrix
            yield matrix

    def _exposed(self, exposure: float) -> np.ndarray:
        """The matrix over an exposure, with mean and variance of the state within it: ``(3, N, N)``.

        Given where it begins and ends, from the first and the second moment of the integral, which over two
        times add up as ``A₁P₂ + P₁A₂`` and ``B₁P₂ + 2A₁A₂ + P₁B₂``; without any, where f is too steep.
        """
        for matrix, doublings in self._short_steps(np.array([exposure])):
            places = np.arange(len(matrix)) + 0.5
            middle = (places[:, None] + places) / 2
            first, second = middle * matrix, middle**2 * matrix
            for _ in range(doublings):
                second = (second @ matrix + 2 * first @ first + matrix @ second) / 4
                first, matrix = (first @ matrix + matrix @ first) / 2, matrix @ matrix
            mean = first / np.maximum(matrix, LEAST)
            spread = np.maximum(second / np.maximum(matrix, LEAST) - mean**2, 0.0)
            return np.stack([matrix, self.first + self.width * mean, self.width**2 * spread])
        return np.zeros((0, 0, 0))

    def _interpolated(
        self, of_matrix: Callable[[np.ndarray], np.ndarray], places: np.ndarray, h: np.ndarray
    ) -> np.ndarray:
        """A smooth function of the matrix at places in cells ``(2, n)``; NaN where f is too steep."""
        (steps, which), found = self.distinct(h), np.full(len(h), np.nan)
        for place, matrix in enumerate(self._matrices(steps)):
            rows = np.flatnonzero(which == place)
            found[rows] = map_coordinates(of_matrix(matrix), places[:, rows], order=3, mode="nearest")
        return found

    def log_density(self, x0: np.ndarray, xh: np.ndarray, h: np.ndarray) -> np.ndarray:
        """``ln p(xh, h | x0)`` of states within the edges, shape ``(n,)``; NaN where f is too steep."""
        places = (np.stack([x0, xh]) - self.first) / self.width - 0.5
        return self._interpolated(lambda matrix: np.log(np.maximum(matrix, LEAST) / self.width), places, h)

    def normal_scores(self, x0: np.ndarray, xh: np.ndarray, h: np.ndarray) -> np.ndarray:
        """``z = Φ⁻¹(P(x < xh | x0))``, independent and normal (Rosenblatt, Ann. Math. Stat. 1952)."""

        def scores(matrix: np.ndarray) -> np.ndarray:
            below, above = matrix.cumsum(axis=1)[:, :-1], matrix[:, ::-1].cumsum(axis=1)[:, -2::-1]
            low, high = (ndtri(np.clip(one, LEAST, 0.5)) for one in (below, above))
            return np.where(below < above, low, -high)

        places = (np.stack([x0, xh]) - self.first) / self.width - np.array([[0.5], [1.0]])
        return self._interpolated(scores, places, h)

    def foreseen(
        self, x0: np.ndarray, xh: np.ndarray, h: np.ndarray, begins: np.ndarray,
        shown: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]], *, exposure: float = 0.0,
        whole: bool = True,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
        """The same two of values that a sensor shows with normal noise, given all earlier ones of a record.

        A filter on the cells, which where a record `begins` knows its first value alone. The third is the
        mean of the state, once the later value is known, too. All are ``(n,)``, NaN where f is too steep; of
        scores that are not wanted, as they take longest, nothing is said. A value may be a mean over the time
        `exposure` before it; of a normal law, given where the state was at both of its ends. What is
        `shown` of states, of any shape, are the mean of a value and the deviation of a sensor.
        """
        steps, which = self.distinct(h)
        waiting = np.maximum(steps - exposure, EXPOSED * steps) if exposure else steps
        matrices, within = list(self._matrices(waiting)), self._exposed(exposure) if exposure else None
        if not matrices or (within is not None and not len(within)):
            return (np.full(len(h), np.nan),) * 3
        middles = self.first + self.width * (np.arange(len(matrices[0])) + 0.5)
        if within is None:  # the state itself, and not what it does on the way
            nothing = np.zeros((len(middles),) * 2)
            within = np.stack([np.eye(len(middles)), nothing + middles, nothing])
        mean, deviation = shown(within[1])
        logarithms, below, above, means = _filtered(
            x0, xh, which, begins, np.stack(matrices), middles, within[0], mean,
            np.sqrt(within[2] + deviation**2), whole,
        )  # fmt: skip
        low, high = (ndtri(np.clip(one, LEAST, 0.5)) for one in (below, above))
        return logarithms, np.where(below < above, low, -high), means


@machine_code
def _filtered(
    x0: np.ndarray, xh: np.ndarray, which: np.ndarray, begins: np.ndarray, matrices: np.ndarray,
    middles: np.ndarray, within: np.ndarray, shown: np.ndarray, deviation: np.ndarray, whole: bool,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Log-density of each measured value, probabilities of lower and of higher ones, and the state's mean.

    The state is carried on by one of the matrices, and then by the one `within` an exposure; what is shown,
    and its deviation, follow from where it was at both ends of that.
    """
    logarithms, below, above, means = np.zeros((4, len(xh)))
    count = len(middles)
    share, ahead = np.zeros(count), np.zeros(count)
    # First and last cells in which it ends with any chance.
    reached = np.zeros((len(matrices) + 1, count, 2), dtype=np.int64)
    for place in range(len(reached)):
        matrix = matrices[place] if place < len(matrices) else within
        for start in range(count):
            likely = np.flatnonzero(matrix[start] > UNLIKELY)
            if len(likely):
                reached[place, start] = likely[0], likely[-1] + 1
    for k in range(len(xh)):
        for first in range(2 if begins[k] else 1):
            value = x0[k] if begins[k] and not first else xh[k]
            if begins[k] and not first:
                ahead[:] = 1.0 / count
            else:
                ahead[:] = 0.0
                least = UNLIKELY * share.max()
                for start in range(count):
                    if share[start] > least:
                        low, high = reached[which[k], start]
                        ahead[low:high] += share[start] * matrices[which[k], start, low:high]
                below[k] = above[k] = 0.0
            share, least = np.zeros(count), UNLIKELY * ahead.max()
            for start in range(count):
                if ahead[start] < least:
                    continue
                for end in range(reached[-1, start, 0], reached[-1, start, 1]):
                    chance = ahead[start] * within[start, end]
                    away = (value - shown[start, end]) / deviation[start, end]
                    if whole:
                        higher = math.erfc(away / math.sqrt(2.0)) / 2 if abs(away) < FAR else (away < 0) * 1.0
                        below[k] += chance * (1 - higher)
                        above[k] += chance * higher
                    if abs(away) < FAR_AWAY:
                        share[end] += chance / deviation[start, end] * math.exp(-(away**2) / 2)
            density = share.sum()
            logarithms[k] = math.log(max(density, LEAST) / math.sqrt(2 * math.pi))
            share = share / density if density > LEAST else ahead @ within
        means[k] = (share * middles).sum()
    return logarithms, below, above, means


def _explained(scores: np.ndarray) -> float:
    """Twice what the likelihood gains by single scores ``(n, p)``, to second order: Rao's statistic."""
    return float((np.linalg.qr(scores / positive(np.linalg.norm(scores, axis=0)))[0].sum(axis=0) ** 2).sum())


class Transitions:
    """Pairs of one state, over coarse steps or behind a sensor, and the density that f and εD give to each.

    f has terms of its library. εD is a sum of shapes, those of a `NoiseFormula` or the one of a D that is
    known, with a strength each. Behind a noisy sensor, which an estimate knows by its diagnosis, the density
    is that of the second value given all of its record up to the first.

    Raises
    ------
    NumericalFailure
        Where there is no such density: of several states and angles, of steps that are not coarse without a
        noisy sensor, and of a D that nearly vanishes.
    """

    def __init__(self, found: FieldEstimate, pairs: SnapshotPairs) -> None:
        near = not found.flow.coarse and found.sensor_variance is None
        if found.library.dimension > 1 or found.library.angles or near:
            raise NumericalFailure("the density of what noise does between two samples is not worked out")
        self.found, self.pairs = found, pairs
        self.x0, self.xh, self.h = pairs.x0[:, 0], pairs.xh[:, 0], pairs.h
        self.begins = np.append(
            True, (pairs.recording[1:] != pairs.recording[:-1]) | (self.xh[:-1] != self.x0[1:])
        )
        noise, symbols, sensor = found.noise, found.library.symbols, found.sensor_variance
        self.sensor, self.exposure = np.zeros(0) if sensor is None else np.log(sensor), found.exposure or 0.0
        if self.exposure > LONGEST_EXPOSURE * self.h.min():
            raise NumericalFailure("exposures overlap")
        self._terms = [found.library.terms[k] for k in found.support[:, 1]]

        def shape(x: np.ndarray) -> np.ndarray:
            return found.diffusion.at(x.T)[:, 0, 0][None]

        functions = compile_formulas(self._terms, symbols)
        shapes = shape if noise is None else compile_formulas(list(noise.terms), symbols)
        inside = found.on_the_way(pairs)
        self.of_field, self.of_noise = functions(self.x0[None]), shapes(inside.T)
        self.strengths = noise.values if noise else found.noise_rate[0] / self.of_noise.mean(axis=1)
        # Within a step noise spreads the state by √(εD h), or less where f brings it back.
        forgotten = np.abs(found.dynamics.jacobian(inside)[:, 0, 0]) * self.h
        back, self.forgotten = 1 + 2 * forgotten, float(forgotten.mean())
        least, most = np.quantile(np.sqrt(self.strengths @ self.of_noise * self.h / back), [0.01, 0.99])
        low, high = min(self.x0.min(), self.xh.min()), max(self.x0.max(), self.xh.max())
        aside = min(float(most), (high - low) / 2) * BEYOND
        per_spread = CELLS_IF_BLURRED if self.filtered else CELLS_PER_SPREAD
        count = max(int((high - low + 2 * aside) / least * per_spread), LEAST_CELLS)
        if self.filtered:  # what blurs is known, and what cells do not resolve is blurred
            within = float(least) ** 2 * self.exposure / float(np.median(self.h)) / 12
            blur = np.sqrt(np.exp(self.sensor).sum() + within)
            count = min(max(count, int((high - low + 2 * aside) / blur * CELLS_PER_NOISE)), MOST_CELLS)
            reach = 2 * FAR_AWAY * max(float(most), float(blur)) * count / (high - low + 2 * aside)
            if len(self.h) * min(count, reach) ** 2 * (DEARER if self.exposure else 1) > MOST_PRODUCTS:
                raise NumericalFailure("there are too many samples to follow all that their states may be")
        if count * CELLS_IF_BLURRED > MOST_CELLS * per_spread:
            raise NumericalFailure("noise moves some states by a small part of what it moves others by")
        self.edges = np.linspace(low - aside, high + aside, min(count, MOST_CELLS) + 1)
        inner, middle = self.edges[None, 1:-1], (self.edges[None, 1:] + self.edges[None, :-1]) / 2
        self._drift, self._between, self._inside = functions(inner), shapes(inner), shapes(middle)

    def _density(self, values: np.ndarray, strengths: np.ndarray) -> TransitionDensity:
        """With f and εD of some values; beyond the recorded states εD does not vanish."""
        least = SLIGHT_NOISE * float((strengths @ self.of_noise).min())
        between, inside = (np.maximum(strengths @ one, least) for one in (self._between, self._inside))
        return TransitionDensity(self.edges, values @ self._drift, between, inside)

    @property
    def filtered(self) -> bool:
        """Whether samples do not show the states themselves."""
        return bool(len(self.sensor)) or self.exposure > 0

    def _foreseen(
        self, density: TransitionDensity, sensor: np.ndarray, *, whole: bool = True
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """By the sensor's noise, from the logarithm of its variance; cells tell none that is too small.

        Of a law V(x) the noise has the skewness of counts, of which the third cumulant is ``V V'``: it is
        nearly normal in ``t = ∫ V^(-1/3) dx``, which of counts is their power of 2/3 (Anscombe 1953).
        """
        size, least = float(np.exp(sensor[0] / 2)) if len(sensor) else 0.0, FEWEST_PER_NOISE * density.width
        if (law := None if self.found.diagnosis is None else self.found.diagnosis.sensor_law) is None:

            def plain(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
                return x, np.full(x.shape, size if self.exposure else max(size, least))

            ends = self.x0, self.xh, self.h, self.begins
            return density.foreseen(*ends, plain, exposure=self.exposure, whole=whole)
        grid = np.linspace(self.edges[0], self.edges[-1], NATURAL_GRID)
        variance = Measurements.relative_variance(law, grid[:, None])[:, 0]
        slope, bent = np.cbrt(1 / variance), np.gradient(variance, grid)
        natural = np.append(0.0, np.cumsum((slope[1:] + slope[:-1]) / 2 * np.diff(grid)))

        def shown(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            mean = natural - size**2 * bent * slope / 6
            return np.interp(x, grid, mean), np.maximum(size * np.interp(x, grid, variance ** (1 / 6)), least)

        first, second = (np.interp(one, grid, natural) for one in (self.x0, self.xh))
        known = density.foreseen(first, second, self.h, self.begins, shown, whole=whole)
        return known[0] + np.log(np.interp(self.xh, grid, slope)), *known[1:]

    def log_densities(self, values: np.ndarray, strengths: np.ndarray, sensor: np.ndarray) -> np.ndarray:
        """Of each pair; minus infinity where εD is not positive, or f too steep."""
        if not (strengths @ self.of_noise).min() > 0:
            return np.full(len(self.h), -np.inf)
        density = self._density(values, strengths)
        if self.filtered:
            found = self._foreseen(density, sensor, whole=False)[0]
        else:
            found = density.log_density(self.x0, self.xh, self.h)
        return np.where(np.isfinite(found), found, -np.inf)

    @property
    def log_likelihood(self) -> float:
        """Of the estimate as it is."""
        return float(self.log_densities(self.found.values, self.strengths, self.sensor).sum())

    def normal_increments(self) -> np.ndarray:
        """Normal scores times √(εD h): residuals as of a short step, shape ``(n, 1)``."""
        density = self._density(self.found.values, self.strengths)
        if self.filtered:
            scores = self._foreseen(density, self.sensor)[1]
        else:
            scores = density.normal_scores(self.x0, self.xh, self.h)
        if not np.isfinite(scores).all():
            raise NumericalFailure("f is too steep for so long steps; sample more often")
        return np.asarray(scores * np.sqrt(self.strengths @ self.of_noise * self.h))[:, None]

    def states(self) -> np.ndarray:
        """Means of the states at the ends of pairs, as a noisy sensor shows them, shape ``(n,)``."""
        return self._foreseen(self._density(self.found.values, self.strengths), self.sensor)[2]

    @cached_property
    def start(self) -> tuple[np.ndarray, np.ndarray]:
        """Parameters of f, of εD, and of the sensor; and axes for `scored`, as of short steps."""
        p, k, m = len(self.of_field), len(self.strengths), len(self.sensor)
        rate, triangle = float((self.strengths @ self.of_noise).mean()), np.eye(p + k + m)
        triangle[:p, :p] = np.linalg.qr((self.of_field * np.sqrt(self.h / rate)).T)[1]
        triangle[p : p + k, p : p + k] = np.linalg.qr(self.of_noise.T / (np.sqrt(2) * rate))[1]
        triangle[p + k :, p + k :] *= np.sqrt(len(self.h) / 2)
        return np.concatenate([self.found.values, self.strengths, self.sensor]), np.linalg.inv(triangle)

    def densities(self, place: np.ndarray) -> np.ndarray:
        """Logarithms, of each pair, at some parameters."""
        p = len(self.of_field)
        return self.log_densities(*np.split(place, [p, p + len(self.strengths)]))

    def scored(self, place: np.ndarray, axes: np.ndarray, now: np.ndarray) -> np.ndarray:
        """Derivatives of the densities `now` along axes ``(p, p)`` of parameters, shape ``(n, p)``.

        Along each a step of one is about a standard error, and they are independent, so that differences are
        accurate where functions are nearly alike.
        """
        with np.errstate(invalid="ignore"):
            ends = [self.densities(place + DENSITY_STEP * axis) for axis in axes.T]
            return np.asarray((np.stack(ends, axis=1) - now[:, None]) / DENSITY_STEP)

    def fitted(self) -> tuple[FieldEstimate, np.ndarray]:
        """The terms of f and of εD with the values of the largest likelihood.

        By steps of the sum of squares of single scores, halved until each gains (Berndt et al., Ann. Econ.
        Soc. Meas. 3 (1974) 653). And these scores ``(n, p + k)``, by values of f and strengths of εD; of a
        noisy sensor by the logarithm of its variance, too. It is a NumericalFailure where steps are of many
        lengths, or the search does not settle.
        """
        if len(TransitionDensity.distinct(self.h)[0]) > MOST_STEPS:
            raise NumericalFailure("samples follow each other in steps of too many lengths")
        found, p, k = self.found, len(self.found.support), len(self.strengths)
        (at, axes), symbols = self.start, found.library.symbols
        starts = [at]
        if not found.flow.by_density and found.diffusion.constant:
            # Of a state at rest 2f/εD is the slope of its ln p (Hyvärinen, JMLR 6 (2005) 695).
            rate = float((self.strengths @ self.of_noise).mean())
            slopes = compile_formulas([term.diff(symbols[0]) for term in self._terms], symbols)(self.x0[None])
            functions = axes[:p, :p].T @ self.of_field
            rest = np.linalg.solve(functions @ functions.T, axes[:p, :p].T @ slopes.sum(axis=1))
            slope = -axes[:p, :p] @ rest * rate / 2
            starts += [np.concatenate([one * slope, one * self.strengths, self.sensor]) for one in RATES]
        now, at = max(((self.densities(one), one) for one in starts), key=lambda one: one[0].sum())
        gain = np.inf
        for _ in range(MOST_DENSITY_STEPS):
            along = self.scored(at, axes, now)
            if not np.isfinite(along).all() or np.linalg.matrix_rank(along) < len(at):
                gain = np.inf
                break
            scores, root = along @ np.linalg.inv(axes), np.linalg.inv(np.linalg.qr(along, mode="r"))
            gain, axes = _explained(along), axes @ root
            step = axes @ (root.T @ along.sum(axis=0))
            for _ in range(FEW_HALVINGS if gain > DENSITY_SETTLED else 0):
                if (then := self.densities(at + step)).sum() > now.sum():
                    at, now = at + step, then
                    break
                step = step / 2
            else:
                break
        if not gain < 1.0:
            raise NumericalFailure("f and D of so long steps are not found; sample more often")
        (values, strengths, sensor), covariance = np.split(at, [p, p + k]), axes @ axes.T * self.pairs.copies
        flow, of_noise = replace(found.flow, coarse=True, by_density=True), covariance[p : p + k, p : p + k]
        found = found.with_values(found.support, values, covariance=covariance[:p, :p], flow=flow)
        if found.diagnosis is not None and len(sensor):
            deviation = np.exp(sensor / 2)
            error = deviation / 2 * np.sqrt(np.diag(covariance)[p + k :])
            measured = replace(found.diagnosis, measurement=deviation, measurement_error=error)
            found = replace(found, diagnosis=measured)
        if found.noise is not None:
            formula = replace(found.noise, values=strengths, covariance=of_noise)
            return found.with_formula(formula, found.on_the_way(self.pairs)), scores
        size, known = self.of_noise.mean(), None
        noise_rate = strengths[:, None] * size
        if found.diffusion.constant:
            known = replace(constant_noise(symbols, noise_rate, samples=1.0), covariance=of_noise * size**2)
        return replace(found, noise_rate=noise_rate, constant_noise=known), scores

    def fitted_with_formula(self, *, false_terms: float) -> tuple[FieldEstimate, np.ndarray] | None:
        """All terms of f with those of a D(x), and the scores; None where a constant D can be held.

        By Rao's test of the strengths of the other shapes of εD; see `_DiffusionLikelihood.selected`.
        """
        found, library, x0 = self.found, self.found.library, self.found.on_the_way(self.pairs)
        terms = tuple(term for _, term in library.functions(library.symbols, DEGREE, library.angles))
        places, values = np.zeros((len(terms), 2), dtype=int), np.zeros(len(terms))
        values[0] = found.noise_rate[0, 0]
        formula = NoiseFormula(library.symbols, places, terms, values, np.eye(len(terms)), 1.0)
        everything = all_coefficients([0], library.size)
        found = found.with_values(everything, found.coefficients[:, 0]).with_formula(formula, x0)
        whole = Transitions(found, self.pairs)
        place, axes = whole.start
        now = whole.densities(place)
        # Once more, along axes that are independent: those of short steps are not, and differences inexact.
        axes = axes @ np.linalg.pinv(np.linalg.qr(whole.scored(place, axes, now), mode="r"))
        scores = whole.scored(place, axes, now) @ np.linalg.pinv(axes)
        statistic = _explained(scores)
        statistic -= _explained(np.delete(scores, library.size + np.arange(1, len(terms)), axis=1))
        probability = float(scipy.special.chdtrc(len(terms) - 1, statistic))
        if probability >= false_terms:
            return None
        found, scores = whole.fitted()
        assert found.noise is not None
        formula, rates = replace(found.noise, probability=probability), found.noise_rate_at(x0)
        if rates.std() < HARMLESS_CHANGE * rates.mean():
            return None
        kept, values = formula.eliminated(float(-scipy.special.ndtri(false_terms / (2 * len(terms)))))
        if len(kept) == len(terms):
            return found.with_formula(formula, x0), scores
        covariance, chosen = formula.covariance[np.ix_(kept, kept)], tuple(terms[k] for k in kept)
        formula = replace(formula, places=places[kept], terms=chosen, values=values, covariance=covariance)
        return Transitions(found.with_formula(formula, x0), self.pairs).fitted()

    def identified(
        self, whole: tuple[FieldEstimate, np.ndarray] | None = None, *, false_terms: float
    ) -> FieldEstimate:
        """The significant terms of f, by the single scores of a fit of all terms, or of this one of them."""
        found, scores = whole or self.fitted()
        library, samples = found.library, len(self.pairs) / self.pairs.copies
        # Less what D explains of them; errors are those of n residuals of variance one.
        of_field, others = np.split(scores, [library.size], axis=1)
        basis = np.linalg.qr(others)[0]
        columns = of_field - basis @ (basis.T @ of_field)
        triangle = stacked_triangle([np.column_stack([columns, columns @ found.values])])
        triangle[-1, -1] = np.sqrt(max(samples - library.size, 1.0))
        critical = critical_values(library, false_terms=false_terms)
        problem = LinearProblem.of_components(triangle, samples=samples, critical=critical)[0]

        def fit(support: np.ndarray) -> tuple[FieldEstimate, np.ndarray]:
            values = problem.solve(problem.places(support))[support[:, 1]]
            again = Transitions(found.with_values(support, values), self.pairs).fitted()[0]
            return again, np.abs(again.values) / np.sqrt(np.diag(again.covariance)) / critical[support[:, 1]]

        again, support = fit_significant(fit, chosen_terms([problem], library))
        return replace(again, alternatives=model_average([problem], support, library))

    def identified_behind_sensor(
        self, *, exposure: float | None = None, law: np.ndarray | None = None, false_terms: float
    ) -> FieldEstimate | None:
        """f, D and the noise of a sensor, from an estimate without that; None where none gains.

        At whatever share of what moves the state from sample to sample the search begins. Of means over an
        exposure there is an estimate without such noise, too. The noise may follow a law of what is measured,
        as in `siq.inference.measurements.Measurements`, from an estimate with one that does not. The
        `sensor_evidence` of the diagnosis is Schwarz's, but for the sensor. Without such a law it is a
        NumericalFailure where little is forgotten within a step: a filter that supposes a normal law does.
        """
        if self.forgotten < MUCH_FORGOTTEN and law is None:
            raise NumericalFailure("steps are so short that the law of what noise does is nearly normal")
        found, pairs, rate = self.found, self.pairs, self.found.noise_rate
        everything = all_coefficients([0], found.library.size)
        base = replace(
            found.with_values(everything, found.coefficients[:, 0]),
            noise=None, constant_noise=None, diffusion=Diffusion.identity(1),
        )  # fmt: skip
        moved, known = rate[0] * float(np.median(pairs.h)), found.sensor_variance
        tried = []
        for share in (0.0, *SENSOR_SHARES) if known is None else (0.0,):
            deviation = np.sqrt(share * moved if known is None else known)
            seen = NoiseDiagnosis(
                "process", float(rate[0, 0]), np.eye(1), 0.0, 0.0, deviation,
                exposure=exposure, sensor_law=law,
            )  # fmt: skip
            for kept in (1.0, 1 - share) if share else (1.0,):
                start = replace(base, diagnosis=seen, noise_rate=kept * rate)
                tried.append((Transitions(start, pairs).log_likelihood, start))
        best = max(tried, key=lambda one: one[0])[1]
        if best.sensor_variance is None and exposure is None:
            return None
        try:
            whole = Transitions(best, pairs).fitted()
        except NumericalFailure:
            if exposure is None or best.sensor_variance is None:
                raise
            whole = Transitions(tried[0][1], pairs).fitted()
        constant = Transitions(whole[0], pairs)
        whole = constant.fitted_with_formula(false_terms=false_terms) or whole
        behind = constant.identified(whole, false_terms=false_terms)
        assert behind.diagnosis is not None
        other = Transitions(behind, pairs)
        further = len(behind.support) + len(other.strengths) - len(found.support) - len(self.strengths)
        evidence = 2 * (other.log_likelihood - self.log_likelihood) - further * np.log(len(pairs))
        return replace(behind, diagnosis=replace(behind.diagnosis, sensor_evidence=float(evidence)))
