"""Compiled loops of the Kalman filter: propagation, the one recursion of the filter, smoothing, likelihood.

A recording is a chain of samples. Between two of them the model carries the state on, linearly for small
deviations, and process noise adds

    ``∫₀ʰ Φ(h - s) Q Φ(h - s)ᵀ ds``

to its covariance, here by Simpson's rule; at each of them something is measured. What is linear in a chain is
worked out here, compiled, since every fit and every candidate passes through it many times. The statistics is
in `siq.inference.maximum_likelihood`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from siq.numerics.integration import machine_code


@machine_code
def carry_linearly(
    step: np.ndarray, by_state: np.ndarray, by_parameter: np.ndarray, begin: int, transition: np.ndarray,
    response: np.ndarray,
) -> None:  # fmt: skip
    """Carry deviations of the state over one substep, in place: ``S' = J S + F`` by the Runge–Kutta rule.

    The four stages are multiplied out: with A, B, C for J at the start, the middle and the end,

        ``h/6 (1 + h B + h²/2 B² + h³/4 C B²)``, ``h/6 (4 + h (B + C) + h²/2 C B)`` and ``h/6``

    are the weights of what drives S at these places, J S at the start of the substep and F there. All
    intervals lie side by side in memory, and are worked out together.

    Parameters
    ----------
    step
        Lengths of the substeps, shape ``(n,)``.
    by_state, by_parameter
        J and F, the derivatives by parameters, ``(d, d, 3 n)`` or more and ``(d, p, 3 n)``: all n
        starts from `begin` on, then all middles, then all ends.
    transition
        Shape ``(d, d, n)``: derivative of the state by the state at the start of the interval.
    response
        Shape ``(d, p, n)``: derivative of the state by the parameters.
    """
    d, columns = by_parameter.shape[:2]
    count = len(step)
    middle, end = begin + count, begin + 2 * count
    bent = np.empty((d, d))
    first, second, whole = np.empty((d, d, count)), np.empty((d, d, count)), np.empty((d, d, count))
    for k in range(count):
        h = step[k]
        for i in range(d):
            for j in range(d):
                value = 0.0
                for m in range(d):
                    value += by_state[i, m, end + k] * by_state[m, j, middle + k]
                bent[i, j] = by_state[i, j, middle + k] + 0.5 * h * value
                second[i, j, k] = h / 6.0 * h * (by_state[i, j, end + k] + bent[i, j])
            second[i, i, k] += h / 6.0 * 4.0
            for j in range(d):
                value = 0.0
                for m in range(d):
                    value += bent[i, m] * by_state[m, j, middle + k]
                first[i, j, k] = h / 6.0 * h * (by_state[i, j, middle + k] + 0.5 * h * value)
            first[i, i, k] += h / 6.0
            for j in range(d):
                value = h / 6.0 * by_state[i, j, end + k] + (1.0 if i == j else 0.0)
                for m in range(d):
                    value += first[i, m, k] * by_state[m, j, begin + k]
                    value += second[i, m, k] * by_state[m, j, middle + k]
                whole[i, j, k] = value
    for c in range(d + columns):
        state = transition[:, c] if c < d else response[:, c - d]
        held = state.copy()
        for i in range(d):
            for k in range(count):
                state[i, k] = step[k] / 6.0 * by_parameter[i, c - d, end + k] if c >= d else 0.0
            for j in range(d):
                for k in range(count):
                    state[i, k] += whole[i, j, k] * held[j, k]
                if c >= d:
                    forcing = by_parameter[j, c - d]
                    for k in range(count):
                        state[i, k] += (
                            first[i, j, k] * forcing[begin + k] + second[i, j, k] * forcing[middle + k]
                        )


@machine_code
def filter_recursion(
    first: np.ndarray, transition: np.ndarray, response: np.ndarray, gap: np.ndarray, measured: np.ndarray,
    measured_response: np.ndarray, residual: np.ndarray, variance: np.ndarray, step: np.ndarray,
    intensity: np.ndarray, begin: np.ndarray, begin_covariance: np.ndarray, functions: np.ndarray,
    places: np.ndarray, scored: bool, kept: bool,
) -> tuple[Any, ...]:  # fmt: skip
    """Innovations of the Kalman filter with their derivatives, each divided by its standard deviation.

    The initial state of every recording may be unknown: it enters as d further columns, not as a covariance,
    so that nothing is lost to rounding and the case without process noise is exact.

    Parameters
    ----------
    first
        Row at which each recording begins, and the number of rows at the end; shape ``(recordings + 1,)``.
    transition, response, gap
        Of the interval that begins at each row: shapes ``(n, d, d)``, ``(n, d, p)``, ``(n, d)``. `gap` is
        by how much the model's next state exceeds the one in hand.
    measured, measured_response, residual
        Derivative of the outputs by states and parameters, ``(n, m, d)`` and ``(n, m, p)``; measured minus
        modelled outputs, shape ``(n, m)``, NaN where nothing was measured.
    variance, step, intensity
        Of the measurement noise, shape ``(m,)``; lengths of the intervals, shape ``(n,)``; of the process
        noise, per time: shape ``(1, d, d)``, or ``(n, d, d)``.
    begin, begin_covariance
        Deviation of the initial state of each recording ``(recordings, d)``, and its covariance ``(d, d)``.
    functions, places
        Functions over the interval that begins at each row, ``(n, q)``, and row, column and function of the
        coefficients of the intensity by which the likelihood is derived, the row not above the column,
        ``(c, 3)``.
    scored, kept
        Whether it is derived by these coefficients, and by the logarithms of the sensors' variances; and
        whether what a smoother needs is kept.

    Returns
    -------
    whitened
        Innovations, and what a unit of each parameter, and of the initial state, adds to the modelled output,
        in units of their standard deviation, zero where nothing was measured: shape ``(n, m, 1 + p + d)``.
    log_determinant
        Sum of the logarithms of the innovations' variances.
    score, information, squares
        Derivatives of the log-likelihood ``(c + m,)``, Fisher's information, and the sum of the outer
        products of the scores of single innovations.
    predicted, filtered, before, after, gains, variances
        States before and after what is measured, their covariances, and gains ``(n, m, d)`` and variances
        ``(n, m)`` of each measured value, where they are kept.
    """
    rows, dimension, columns = response.shape
    outputs = residual.shape[1]
    width = 1 + columns + dimension
    whitened = np.zeros((rows, outputs, width))
    log_determinant, count = 0.0, len(places)
    size = count + outputs if scored else 0
    score = np.zeros(size)
    information, squares = np.zeros((size, size)), np.zeros((size, size))
    slopes = np.empty((size, dimension))  # derivatives of the mean
    bends = np.empty((size, dimension, dimension))  # derivatives of the covariance
    turned, by_variance = np.empty((size, dimension)), np.empty(size)
    by_innovation, single = np.empty(size), np.empty(size)
    stored = rows if kept else 0
    predicted = np.empty((stored, dimension))
    filtered = np.empty((stored, dimension))
    before = np.empty((stored, dimension, dimension))
    after = np.empty((stored, dimension, dimension))
    gains = np.zeros((stored, outputs, dimension))
    variances = np.ones((stored, outputs))
    state, carried = np.empty((dimension, width)), np.empty((dimension, width))
    half, gain = np.empty((dimension, dimension)), np.empty(dimension)
    shown = np.empty(width)
    driven = np.empty((dimension * dimension, 2), dtype=np.int64)
    drives = 0
    for m in range(dimension):
        for n in range(dimension):
            for row in range(len(intensity)):
                if intensity[row, m, n] != 0.0:
                    driven[drives, 0], driven[drives, 1] = m, n
                    drives += 1
                    break
    for recording in range(len(first) - 1):
        state[:] = 0.0
        covariance = begin_covariance.copy()
        slopes[:] = 0.0
        bends[:] = 0.0
        for i in range(dimension):
            state[i, 0] = begin[recording, i]
            state[i, 1 + columns + i] = 1.0
        for k in range(first[recording], first[recording + 1]):
            if kept:
                predicted[k] = state[:, 0]
                before[k] = covariance
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
                whitened[k, o, 0] = innovation * scale
                for c in range(1, width):
                    whitened[k, o, c] = shown[c] * scale
                log_determinant += np.log(spread)
                if kept:
                    gains[k, o] = gain
                    variances[k, o] = spread
                surprise = innovation * innovation / spread
                for c in range(size):
                    by_variance[c] = variance[o] if c == count + o else 0.0
                    by_innovation[c] = 0.0
                    for i in range(dimension):
                        value = 0.0
                        for j in range(dimension):
                            value += bends[c, i, j] * measured[k, o, j]
                        turned[c, i] = value
                        by_variance[c] += measured[k, o, i] * value
                        by_innovation[c] -= measured[k, o, i] * slopes[c, i]
                    single[c] = -0.5 * by_variance[c] / spread * (1.0 - surprise)
                    single[c] -= innovation * by_innovation[c] / spread
                    score[c] += single[c]
                    for e in range(c + 1):
                        squares[c, e] += single[c] * single[e]
                        information[c, e] += 0.5 * by_variance[c] * by_variance[e] / (spread * spread)
                        information[c, e] += by_innovation[c] * by_innovation[e] / spread
                for c in range(size):
                    share = by_variance[c] / spread
                    for i in range(dimension):
                        slopes[c, i] += (
                            turned[c, i] * innovation + gain[i] * (by_innovation[c] - innovation * share)
                        ) / spread
                        for j in range(dimension):
                            bends[c, i, j] -= (
                                turned[c, i] * gain[j] + gain[i] * turned[c, j] - gain[i] * gain[j] * share
                            ) / spread
                for i in range(dimension):
                    share = gain[i] / spread
                    state[i, 0] += share * innovation
                    for c in range(1, width):
                        state[i, c] -= share * shown[c]
                    for j in range(dimension):
                        covariance[i, j] -= share * gain[j]
            if kept:
                filtered[k] = state[:, 0]
                after[k] = covariance
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
            state, carried = carried, state
            # As a function of its own this was slower by a fifth.
            row = 0 if len(intensity) == 1 else k
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
                    for pair in range(drives):
                        m, n = driven[pair, 0], driven[pair, 1]
                        a, b = transition[k, i, m], transition[k, j, n]
                        same_i = 1.0 if i == m else 0.0
                        same_j = 1.0 if j == n else 0.0
                        added = a * b + (a + same_i) * (b + same_j) + same_i * same_j
                        value += intensity[row, m, n] * added * step[k] / 6.0
                    covariance[i, j] = value
                    covariance[j, i] = value
            for c in range(size):
                for i in range(dimension):
                    value = 0.0
                    for j in range(dimension):
                        value += transition[k, i, j] * slopes[c, j]
                    gain[i] = value
                slopes[c] = gain
                _carry(transition[k], bends[c], half)
                if c < count:
                    m, n = places[c, 0], places[c, 1]
                    strength = functions[k, places[c, 2]] * step[k] / 6.0
                    for i in range(dimension):
                        for j in range(dimension):
                            value = _simpson(transition[k], i, j, m, n)
                            if m != n:
                                value += _simpson(transition[k], i, j, n, m)
                            bends[c, i, j] += strength * value
    for c in range(size):
        for e in range(c):
            squares[e, c] = squares[c, e]
            information[e, c] = information[c, e]
    return (
        whitened, log_determinant, score, information, squares, predicted, filtered, before, after, gains,
        variances,
    )  # fmt: skip


@machine_code
def _simpson(transition: np.ndarray, i: int, j: int, m: int, n: int) -> float:
    """Six times the mean of ``Φ_im Φ_jn`` over an interval, by Simpson's rule from Φ at its ends."""
    a, b = transition[i, m], transition[j, n]
    same_i = 1.0 if i == m else 0.0
    same_j = 1.0 if j == n else 0.0
    return a * b + (a + same_i) * (b + same_j) + same_i * same_j


