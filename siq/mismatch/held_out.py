"""The fit on recordings that had no part in it: before, recalibrated, augmented, and the noise floor."""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from siq.dynamics.dynamics import Dynamics
from siq.estimation.estimation import Fit
from siq.estimation.free_runs import FreeRun, free_run, normalised_rms, told_rows
from siq.estimation.measurements import Measurements
from siq.mismatch.investigation import Investigation, MismatchVerdict
from siq.mismatch.left_out import error_left_out
from siq.mismatch.nameless_models import Model

LOGGER = logging.getLogger(__name__)
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
    named
        With what has a name only, where something without a name describes the rest.
    """

    before: float | None
    recalibrated: float | None
    augmented: float | None
    noise_floor: float | None
    values: int = 0
    named: float | None = None

    @property
    def without(self) -> float | None:
        """The better one of the simulation as it is and with its parameters refitted."""
        return min((each for each in (self.before, self.recalibrated) if each is not None), default=None)

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
    adopted
        Whether that model is part of the new card, since it makes predictions better.
    """

    before: FreeRun
    recalibrated: FreeRun
    augmented: FreeRun
    model: Dynamics
    errors: HeldOutErrors
    independent: bool = True
    described: Model | None = None
    described_fit: Fit | None = None

    adopted: bool = False

    @property
    def gained(self) -> bool:
        """Whether the augmented simulation is better than the others."""
        return self.errors.change(self.errors.without, self.errors.augmented) == "better"


def held_out_runs(
    investigation: Investigation,
    learned: Measurements,
    data: Measurements,
    *,
    tests: Collection[str] = (),
) -> HeldOutRuns:
    """Show the fit on recordings that had no part in anything.

    Of several models of what has no name the likeliest is adopted that makes the prediction better than it is
    without: than that of the mechanisms with a name, where there are any, or else of the simulation. Where
    all recordings are tests of somebody else, each part of those to learn from is left out in turn, and the
    model is adopted that foresees them best (`siq.mismatch.left_out`).

    Parameters
    ----------
    investigation
        What was found.
    learned
        The recordings that it was found in; they decide which estimates run freely best.
    data
        The recordings held out.
    tests
        Labels of those that may choose nothing.
    """
    search = investigation.search
    noise, substeps = search.recalibrated.noise, max(search.fit.substeps, search.recalibrated.substeps)

    def error_of(model: Dynamics, where: Measurements, finer: int = 0) -> float | None:
        run = free_run(model, where, noise=noise, substeps=max(substeps, finer))
        return normalised_rms(where.outputs, run)

    def error_where_learned(model: Dynamics) -> float:
        error = error_of(model, learned)
        return np.inf if error is None else error

    def best_of(*fits: Fit | None) -> Fit:
        known = [each for each in fits if each is not None]
        if len(known) == 1:
            return known[0]
        return min(known, key=lambda each: error_where_learned(each.model))

    # What fits best with random forces admitted need not be what runs best without.
    recalibrated = search.recalibrated.model
    if search.recalibrated.has_process_noise and np.isfinite(investigation.least_squares.sum_of_squares):
        refits = (investigation.least_squares.model, recalibrated, investigation.model)
        recalibrated = min(refits, key=error_where_learned)
    plain = best_of(investigation.augmented_least_squares, search.fit)
    choices = [(model, best_of(model.fit, model.exact)) for model in investigation.models]
    named = investigation.verdict is MismatchVerdict.MISSING_PHYSICS
    judges = [place for place, label in enumerate(data.labels) if label not in tests]
    adopted = None
    if choices and judges:
        some = data.select(judges)
        without = [error_of(plain.model, some, plain.substeps)]
        if not named:
            without = [error_of(investigation.model, some), error_of(recalibrated, some)]
        errors = ((error_of(fit.model, some, fit.substeps), _scored(some)) for _, fit in choices)
        adopted = first_better(_least(without), errors)
    elif choices:
        base = plain if named else search.recalibrated
        alone, _ = error_left_out(base, learned, noise=noise)
        left_out = [error_left_out(fit, learned, noise=noise) for _, fit in choices]
        LOGGER.info("parts left out: %s without, %s with models of what has no name", alone, left_out)
        known = [place for place, (error, _) in enumerate(left_out) if error is not None]
        for best in sorted(known, key=lambda place: left_out[place][0] or 0.0)[:1]:
            adopted = best if first_better(alone, [left_out[best]]) == 0 else None
    described, fit = (None, plain) if named or not choices else choices[0]
    if adopted is not None:
        described, fit = choices[adopted]
    before, refitted = (
        free_run(each, data, noise=noise, substeps=substeps) for each in (investigation.model, recalibrated)
    )
    run = free_run(fit.model, data, noise=noise, substeps=max(substeps, fit.substeps))
    spread = np.nanvar(data.outputs[before.scored], axis=0)
    # What a fit leaves may be more than noise; the one that leaves less is nearer to it.
    least = np.minimum(search.fit.noise.measurement, fit.noise.measurement)
    floor = np.sqrt(np.mean(least / np.where(spread > 0, spread, 1.0)))
    return HeldOutRuns(
        before=before,
        recalibrated=refitted,
        augmented=run,
        model=fit.model,
        errors=HeldOutErrors(
            before=normalised_rms(data.outputs, before),
            recalibrated=normalised_rms(data.outputs, refitted),
            augmented=normalised_rms(data.outputs, run),
            noise_floor=float(floor),
            values=int(np.isfinite(data.outputs[before.scored]).sum()),
            named=error_of(plain.model, data, plain.substeps) if named and adopted is not None else None,
        ),
        independent=not set(learned.labels) & set(data.labels),
        described=described,
        described_fit=fit if described is not None else None,
        adopted=adopted is not None,
    )


def first_better(without: float | None, errors: Iterable[tuple[float | None, int]]) -> int | None:
    """The place of the first of several errors that is better than one; None where none is.

    Parameters
    ----------
    without
        The error without any of the models; None where it ran away.
    errors
        Of each model, the likeliest first, with the number of values that each is a mean over.
    """
    for place, (error, values) in enumerate(errors):
        if HeldOutErrors(None, None, None, None, values).change(without, error) == "better":
            return place
    return None


def _least(errors: Sequence[float | None]) -> float | None:
    return min((each for each in errors if each is not None), default=None)


def _scored(data: Measurements) -> int:
    """How many values of free runs of recordings are scored."""
    within = np.arange(len(data.t)) - data.first[data.recording]
    return int(np.isfinite(data.outputs[within >= told_rows(data)[data.recording]]).sum())
