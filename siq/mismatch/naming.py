"""Naming: which of the mechanisms that were found may be named.

A name has to be likelier than a function without one, by the odds that keep wrong names as rare as is asked
for (`siq.mismatch.evidence`). Where it leaves something, it also has to explain more than mechanisms
explain of effects that have no name (`siq.mismatch.matches`).
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.special

from siq.dynamics.dynamics import Dynamics
from siq.estimation.measurements import Measurements
from siq.mismatch.building import MechanismCandidate
from siq.mismatch.evidence import log_odds_of_a_name
from siq.mismatch.found import Search
from siq.mismatch.matches import probability_of_a_match
from siq.mismatch.probes import probes_of
from siq.mismatch.remainder import Remainder
from siq.mismatch.roles import Roles
from siq.mismatch.search_options import SearchOptions
from siq.mismatch.tried import UNFORESEEN

LOGGER = logging.getLogger(__name__)


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
