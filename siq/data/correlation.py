"""Correlation over lags: from which lag on a record is Markovian, and what kinds of noise it shows.

Statistics of lags need samples one after the other, a step apart. Recordings are cut where a sample is
missing or a recording ends; what is told of a lag comes from whole stretches alone.

A state that white forces drive moves by independent increments, so that its mean square displacement grows as
``M(k) = σ²h k`` over k steps. It grows otherwise where

- the sensor errs: ``M(k) = σ²h k + 2R``;
- a sample is the mean over an exposure of u steps: ``M(k) = σ²h (k - u/3)`` for ``k ≥ u``, and
  ``σ²h (k²/u - k³/3u²)`` before;
- the forces are an Ornstein–Uhlenbeck process of the memory u, or the sensor is a low-pass filter of that
  time: ``M(k) = σ²h (k - u (1 - e^(-k/u)))``. The two cannot be told apart.

Covariances of increments are ``C(k) = (M(k+1) - 2M(k) + M(k-1))/2``. Each kind is fitted to those of the
residuals, by generalised least squares, and the best is named where the others are clearly worse.

What happens next may depend on the present state alone. Increments ``x(t+h) - x(t)`` less their mean, given
x(t), then know nothing of each other. Sensor noise, an exposure, and forces with a memory make them
correlated, and the mean itself is no longer that of the system: of a state driven by forces with a memory it
vanishes, since the recorded state tells which way the forces push.

A sample L steps earlier does not know that once L is longer than the memory. So the mean is sought as a
polynomial of the state whose coefficients make what is left uncorrelated with polynomials of the state *L
steps earlier* (instrumental variables), ``Σ φ(x(t-L)) (x(t+h) - x(t) - φ(x(t))ᵀξ) = 0``. What is left is then
that of the forces and of the sensor, whatever L is, provided it is long enough: the shortest L at which
residuals L steps apart are not told from uncorrelated.

Within a short window a motion without noise is nearly a polynomial of time. What is left of the samples
besides polynomials of low degree is noise: of random forces, whose effect adds up from sample to sample, or
of the sensor, which is new in each. Their covariances differ, and both strengths follow from that of the
windows by maximum likelihood. This takes milliseconds, and is a first look: what f and D are is found by
`siq.identify`.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np
import scipy.linalg
import scipy.optimize
import scipy.special

from siq.data.recordings import Recordings
from siq.data.stationarity import relaxation_samples, runs_of, usual_step

EVEN = 0.01  # of a step: stretches end where a step differs by more


@dataclass(frozen=True)
class Stretches:
    """Steps between neighbouring samples, numbered by the stretch of even steps that they belong to.

    Attributes
    ----------
    number
        Shape ``(n - 1,)`` for n samples: the stretch of the step from sample k to sample k + 1, -1 where it
        belongs to none.
    step
        The usual time between neighbouring samples, in the unit of time; 0 where there are none.
    """

    number: np.ndarray
    step: float

    def within(self, lag: int) -> np.ndarray:
        """The first of `lag` + 1 steps that belong to one stretch, as indices of steps."""
        count = len(self.number) - lag
        if count <= 0:
            return np.zeros(0, dtype=int)
        one, other = self.number[:count], self.number[lag:]
        return np.flatnonzero((one >= 0) & (one == other))


def even_stretches(recordings: Recordings) -> Stretches:
    """Cut recordings into stretches of even steps."""
    gap = np.diff(recordings.t)
    inside = np.diff(recordings.recording) == 0
    if not inside.any():
        return Stretches(np.full(len(gap), -1), 0.0)
    usual = float(np.quantile(gap[inside], 0.5, method="lower"))
    # Times such as 0.1·k, or seconds since 1970, carry rounding errors into their differences.
    even = inside & (np.abs(gap - usual) <= EVEN * usual + 4 * np.spacing(np.abs(recordings.t[1:])))
    return Stretches(np.where(even, np.cumsum(~even), -1), usual)


def lagged_covariances(rest: np.ndarray, number: np.ndarray, most: int) -> np.ndarray:
    """Covariances of what is left of steps with what is left of later ones.

    Parameters
    ----------
    rest
        Shape ``(n, d)``: what is left of each step, with mean zero.
    number
        Shape ``(n,)``: the stretch of each step, -1 for none. Steps of a stretch follow each other.
    most
        The longest lag.

    Returns
    -------
    numpy.ndarray
        Shape ``(most + 1, d, d)``: ``C[k, i, j]`` is the mean of ``rest[m, i] rest[m + k, j]``; zero where no
        two steps are so far apart.
    """
    d = rest.shape[1]
    covariances = np.zeros((most + 1, d, d))
    for lag in range(min(most, len(rest) - 1) + 1):
        count = len(rest) - lag
        both = (number[:count] == number[lag:]) & (number[:count] >= 0)
        if both.any():
            covariances[lag] = (rest[:count] * both[:, None]).T @ rest[lag:] / both.sum()
    return covariances


def long_run_covariance(covariances: np.ndarray, lag: int) -> np.ndarray:
    """``C_0 + Σ_k (C_k + C_kᵀ)`` up to a lag: what sums of many steps have, per step; shape ``(d, d)``."""
    later = covariances[1 : lag + 1].sum(axis=0)
    return np.asarray(covariances[0] + later + later.T)


Shape = Literal["white", "sensor", "blur", "coloured", "either"]

CLEARLY = 6.0  # in χ²: the other is e³ = 20 times less likely, or a further number worth its while
GRID = 40  # memories tried, before the best is refined
FLOOR = 1e-9  # of the largest eigenvalue, so that a covariance can be inverted


@dataclass(frozen=True)
class FittedShape:
    """The kind of noise that fits covariances of residuals over lags.

    Attributes
    ----------
    shape
        ``either`` where an exposure fits about as well as forces with a memory.
    memory
        Exposure, or memory, in steps; 0 of white noise and of sensor noise.
    sensor
        Variance of the sensor's error.
    misfit
        χ² of what is left, and ...
    freedom
        ... the number that it has in the mean where the kind is right.
    departure
        The largest difference of a correlation from that of the kind: large where it is of none of these.
    """

    shape: Shape
    memory: float
    sensor: float
    misfit: float
    freedom: int
    departure: float = 0.0


def exposure_displacement(lags: np.ndarray, exposure: float) -> np.ndarray:
    """M(k)/σ²h of means over an exposure of so many steps."""
    k = np.abs(np.asarray(lags, dtype=float))
    if exposure <= 0:
        return k
    return np.where(k >= exposure, k - exposure / 3, k**2 / exposure - k**3 / (3 * exposure**2))


def coloured_displacement(lags: np.ndarray, memory: float) -> np.ndarray:
    """M(k)/σ²h of forces with a memory of so many steps."""
    k = np.abs(np.asarray(lags, dtype=float))
    return k if memory <= 0 else k + memory * np.expm1(-k / memory)


def increment_covariances(displacement: np.ndarray) -> np.ndarray:
    """C(k), k = 0 ... K, from M(0) ... M(K + 1)."""
    before = np.concatenate([displacement[1:2], displacement[:-2]])
    return np.asarray((displacement[1:] - 2 * displacement[:-1] + before) / 2)


def fitted_shape(covariances: np.ndarray, count: float, *, seen: int) -> FittedShape:
    """The simplest kind of noise that explains covariances of residuals.

    Parameters
    ----------
    covariances
        Shape ``(K + 1,)``: of residuals k steps apart.
    count
        Number of residuals.
    seen
        The lag from which on none is told from zero.

    Notes
    -----
    By Bartlett's formula the covariances have themselves the covariance
    ``Σ_m (C_m C_(m+j-k) + C_(m+j) C_(m-k)) / n``.
    """
    lags = np.arange(len(covariances) + 1)
    root = _whitening(covariances, count, seen)
    goal = root @ covariances
    error = root @ increment_covariances(np.where(lags > 0, 2.0, 0.0))
    size = len(covariances)

    def own(memory: float, kind: Shape) -> np.ndarray:
        move = exposure_displacement if kind == "blur" else coloured_displacement
        return increment_covariances(move(lags, memory))

    def misfit(memory: float, kind: Shape, *, sensor: bool) -> tuple[float, np.ndarray]:
        design = np.stack([root @ own(memory, kind), error], axis=1)
        design = design if sensor else design[:, :1]
        scale = np.linalg.norm(design, axis=0)
        values, left = scipy.optimize.nnls(design / scale, goal)
        return float(left**2), np.append(values / scale, 0.0)[:2]

    tried = np.geomspace(0.1, 1.5 * max(seen, 1), GRID)
    shapes: tuple[Shape, Shape] = ("white", "sensor")
    kinds: tuple[Shape, Shape] = ("blur", "coloured")

    def best(kind: Shape, sensor: bool) -> FittedShape:
        place = int(np.argmin([misfit(u, kind, sensor=sensor)[0] for u in tried]))
        found = scipy.optimize.minimize_scalar(
            lambda u: misfit(u, kind, sensor=sensor)[0], method="bounded",
            bounds=(tried[max(place - 1, 0)], tried[min(place + 1, GRID - 1)]),
        )  # fmt: skip
        left, values = misfit(float(found.x), kind, sensor=sensor)
        return FittedShape(kind, float(found.x), float(values[1]), left, size - 2 - sensor)

    simple = []
    for shape in shapes:
        left, values = misfit(0.0, "coloured", sensor=shape == "sensor")
        simple.append(FittedShape(shape, 0.0, float(values[1]), left, size - 1 - (shape == "sensor")))
    with_memory = [min((best(kind, False), best(kind, True)), key=_cost) for kind in kinds]
    first, second = sorted(with_memory, key=_cost)
    either = second.misfit - first.misfit < CLEARLY
    chosen = min((*simple, first), key=_cost)
    _, values = misfit(chosen.memory, chosen.shape, sensor=chosen.sensor > 0)
    left = covariances - values[0] * own(chosen.memory, chosen.shape)
    left -= values[1] * increment_covariances(np.where(lags > 0, 2.0, 0.0))
    departure = float(np.abs(left).max() / covariances[0])
    shape = "either" if either and chosen is first else chosen.shape
    return replace(chosen, shape=shape, departure=departure)


def _cost(fit: FittedShape) -> float:
    """What is left, and what each further number has to explain to be worth it."""
    return fit.misfit - CLEARLY * fit.freedom


def _whitening(covariances: np.ndarray, count: float, seen: int) -> np.ndarray:
    """The inverse root of the covariance of estimated covariances, by Bartlett's formula."""
    size = len(covariances)
    known = np.where(np.arange(size) <= seen, covariances, 0.0)
    reach = 3 * size
    even = np.zeros(2 * reach + 1)
    even[reach : reach + size], even[reach - size + 1 : reach + 1] = known, known[::-1]
    # Σ_m C_m C_(m+j-k) depends on j-k, Σ_m C_(m+j) C_(m-k) on j+k: correlations of C with itself.
    auto = np.correlate(even, even, mode="full")[len(even) - 1 :]
    j = np.arange(size)
    bartlett = auto[np.abs(j[:, None] - j[None])] + auto[j[:, None] + j[None]]
    values, vectors = np.linalg.eigh(bartlett / count)
    values = np.maximum(values, FLOOR * values.max())
    return np.asarray((vectors / np.sqrt(values)) @ vectors.T)


