"""What the likelihood of recordings says of the formulas of a noise, in one loop over the samples.

Beside the filter run the derivatives of its means and covariances by the coefficients of the noise. At each
measured value they give the score and the information of an innovation; only their sums are kept.
"""

from __future__ import annotations

import numpy as np

from siq.numerics.machine_code import machine_code


@machine_code
def noise_scores(
    first: np.ndarray,
    transition: np.ndarray,
    gap: np.ndarray,
    measured: np.ndarray,
    residual: np.ndarray,
    step: np.ndarray,
    variance: np.ndarray,
    begin: np.ndarray,
    functions: np.ndarray,
    chosen: np.ndarray,
    values: np.ndarray,
) -> tuple[float, np.ndarray, np.ndarray, np.ndarray]:
    """The log-likelihood with its derivatives by the coefficients of random forces, and by sensors.

    Parameters
    ----------
    first, transition, gap, measured, residual, variance
        As in `siq.estimation.kernels.whitened_innovations`; parameters' changes are already part of `gap` and
        `residual`.
    step
        Lengths of the intervals, shape ``(n,)``.
    begin
        Covariance of the first state of each recording, about the one in hand, shape ``(d, d)``.
    functions
        Of the state, over the interval that begins at each row, shape ``(n, q)``.
    chosen
        Row, column and function of each coefficient, the row not above the column, shape ``(p, 3)``.
    values
        The coefficients, per time, shape ``(p,)``.

    Returns
    -------
    logarithm
        Of the likelihood, up to a constant.
    score
        Its derivatives by the p coefficients, and by the logarithms of the m variances: ``(p + m,)``.
    information
        Fisher's, of the same, ``(p + m, p + m)``.
    squares
        Sum of the outer products of the scores of single innovations, ``(p + m, p + m)``.
    """
    dimension = gap.shape[1]
    outputs = residual.shape[1]
    count = len(values)
    size = count + outputs
    score = np.zeros(size)
    information = np.zeros((size, size))
    squares = np.zeros((size, size))
    logarithm = 0.0
    mean = np.empty(dimension)
    carried = np.empty(dimension)
    covariance = np.empty((dimension, dimension))
    half = np.empty((dimension, dimension))
    gain = np.empty(dimension)
    slopes = np.empty((size, dimension))  # of the mean
    bends = np.empty((size, dimension, dimension))  # of the covariance
    turned = np.empty((size, dimension))
    added = np.empty((dimension, dimension, dimension, dimension))
    by_spread = np.empty(size)
    by_innovation = np.empty(size)
    own = np.empty(size)
    for recording in range(len(first) - 1):
        mean[:] = 0.0
        covariance[:] = begin
        slopes[:] = 0.0
        bends[:] = 0.0
        for k in range(first[recording], first[recording + 1]):
            for o in range(outputs):
                if np.isnan(residual[k, o]):
                    continue
                innovation = residual[k, o]
                spread = variance[o]
                for i in range(dimension):
                    value = 0.0
                    for j in range(dimension):
                        value += covariance[i, j] * measured[k, o, j]
                    gain[i] = value
                for i in range(dimension):
                    innovation -= measured[k, o, i] * mean[i]
                    spread += measured[k, o, i] * gain[i]
                surprise = innovation * innovation / spread
                logarithm -= 0.5 * (np.log(spread) + surprise)
                for c in range(size):
                    by_spread[c] = variance[o] if c == count + o else 0.0
                    by_innovation[c] = 0.0
                    for i in range(dimension):
                        value = 0.0
                        for j in range(dimension):
                            value += bends[c, i, j] * measured[k, o, j]
                        turned[c, i] = value
                        by_spread[c] += measured[k, o, i] * value
                        by_innovation[c] -= measured[k, o, i] * slopes[c, i]
                    own[c] = -0.5 * by_spread[c] / spread * (1.0 - surprise)
                    own[c] -= innovation * by_innovation[c] / spread
                    score[c] += own[c]
                for c in range(size):
                    for e in range(c + 1):
                        squares[c, e] += own[c] * own[e]
                        information[c, e] += 0.5 * by_spread[c] * by_spread[e] / (spread * spread)
                        information[c, e] += by_innovation[c] * by_innovation[e] / spread
                for c in range(size):
                    share = by_spread[c] / spread
                    for i in range(dimension):
                        slopes[c, i] += (
                            turned[c, i] * innovation + gain[i] * (by_innovation[c] - innovation * share)
                        ) / spread
                        for j in range(dimension):
                            bends[c, i, j] -= (
                                turned[c, i] * gain[j] + gain[i] * turned[c, j] - gain[i] * gain[j] * share
                            ) / spread
                for i in range(dimension):
                    mean[i] += gain[i] / spread * innovation
                    for j in range(dimension):
                        covariance[i, j] -= gain[i] / spread * gain[j]
            if k + 1 == first[recording + 1]:
                break
            for i in range(dimension):
                value = gap[k, i]
                for j in range(dimension):
                    value += transition[k, i, j] * mean[j]
                carried[i] = value
            mean[:] = carried
            _carry(transition[k], covariance, half)
            for c in range(size):
                for i in range(dimension):
                    value = 0.0
                    for j in range(dimension):
                        value += transition[k, i, j] * slopes[c, j]
                    carried[i] = value
                slopes[c] = carried
                _carry(transition[k], bends[c], half)
            for m in range(dimension):
                for n in range(dimension):
                    for i in range(dimension):
                        for j in range(dimension):
                            # Simpson's rule, as in siq.estimation.innovations.process_covariance.
                            a, b = transition[k, i, m], transition[k, j, n]
                            same_i = 1.0 if i == m else 0.0
                            same_j = 1.0 if j == n else 0.0
                            whole = a * b + (a + same_i) * (b + same_j) + same_i * same_j
                            added[m, n, i, j] = whole * step[k] / 6.0
            for c in range(count):
                m, n = chosen[c, 0], chosen[c, 1]
                factor = functions[k, chosen[c, 2]]
                for i in range(dimension):
                    for j in range(dimension):
                        value = added[m, n, i, j]
                        if m != n:
                            value += added[n, m, i, j]
                        bends[c, i, j] += factor * value
                        covariance[i, j] += values[c] * factor * value
    for c in range(size):
        for e in range(c):
            squares[e, c] = squares[c, e]
            information[e, c] = information[c, e]
    return logarithm, score, information, squares


@machine_code
def _carry(transition: np.ndarray, matrix: np.ndarray, half: np.ndarray) -> None:
    """``Φ M Φᵀ`` in the place of M."""
    dimension = len(transition)
    for i in range(dimension):
        for j in range(dimension):
            value = 0.0
            for m in range(dimension):
                value += transition[i, m] * matrix[m, j]
            half[i, j] = value
    for i in range(dimension):
        for j in range(dimension):
            value = 0.0
            for m in range(dimension):
                value += half[i, m] * transition[j, m]
            matrix[i, j] = value
