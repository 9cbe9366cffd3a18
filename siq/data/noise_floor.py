"""How strong are the two kinds of noise, as far as a look at neighbouring samples can tell?

Within a short window a motion without noise is nearly a polynomial of time. What is left of the samples
besides polynomials of low degree is noise: of random forces, whose effect adds up from sample to sample, or
of the sensor, which is new in each. Their covariances differ, and both strengths follow from that of the
windows by maximum likelihood. This takes milliseconds, and is a first look: what f and D are is found by
`siq.identify`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from siq.data.recordings import Recordings

WINDOWS = (32, 16, 8)  # samples; the longest of which the recordings hold enough
ENOUGH = 10  # windows, at least
MOST = 4000  # windows looked at
EVEN = 0.01  # of a step: windows whose steps differ by more are left out
SMOOTH_SHARE = 4  # polynomials of a degree below window/4 may be motion
FILLED = 0.6  # of the power that noise would have in the highest degrees
VISIBLE = 1e-3  # of the rms step of a state: noise below that share is not told from motion


@dataclass(frozen=True)
class NoiseFloor:
    """The noise of one state.

    Attributes
    ----------
    sensor
        Standard deviation of the sensor's error, in the state's unit; 0 where none is seen.
    process
        Variance that random forces add per unit of time; 0 where none is seen.
    sensor_error, process_error
        Their standard errors.
    """

    sensor: float
    process: float
    sensor_error: float
    process_error: float


def noise_floors(recordings: Recordings) -> tuple[NoiseFloor, ...] | None:
    """The noise of each state; None where too few neighbouring samples are evenly spaced.

    Parameters
    ----------
    recordings
        Trajectories; of long ones a part is looked at.
    """
    for width in WINDOWS:
        rows = _windows(recordings, width)
        if len(rows) >= ENOUGH:
            return tuple(_floor(recordings, rows, column, width) for column in range(len(recordings.names)))
    return None


def _windows(recordings: Recordings, width: int) -> np.ndarray:
    """First rows of windows that lie in one recording and are evenly spaced."""
    t, recording = recordings.t, recordings.recording
    inside = recording[1:] == recording[:-1]
    if not inside.any():
        return np.zeros(0, dtype=int)
    gap = np.diff(t)
    usual = float(np.median(gap[inside]))
    # Written times are rounded: 0.033, 0.067, 0.1.
    even = inside & (np.abs(gap - usual) <= EVEN * usual + 4 * np.spacing(np.abs(t[1:])))
    broken = np.append(0, np.cumsum(~even))
    begins = np.arange(0, len(t) - width + 1, width // 2)
    begins = begins[broken[begins + width - 1] == broken[begins]]
    return begins[:: max(len(begins) // MOST, 1)]


def _floor(recordings: Recordings, begins: np.ndarray, column: int, width: int) -> NoiseFloor:
    step = float(np.median(recordings.t[begins + 1] - recordings.t[begins]))
    window = recordings.values[:, column][begins[:, None] + np.arange(width)]
    centre = np.linspace(-1, 1, width)
    polynomials = np.linalg.qr(np.polynomial.legendre.legvander(centre, width - 1))[0]
    walk = np.minimum.outer(np.arange(width), np.arange(width)).astype(float)
    typical = float(np.mean(np.diff(window, axis=1) ** 2))
    for lowest in (width // SMOOTH_SHARE, width // 2):
        contrasts = polynomials[:, lowest:]
        rest = (window - window[:, :1]) @ contrasts
        empirical = rest.T @ rest / len(rest)
        parts = np.array([contrasts.T @ contrasts, contrasts.T @ walk @ contrasts])
        # Windows overlap by a half, so that about half of them are independent.
        (sensor, process), errors = _most_likely(parts, empirical, len(rest) / 2)
        if 2 * sensor + process <= VISIBLE**2 * typical:
            break
        # A motion that is no polynomial leaves hardly anything in the highest degrees, which noise fills.
        highest = np.arange(len(empirical)) >= len(empirical) // 2
        foreseen = np.diag(sensor * parts[0] + process * parts[1])[highest].sum()
        if np.diag(empirical)[highest].sum() < FILLED * foreseen:
            continue
        deviation = float(np.sqrt(sensor))
        error = float(errors[0] / (2 * deviation)) if sensor > 0 else float(np.sqrt(errors[0]))
        return NoiseFloor(deviation, float(process) / step, error, float(errors[1]) / step)
    return NoiseFloor(0.0, 0.0, 0.0, 0.0)


def _most_likely(parts: np.ndarray, empirical: np.ndarray, count: float) -> tuple[np.ndarray, np.ndarray]:
    """Two variances θ ≥ 0 with which θ₁A + θ₂B explains the empirical covariance best; with their errors."""
    size = float(np.trace(empirical))
    if size <= 0:
        return np.zeros(2), np.zeros(2)
    theta = np.array([size / np.trace(part) / 2 for part in parts])
    information = np.eye(2)
    for _ in range(50):
        inverse = np.linalg.inv(np.tensordot(theta, parts, 1))
        weighted = [inverse @ part for part in parts]
        information = np.array([[np.sum(a * b.T) for b in weighted] for a in weighted])
        goal = np.array([np.sum(a * (inverse @ empirical).T) for a in weighted])
        new = np.linalg.solve(information, goal)
        for place in range(2):
            if new[place] <= 0:  # then the other alone
                new = np.where(np.arange(2) == place, 0.0, goal / np.diag(information))
        new = np.maximum(new, 1e-12 * new.max())
        if np.abs(new - theta).max() <= 1e-6 * new.max():
            theta = new
            break
        theta = new
    errors = np.sqrt(2 * np.diag(np.linalg.inv(information)) / count)
    return np.where(theta > 2 * errors, theta, 0.0), errors
