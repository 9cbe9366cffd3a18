"""The fit on recordings that had no part in it: before, recalibrated, augmented, and the noise floor."""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from siq.dynamics.dynamics import Dynamics
from siq.estimation.estimation import Fit
from siq.estimation.free_runs import FreeRun, UsualStates, free_run, squared_errors
from siq.estimation.measurements import Measurements
from siq.mismatch.held_out_errors import HeldOutErrors, change_between, in_blocks
from siq.mismatch.investigation import Investigation, MismatchVerdict
from siq.mismatch.left_out import errors_left_out
from siq.mismatch.nameless_models import Model

LOGGER = logging.getLogger(__name__)


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

    Of several models of what has no name the likeliest is adopted that makes the prediction better than it is
    without: than that of the mechanisms with a name, where there are any, or else of the simulation. What is
    not certain where it was found has to be better by more than appears by chance, what is certain better
    than the simulation fitted alike; one of fewer coordinates that foresees no worse takes its place. Where
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
    certain
        Logarithm of the odds from which on a model is certain where it was found.
    tests
        Labels of those that may choose nothing.
    """
    search = investigation.search
    noise, substeps = search.recalibrated.noise, max(search.fit.substeps, search.recalibrated.substeps)

    def run_of(fit: Fit, where: Measurements) -> FreeRun:
        finer = max(substeps, fit.substeps)
        return free_run(fit.model, where, noise=noise, substeps=finer, usual=UsualStates.along(fit.x))

    def errors_of(fit: Fit, where: Measurements) -> np.ndarray | None:
        return squared_errors(where.outputs, run_of(fit, where))

    def error_where_learned(fit: Fit) -> float:
        errors = errors_of(fit, learned)
        return np.inf if errors is None else float(errors.mean())

    def best_of(*fits: Fit | None) -> Fit:
        known = [each for each in fits if each is not None]
        return known[0] if len(known) == 1 else min(known, key=error_where_learned)

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
        some = data.select(judges)
        without = [errors_of(each, some) for each in ((plain,) if named else (card, recalibrated))]
        known = [each for each in without if each is not None]
        least = min(known, key=np.mean, default=None)
        errors = [errors_of(fit, some) for _, fit in choices]
        # A card whose values are right foresees well, and tells nothing of a function whose fit had to find
        # them, too. Beside random forces a free run is off by these, and a little may be chance.
        fitted_alone = np.inf if without[-1] is None else float(without[-1].mean())
        lowest = np.inf if least is None else float(least.mean())
        limits = [
            0.0 if model.log_evidence < certain else lowest if model.fit.has_process_noise else fitted_alone
            for model, _ in choices
        ]
        adopted = first_better(least, errors, limits)
        if adopted is not None:
            sizes = [np.inf if each is None else float(each.mean()) for each in errors]
            adopted = simplest_of(sizes, [model.coordinates for model, _ in choices], adopted)
    elif choices:
        names = [each.best.candidate for each in search.found] if named else []
        alone = errors_left_out(
            plain if named else search.recalibrated, learned, noise=noise, candidates=names
        )
        left_out = [
            errors_left_out(
                fit,
                learned,
                noise=noise,
                candidates=[*names, *(part.trial.candidate for part in model.parts)],
            )
            for model, fit in choices
        ]
        sizes = [np.inf if each is None else float(each.mean()) for each in left_out]
        LOGGER.info("parts left out: mean squared errors %s with models of what has no name", sizes)
        best = int(np.argmin(sizes))
        adopted = best if first_better(alone, [left_out[best]], [0.0]) == 0 else None
    described, fit = (None, plain) if named or not choices else choices[0]
    if adopted is not None:
        described, fit = choices[adopted]
    before, refitted, run = (run_of(each, data) for each in (card, recalibrated, fit))
    spread = np.nanvar(data.outputs[before.scored], axis=0)
    # What a fit leaves may be more than noise; the one that leaves less is nearer to it.
    least = np.minimum(search.fit.noise.measurement, fit.noise.measurement)
    floor = np.sqrt(np.mean(least / np.where(spread > 0, spread, 1.0)))
    runs = {
        "before": squared_errors(data.outputs, before),
        "recalibrated": squared_errors(data.outputs, refitted),
        "augmented": squared_errors(data.outputs, run),
        "named": errors_of(plain, data) if named and adopted is not None else None,
    }
    return HeldOutRuns(
        before=before,
        recalibrated=refitted,
        augmented=run,
        model=fit.model,
        errors=HeldOutErrors.of(runs, noise_floor=float(floor)),
        independent=not set(learned.labels) & set(data.labels),
        described=described,
        described_fit=fit if described is not None else None,
        adopted=adopted is not None,
    )


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
