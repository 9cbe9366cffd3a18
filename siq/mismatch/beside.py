"""Beside a remainder: is a mechanism likelier than a function, if another function models what it leaves?

A mechanism may be right although more is missing that no entry of the dictionary does. Two explanations are
then fitted in earnest, each with a function for the rest: the mechanism and a function on top of it, against
a function in its place and another on top of that. Neither is all of it, and the errors that both leave hang
together over time; they count as so many as are independent (`siq.mismatch.evidence`). How many these are is
known roughly, so that the odds may decide nothing. Parts of the recordings that are left out then tell which
of the two foresees. Where random forces still have to stand in for something, the rest has no model, and
nobody can say.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from siq.estimation.fit import Fit
from siq.estimation.measurements import Measurements
from siq.mismatch.building import MechanismCandidate
from siq.mismatch.evidence import correlation_time_left, log_evidence_of
from siq.mismatch.fitted_functions import with_a_function
from siq.mismatch.held_out_errors import change_between, in_blocks
from siq.mismatch.left_out import errors_left_out
from siq.mismatch.nameless_models import Material, Model, runs_freely
from siq.mismatch.tried import TriedMechanism, admissible

LOGGER = logging.getLogger(__name__)
RIVALS = 2  # functions in the place of the mechanism that get another on top of them: a choice


@dataclass(frozen=True)
class BesideARemainder:
    """How likely a mechanism is beside a function without a name, and what was fitted to know it.

    Attributes
    ----------
    log_odds
        Logarithm of the odds that it is the mechanism, rather than a function in its place.
    on_top
        Functions on top of the mechanism.
    instead
        Functions in its place, alone and with another on top.
    foresees
        Whether an explanation with the mechanism foresees parts left out better than every one without it, by
        more than appears by chance; asked only where the odds decide nothing.
    """

    log_odds: float
    on_top: tuple[Model, ...]
    instead: tuple[Model, ...]
    foresees: bool = False


def beside_a_remainder(
    trial: TriedMechanism,
    recalibrated: Fit,
    material: Material,
    *,
    considered: Sequence[MechanismCandidate],
    unnamed: float,
    least: float,
) -> BesideARemainder | None:
    """Hold a mechanism against functions in its place, whatever else is missing being a function for both.

    Parameters
    ----------
    trial
        The mechanism, fitted without anything beside it.
    recalibrated
        The simulation without it.
    material
        What functions are fitted to.
    considered
        The mechanisms that could have been named.
    unnamed
        Probability beforehand that what is missing has no name.
    least
        Logarithm of the odds that decide.

    Returns
    -------
    BesideARemainder or None
        None where random forces stand in for what it leaves, or it has states of its own.
    """
    if trial.fit.has_process_noise or trial.fit.model.dimension > recalibrated.model.dimension:
        return None
    data = material.data
    on_top = [
        each
        for each in with_a_function((), trial.fit, material)
        if not each.fit.has_process_noise
        and admissible(each.fit, trial.candidate)
        and runs_freely(each.fit, trial.fit, data)
    ]
    instead = with_a_function((), recalibrated, material)
    for one in instead[:RIVALS]:
        instead = instead + with_a_function(one.parts, one.fit, material)
    ours = [Model((), trial.fit), *on_top]
    theirs = [Model((), recalibrated), *instead]
    correlated = correlation_time_left([each.fit for each in (*ours, *theirs)], data)

    def best(models: Sequence[Model]) -> float:
        """The largest evidence; that something without a name is missing, too, has its own probability."""
        return max(
            log_evidence_of(each.fit, data, correlated=correlated)
            - each.cost
            + len(each.parts) * np.log(unnamed)
            for each in models
        )

    forms = Counter(each.name for each in considered)
    chosen = np.log(max(len(forms) * forms[trial.candidate.name], 1))
    named = best(ours) + np.log1p(-unnamed) - chosen
    log_odds = float(named - best(theirs))
    LOGGER.info(
        "%s beside a function: log-odds %.1f, errors correlated over %.1f samples",
        trial.candidate.label, log_odds, correlated,
    )  # fmt: skip
    foresees = False
    if abs(log_odds) < least:
        errors = [
            min(known, key=np.mean, default=None)
            for known in (
                _left_out(models, recalibrated, data, candidates=candidates)
                for models, candidates in ((theirs, ()), (ours, (trial.candidate,)))
            )
        ]
        blocks = [None if each is None else in_blocks(each) for each in errors]
        foresees = None not in blocks and change_between(*blocks) == "better"
        LOGGER.info("parts left out are foreseen better with it: %s", foresees)
    return BesideARemainder(log_odds, tuple(on_top), tuple(instead), foresees)


def _left_out(
    models: Sequence[Model],
    recalibrated: Fit,
    data: Measurements,
    *,
    candidates: Sequence[MechanismCandidate],
) -> list[np.ndarray]:
    """Squared errors on parts left out, of each model that does not run away there."""
    errors = (
        errors_left_out(each.fit, data, noise=recalibrated.noise, candidates=candidates) for each in models
    )
    return [each for each in errors if each is not None]
