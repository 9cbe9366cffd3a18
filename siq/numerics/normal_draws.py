"""Draws of parameters from the normal distribution of their errors, whatever their units."""

from __future__ import annotations

import numpy as np


def normal_draws(
    mean: np.ndarray, covariance: np.ndarray, count: int, *, generator: np.random.Generator
) -> np.ndarray:
    """Draws from a normal distribution, of coordinates whose sizes differ by any factor.

    Coefficients of x and of x³ may differ by 10¹⁴ in the unit of a recording. The covariance is therefore
    taken apart as standard deviations and correlations, of which eigenvalues can be told from rounding.

    Parameters
    ----------
    mean
        Shape ``(p,)``.
    covariance
        Shape ``(p, p)``; coordinates without variance stay at their mean.
    count
        So many draws.
    generator
        Where they come from.

    Returns
    -------
    numpy.ndarray
        Shape ``(count, p)``.
    """
    deviation = np.sqrt(np.diag(covariance))
    scale = np.where(deviation > 0, deviation, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    drawn = generator.standard_normal((count, len(mean)))
    return np.asarray(mean + (drawn @ root.T) * scale)
