"""Correlation over lags: from which lag on a record is Markovian, and what kinds of noise it shows.

Statistics of lags need samples one after the other, a step apart; they come from whole stretches alone (see
`siq.data.stationarity.even_stretches`). A state that white forces drive moves by independent increments, so
that its mean square displacement grows as ``M(k) = σ²h k`` over k steps. It grows otherwise where

- the sensor errs: ``M(k) = σ²h k + 2R``;
- the clock errs, by u steps: ``M(k) = σ²h E|k + √2 u ξ|`` with a normal ξ, which tends to ``σ²h k``. Steps
  of all lengths make tails, by which a clock is told from the sums of what follows;
- a sample is the mean over an exposure of u steps: ``M(k) = σ²h (k - u/3)`` for ``k ≥ u``, and
  ``σ²h (k²/u - k³/3u²)`` before;
- the forces are an Ornstein–Uhlenbeck process of the memory u, or the sensor is a low-pass filter of that
  time: ``M(k) = σ²h (k - u (1 - e^(-k/u)))``. The two cannot be told apart.

Covariances of increments are ``C(k) = (M(k+1) - 2M(k) + M(k-1))/2``. Each kind is fitted to those of the
residuals, by generalised least squares, and the best is named where the others are clearly worse.

Residuals are what f leaves of increments. Where noise is correlated, the mean of an increment given x(t) is
not that of the system. A sample L steps earlier does not know the noise once L is longer than its memory, so
the mean is sought as a polynomial whose coefficients make what is left uncorrelated with polynomials of the
state *L steps earlier* (instrumental variables), ``Σ φ(x(t-L)) (x(t+h) - x(t) - φ(x(t))ᵀξ) = 0``. The Markov
lag is the shortest L at which residuals L steps apart are not told from uncorrelated.

The *noise floor* is a first look without any f: within a short window a motion without noise is nearly a
polynomial of time, and what is left besides polynomials of low degree is process noise, which adds up from
sample to sample, or measurement noise, which is new in each. Both variances follow by maximum likelihood.

A column whose values are all multiples of one *resolution step*, 0.001 or that of a digitiser, was rounded to
it. Each value is then off by up to half a step, with a standard deviation of step/√12.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import scipy.linalg
import scipy.optimize
import scipy.special

from siq.data.recordings import Recordings
from siq.data.stationarity import (
    STEP_TOLERANCE,
    Stretches,
    even_stretches,
    lagged_covariances,
    long_run_covariance,
    relaxation_samples,
    runs_of,
    same_stretch,
    usual_step,
)
from siq.numerics.randomness import positive

Kind = Literal[
    "none", "white", "sensor", "clock", "blur", "coloured", "either", "memory", "hidden", "unknown"
]  # fmt: skip

FALSE_ALARM_RATE = 1e-3  # one record in a thousand of white noise is taken for one with a memory
NEGLIGIBLE_CORRELATION = 0.005  # twice that, one per cent, is what it adds to the strength of the noise
FIRST_LAGS = 8  # looked at for a first sign; a memory that shows later shows there as well
STANDARD_ERRORS = 2.0  # the usual ones of 95 %
STANDARD_ERRORS_LATER = 3.0  # at each of a few longer lags, so that all are kept about as often
LATER_LAGS = (1.25, 1.5, 2.0)  # times the lag: correlations that swing do not stay at zero
UNSEEN_CORRELATION = 0.1  # the mean is off by no larger share where less than that could remain unseen
SHAPE_DEPARTURE = 0.05  # of a correlation: a fifth of what an exposure of a whole step makes
WEAK_INSTRUMENT = 0.1  # a correlation: what the earlier state tells no more of is left out of the mean
LONGEST_LAG = 2.0  # relaxation times: a state so much earlier tells e^-2 of the present one
LARGEST_DEGREE, MOST_FUNCTIONS = 5, 36  # numerical: a polynomial that a second suffices for
STEPS_PER_FUNCTION = 50  # fewer tell nothing of correlations
MOST_SAMPLES = 400_000  # looked at: a correlation is then known to 0.002
LAG_GROWTH = 1.2  # of the lags that are tried, about as exactly as they are known
NOISE_FREE_RESIDUAL = 1e-3  # of the rms step: less is left where nothing but the integrator erred
MIN_CHI2_GAIN = 6.0  # the other is e³ = 20 times less likely, or a further number worth its while
TAILS_KNOWN = 0.1  # of those of normal noise, since a D(x) makes some, too: a choice
MEMORIES_TRIED = 40  # before the best is refined
EIGENVALUE_FLOOR = 1e-9  # of the largest, so that a covariance can be inverted


@dataclass(frozen=True)
class MarkovLag:
    """How long a record remembers, and why.

    Its kind is ``none``: no noise. ``white``: white process noise. ``sensor``: measurement noise, new in each
    sample. ``clock``: each was taken at another time than it is said. ``blur``: each is a mean over an
    exposure. ``coloured``: the process noise has a memory, or the sensor is slow. ``either`` of these two.
    ``memory``: it remembers in another way, as by an oscillation of its own. ``hidden``: it remembers longer
    than it takes to relax, as where a state is not recorded. ``unknown``: too few samples, or uneven ones.
    """

    kind: Kind
    lag: int | None  #: from so many steps on it is Markovian: 0 of white noise, None where none was found
    step: float  #: the usual time between samples
    memory: float  #: exposure, memory of the forces, or error of the clock, in the unit of time; else 0
    relaxation: float  #: the shortest time in which the state relaxes; NaN where nothing is known of it
    lags: np.ndarray  #: (K,), in steps
    correlations: np.ndarray  #: (K, d): of residuals so many steps apart, for each state
    errors: np.ndarray  #: (K, d): standard errors of these, were there no correlation
    sensor: np.ndarray  #: (d,): standard deviation of the sensor's error, where it follows; else 0

    @property
    def remembers(self) -> bool:
        """Whether pairs of neighbouring samples are misleading, and pairs seen from earlier are not."""
        return self.kind in ("blur", "coloured", "either", "memory") and self.lag is not None

    @property
    def may_hop(self) -> bool:
        """Whether it may hop between states; what relaxes without noise does not."""
        return self.kind not in ("none", "unknown")

    @property
    def time(self) -> float:
        """The lag in the unit of time; NaN where there is none."""
        return float("nan") if self.lag is None else self.lag * self.step


class _Residuals(NamedTuple):
    """What is left of increments whose mean was found from states some steps earlier."""

    rest: np.ndarray  # (n, d)
    number: np.ndarray  # (n,): the stretch of each
    inverse: np.ndarray  # (q, q): of the mean of φ(x(t-L)) φ(x(t))ᵀ

    @property
    def size(self) -> int:
        return int((self.number >= 0).sum())

    def correlations(self, most: int) -> tuple[np.ndarray, np.ndarray]:
        """Correlations at lags 1 ... most and their standard errors, each of shape ``(most, d)``."""
        own = np.einsum("kii->ki", lagged_covariances(self.rest, self.number, most))
        values = own[1:] / positive(own[0])
        # Bartlett: correlations at shorter lags make all others uncertain.
        spread = 1 + 2 * np.cumsum(np.vstack([np.zeros_like(values[:1]), values[:-1] ** 2]), axis=0)
        return values, np.sqrt(spread * self.kurtosis(most) / self.size)

    def kurtosis(self, lag: int) -> np.ndarray:
        """Mean of r²(t) r²(t+lag) over that of r² squared: 1 where the strength is the same; 3 at lag 0."""
        squares, both = self.rest**2, same_stretch(self.number, lag)
        mean = squares[self.number >= 0].mean(axis=0) ** 2
        if both.sum() < STEPS_PER_FUNCTION:
            return np.ones(squares.shape[1])
        return np.maximum((squares[: len(both)] * squares[lag:])[both].mean(axis=0) / positive(mean), 1.0)


class _Increments(NamedTuple):
    """Increments, polynomials of the states where they begin, and their stretches."""

    functions: np.ndarray  # (n, q), orthonormal in the mean
    values: np.ndarray  # (n, d)
    stretches: Stretches
    size: np.ndarray  # (d,): root mean square
    root: np.ndarray  # (n, 1): of the time of each step over the usual one
    relaxation: float

    def residuals(self, lag: int) -> _Residuals | None:
        """What is left where the mean is found from states `lag` steps earlier; None of too few samples."""
        number, both = self.stretches.number, same_stretch(self.stretches.number, lag)
        if both.sum() < STEPS_PER_FUNCTION * self.functions.shape[1]:
            return None
        earlier, now = self.functions[: len(both)] * both[:, None], self.functions[lag:]
        moved = self.values[lag:]
        inverse = np.linalg.pinv(earlier.T @ now / both.sum(), rcond=WEAK_INSTRUMENT)
        coefficients = inverse @ (earlier.T @ moved) / both.sum()
        rest = np.zeros_like(self.values)
        rest[lag:] = (moved - now @ coefficients) * both[:, None]
        kept = np.full(len(number), -1)
        kept[lag:][both] = number[lag:][both]
        return _Residuals(rest, kept, inverse)

    def forgotten(self, seen: _Residuals, lag: int) -> bool:
        """Whether residuals so many steps apart, and farther, are not told from uncorrelated.

        The error of the mean that was found makes them uncertain, too: by the covariance of residuals with
        later states.
        """
        lags = [lag, *(int(np.ceil(lag * times)) for times in LATER_LAGS)]
        covariances = lagged_covariances(seen.rest, seen.number, lags[-1])
        run = np.maximum(np.diag(long_run_covariance(covariances, lag)), 0.0)
        size = np.diag(covariances[0])
        values, errors = seen.correlations(lags[-1])
        for place, one in enumerate(lags):
            count = len(seen.rest) - one
            carried = seen.rest[:count].T @ self.functions[one:] / seen.size @ seen.inverse
            further = (carried**2).sum(axis=1) * run / seen.size / positive(size**2)
            error = np.sqrt(errors[one - 1] ** 2 + further)
            limit = STANDARD_ERRORS if place == 0 else STANDARD_ERRORS_LATER
            apart, unseen = (
                np.abs(values[one - 1]) > limit * error,
                STANDARD_ERRORS * error > UNSEEN_CORRELATION,
            )
            if (apart | unseen).any():
                return False
        return True


def markov_lag(recordings: Recordings, *, angles: Mapping[str, Sequence[float]] | None = None) -> MarkovLag:
    """Find the lag from which on recordings are Markovian; evenly spaced stretches of them are looked at.

    Where samples are uneven throughout, increments over the root of their time are, and lags count steps. The
    mean of an increment has the period of states that are angles, each given with both ends of a period.
    """
    d, stretches = len(recordings.names), even_stretches(recordings)
    step, sensor = stretches.step, np.zeros(d)
    problem = _increments(recordings, stretches, angles or {})
    first = None if problem is None else problem.residuals(0)
    if problem is None or first is None:
        nothing, none = np.zeros((0, d)), np.zeros(0, dtype=int)
        return MarkovLag("unknown", None, step, 0.0, float("nan"), none, nothing, nothing, sensor)
    relaxation = problem.relaxation

    def told(kind: Kind, lag: int | None, seen: _Residuals, most: int, memory: float = 0.0) -> MarkovLag:
        lags = np.arange(1, most + 1)
        return MarkovLag(kind, lag, step, memory, relaxation, lags, *seen.correlations(most), sensor)

    left = np.diag(lagged_covariances(first.rest, first.number, 0)[0])
    if (left <= NOISE_FREE_RESIDUAL**2 * problem.size**2).all():
        return told("none", 0, first, FIRST_LAGS)
    # Of a motion without noise uneven steps leave what is of the next order in their time: half the rate
    # times the spread of the steps, which is at most half of one.
    uneven = float(np.ptp(problem.root)) > 0
    if uneven and not (left > (step / relaxation / 4) ** 2 * problem.size**2).all():
        return told("unknown", None, first, FIRST_LAGS)
    if not _significant(*first.correlations(FIRST_LAGS)).any():
        return told("white", 0, first, FIRST_LAGS)
    lag = 1
    while (seen := problem.residuals(lag)) is not None:
        if lag * step > LONGEST_LAG * relaxation or problem.forgotten(seen, lag):
            break
        lag = max(lag + 1, round(lag * LAG_GROWTH))
    if seen is None or lag * step > LONGEST_LAG * relaxation:
        return told("hidden", None, seen or first, 2 * lag)
    # The kind of each state that remembers; that of the longest memory stands for the record.
    most = max(2 * lag, FIRST_LAGS)
    own = np.einsum("kii->ki", lagged_covariances(seen.rest, seen.number, most))
    marked = np.flatnonzero(_significant(*seen.correlations(FIRST_LAGS)))
    counts, tails = seen.size / seen.kurtosis(lag + 1), seen.kurtosis(0) / 3
    fits = [_fitted_shape(own[:, at], counts[at], seen=lag, tails=tails[at]) for at in marked]
    longest = max(fits, key=lambda fit: fit.memory, default=None)
    if longest is None or longest.shape == "white":
        return told("white", 0, seen, most)
    if longest.departure > max(SHAPE_DEPARTURE, 4 * float(seen.correlations(most)[1][0].max())):
        return told("memory", lag, seen, most)
    sensor[marked] = np.sqrt([fit.sensor for fit in fits]) / (1 / problem.root).mean()
    return told(longest.shape, 1 if longest.memory == 0 else lag, seen, most, longest.memory * step)


def _increments(
    recordings: Recordings, stretches: Stretches, angles: Mapping[str, Sequence[float]]
) -> _Increments | None:
    most = min(len(stretches.number), MOST_SAMPLES)
    number = stretches.number[:most]
    known = number >= 0
    values = recordings.values[: most + 1]
    scale = values.std(axis=0)
    if not known.any() or not (scale > 0).all():
        return None
    columns = list(((recordings.values - values.mean(axis=0)) / scale).T)
    for name, (low, high) in angles.items():  # its cosine and sine, whose monomials are its Fourier series
        place = recordings.names.index(name)
        turns = 2 * np.pi * recordings.values[:, place] / (float(high) - float(low))
        columns[place] = np.cos(turns)
        columns.append(np.sin(turns))
    scaled, d = np.stack(columns, axis=1)[: len(number)], len(columns)
    # Monomials of the highest degree that leaves few enough of them.
    degree = max(
        (k for k in range(1, LARGEST_DEGREE + 1) if scipy.special.comb(d + k, k) <= MOST_FUNCTIONS), default=1
    )
    chosen = [
        list(places)
        for total in range(degree + 1)
        for places in itertools.combinations_with_replacement(range(d), total)
    ]
    if known.sum() < STEPS_PER_FUNCTION * len(chosen):
        return None
    functions = np.stack([scaled[:, places].prod(axis=1) for places in chosen], axis=1)
    # Of a time h, √h f and √h φ(x): so the strength of what is left is that of white noise, whatever h.
    root = np.sqrt(np.where(known, np.diff(recordings.t[: most + 1]) / stretches.step, 1.0))[:, None]
    root[np.abs(root - 1) <= STEP_TOLERANCE] = 1.0
    functions *= root
    eigenvalues, vectors = np.linalg.eigh(functions[known].T @ functions[known] / known.sum())
    kept = eigenvalues > 1e-10 * eigenvalues[-1]
    increments = np.where(known[:, None], np.diff(values, axis=0) / root, 0.0)
    runs = runs_of(recordings, bridged=True)
    times = [relaxation_samples(column, runs, noisy=True) for column in columns]
    return _Increments(
        functions @ (vectors[:, kept] / np.sqrt(eigenvalues[kept])), increments,
        Stretches(number, stretches.step), np.sqrt((increments[known] ** 2).mean(axis=0)), root,
        min((time for time in times if time is not None), default=float("nan")) * usual_step(recordings),
    )  # fmt: skip


def _significant(values: np.ndarray, errors: np.ndarray) -> np.ndarray:
    """Which states have residuals that are correlated, and not only a little: a mask ``(d,)``."""
    chosen = FALSE_ALARM_RATE / values.shape[1] / 2  # for two tests: of neighbours, and of all together
    all_limit, first_limit = scipy.special.chdtri(len(values), chosen), scipy.special.chdtri(1, chosen)
    squares = (values / errors) ** 2
    seen = (squares.sum(axis=0) > all_limit) | (squares[0] > first_limit)
    return np.asarray(seen & (np.abs(values).max(axis=0) > NEGLIGIBLE_CORRELATION))


class _Shape(NamedTuple):
    """The kind of noise that fits covariances of residuals over lags."""

    shape: Kind  # ``either`` where an exposure fits about as well as forces with a memory
    memory: float  # exposure, memory, or error of the clock, in steps; 0 of white noise and of sensor noise
    sensor: float  # variance of the sensor's error
    misfit: float  # χ² of what is left, and ...
    freedom: int  # ... the number that it has in the mean where the kind is right
    departure: float  # the largest difference of a correlation from that of the kind

    @property
    def cost(self) -> float:
        """What is left, and what each further number has to explain to be worth it."""
        return self.misfit - MIN_CHI2_GAIN * self.freedom


def _displacement(kind: Kind, lags: np.ndarray, u: float) -> np.ndarray:
    """M(k)/σ²h of means over an exposure, by a clock with errors, or of forces with a memory, of u steps."""
    k = np.abs(np.asarray(lags, dtype=float))
    if u <= 0:
        return k
    if kind == "clock":  # the mean of a folded normal distribution
        folded = 2 * u / np.sqrt(np.pi) * np.exp(-((k / (2 * u)) ** 2)) + k * scipy.special.erf(k / (2 * u))
        return np.where(k > 0, folded, 0.0)
    if kind == "blur":
        return np.where(k >= u, k - u / 3, k**2 / u - k**3 / (3 * u**2))
    return k + u * np.expm1(-k / u)


def _increment_covariances(displacement: np.ndarray) -> np.ndarray:
    """C(k), k = 0 ... K, from M(0) ... M(K + 1)."""
    before = np.concatenate([displacement[1:2], displacement[:-2]])
    return np.asarray((displacement[1:] - 2 * displacement[:-1] + before) / 2)


def _fitted_shape(covariances: np.ndarray, count: float, *, seen: int, tails: float) -> _Shape:
    """The simplest kind of noise that explains covariances of `count` residuals 0 ... K steps apart.

    From the lag `seen` on none is told from zero. By Bartlett's formula the covariances have themselves the
    covariance ``Σ_m (C_m C_(m+j-k) + C_(m+j) C_(m-k)) / n``. Of `tails`, the fourth moment of residuals over
    that of normal ones, a clock makes ``(1 + 2u²)/E²|1 + √2 u ξ|``.
    """
    size, lags = len(covariances), np.arange(len(covariances) + 1)
    known = np.where(np.arange(size) <= seen, covariances, 0.0)
    reach = 3 * size
    even = np.zeros(2 * reach + 1)
    even[reach : reach + size], even[reach - size + 1 : reach + 1] = known, known[::-1]
    # Σ_m C_m C_(m+j-k) depends on j-k, Σ_m C_(m+j) C_(m-k) on j+k: correlations of C with itself.
    auto = np.correlate(even, even, mode="full")[len(even) - 1 :]
    j = np.arange(size)
    eigenvalues, vectors = np.linalg.eigh(
        (auto[np.abs(j[:, None] - j[None])] + auto[j[:, None] + j[None]]) / count
    )
    eigenvalues = np.maximum(eigenvalues, EIGENVALUE_FLOOR * eigenvalues.max())
    root = np.asarray((vectors / np.sqrt(eigenvalues)) @ vectors.T)
    goal = root @ covariances
    of_sensor = _increment_covariances(np.where(lags > 0, 2.0, 0.0))

    def fitted(kind: Kind, memory: float, sensor: bool) -> _Shape:
        parts = np.stack([_increment_covariances(_displacement(kind, lags, memory)), of_sensor][: 1 + sensor])
        design = (root @ parts[:, :, None])[:, :, 0].T
        scale = np.linalg.norm(design, axis=0)
        values, left = scipy.optimize.nnls(design / scale, goal)
        values = values / scale
        departure = float(np.abs(covariances - values @ parts).max() / covariances[0])
        freedom = size - 1 - sensor - (memory > 0)
        return _Shape(kind, memory, float(values[1:].sum()), float(left**2), freedom, departure)

    def best(kind: Kind, sensor: bool) -> _Shape:
        tried = np.geomspace(0.1, 1.5 * max(seen, 1), MEMORIES_TRIED)
        place = int(np.argmin([fitted(kind, u, sensor).misfit for u in tried]))
        found = scipy.optimize.minimize_scalar(
            lambda u: fitted(kind, u, sensor).misfit, method="bounded",
            bounds=(tried[max(place - 1, 0)], tried[min(place + 1, MEMORIES_TRIED - 1)]),
        )  # fmt: skip
        return fitted(kind, float(found.x), sensor)

    with_memory = [
        min((best(kind, False), best(kind, True)), key=lambda fit: fit.cost) for kind in ("blur", "coloured")
    ]
    first, second = sorted(with_memory, key=lambda fit: fit.cost)
    plain = fitted("white", 0.0, False), fitted("sensor", 0.0, True)  # whose tails may be anything
    chosen = min(*plain, first, key=lambda fit: fit.cost)
    clock = best("clock", False)
    made = (1 + 2 * clock.memory**2) / _displacement("clock", lags[1:2], clock.memory)[0] ** 2
    told_by_tails = ((tails - 1) ** 2 - (tails - made) ** 2) / TAILS_KNOWN**2
    if clock.cost < min(chosen.cost + told_by_tails, *(one.cost - MIN_CHI2_GAIN for one in plain)):
        return clock
    either = second.misfit - first.misfit < MIN_CHI2_GAIN and chosen is first
    return chosen._replace(shape="either") if either else chosen


WINDOWS = (32, 16, 8)  # samples; the longest of which the recordings hold enough
FEWEST_WINDOWS, MOST_WINDOWS = 10, 4000
SMOOTH_SHARE = 4  # polynomials of a degree below window/4 may be motion
FILLED_POWER = 0.6  # of the power that noise would have in the highest degrees
VISIBLE_NOISE = 1e-3  # of the rms step of a state: noise below that share is not told from motion


@dataclass(frozen=True)
class NoiseFloor:
    """The noise of one state; zero where none is seen."""

    sensor: float  #: standard deviation of the sensor's error, in the state's unit
    process: float  #: variance that process noise adds per unit of time
    sensor_error: float  #: standard error of the first
    process_error: float  #: standard error of the second


def noise_floors(recordings: Recordings) -> tuple[NoiseFloor, ...] | None:
    """The noise of each state; None where too few neighbouring samples have no gap between them."""
    stretches = even_stretches(recordings)
    for width in WINDOWS:
        begins = stretches.within(width - 2)
        begins = begins[begins % (width // 2) == 0]
        begins = begins[:: max(len(begins) // MOST_WINDOWS, 1)]
        if len(begins) >= FEWEST_WINDOWS:
            rows = begins[:, None] + np.arange(width)
            elapsed = (recordings.t[rows] - recordings.t[begins, None]) / stretches.step
            even = np.abs(np.diff(elapsed) - 1) <= 2 * STEP_TOLERANCE
            times = np.arange(width, dtype=float)[None] if even.all() else elapsed
            return tuple(_noise_floor(column[rows], times, stretches.step) for column in recordings.values.T)
    return None


def _noise_floor(window: np.ndarray, times: np.ndarray, step: float) -> NoiseFloor:
    """The noise of one state in windows ``(windows, width)``, at times in steps, one row or one each."""
    width = window.shape[1]
    polynomials = np.linalg.qr(np.polynomial.legendre.legvander(2 * times / times[:, -1:] - 1, width - 1))[0]
    walk = np.minimum(times[:, :, None], times[:, None])
    typical = float(np.mean(np.diff(window, axis=1) ** 2))
    for lowest in (width // SMOOTH_SHARE, width // 2):
        contrasts = polynomials[..., lowest:]
        rest = ((window - window[:, :1])[:, None] @ contrasts)[:, 0]
        empirical = rest.T @ rest / len(rest)
        back = np.swapaxes(contrasts, -1, -2)
        parts = np.array([(back @ contrasts).mean(axis=0), (back @ walk @ contrasts).mean(axis=0)])
        # Windows overlap by a half, so that about half of them are independent.
        (sensor, process), errors = _most_likely(parts, empirical, len(rest) / 2)
        if 2 * sensor + process <= VISIBLE_NOISE**2 * typical:
            break
        # A motion that is no polynomial leaves hardly anything in the highest degrees, which noise fills.
        highest = np.arange(len(empirical)) >= len(empirical) // 2
        foreseen = np.diag(sensor * parts[0] + process * parts[1])[highest].sum()
        if np.diag(empirical)[highest].sum() < FILLED_POWER * foreseen:
            continue
        deviation = float(np.sqrt(sensor))
        error = float(errors[0] / (2 * deviation)) if sensor > 0 else float(np.sqrt(errors[0]))
        return NoiseFloor(deviation, float(process) / step, error, float(errors[1]) / step)
    return NoiseFloor(0.0, 0.0, 0.0, 0.0)


def _most_likely(parts: np.ndarray, empirical: np.ndarray, count: float) -> tuple[np.ndarray, np.ndarray]:
    """Two variances θ ≥ 0 with which θ₁A + θ₂B explains the empirical covariance best; with their errors."""
    size = float(np.trace(empirical))
    if size <= 0:
        return np.zeros(2), np.zeros(2)
    theta = np.array([size / np.trace(part) / 2 for part in parts])
    information = np.eye(2)
    for _ in range(50):
        inverse = np.linalg.inv(np.tensordot(theta, parts, 1))
        weighted = [inverse @ part for part in parts]
        information = np.array([[np.sum(a * b.T) for b in weighted] for a in weighted])
        goal = np.array([np.sum(a * (inverse @ empirical).T) for a in weighted])
        new = np.linalg.solve(information, goal)
        for place in range(2):
            if new[place] <= 0:  # then the other alone
                new = np.where(np.arange(2) == place, 0.0, goal / np.diag(information))
        new = np.maximum(new, 1e-12 * new.max())
        converged = np.abs(new - theta).max() <= 1e-6 * new.max()
        theta = new
        if converged:
            break
    errors = np.sqrt(2 * np.diag(np.linalg.inv(information)) / count)
    return np.where(theta > 2 * errors, theta, 0.0), errors


MOST_DECIMALS = 12  # a double of size 1 has 15 to 16; what has as many as that was not rounded
MIN_REPETITIONS = 4  # of the values of a label
FEWEST_VALUES = 8  # distinct values below which their decimals say nothing
FEWEST_LEVELS = 3  # of a digitiser; two are always a step apart
LATTICE_BY_CHANCE, LATTICE_TOLERANCE = 1e-6, 0.05  # of levels: to lie on a lattice, and off it, in steps
VALUES_SAMPLED = 2000  # looked at before all are


AUTOCORRELATION_95 = 1.96  # standard deviations of an autocorrelation of white errors, which are 1/√n


def correlation_time_of(
    left: np.ndarray, recording: np.ndarray, *, outputs: int = 1, least: float = AUTOCORRELATION_95
) -> float:
    """Integral correlation time of all residuals in samples, at least 1.

    Of n residuals, n over it count as independent. Autocorrelations are means over recordings and outputs.
    The sum ends at the first below `least` standard deviations of those of white errors: by default one that
    these would have by chance, so that noise does not lengthen it. The residuals have the outputs of a sample
    one behind the other, and come with the recording of each; shape ``(n·m,)``.
    """
    series = left.reshape(-1, outputs)
    owner = recording.reshape(-1, outputs)[:, 0]
    power, total = float((series**2).mean()), 1.0
    for lag in range(1, len(series) // 4):
        same = owner[lag:] == owner[:-lag]
        pairs = int(same.sum()) * outputs
        if not pairs or power <= 0:
            break
        correlation = float((series[lag:] * series[:-lag])[same].sum()) / pairs / power
        if correlation <= least / np.sqrt(pairs):
            break
        total += 2 * correlation
    return total


def resolution_step(values: np.ndarray) -> float | None:
    """The step of which all known values ``(n,)`` are multiples, up to an offset; None where there is none.

    Where values repeat, the least difference of two, if all differences are multiples of it: the step of a
    digitiser, which may be written with more decimals than it has. Else a power of ten, where the values have
    so many decimals.

    Examples
    --------
    >>> resolution_step(np.round(np.sin(np.arange(100.0)), 3))
    0.001
    >>> resolution_step(np.sin(np.arange(100.0))) is None
    True
    """
    values = values[np.isfinite(values)]
    levels = np.unique(values)
    largest = float(np.abs(levels).max(initial=0.0))
    if len(levels) < FEWEST_LEVELS or largest == 0:
        return None
    # The step of a digitiser: many equal values, all of them a whole number of steps apart.
    if len(levels) <= len(values) // 2:
        gaps = np.diff(levels)
        # Levels that differ by less than numbers are written with are one level.
        counts = (levels - levels[0]) / float(gaps[gaps > 1e-9 * np.ptp(levels)].min())
        # By chance all of the others lie so near whole numbers once in a million times.
        tolerance = min(0.5 * LATTICE_BY_CHANCE ** (1 / (len(levels) - 2)), LATTICE_TOLERANCE)
        if counts[-1] <= 1e7 and np.abs(counts - np.round(counts)).max() <= tolerance:
            return float(np.ptp(levels) / np.round(counts[-1]))
    if len(levels) < FEWEST_VALUES:
        return None
    some = levels[:: max(len(levels) // VALUES_SAMPLED, 1)]
    most = MOST_DECIMALS - int(np.ceil(np.log10(largest)))
    for decimals in range(most - MOST_DECIMALS, most + 1):
        # Rounding as a writer does gives back the very number that was read, where it has no more decimals.
        if all(
            (decimals >= 0 and (np.round(each, decimals) == each).all())
            or np.allclose(np.round(each, decimals), each, rtol=1e-14, atol=0.0)
            for each in (some, levels)
        ):
            return float(f"1e{-decimals}")
    return None


def decimals_of(step: float) -> int | None:
    """How many decimals a number has that was rounded to `step`; None where that is no power of ten."""
    decimals = round(-np.log10(step))
    return max(decimals, 0) if np.isclose(step, 10.0**-decimals, rtol=1e-9) else None


def rounding_error(step: float) -> float:
    """Standard deviation of what rounding to `step` does to a value."""
    return step / float(np.sqrt(12.0))