@machine_code
def smooth_backwards(
    first: np.ndarray, transition: np.ndarray, measured: np.ndarray, residual: np.ndarray,
    innovations: np.ndarray, predicted: np.ndarray, before: np.ndarray, gains: np.ndarray,
    variances: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """The most probable deviation of every state, given all measurements, shape ``(n, d)``.

    Modified Bryson–Frazier smoother: it inverts no covariance of states, which is singular where a state
    carries no process noise. The arguments are those of `filter_recursion`, and what it keeps.
    """
    dimension, outputs = predicted.shape[1], residual.shape[1]
    smoothed, adjoint = predicted.copy(), np.empty(dimension)
    carried = np.empty(dimension)
    for recording in range(len(first) - 1):
        adjoint[:] = 0.0
        for k in range(first[recording + 1] - 1, first[recording] - 1, -1):
            if k + 1 < first[recording + 1]:
                for i in range(dimension):
                    value = 0.0
                    for j in range(dimension):
                        value += transition[k, j, i] * adjoint[j]
                    carried[i] = value
                adjoint, carried = carried, adjoint
            for o in range(outputs - 1, -1, -1):
                if np.isnan(residual[k, o]):
                    continue
                value = innovations[k, o] * np.sqrt(variances[k, o])
                for i in range(dimension):
                    value += gains[k, o, i] * adjoint[i]
                for i in range(dimension):
                    adjoint[i] -= measured[k, o, i] * value / variances[k, o]
            for i in range(dimension):
                value = 0.0
                for j in range(dimension):
                    value += before[k, i, j] * adjoint[j]
                smoothed[k, i] -= value
    return smoothed


@machine_code
def projected_sums(first: np.ndarray, whitened: np.ndarray, kept: int) -> tuple[float, float, int]:
    """Sum of squared innovations, initial states of recordings and parameters at their best.

    The columns of initial states stand behind the `kept` ones. The logarithm of the determinant of what they
    were projected out of, and their number, too.
    """
    outputs, width = whitened.shape[1:]
    sums = np.zeros((kept, kept))
    own = np.empty((width, width))
    log_determinant, removed = 0.0, 0
    for recording in range(len(first) - 1):
        own[:] = 0.0
        for k in range(first[recording], first[recording + 1]):
            for o in range(outputs):
                for c in range(width):
                    for e in range(c + 1):
                        own[c, e] += whitened[k, o, c] * whitened[k, o, e]
        gone, logarithm = _eliminate(own, kept)
        removed += gone
        log_determinant += logarithm
        for c in range(kept):
            for e in range(c + 1):
                sums[c, e] += own[c, e]
    _eliminate(sums, 1)
    return sums[0, 0], log_determinant, removed


@machine_code
def _eliminate(products: np.ndarray, kept: int) -> tuple[int, float]:
    """Project the last columns out of a matrix of products, in place; how many there were, and log det.

    Only the lower triangle is used. A column of which nothing is left of its own is passed over.
    """
    width, scale = len(products), np.diag(products).copy()
    removed, logarithm = 0, 0.0
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