Kind = Literal["none", "white", "sensor", "blur", "coloured", "either", "memory", "hidden", "unknown"]

FALSE_ALARMS = 1e-3  # a choice: one record in a thousand of white noise is taken for one with a memory
HARMLESS = 0.005  # a correlation; twice that, one per cent, is what it adds to the strength of the noise
FIRST_LAGS = 8  # looked at for a first sign; a memory that shows later shows there as well
SEEN = 2.0  # standard errors: the usual ones of 95 %
SEEN_LATER = 3.0  # at each of a few longer lags, so that all are kept about as often
LATER = (1.25, 1.5, 2.0)  # times the lag: correlations that swing pass through zero, but do not stay there
TOLD = 0.1  # a correlation: the mean is off by no larger share where less than that could remain unseen
DEPARTURE = 0.05  # of a correlation: a fifth of what an exposure of a whole step makes
TELLING = 0.1  # a correlation: what the earlier state tells no more of than that is left out of the mean
LONGEST = 2.0  # relaxation times: a state so much earlier tells e^-2 of the present one, and errors grow
LARGEST_DEGREE, MOST_FUNCTIONS = 5, 36  # numerical: a polynomial that a second suffices for
FEWEST = 50  # steps for each function: fewer tell nothing of correlations
MOST_SAMPLES = 400_000  # looked at: a correlation is then known to 0.002, a tenth of HARMLESS
GROWTH = 1.2  # of the lags that are tried, about as exactly as they are known
QUIET = 1e-3  # of the rms step: what is left is less than that where nothing but the integrator erred


