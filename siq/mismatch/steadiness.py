"""Steadiness: whether random forces are those of surroundings, or follow the motion.

Process noise drives a system alike whether it moves or rests. What a simulation lacks of a hidden part - a
second oscillator, a memory - can pass for random forces, too, where recordings are noisy; but such forces
fade with the motion that excites them. The likelihood tells the two apart.
"""

from __future__ import annotations

import numpy as np

from siq.estimation.fit import Fit
from siq.estimation.innovations import Noise, profile_likelihood
from siq.estimation.measurements import Measurements
from siq.estimation.noise import likelihood_sums

SHARES = (0.5, 0.9, 0.99)  # of the forces that follow the motion
RATIOS = (1 / 8, 1 / 4, 1 / 2, 1 / 1.4, 1.0, 1.4, 2.0, 4.0, 8.0)  # of process noise, to that of the fit


def unsteadiness(fit: Fit, data: Measurements) -> float:
    """How much better random forces fit that follow the motion than steady ones do.

    Parameters
    ----------
    fit
        With process noise.
    data
        The measurements it was made for.

    Returns
    -------
    float
        Twice the difference of the log-likelihoods, each with the intensities at their best and, for forces
        that follow the motion, at least half of them in proportion to the square of its size. Negative
        where steady forces fit better.
    """
    spread = fit.x.std(axis=0)
    moved = (fit.x - fit.x.mean(axis=0)) / np.where(spread > 0, spread, 1.0)
    motion = (moved**2).mean(axis=1)
    following = motion / motion.mean()
    steady = max(_log_likelihood(fit, data, ratio, np.ones(len(motion))) for ratio in RATIOS)
    fading = max(
        _log_likelihood(fit, data, ratio, 1 - share + share * following)
        for share in SHARES
        for ratio in RATIOS
    )
    return 2 * (fading - steady)


def _log_likelihood(fit: Fit, data: Measurements, ratio: float, weight: np.ndarray) -> float:
    """With both kinds of noise on the best common scale; the weight is of the forces at every sample."""
    noise = Noise(fit.noise.measurement, ratio * fit.noise.process)
    return profile_likelihood(*likelihood_sums(fit.linearisation, data, noise, weight=weight))
