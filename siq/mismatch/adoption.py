"""Adoption: which model of what has no name becomes a part of the new card?

The likeliest that foresees recordings better than they are foreseen without it. Recordings that had no part
in the fit decide; where all of those are tests of somebody else, parts of the others do, left out in turn
(`siq.mismatch.left_out`).
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence

import numpy as np

from siq.estimation.fit import Fit
from siq.estimation.innovations import Noise
from siq.estimation.measurements import Measurements
from siq.mismatch.building import MechanismCandidate
from siq.mismatch.held_out_errors import change_between, in_blocks
from siq.mismatch.left_out import errors_left_out
from siq.mismatch.nameless_models import Model
from siq.mismatch.runs_alike import RunsAlike, mean_error

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
        See `siq.estimation.free_runs.free_run`.
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
