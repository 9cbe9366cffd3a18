"""Compiled loops of the Kalman filter: propagation, innovations, smoothing, likelihood and its score.

A recording is a chain of samples. Between two of them the model carries the state on, linearly for small
deviations; at each of them something is measured. What is linear in a chain is worked out here, compiled,
since every fit and every candidate passes through it many times. The statistics is in
`siq.inference.maximum_likelihood`.

The filter's steps stand here as they do in `siq.inference.filter_kernels`: called as functions of their own
they were slower by a fifth, and these two loops are what a diagnosis spends its time in.

Beside the filter run the derivatives of its means and covariances by the coefficients of the noise. At each
measured value they give the score and the information of an innovation; only their sums are kept.
"""

from __future__ import annotations

import numpy as np

from siq.numerics.integration import machine_code


@machine_code
def carry_linearly(
    step: np.ndarray,
    jacobians: np.ndarray,
    forcings: np.ndarray,
    transition: np.ndarray,
    response: np.ndarray,
) -> None:
    """Carry deviations of the state over one substep, in place: ``S' = J S + F`` by the Runge–Kutta rule.

    Parameters
    ----------
    step
        Lengths of the substeps, shape ``(n,)``.
    jacobians
        J at the begin, the middle and the end of each, shape ``(3, n, d, d)``.
    forcings
        F at the same places, shape ``(3, n, d, p)``: the derivatives by parameters.
    transition
        Shape ``(n, d, d)``: derivative of the state by the state at the begin of the interval.
    response
        Shape ``(n, d, p)``: derivative of the state by the parameters.
    """
    intervals, dimension, columns = forcings.shape[1:]
    slope = np.empty(dimension)
    weights = (1.0, 2.0, 2.0, 1.0)
    reach = (0.0, 0.5, 0.5, 1.0)
    node = (0, 1, 1, 2)
    begin = np.empty(dimension)
    at = np.empty(dimension)
    total = np.empty(dimension)
    for k in range(intervals):
        h = step[k]
        for c in range(dimension + columns):
            for i in range(dimension):
                begin[i] = transition[k, i, c] if c < dimension else response[k, i, c - dimension]
                total[i] = 0.0
                slope[i] = 0.0
            for stage in range(4):
                place = node[stage]
                for i in range(dimension):
                    at[i] = begin[i] + reach[stage] * h * slope[i]
                for i in range(dimension):
                    value = forcings[place, k, i, c - dimension] if c >= dimension else 0.0
                    for j in range(dimension):
                        value += jacobians[place, k, i, j] * at[j]
                    slope[i] = value
                    total[i] += weights[stage] * value
            for i in range(dimension):
                value = begin[i] + h / 6.0 * total[i]
                if c < dimension:
                    transition[k, i, c] = value
                else:
                    response[k, i, c - dimension] = value


