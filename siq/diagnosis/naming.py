"""Naming: which mechanisms may be named, and what models the rest.

A mechanism may be right although more is missing that no entry of the dictionary does. Two explanations are
then fitted in earnest, each with a function for the rest: the mechanism and a function on top of it, against
a function in its place and another on top of that. Neither is all of it, and the errors that both leave hang
together over time; they count as so many as are independent (`siq.diagnosis.evidence`). How many these are is
known roughly, so that the odds may decide nothing. Parts of the recordings that are left out then tell which
of the two foresees. Where random forces still have to stand in for something, the rest has no model, and
nobody can say.

A name has to be likelier than a function without one, by the odds that keep wrong names as rare as is asked
for (`siq.diagnosis.evidence`). Where it leaves something, it also has to explain more than mechanisms
explain of effects that have no name (`siq.diagnosis.evidence`).

A name stands if it is convincing and likelier than a function without one (`siq.diagnosis.naming`). Where
mechanisms leave something and are not convincing as a whole, the first may still be likelier than a function
in its place, beside a function for the rest (`siq.diagnosis.naming`).
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.special

from siq.diagnosis.dictionary import Roles
from siq.diagnosis.evidence import (
    correlation_time_left,
    log_evidence_of,
    log_odds_of_a_name,
    probability_of_a_match,
)
from siq.diagnosis.hidden_state_terms import models_beside_names, models_of_the_nameless
from siq.diagnosis.holdout import change_between, errors_left_out, in_blocks
from siq.diagnosis.mechanisms import MechanismCandidate
from siq.diagnosis.options import SearchOptions
from siq.diagnosis.residual_structure import Remainder
from siq.diagnosis.screening import probes_of
from siq.diagnosis.search import Search
from siq.diagnosis.significance import UNFORESEEN, TriedMechanism, admissible
from siq.diagnosis.unnamed_models import Material, Model, runs_freely, with_a_function
from siq.inference.maximum_likelihood import Fit
from siq.inference.measurements import Measurements
from siq.inference.recalibration import fit_with_and_without_process_noise
from siq.numerics.text import p_equation, percent
from siq.systems.dynamics import Dynamics

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


@dataclass(frozen=True)
class Naming:
    """Whether mechanisms that were found may be named.

    Attributes
    ----------
    search
        With those that are not mere patches of others.
    left
        What they leave.
    log_odds
        For each, that it is the mechanism rather than a function without a name, as a logarithm.
    together
        The same of all of them against one such function.
    p_alike
        Probability that as many mechanisms explain as much of an effect that has no name; None where nothing
        is left, so that nobody asked.
    convincing
        Whether they explain enough.
    likely
        Whether the odds are for them.
    """

    search: Search
    left: Remainder
    log_odds: tuple[float, ...]
    together: float
    p_alike: float | None
    convincing: bool
    likely: bool


def naming_of(
    search: Search,
    left: Sequence[Remainder],
    data: Measurements,
    model: Dynamics,
    roles: Roles,
    candidates: Sequence[MechanismCandidate],
    *,
    options: SearchOptions,
    generator: np.random.Generator,
) -> Naming:
    """Judge the mechanisms of a search.

    Parameters
    ----------
    search
        That found at least one.
    left
        What is left with the first, the first two, and so on.
    data, model, roles, candidates
        The recordings, the simulation as its author believes it, and what could be named.
    options
        Of the search.
    generator
        Draws effects without a name.
    """
    jury = _Jury(search, data, model, roles, candidates, options, generator)
    if len(search.found) > 1 and jury.convincing(1, left[0])[0]:
        search, kept = jury.without_patches(left)
        left = left[: len(kept)]
    convincing, p_alike = jury.convincing(len(search.found), left[-1])
    odds = tuple(jury.log_odds(len(search.found), [place]) for place in range(len(search.found)))
    together = odds[0] if len(odds) == 1 else jury.log_odds(len(odds), list(range(len(odds))))
    likely = min(*odds, together) >= options.least_log_odds
    return Naming(search, left[-1], odds, together, p_alike, convincing, likely)


def log_odds_of_the_first(
    search: Search,
    data: Measurements,
    model: Dynamics,
    roles: Roles,
    candidates: Sequence[MechanismCandidate],
    *,
    options: SearchOptions,
) -> float:
    """Logarithm of the odds that the first mechanism is one rather than a function, in the fit with it alone.

    Parameters
    ----------
    search, data, model, roles, candidates, options
        See `naming_of`.
    """
    return _Jury(search, data, model, roles, candidates, options, np.random.default_rng(0)).log_odds(1, [0])


@dataclass(frozen=True)
class _Jury:
    """What is asked of mechanisms several times; the attributes are the parameters of `naming_of`."""

    search: Search
    data: Measurements
    model: Dynamics
    roles: Roles
    candidates: Sequence[MechanismCandidate]
    options: SearchOptions
    generator: np.random.Generator

    def log_odds(self, number: int, chosen: Sequence[int]) -> float:
        """Of some mechanisms, in the fit with the first so many."""
        found = [each.best for each in self.search.found]
        try:
            odds = log_odds_of_a_name(
                found[number - 1].fit,
                self.data,
                [found[place].candidate for place in chosen],
                self.roles,
                self.model,
                considered=self.candidates,
                unnamed=self.options.unnamed,
            )
        except UNFORESEEN as error:
            LOGGER.info("the odds of a name are not known: %s", error)
            return -np.inf
        if len(chosen) == 1:  # what cannot be told apart is named as a class
            one = self.search.found[chosen[0]]
            same = [one.best.delta_bic, *(each.delta_bic for each in one.indistinguishable)]
            odds += float(scipy.special.logsumexp(-0.5 * (np.array(same) - one.best.delta_bic)))
        LOGGER.info("%s: log-odds of the name %.1f", [found[k].candidate.label for k in chosen], odds)
        return odds

    def convincing(self, number: int, left: Remainder) -> tuple[bool, float | None]:
        """Whether the first so many mechanisms leave nothing, or explain more than by chance."""
        if not (left.doubtful or self.search.found[number - 1].best.fit.has_process_noise):
            return True, None
        recalibrated = self.search.recalibrated
        probes = [
            probe
            for each in self.candidates
            for probe in probes_of(each, self.data, self.model, recalibrated.x)
        ]
        try:
            p_alike = probability_of_a_match(
                recalibrated,
                self.data,
                probes,
                self.roles,
                share=left.share,
                mechanisms=number,
                measurement=self.search.fit.noise.measurement,
                generator=self.generator,
            )
        except UNFORESEEN as error:
            LOGGER.info("matches by chance are not known: %s", error)
            return False, None
        LOGGER.info("%d mechanisms explain %.4f; by chance: p %.3f", number, left.share, p_alike)
        return p_alike <= self.options.most_alike, p_alike

    def without_patches(self, left: Sequence[Remainder]) -> tuple[Search, list[Remainder]]:
        """The first mechanism, and those after it as long as each is likely and leaves less of the excess."""
        search, kept = self.search, 1
        while (
            kept < len(left)
            and left[kept].share > left[kept - 1].share
            and self.log_odds(kept + 1, [kept]) >= self.options.least_log_odds
        ):
            kept += 1
        found = search.found[:kept]
        return replace(search, found=found, fit=found[-1].best.fit), list(left[:kept])


NAMELESS = "It has no name."
EXACT = (
    "The estimates allow for random forces that stand for what remains. The new card has the estimates of"
    " least squares instead, where it runs better with them."
)


@dataclass(frozen=True)
class Names:
    """What is named of a search that found something.

    Attributes
    ----------
    given
        Whether a name is given.
    naming
        What was asked, with the mechanisms that are named, or that describe what has no name.
    models
        Of what has no name: of what names leave, or of all of it.
    exact
        The fit with names whose trajectories follow the equations, where random forces are part of the other.
    remarks
        Sentences about reservations.
    """

    given: bool
    naming: Naming
    models: tuple[Model, ...]
    exact: Fit | None
    remarks: tuple[str, ...]


def names_of(
    whole: Search,
    left: Sequence[Remainder],
    model: Dynamics,
    material: Material,
    candidates: Sequence[MechanismCandidate],
    *,
    options: SearchOptions,
    generator: np.random.Generator,
) -> Names:
    """Judge a search that found something.

    Parameters
    ----------
    whole
        The search.
    left
        What is left with the first mechanism, the first two, and so on.
    model, material, candidates
        The simulation as its author believes it, what models are made from, and what could be named.
    options
        Of the search.
    generator
        Draws effects without a name.
    """
    data, roles = material.data, material.roles
    naming = naming_of(whole, left, data, model, roles, candidates, options=options, generator=generator)
    given, remarks = named_or_not(naming, options)
    beside: BesideARemainder | None = None
    # Only few functions are fitted; along the trajectories of a fit all are compared. Where these speak
    # against the name as clearly as something would have to speak for it, the few prove nothing.
    if not naming.convincing and (
        log_odds_of_the_first(whole, data, model, roles, candidates, options=options)
        > -options.least_log_odds
    ):
        beside = beside_a_remainder(
            whole.found[0].best, whole.recalibrated, material,
            considered=candidates, unnamed=options.unnamed, least=options.least_log_odds,
        )  # fmt: skip
    if beside is not None and (beside.log_odds >= options.least_log_odds or beside.foresees):
        naming = named_beside_a_remainder(naming, whole, left[0], beside)
        given, remarks = True, (f"{remains(naming.left)} {NAMELESS}",)
    named = naming.search
    if not given:
        instead = None if beside is None else beside.instead
        models = models_of_the_nameless(named, material, functions=instead)
        return Names(False, naming, models, None, remarks)
    models, exact = (), None
    if len(whole.found) > len(named.found) or naming.left.doubtful or named.fit.has_process_noise:
        on_top = None if beside is None else beside.on_top
        models = models_beside_names(named, whole, material, functions=on_top)
    if named.fit.has_process_noise:
        still = replace(named.fit, noise=named.fit.noise.without_process())
        with material.budget.exempt():
            followed = fit_with_and_without_process_noise(
                named.fit.model, data, still, budget=material.budget
            )[1]
        if followed.converged:
            exact, remarks = followed, (*remarks, EXACT)
    return Names(True, naming, models, exact, remarks)


def named_or_not(naming: Naming, options: SearchOptions) -> tuple[bool, tuple[str, ...]]:
    """Whether mechanisms that were found are named, and with which reservations."""
    if not naming.convincing:
        return False, ()
    remarks = tuple(filter(None, [remains(naming.left)])) if naming.p_alike is not None else ()
    if naming.likely:
        return True, remarks
    names = " and ".join(each.best.candidate.name for each in naming.search.found)
    least = min(*naming.log_odds, naming.together)
    return False, (
        *remarks,
        f"It looks like {names}, but a function without a name is {_as_likely(least)}; a name takes odds of"
        f" {np.exp(options.least_log_odds):.0f} to 1.",
    )


def named_beside_a_remainder(
    naming: Naming, whole: Search, left: Remainder, beside: BesideARemainder
) -> Naming:
    """The first mechanism of a search, named although what it leaves has no name."""
    first = replace(whole, found=whole.found[:1], fit=whole.found[0].best.fit)
    return replace(
        naming, search=first, left=left, log_odds=(beside.log_odds,), together=beside.log_odds,
        convincing=True, likely=True,
    )  # fmt: skip


def _as_likely(log_odds: float) -> str:
    """How likely a function without a name is, beside a mechanism."""
    if log_odds < 0:
        return "likelier"
    return f"nearly as likely (odds of {np.exp(log_odds):.0f} to 1)"


def remains(left: Remainder) -> str:
    """How much of the excess over noise is left by what was found, and whether it looks like noise."""
    size = percent(1 - left.share)
    if not left.doubtful:
        return "" if size == "none" else f"What was found leaves {size} of the difference."
    chance = f"({p_equation(left.after.p_value)})"
    if size == "none":
        return f"What is left is as small as noise, but does not look like it {chance}."
    return f"What was found leaves {size} of the difference, and this rest does not look like noise {chance}."
