"""Which values of its own parameters make a simulation fit recordings best?"""

from __future__ import annotations

import numpy as np

from siq.dynamics.dynamics import Dynamics
from siq.errors import NumericalFailure
from siq.estimation.budget import Budget
from siq.estimation.estimation import Fit, fit_by_multiple_shooting
from siq.estimation.first_states import first_states
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


def recalibrate(model: Dynamics, data: Measurements, *, budget: Budget | None = None) -> tuple[Fit, Fit]:
    """Fit the simulation's own parameters: with process noise where the data ask for it, and without.

    Raises
    ------
    NumericalFailure
        When neither fit can be made.
    """
    x = first_states(model, data)
    noise = first_noise(model, data, x)
    loose = fit_by_multiple_shooting(model, data, x=x, noise=noise, estimate_process=True, budget=budget)
    if loose.converged:
        again, strict = fit_with_and_without_process_noise(
            loose.model, data, loose, settled=True, budget=budget
        )
        return simpler_fit(again, strict), strict
    # Where random forces on a hidden state could explain anything, the fit has no end. The card's own
    # simulation is then the better start.
    followed = run(model, Grid(data, max(loose.substeps, 1)), x[data.first[:-1]])
    x = np.where(np.isfinite(followed), followed, x)
    strict = fit_by_multiple_shooting(
        model, data, x=x, noise=noise.without_process(), estimate_process=False, budget=budget
    )
    if not strict.converged:
        # Steps at all samples at once may lead anywhere, from where a search could explain nothing. Damped
        # steps of whole trajectories never make a fit worse than the card's own simulation is.
        damped = fit_trajectories(
            model,
            data,
            begin=x[data.first[:-1]],
            noise=noise,
            substeps=max(loose.substeps, 1),
            budget=budget,
        )
        strict = better_of(strict, damped)
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
    if not again.converged:
        return strict, strict
    idle = without_idle_forces(again, data)
    strict = strict if idle is None else better_of(idle, strict)
    return simpler_fit(again, strict), strict
