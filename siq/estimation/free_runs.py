"""How far is a simulation off that runs freely, told only how a recording begins?

Every simulation runs from the end of a prefix of each recording. From the prefix, which is not scored, it
estimates its own state at the begin; the prefix is the same for all.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from siq.dynamics.dynamics import Dynamics
from siq.dynamics.parametric import symbol
from siq.estimation.estimation import fit_by_multiple_shooting
from siq.estimation.first_states import first_states
from siq.estimation.innovations import Noise
from siq.estimation.linearisation import Grid
from siq.estimation.measurements import Measurements
from siq.estimation.trajectories import fit_trajectories, run

SHORTEST_PREFIX = 8  # samples
PREFIX = 0.2  # of a recording


@dataclass(frozen=True)
class FreeRun:
    """A simulation of held-out recordings.

    Attributes
    ----------
    outputs
        Shape ``(n, m)``; NaN from where the simulation ran away.
    scored
        Rows behind the prefixes, shape ``(n,)``.
    """

    outputs: np.ndarray
    scored: np.ndarray


@dataclass(frozen=True)
class UsualStates:
    """Where a system usually is: what a prefix does not tell of a state that nobody measures.

    Attributes
    ----------
    mean, width
        Of each state: its mean, and how far from there it may well begin; shape ``(d,)``.
    """

    mean: np.ndarray
    width: np.ndarray

    @classmethod
    def along(cls, x: np.ndarray) -> UsualStates:
        """Of states ``(n, d)`` along recordings: anywhere within their range, as many begin at its ends."""
        return cls(x.mean(axis=0), np.ptp(x, axis=0))


def free_run(
    model: Dynamics,
    data: Measurements,
    *,
    noise: Noise,
    substeps: int,
    told: int | None = None,
    usual: UsualStates | None = None,
) -> FreeRun:
    """Simulate recordings from states that their prefixes tell.

    Parameters
    ----------
    model
        With the parameters' values to be used; nothing but initial states is fitted.
    data
        The recordings.
    noise
        The measurement noise weighs the outputs; the process noise lets the states follow the prefix first.
    substeps
        Runge–Kutta steps between samples.
    told
        Samples of each prefix; by default a fifth of the recording, and `SHORTEST_PREFIX` at least.
    usual
        Where the states are expected beforehand; by default nothing is.
    """
    rows = told_rows(data, told)
    prefix = data.until(np.maximum(rows, 2))
    x = initial_states(model, prefix, noise=noise, substeps=substeps, usual=usual)
    states = run(model, Grid(data, substeps), x)
    signals = data.signals(data.t, data.recording, delays=model.lags(model.values))
    within = np.arange(len(data.t)) - data.first[data.recording]
    return FreeRun(
        outputs=model.functions.outputs(states.T, signals, model.values).T,
        scored=within >= rows[data.recording],
    )


def told_rows(data: Measurements, told: int | None = None) -> np.ndarray:
    """How many rows of each recording tell its initial state, shape ``(recordings,)``; see `free_run`."""
    lengths = np.diff(data.first)
    if told is None:
        rows = np.maximum((PREFIX * lengths).astype(int), SHORTEST_PREFIX)
    else:
        rows = np.full(len(lengths), told)
    return np.minimum(rows, lengths - 1)


def initial_states(
    model: Dynamics,
    data: Measurements,
    *,
    noise: Noise,
    substeps: int,
    usual: UsualStates | None = None,
) -> np.ndarray:
    """The states in which recordings begin, shape ``(recordings, d)``, with all parameters as they are."""
    still = replace(model, parameters=tuple(replace(each, fixed=True) for each in model.parameters))
    process = np.zeros(model.dimension)
    process[: len(noise.process)] = noise.process
    start = first_states(still, data)
    if usual is not None:
        still, data, noise = _with_usual_states(still, data, noise, usual)
    follow = fit_by_multiple_shooting(
        still,
        data,
        x=start,
        noise=Noise(noise.measurement, process),
        estimate_process=False,
        substeps=substeps,
    )
    x = follow.x if np.isfinite(follow.sum_of_squares) else start
    strict = fit_by_multiple_shooting(
        still,
        data,
        x=x,
        noise=Noise(noise.measurement, np.zeros(model.dimension)),
        estimate_process=False,
        substeps=substeps,
    )
    if strict.converged:
        return strict.x[data.first[:-1]]
    # Where f jumps or a reading is cut off, steps of all samples at once may go to and fro. Damped steps of
    # whole trajectories never make it worse.
    damped = fit_trajectories(still, data, begin=x[data.first[:-1]], noise=noise, substeps=substeps)
    best = damped.x if np.isfinite(damped.sum_of_squares) else x
    return best[data.first[:-1]]


def _with_usual_states(
    model: Dynamics, data: Measurements, noise: Noise, usual: UsualStates
) -> tuple[Dynamics, Measurements, Noise]:
    """What is expected of first states, as if it were measured: once, and as inaccurately as it is known."""
    moving = np.flatnonzero(usual.width > 0)
    names = [model.states[place] for place in moving]
    expected = np.full((len(data.t), len(names)), np.nan)
    expected[data.first[:-1]] = usual.mean[moving]
    variances = np.concatenate([noise.measurement, usual.width[moving] ** 2])
    return (
        replace(model, outputs=(*model.outputs, *((f"usual_{name}", symbol(name)) for name in names))),
        replace(data, outputs=np.hstack([data.outputs, expected]), sensor_noise=variances),
        replace(noise, measurement=variances),
    )


def normalised_rms(outputs: np.ndarray, simulated: FreeRun) -> float | None:
    """Root mean square error over that of the outputs about their mean; None where a simulation ran away.

    Parameters
    ----------
    outputs
        As measured, shape ``(n, m)``.
    simulated
        The free run of the same recordings.
    """
    squares = squared_errors(outputs, simulated)
    return None if squares is None else float(np.sqrt(squares.mean()))


def squared_errors(outputs: np.ndarray, simulated: FreeRun) -> np.ndarray | None:
    """Squared errors over the variance of each output, of every value that is scored; see `normalised_rms`.

    Returns
    -------
    numpy.ndarray or None
        Shape ``(values,)``, sample by sample; what was not measured is left out. None where a simulation ran
        away.
    """
    measured = outputs[simulated.scored]
    error = simulated.outputs[simulated.scored] - measured
    known = np.isfinite(measured)
    if not np.isfinite(error[known]).all():
        return None
    spread = np.nanvar(measured, axis=0)
    squares: np.ndarray = (error**2 / np.where(spread > 0, spread, 1.0))[known]
    return squares
