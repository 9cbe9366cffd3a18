"""What is known of a fit: its parameters with their errors, its states, its noise and its likelihood?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from siq.dynamics.dynamics import Dynamics
from siq.estimation.expectations import Expectations
from siq.estimation.innovations import Noise, solve, whiten
from siq.estimation.linearisation import Grid, Linearisation, linearise
from siq.estimation.measurements import Measurements
from siq.estimation.noise import Priors, noise_along
from siq.estimation.shooting import INEXACT, Iterate, changed

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
        Below which singular values tell nothing; see `siq.estimation.innovations.solve`.

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
