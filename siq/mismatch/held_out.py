"""The fit on recordings that had no part in it: before, recalibrated, augmented, and the noise floor."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from siq.dynamics.dynamics import Dynamics
from siq.estimation.estimation import Fit
from siq.estimation.free_runs import FreeRun, free_run, normalised_rms
from siq.estimation.measurements import Measurements
from siq.mismatch.described import Model
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
    independent
        Whether the recordings are others than those that were learned from, rather than a later part.
    described
        The model of what has no name that was run; None where nothing was described.
    described_fit
        Its estimates that were run.
    """

    before: FreeRun
    recalibrated: FreeRun
    augmented: FreeRun
    model: Dynamics
    errors: HeldOutErrors
    independent: bool = True
    described: Model | None = None
    described_fit: Fit | None = None

    @property
    def gained(self) -> bool:
        """Whether the augmented simulation is better than the others."""
        known = [each for each in (self.errors.before, self.errors.recalibrated) if each is not None]
        return self.errors.change(min(known, default=None), self.errors.augmented) == "better"


def held_out_runs(investigation: Investigation, learned: Measurements, data: Measurements) -> HeldOutRuns:
    """Show the fit on recordings that had no part in anything.

    Of several models of what has no name the likeliest is shown that makes the prediction better; the first,
    where none does.

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
        refits = (investigation.least_squares.model, recalibrated, investigation.model)
        recalibrated = min(refits, key=error_where_learned)
    choices: list[tuple[Model | None, Fit]] = []
    for model in investigation.models:
        fits = [each for each in (model.fit, model.exact) if each is not None]
        choices.append((model, min(fits, key=lambda each: error_where_learned(each.model))))
    if not choices:
        fits = [each for each in (investigation.augmented_least_squares, search.fit) if each is not None]
        choices.append((None, min(fits, key=lambda each: error_where_learned(each.model))))
    before = free_run(investigation.model, data, noise=noise, substeps=substeps)
    refitted = free_run(recalibrated, data, noise=noise, substeps=substeps)
    spread = np.nanvar(data.outputs[before.scored], axis=0)
    floor = np.sqrt(np.mean(search.fit.noise.measurement / np.where(spread > 0, spread, 1.0)))
    shown: list[HeldOutRuns] = []
    for described, fit in choices:
        run = free_run(fit.model, data, noise=noise, substeps=max(substeps, fit.substeps))
        errors = HeldOutErrors(
            before=normalised_rms(data.outputs, before),
            recalibrated=normalised_rms(data.outputs, refitted),
            augmented=normalised_rms(data.outputs, run),
            noise_floor=float(floor),
            values=int(np.isfinite(data.outputs[before.scored]).sum()),
        )
        shown.append(
            HeldOutRuns(
                before=before,
                recalibrated=refitted,
                augmented=run,
                model=fit.model,
                errors=errors,
                independent=not set(learned.labels) & set(data.labels),
                described=described,
                described_fit=fit if described is not None else None,
            )
        )
        if shown[-1].gained:
            return shown[-1]
    return shown[0]
