"""The likelihood of a noise, in one loop over the samples that keeps sums of products only.

The filter's steps stand here as they do in `siq.estimation.kernels`: called as functions of their own they
were slower by a fifth, and these two loops are what a diagnosis spends its time in.
"""

from __future__ import annotations

import numpy as np

from siq.numerics.machine_code import machine_code


@machine_code
def noise_likelihood(
    first: np.ndarray,
    transition: np.ndarray,
    response: np.ndarray,
    gap: np.ndarray,
    measured: np.ndarray,
    measured_response: np.ndarray,
    residual: np.ndarray,
    step: np.ndarray,
    variance: np.ndarray,
    intensity: np.ndarray,
) -> tuple[float, float, int]:
    """What the likelihood of a noise depends on, initial states and parameters at their best.

    The same as `siq.estimation.kernels.whitened_innovations` with what follows it, without keeping anything
    but sums of products: it is called for every noise that a search tries.

    Parameters
    ----------
    first, transition, response, gap, measured, measured_response, residual, variance
        As in `siq.estimation.kernels.whitened_innovations`.
    step
        Lengths of the intervals, shape ``(n,)``.
    intensity
        Of the random forces, per time: shape ``(1, d, d)``, or ``(n, d, d)``.

    Returns
    -------
    total
        Sum of squared innovations.
    log_determinant
        Of their covariance, initial states projected out.
    freedom
        Measured values less initial states.
    """
    dimension, columns = response.shape[1:]
    outputs = residual.shape[1]
    kept = 1 + columns
    width = kept + dimension
    constant = len(intensity) == 1
    sums = np.zeros((kept, kept))
    log_determinant = 0.0
    freedom = 0
    state = np.empty((dimension, width))
    carried = np.empty((dimension, width))
    covariance = np.empty((dimension, dimension))
    half = np.empty((dimension, dimension))
    gain = np.empty(dimension)
    shown = np.empty(width)
    own = np.empty((width, width))
    pairs = np.empty((dimension * dimension, 2), dtype=np.int64)
    driven = 0
    for m in range(dimension):
        for other in range(dimension):
            for row in range(len(intensity)):
                if intensity[row, m, other] != 0.0:
                    pairs[driven, 0], pairs[driven, 1] = m, other
                    driven += 1
                    break
    for recording in range(len(first) - 1):
        state[:] = 0.0
        covariance[:] = 0.0
        own[:] = 0.0
        for i in range(dimension):
            state[i, kept + i] = 1.0
        for k in range(first[recording], first[recording + 1]):
            for o in range(outputs):
                if np.isnan(residual[k, o]):
                    continue
                freedom += 1
                for c in range(width):
                    value = 0.0
                    for i in range(dimension):
                        value += measured[k, o, i] * state[i, c]
                    shown[c] = value
                for c in range(columns):
                    shown[1 + c] += measured_response[k, o, c]
                shown[0] = residual[k, o] - shown[0]
                spread = variance[o]
                for i in range(dimension):
                    value = 0.0
                    for j in range(dimension):
                        value += covariance[i, j] * measured[k, o, j]
                    gain[i] = value
                for i in range(dimension):
                    spread += measured[k, o, i] * gain[i]
                log_determinant += np.log(spread)
                for c in range(width):
                    for e in range(c + 1):
                        own[c, e] += shown[c] * shown[e] / spread
                for i in range(dimension):
                    share = gain[i] / spread
                    state[i, 0] += share * shown[0]
                    for c in range(1, width):
                        state[i, c] -= share * shown[c]
                    for j in range(dimension):
                        covariance[i, j] -= share * gain[j]
            if k + 1 == first[recording + 1]:
                break
            row = 0 if constant else k
            for i in range(dimension):
                for c in range(width):
                    value = 0.0
                    for j in range(dimension):
                        value += transition[k, i, j] * state[j, c]
                    carried[i, c] = value
                carried[i, 0] += gap[k, i]
                for c in range(columns):
                    carried[i, 1 + c] += response[k, i, c]
            state[:] = carried
            for i in range(dimension):
                for j in range(dimension):
                    value = 0.0
                    for m in range(dimension):
                        value += transition[k, i, m] * covariance[m, j]
                    half[i, j] = value
            for i in range(dimension):
                for j in range(i + 1):
                    value = 0.0
                    for m in range(dimension):
                        value += half[i, m] * transition[k, j, m]
                    for pair in range(driven):
                        m, other = pairs[pair, 0], pairs[pair, 1]
                        # Simpson's rule, as in siq.estimation.innovations.process_covariance.
                        a, b = transition[k, i, m], transition[k, j, other]
                        same_i = 1.0 if i == m else 0.0
                        same_j = 1.0 if j == other else 0.0
                        added = a * b + (a + same_i) * (b + same_j) + same_i * same_j
                        value += intensity[row, m, other] * added * step[k] / 6.0
                    covariance[i, j] = value
                    covariance[j, i] = value
        removed, logarithm = _eliminate(own, kept)
        freedom -= removed
        log_determinant += logarithm
        for c in range(kept):
            for e in range(c + 1):
                sums[c, e] += own[c, e]
    _eliminate(sums, 1)
    return sums[0, 0], log_determinant, freedom


@machine_code
def _eliminate(products: np.ndarray, kept: int) -> tuple[int, float]:
    """Project the last columns out of a matrix of products, in place; how many there were, and log det.

    Only the lower triangle is used. A column of which nothing is left of its own is passed over.
    """
    width = len(products)
    scale = np.empty(width)
    for c in range(width):
        scale[c] = products[c, c]
    removed = 0
    logarithm = 0.0
    for c in range(width - 1, kept - 1, -1):
        pivot = products[c, c]
        if not pivot > 1e-13 * scale[c]:
            continue
        removed += 1
        logarithm += np.log(pivot)
        for e in range(c):
            factor = products[c, e] / pivot
            for f in range(e + 1):
                products[e, f] -= factor * products[c, f]
    return removed, logarithm
