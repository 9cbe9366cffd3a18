"""Parts of a description: what is added to a simulation, fitted in earnest and judged."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np

from siq.errors import NumericalFailure
from siq.estimation.budget import BudgetSpent
from siq.estimation.estimation import SUBSTEP_ERROR
from siq.estimation.fit import Fit
from siq.estimation.linearisation import substeps_needed
from siq.estimation.process_noise import better_of, fit_with_process_noise_as_needed
from siq.estimation.trajectories import fit_trajectories
from siq.mismatch.building import MechanismCandidate
from siq.mismatch.function_places import Place
from siq.mismatch.functions import FORMULA
from siq.mismatch.nameless_models import Material, Part
from siq.mismatch.smooth_functions import Smooth
from siq.mismatch.tried import UNFORESEEN, TriedMechanism, judged

LOGGER = logging.getLogger(__name__)
LARGEST_PART = 0.25  # of the work left, that a single fit may take: a choice


def fitted_part(
    candidate: MechanismCandidate,
    level: float,
    place: Place | None,
    fit: Fit,
    cost: float,
    material: Material,
    *,
    smooth: Smooth | None = None,
    begin: Fit | None = None,
) -> list[Part]:
    """A function as part of a model, or nothing where it cannot be fitted.

    Parameters
    ----------
    candidate
        The simulation with the function.
    level
        Of random forces to begin with, as a multiple of those of the fit.
    place
        Where the function stands; None for a memory.
    fit
        The simulation without it.
    cost
        Logarithm of the number of functions that it was chosen among.
    material
        What models are made from.
    smooth
        See `siq.mismatch.nameless_models.Part`.
    begin
        Where the fit begins, if it is not the simulation without the function: with states for those that
        the function brings, if it brings any.
    """
    kind = FORMULA if smooth is None else smooth.kind
    try:
        material.budget.says(f"a {kind}: {candidate.label}")
        with material.budget.part(LARGEST_PART):
            trial = _fitted(candidate, level, begin or fit, fit, material)
    except (*UNFORESEEN, BudgetSpent) as error:
        LOGGER.info("%s as a %s cannot be fitted: %s", candidate.label, kind, error)
        return []
    return [Part(trial, kind, cost, place, smooth)]


def _fitted(
    candidate: MechanismCandidate, level: float, begin: Fit, fit: Fit, material: Material
) -> TriedMechanism:
    """A function, fitted from a fit on, and judged against the fit without it.

    Raises
    ------
    NumericalFailure
        When the fit does not settle.
    """
    data, budget = material.data, material.budget
    known = {each.name: each.value for each in begin.model.parameters}
    known |= {each.name: each.value for each in candidate.model.parameters if each.name in candidate.new}
    values = np.array([known.get(each.name, 0.0) for each in candidate.model.parameters])
    if not begin.has_process_noise:  # a function that was nearly right may not be followed by another
        begin = replace(begin, noise=replace(begin.noise, process=fit.noise.process))
    trial = fit_with_process_noise_as_needed(
        candidate.model.with_values(values), data, begin, level=level, budget=budget
    )
    # A function may be steeper than the simulation, whose steps are then too long to follow it.
    needed = substeps_needed(trial.model, data, trial.model.values, trial.x, tolerance=SUBSTEP_ERROR)
    if trial.converged and needed > trial.substeps:
        finer = replace(trial, substeps=needed)
        trial = fit_with_process_noise_as_needed(trial.model, data, finer, budget=budget)
    if not (trial.has_process_noise or fit.has_process_noise) and trial.log_likelihood < fit.log_likelihood:
        # Nothing added is as likely as the fit without it: steps of all samples at once have led away.
        damped = fit_trajectories(
            candidate.model.with_values(values),
            data,
            begin=begin.x[data.first[:-1]],
            noise=begin.noise.of_states(candidate.model.dimension),
            substeps=trial.substeps,
            budget=budget,
        )
        trial = better_of(trial, damped)
    if not trial.converged:
        raise NumericalFailure(trial.fault or "its fit does not settle")
    return judged(trial, fit, data, candidate, blocks=material.blocks)
