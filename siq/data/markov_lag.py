"""From which lag on is a record Markovian, and what made it remember until then?

What happens next may depend on the present state alone. Increments ``x(t+h) - x(t)`` less their mean, given
x(t), then know nothing of each other. Sensor noise, an exposure, and forces with a memory make them
correlated, and the mean itself is no longer that of the system: of a state driven by forces with a memory it
vanishes, since the recorded state tells which way the forces push.

A sample L steps earlier does not know that once L is longer than the memory. So the mean is sought as a
polynomial of the state whose coefficients make what is left uncorrelated with polynomials of the state *L
steps earlier* (instrumental variables), ``Σ φ(x(t-L)) (x(t+h) - x(t) - φ(x(t))ᵀξ) = 0``. What is left is then
that of the forces and of the sensor, whatever L is, provided it is long enough: the shortest L at which
residuals L steps apart are not told from uncorrelated.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy.special

from siq.data.lagged import Stretches, even_stretches, lagged_covariances, long_run_covariance
from siq.data.noise_memory import FittedShape, fitted_shape
from siq.data.recordings import Recordings
from siq.data.stationarity import relaxation_samples, runs_of, usual_step

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
