"""What does a sample tell of the state if it is a mean over some time before it?

A camera that is exposed shows no state, but the mean of the state over the exposure. Such means remember: a
part of the same path may be in two of them. With the running mean as a state of its own, which begins anew
with every exposure, the system is Markovian again, and a filter treats it like any other.

An exposure that is shorter than the step begins between two samples, at an instant at which nothing is
measured. Where it is longer, of several samples one is kept, so that no two exposures overlap: of how the
state moves these tell nearly as much as all, as long as they are close beside the time in which it relaxes.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from siq.dynamics.diffusion import Diffusion
from siq.dynamics.dynamics import Dynamics
from siq.dynamics.parametric import symbol
from siq.estimation.innovations import Noise
from siq.estimation.measurements import Measurements

SAME = 1e-6  # of an exposure: what rounding leaves between two instants


def kept_samples(step: float, exposure: float) -> int:
    """Of how many samples one is kept, so that exposures do not overlap."""
    return max(int(np.ceil(exposure / step * (1 - SAME))), 1)


def exposed(model: Dynamics, exposure: float) -> Dynamics:
    """The same dynamics, of which each sample is the mean over the exposure before it.

    Parameters
    ----------
    model
        Of d states, all of them measured.
    exposure
        Its length, in the unit of time.

    Returns
    -------
    Dynamics
        Of 2d states: the d states, and their running means, which are what is measured.
    """
    names = [f"_mean_{name}" for name in model.states]
    return Dynamics(
        states=(*model.states, *names),
        equations=(*model.equations, *(each / exposure for each in model.symbols)),
        diffusion=Diffusion(np.eye(2 * model.dimension)),
        parameters=model.parameters,
        outputs=tuple((name, symbol(mean)) for (name, _), mean in zip(model.outputs, names, strict=True)),
    )


def exposed_measurements(data: Measurements, dimension: int, exposure: float) -> Measurements:
    """The same measurements, with running means that begin anew where an exposure does.

    Where that is between two samples a row without any measured value stands there.
    """
    restarting = tuple(range(dimension, 2 * dimension))
    ends = data.begins + 1
    start = data.t[ends] - exposure
    inside = start > data.t[ends - 1] + SAME * exposure
    at, before = ends[inside], np.searchsorted(ends[inside], data.first)
    return replace(
        data,
        first=data.first + before,
        t=np.insert(data.t, at, start[inside]),
        outputs=np.insert(data.outputs, at, np.nan, axis=0),
        restarting=restarting,
    )


def exposed_noise(noise: Noise, dimension: int) -> Noise:
    """The same noise, of which nothing drives the running means."""
    process = np.concatenate([noise.process, np.zeros(dimension)])
    shape = None
    if noise.shape is not None and noise.field is None:
        shape = np.eye(2 * dimension)[None].copy()
        shape[0, :dimension, :dimension] = noise.shape[0]
    return Noise(noise.measurement, process, shape, noise.field)
