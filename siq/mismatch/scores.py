"""Scores of simulations on held-out recordings, in the recordings' own units."""

from __future__ import annotations

import numpy as np

from siq.dynamics.dynamics import Dynamics
from siq.estimation.free_runs import free_run
from siq.estimation.innovations import Noise
from siq.estimation.measurements import Measurements

PREFIX = 200  # samples of a whole recording from which a simulation may learn its initial state
SUBSTEPS = 4  # Runge-Kutta steps between samples


def windows(data: Measurements, length: int) -> Measurements:
    """Recordings cut into windows of so many samples; what is too short at the end of each is left out.

    The inputs stay those of the whole recordings, so that nothing rings at the begin of a window.
    """
    starts, origin = [], []
    for place, (begin, end) in enumerate(zip(data.first[:-1], data.first[1:], strict=True)):
        own = np.arange(begin, end - length + 1, length)
        starts.append(own)
        origin += [place] * len(own)
    rows = (np.concatenate(starts)[:, None] + np.arange(length)).ravel()
    return Measurements(
        labels=tuple(f"{data.labels[place]}:{number}" for number, place in enumerate(origin)),
        first=np.arange(len(origin) + 1) * length,
        t=data.t[rows],
        outputs=data.outputs[rows],
        courses=tuple(data.courses[place] for place in origin),
    )


def root_mean_square(
    model: Dynamics, data: Measurements, *, variance: np.ndarray, window: int | None
) -> tuple[float, ...]:
    """Root mean square error of each output of a free run, in its unit; NaN where the simulation ran away.

    Parameters
    ----------
    model
        With the parameters' values to be used.
    data
        The recordings.
    variance
        Of the measurement noise, shape ``(m,)``: how outputs weigh when the initial state is estimated.
    window
        Length of the windows into which recordings are cut, each with a prefix of a fifth from which its
        initial state is estimated; None for whole recordings, with a prefix of `PREFIX` samples.
    """
    noise = Noise(np.asarray(variance, dtype=float), np.zeros(model.dimension))
    if window is not None:
        run = free_run(model, (data := windows(data, window)), noise=noise, substeps=SUBSTEPS)
    else:
        share = min(0.2, PREFIX / float(np.diff(data.first).min()))
        run = free_run(model, data, noise=noise, substeps=SUBSTEPS, prefix=share)
    error = run.outputs[run.scored] - data.outputs[run.scored]
    measured = np.isfinite(data.outputs[run.scored])
    return tuple(float(np.sqrt(np.mean(error[known, place] ** 2))) for place, known in enumerate(measured.T))
