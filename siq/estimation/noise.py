"""The two kinds of noise: of the sensors (variance R), and what drives the states (intensity Q per time).

The variances are those of highest restricted likelihood, which allows for the initial states and parameters
that are fitted beside them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.optimize

from siq.dynamics.dynamics import Dynamics
from siq.estimation.innovations import Noise, solve, whiten, with_parameters_changed
from siq.estimation.linearisation import Linearisation
from siq.estimation.measurements import Measurements
from siq.estimation.noise_kernel import noise_likelihood

SMOOTHEST = 1e-4  # least measurement noise, as a share of what third differences show
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


def estimate_noise(linearisation: Linearisation, data: Measurements, start: Noise) -> Noise:
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
    """
    coordinates = noise_coordinates(data, start)
    driven, outputs = coordinates.driven, len(start.measurement)
    white = whiten(linearisation, data, start)
    linearisation = with_parameters_changed(linearisation, solve(white.columns, white.innovations)[0])

    def cost(vector: np.ndarray) -> float:
        value = -log_likelihood(linearisation, data, coordinates.noise_at(vector))
        return value if np.isfinite(value) else 1e300

    begins = [np.zeros(coordinates.size)]
    for factor in (1e-2, 1e-4, 1e-6) if len(driven) else ():
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
    found = scipy.optimize.minimize(
        cost, best, method="L-BFGS-B", bounds=bounds, options={"maxiter": 12, "ftol": 1e-7, "eps": 1e-3}
    )
    vector = found.x if found.fun <= cost(best) else best
    noise = coordinates.noise_at(vector)
    gone = vector[outputs : outputs + len(driven)] <= np.log(LOWEST) + 1
    noise.process[driven[gone]] = 0.0
    return noise


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
    total, log_determinant, freedom = noise_likelihood(
        data.first,
        linearisation.transition,
        linearisation.response,
        linearisation.gap,
        linearisation.measured,
        linearisation.measured_response,
        linearisation.residual,
        weight * np.append(np.diff(data.t), 0.0),
        noise.measurement,
        noise.intensity,
    )
    return total, freedom, log_determinant


def noise_along(
    linearisation: Linearisation, data: Measurements, noise: Noise, estimate_process: bool
) -> Noise:
    """The noise along the trajectories in hand, the process noise only where it is to be estimated, too."""
    if estimate_process and (noise.process > 0).any():
        return estimate_noise(linearisation, data, noise)
    driven = bool((noise.process > 0).any())
    if driven and data.sensor_noise is not None:
        return noise
    white = whiten(linearisation, data, noise)
    change, _ = solve(white.columns, white.innovations)
    left = (white.innovations - white.columns @ change).reshape(len(data.t), -1)
    known = white.known.reshape(left.shape)
    # Each output has its share of the initial states and parameters.
    share = (white.degrees_of_freedom - len(change)) / known.sum()
    factor = (left**2).sum(axis=0) / np.maximum(known.sum(axis=0) * share, 1.0)
    if driven:  # one scale for both, since only their ratio is given
        factor = np.full_like(factor, (left**2).sum() / (known.sum() * share))
        return replace(noise, measurement=noise.measurement * factor, process=noise.process * factor[0])
    return replace(noise, measurement=data.with_known_noise(noise.measurement * np.maximum(factor, 1e-12)))