@dataclass(frozen=True)
class MarkovLag:
    """How long a record remembers, and why.

    Attributes
    ----------
    kind
        ``none``: no noise. ``white``: random forces without a memory. ``sensor``: errors of the sensor, new
        in each sample. ``blur``: each sample is a mean over an exposure. ``coloured``: the random forces
        have a memory, or the sensor is slow. ``either`` of these two. ``memory``: it remembers in another
        way, such as by an oscillation of its own. ``hidden``: it remembers longer than
        it takes to relax, as where a state is not recorded. ``unknown``: too few samples, or uneven ones.
    lag
        From so many steps on it is Markovian: 0 of white noise, None where no such lag was found.
    step
        The usual time between samples.
    memory
        Exposure, or memory of the forces, in the unit of time; 0 where there is none.
    relaxation
        The shortest time in which the state relaxes, in the unit of time; NaN where nothing is known of it.
    lags, correlations, errors
        Shapes ``(K,)``, ``(K, d)`` and ``(K, d)``: correlation of residuals so many steps apart, for each
        state, and its standard error were there none.
    sensor
        Shape ``(d,)``: standard deviation of the sensor's error, where it follows; else 0.
    """

    kind: Kind
    lag: int | None
    step: float
    memory: float
    relaxation: float
    lags: np.ndarray
    correlations: np.ndarray
    errors: np.ndarray
    sensor: np.ndarray

    @property
    def remembers(self) -> bool:
        """Whether pairs of neighbouring samples are misleading, and pairs seen from earlier are not."""
        return self.kind in ("blur", "coloured", "either", "memory") and self.lag is not None

    @property
    def time(self) -> float:
        """The lag in the unit of time; NaN where there is none."""
        return float("nan") if self.lag is None else self.lag * self.step


