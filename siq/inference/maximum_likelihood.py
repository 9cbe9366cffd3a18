"""Maximum likelihood: parameters, states and both kinds of noise from recordings.

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

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from siq.inference.budget import Budget, evaluation
from siq.inference.filter_kernels import smoothed_states, whitened_innovations
from siq.inference.kalman_filter import (
    RANK,
    ClosedFunctions,
    Grid,
    Linearisation,
    Noise,
    linearise,
    process_covariance,
    solve,
    substeps_needed,
    whiten,
    with_parameters_changed,
)
from siq.inference.measurements import Expectations, Measurements
from siq.inference.noise import Priors, noise_along
from siq.systems.dynamics import Dynamics

SMALLEST_STEP = 1 / 64
INEXACT = 1e-4  # numerical: of effects carried along whole trajectories, where f may jump, the rest is error
NONLINEAR = 0.5  # share of a step's effect that may be unforeseen before the step is shortened
HARMLESS = 0.1  # of a filter's own corrections: what is unforeseen below that is corrected as they are


@dataclass(frozen=True)
class Iterate:
    """Where a fit stands.

    Attributes
    ----------
    values
        All parameters, shape ``(p,)``.
    x
        The states at which f is taken, shape ``(n, d)``.
    along
        The linearisation there.
    smoothed
        The states given all measurements, shape ``(n, d)``.
    spread
        Covariance of what a filter knows at each sample, shape ``(n, d, d)``; None where nothing drives the
        states.
    """

    values: np.ndarray
    x: np.ndarray
    along: Linearisation
    smoothed: np.ndarray
    spread: np.ndarray | None = None


@dataclass(frozen=True)
class StateChanges:
    """Most probable changes of all states, given those of the parameters.

    Attributes
    ----------
    smoothed, filtered
        By all measurements, and by those until then, shape ``(n, d)`` each.
    spread
        Covariance of what is filtered, shape ``(n, d, d)``.
    """

    smoothed: np.ndarray
    filtered: np.ndarray
    spread: np.ndarray


@dataclass(frozen=True)
class Shooting:
    """What is fitted.

    Attributes
    ----------
    model, grid
        The dynamics, on the grid of the measurements.
    scale
        The size of each state, shape ``(d,)``.
    filtered
        Whether f is taken at what a filter knows, rather than at smoothed states.
    closed
        F with the effect of the filter's spread on it, where that is wanted.
    budget
        Charged for every evaluation; None where nobody counts.
    """

    model: Dynamics
    grid: Grid
    scale: np.ndarray
    filtered: bool = False
    closed: ClosedFunctions | None = None
    budget: Budget | None = None

    @property
    def resolution(self) -> float:
        """How unlike the effects of parameters have to be for the data to tell them apart; see `solve`."""
        return RANK if self.filtered else INEXACT

    def charge(self, evaluations: float = 1.0) -> None:
        """Count evaluations of the likelihood.

        Raises
        ------
        BudgetSpent
            When nothing is left of what is allowed.
        """
        if self.budget is not None:
            self.budget.charge(evaluations * evaluation(self.model, self.grid.data))

    def linearised(
        self, values: np.ndarray, x: np.ndarray, spread: np.ndarray | None, noise: Noise
    ) -> Linearisation:
        """At parameters ``(p,)`` and states ``(n, d)``."""
        self.charge(self.grid.substeps)
        if self.closed is None or spread is None:
            return linearise(self.model, self.grid, values, x)
        rows, data = self.grid.rows, self.grid.data
        # The random forces of half an interval are what its middle adds to the spread at its begin.
        half = (data.t[rows + 1] - data.t[rows])[:, None, None] / 2
        intensity = noise.intensity if len(noise.intensity) == 1 else noise.intensity[rows]
        drift = self.closed.at(spread[rows] + intensity * half)
        return linearise(self.model, self.grid, values, x, drift=drift)

    def noise_at(self, now: Iterate, noise: Noise) -> Noise:
        """The noise where a fit stands: random forces may depend on the state."""
        if noise.field is None:
            return noise
        rows, data = self.grid.rows, self.grid.data
        middle, step = now.x.copy(), np.append(np.diff(data.t), 0.0)
        middle[rows] += (now.x[rows + 1] + now.along.gap[rows] - now.x[rows]) / 2
        return noise.along(middle, now.spread, step)

    def stepped(self, now: Iterate, change: np.ndarray, noise: Noise) -> tuple[Iterate, float] | None:
        """The step that the linearisation suggests, shortened until it does about what was foreseen.

        Parameters
        ----------
        now
            Where the fit stands.
        change
            Of the free parameters, shape ``(p,)``.
        noise
            Decides how the states follow.

        Returns
        -------
        Iterate, float
            Where it leads, and the share of it that was taken; None where not even a short one does as
            foreseen.
        """
        follow = state_changes(now.along, self.grid.data, noise, change)
        deviation = follow.filtered if self.filtered else follow.smoothed
        spread = follow.spread if noise.process.any() else None
        rows, scale = self.grid.rows, self.scale
        moved = np.einsum("kij,kj->ki", now.along.transition[rows], deviation[rows])
        moved += now.along.response[rows] @ change
        foreseen = now.along.gap[rows] + moved - deviation[rows + 1]
        effect = np.sqrt(np.mean(((np.abs(moved) + np.abs(deviation[rows + 1])) / scale) ** 2))
        # A filter's gaps are its corrections at each sample, which random forces and sensors ask for anyway.
        usual = np.sqrt(np.mean((now.along.gap[rows] / scale) ** 2)) if self.filtered else 0.0
        length = 1.0
        while length >= SMALLEST_STEP:
            values = changed(now.values, self.model.free, length * change)
            x = now.x + length * deviation
            along = self.linearised(values, x, spread, noise)
            if along.finite:
                expected = (1 - length) * now.along.gap[rows] + length * foreseen
                unforeseen = np.sqrt(np.mean(((along.gap[rows] - expected) / scale) ** 2))
                if unforeseen <= NONLINEAR * length * effect + HARMLESS * usual + 1e-9:
                    smoothed = now.x + length * follow.smoothed
                    return Iterate(values, x, along, smoothed, spread), length
            length /= 2
        return None


def state_changes(
    linearisation: Linearisation, data: Measurements, noise: Noise, change: np.ndarray
) -> StateChanges:
    """How the states follow a change of the free parameters, shape ``(p,)``."""
    step = np.append(np.diff(data.t), 0.0)
    process = process_covariance(linearisation.transition, step, noise.intensity)
    still = with_parameters_changed(linearisation, change)
    gap, residual = still.gap, still.residual
    innovations, _, initial, _ = whitened_innovations(
        data.first,
        still.transition,
        still.response,
        gap,
        process,
        still.measured,
        still.measured_response,
        residual,
        noise.measurement,
    )
    begin = np.empty((len(data.labels), gap.shape[1]))
    for place, (start, end) in enumerate(zip(data.first[:-1], data.first[1:], strict=True)):
        columns = initial[start:end].reshape(-1, gap.shape[1])
        begin[place] = solve(columns, innovations[start:end].ravel(), least=INEXACT)[0]
    return StateChanges(
        *smoothed_states(
            data.first,
            linearisation.transition,
            gap,
            process,
            linearisation.measured,
            residual,
            noise.measurement,
            begin,
        )
    )


def changed(values: np.ndarray, free: Sequence[int], change: np.ndarray) -> np.ndarray:
    """Parameters' values after a change of the free ones."""
    result = values.copy()
    result[np.array(free, dtype=int)] += change
    return result


