"""Names: which mechanisms of a search are named, and what models the rest?

A name stands if it is convincing and likelier than a function without one (`siq.mismatch.naming`). Where
mechanisms leave something and are not convincing as a whole, the first may still be likelier than a function
in its place, beside a function for the rest (`siq.mismatch.beside`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from siq.dynamics.dynamics import Dynamics
from siq.estimation.fit import Fit
from siq.estimation.process_noise import fit_with_and_without_process_noise
from siq.mismatch.beside import BesideARemainder, beside_a_remainder
from siq.mismatch.building import MechanismCandidate
from siq.mismatch.described import models_beside_names, models_of_the_nameless
from siq.mismatch.found import Search
from siq.mismatch.nameless_models import Material, Model
from siq.mismatch.naming import Naming, log_odds_of_the_first, naming_of
from siq.mismatch.remainder import Remainder
from siq.mismatch.search_options import SearchOptions
from siq.numerics.share_text import p_equation, percent

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
