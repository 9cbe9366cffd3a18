"""Scores of simulations on the official tests of benchmarks, in the recordings' own units."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from siq.dynamics.dynamics import Dynamics
from siq.estimation.free_runs import free_run
from siq.estimation.innovations import Noise
from siq.estimation.measurements import Measurements

EXACT = 1e-3  # relative change of an error by halving the steps of the integration, below which they are fine
FINEST = 64  # Runge-Kutta steps between samples


@dataclass(frozen=True)
class ScoredRun:
    """A free run over a recording of which a simulation was told no more than how it begins.

    Attributes
    ----------
    simulated
        Outputs, shape ``(n, m)``; NaN from where the simulation ran away.
    errors
        Root mean square error of each output behind what it was told, in its unit, shape ``(m,)``.
    """

    simulated: np.ndarray
    errors: np.ndarray


def scored_run(model: Dynamics, data: Measurements, *, variance: np.ndarray, window: int) -> ScoredRun:
    """Simulate a recording and score it, as official tests of benchmarks ask for.

    Parameters
    ----------
    model
        With the parameters' values to be used.
    data
        One recording.
    variance
        Of the measurement noise, shape ``(m,)``: how outputs weigh when the initial state is estimated.
    window
        Samples at the begin that tell the initial state. They are not scored.
    """
    noise = Noise(np.asarray(variance, dtype=float), np.zeros(model.dimension))
    substeps, before = 2, np.inf
    while True:
        run = free_run(model, data, noise=noise, substeps=substeps, told=window)
        with np.errstate(all="ignore"):  # what ran away has no error
            squares = (run.outputs[run.scored] - data.outputs[run.scored]) ** 2
        measured = np.isfinite(data.outputs[run.scored])
        errors = np.sqrt([squares[known, place].mean() for place, known in enumerate(measured.T)])
        total = float(np.sqrt((errors**2 / noise.measurement).sum()))
        if abs(total - before) <= EXACT * total or 2 * substeps > FINEST:
            return ScoredRun(run.outputs, errors)
        substeps, before = 2 * substeps, total
