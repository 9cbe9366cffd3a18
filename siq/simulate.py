"""Simulate: trajectories of a system, sampled as snapshot pairs (paper, Appendix B).

Time runs in steps of the Runge–Kutta rule, all trajectories at once; the arrays hold components first,
``(d, trajectories)``, so that each component is contiguous.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from siq.errors import NumericalFailure
from siq.recordings import Recordings
from siq.systems import System

VectorField = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class SimulationOptions:
    """What is sampled from a simulated system; the defaults are the paper's (its Table B1).

    Attributes
    ----------
    trajectories
        N, the number of trajectories, with initial states uniform over the card's domain Ω.
    pairs
        M, the number of snapshot pairs along each trajectory.
    pair_step
        h, the time between the two snapshots of a pair, in the card's time unit.
    interval
        The time between pairs: they start at t_j = interval·j, j = 1 … M.
    substeps
        Steps of the fourth-order Runge–Kutta rule within h; the paper has 5.
    """

    trajectories: Annotated[int, Field(ge=2)] = 5000
    pairs: Annotated[int, Field(ge=1)] = 50
    pair_step: Annotated[float, Field(gt=0)] = 0.01
    interval: Annotated[float, Field(gt=0)] = 0.1
    substeps: Annotated[int, Field(ge=1)] = 5


def sampling_stride(options: SimulationOptions) -> int:
    """Number of integrator steps between the starts of two pairs.

    Raises
    ------
    ValueError
        When the interval is not a multiple of the integrator's step, or does not exceed h.
    """
    step = options.pair_step / options.substeps
    stride = round(options.interval / step)
    if abs(stride * step - options.interval) > 1e-9 * options.interval or stride <= options.substeps:
        raise ValueError(
            f"simulation.interval ({options.interval}) is not a multiple of the step"
            f" pair_step/substeps ({step}) that exceeds pair_step; change one of them"
        )
    return stride


def runge_kutta_step(vector_field: VectorField, x: np.ndarray, step: float) -> np.ndarray:
    """One step of the classical fourth-order Runge–Kutta rule.

    Parameters
    ----------
    vector_field
        f, mapping components ``(d, n)`` to components ``(d, n)``.
    x
        States, shape ``(d, n)``.
    step
        Time step.

    Returns
    -------
    numpy.ndarray
        States one step later, shape ``(d, n)``; the local error is O(step⁵).
    """
    k1 = vector_field(x)
    k2 = vector_field(x + (step / 2) * k1)
    k3 = vector_field(x + (step / 2) * k2)
    k4 = vector_field(x + step * k3)
    k2 += k3
    k2 *= 2
    k2 += k1
    k2 += k4
    k2 *= step / 6
    k2 += x
    return k2


def simulate_snapshots(
    system: System, *, options: SimulationOptions, generator: np.random.Generator
) -> Recordings:
    """Simulate trajectories from random initial states and keep their snapshot pairs.

    Parameters
    ----------
    system
        The system; its domain Ω is where the initial states are drawn, uniformly.
    options
        Sampling (paper, Appendix B).
    generator
        Source of the initial states; a run passes its own.

    Returns
    -------
    Recordings
        Every trajectory as one recording of 2·M samples at t_j and t_j + h. Consecutive samples no
        further apart than h are the pairs (X0, Xh); see `siq.recordings.snapshot_pairs`.

    Raises
    ------
    ValueError
        When the sampling does not fit the integrator's step.
    NumericalFailure
        When trajectories run to infinity.
    """
    step = options.pair_step / options.substeps
    stride = sampling_stride(options)
    lower, upper = system.domain.T
    count = options.trajectories
    x = generator.uniform(lower[:, None], upper[:, None], size=(system.dimension, count))
    samples = np.empty((count, 2 * options.pairs, system.dimension))
    with np.errstate(over="ignore", invalid="ignore"):  # a runaway trajectory is told below, by name
        for pair in range(options.pairs):
            for _ in range(stride - (options.substeps if pair else 0)):
                x = runge_kutta_step(system.vector_field, x, step)
            samples[:, 2 * pair] = x.T
            for _ in range(options.substeps):
                x = runge_kutta_step(system.vector_field, x, step)
            samples[:, 2 * pair + 1] = x.T
    lost = ~np.isfinite(samples).all(axis=(1, 2))
    if lost.any():
        raise NumericalFailure(
            f"{lost.sum()} of {count} trajectories of {system.name} run to infinity (the first is number"
            f" {int(lost.argmax())}); narrow the domains of the card or take more substeps"
        )
    starts = options.interval * np.arange(1, options.pairs + 1)
    times = np.stack([starts, starts + options.pair_step], axis=1).ravel()
    width = len(str(count - 1))
    return Recordings(
        names=system.states,
        units=system.units,
        labels=tuple(f"trajectory{index:0{width}d}" for index in range(count)),
        recording=np.repeat(np.arange(count), 2 * options.pairs),
        t=np.tile(times, count),
        values=samples.reshape(-1, system.dimension),
    )
