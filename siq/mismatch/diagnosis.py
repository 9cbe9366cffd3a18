"""Diagnosis: compare, locate, name, model, show - the whole of it for one simulation and its recordings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import scipy.stats

from siq.errors import NumericalFailure
from siq.mismatch.best_fit import both_fits, simpler
from siq.mismatch.candidates import Candidate, candidates_of, generic_candidates
from siq.mismatch.dictionary import Mechanism
from siq.mismatch.estimation import Fit, fit
from siq.mismatch.first_states import first_states
from siq.mismatch.innovations import Noise
from siq.mismatch.linearisation import Grid
from siq.mismatch.measurements import Measurements
from siq.mismatch.model import Model
from siq.mismatch.noise import first_noise
from siq.mismatch.remainder import Remainder, what_is_left, without_patches
from siq.mismatch.roles import Roles, roles_of
from siq.mismatch.search import Search, search
from siq.mismatch.steadiness import unsteadiness
from siq.mismatch.structure import Structure
from siq.mismatch.study import MismatchStudy
from siq.mismatch.trajectories import run

Verdict = Literal["no mismatch", "parameter shift", "missing physics", "unexplained"]

SHIFTED = 1e-4  # probability below which parameters are not called unchanged
FAINT = 1e-4  # process noise, relative to the motion, from which a fit without any is loosened
ENOUGH = 0.998  # share of the excess that mechanisms explain, beyond which a remainder is only remarked
MOSTLY = 0.99  # share that the first of several must explain alone for that
MANY = 3  # mechanisms that together are a description rather than an explanation
UNSTEADY = 6.0  # twice the difference of log-likelihoods, from which random forces follow the motion
GROWING = "Random forces that would explain it grow with the motion: a hidden state is likelier."
EXACT = (
    "The estimates admit random forces for what remains; the augmented card has those of least squares where "
    "it runs better with them."
)


@dataclass(frozen=True)
class Diagnosis:
    """What was found out about a simulation and recordings of the system.

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
        Probability that the parameters of the card are the true ones.
    share
        Of the excess that the mechanisms explain.
    remarks
        Sentences about reservations.
    candidates
        All mechanisms that were considered.
    """

    verdict: Verdict
    model: Model
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
    candidates: tuple[Candidate, ...]

    @property
    def final(self) -> Fit:
        """The fit that the verdict stands on: with mechanisms only where they are physics."""
        return self.search.fit if self.verdict == "missing physics" else self.search.recalibrated


def diagnose(
    model: Model, data: Measurements, dictionary: Sequence[Mechanism], study: MismatchStudy, *, file: str = ""
) -> Diagnosis:
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
    left = what_is_left(model, data, recalibrated, found.fit, roles)
    share_of_first = left.share
    if len(found.found) > 1:
        by_each = [what_is_left(model, data, recalibrated, each.best.fit, roles) for each in found.found]
        share_of_first = by_each[0].share
        random_forces = found.found[0].best.fit.has_process_noise
        if share_of_first >= ENOUGH or not (by_each[0].doubtful or random_forces):
            found, left = without_patches(found, by_each, least=study.search.named)
    doubtful = left.doubtful or found.fit.has_process_noise or len(found.found) >= MANY
    p_shift = shift_probability(model, recalibrated)
    exact: Fit | None = None
    verdict: Verdict
    if found.found:
        good = not doubtful or (left.share >= ENOUGH and share_of_first >= MOSTLY)
        verdict, remarks = named_or_not(found, left, doubtful, good, least=study.search.named)
        if verdict == "missing physics" and found.fit.has_process_noise:
            still = replace(found.fit, noise=found.fit.noise.without_process())
            followed = both_fits(found.fit.model, data, still)[1]
            if followed.converged:
                exact, remarks = followed, (*remarks, EXACT)
    elif found.fit.has_process_noise:
        steady = unsteadiness(found.fit, data) < UNSTEADY
        knows_noise = any(form.noise for mechanism in dictionary for form in mechanism.forms)
        verdict = "missing physics" if knows_noise and steady and not left.doubtful else "unexplained"
        remarks = () if steady else (GROWING,)
    elif left.structured:
        verdict, remarks = "unexplained", ()
    else:
        verdict, remarks = "parameter shift" if p_shift < SHIFTED else "no mismatch", ()
    return Diagnosis(
        verdict=verdict,
        model=model,
        roles=roles,
        search=found,
        least_squares=least_squares,
        augmented_least_squares=exact,
        before=left.before,
        after=left.after,
        process_noise=verdict == "missing physics" and not found.found,
        p_shift=p_shift,
        share=left.share,
        remarks=remarks,
        candidates=tuple(candidates),
    )


def considered(
    model: Model, roles: Roles, dictionary: Sequence[Mechanism], study: MismatchStudy, *, file: str
) -> list[Candidate]:
    """The candidates of the dictionary, and monomials where the study or the lack of roles allows them."""
    candidates = candidates_of(model, roles, dictionary, file=file)
    if study.generic if study.generic is not None else not roles.physical:
        monomials = generic_candidates(model, roles, degree=study.degree)
        candidates += [each for each in monomials if each.coordinate != "constant"]
    return candidates


def named_or_not(
    search: Search, left: Remainder, doubtful: bool, good: bool, *, least: float
) -> tuple[Verdict, tuple[str, ...]]:
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
        return "unexplained", ()
    remarks = (f"{1 - left.share:.2g} of the excess remains, and is not noise.",) if doubtful else ()
    found = [each.best for each in search.found]
    faintest = min(found, key=lambda each: each.delta_chi2)
    if faintest.delta_chi2 >= least:
        return "missing physics", remarks
    names = " and ".join(each.candidate.name for each in found)
    which = "is" if len(found) == 1 else f"{faintest.candidate.name} is"
    faint = (
        f"It looks like {names}, but {which} too faint to be named: that gains "
        f"{faintest.delta_chi2:.0f} in chi2, and {least:g} are asked for."
    )
    return "unexplained", (*remarks, faint)


def recalibrate(model: Model, data: Measurements) -> tuple[Fit, Fit]:
    """Fit the simulation's own parameters: with process noise where the data ask for it, and without.

    Raises
    ------
    NumericalFailure
        When neither fit can be made.
    """
    x = first_states(model, data)
    noise = first_noise(model, data, x)
    loose = fit(model, data, x=x, noise=noise, estimate_process=True)
    if loose.converged:
        again, strict = both_fits(loose.model, data, loose)
        return simpler(again, strict), strict
    # Where random forces on a hidden state could explain anything, the fit has no end. The card's own
    # simulation is then the better start.
    followed = run(model, Grid(data, max(loose.substeps, 1)), x[data.first[:-1]])
    x = np.where(np.isfinite(followed), followed, x)
    strict = fit(model, data, x=x, noise=noise.without_process(), estimate_process=False)
    if not strict.converged:
        if not np.isfinite(loose.sum_of_squares):
            raise NumericalFailure(
                "the simulation cannot be fitted to the recordings; check the card's equations and values"
            )
        return loose, strict
    small = Noise(strict.noise.measurement, noise.process * FAINT)
    again = fit(strict.model, data, x=strict.x, noise=small, estimate_process=True, substeps=strict.substeps)
    return simpler(again if again.converged else None, strict), strict


def shift_probability(model: Model, recalibrated: Fit) -> float:
    """Probability that the card's parameters are the true ones, given the recalibrated ones."""
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
