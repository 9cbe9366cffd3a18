"""Estimation: parameters, states and the two kinds of noise, by maximum likelihood.

The model is fitted with noise in what is measured (variance R) and, where asked, noise that drives the states
(intensity Q per time). With Q = 0 this is the least-squares fit of whole trajectories. With Q > 0 it is the
extended Kalman filter, linearised at what it knows at the begin of each interval, whose likelihood is that
of its innovations. Linearising along *smoothed* states, which know the future, would be another thing: what
random forces did later is then in the states at which f is taken, and the coefficients of f come out too
small, by a half where sensor and random forces do alike. Smoothed states are where the filter begins, since
they follow the data whatever the model says, and they are what is shown of the motion.

A model that lacks physics is fitted with Q > 0 too, so that a later addition is judged along the right
trajectories. Initial states are unknown and enter as fixed effects; the variances are those of highest
restricted likelihood, which allows for that.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from siq.dynamics.dynamics import Dynamics
from siq.estimation.budget import Budget
from siq.estimation.closure import ClosedFunctions
from siq.estimation.expectations import Expectations
from siq.estimation.fit import RUNS_AWAY, Fit, failed_fit, fit_at
from siq.estimation.innovations import Noise, solve, whiten
from siq.estimation.linearisation import Grid, linearise, substeps_needed
from siq.estimation.measurements import Measurements
from siq.estimation.noise import Priors, noise_along
from siq.estimation.shooting import Iterate, Shooting

SUBSTEP_ERROR = 3e-6  # of the spread of a state: far below what any sensor resolves
SETTLED = 1e-4  # change of the innovations, squared and per sample, at which a fit has converged
FINE = 1e-3  # the same of all innovations together, by the parameters: a thirtieth of a standard error
STANDSTILL = 0.005  # change of the sum of squares over four steps, below which a fit moves to no avail
PATIENCE = 6  # steps before that is asked
RESTING = 1e-12  # of a state's domain, the least that its spread is taken for


def fit_by_multiple_shooting(
    model: Dynamics,
    data: Measurements,
    *,
    x: np.ndarray,
    noise: Noise,
    estimate_process: bool,
    substeps: int | None = None,
    iterations: int = 25,
    budget: Budget | None = None,
) -> Fit:
    """Fit free parameters, states and noise, by Gauss–Newton steps along linearised trajectories.

    Parameters
    ----------
    model
        Its parameters' values are where the fit begins.
    data
        The measurements.
    x
        States to begin with, shape ``(n, d)``.
    noise
        To begin with. Without process noise the fitted states follow their equations exactly.
    estimate_process
        Whether the process noise is estimated, too; the measurement noise always is.
    substeps
        Runge–Kutta steps between samples; by default as many as the accuracy needs.
    iterations
        Most steps.
    budget
        Charged for every evaluation.

    Returns
    -------
    Fit
        Not converged, with a log-likelihood of -∞ and the reason as its `fault`, where the simulation runs
        away.

    Raises
    ------
    BudgetSpent
        When nothing is left of what is allowed.
    """
    with np.errstate(all="ignore"):  # what runs away is told as a fault
        if substeps is None:
            substeps = substeps_needed(model, data, model.values, x, tolerance=SUBSTEP_ERROR)
        grid = Grid(data, substeps)
        begin = Iterate(model.values, x, linearise(model, grid, model.values, x), x)
        if not begin.along.finite:
            return failed_fit(model, begin, noise, substeps, RUNS_AWAY)
        shooting = Shooting(model, grid, _sizes(model, x), budget=budget)
        try:
            fit = _gauss_newton(shooting, begin, noise, estimate_process=estimate_process, most=iterations)
        except (ArithmeticError, np.linalg.LinAlgError) as error:
            return failed_fit(model, begin, noise, substeps, str(error))
    if not (fit.converged and fit.has_process_noise):
        return fit
    return fit_by_filter(
        fit.model, data, x=fit.x, noise=fit.noise, estimate_process=estimate_process, substeps=substeps,
        iterations=iterations, closure=False, budget=budget,
    )  # fmt: skip


def fit_by_filter(
    model: Dynamics,
    data: Measurements,
    *,
    x: np.ndarray,
    noise: Noise,
    estimate_process: bool = True,
    estimate_sensor: bool = True,
    substeps: int | None = None,
    iterations: int = 25,
    closure: bool = True,
    budget: Budget | None = None,
) -> Fit:
    """The second half of `fit_by_multiple_shooting` alone, for a model that follows the data from the start.

    Parameters
    ----------
    model, data, x, noise, estimate_process, substeps, iterations, budget
        See there; random forces have to drive the states.
    estimate_sensor
        Whether the noise of the sensors is estimated; if not, the random forces are as given, too.
    closure
        Whether the spread of what the filter knows acts on the mean of f (`siq.estimation.closure`).

    Returns
    -------
    Fit
        See there.
    """
    with np.errstate(all="ignore"):  # what runs away is told as a fault
        if substeps is None:
            substeps = substeps_needed(model, data, model.values, x, tolerance=SUBSTEP_ERROR)
        closed = ClosedFunctions(model) if closure else None
        if not estimate_sensor:
            data = replace(data, sensor_noise=noise.measurement)
        shooting = Shooting(
            model, Grid(data, substeps), _sizes(model, x), filtered=True, closed=closed, budget=budget
        )
        begin = Iterate(model.values, x, shooting.linearised(model.values, x, None, noise), x)
        if not begin.along.finite:
            return failed_fit(model, begin, noise, substeps, RUNS_AWAY)
        try:
            return _gauss_newton(shooting, begin, noise, estimate_process=estimate_process, most=iterations)
        except (ArithmeticError, np.linalg.LinAlgError) as error:
            return failed_fit(model, begin, noise, substeps, str(error))


def _gauss_newton(
    shooting: Shooting, now: Iterate, noise: Noise, *, estimate_process: bool, most: int
) -> Fit:
    data, expected = shooting.grid.data, Expectations.of(shooting.model)
    before: np.ndarray | None = None
    totals: list[float] = []
    converged, settled_noise, whole = False, False, False
    for iteration in range(most):
        noise = shooting.noise_at(now, noise)
        if iteration in (0, 2) or settled_noise:
            noise = noise_along(
                now.along, data, noise, estimate_process,
                priors=Priors(expected, now.values[list(shooting.model.free)]),
                charge=shooting.charge, coarse=not settled_noise,
            )  # fmt: skip
        shooting.charge()
        white = whiten(now.along, data, noise)
        columns, innovations = expected.beside(
            white.columns, white.innovations, now.values[list(shooting.model.free)]
        )
        change, _ = solve(columns, innovations, least=shooting.resolution)
        explained = white.columns @ change
        left = white.innovations - explained
        settled = SETTLED * len(left) * max(1.0, (left**2).sum() / len(left))
        # A shortened step leaves much of what is foreseen undone, and the forecast unchanged. So does a whole
        # one where effects are so curved that steps go to and fro: the states in hand have to be as likely
        # as the forecast is, since it is they that the likelihood is of.
        if (
            before is not None
            and whole
            and ((left - before) ** 2).sum() < settled
            and explained @ explained < (FINE if shooting.filtered else settled)
        ):
            if settled_noise:
                converged = True
                break
            settled_noise = True
        before = left
        totals.append(float(white.innovations @ white.innovations))
        if len(totals) > PATIENCE and settled_noise is False and _stands_still(totals):
            settled_noise = True
        elif len(totals) > 2 * PATIENCE and _stands_still(totals):
            converged = True
            break
        step = shooting.stepped(now, change, noise)
        if step is None:
            break
        now, length = step
        whole = length == 1.0
    return fit_at(
        shooting.model, data, now, noise=noise, substeps=shooting.grid.substeps, converged=converged,
        resolution=shooting.resolution,
    )  # fmt: skip


def _stands_still(totals: list[float]) -> bool:
    """Whether a fit moves without becoming better: where f jumps its derivatives are never exact."""
    recent = totals[-4:]
    return max(recent) - min(recent) < STANDSTILL * max(recent)


def _sizes(model: Dynamics, x: np.ndarray) -> np.ndarray:
    """By how much each state varies, shape ``(d,)``; not zero where one rests."""
    about_zero = 2 * np.where(x.any(axis=0), np.abs(x).max(axis=0), 1.0)
    wide = np.ptp(model.limits, axis=1)
    return np.maximum(x.std(axis=0), RESTING * np.where(np.isfinite(wide), wide, about_zero))
