"""Identify f of recordings that remember: each increment is seen from a sample before its noise was."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from siq.certificate.tests import PredictionLimits, check_prediction
from siq.data.markov_lag import MarkovLag
from siq.data.recordings import Recordings
from siq.errors import NumericalFailure
from siq.identify.diffusion import DiffusionSource, check_units, estimated_diffusion
from siq.identify.identification import IdentificationOptions
from siq.identify.identified_field import IdentifiedField
from siq.identify.lagged_pairs import (
    identify_from_earlier,
    lagged_pairs,
    lagged_parts,
    lost_time,
    mean_probability_from_earlier,
    refit_from_earlier,
    residuals_from_earlier,
)
from siq.identify.library import CandidateLibrary
from siq.identify.memory import lagged_noise
from siq.identify.noise_formula import constant_noise
from siq.identify.random_forces import with_random_forces
from siq.identify.storage import FieldRecord
from siq.steps.identify_beside_sensor import units_of_states
from siq.steps.settings import StateSpace


def record_from_earlier(
    recordings: Recordings,
    memory: MarkovLag,
    *,
    held: np.ndarray,
    library: CandidateLibrary,
    options: IdentificationOptions,
    space: StateSpace,
    limits: PredictionLimits,
) -> FieldRecord:
    """F, D, and the test of f, of recordings that remember.

    Parameters
    ----------
    recordings
        Trajectories.
    memory
        From which lag on they are Markovian.
    held
        Which of them are held out, as a mask over the recordings.
    library, options
        In which functions f is sought, and what makes a term significant.
    space
        D, where it is given, and units.
    limits
        Of the test.

    Raises
    ------
    NumericalFailure
        Where f cannot be identified, and where D is given as a function of the state.
    """
    assert memory.lag is not None  # they remember for so long
    everything = lagged_pairs(recordings, memory.lag)
    training, unseen = lagged_parts(recordings, memory.lag, held)
    found = identify_from_earlier(library, everything, options=options)
    fitted = refit_from_earlier(found, training)
    independent = int(everything.independent)
    found = with_random_forces(found, everything.pairs)
    found, source = _with_diffusion(found, recordings, space, independent)
    noise = lagged_noise(found, memory, independent=independent, time_unit=recordings.time_unit)
    squares = [
        float((residuals_from_earlier(fitted, part) ** 2 / part.pairs.h[:, None]).mean())
        for part in (unseen, training)
    ]
    verdict = check_prediction(
        noise_fault=noise.fault(recordings.names),
        errors=None,
        mean_probability=mean_probability_from_earlier(fitted, unseen, seen=len(training.pairs.h)),
        held_out_ratio=squares[0] / squares[1],
        limits=limits,
    )
    kept = {
        **noise.as_data(),
        "diffusion": str(source),
        "note": noise.note,
        "pairs": independent,
        "lag": memory.lag,
        "lost_time": lost_time(found, everything),
    }
    return FieldRecord(found, verdict.as_data(), kept)


def _with_diffusion(
    found: IdentifiedField, recordings: Recordings, space: StateSpace, independent: int
) -> tuple[IdentifiedField, DiffusionSource]:
    """The field with D: as given, else as the long-run noise shows it, else the unit matrix."""
    given = space.noise(recordings.names)
    if given is not None and not given.constant:
        raise NumericalFailure(
            "the recordings remember, and D is given as a function of the state: how strong forces with a"
            " memory are here and there is not known; give a constant D, or leave it out"
        )
    if given is not None:
        return replace(found, diffusion=given), DiffusionSource.GIVEN
    estimated = estimated_diffusion(found, pairs=independent)
    if estimated is not None:
        own = constant_noise(found.library.symbols, found.noise_rate, samples=independent)
        return replace(found, diffusion=estimated, constant_noise=own), DiffusionSource.ESTIMATED
    check_units(recordings.names, units_of_states(recordings, space))
    return found, DiffusionSource.UNIT
