"""The fit on recordings that had no part in it: before, recalibrated, augmented, and the noise floor."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from siq.dynamics.dynamics import Dynamics
from siq.estimation.fit import Fit
from siq.estimation.free_runs import FreeRun, squared_errors
from siq.estimation.measurements import Measurements
from siq.mismatch.adoption import adopted_by_held_out, adopted_by_left_out
from siq.mismatch.held_out_errors import HeldOutErrors
from siq.mismatch.investigation import Investigation
from siq.mismatch.nameless_models import Model
from siq.mismatch.possible_verdicts import MismatchVerdict
from siq.mismatch.runs_alike import RunsAlike


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


def held_out_runs(
    investigation: Investigation,
    learned: Measurements,
    data: Measurements,
    *,
    certain: float,
    tests: Collection[str] = (),
) -> HeldOutRuns:
    """Show the fit on recordings that had no part in anything.

    Of several models of what has no name one may be adopted (`siq.mismatch.adoption`): it makes the
    prediction better than that of the mechanisms with a name, where there are any, or else of the simulation.
    Where all recordings are tests of somebody else, parts of those to learn from are left out in turn, and
    decide.

    Parameters
    ----------
    investigation
        What was found.
    learned
        The recordings that it was found in; they decide which estimates run freely best.
    data
        The recordings held out.
    certain
        Logarithm of the odds from which on a model is certain where it was found.
    tests
        Labels of those that may choose nothing.
    """
    search = investigation.search
    noise, substeps = search.recalibrated.noise, max(search.fit.substeps, search.recalibrated.substeps)
    runs = RunsAlike(noise, substeps)

    def best_of(*fits: Fit | None) -> Fit:
        return runs.nearest([each for each in fits if each is not None], learned)

    card = replace(search.recalibrated, model=investigation.model)
    # What fits best with random forces admitted need not be what runs best without.
    recalibrated = search.recalibrated
    if recalibrated.has_process_noise and np.isfinite(investigation.least_squares.sum_of_squares):
        recalibrated = best_of(investigation.least_squares, recalibrated, card)
    plain = best_of(investigation.augmented_least_squares, search.fit)
    choices = [(model, best_of(model.fit, model.exact)) for model in investigation.models]
    named = investigation.verdict is MismatchVerdict.MISSING_PHYSICS
    judges = [place for place, label in enumerate(data.labels) if label not in tests]
    adopted = None
    if choices and judges:
        without = (plain,) if named else (card, recalibrated)
        adopted = adopted_by_held_out(choices, without, data.select(judges), runs=runs, certain=certain)
    elif choices:
        names = [each.best.candidate for each in search.found] if named else []
        alone = plain if named else search.recalibrated
        adopted = adopted_by_left_out(choices, alone, learned, noise=noise, named=names)
    described, fit = (None, plain) if named or not choices else choices[0]
    if adopted is not None:
        described, fit = choices[adopted]
    before, refitted, run = (runs.run(each, data) for each in (card, recalibrated, fit))
    squares = {
        "before": squared_errors(data.outputs, before),
        "recalibrated": squared_errors(data.outputs, refitted),
        "augmented": squared_errors(data.outputs, run),
        "named": runs.errors(plain, data) if named and adopted is not None else None,
    }
    floor = noise_floor_of((search.fit, fit), data, before.scored)
    return HeldOutRuns(
        before=before,
        recalibrated=refitted,
        augmented=run,
        model=fit.model,
        errors=HeldOutErrors.of(squares, noise_floor=floor),
        independent=not set(learned.labels) & set(data.labels),
        described=described,
        described_fit=fit if described is not None else None,
        adopted=adopted is not None,
    )


def noise_floor_of(fits: Sequence[Fit], data: Measurements, scored: np.ndarray) -> float:
    """The error that noise alone would leave, as a share of the recordings' spread.

    What a fit leaves may be more than noise; the one that leaves least is nearest to it.

    Parameters
    ----------
    fits
        Of several simulations, each with its estimate of the measurement noise.
    data
        The recordings held out.
    scored
        Rows that count, shape ``(n,)``.
    """
    spread = np.nanvar(data.outputs[scored], axis=0)
    least = np.minimum.reduce([each.noise.measurement for each in fits])
    return float(np.sqrt(np.mean(least / np.where(spread > 0, spread, 1.0))))
