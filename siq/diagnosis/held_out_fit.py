"""The fit on held-out recordings, and which model becomes part of the new card.

The likeliest that foresees recordings better than they are foreseen without it. Recordings that had no part
in the fit decide; where all of those are tests of somebody else, parts of the others do, left out in turn
(`siq.diagnosis.holdout`).
"""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from siq.diagnosis.holdout import (
    HeldOutErrors,
    RunsAlike,
    change_between,
    errors_left_out,
    in_blocks,
    mean_error,
)
from siq.diagnosis.investigation import Investigation
from siq.diagnosis.mechanisms import MechanismCandidate
from siq.diagnosis.options import MismatchVerdict
from siq.diagnosis.unnamed_models import Model
from siq.inference.kalman_filter import Noise
from siq.inference.maximum_likelihood import Fit
from siq.inference.measurements import Measurements
from siq.inference.trajectories import FreeRun, squared_errors
from siq.systems.dynamics import Dynamics

LOGGER = logging.getLogger(__name__)


def adopted_by_held_out(
    choices: Sequence[tuple[Model, Fit]],
    without: Sequence[Fit],
    data: Measurements,
    *,
    runs: RunsAlike,
    certain: float,
) -> int | None:
    """The place of the model that is adopted, judged by recordings held out; None where none helps.

    What is not certain where it was found has to be better by more than appears by chance, what is certain
    better than the simulation fitted alike; one of fewer coordinates that foresees no worse takes its place.

    Parameters
    ----------
    choices
        Models, the likeliest first, each with the estimates that are run.
    without
        The simulation without any of them: as it may be, and last as it was fitted to the same recordings.
    data
        The recordings held out that may choose.
    runs
        How all are run.
    certain
        Logarithm of the odds from which on a model is certain where it was found.
    """
    alone = [runs.errors(each, data) for each in without]
    known = [each for each in alone if each is not None]
    least = min(known, key=np.mean, default=None)
    errors = [runs.errors(fit, data) for _, fit in choices]
    # A card whose values are right foresees well, and tells nothing of a function whose fit had to find
    # them, too. Beside random forces a free run is off by these, and a little may be chance.
    fitted_alone, lowest = mean_error(alone[-1]), mean_error(least)
    limits = [
        0.0 if model.log_evidence < certain else lowest if model.fit.has_process_noise else fitted_alone
        for model, _ in choices
    ]
    likeliest = first_better(least, errors, limits)
    if likeliest is None:
        return None
    sizes = [mean_error(each) for each in errors]
    return simplest_of(sizes, [model.coordinates for model, _ in choices], likeliest)


def adopted_by_left_out(
    choices: Sequence[tuple[Model, Fit]],
    without: Fit,
    learned: Measurements,
    *,
    noise: Noise,
    named: Sequence[MechanismCandidate] = (),
) -> int | None:
    """The place of the model that foresees parts left out best, and better than without; None for none.

    Parameters
    ----------
    choices
        See `adopted_by_held_out`.
    without
        The simulation without any of them, fitted.
    learned
        The recordings that all of them were fitted to.
    noise
        See `siq.inference.trajectories.free_run`.
    named
        The mechanisms in all of them.
    """
    alone = errors_left_out(without, learned, noise=noise, candidates=named)
    errors = [
        errors_left_out(
            fit,
            learned,
            noise=noise,
            candidates=[*named, *(part.trial.candidate for part in model.parts)],
        )
        for model, fit in choices
    ]
    sizes = [mean_error(each) for each in errors]
    LOGGER.info("parts left out: mean squared errors %s with models of what has no name", sizes)
    best = int(np.argmin(sizes))
    return best if first_better(alone, [errors[best]], [0.0]) == 0 else None


def simplest_of(errors: Sequence[float], coordinates: Sequence[int], likeliest: int) -> int:
    """The place of the model of fewest coordinates that foresees no worse than the likeliest one.

    Errors of a sensor's clock, for one, grow with the motion, and look like functions of more than there is.

    Parameters
    ----------
    errors
        Of each model, on recordings held out.
    coordinates
        How many each depends on.
    likeliest
        The place of the one to begin with.
    """
    known = [place for place, error in enumerate(errors) if error <= errors[likeliest]]
    return min(known, key=lambda place: (coordinates[place], place != likeliest, place))


def first_better(
    without: np.ndarray | None, models: Iterable[np.ndarray | None], limits: Iterable[float]
) -> int | None:
    """The place of the first of several models that foresees better than without it; None where none does.

    Parameters
    ----------
    without
        Squared errors without any of the models, shape ``(values,)``; None where it ran away.
    models
        Those of each model, the likeliest first.
    limits
        Mean squared errors below which a model need only be no worse than without it, by more than appears
        by chance; zero for one that has to be better by more than that.
    """
    before = None if without is None else in_blocks(without)
    for place, (squares, limit) in enumerate(zip(models, limits, strict=True)):
        if squares is None:
            continue
        change = change_between(before, in_blocks(squares))
        if change == "better" or (change == "same" and squares.mean() < limit):
            return place
    return None


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

    Of several models of what has no name one may be adopted (`siq.diagnosis.held_out_fit`): it makes the
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
