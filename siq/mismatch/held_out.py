"""The fit on recordings that had no part in it: before, recalibrated, augmented, and the noise floor."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from siq.dynamics.dynamics import Dynamics
from siq.estimation.free_runs import FreeRun, free_run, normalised_rms
from siq.estimation.measurements import Measurements
from siq.mismatch.investigation import Investigation

Change = Literal["better", "same", "worse", "unknown"]
WIDE = 1.96  # standard errors within which 95 % lie


@dataclass(frozen=True)
class HeldOutErrors:
    """Normalised errors on held-out recordings; None where a simulation ran away.

    Attributes
    ----------
    before, recalibrated, augmented
        Of the simulation as it is, with its parameters refitted, and with what was found.
    noise_floor
        What measurement noise alone amounts to.
    values
        Number of measured values that the errors are means over; 0 where it is not known.
    """

    before: float | None
    recalibrated: float | None
    augmented: float | None
    noise_floor: float | None
    values: int = 0

    @property
    def tolerance(self) -> float:
        """Relative difference of two errors that so many values show by chance in one case out of twenty.

        The root mean square of n independent values has the relative standard error 1/√(2n).
        """
        return WIDE / float(np.sqrt(2 * self.values)) if self.values else 0.0

    def change(self, first: float | None, second: float | None) -> Change:
        """Whether one error is better than another, by more than the number of values lets appear by chance.

        Parameters
        ----------
        first, second
            Without and with what is judged; None where the simulation ran away.
        """
        if first is None and second is None:
            return "unknown"
        if first is None or second is None:
            return "better" if first is None else "worse"
        if second < first * (1 - self.tolerance):
            return "better"
        return "worse" if second * (1 - self.tolerance) > first else "same"

    def at_noise(self, error: float | None) -> bool:
        """Whether an error is that of measurement noise alone."""
        if error is None or self.noise_floor is None:
            return False
        return error * (1 - self.tolerance) <= self.noise_floor


@dataclass(frozen=True)
class HeldOutRuns:
    """Free runs of held-out recordings by the three simulations, and how far each is off.

    Attributes
    ----------
    before, recalibrated, augmented
        The simulation as it is, with its parameters refitted, and with what was found.
    model
        The augmented simulation that was run.
    errors
        Of the three.
    """

    before: FreeRun
    recalibrated: FreeRun
    augmented: FreeRun
    model: Dynamics
    errors: HeldOutErrors


def held_out_runs(investigation: Investigation, learned: Measurements, data: Measurements) -> HeldOutRuns:
    """Show the fit on recordings that had no part in anything.

    Parameters
    ----------
    investigation
        What was found.
    learned
        The recordings that it was found in; they decide which estimates run freely best.
    data
        The recordings held out.
    """
    search = investigation.search
    noise, substeps = search.recalibrated.noise, max(search.fit.substeps, search.recalibrated.substeps)

    def error_where_learned(model: Dynamics) -> float:
        error = normalised_rms(learned.outputs, free_run(model, learned, noise=noise, substeps=substeps))
        return np.inf if error is None else error

    # What fits best with random forces admitted need not be what runs best without.
    recalibrated = search.recalibrated.model
    if search.recalibrated.has_process_noise and np.isfinite(investigation.least_squares.sum_of_squares):
        choices = (investigation.least_squares.model, recalibrated, investigation.model)
        recalibrated = min(choices, key=error_where_learned)
    augmented = search.fit.model
    if investigation.augmented_least_squares is not None:
        augmented = min((investigation.augmented_least_squares.model, augmented), key=error_where_learned)
    models = {"before": investigation.model, "recalibrated": recalibrated, "augmented": augmented}
    runs = {name: free_run(model, data, noise=noise, substeps=substeps) for name, model in models.items()}
    scores = {name: normalised_rms(data.outputs, simulated) for name, simulated in runs.items()}
    scored = runs["before"].scored
    spread = np.nanvar(data.outputs[scored], axis=0)
    floor = np.sqrt(np.mean(search.fit.noise.measurement / np.where(spread > 0, spread, 1.0)))
    values = int(np.isfinite(data.outputs[scored]).sum())
    errors = HeldOutErrors(**scores, noise_floor=float(floor), values=values)
    return HeldOutRuns(**runs, model=augmented, errors=errors)
