"""Measurement noise and process noise by maximum likelihood.

The variances are those of highest restricted likelihood, which allows for the initial states and parameters
that are fitted beside them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import scipy.optimize

from siq.inference.filter_kernels import noise_likelihood
from siq.inference.kalman_filter import Linearisation, Noise, Whitened, solve, whiten, with_parameters_changed
from siq.inference.measurements import Expectations, Measurements
from siq.systems.dynamics import Dynamics

PIECE = 500  # samples in one stretch, so that its unknown first state hardly matters


@dataclass(frozen=True)
class Stretches:
    """Parts of recordings, or all of them, along which the likelihood of a noise is worked out.

    Attributes
    ----------
    first
        Row at which each part begins, and the number of rows.
    linearisation
        Along them.
    step
        Length of the interval after each sample, shape ``(n,)``.
    rows
        Which they are, of all samples; None where they are all.
    """

    first: np.ndarray
    linearisation: Linearisation
    step: np.ndarray
    rows: np.ndarray | None = None

    def some(self, most: int) -> Stretches:
        """Pieces spread over all recordings, about so many samples in all; itself where there are fewer."""
        count = len(self.step)
        if count <= 2 * most:
            return self
        keep = most / count
        rows, first = [], [0]
        for begin, end in zip(self.first[:-1], self.first[1:], strict=True):
            pieces = max(round((end - begin) * keep / PIECE), 1)
            length = max(int((end - begin) * keep / pieces), 1)
            for at in np.linspace(begin, end - length, pieces).astype(int):
                rows.append(np.arange(at, at + length))
                first.append(first[-1] + length)
        chosen = np.concatenate(rows)
        line = self.linearisation
        parts = {each.name: getattr(line, each.name)[chosen] for each in fields(line)}
        return Stretches(np.array(first), Linearisation(**parts), self.step[chosen], chosen)

    def sums(self, noise: Noise, *, weight: np.ndarray | float = 1.0) -> tuple[float, float, int]:
        """See `siq.inference.filter_kernels.noise_likelihood`, whose results they are."""
        line, intensity = self.linearisation, noise.intensity
        if self.rows is not None and len(intensity) > 1:
            intensity = intensity[self.rows]
        return noise_likelihood(
            self.first,
            line.transition,
            line.response,
            line.gap,
            line.measured,
            line.measured_response,
            line.residual,
            weight * self.step,
            noise.measurement,
            intensity,
        )


SMOOTHEST = 1e-4  # least measurement noise, as a share of what third differences show
MANY = 8000  # samples, whose noise is known to 2 %: enough to begin with
AWAY = 0.05  # numerical: of a logarithm, for differences of the likelihood
TOLD = 1.0  # curvature along a logarithm, from which on its standard error is below one
NEAR = 0.5  # of a logarithm, within which the likelihood is a parabola
LOWEST = np.exp(-23.0)  # of a process noise, relative to where the search began; below it there is none


def first_noise(model: Dynamics, data: Measurements, x: np.ndarray) -> Noise:
    """Noise to begin with: what third differences show of the outputs, and a drive as large as the motion."""
    measurement = data.with_known_noise(data.roughness)
    rows = data.begins
    step = (data.t[rows + 1] - data.t[rows])[:, None]
    process = 0.01 * np.mean((x[rows + 1] - x[rows]) ** 2 / step, axis=0)
    if not (process > 0).all():
        spread = np.ptp(model.limits, axis=1) ** 2 / (data.t[-1] - data.t[0] + 1e-300)
        # Of a state at rest whose domain nobody knows, what its own equation moves it by.
        moved = np.mean(_rates(model, data, x)[rows] ** 2 * step, axis=0)
        process = np.where(process > 0, process, np.where(np.isfinite(spread), 1e-4 * spread, 0.01 * moved))
    return Noise(measurement, np.where(model.kinematic, 0.0, process))


def _rates(model: Dynamics, data: Measurements, x: np.ndarray) -> np.ndarray:
    """F at all samples, shape ``(n, d)``; zero where it has no value."""
    signals = data.signals(data.t, data.recording, delays=model.lags(model.values))
    rates = model.functions.rates(x.T, signals, model.values).T
    return np.where(np.isfinite(rates), rates, 0.0)


@dataclass(frozen=True)
class NoiseCoordinates:
    """The parameters of a noise as one vector: logarithms of variances, then how random forces correlate.

    Attributes
    ----------
    origin
        The noise at zero. A process noise that is zero there stays so.
    known
        Which variances of the measurement are known, and stay as they are; shape ``(m,)``.
    """

    origin: Noise
    known: np.ndarray

    @property
    def driven(self) -> np.ndarray:
        """Places of the states that random forces drive."""
        return np.flatnonzero(self.origin.process > 0)

    @property
    def correlates(self) -> bool:
        """Whether a correlation of the random forces is among the parameters."""
        return self.origin.shape is not None and len(self.origin.shape) == 1

    @property
    def size(self) -> int:
        """Number of parameters."""
        count = len(self.driven)
        pairs = count * (count - 1) // 2 if self.correlates else 0
        return len(self.known) + count + pairs

    def noise_at(self, vector: np.ndarray) -> Noise:
        """The noise for a vector, shape ``(size,)``."""
        outputs, driven = len(self.known), self.driven
        process = np.zeros_like(self.origin.process)
        process[driven] = self.origin.process[driven] * np.exp(vector[outputs : outputs + len(driven)])
        logarithms = np.where(self.known, 0.0, vector[:outputs])
        result = replace(
            self.origin, measurement=self.origin.measurement * np.exp(logarithms), process=process
        )
        if not self.correlates or len(driven) < 2:
            return result
        assert self.origin.shape is not None
        root = np.linalg.cholesky(self.origin.shape[0][np.ix_(driven, driven)])
        change = np.eye(len(driven))
        change[np.tril_indices(len(driven), -1)] = vector[outputs + len(driven) :]
        root = root @ change
        root /= np.linalg.norm(root, axis=1)[:, None]
        shape = self.origin.shape.copy()
        shape[0][np.ix_(driven, driven)] = root @ root.T
        return replace(result, shape=shape)


def noise_coordinates(data: Measurements, origin: Noise) -> NoiseCoordinates:
    """The parameters of a noise of recordings, of whose sensors something may be known."""
    known = np.zeros(len(origin.measurement), dtype=bool)
    return NoiseCoordinates(origin, known if data.sensor_noise is None else np.isfinite(data.sensor_noise))


@dataclass(frozen=True)
class Priors:
    """What is expected of parameters, and where they are.

    Attributes
    ----------
    expected
        Of the free ones.
    values
        Of these, shape ``(p,)``.
    """

    expected: Expectations
    values: np.ndarray

    @classmethod
    def none(cls, white: Whitened) -> Priors:
        """Those of parameters of which nothing is expected."""
        count = white.columns.shape[1]
        return cls(Expectations(np.zeros((0, count)), np.zeros(0)), np.zeros(count))

    def best(self, white: Whitened) -> tuple[np.ndarray, float]:
        """The likeliest change of the parameters, shape ``(p,)``, and how many of them the data tell."""
        change, covariance = solve(*self.expected.beside(white.columns, white.innovations, self.values))
        rows = self.expected.rows
        return change, len(change) - float(np.einsum("rp,pq,rq->", rows, covariance, rows))


def estimate_noise(
    linearisation: Linearisation,
    data: Measurements,
    start: Noise,
    *,
    priors: Priors | None = None,
    charge: Callable[[float], None] | None = None,
    coarse: bool = False,
) -> Noise:
    """The noise of highest restricted likelihood along the trajectories in hand.

    The parameters are those that are best for the noise that the search begins with: they depend little on
    it, and a fit returns here once they have settled.

    Parameters
    ----------
    linearisation
        Along the trajectories.
    data
        The measurements.
    start
        Where the search begins. A process noise that is zero stays so.
    priors
        What is expected of the parameters.
    charge
        Called before each evaluation of the likelihood, with the share of the samples that it is for.
    coarse
        Whether some thousand samples are enough, where there are many more.
    """
    coordinates = noise_coordinates(data, start)
    driven, outputs = coordinates.driven, len(start.measurement)
    white = whiten(linearisation, data, start)
    change, _ = (priors or Priors.none(white)).best(white)
    linearisation = with_parameters_changed(linearisation, change)

    whole = Stretches(data.first, linearisation, np.append(np.diff(data.t), 0.0))
    some = whole.some(MANY)

    def cost_along(stretches: Stretches) -> Callable[[np.ndarray], float]:
        share = len(stretches.step) / len(whole.step)

        def cost(vector: np.ndarray) -> float:
            if charge is not None:
                charge(share)
            total, log_determinant, freedom = stretches.sums(coordinates.noise_at(vector))
            value = 0.5 * (total + log_determinant + freedom * np.log(2 * np.pi))
            return value if np.isfinite(value) else 1e300

        return cost

    cost = cost_along(some)
    begins = [np.zeros(coordinates.size)]
    # Upwards, too: a candidate that promised to need hardly any random forces may not have kept that.
    for factor in (1e-2, 1e-4, 1e-6, 1e2, 1e4) if len(driven) else ():
        begins.append(np.zeros(coordinates.size))
        begins[-1][outputs : outputs + len(driven)] = np.log(factor)
    best = min(begins, key=cost)
    # States that random forces drive could follow every sample; the noise of a sensor never vanishes.
    least = np.log(SMOOTHEST * data.roughness / start.measurement)
    bounds = [
        (0.0, 0.0) if coordinates.known[k] else (min(least[k], 0.0), best[k] + 12.0) for k in range(outputs)
    ]
    bounds += [(np.log(LOWEST), 12.0)] * len(driven)
    bounds += [(-10.0, 10.0)] * (coordinates.size - len(bounds))
    vector = _lowest(cost, best, bounds)
    if some is not whole and not coarse:
        ratio = len(whole.step) / len(some.step)
        vector = _corrected(vector, cost_along(whole), cost, ratio=ratio, bounds=bounds)
    noise = coordinates.noise_at(vector)
    gone = vector[outputs : outputs + len(driven)] <= np.log(LOWEST) + 1
    noise.process[driven[gone]] = 0.0
    return noise


def _lowest(
    cost: Callable[[np.ndarray], float], begin: np.ndarray, bounds: Sequence[tuple[float, float]]
) -> np.ndarray:
    found = scipy.optimize.minimize(
        cost, begin, method="L-BFGS-B", bounds=bounds, options={"maxiter": 12, "ftol": 1e-7, "eps": 1e-3}
    )
    return found.x if found.fun <= cost(begin) else begin


def _corrected(
    vector: np.ndarray,
    whole: Callable[[np.ndarray], float],
    some: Callable[[np.ndarray], float],
    *,
    ratio: float,
    bounds: Sequence[tuple[float, float]],
) -> np.ndarray:
    """The minimum of a cost from that of a part of it, by one Newton step with the curvature of the part.

    What is left is of second order in the difference of the two, which many samples make small; where they
    differ so much that the step leads upwards all is searched.

    Parameters
    ----------
    vector
        Where the part has its minimum.
    whole, some
        The two costs.
    ratio
        How much larger the whole is.
    bounds
        A coordinate at one of them stays there.
    """
    lower, upper = np.array(bounds).T
    inside = np.flatnonzero((vector > lower + AWAY) & (vector < upper - AWAY))
    unit = AWAY * np.eye(len(vector))[inside]
    middle, part = whole(vector), some(vector)
    ahead = np.array([some(vector + one) for one in unit])
    curvature = np.empty((len(inside), len(inside)))
    for row, one in enumerate(unit):
        curvature[row, row] = ahead[row] + some(vector - one) - 2 * part
        for column in range(row):
            both = some(vector + one + unit[column])
            curvature[row, column] = curvature[column, row] = both - ahead[row] - ahead[column] + part
    curvature *= ratio / AWAY**2
    slope = np.array([whole(vector + one) - middle for one in unit]) / AWAY - AWAY / 2 * np.diag(curvature)
    values, directions = np.linalg.eigh(curvature)
    # Where the likelihood is flat, as towards no random forces, there is nothing to correct.
    told = directions[:, values > TOLD]
    step = -told @ (told.T @ slope / values[values > TOLD])
    moved = vector.copy()
    moved[inside] += np.clip(step, -NEAR, NEAR)
    return moved if whole(moved) <= middle else _lowest(whole, vector, bounds)


def log_likelihood(linearisation: Linearisation, data: Measurements, noise: Noise) -> float:
    """Restricted log-likelihood along the trajectories in hand, the parameters at their best."""
    total, freedom, log_determinant = likelihood_sums(linearisation, data, noise)
    return -0.5 * (total + log_determinant + freedom * np.log(2 * np.pi))


def likelihood_sums(
    linearisation: Linearisation, data: Measurements, noise: Noise, *, weight: np.ndarray | float = 1.0
) -> tuple[float, int, float]:
    """Sum of squared innovations, degrees of freedom and log-determinant, the parameters at their best.

    Parameters
    ----------
    linearisation, data, noise
        Along which trajectories, for which recordings, at which noise.
    weight
        Factor on the process noise at each sample, shape ``(n,)``.
    """
    whole = Stretches(data.first, linearisation, np.append(np.diff(data.t), 0.0))
    total, log_determinant, freedom = whole.sums(noise, weight=weight)
    return total, freedom, log_determinant


def noise_along(
    linearisation: Linearisation,
    data: Measurements,
    noise: Noise,
    estimate_process: bool,
    *,
    priors: Priors | None = None,
    charge: Callable[[float], None] | None = None,
    coarse: bool = False,
) -> Noise:
    """The noise along the trajectories in hand, the process noise only where it is to be estimated, too."""
    if estimate_process and (noise.process > 0).any():
        return estimate_noise(linearisation, data, noise, priors=priors, charge=charge, coarse=coarse)
    driven = bool((noise.process > 0).any())
    if driven and data.sensor_noise is not None:
        return noise
    white = whiten(linearisation, data, noise)
    change, told = (priors or Priors.none(white)).best(white)
    left = (white.innovations - white.columns @ change).reshape(len(data.t), -1)
    known = white.known.reshape(left.shape)
    # Each output has its share of the initial states and parameters.
    share = (white.degrees_of_freedom - told) / known.sum()
    factor = (left**2).sum(axis=0) / np.maximum(known.sum(axis=0) * share, 1.0)
    if driven:  # one scale for both, since only their ratio is given
        factor = np.full_like(factor, (left**2).sum() / (known.sum() * share))
        return replace(noise, measurement=noise.measurement * factor, process=noise.process * factor[0])
    return replace(noise, measurement=data.with_known_noise(noise.measurement * np.maximum(factor, 1e-12)))
