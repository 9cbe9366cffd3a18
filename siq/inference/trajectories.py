"""Whole trajectories: least squares by damped steps, free runs of held-out recordings, and jumps of f.

`siq.inference.maximum_likelihood.fit_by_multiple_shooting` moves the states at all samples at once and is
fast, but where f jumps, or nearly, its linearised steps can go to and fro without end. Here only initial
states and parameters are unknown, every trajectory follows its equations at every step, and no step of
Levenberg and Marquardt makes the fit worse.

A free run simulates a recording from the end of a prefix, which is not scored and from which the state at the
begin is estimated. A force that takes another sign in no time, such as dry friction, is spread over a little
of its argument when it is evaluated, so that an integrator can follow it.
"""

from __future__ import annotations

import itertools
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import sympy

from siq.inference.budget import Budget, evaluation
from siq.inference.kalman_filter import Grid, Linearisation, Noise, integrate_intervals, linearise
from siq.inference.maximum_likelihood import Fit, fit_by_multiple_shooting, fit_of_states
from siq.inference.measurements import Measurements, expectations, first_states
from siq.numerics.integration import machine_code
from siq.numerics.randomness import positive
from siq.systems.dynamics import Dynamics, Tape, roots_of, symbol
from siq.systems.formulas import compile_values


@machine_code
def _run_tape(
    operations: np.ndarray, registers: np.ndarray, base: int, results: np.ndarray, first: np.ndarray,
    begin: np.ndarray, signals: np.ndarray, step: np.ndarray, states: np.ndarray,
) -> None:  # fmt: skip
    """Integrate recordings by the Runge–Kutta rule, sample after sample, into `states`."""
    dimension, known = begin.shape[1], signals.shape[1]
    substeps = signals.shape[0] // 3
    node = (0, 1, 1, 2)
    reach = (0.0, 0.5, 0.5, 1.0)
    weight = (1.0, 2.0, 2.0, 1.0)
    slope, total = np.empty(dimension), np.empty(dimension)
    interval = 0
    for recording in range(len(first) - 1):
        last = interval + first[recording + 1] - first[recording] - 1
        now, row = begin[recording].copy(), first[recording]
        states[row] = now
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


ACCURACY = 1e-4  # relative change of the sum of squares at which a fit has converged
SETTLED = 0.1  # the same in χ², which matters where there are many samples
TRIALS = 25  # simulations of all recordings, at most,
# or as many as have so many samples together, at least 1000 each: along a curved valley steps are short
WORK, LEAST_WORK = 500_000, 1000
# Of Levenberg and Marquardt's rule, the usual values; damping is relative to each direction's own square.
FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-3, 1e-6, 1e4
EASIER, HARDER = 10.0, 5.0
NEARLY_FORESEEN = 0.25  # share of what is foreseen that a last step must gain
RUN = 0.3  # work of a simulation beside that of its derivatives
SINGULAR = 1e-13  # numerical: of the largest eigenvalue


def run(model: Dynamics, grid: Grid, begin: np.ndarray) -> np.ndarray:
    """Integrate recordings from their initial states, shape ``(recordings, d)``, to all samples ``(n, d)``.

    A simulation that runs away is not a number from there on.
    """
    tape = model.functions.tape
    if tape is None:
        return _run_side_by_side(model, grid, begin)
    delays = model.lags(model.values)
    nodes = [grid.signals(node, delays) for node in range(3 * grid.substeps)]
    signals = np.stack([np.concatenate([s.inputs, s.delayed, s.slopes, s.t[None]]) for s in nodes])
    return run_along(tape, grid, signals, model.values, begin)


def run_along(
    tape: Tape, grid: Grid, signals: np.ndarray, values: np.ndarray, begin: np.ndarray
) -> np.ndarray:
    """Integrate the rates on a tape, whose arguments are states, signals and parameters, to ``(n, d)``.

    The signals are what is known at all nodes, shape ``(3 substeps, s, intervals)``; initial states are
    ``(recordings, d)``.
    """
    states = np.full((len(grid.data.t), begin.shape[1]), np.nan)
    registers = tape.registers.copy()
    known = begin.shape[1] + signals.shape[1]
    registers[known : known + len(values)] = values
    with np.errstate(all="ignore"):
        _run_tape(
            tape.operations, registers, tape.base, tape.results, grid.data.first,
            np.ascontiguousarray(begin, dtype=float), signals, grid.step, states,
        )  # fmt: skip
    return states