def markov_lag(recordings: Recordings) -> MarkovLag:
    """Find the lag from which on recordings are Markovian.

    Parameters
    ----------
    recordings
        Trajectories; evenly spaced stretches of them are looked at.
    """
    d = len(recordings.names)
    stretches = even_stretches(recordings)
    problem = _Problem.of(recordings, stretches)
    unknown = MarkovLag(
        "unknown", None, stretches.step, 0.0, float("nan"),
        np.zeros(0, int), np.zeros((0, d)), np.zeros((0, d)), np.zeros(d),
    )  # fmt: skip
    if problem is None:
        return unknown
    first = problem.seen_from(0)
    if first is None:
        return unknown
    white = first.correlations(FIRST_LAGS)
    if (np.diag(first.covariances[0]) <= QUIET**2 * problem.size**2).all():
        return _told("none", 0, first, FIRST_LAGS, problem)
    if not _significant(white).any():
        return _told("white", 0, first, FIRST_LAGS, problem)
    lag = 1
    while (seen := problem.seen_from(lag)) is not None:
        if lag * problem.step > LONGEST * problem.relaxation:
            break
        if problem.forgotten(seen, lag):
            return _with_kind(seen, lag, problem)
        lag = max(lag + 1, round(lag * GROWTH))
    seen = seen or first
    return _told("hidden", None, seen, 2 * lag, problem)


