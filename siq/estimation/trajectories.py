"""Whole trajectories by damped least squares: for fits that Gauss–Newton steps at all samples do not settle.

`siq.estimation.estimation.fit_by_multiple_shooting` moves the states at all samples at once and is fast,
but where f jumps, or nearly, its linearised steps can go to and fro without end. Here only initial states and
parameters are unknown, every trajectory follows its equations at every step, and no step makes the fit worse.
"""

from __future__ import annotations

import numpy as np
import scipy.optimize

from siq.dynamics.dynamics import Dynamics
from siq.estimation.estimation import Fit, fit_of_states
from siq.estimation.innovations import Noise
from siq.estimation.linearisation import Grid, Linearisation, integrate_intervals, linearise
from siq.estimation.measurements import Measurements

ACCURACY = 1e-4  # relative change of the sum of squares at which a fit has converged
TRIALS = 25  # most simulations of all recordings


def run(model: Dynamics, grid: Grid, begin: np.ndarray) -> np.ndarray:
    """Integrate recordings from their initial states, shape ``(recordings, d)``, to all samples ``(n, d)``.

    A simulation that runs away is NaN from there on.
    """
    data = grid.data
    states = np.full((len(data.t), model.dimension), np.nan)
    lengths = np.diff(data.first)
    current = begin.T.copy()
    states[data.first[:-1]] = begin
    places = np.concatenate([[0], np.cumsum(lengths - 1)])[:-1]
    for sample in range(int(lengths.max()) - 1):
        alive = np.flatnonzero(lengths > sample + 1)
        one = grid.at_intervals(places[alive] + sample)
        with np.errstate(all="ignore"):
            after = integrate_intervals(model, one, model.values, current[:, alive])
        current[:, alive] = after
        states[data.first[alive] + sample + 1] = after.T
    return states


def fit_trajectories(
    model: Dynamics, data: Measurements, *, begin: np.ndarray, noise: Noise, substeps: int
) -> Fit:
    """Fit free parameters and initial states, without process noise, by a trust-region method.

    Slower by far than `siq.estimation.estimation.fit_by_multiple_shooting`, for it simulates sample after
    sample, and lost where the motion is chaotic; to be used where that one does not settle.

    Parameters
    ----------
    model
        Its parameters' values are where the fit begins.
    data
        The measurements.
    begin
        Initial states to begin with, shape ``(recordings, d)``.
    noise
        Of which only the measurement noise is used, for the weights of the outputs.
    substeps
        Runge–Kutta steps between samples.

    Returns
    -------
    Fit
        Not converged where the simulation runs away at the begin, or `TRIALS` simulations are not enough.
    """
    free = np.array(model.free, dtype=int)
    grid = Grid(data, substeps)
    known = np.isfinite(data.outputs)
    weight = 1 / np.sqrt(noise.measurement)
    along = _Along(model, grid)

    def residual(unknown: np.ndarray) -> np.ndarray:
        values, states = along.trajectory(unknown)
        outputs = model.functions.outputs(states.T, grid.at_samples(model.lags(values)), values).T
        return ((outputs - data.outputs) * weight)[known]

    def jacobian(unknown: np.ndarray) -> np.ndarray:
        slopes = (sensitivities(along.linearised(unknown), data) * weight[:, None])[known]
        return np.where(np.isfinite(slopes), slopes, 0.0)  # as of a root at zero: no direction is known

    unknown = np.concatenate([model.values[free], begin.ravel()])
    converged = False
    with np.errstate(all="ignore"):
        first = residual(unknown)
        if np.isfinite(first @ first):
            found = scipy.optimize.least_squares(
                residual,
                unknown,
                jacobian,
                x_scale="jac",
                ftol=ACCURACY,
                xtol=1e-8,
                gtol=None,
                max_nfev=TRIALS,
            )
            unknown, converged = found.x, found.status > 0
    values, states = along.trajectory(unknown)
    return fit_of_states(
        model.with_values(values),
        data,
        x=states,
        noise=noise.without_process(),
        substeps=substeps,
        converged=converged,
    )


def sensitivities(linearisation: Linearisation, data: Measurements) -> np.ndarray:
    """Derivatives of the outputs by parameters and all initial states, shape ``(n, m, p + r d)``.

    Along trajectories without gaps; r recordings have d states each.
    """
    count, dimension, parameters = linearisation.response.shape
    recordings = len(data.labels)
    by_state = np.zeros((count, dimension, parameters + recordings * dimension))
    for place, (first, end) in enumerate(zip(data.first[:-1], data.first[1:], strict=True)):
        own = slice(parameters + place * dimension, parameters + (place + 1) * dimension)
        now = np.zeros((dimension, parameters + dimension))
        now[:, parameters:] = np.eye(dimension)
        for row in range(first, end):
            by_state[row, :, :parameters], by_state[row, :, own] = now[:, :parameters], now[:, parameters:]
            now = linearisation.transition[row] @ now
            now[:, :parameters] += linearisation.response[row]
    result = np.einsum("nmd,ndk->nmk", linearisation.measured, by_state)
    result[:, :, :parameters] += linearisation.measured_response
    return result


class _Along:
    """Trajectories from parameters and initial states; the last one is kept for its derivative."""

    def __init__(self, model: Dynamics, grid: Grid) -> None:
        self._model, self._grid = model, grid
        self._free = np.array(model.free, dtype=int)
        self._last: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None

    def trajectory(self, unknown: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """All parameters, and the states at all samples."""
        if self._last is None or not np.array_equal(self._last[0], unknown):
            values = self._model.values
            values[self._free] = unknown[: len(self._free)]
            begin = unknown[len(self._free) :].reshape(-1, self._model.dimension)
            states = run(self._model.with_values(values), self._grid, begin)
            self._last = (unknown.copy(), values, states)
        return self._last[1], self._last[2]

    def linearised(self, unknown: np.ndarray) -> Linearisation:
        values, states = self.trajectory(unknown)
        return linearise(self._model, self._grid, values, states)
