"""Recordings of a damped particle in a double well, of its position alone."""

from __future__ import annotations

import numpy as np

from siq.data.recordings import Recordings

TEMPERATURE = 0.08  # the barrier is a quarter


def particle(
    seed: int,
    *,
    friction: float = 0.3,
    records: int = 8,
    samples: int = 2_500,
    step: float = 0.05,
    sensor: float = 0.02,
    within: int = 10,
) -> tuple[Recordings, np.ndarray]:
    """Records of dv = (x - x³ - γv) dt + √(2γT) dW by x alone, and the velocities, shape ``(n,)``.

    By the splitting BAOAB (Leimkuhler and Matthews 2013).
    """
    draw = np.random.default_rng(seed)
    small = step / within
    kept = np.exp(-friction * small)
    spread = np.sqrt(TEMPERATURE * (1 - kept**2))
    x = np.where(np.arange(records) % 2, -1.0, 1.0)
    v = np.sqrt(TEMPERATURE) * draw.standard_normal(records)
    positions, velocities = np.empty((records, samples)), np.empty((records, samples))
    for row in range(samples):
        positions[:, row], velocities[:, row] = x, v
        for push in spread * draw.standard_normal((within, records)):
            v = v + small / 2 * (x - x**3)
            x = x + small / 2 * v
            v = kept * v + push
            x = x + small / 2 * v
            v = v + small / 2 * (x - x**3)
    measured = positions + sensor * draw.standard_normal(positions.shape)
    recordings = Recordings.from_arrays(step * np.arange(samples), measured[:, :, None], names=["x"])
    return recordings, velocities.ravel()
