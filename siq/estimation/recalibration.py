"""Which values of its own parameters make a simulation fit recordings best?"""

from __future__ import annotations

import numpy as np

from siq.dynamics.dynamics import Dynamics
from siq.errors import NumericalFailure
from siq.estimation.budget import Budget
from siq.estimation.estimation import fit_by_multiple_shooting
from siq.estimation.first_states import first_states
from siq.estimation.fit import Fit
from siq.estimation.innovations import Noise
from siq.estimation.linearisation import Grid
from siq.estimation.measurements import Measurements
from siq.estimation.noise import first_noise
from siq.estimation.process_noise import (
    better_of,
    fit_with_and_without_process_noise,
    simpler_fit,
    without_idle_forces,
)
from siq.estimation.trajectories import fit_trajectories, run

FAINT = 1e-4  # process noise, relative to the motion, from which a fit without any is loosened
BETTER = 0.5  # of a log-likelihood: what half a parameter gains by chance, below which two fits are one


def recalibrate(model: Dynamics, data: Measurements, *, budget: Budget | None = None) -> tuple[Fit, Fit]:
    """Fit the simulation's own parameters: with process noise where the data ask for it, and without.

    The likelihood has more than one maximum where a state is hidden. A fit begins twice, along states that
    follow the recordings and along the card's own simulation, and the likelier end counts.

    Raises
    ------
    NumericalFailure
        When neither fit can be made.
    """
    x = first_states(model, data)
    noise = first_noise(model, data, x)
    loose = fit_by_multiple_shooting(model, data, x=x, noise=noise, estimate_process=True, budget=budget)
    own = fit_from_card(model, data, x=x, noise=noise, substeps=max(loose.substeps, 1), budget=budget)
    known: Fit | None = None
    if loose.converged:
        known, strict = fit_with_and_without_process_noise(
            loose.model, data, loose, settled=True, budget=budget
        )
        if not (own.converged and own.log_likelihood > strict.log_likelihood + BETTER):
            return simpler_fit(known, strict), strict
    # Where random forces on a hidden state could explain anything, the fit has no end, or one far off. The
    # card's own simulation is then the better start.
    strict = own
    if not strict.converged:
        if not np.isfinite(loose.sum_of_squares):
            raise NumericalFailure(strict.fault or loose.fault)
        return loose, strict
    small = Noise(strict.noise.measurement, noise.process * FAINT)
    again = fit_by_multiple_shooting(
        strict.model,
        data,
        x=strict.x,
        noise=small,
        estimate_process=True,
        substeps=strict.substeps,
        budget=budget,
    )
    if again.converged:
        idle = without_idle_forces(again, data)
        strict = strict if idle is None else better_of(idle, strict)
    loosened = [each for each in (known, again) if each is not None and each.converged]
    best = max(loosened, key=lambda each: each.log_likelihood, default=None)
    return simpler_fit(best, strict), strict


def fit_from_card(
    model: Dynamics,
    data: Measurements,
    *,
    x: np.ndarray,
    noise: Noise,
    substeps: int,
    budget: Budget | None = None,
) -> Fit:
    """Fit without process noise, beginning along the simulation as the card has it.

    Parameters
    ----------
    model, data
        The simulation, and the recordings.
    x
        States read off the recordings, shape ``(n, d)``, whose first ones the simulation begins with.
    noise
        Of which only that of the sensors is used.
    substeps
        Runge–Kutta steps between samples.
    budget
        Charged for every evaluation.
    """
    begin = x[data.first[:-1]]
    followed = run(model, Grid(data, substeps), begin)
    strict = fit_by_multiple_shooting(
        model, data, x=np.where(np.isfinite(followed), followed, x), noise=noise.without_process(),
        estimate_process=False, budget=budget,
    )  # fmt: skip
    if strict.converged:
        return strict
    # Steps at all samples at once may lead anywhere, from where a search could explain nothing. Damped
    # steps of whole trajectories never make a fit worse than the card's own simulation is.
    damped = fit_trajectories(model, data, begin=begin, noise=noise, substeps=substeps, budget=budget)
    return better_of(strict, damped)
