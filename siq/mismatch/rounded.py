"""Does rounding explain what a simulation leaves?

Where a sensor's steps are wide beside its noise, what rounding does hangs together for as long as a reading
stays on a step, and looks like random forces, or like physics that is missing. The steps are known: the
recorded values lie on them. Of a reading that was rounded it is known that the value lay within its step, and
a simulation says where: at the mean of a normal distribution that is cut off at the edges of the step. About
the right simulation the residuals to these values are independent of each other (the generalised residuals of
Gourieroux, Monfort, Renault and Trognon, Journal of Econometrics 34, 5, 1987), and the fit to them is that
of highest likelihood of the readings (Dempster, Laird and Rubin's EM algorithm). So they can be asked whether
anything is left.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.stats

from siq.dynamics.dynamics import Dynamics
from siq.errors import NumericalFailure
from siq.estimation.budget import Budget
from siq.estimation.estimation import fit_by_multiple_shooting
from siq.estimation.fit import Fit
from siq.estimation.innovations import Noise
from siq.estimation.linearisation import Grid
from siq.estimation.measurements import Measurements
from siq.estimation.noise import first_noise
from siq.estimation.process_noise import process_noise_needed
from siq.estimation.recalibration import FAINT
from siq.mismatch.places import lattice_step
from siq.mismatch.remainder import STRUCTURED, Remainder, what_is_left
from siq.mismatch.roles import Roles

ROUNDS = 30  # of fits at most
STILL = 0.01  # relative change of the noise, at which they have settled


@dataclass(frozen=True)
class Unrounded:
    """A simulation that explains recordings but for rounding.

    Attributes
    ----------
    fit
        Its parameters and states are those that the values which were rounded are fitted by; its errors are
        those of the fit to the readings, which rounding makes wider.
    left
        What is left of the values that were rounded, which is noise.
    outputs
        Names of the outputs that are rounded.
    """

    fit: Fit
    left: Remainder
    outputs: tuple[str, ...]


def explained_by_rounding(
    model: Dynamics,
    data: Measurements,
    strict: Fit,
    roles: Roles,
    *,
    least: float = STRUCTURED,
    budget: Budget | None = None,
) -> Unrounded | None:
    """The fit to the values that were rounded, if it leaves noise; None where it does not, or nothing rounds.

    Parameters
    ----------
    model, data
        The simulation as its author believes it, and the recordings.
    strict
        Its fit without process noise.
    roles
        Of the simulation's states.
    least
        Probability of structure by chance, below which it is no noise.
    budget
        Charged for every evaluation.
    """
    steps = steps_of(data)
    # What rounding does under noise half as wide as a step is white (Widrow and Kollár 2008), and fitted.
    coarse = steps > np.sqrt(strict.noise.measurement)
    if not (strict.converged and coarse.any()):
        return None
    deviation, fit = np.sqrt(strict.noise.measurement), strict
    values = data
    for _ in range(ROUNDS):
        before = deviation
        values, deviation = unrounded(data, simulated(fit, values), steps, before)
        fit = fit_by_multiple_shooting(
            fit.model, values, x=fit.x, noise=fit.noise, estimate_process=False, substeps=fit.substeps,
            budget=budget,
        )  # fmt: skip
        if not fit.converged:
            return None
        if (np.abs(deviation - before) < STILL * before).all():
            break
    faint = Noise(fit.noise.measurement, FAINT * first_noise(model, values, fit.x).process)
    forced = fit_by_multiple_shooting(
        fit.model, values, x=fit.x, noise=faint, estimate_process=True, substeps=fit.substeps, budget=budget
    )
    if forced.converged and process_noise_needed(forced, fit):
        return None
    try:
        left = what_is_left(model, values, fit, fit, roles)
    except NumericalFailure:
        return None
    if left.after.p_value < least:
        return None
    names = tuple(name for name, wide in zip(model.output_names, coarse, strict=True) if wide)
    return Unrounded(replace(strict, model=fit.model, x=fit.x), left, names)


def steps_of(data: Measurements) -> np.ndarray:
    """The step on whose multiples the values of each output lie, zero where there is none; shape ``(m,)``."""
    return np.array([lattice_step(column) or 0.0 for column in data.outputs.T])


def simulated(fit: Fit, data: Measurements) -> np.ndarray:
    """What a fit says of the outputs, shape ``(n, m)``."""
    model = fit.model
    signals = Grid(data, fit.substeps).at_samples(model.lags(model.values))
    return model.functions.outputs(np.ascontiguousarray(fit.x.T), signals, model.values).T


def unrounded(
    data: Measurements, simulation: np.ndarray, steps: np.ndarray, deviation: np.ndarray
) -> tuple[Measurements, np.ndarray]:
    """Recordings before they were rounded, as far as a simulation tells, and the deviation of their noise.

    Parameters
    ----------
    data
        What was recorded.
    simulation
        Outputs without noise, shape ``(n, m)``.
    steps
        Of each output, zero where nothing is rounded; shape ``(m,)``.
    deviation
        Of the noise of each output before rounding, shape ``(m,)``.

    Returns
    -------
    Measurements, numpy.ndarray
        With the expected values; and the deviation of what they are expected of, shape ``(m,)``.
    """
    outputs, wide = data.outputs.copy(), deviation.copy()
    for place in np.flatnonzero(steps > 0):
        off = (data.outputs[:, place] - simulation[:, place]) / deviation[place]
        half = steps[place] / 2 / deviation[place]
        known = np.isfinite(off)
        mean, variance = scipy.stats.truncnorm.stats(off[known] - half, off[known] + half, moments="mv")
        outputs[known, place] = simulation[known, place] + deviation[place] * mean
        wide[place] = deviation[place] * np.sqrt(np.mean(mean**2 + variance))
    return replace(data, outputs=outputs), wide