@dataclass(frozen=True)
class _Seen:
    """What is left of increments whose mean was found from states some steps earlier."""

    rest: np.ndarray
    number: np.ndarray
    inverse: np.ndarray  # (q, q): of the mean of φ(x(t-L)) φ(x(t))ᵀ

    @property
    def covariances(self) -> np.ndarray:
        return lagged_covariances(self.rest, self.number, 0)

    def correlations(self, most: int) -> tuple[np.ndarray, np.ndarray]:
        """Correlations at lags 1 ... most and their standard errors, each of shape ``(most, d)``."""
        all_lags = lagged_covariances(self.rest, self.number, most)
        own = np.einsum("kii->ki", all_lags)
        size = np.where(own[0] > 0, own[0], 1.0)
        values = own[1:] / size
        # Bartlett: correlations at shorter lags make all others uncertain.
        spread = 1 + 2 * np.cumsum(np.vstack([np.zeros_like(values[:1]), values[:-1] ** 2]), axis=0)
        return values, np.sqrt(spread * self.kurtosis(most) / self.count)

    @property
    def count(self) -> int:
        return int((self.number >= 0).sum())

    def kurtosis(self, lag: int) -> np.ndarray:
        """Mean of r²(t) r²(t+lag) over that of r² squared: 1 where the strength is the same everywhere."""
        squares = self.rest**2
        count = len(squares) - lag
        if count <= 0:
            return np.ones(squares.shape[1])
        both = (self.number[:count] == self.number[lag:]) & (self.number[:count] >= 0)
        mean = squares[self.number >= 0].mean(axis=0) ** 2
        if both.sum() < FEWEST:
            return np.ones(squares.shape[1])
        product = (squares[:count] * squares[lag:])[both].mean(axis=0)
        return np.maximum(product / np.where(mean > 0, mean, 1.0), 1.0)


@dataclass(frozen=True)
class _Problem:
    """Increments, polynomials of the states where they begin, and their stretches."""

    functions: np.ndarray  # (n, q), orthonormal in the mean
    increments: np.ndarray  # (n, d)
    stretches: Stretches
    size: np.ndarray
    relaxation: float

    @property
    def step(self) -> float:
        return self.stretches.step

    @classmethod
    def of(cls, recordings: Recordings, stretches: Stretches) -> _Problem | None:
        most = min(len(stretches.number), MOST_SAMPLES)
        number = stretches.number[:most]
        known = number >= 0
        values = recordings.values[: most + 1]
        if not known.any():
            return None
        scale = values.std(axis=0)
        if not (scale > 0).all():
            return None
        scaled = (values[:-1] - values.mean(axis=0)) / scale
        powers = _powers(scaled.shape[1])
        if known.sum() < FEWEST * len(powers):
            return None
        functions = _monomials(scaled, powers)
        gram = functions[known].T @ functions[known] / known.sum()
        values_of, vectors = np.linalg.eigh(gram)
        kept = values_of > 1e-10 * values_of[-1]
        orthonormal = vectors[:, kept] / np.sqrt(values_of[kept])
        increments = np.where(known[:, None], np.diff(values, axis=0), 0.0)
        return cls(
            functions @ orthonormal, increments, Stretches(number, stretches.step),
            np.sqrt((increments[known] ** 2).mean(axis=0)), _relaxation(recordings),
        )  # fmt: skip

    def seen_from(self, lag: int) -> _Seen | None:
        """What is left where the mean is found from states `lag` steps earlier; None of too few samples."""
        count = len(self.increments) - lag
        q = self.functions.shape[1]
        if count < FEWEST * q:
            return None
        numbers = self.stretches.number
        both = (numbers[:count] == numbers[lag:]) & (numbers[:count] >= 0)
        if both.sum() < FEWEST * q:
            return None
        earlier, now = self.functions[:count] * both[:, None], self.functions[lag:]
        moved = self.increments[lag:]
        inverse = np.linalg.pinv(earlier.T @ now / both.sum(), rcond=TELLING)
        coefficients = inverse @ (earlier.T @ moved) / both.sum()
        number = np.full(len(self.increments), -1)
        number[lag:][both] = numbers[lag:][both]
        rest = np.zeros_like(self.increments)
        rest[lag:] = (moved - now @ coefficients) * both[:, None]
        return _Seen(rest, number, inverse)

    def forgotten(self, seen: _Seen, lag: int) -> bool:
        """Whether residuals so many steps apart, and farther, are not told from uncorrelated.

        The error of the mean that was found makes them uncertain, too: by the covariance of residuals with
        later states.
        """
        lags = [lag, *(int(np.ceil(lag * times)) for times in LATER)]
        covariances = lagged_covariances(seen.rest, seen.number, lags[-1])
        run = np.maximum(np.diag(long_run_covariance(covariances, lag)), 0.0)
        size = np.diag(covariances[0])
        values, errors = seen.correlations(lags[-1])
        for place, one in enumerate(lags):
            count = len(seen.rest) - one
            carried = seen.rest[:count].T @ self.functions[one:] / seen.count @ seen.inverse
            further = (carried**2).sum(axis=1) * run / seen.count / size**2
            error = np.sqrt(errors[one - 1] ** 2 + further)
            limit = SEEN if place == 0 else SEEN_LATER
            if (np.abs(values[one - 1]) > limit * error).any() or (SEEN * error > TOLD).any():
                return False
        return True


