"""Whole trajectories in one compiled loop: the formulas come as a tape (`siq.dynamics.tape`)."""

from __future__ import annotations

import numpy as np

from siq.numerics.machine_code import machine_code


@machine_code
def run_tape(
    operations: np.ndarray,
    registers: np.ndarray,
    base: int,
    results: np.ndarray,
    first: np.ndarray,
    begin: np.ndarray,
    signals: np.ndarray,
    step: np.ndarray,
    states: np.ndarray,
) -> int:
    """Integrate recordings by the Runge–Kutta rule, sample after sample, into `states`.

    Parameters
    ----------
    operations, registers, base, results
        The tape of the rates: its arguments are states, then signals, then parameters, which are filled in.
    first
        Row at which each recording begins, and the number of rows; shape ``(recordings + 1,)``.
    begin
        Initial states, shape ``(recordings, d)``.
    signals
        At begin, middle and end of every substep, shape ``(3 substeps, s, intervals)``.
    step
        Length of a substep of each interval, shape ``(intervals,)``.
    states
        Shape ``(n, d)``, not a number to begin with: a recording in which the simulation runs away is left
        so from there on.

    Returns
    -------
    int
        Evaluations of the rates.
    """
    dimension = begin.shape[1]
    known = signals.shape[1]
    substeps = signals.shape[0] // 3
    node = (0, 1, 1, 2)
    reach = (0.0, 0.5, 0.5, 1.0)
    weight = (1.0, 2.0, 2.0, 1.0)
    now = np.empty(dimension)
    slope = np.empty(dimension)
    total = np.empty(dimension)
    evaluations = 0
    interval = 0
    for recording in range(len(first) - 1):
        last = interval + first[recording + 1] - first[recording] - 1
        now[:] = begin[recording]
        states[first[recording]] = now
        row = first[recording]
        alive = True
        while interval < last and alive:
            h = step[interval]
            for part in range(substeps):
                total[:] = 0.0
                slope[:] = 0.0
                for stage in range(4):
                    for i in range(dimension):
                        registers[i] = now[i] + reach[stage] * h * slope[i]
                    for s in range(known):
                        registers[dimension + s] = signals[3 * part + node[stage], s, interval]
                    for k in range(len(operations)):
                        what = operations[k, 0]
                        a = registers[operations[k, 1]]
                        if what == 0:
                            value = a + registers[operations[k, 2]]
                        elif what == 1:
                            value = a * registers[operations[k, 2]]
                        elif what == 2:
                            value = 1.0 / a if a != 0.0 else np.inf
                        elif what == 3:
                            value = a
                            for _ in range(operations[k, 2] - 1):
                                value *= a
                        elif what == 4:
                            exponent = registers[operations[k, 2]]
                            value = np.inf if a == 0.0 and exponent < 0.0 else a**exponent
                        elif what == 5:
                            value = np.sqrt(a)
                        elif what == 6:
                            value = np.sin(a)
                        elif what == 7:
                            value = np.cos(a)
                        elif what == 8:
                            value = np.tan(a)
                        elif what == 9:
                            value = np.exp(a)
                        elif what == 10:
                            value = np.log(a)
                        elif what == 11:
                            value = np.tanh(a)
                        elif what == 12:
                            value = np.arctan(a)
                        elif what == 13:
                            value = abs(a)
                        elif what == 14:
                            value = np.sign(a)
                        else:
                            b = registers[operations[k, 2]]
                            if np.isnan(a) or np.isnan(b):
                                value = np.nan
                            elif what == 15:
                                value = max(a, b)
                            else:
                                value = min(a, b)
                        registers[base + k] = value
                    evaluations += 1
                    for i in range(dimension):
                        slope[i] = registers[results[i]]
                        total[i] += weight[stage] * slope[i]
                for i in range(dimension):
                    now[i] += h / 6.0 * total[i]
            for i in range(dimension):
                if not np.isfinite(now[i]):
                    alive = False
            interval += 1
            row += 1
            if alive:
                states[row] = now
        interval = last
    return evaluations
