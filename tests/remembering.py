"""Records that remember: double wells and a trap with coloured forces, or seen through an exposure.

Made without the library: nothing here knows of what reads them.
"""

from __future__ import annotations

import numba
import numpy as np
import scipy.signal

STEP = 0.01


@numba.njit(cache=True)
def _followed(
    x: np.ndarray,
    kicks: np.ndarray,
    dt: float,
    *,
    force: np.ndarray,
    keep: float,
    white: float,
    coloured: float,
) -> np.ndarray:
    """Every state in turn, of kicks ``(steps, states, traces)``; forces at random are white, or remember."""
    path = np.empty_like(kicks)
    for k in range(len(kicks)):
        path[k] = x
        for i in range(x.shape[0]):
            for j in range(x.shape[1]):
                drift = x[i, j] - x[i, j] ** 3 if i == 0 else -x[i, j]
                x[i, j] += dt * (drift + force[i, j]) + white * kicks[k, i, j]
                force[i, j] = keep * force[i, j] + coloured * kicks[k, i, j]
    return path


def double_wells(
    seed: int,
    *,
    states: int = 1,
    memory: float = 0.0,
    exposure: float = 0.0,
    sensor: float = 0.0,
    samples: int = 20_000,
    traces: int = 8,
    intensity: float = 0.2,
) -> np.ndarray:
    """``dx = (x - x³) dt + forces`` and ``dy = -y dt + forces``: the barrier of U is 1/2.

    Parameters
    ----------
    seed
        Of the forces.
    states
        1, of x alone, or 2.
    memory
        Of the forces, in sampling steps; 0 of white ones.
    exposure
        Of each sample, in sampling steps.
    sensor
        Standard deviation of an error in each sample.
    samples, traces
        How many.
    intensity
        ε.

    Returns
    -------
    numpy.ndarray
        Shape ``(traces, samples, states)``.
    """
    draw = np.random.default_rng(seed)
    within = 8 if memory or exposure else 4
    dt, lead = STEP / within, int(3 / STEP)
    x = np.zeros((states, traces))
    x[0] = np.where(np.arange(traces) % 2 == 0, 1.0, -1.0)
    spread = np.sqrt(intensity / (2 * memory * STEP)) if memory else 0.0
    force = spread * draw.standard_normal(x.shape)
    keep = np.exp(-1 / (memory * within)) if memory else 0.0
    kicks = draw.standard_normal(((lead + samples) * within, states, traces))
    white = 0.0 if memory else np.sqrt(intensity * dt)
    path = _followed(
        x, kicks, dt, force=force, keep=keep, white=white, coloured=spread * np.sqrt(1 - keep**2)
    )[lead * within :]
    return seen(path, exposure, within, sensor, draw)


def trap(seed: int, *, exposure: float, samples: int = 40_000, rate: float = 5.0) -> np.ndarray:
    """A bead in a trap, ``dx = -rate x dt + √ε dW`` with ε = 1: shape ``(1, samples, 1)``."""
    draw = np.random.default_rng(seed)
    within = 8
    dt = STEP / within
    keep = np.exp(-rate * dt)
    kicks = np.sqrt((1 - keep**2) / (2 * rate)) * draw.standard_normal(samples * within)
    path = scipy.signal.lfilter([1.0], [1.0, -keep], kicks)[:, None, None]
    return seen(path, exposure, within, 0.0, draw)


def seen(
    path: np.ndarray, exposure: float, within: int, sensor: float, draw: np.random.Generator
) -> np.ndarray:
    """What a camera records of a path: means over the exposure, and an error in each."""
    width = round(exposure * within)
    if width:
        total = np.cumsum(np.concatenate([np.zeros_like(path[:1]), path]), axis=0)
        path = (total[width:] - total[:-width]) / width
    values = np.ascontiguousarray(np.moveaxis(path[::within], 2, 0))
    return values + sensor * draw.standard_normal(values.shape)
