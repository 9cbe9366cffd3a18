"""Whole trajectories by damped least squares: for fits that Gauss–Newton steps at all samples do not settle.

`siq.estimation.estimation.fit_by_multiple_shooting` moves the states at all samples at once and is fast,
but where f jumps, or nearly, its linearised steps can go to and fro without end. Here only initial states and
parameters are unknown, every trajectory follows its equations at every step, and no step makes the fit worse.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from siq.dynamics.dynamics import Dynamics
from siq.dynamics.tape import Tape
from siq.estimation.budget import Budget, evaluation
from siq.estimation.expectations import Expectations
from siq.estimation.fit import Fit, fit_of_states
from siq.estimation.innovations import Noise
from siq.estimation.kernels import whitened_innovations
from siq.estimation.linearisation import Grid, Linearisation, integrate_intervals, linearise
from siq.estimation.measurements import Measurements
from siq.estimation.trajectory_kernel import run_tape

ACCURACY = 1e-4  # relative change of the sum of squares at which a fit has converged
SETTLED = 0.1  # the same in χ², which matters where there are many samples
TRIALS = 25  # simulations of all recordings, at most,
WORK = 500_000  # or as many as have so many samples together: along a curved valley steps are short
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
    """Integrate the rates on a tape, whose arguments are states, signals and parameters, in this order.

    Parameters
    ----------
    tape
        The rates.
    grid
        Recordings and substeps.
    signals
        What is known at all nodes, shape ``(3 substeps, s, intervals)``.
    values
        Of the parameters, shape ``(p,)``.
    begin
        Initial states, shape ``(recordings, d)``.

    Returns
    -------
    np.ndarray
        At all samples, shape ``(n, d)``; not a number from where they run away.
    """
    states = np.full((len(grid.data.t), begin.shape[1]), np.nan)
    registers = tape.registers.copy()
    known = begin.shape[1] + signals.shape[1]
    registers[known : known + len(values)] = values
    with np.errstate(all="ignore"):
        run_tape(
            tape.operations, registers, tape.base, tape.results, grid.data.first,
            np.ascontiguousarray(begin, dtype=float), signals, grid.step, states,
        )  # fmt: skip
    return states


def _run_side_by_side(model: Dynamics, grid: Grid, begin: np.ndarray) -> np.ndarray:
    """The same in numpy, all recordings side by side: for formulas that no tape can hold."""
    data = grid.data
    states = np.full((len(data.t), model.dimension), np.nan)
    lengths = np.diff(data.first)
    current = begin.T.copy()
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
    model: Dynamics,
    data: Measurements,
    *,
    begin: np.ndarray,
    noise: Noise,
    substeps: int,
    budget: Budget | None = None,
) -> Fit:
    """Fit free parameters and initial states, without process noise, by damped steps.

    Slower by far than `siq.estimation.estimation.fit_by_multiple_shooting`, for it simulates sample after
    sample, and lost where the motion is chaotic; to be used where that one does not settle.

    Parameters
    ----------
    model
        Its parameters' values are where the fit begins.
    data
        The measurements.
    begin
        Initial states to begin with, shape ``(recordings, d)``.
    noise
        Of which only the measurement noise is used, for the weights of the outputs.
    substeps
        Runge–Kutta steps between samples.
    budget
        Charged for every evaluation.

    Returns
    -------
    Fit
        Not converged where the simulation runs away at the begin, or where more simulations would be needed
        than are allowed.

    Raises
    ------
    BudgetSpent
        When nothing is left of what is allowed.
    """
    work = substeps * evaluation(model, data)
    with np.errstate(all="ignore"):
        grid = Grid(data, substeps)
        best = _Course.of(model, grid, model.values, begin, noise)
        converged = False
        if np.isfinite(best.total):
            best, converged = _descended(model, grid, best, noise, budget=budget, work=work)
    return fit_of_states(
        model.with_values(best.values),
        data,
        x=best.states,
        noise=noise.without_process(),
        substeps=substeps,
        converged=converged,
    )


@dataclass(frozen=True)
class _Course:
    """Trajectories from parameters and initial states.

    Attributes
    ----------
    values, begin, states
        All parameters; the initial states, shape ``(recordings, d)``; the states at all samples.
    total
        Weighted sum of squared residuals, and of what is expected of parameters; not finite where the
        simulation runs away.
    """

    values: np.ndarray
    begin: np.ndarray
    states: np.ndarray
    total: float

    @classmethod
    def of(cls, model: Dynamics, grid: Grid, values: np.ndarray, begin: np.ndarray, noise: Noise) -> _Course:
        states = run(model.with_values(values), grid, begin)
        outputs = model.functions.outputs(states.T, grid.at_samples(model.lags(values)), values).T
        known = np.isfinite(grid.data.outputs)
        left = ((outputs - grid.data.outputs) / np.sqrt(noise.measurement))[known]
        expected = Expectations.of(model).deviations(values[list(model.free)])
        return cls(values, begin, states, float(left @ left + expected @ expected))


def _descended(
    model: Dynamics, grid: Grid, best: _Course, noise: Noise, *, budget: Budget | None, work: float
) -> tuple[_Course, bool]:
    """Damped steps downhill (Levenberg and Marquardt), and whether they came to an end."""
    free = np.array(model.free, dtype=int)
    values = int(np.isfinite(grid.data.outputs).sum())
    slightest = min(ACCURACY, SETTLED / max(values, 1))
    damping, normal = FIRST_DAMPING, None
    for _ in range(max(TRIALS, WORK // max(values, 1))):
        if budget is not None:
            budget.charge(work * (RUN if normal is not None else 1.0 + RUN))
        if normal is None:
            along = linearise(model, grid, best.values, best.states)
            normal = normal_equations(along, grid.data, noise.measurement).with_expectations(
                Expectations.of(model), best.values[free]
            )
        change, begin, foreseen = normal.step(damping)
        new = best.values.copy()
        new[free] += change
        tried = _Course.of(model, grid, new, best.begin + begin, noise)
        gained = best.total - tried.total
        if gained > 0:  # which what runs away never is
            settled = gained < slightest * best.total and gained > NEARLY_FORESEEN * foreseen
            best, normal = tried, None
            damping = max(damping / EASIER, LEAST_DAMPING)
            if settled:
                return best, True
        else:
            if foreseen < slightest * best.total or damping > MOST_DAMPING:
                return best, True
            damping *= HARDER
    return best, False


@dataclass(frozen=True)
class NormalEquations:
    """Least squares of parameters and the initial states of every recording.

    Attributes
    ----------
    shared
        Products of the parameters' columns, summed over the recordings, shape ``(p, p)``.
    own
        The same of each recording's initial state, shape ``(r, d, d)``.
    between
        Of parameters and initial states, shape ``(r, p, d)``.
    shared_target, own_target
        With the residuals: shapes ``(p,)`` and ``(r, d)``.
    """

    shared: np.ndarray
    own: np.ndarray
    between: np.ndarray
    shared_target: np.ndarray
    own_target: np.ndarray

    def with_expectations(self, expected: Expectations, values: np.ndarray) -> NormalEquations:
        """The same with what is expected of the parameters, which are at `values`, shape ``(p,)``."""
        return replace(
            self,
            shared=self.shared + expected.rows.T @ expected.rows,
            shared_target=self.shared_target + expected.rows.T @ expected.deviations(values),
        )

    def step(self, damping: float) -> tuple[np.ndarray, np.ndarray, float]:
        """Changes of parameters ``(p,)`` and initial states ``(r, d)``, and what they gain if all is linear.

        Every direction is damped by its own square; initial states are eliminated recording by recording.
        """
        scale = _sizes(np.diag(self.shared))
        own_scale = _sizes(np.einsum("rii->ri", self.own))
        shared = self.shared / np.outer(scale, scale) + damping * np.eye(len(scale))
        own = self.own / (own_scale[:, :, None] * own_scale[:, None, :]) + damping * np.eye(
            own_scale.shape[1]
        )
        between = self.between / (scale[None, :, None] * own_scale[:, None, :])
        target, own_target = self.shared_target / scale, self.own_target / own_scale
        inverse = np.linalg.pinv(own, rcond=SINGULAR, hermitian=True)
        through = between @ inverse
        reduced = shared - (through @ between.transpose(0, 2, 1)).sum(axis=0)
        rest = target - np.einsum("rpd,rd->p", through, own_target)
        change = np.linalg.pinv(reduced, rcond=SINGULAR, hermitian=True) @ rest
        begin = np.einsum("rde,re->rd", inverse, own_target - np.einsum("rpd,p->rd", between, change))
        linear = float(change @ target + (begin * own_target).sum())
        length = float(change @ change + (begin**2).sum())
        return change / scale, begin / own_scale, linear + damping * length


def normal_equations(
    linearisation: Linearisation, data: Measurements, variance: np.ndarray
) -> NormalEquations:
    """The normal equations along trajectories without gaps, at the sensors' variances ``(m,)``."""
    innovations, by_parameters, by_initial, _ = whitened_innovations(
        data.first,
        linearisation.transition,
        linearisation.response,
        np.zeros_like(linearisation.gap),
        np.zeros_like(linearisation.transition),
        linearisation.measured,
        linearisation.measured_response,
        linearisation.residual,
        variance,
    )
    dimension, parameters = by_initial.shape[2], by_parameters.shape[2]
    recordings = len(data.labels)
    shared, shared_target = np.zeros((parameters, parameters)), np.zeros(parameters)
    own, own_target = np.zeros((recordings, dimension, dimension)), np.zeros((recordings, dimension))
    between = np.zeros((recordings, parameters, dimension))
    for place, (first, end) in enumerate(zip(data.first[:-1], data.first[1:], strict=True)):
        # As of a root at zero: where a derivative is no number, no direction is known.
        values = (end - first) * innovations.shape[1]
        columns = by_parameters[first:end].reshape(values, parameters)
        columns = np.nan_to_num(columns, posinf=0.0, neginf=0.0)
        states = np.nan_to_num(by_initial[first:end].reshape(values, dimension), posinf=0.0, neginf=0.0)
        left = innovations[first:end].ravel()
        shared += columns.T @ columns
        shared_target += columns.T @ left
        between[place], own[place], own_target[place] = columns.T @ states, states.T @ states, states.T @ left
    return NormalEquations(shared, own, between, shared_target, own_target)


def _sizes(squares: np.ndarray) -> np.ndarray:
    return np.sqrt(np.where(squares > 0, squares, 1.0))
