"""Investigation: what a simulation lacks, from its recalibration to the verdict."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
import scipy.stats

from siq.dynamics.dynamics import Dynamics
from siq.errors import NumericalFailure
from siq.estimation.budget import UNLIMITED, Account, Budget
from siq.estimation.estimation import Fit
from siq.estimation.measurements import Measurements
from siq.estimation.process_noise import fit_with_and_without_process_noise
from siq.estimation.recalibration import recalibrate
from siq.estimation.unknown_forces import covariance_with_unknown_forces
from siq.mismatch.beside import BesideARemainder, beside_a_remainder
from siq.mismatch.candidates import MechanismCandidate, candidates_of, generic_candidates
from siq.mismatch.described import Model, models_beside_names, models_of_the_nameless
from siq.mismatch.dictionary import Mechanism
from siq.mismatch.naming import Naming, naming_of
from siq.mismatch.remainder import Remainder, what_is_left
from siq.mismatch.roles import Roles, roles_of
from siq.mismatch.search import Search, search
from siq.mismatch.search_options import SearchOptions
from siq.mismatch.steadiness import unsteadiness
from siq.mismatch.structure import Structure
from siq.mismatch.study import MismatchStudy
from siq.mismatch.trials import UntriedMechanism
from siq.numerics.share_text import p_equation, percent


class MismatchVerdict(StrEnum):
    """What a diagnosis ends with, as files have it."""

    NO_MISMATCH = "no mismatch"
    PARAMETER_SHIFT = "parameter shift"
    MISSING_PHYSICS = "missing physics"
    UNEXPLAINED = "unexplained"

    @property
    def mismatch(self) -> bool:
        """Whether the equations differ from the system, whatever their parameters."""
        return self in (MismatchVerdict.MISSING_PHYSICS, MismatchVerdict.UNEXPLAINED)


GROWING = "Random forces would explain it only if they grew with the motion; a hidden state is more likely."
NAMELESS = "It has no name."
EXACT = (
    "The estimates allow for random forces that stand for what remains. The new card has the estimates of"
    " least squares instead, where it runs better with them."
)


@dataclass(frozen=True)
class Investigation:
    """What was found out about a simulation and recordings of the system, with all fits that it rests on.

    Attributes
    ----------
    verdict
        One of four.
    model
        The simulation as its author believes it.
    roles
        Of its states.
    search
        Recalibration, mechanisms found, and the final fit.
    least_squares
        The recalibration whose trajectories follow the equations exactly.
    augmented_least_squares
        The same of the final simulation, where a remainder that is no noise was admitted as random forces.
    before
        Structure of what the recalibrated simulation does not explain, random forces included.
    after
        Structure that the final fit leaves.
    process_noise
        Whether random forces are part of the verdict.
    p_shift
        p-value of the test that the parameters of the card are the true ones.
    share
        Of the excess that the mechanisms explain.
    remarks
        Sentences about reservations.
    candidates
        All mechanisms that were considered.
    naming
        What was asked of mechanisms before they could be named; None where none was found.
    models
        Of what has no name, be it all that is missing or what names leave, the likeliest first.
    account
        The work that it took, and whether something was left undone.
    """

    verdict: MismatchVerdict
    model: Dynamics
    roles: Roles
    search: Search
    least_squares: Fit
    augmented_least_squares: Fit | None
    before: Structure
    after: Structure
    process_noise: bool
    p_shift: float
    share: float
    remarks: tuple[str, ...]
    candidates: tuple[MechanismCandidate, ...]
    naming: Naming | None = None
    models: tuple[Model, ...] = ()
    account: Account = UNLIMITED

    @property
    def too_faint(self) -> bool:
        """Whether what was found explains enough, and is not named since a function is nearly as likely."""
        return (
            self.verdict is MismatchVerdict.UNEXPLAINED and self.naming is not None and self.naming.convincing
        )

    @property
    def final(self) -> Fit:
        """The fit that the verdict stands on: with mechanisms only where they are physics."""
        return (
            self.search.fit if self.verdict is MismatchVerdict.MISSING_PHYSICS else self.search.recalibrated
        )


def investigate(
    model: Dynamics,
    data: Measurements,
    dictionary: Sequence[Mechanism],
    study: MismatchStudy,
    *,
    file: str = "the dictionary",
    seed: int = 0,
    budget: Budget | None = None,
) -> Investigation:
    """Say whether, where and in which way a simulation differs from recordings.

    Parameters
    ----------
    model
        The simulation, as its card says.
    data
        The recordings to learn from; those held out stay out.
    dictionary
        The mechanisms that may be named.
    study
        What counts as found, and whether monomials do.
    file
        Where the dictionary's entries come from, for messages.
    seed
        Of the effects without a name that mechanisms are held against.
    budget
        Charged for the work; what it does not reach is left undone, and the answer is that of the rest.

    Raises
    ------
    NumericalFailure
        When not even the recalibrated simulation with process noise can be fitted.
    """
    options = study.search
    roles = roles_of(model)
    candidates = considered(model, roles, dictionary, study, file=file)
    budget = budget or Budget()
    budget.says("fitting the simulation's own parameters")
    with budget.exempt():
        recalibrated, least_squares = recalibrate(model, data, budget=budget)
    found = search(model, data, recalibrated, candidates, options=options, budget=budget)
    found, by_each = remainders(model, data, found, roles)
    left = by_each[-1]
    p_shift = shift_probability(model, recalibrated)
    exact: Fit | None = None
    naming: Naming | None = None
    models: tuple[Model, ...] = ()
    beside: BesideARemainder | None = None
    verdict, remarks = MismatchVerdict.NO_MISMATCH, tuple[str, ...]()

    def modelled() -> tuple[Model, ...]:
        return models_of_the_nameless(
            data, found, roles, degree=study.degree, blocks=options.blocks, considered=len(candidates),
            budget=budget,
        )  # fmt: skip

    if found.found:
        generator = np.random.default_rng(seed)
        naming = naming_of(
            found, by_each, data, model, roles, candidates, options=options, generator=generator
        )
        whole, found, left = found, naming.search, naming.left
        verdict, remarks = named_or_not(naming, options)
        if not naming.convincing:
            beside = beside_a_remainder(
                whole.found[0].best, recalibrated, data, roles, degree=study.degree,
                considered=candidates, options=options, budget=budget,
            )  # fmt: skip
        if beside is not None and beside.log_odds >= options.least_log_odds:
            naming = named_beside_a_remainder(naming, whole, by_each[0], beside)
            found, left = naming.search, naming.left
            verdict, remarks = MismatchVerdict.MISSING_PHYSICS, (f"{remains(left)} {NAMELESS}",)
        if verdict is MismatchVerdict.MISSING_PHYSICS and (
            len(whole.found) > len(found.found) or left.doubtful or found.fit.has_process_noise
        ):
            models = models_beside_names(
                data, found, whole, roles, functions=None if beside is None else beside.on_top,
                degree=study.degree, blocks=options.blocks, considered=len(candidates), budget=budget,
            )  # fmt: skip
        if verdict is MismatchVerdict.MISSING_PHYSICS and found.fit.has_process_noise:
            still = replace(found.fit, noise=found.fit.noise.without_process())
            with budget.exempt():
                followed = fit_with_and_without_process_noise(found.fit.model, data, still, budget=budget)[1]
            if followed.converged:
                exact, remarks = followed, (*remarks, EXACT)
    elif found.fit.has_process_noise:
        steady = unsteadiness(found.fit, data) < 2 * options.least_log_odds
        knows_noise = any(form.noise for mechanism in dictionary for form in mechanism.forms)
        verdict, remarks = MismatchVerdict.UNEXPLAINED, () if steady else (GROWING,)
        if knows_noise and steady and not left.doubtful:
            # Random forces are an explanation among others: a function without any may be likelier.
            models = tuple(each for each in modelled() if not each.fit.has_process_noise)
            if not models or models[0].log_evidence < options.least_log_odds:
                verdict, models = MismatchVerdict.MISSING_PHYSICS, ()
    elif left.structured:
        verdict = MismatchVerdict.UNEXPLAINED
    elif p_shift < options.false_alarms:
        verdict = MismatchVerdict.PARAMETER_SHIFT
    if verdict is MismatchVerdict.UNEXPLAINED and not models:
        models = modelled()
    budget.says("working out how well parameters are known")
    with budget.exempt():
        covariance = covariance_with_unknown_forces(found.fit, data, budget=budget)
    found = replace(found, fit=replace(found.fit, covariance=covariance))
    return Investigation(
        verdict=verdict,
        model=model,
        roles=roles,
        search=found,
        least_squares=least_squares,
        augmented_least_squares=exact,
        before=left.before,
        after=left.after,
        process_noise=verdict is MismatchVerdict.MISSING_PHYSICS and not found.found,
        p_shift=p_shift,
        share=left.share,
        remarks=remarks,
        candidates=tuple(candidates),
        naming=naming,
        models=models,
        account=budget.account(),
    )


def remainders(
    model: Dynamics, data: Measurements, search: Search, roles: Roles
) -> tuple[Search, list[Remainder]]:
    """What is left with each mechanism that was found, or of the recalibrated simulation where there is none.

    A mechanism whose remainder has no finite size, such as one that makes the simulation run away without
    random forces, is taken back, with those after it.

    Raises
    ------
    NumericalFailure
        When that of the recalibrated simulation has none, either.
    """
    left: list[Remainder] = []
    for place, found in enumerate(search.found):
        try:
            left.append(what_is_left(model, data, search.recalibrated, found.best.fit, roles))
        except NumericalFailure as error:
            fit = search.found[place - 1].best.fit if place else search.recalibrated
            untried = (*search.untried, UntriedMechanism(found.best.candidate, str(error)))
            search = replace(search, found=search.found[:place], fit=fit, untried=untried)
            break
    return search, left or [what_is_left(model, data, search.recalibrated, search.recalibrated, roles)]


def considered(
    model: Dynamics, roles: Roles, dictionary: Sequence[Mechanism], study: MismatchStudy, *, file: str
) -> list[MechanismCandidate]:
    """The candidates of the dictionary, and monomials where the study or the lack of roles allows them."""
    candidates = candidates_of(model, roles, dictionary, file=file)
    if study.generic if study.generic is not None else not roles.physical:
        monomials = generic_candidates(model, roles, degree=study.degree, named=candidates)
        candidates += [each for each in monomials if each.coordinate != "constant"]
    return candidates


def named_or_not(naming: Naming, options: SearchOptions) -> tuple[MismatchVerdict, tuple[str, ...]]:
    """Whether mechanisms that were found are named, and with which reservations."""
    if not naming.convincing:
        return MismatchVerdict.UNEXPLAINED, ()
    remarks = tuple(filter(None, [remains(naming.left)])) if naming.p_alike is not None else ()
    if naming.likely:
        return MismatchVerdict.MISSING_PHYSICS, remarks
    names = " and ".join(each.best.candidate.name for each in naming.search.found)
    least = min(*naming.log_odds, naming.together)
    return MismatchVerdict.UNEXPLAINED, (
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


def shift_probability(model: Dynamics, recalibrated: Fit) -> float:
    """p-value of the test that the card's parameters are the true ones, given the recalibrated ones."""
    free = np.array(model.free, dtype=int)
    if not len(free):
        return 1.0
    difference = recalibrated.model.values[free] - model.values[free]
    scale = np.sqrt(np.diag(recalibrated.covariance))
    scale = np.where(scale > 0, scale, np.inf)
    correlation = recalibrated.covariance / np.outer(scale, scale)
    values, vectors = np.linalg.eigh(correlation)
    kept = values > 1e-9 * values[-1]
    along = vectors[:, kept].T @ (difference / scale) / np.sqrt(values[kept])
    return float(scipy.stats.chi2.sf(float(along @ along), int(kept.sum())))