def _powers(d: int) -> list[tuple[int, ...]]:
    """Exponents of the monomials, of the highest degree that leaves few enough of them."""
    degree = max(
        (k for k in range(1, LARGEST_DEGREE + 1) if scipy.special.comb(d + k, k) <= MOST_FUNCTIONS), default=1
    )
    return [row for row in itertools.product(range(degree + 1), repeat=d) if sum(row) <= degree]


def _monomials(x: np.ndarray, powers: list[tuple[int, ...]]) -> np.ndarray:
    highest = max(max(row) for row in powers)
    tower = [np.ones_like(x)]
    for _ in range(highest):
        tower.append(tower[-1] * x)
    values = np.ones((len(x), len(powers)))
    for place, row in enumerate(powers):
        for state, exponent in enumerate(row):
            if exponent:
                values[:, place] *= tower[exponent][:, state]
    return values


def _relaxation(recordings: Recordings) -> float:
    """The shortest time in which a state relaxes, NaN where nothing is known of it."""
    runs, step = runs_of(recordings), usual_step(recordings)
    known = [
        samples for column in recordings.values.T if (samples := relaxation_samples(column, runs)) is not None
    ]
    return min(known) * step if known else float("nan")


def _significant(found: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Which states have residuals that are correlated, and not only a little: a mask ``(d,)``."""
    values, errors = found
    chosen = FALSE_ALARMS / values.shape[1] / 2  # for two tests: of neighbours, and of all together
    all_limit, first_limit = scipy.special.chdtri(len(values), chosen), scipy.special.chdtri(1, chosen)
    squares = (values / errors) ** 2
    seen = (squares.sum(axis=0) > all_limit) | (squares[0] > first_limit)
    return np.asarray(seen & (np.abs(values).max(axis=0) > HARMLESS))


def _with_kind(seen: _Seen, lag: int, problem: _Problem) -> MarkovLag:
    """The kind of each state that remembers; that of the longest memory stands for the record."""
    most = max(2 * lag, FIRST_LAGS)
    own = np.einsum("kii->ki", lagged_covariances(seen.rest, seen.number, most))
    values, errors = seen.correlations(FIRST_LAGS)
    marked = _significant((values, errors))
    kurtosis = seen.kurtosis(lag + 1)
    fits: list[FittedShape] = [
        fitted_shape(own[:, place], seen.count / kurtosis[place], seen=lag)
        for place in range(len(marked))
        if marked[place]
    ]
    longest = max(fits, key=lambda fit: fit.memory, default=None)
    if longest is None or longest.shape == "white":
        return _told("white", 0, seen, most, problem)
    errors = seen.correlations(most)[1]
    if longest.departure > max(DEPARTURE, 4 * float(errors[0].max())):
        return _told("memory", lag, seen, most, problem)
    if longest.memory == 0:
        lag = 1
    sensor = np.zeros(len(marked))
    sensor[marked] = np.sqrt([fit.sensor for fit in fits])
    return _told(longest.shape, lag, seen, most, problem, memory=longest.memory * problem.step, sensor=sensor)


def _told(
    kind: Kind, lag: int | None, seen: _Seen, most: int, problem: _Problem,
    *, memory: float = 0.0, sensor: np.ndarray | None = None,
) -> MarkovLag:  # fmt: skip
    values, errors = seen.correlations(most)
    d = values.shape[1]
    return MarkovLag(
        kind, lag, problem.step, memory, problem.relaxation, np.arange(1, len(values) + 1), values, errors,
        np.zeros(d) if sensor is None else sensor,
    )  # fmt: skip


if TYPE_CHECKING:
    from siq.data.recordings import Recordings

WINDOWS = (32, 16, 8)  # samples; the longest of which the recordings hold enough
ENOUGH = 10  # windows, at least
MOST = 4000  # windows looked at
SMOOTH_SHARE = 4  # polynomials of a degree below window/4 may be motion
FILLED = 0.6  # of the power that noise would have in the highest degrees
VISIBLE = 1e-3  # of the rms step of a state: noise below that share is not told from motion


@dataclass(frozen=True)
class NoiseFloor:
    """The noise of one state.

    Attributes
    ----------
    sensor
        Standard deviation of the sensor's error, in the state's unit; 0 where none is seen.
    process
        Variance that random forces add per unit of time; 0 where none is seen.
    sensor_error, process_error
        Their standard errors.
    """

    sensor: float
    process: float
    sensor_error: float
    process_error: float


def noise_floors(recordings: Recordings) -> tuple[NoiseFloor, ...] | None:
    """The noise of each state; None where too few neighbouring samples are evenly spaced.

    Parameters
    ----------
    recordings
        Trajectories; of long ones a part is looked at.
    """
    for width in WINDOWS:
        rows = _windows(recordings, width)
        if len(rows) >= ENOUGH:
            return tuple(_floor(recordings, rows, column, width) for column in range(len(recordings.names)))
    return None


def _windows(recordings: Recordings, width: int) -> np.ndarray:
    """First rows of windows that lie in one recording and are evenly spaced."""
    t, recording = recordings.t, recordings.recording
    inside = recording[1:] == recording[:-1]
    if not inside.any():
        return np.zeros(0, dtype=int)
    gap = np.diff(t)
    usual = float(np.median(gap[inside]))
    # Written times are rounded: 0.033, 0.067, 0.1.
    even = inside & (np.abs(gap - usual) <= EVEN * usual + 4 * np.spacing(np.abs(t[1:])))
    broken = np.append(0, np.cumsum(~even))
    begins = np.arange(0, len(t) - width + 1, width // 2)
    begins = begins[broken[begins + width - 1] == broken[begins]]
    return begins[:: max(len(begins) // MOST, 1)]


def _floor(recordings: Recordings, begins: np.ndarray, column: int, width: int) -> NoiseFloor:
    step = float(np.median(recordings.t[begins + 1] - recordings.t[begins]))
    window = recordings.values[:, column][begins[:, None] + np.arange(width)]
    centre = np.linspace(-1, 1, width)
    polynomials = np.linalg.qr(np.polynomial.legendre.legvander(centre, width - 1))[0]
    walk = np.minimum.outer(np.arange(width), np.arange(width)).astype(float)
    typical = float(np.mean(np.diff(window, axis=1) ** 2))
    for lowest in (width // SMOOTH_SHARE, width // 2):
        contrasts = polynomials[:, lowest:]
        rest = (window - window[:, :1]) @ contrasts
        empirical = rest.T @ rest / len(rest)
        parts = np.array([contrasts.T @ contrasts, contrasts.T @ walk @ contrasts])
        # Windows overlap by a half, so that about half of them are independent.
        (sensor, process), errors = _most_likely(parts, empirical, len(rest) / 2)
        if 2 * sensor + process <= VISIBLE**2 * typical:
            break
        # A motion that is no polynomial leaves hardly anything in the highest degrees, which noise fills.
        highest = np.arange(len(empirical)) >= len(empirical) // 2
        foreseen = np.diag(sensor * parts[0] + process * parts[1])[highest].sum()
        if np.diag(empirical)[highest].sum() < FILLED * foreseen:
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
        if np.abs(new - theta).max() <= 1e-6 * new.max():
            theta = new
            break
        theta = new
    errors = np.sqrt(2 * np.diag(np.linalg.inv(information)) / count)
    return np.where(theta > 2 * errors, theta, 0.0), errors
