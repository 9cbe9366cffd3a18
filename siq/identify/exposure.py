"""What does a sample tell of the state if it is a mean over the time since the sample before?

A camera that is exposed over its whole step shows no state, but the mean of the state over the step. Such
means remember: a part of the same path is in two of them. With the running mean as a state of its own, which
begins anew with every sample, the system is Markovian again, and a filter treats it like any other.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from siq.dynamics.diffusion import Diffusion
from siq.dynamics.dynamics import Dynamics
from siq.dynamics.parametric import symbol
from siq.estimation.innovations import Noise
from siq.estimation.measurements import Measurements


def exposed(model: Dynamics, step: float) -> Dynamics:
    """The same dynamics, of which each sample is the mean over the step before it.

    Parameters
    ----------
    model
        Of d states, all of them measured.
    step
        The time between samples.

    Returns
    -------
    Dynamics
        Of 2d states: the d states, and their running means, which are what is measured.
    """
    names = [f"_mean_{name}" for name in model.states]
    return Dynamics(
        states=(*model.states, *names),
        equations=(*model.equations, *(each / step for each in model.symbols)),
        diffusion=Diffusion(np.eye(2 * model.dimension)),
        parameters=model.parameters,
        outputs=tuple((name, symbol(mean)) for (name, _), mean in zip(model.outputs, names, strict=True)),
    )


def exposed_measurements(data: Measurements, dimension: int) -> Measurements:
    """The same measurements, with running means that begin anew with every interval."""
    return replace(data, restarting=tuple(range(dimension, 2 * dimension)))


def exposed_noise(noise: Noise, dimension: int) -> Noise:
    """The same noise, of which nothing drives the running means."""
    process = np.concatenate([noise.process, np.zeros(dimension)])
    shape = None
    if noise.shape is not None:
        shape = np.eye(2 * dimension)[None].copy()
        shape[0, :dimension, :dimension] = noise.shape[0]
    return Noise(noise.measurement, process, shape)
