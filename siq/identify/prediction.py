"""Long-term prediction: trajectories of an identified f beside those that were recorded."""

from __future__ import annotations

import numpy as np

from siq.data.recordings import Recordings
from siq.dynamics.dynamics import Dynamics
from siq.dynamics.simulation import runge_kutta_step

ACCURACY = 0.05  # step times the norm of the Jacobian, per step of the integrator
MOST_STEPS = 5000  # between two samples; what is faster than that between samples is not what was recorded
AWAY = 1e3  # widths of the recorded states: so far off a prediction has run away


def predict(dynamics: Dynamics, recordings: Recordings) -> np.ndarray:
    """Follow f from the first sample of every recording through all its times.

    Parameters
    ----------
    dynamics
        f and D.
    recordings
        The trajectories; each keeps its own times.

    Returns
    -------
    numpy.ndarray
        Predicted states in the order of ``recordings.values``, shape ``(n, d)``; not finite where the
        prediction runs away, or f is too fast to be followed from sample to sample.
    """
    starts = np.flatnonzero(np.diff(recordings.recording, prepend=-1))
    lengths = np.diff(np.append(starts, len(recordings.t)))
    width = np.ptp(recordings.values, axis=0)
    width = np.where(width > 0, width, 1.0)
    center = recordings.values.mean(axis=0)
    jacobian = dynamics.jacobian(recordings.values) * width / width[:, None]
    rate = float(np.quantile(np.linalg.norm(jacobian, axis=(1, 2)), 0.999))
    predicted = np.full_like(recordings.values, np.nan)
    predicted[starts] = recordings.values[starts]
    x = recordings.values[starts].T.copy()

    def velocity(components: np.ndarray) -> np.ndarray:
        return dynamics.drift(components.T).T

    with np.errstate(over="ignore", invalid="ignore"):
        for place in range(1, int(lengths.max())):
            near = (np.abs(x - center[:, None]) < AWAY * width[:, None]).all(axis=0)
            going = (lengths > place) & near
            if not going.any():
                break
            rows = starts[going] + place
            gap = recordings.t[rows] - recordings.t[rows - 1]
            steps = max(int(np.ceil(gap.max() * rate / ACCURACY)), 1)
            if steps > MOST_STEPS:
                break
            part = x[:, going]
            for _ in range(steps):
                part = runge_kutta_step(velocity, part, gap / steps)
            x[:, going] = part
            predicted[rows] = part.T
    return predicted


def prediction_errors(dynamics: Dynamics, recordings: Recordings) -> np.ndarray:
    """``E_k = ‖X_predicted(t) - X_k(t)‖ / ‖X_k(t)‖`` of every recording k (paper, Eq. error), shape ``(K,)``.

    The norms are over all samples of a recording and all states. A prediction that runs away has an
    infinite error.
    """
    difference = ((predict(dynamics, recordings) - recordings.values) ** 2).sum(axis=1)
    size = (recordings.values**2).sum(axis=1)
    count = len(recordings.labels)
    difference = np.where(np.isfinite(difference), difference, np.inf)
    total = np.bincount(recordings.recording, weights=difference, minlength=count)
    return np.sqrt(total / np.bincount(recordings.recording, weights=size, minlength=count))