RUNS_AWAY = "the simulation runs away between two samples"


@dataclass(frozen=True)
class Fit:
    """A fitted model.

    Attributes
    ----------
    model
        With the estimates as its parameters' values.
    covariance
        Of the free parameters, shape ``(p, p)``, from white innovations.
    x
        Smoothed states at all samples, shape ``(n, d)``.
    linearised_at
        Where f was taken for `linearisation`, shape ``(n, d)``: `x` without process noise, otherwise what the
        filter knows at each sample.
    spread
        Covariance of what the filter knows at each sample, shape ``(n, d, d)``; None without process noise.
    noise
        Estimates, or what was given.
    linearisation
        At `linearised_at` and the estimates.
    log_likelihood
        Not the restricted one, which depends on the units in which a model has its states.
    sum_of_squares
        Of the whitened innovations, and of what is expected of parameters: about `degrees_of_freedom` where
        the model is right.
    degrees_of_freedom
        Measured values, and what is expected of several parameters together, less initial states and free
        parameters.
    substeps
        Runge–Kutta steps between samples.
    converged
        Whether the iteration settled.
    fault
        Why there is no result; empty where there is one, settled or not.
    """

    model: Dynamics
    covariance: np.ndarray
    x: np.ndarray
    linearised_at: np.ndarray
    spread: np.ndarray | None
    noise: Noise
    linearisation: Linearisation
    log_likelihood: float
    sum_of_squares: float
    degrees_of_freedom: int
    substeps: int
    converged: bool
    fault: str = ""

    @property
    def standard_errors(self) -> np.ndarray:
        """Of the free parameters, shape ``(p,)``."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def has_process_noise(self) -> bool:
        """Whether the states were let deviate from their equations."""
        return bool((self.noise.process > 0).any())


def fit_of_states(
    model: Dynamics, data: Measurements, *, x: np.ndarray, noise: Noise, substeps: int, converged: bool
) -> Fit:
    """What is known of a fit that was made otherwise: without process noise, its states follow the equations.

    Parameters
    ----------
    model
        With the estimates.
    data, substeps, converged
        Of the fit.
    x
        The fitted states, shape ``(n, d)``.
    noise
        To begin with; the measurement noise is estimated.
    """
    at = Iterate(model.values, x, linearise(model, Grid(data, substeps), model.values, x), x)
    if not at.along.finite:
        return failed_fit(model, at, noise, substeps, RUNS_AWAY)
    try:
        priors = Priors(Expectations.of(model), model.values[list(model.free)])
        noise = noise_along(at.along, data, noise, estimate_process=False, priors=priors)
        return fit_at(
            model, data, at, noise=noise, substeps=substeps, converged=converged, resolution=INEXACT
        )
    except (ArithmeticError, np.linalg.LinAlgError) as error:
        return failed_fit(model, at, noise, substeps, str(error))


def fit_at(
    model: Dynamics,
    data: Measurements,
    at: Iterate,
    *,
    noise: Noise,
    substeps: int,
    converged: bool,
    resolution: float,
) -> Fit:
    """What is known of a fit whose iteration ended at parameters, states and noise.

    Parameters
    ----------
    model, data
        The model, and the measurements.
    at
        Where it ended.
    noise, substeps, converged
        See `Fit`.
    resolution
        Below which singular values tell nothing; see `siq.inference.kalman_filter.solve`.

    Raises
    ------
    NumericalFailure
        When what a parameter does to what is measured is not finite.
    """
    white = whiten(at.along, data, noise)
    columns, innovations = Expectations.of(model).beside(
        white.columns, white.innovations, at.values[list(model.free)]
    )
    change, covariance = solve(columns, innovations, least=resolution)
    # The last change is below the errors. The likelihood is that of the states in hand, not of a forecast.
    total = float(innovations @ innovations)
    together = sum(len(each.roots) for each in model.expected_together)
    return Fit(
        model=model.with_values(changed(at.values, model.free, change if converged else 0 * change)),
        covariance=covariance,
        x=at.smoothed,
        linearised_at=at.x,
        spread=at.spread,
        noise=noise,
        linearisation=at.along,
        log_likelihood=white.log_likelihood(total),
        sum_of_squares=total,
        degrees_of_freedom=white.degrees_of_freedom + together - len(model.free),
        substeps=substeps,
        converged=converged,
    )


def failed_fit(model: Dynamics, at: Iterate, noise: Noise, substeps: int, fault: str) -> Fit:
    """A fit that has no result, and the reason; see `Fit.fault`."""
    free = len(model.free)
    return Fit(
        model=model,
        covariance=np.full((free, free), np.nan),
        x=at.smoothed,
        linearised_at=at.x,
        spread=at.spread,
        noise=noise,
        linearisation=at.along,
        log_likelihood=-np.inf,
        sum_of_squares=np.inf,
        degrees_of_freedom=1,
        substeps=substeps,
        converged=False,
        fault=fault,
    )


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
        Whether the spread of what the filter knows acts on the mean of f (`siq.inference.kalman_filter`).

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
