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
from siq.mismatch.estimation import Fit, first_states, fit
from siq.mismatch.innovations import Noise
from siq.mismatch.measurements import Measurements
from siq.mismatch.model import Model
from siq.mismatch.noise import first_noise
from siq.mismatch.roles import Roles, roles_of
from siq.mismatch.search import Search, search
from siq.mismatch.steadiness import unsteadiness
from siq.mismatch.structure import Structure, structure_of
from siq.mismatch.study import MismatchStudy
from siq.mismatch.trajectories import run

Verdict = Literal["no mismatch", "parameter shift", "missing physics", "unexplained"]

STRUCTURED = 1e-4  # probability below which residuals are not called random
SHIFTED = 1e-4  # probability below which parameters are not called unchanged
FAINT = 1e-4  # process noise, relative to the motion, from which a fit without any is loosened
ENOUGH = 0.998  # share of the excess that mechanisms explain, beyond which a remainder is only remarked
MOSTLY = 0.99  # share that the first of several must explain alone for that
MANY = 3  # mechanisms that together are a description rather than an explanation
UNSTEADY = 6.0  # twice the difference of log-likelihoods, from which random forces follow the motion


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
    generic = study.generic if study.generic is not None else not roles.physical
    candidates = candidates_of(model, roles, dictionary, file=file)
    monomials = [
        c for c in generic_candidates(model, roles, degree=study.degree) if c.coordinate != "constant"
    ]
    if generic:
        candidates += monomials
    recalibrated, least_squares = recalibrate(model, data)
    found = search(model, data, recalibrated, candidates, options=study.search)
    after, before, explained = what_is_left(model, data, recalibrated, found.fit, roles)
    mostly = explained
    doubtful = after.p_value < STRUCTURED or found.fit.has_process_noise or len(found.found) >= MANY
    if len(found.found) > 1 and doubtful:
        left = [what_is_left(model, data, recalibrated, each.best.fit, roles) for each in found.found]
        mostly = left[0][2]
        if mostly >= ENOUGH:
            # What is added to a mechanism that explains all but a trifle may only patch the trifle.
            kept = 1
            while (
                kept < len(left)
                and found.found[kept].best.delta_chi2 >= study.search.named
                and left[kept][2] > left[kept - 1][2]
            ):
                kept += 1
            found = replace(found, found=found.found[:kept], fit=found.found[kept - 1].best.fit)
            after, before, explained = left[kept - 1]
    random = found.fit.has_process_noise
    p_shift = shift_probability(model, recalibrated)
    remarks: list[str] = []
    knows_noise = any(form.noise for mechanism in dictionary for form in mechanism.forms)
    structured = after.p_value < STRUCTURED
    verdict: Verdict
    if found.found:
        verdict = "missing physics"
        if doubtful:
            # Several terms that fit well together, and yet leave structure: so a false explanation looks.
            if explained >= ENOUGH and mostly >= MOSTLY:
                remarks.append(f"{1 - explained:.2g} of the excess remains, and is not noise.")
            else:
                verdict = "unexplained"
        gained = found.found[0].best.delta_chi2
        if verdict == "missing physics" and gained < study.search.named:
            verdict = "unexplained"
            name = found.found[0].best.candidate.name
            remarks.append(
                f"It looks like {name}, but is too faint to be named: that gains {gained:.0f} in chi2, and "
                f"{study.search.named:g} are asked for."
            )
        random = False
    elif random:
        steady = unsteadiness(found.fit, data) < UNSTEADY
        if not steady:
            remarks.append(
                "Random forces that would explain it grow with the motion: a hidden state is likelier."
            )
        verdict = "missing physics" if knows_noise and steady and not structured else "unexplained"
        random = verdict == "missing physics"
    elif structured:
        verdict = "unexplained"
    else:
        verdict = "parameter shift" if p_shift < SHIFTED else "no mismatch"
    exact = None
    if verdict == "missing physics" and not random and found.fit.has_process_noise:
        exact = both_fits(found.fit.model, data, found.fit)[1]
        if exact.converged:
            remarks.append(
                "The estimates admit random forces for what remains; the augmented card has those of least "
                "squares where it runs better with them."
            )
    return Diagnosis(
        verdict=verdict,
        model=model,
        roles=roles,
        search=found,
        least_squares=least_squares,
        augmented_least_squares=exact if exact is not None and exact.converged else None,
        before=before,
        after=after,
        process_noise=random,
        p_shift=p_shift,
        share=explained,
        remarks=tuple(remarks),
        candidates=tuple(candidates),
    )


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
    followed = run(model, data, x[data.first[:-1]], substeps=max(loose.substeps, 1))
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


def what_is_left(
    model: Model, data: Measurements, recalibrated: Fit, final: Fit, roles: Roles
) -> tuple[Structure, Structure, float]:
    """Structure after and before mechanisms were added, and the share of the excess that they explain."""
    after = structure_of(final.model, data, final, roles)
    # Random forces that stand for missing physics take measurement noise with them; the final fit's is right.
    still = Noise(final.noise.measurement, np.zeros(model.dimension))
    before = structure_of(model, data, recalibrated, roles, noise=still)
    alone = after
    if final.has_process_noise:
        alone = structure_of(final.model, data, final, roles, noise=final.noise.without_process())
    return after, before, explained_share(before, alone)


def explained_share(before: Structure, after: Structure) -> float:
    """Share of the excess over measurement noise that the final simulation explains, without process noise.

    What is left is the excess that remains, or what a function of one coordinate still finds: where a fit
    without process noise takes a misfit for noise, only the latter shows it.
    """
    if not before.total > before.freedom:
        return 1.0
    best = after.curves[0] if after.curves else None
    systematic = 0.0 if best is None else best.gain - 2 * len(best.direction.knots)
    left = max(after.total - after.freedom, systematic, 0.0)
    return float(np.clip(1 - left / (before.total - before.freedom), 0.0, 1.0))


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
