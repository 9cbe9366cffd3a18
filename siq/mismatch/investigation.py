"""Investigation: what a simulation lacks, from its recalibration to the verdict."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
import scipy.stats

from siq.dynamics.dynamics import Dynamics
from siq.errors import NumericalFailure
from siq.estimation.estimation import Fit
from siq.estimation.measurements import Measurements
from siq.estimation.process_noise import fit_with_and_without_process_noise
from siq.estimation.recalibration import recalibrate
from siq.mismatch.candidates import MechanismCandidate, candidates_of, generic_candidates
from siq.mismatch.dictionary import Mechanism
from siq.mismatch.remainder import Remainder, what_is_left, without_patches
from siq.mismatch.roles import Roles, roles_of
from siq.mismatch.search import Search, search
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


SHIFTED = 1e-4  # probability below which parameters are not called unchanged
ENOUGH = 0.998  # share of the excess that mechanisms explain, beyond which a remainder is only remarked
MOSTLY = 0.99  # share that the first of several must explain alone for that
MANY = 3  # mechanisms that together are a description rather than an explanation
UNSTEADY = 6.0  # twice the difference of log-likelihoods, from which random forces follow the motion
GROWING = "Random forces would explain it only if they grew with the motion; a hidden state is more likely."
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
    too_faint
        Whether what was found leaves nothing, and is not named since it gains too little.
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
    too_faint: bool = False

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

    Raises
    ------
    NumericalFailure
        When not even the recalibrated simulation with process noise can be fitted.
    """
    roles = roles_of(model)
    candidates = considered(model, roles, dictionary, study, file=file)
    recalibrated, least_squares = recalibrate(model, data)
    found = search(model, data, recalibrated, candidates, options=study.search)
    found, by_each = remainders(model, data, found, roles)
    first, left = by_each[0], by_each[-1]
    alone = found.found[0].best.fit if found.found else recalibrated
    if len(found.found) > 1 and (first.share >= ENOUGH or not (first.doubtful or alone.has_process_noise)):
        found, left = without_patches(found, by_each, least=study.search.named)
    doubtful = left.doubtful or found.fit.has_process_noise or len(found.found) >= MANY
    p_shift = shift_probability(model, recalibrated)
    exact: Fit | None = None
    too_faint = False
    verdict: MismatchVerdict
    if found.found:
        good = not doubtful or (left.share >= ENOUGH and first.share >= MOSTLY)
        verdict, remarks = named_or_not(found, left, doubtful, good, least=study.search.named)
        too_faint = good and verdict is MismatchVerdict.UNEXPLAINED
        if verdict is MismatchVerdict.MISSING_PHYSICS and found.fit.has_process_noise:
            still = replace(found.fit, noise=found.fit.noise.without_process())
            followed = fit_with_and_without_process_noise(found.fit.model, data, still)[1]
            if followed.converged:
                exact, remarks = followed, (*remarks, EXACT)
    elif found.fit.has_process_noise:
        steady = unsteadiness(found.fit, data) < UNSTEADY
        knows_noise = any(form.noise for mechanism in dictionary for form in mechanism.forms)
        named = knows_noise and steady and not left.doubtful
        verdict = MismatchVerdict.MISSING_PHYSICS if named else MismatchVerdict.UNEXPLAINED
        remarks = () if steady else (GROWING,)
    elif left.structured:
        verdict, remarks = MismatchVerdict.UNEXPLAINED, ()
    else:
        shifted = p_shift < SHIFTED
        verdict = MismatchVerdict.PARAMETER_SHIFT if shifted else MismatchVerdict.NO_MISMATCH
        remarks = ()
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
        too_faint=too_faint,
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
        monomials = generic_candidates(model, roles, degree=study.degree)
        candidates += [each for each in monomials if each.coordinate != "constant"]
    return candidates


def named_or_not(
    search: Search, left: Remainder, doubtful: bool, good: bool, *, least: float
) -> tuple[MismatchVerdict, tuple[str, ...]]:
    """Whether mechanisms that were found are named, and with which reservations.

    Parameters
    ----------
    search
        With what was found.
    left
        What that leaves.
    doubtful, good
        Whether there is a reason for doubt, and whether they explain enough all the same: several terms that
        fit well together, and yet leave structure, are what a false explanation looks like.
    least
        χ² that each must gain.
    """
    if not good:
        return MismatchVerdict.UNEXPLAINED, ()
    remarks = tuple(filter(None, [remains(left)])) if doubtful else ()
    found = [each.best for each in search.found]
    faintest = min(found, key=lambda each: each.delta_chi2)
    if faintest.delta_chi2 >= least:
        return MismatchVerdict.MISSING_PHYSICS, remarks
    names = " and ".join(each.candidate.name for each in found)
    which = "is" if len(found) == 1 else f"{faintest.candidate.name} is"
    faint = (
        f"It looks like {names}, but {which} too faint to be named: it gains {faintest.delta_chi2:.0f} in χ²,"
        f" and a name takes {least:g}."
    )
    return MismatchVerdict.UNEXPLAINED, (*remarks, faint)


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
