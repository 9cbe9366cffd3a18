"""How well is the noise known, and what does that leave open in the parameters?

A filter that took a sensor for noisier than it is follows the recordings less, and takes f at other states.
The coefficients of f depend on the noise, and the noise is an estimate.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from siq.estimation.fit import Fit
from siq.estimation.innovations import Noise, solve, whiten, with_parameters_changed
from siq.estimation.measurements import Measurements
from siq.estimation.noise import log_likelihood, noise_coordinates

STEP = 0.05  # numerical: of the logarithm of a variance, for differences of the likelihood
UNKNOWN = (
    1.0  # standard error of a logarithm beyond which the likelihood is no parabola: the bound is far off
)


@dataclass(frozen=True)
class NoiseUncertainty:
    """Errors of a noise, and of the parameters with it.

    Attributes
    ----------
    measurement
        Standard errors of the logarithms of the sensors' variances, shape ``(m,)``; infinite where a
        variance is only bounded from above, zero where it was given.
    process
        The same of the random forces' intensities, shape ``(d,)``.
    covariance
        Of the free parameters, with what the noise leaves open in them, shape ``(p, p)``.
    """

    measurement: np.ndarray
    process: np.ndarray
    covariance: np.ndarray


def noise_uncertainty(fit: Fit, data: Measurements) -> NoiseUncertainty:
    """Errors of the noise of a fit, by the curvature of the likelihood along its trajectories."""
    coordinates = noise_coordinates(data, fit.noise)
    line = fit.linearisation
    white = whiten(line, data, fit.noise)
    still = with_parameters_changed(line, solve(white.columns, white.innovations)[0])
    outputs = len(coordinates.known)
    places = [k for k in range(coordinates.size) if k >= outputs or not coordinates.known[k]]

    def moved(*changes: tuple[int, float]) -> Noise:
        vector = np.zeros(coordinates.size)
        for place, change in changes:
            vector[place] += change
        return coordinates.noise_at(vector)

    def value(*changes: tuple[int, float]) -> float:
        return log_likelihood(still, data, moved(*changes))

    middle, h = value(), STEP
    single = {k: (value((k, h)), value((k, -h))) for k in places}
    curvature = np.diag([(2 * middle - single[k][0] - single[k][1]) / h**2 for k in places])
    for row, one in enumerate(places):
        for column, other in enumerate(places[:row]):
            both = value((one, h), (other, h)) + value((one, -h), (other, -h))
            apart = value((one, h), (other, -h)) + value((one, -h), (other, h))
            curvature[row, column] = curvature[column, row] = (apart - both) / (4 * h**2)
    told = np.diag(curvature) > 1 / UNKNOWN**2
    errors = np.full(coordinates.size, np.inf)
    errors[:outputs][coordinates.known] = 0.0
    inside = [place for place, known in zip(places, told, strict=True) if known]
    covariance = fit.covariance
    if inside:
        of_noise = np.linalg.pinv(curvature[np.ix_(told, told)], hermitian=True)
        errors[inside] = np.sqrt(np.maximum(np.diag(of_noise), 0.0))
        changes = []
        for place in inside:
            ends = []
            for sign in (1, -1):
                white = whiten(line, data, moved((place, sign * h)))
                ends.append(solve(white.columns, white.innovations)[0])
            changes.append((ends[0] - ends[1]) / (2 * h))
        slope = np.stack(changes, axis=1)
        covariance = covariance + slope @ of_noise @ slope.T
    driven = coordinates.driven
    process = np.zeros_like(fit.noise.process)
    process[driven] = errors[outputs : outputs + len(driven)]
    return NoiseUncertainty(errors[:outputs], process, covariance)