def _run_side_by_side(model: Dynamics, grid: Grid, begin: np.ndarray) -> np.ndarray:
    """Integrate in numpy, all recordings side by side: for formulas that no tape can hold."""
    data = grid.data
    states = np.full((len(data.t), model.dimension), np.nan)
    lengths, current = np.diff(data.first), begin.T.copy()
    states[data.first[:-1]] = begin
    places = np.concatenate([[0], np.cumsum(lengths - 1)])[:-1]
    for sample in range(int(lengths.max()) - 1):
        alive = np.flatnonzero(lengths > sample + 1)
        one = grid.at_intervals(places[alive] + sample)
        with np.errstate(all="ignore"):
            after = integrate_intervals(model, one, model.values, current[:, alive])
        current[:, alive] = after
        states[data.first[alive] + sample + 1] = after.T
    return states


def fit_trajectories(
    model: Dynamics, data: Measurements, *, begin: np.ndarray, noise: Noise, substeps: int,
    budget: Budget | None = None,
) -> Fit:  # fmt: skip
    """Fit free parameters and initial states, without process noise, by damped steps.

    Slower by far than `siq.inference.maximum_likelihood.fit_by_multiple_shooting`, for it simulates
    sample after sample, and lost where the motion is chaotic; to be used where that one does not settle.

    Parameters
    ----------
    model, data
        Its parameters' values are where the fit begins.
    begin
        Initial states to begin with, shape ``(recordings, d)``.
    noise
        Of which only the measurement noise is used, for the weights of the outputs.
    substeps, budget
        Runge–Kutta steps between samples; charged for every evaluation.

    Returns
    -------
    Fit
        Not converged where the simulation runs away at the start, or where more simulations would be needed
        than are allowed.

    Raises
    ------
    BudgetSpent
        When nothing is left of what is allowed.
    """
    work, free = substeps * evaluation(model, data), np.array(model.free, dtype=int)
    count = int(np.isfinite(data.outputs).sum())
    slightest = min(ACCURACY, SETTLED / max(count, 1))
    grid, sides = Grid(data, substeps), None

    def followed(values: np.ndarray, begin: np.ndarray) -> tuple[np.ndarray, float]:
        """States at all samples, and the sum of squares, not finite where the simulation runs away."""
        states = run(model.with_values(values), grid, begin)
        signals = grid.at_samples(model.lags(values))
        outputs = model.functions.outputs(states.T, signals, values).T
        left = ((outputs - data.outputs) / np.sqrt(noise.measurement))[np.isfinite(data.outputs)]
        _, expected = expectations(model, values)
        aside = sides is None or (model.functions.sides(states.T, signals, values) == sides)[sides != 0].all()
        return states, float(left @ left + expected @ expected) if aside else np.inf

    with np.errstate(all="ignore"):
        values, converged, damping, normal = model.values, False, FIRST_DAMPING, None
        states, total = followed(values, begin)
        sides = model.functions.sides(states.T, grid.at_samples(model.lags(values)), values)
        for _ in range(max(TRIALS, WORK // max(count, LEAST_WORK)) if np.isfinite(total) else 0):
            if budget is not None:
                budget.charge(work * (RUN if normal is not None else 1.0 + RUN))
            if normal is None:
                along = linearise(model, grid, values, states)
                normal = _NormalEquations(along, data, noise.measurement, expectations(model, values))
            try:
                change, moved, foreseen = normal.step(damping)
            except np.linalg.LinAlgError:  # derivatives beyond all numbers
                break
            new = values.copy()
            new[free] += change
            tried, then = followed(new, begin + moved)
            gained = total - then
            if gained > 0:  # which what runs away never is
                settled = gained < slightest * total and gained > NEARLY_FORESEEN * foreseen
                values, begin, states, total, normal = new, begin + moved, tried, then, None
                damping = max(damping / EASIER, LEAST_DAMPING)
                if settled:
                    converged = True
                    break
            elif foreseen < slightest * total or damping > MOST_DAMPING:
                converged = True
                break
            else:
                damping *= HARDER
    return fit_of_states(
        model.with_values(values), data, x=states, noise=noise.without_process(), substeps=substeps,
        converged=converged,
    )  # fmt: skip


class _NormalEquations:
    """Least squares of parameters and the initial states of every recording, along trajectories without gaps.

    `shared` are the products of the parameters' columns, `own` those of each recording's initial state, and
    `between` those of both; the variances ``(m,)`` are the sensors'.
    """

    def __init__(
        self, along: Linearisation, data: Measurements, variance: np.ndarray,
        expected: tuple[np.ndarray, np.ndarray],
    ) -> None:  # fmt: skip
        along = replace(along, gap=np.zeros_like(along.gap))
        white = along.filtered(data.first, data.step, Noise(variance, np.zeros(along.gap.shape[1])))[0]
        dimension, parameters, recordings = along.gap.shape[1], along.response.shape[2], len(data.labels)
        self.shared, self.shared_target = np.zeros((parameters, parameters)), np.zeros(parameters)
        self.own = np.zeros((recordings, dimension, dimension))
        self.own_target = np.zeros((recordings, dimension))
        self.between = np.zeros((recordings, parameters, dimension))
        for place, (first, end) in enumerate(itertools.pairwise(data.first)):
            part = white[first:end].reshape(-1, white.shape[2])
            # As of a root at zero: where a derivative is no number, no direction is known.
            known = np.nan_to_num(part[:, 1:], posinf=0.0, neginf=0.0)
            columns, states = map(np.ascontiguousarray, np.split(known, [parameters], axis=1))
            left = np.ascontiguousarray(part[:, 0])
            self.shared += columns.T @ columns
            self.shared_target += columns.T @ left
            self.between[place], self.own[place] = columns.T @ states, states.T @ states
            self.own_target[place] = states.T @ left
        rows, deviations = expected
        self.shared += rows.T @ rows
        self.shared_target += rows.T @ deviations

    def step(self, damping: float) -> tuple[np.ndarray, np.ndarray, float]:
        """Changes of parameters ``(p,)`` and initial states ``(r, d)``, and what they gain if all is linear.

        Every direction is damped by its own square; initial states are eliminated recording by recording.
        """
        scale = np.sqrt(positive(np.diag(self.shared)))
        own_scale = np.sqrt(positive(np.einsum("rii->ri", self.own)))
        shared = self.shared / np.outer(scale, scale) + damping * np.eye(len(scale))
        own = self.own / (own_scale[:, :, None] * own_scale[:, None, :])
        own += damping * np.eye(own_scale.shape[1])
        between = self.between / (scale[None, :, None] * own_scale[:, None, :])
        target, own_target = self.shared_target / scale, self.own_target / own_scale
        inverse = np.linalg.pinv(own, rcond=SINGULAR, hermitian=True)
        through = between @ inverse
        reduced = shared - (through @ between.transpose(0, 2, 1)).sum(axis=0)
        rest = target - np.einsum("rpd,rd->p", through, own_target)
        change = np.linalg.pinv(reduced, rcond=SINGULAR, hermitian=True) @ rest
        begin = np.einsum("rde,re->rd", inverse, own_target - np.einsum("rpd,p->rd", between, change))
        linear = float(change @ target + (begin * own_target).sum())
        return change / scale, begin / own_scale, linear + damping * float(change @ change + (begin**2).sum())


SHORTEST_PREFIX = 8  # samples
PREFIX = 0.2  # of a recording


def _prefixes(data: Measurements, told: int | None) -> np.ndarray:
    """Samples of each recording that tell its initial state and are not scored, see `free_run`."""
    lengths = np.diff(data.first)
    rows = np.maximum((PREFIX * lengths).astype(int), SHORTEST_PREFIX) if told is None else told
    return np.asarray(np.minimum(rows, lengths - 1))


def scored_rows(data: Measurements, told: int | None = None) -> np.ndarray:
    """Mask of the samples behind the prefixes, shape ``(n,)``."""
    within = np.arange(len(data.t)) - data.first[data.recording]
    return np.asarray(within >= _prefixes(data, told)[data.recording])


def squared_errors(
    run: np.ndarray, data: Measurements, spread: np.ndarray | None = None
) -> np.ndarray | None:
    """Squared errors of all scored values of a free run over the variance of each measured output.

    Shape ``(values,)``, sample by sample; what was not measured is left out. None where it ran away. The
    spread, ``(m,)``, is another variance: that of all recordings, where the data are a part of them.
    """
    scored = scored_rows(data)
    measured = data.outputs[scored]
    error, known = run[scored] - measured, np.isfinite(measured)
    if not np.isfinite(error[known]).all():
        return None
    spread = np.nanvar(measured, axis=0) if spread is None else spread
    return np.asarray((error**2 / positive(spread))[known])


def normalised_rms(run: np.ndarray, data: Measurements) -> float | None:
    """Root mean square error over that of the outputs about their mean, see `squared_errors`."""
    squares = squared_errors(run, data)
    return None if squares is None else float(np.sqrt(squares.mean()))


def free_run(
    model: Dynamics, data: Measurements, *, noise: Noise, substeps: int, told: int | None = None,
    usual: np.ndarray | None = None,
) -> np.ndarray:  # fmt: skip
    """Outputs ``(n, m)`` of recordings simulated from states that their prefixes tell.

    They are NaN from where the simulation ran away.

    Parameters
    ----------
    model, data, substeps
        Nothing but initial states is fitted; Runge–Kutta steps between samples.
    noise
        The measurement noise weighs the outputs; the process noise lets the states follow the prefix first.
    told
        Samples of each prefix; by default a fifth of the recording, and `SHORTEST_PREFIX` at least.
    usual
        States along other recordings, shape ``(k, d)``: what a prefix does not tell is expected about their
        mean, anywhere within their range, as many recordings begin at its ends. By default nothing is.
    """
    prefix = data.until(np.maximum(_prefixes(data, told), 2))
    x = _initial_states(model, prefix, noise=noise, substeps=substeps, usual=usual)
    states = run(model, Grid(data, substeps), x)
    if not np.isfinite(states).all():  # a tank may empty that never did before
        substeps = max(substeps, EDGE_SUBSTEPS)
        spread = spread_edges(model, data, states, substeps=substeps)
        if dict(spread.edges).keys() - dict(model.edges).keys():
            states = run(spread, Grid(data, substeps), x)
    signals = data.signals(data.t, data.recording, delays=model.lags(model.values))
    return np.asarray(model.functions.outputs(states.T, signals, model.values).T)


def _initial_states(
    model: Dynamics, data: Measurements, *, noise: Noise, substeps: int, usual: np.ndarray | None = None
) -> np.ndarray:
    """The states in which recordings begin, shape ``(recordings, d)``, with all parameters as they are."""
    still = replace(model, parameters=tuple(replace(each, fixed=True) for each in model.parameters))
    process = np.zeros(model.dimension)
    process[: len(noise.process)] = noise.process
    start = first_states(still, data)
    if usual is not None:
        # What is expected of first states, as if it were measured: once, and as inaccurately as it is known.
        mean, width = usual.mean(axis=0), np.ptp(usual, axis=0)
        moving = np.flatnonzero(width > 0)
        names = [still.states[place] for place in moving]
        expected = np.full((len(data.t), len(names)), np.nan)
        expected[data.first[:-1]] = mean[moving]
        variances = np.concatenate([noise.measurement, width[moving] ** 2])
        further = ((f"usual_{name}", symbol(name)) for name in names)
        still = replace(still, outputs=(*still.outputs, *further))
        data = replace(data, outputs=np.hstack([data.outputs, expected]), sensor_noise=variances)
        noise = replace(noise, measurement=variances)
    fitted = partial(fit_by_multiple_shooting, still, data, estimate_process=False, substeps=substeps)
    follow = fitted(x=start, noise=Noise(noise.measurement, process))
    x, first = follow.x if np.isfinite(follow.sum_of_squares) else start, data.first[:-1]
    strict = fitted(x=x, noise=Noise(noise.measurement, 0 * process))
    if strict.converged:
        return strict.x[first]
    # Where f jumps or a reading is cut off, steps of all samples at once may go to and fro. Damped steps of
    # whole trajectories never make it worse. A fit that did not end may have left the states anywhere.
    begins = [x] if follow.converged else [x, start]
    damped = max(
        (fit_trajectories(still, data, begin=each[first], noise=noise, substeps=substeps) for each in begins),
        key=lambda fit: fit.log_likelihood if np.isfinite(fit.sum_of_squares) else -np.inf,
    )
    return (damped.x if np.isfinite(damped.sum_of_squares) else x)[first]


EDGE_SUBSTEPS = 12  # between samples, for models whose f jumps
# A guard, for where the likelihood still changes. Friction that sticks took more than 96 at 40 dB.
FINEST = 384
SHARP = 0.5  # change of the log-likelihood by halving the substeps, below which a jump is sharp enough
LEAST_SHARE = 0.1  # of what is missing to a goal, that steps twice as fine have to gain: a choice
EDGE = 0.05  # width of a jump, in what its argument passes in a substep


def spread_edges(model: Dynamics, data: Measurements, x: np.ndarray, *, substeps: int) -> Dynamics:
    """The model with its jumps, and its roots at zero, spread over about what arguments pass in a substep.

    It is used along states ``(n, d)``, which are those of all samples of the data, and NaN from where a
    simulation ran away. A root stays what it is where its argument does not come to zero, as that of the
    level in a tank which is never empty, and where it goes further down, to where it has none.
    """
    jumps = {one.args[0] for each in model.equations for one in each.atoms(sympy.sign)}
    arguments = sorted(jumps | {one.base for each in model.equations for one in roots_of(each)}, key=str)
    if not arguments:
        return model
    formulas = [model.evaluable(each) for each in arguments]
    signals = data.signals(data.t, data.recording, delays=model.lags(model.values))
    function = compile_values(formulas, model.arguments)
    further = np.zeros((model.dimension - x.shape[1], len(x)))  # states that a mechanism brings
    along = function(
        *x.T, *further, *signals.inputs, *signals.delayed, *signals.slopes, signals.t, *model.values
    )
    rows, edges = data.begins, []
    for argument, course in zip(arguments, along, strict=True):
        course = np.broadcast_to(course, data.t.shape)
        known = np.isfinite(moved := course[rows + 1] - course[rows])
        passed = float(np.sqrt(np.mean(moved[known] ** 2))) if known.any() else 0.0
        if argument in jumps or abs(np.nanmin(course, initial=np.inf)) <= passed:
            edges.append((argument, EDGE * passed / substeps + 1e-300))
    return replace(model, edges=tuple(edges))


def sharpened(rough: Fit, data: Measurements, *, goal: float = -np.inf, budget: Budget | None = None) -> Fit:
    """A fit whose jumps are spread so little that it no longer matters; motion that sticks asks for this.

    Without process noise only: with it the states follow the data anyway. The goal is a log-likelihood;
    where steps twice as fine gain hardly anything of what is missing to it, jumps are not what it lacks.
    """
    while (
        rough.converged and rough.model.edges and not rough.has_process_noise and 2 * rough.substeps <= FINEST
    ):
        same: dict[str, Any] = {"noise": rough.noise, "substeps": 2 * rough.substeps, "budget": budget}
        model = spread_edges(rough.model, data, rough.x, substeps=2 * rough.substeps)
        finer = fit_trajectories(model, data, begin=rough.x[data.first[:-1]], **same)
        if not finer.converged:
            finer = fit_by_multiple_shooting(model, data, x=rough.x, estimate_process=False, **same)
        if not finer.converged:
            break
        gained, missing = finer.log_likelihood - rough.log_likelihood, goal - rough.log_likelihood
        rough = finer
        if abs(gained) < SHARP or gained < LEAST_SHARE * missing:
            break
    return rough