@machine_code
def whitened_innovations(
    first: np.ndarray,
    transition: np.ndarray,
    response: np.ndarray,
    gap: np.ndarray,
    process: np.ndarray,
    measured: np.ndarray,
    measured_response: np.ndarray,
    residual: np.ndarray,
    variance: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Innovations of the Kalman filter and their derivatives, each divided by its standard deviation.

    The initial state of every recording is unknown; it enters as d further columns, not as a covariance, so
    that nothing is lost to rounding and the case without process noise is exact.

    Parameters
    ----------
    first
        Row at which each recording begins, and the number of rows at the end; shape ``(recordings + 1,)``.
    transition, response, gap
        Of the interval that begins at each row: shapes ``(n, d, d)``, ``(n, d, p)``, ``(n, d)``. `gap` is
        by how much the model's next state exceeds the one in hand.
    process
        Covariance that process noise adds over the interval, shape ``(n, d, d)``.
    measured, measured_response
        Derivative of the outputs by states and parameters, ``(n, m, d)`` and ``(n, m, p)``.
    residual
        Measured minus modelled outputs, shape ``(n, m)``; NaN where nothing was measured.
    variance
        Of the measurement noise, shape ``(m,)``.

    Returns
    -------
    innovations
        Shape ``(n, m)``; zero where nothing was measured.
    by_parameters
        Shape ``(n, m, p)``: what a unit of each parameter adds to the modelled output, whitened.
    by_initial_state
        Shape ``(n, m, d)``: the same of the state in which the recording began.
    log_determinant
        Sum of the logarithms of the innovations' variances.
    """
    rows, dimension, columns = response.shape
    outputs = residual.shape[1]
    width = 1 + columns + dimension
    innovations = np.zeros((rows, outputs))
    by_parameters = np.zeros((rows, outputs, columns))
    by_initial = np.zeros((rows, outputs, dimension))
    log_determinant = 0.0
    state = np.empty((dimension, width))
    carried = np.empty((dimension, width))
    covariance = np.empty((dimension, dimension))
    half = np.empty((dimension, dimension))
    gain = np.empty(dimension)
    shown = np.empty(width)
    for recording in range(len(first) - 1):
        state[:] = 0.0
        covariance[:] = 0.0
        for i in range(dimension):
            state[i, 1 + columns + i] = 1.0
        for k in range(first[recording], first[recording + 1]):
            for o in range(outputs):
                if np.isnan(residual[k, o]):
                    continue
                for c in range(width):
                    value = 0.0
                    for i in range(dimension):
                        value += measured[k, o, i] * state[i, c]
                    shown[c] = value
                for c in range(columns):
                    shown[1 + c] += measured_response[k, o, c]
                spread = variance[o]
                for i in range(dimension):
                    value = 0.0
                    for j in range(dimension):
                        value += covariance[i, j] * measured[k, o, j]
                    gain[i] = value
                for i in range(dimension):
                    spread += measured[k, o, i] * gain[i]
                scale = 1.0 / np.sqrt(spread)
                innovation = residual[k, o] - shown[0]
                innovations[k, o] = innovation * scale
                for c in range(columns):
                    by_parameters[k, o, c] = shown[1 + c] * scale
                for i in range(dimension):
                    by_initial[k, o, i] = shown[1 + columns + i] * scale
                log_determinant += np.log(spread)
                for i in range(dimension):
                    share = gain[i] / spread
                    state[i, 0] += share * innovation
                    for c in range(1, width):
                        state[i, c] -= share * shown[c]
                    for j in range(dimension):
                        covariance[i, j] -= share * gain[j]
            if k + 1 == first[recording + 1]:
                break
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
                    value = process[k, i, j]
                    for m in range(dimension):
                        value += half[i, m] * transition[k, j, m]
                    covariance[i, j] = value
                    covariance[j, i] = value
    return innovations, by_parameters, by_initial, log_determinant


@machine_code
def smoothed_states(
    first: np.ndarray,
    transition: np.ndarray,
    gap: np.ndarray,
    process: np.ndarray,
    measured: np.ndarray,
    residual: np.ndarray,
    variance: np.ndarray,
    begin: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The most probable deviation of every state, given all measurements, or only those until then.

    The second is what a filter knows: it is told the initial states and parameters, and nothing else of the
    future. Modified Bryson–Frazier smoother: it inverts no covariance of states, which is singular where a
    state carries no process noise.

    Parameters
    ----------
    first, transition, gap, process, measured, residual, variance
        As in `whitened_innovations`; the parameters' changes are already part of `gap` and `residual`.
    begin
        Deviation of the initial state of each recording, shape ``(recordings, d)``.

    Returns
    -------
    smoothed
        Given all measurements, shape ``(n, d)``.
    filtered
        Given those of its own sample and before, shape ``(n, d)``.
    spread
        Covariance of what is filtered, shape ``(n, d, d)``.
    """
    rows, dimension = gap.shape
    outputs = residual.shape[1]
    smoothed = np.empty((rows, dimension))
    filtered = np.empty((rows, dimension))
    spread_after = np.empty((rows, dimension, dimension))
    covariances = np.empty((rows, dimension, dimension))
    gains = np.zeros((rows, outputs, dimension))
    spreads = np.ones((rows, outputs))
    innovations = np.zeros((rows, outputs))
    state = np.empty(dimension)
    carried = np.empty(dimension)
    covariance = np.empty((dimension, dimension))
    half = np.empty((dimension, dimension))
    adjoint = np.empty(dimension)
    for recording in range(len(first) - 1):
        state[:] = begin[recording]
        covariance[:] = 0.0
        for k in range(first[recording], first[recording + 1]):
            smoothed[k] = state
            covariances[k] = covariance
            for o in range(outputs):
                if np.isnan(residual[k, o]):
                    continue
                innovation = residual[k, o]
                spread = variance[o]
                for i in range(dimension):
                    value = 0.0
                    for j in range(dimension):
                        value += covariance[i, j] * measured[k, o, j]
                    gains[k, o, i] = value
                for i in range(dimension):
                    innovation -= measured[k, o, i] * state[i]
                    spread += measured[k, o, i] * gains[k, o, i]
                innovations[k, o] = innovation
                spreads[k, o] = spread
                for i in range(dimension):
                    share = gains[k, o, i] / spread
                    state[i] += share * innovation
                    for j in range(dimension):
                        covariance[i, j] -= share * gains[k, o, j]
            filtered[k] = state
            spread_after[k] = covariance
            if k + 1 == first[recording + 1]:
                break
            for i in range(dimension):
                value = gap[k, i]
                for j in range(dimension):
                    value += transition[k, i, j] * state[j]
                carried[i] = value
            state[:] = carried
            for i in range(dimension):
                for j in range(dimension):
                    value = 0.0
                    for m in range(dimension):
                        value += transition[k, i, m] * covariance[m, j]
                    half[i, j] = value
            for i in range(dimension):
                for j in range(i + 1):
                    value = process[k, i, j]
                    for m in range(dimension):
                        value += half[i, m] * transition[k, j, m]
                    covariance[i, j] = value
                    covariance[j, i] = value
        adjoint[:] = 0.0
        for k in range(first[recording + 1] - 1, first[recording] - 1, -1):
            if k + 1 < first[recording + 1]:
                for i in range(dimension):
                    value = 0.0
                    for j in range(dimension):
                        value += transition[k, j, i] * adjoint[j]
                    carried[i] = value
                adjoint[:] = carried
            for o in range(outputs - 1, -1, -1):
                if np.isnan(residual[k, o]):
                    continue
                value = innovations[k, o]
                for i in range(dimension):
                    value += gains[k, o, i] * adjoint[i]
                for i in range(dimension):
                    adjoint[i] -= measured[k, o, i] * value / spreads[k, o]
            for i in range(dimension):
                value = 0.0
                for j in range(dimension):
                    value += covariances[k, i, j] * adjoint[j]
                smoothed[k, i] -= value
    return smoothed, filtered, spread_after


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

    The same as `whitened_innovations` with what follows it, without keeping anything
    but sums of products: it is called for every noise that a search tries.

    Parameters
    ----------
    first, transition, response, gap, measured, measured_response, residual, variance
        As in `whitened_innovations`.
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
                        # Simpson's rule, as in siq.inference.kalman_filter.process_covariance.
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
        As in `whitened_innovations`; parameters' changes are already part of `gap` and
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
                            # Simpson's rule, as in siq.inference.kalman_filter.process_covariance.
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
