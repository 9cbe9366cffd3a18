"""Identify: which f do the pairs of a run show, and does it predict recordings that were held out?"""

from __future__ import annotations

from dataclasses import dataclass as plain_dataclass
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from pydantic.dataclasses import dataclass

from siq.certificate.tests import PredictionLimits, Verdict, check_prediction
from siq.data.held_out import held_out_recordings
from siq.data.markov_lag import MarkovLag, markov_lag
from siq.data.recordings import Recordings, SnapshotPairs, snapshot_pairs
from siq.data.selection import select_recordings
from siq.errors import NumericalFailure
from siq.identify.diffusion import DiffusionSource, check_units, estimated_diffusion
from siq.identify.flow_regression import refit, residuals
from siq.identify.identification import (
    IdentificationOptions,
    carries_noise,
    identify_vector_field,
)
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
from siq.identify.prediction import prediction_errors
from siq.identify.random_forces import with_random_forces
from siq.identify.residuals import NoiseDiagnosis, mean_residual_probability, residual_noise
from siq.identify.rounding import rounding_text
from siq.identify.storage import FieldRecord, field_library, read_field, write_field
from siq.numerics.randomness import Purpose, generator
from siq.steps.outcomes import Outcome, Status, Step, read_outcomes, write_outcomes
from siq.steps.settings import STRICT, Sampling, StateSpace

PREDICTED = 200  # held-out recordings that are predicted: enough for a median


@dataclass(frozen=True, config=STRICT)
class IdentifySettings:
    """What the identification depends on; `prediction` has the certificate's limits for f."""

    seed: int
    space: StateSpace
    sampling: Sampling
    identification: IdentificationOptions
    prediction: PredictionLimits


@plain_dataclass(frozen=True)
class Identified:
    """The identified f of a run with the test of its predictions, None where none was found."""

    record: FieldRecord | None
    outcome: Outcome


def run(settings: IdentifySettings, recordings: Recordings | None, *, number: int) -> Identified:
    """F of run `number`, from its recordings; None where drawing them failed."""
    if recordings is None:
        reason = "the run has no trajectories"
        return Identified(None, Outcome(number, Step.IDENTIFY, Status.SKIPPED, reason))
    try:
        record = _identified(settings, recordings, number)
    except (NumericalFailure, np.linalg.LinAlgError) as error:
        rounding = rounding_text(recordings, coarse=True)
        reason = str(error) if rounding is None else f"{error}; mind that {rounding}"
        return Identified(None, Outcome(number, Step.IDENTIFY, Status.FAILED, reason))
    if record.prediction["passed"]:
        notes = [note for note in (record.diffusion_source.note, record.noise.get("note")) if note]
        return Identified(record, Outcome(number, Step.IDENTIFY, reason="; ".join(notes)))
    notes = [str(record.prediction["reason"]), record.noise.get("note")]
    return Identified(
        record, Outcome(number, Step.IDENTIFY, Status.WARNING, "; ".join(note for note in notes if note))
    )


def _identified(settings: IdentifySettings, recordings: Recordings, number: int) -> FieldRecord:
    options, sampling = settings.identification, settings.sampling
    held = held_out_recordings(recordings, generator=generator(settings.seed, number, Purpose.HOLD_OUT))
    held_out = select_recordings(recordings, np.flatnonzero(held))
    training = select_recordings(recordings, np.flatnonzero(~held))
    step, maker = sampling.pair_step, sampling.integrator_step
    parts = snapshot_pairs(training, pair_step=step), snapshot_pairs(held_out, pair_step=step)
    library = field_library(recordings.names, options)
    identify_pairs = partial(
        identify_vector_field,
        library,
        options=options,
        integrator_step=maker,
    )
    noisy = carries_noise(library, parts[0], options=options, integrator_step=maker)
    if noisy and maker is None and (remembered := markov_lag(recordings)).remembers:
        return _from_earlier(settings, recordings, held, remembered, library)
    if noisy:
        # Under noise every recording counts: all give the result, a part of them its test.
        everything = snapshot_pairs(recordings, pair_step=step)
        found = with_random_forces(identify_pairs(everything), everything)
        fitted = refit(found, parts[0])
    else:
        found = fitted = identify_pairs(parts[0])
    found, noise, source = _with_diffusion(
        found, recordings, settings, pairs=sum(len(part.h) for part in parts)
    )
    verdict = _held_out_verdict(
        found, fitted, parts, held_out, fault=noise.fault(recordings.names), limits=settings.prediction
    )
    return FieldRecord(found, verdict.as_data(), _kept(noise, source, sum(len(part.h) for part in parts)))


def _kept(noise: NoiseDiagnosis, source: DiffusionSource, pairs: int) -> dict[str, Any]:
    """What is stored of the noise, with the number of independent pairs that it is known from."""
    return {
        "kind": noise.kind,
        "intensity": noise.intensity,
        "covariance": noise.covariance.tolist(),
        "correlation": noise.correlation,
        "correlation_score": noise.correlation_score,
        "measurement": noise.measurement.tolist(),
        "diffusion": str(source),
        "note": noise.note,
        "pairs": pairs,
    }


def _from_earlier(
    settings: IdentifySettings,
    recordings: Recordings,
    held: np.ndarray,
    remembered: MarkovLag,
    library: CandidateLibrary,
) -> FieldRecord:
    """F of recordings that remember: each pair is seen from a sample that knows nothing of its noise."""
    assert remembered.lag is not None  # they remember for so long
    everything = lagged_pairs(recordings, remembered.lag)
    parts = lagged_parts(recordings, remembered.lag, held)
    found = identify_from_earlier(library, everything, options=settings.identification)
    fitted = refit_from_earlier(found, parts[0])
    found = with_random_forces(found, everything.pairs)
    independent = int(everything.independent)
    given = settings.space.noise(len(recordings.names))
    diffusion, source = given, DiffusionSource.GIVEN
    if diffusion is None:
        diffusion, source = estimated_diffusion(found, pairs=independent), DiffusionSource.ESTIMATED
    if diffusion is None:
        _check_units(settings.space, recordings)
        diffusion, source = found.diffusion, DiffusionSource.UNIT
    found = replace(found, diffusion=diffusion)
    noise = lagged_noise(found, remembered, independent=independent)
    squares = [
        float((residuals_from_earlier(fitted, part) ** 2 / part.pairs.h[:, None]).mean())
        for part in reversed(parts)
    ]
    verdict = check_prediction(
        noise_fault=noise.fault(recordings.names),
        errors=None,
        mean_probability=mean_probability_from_earlier(fitted, parts[1], seen=len(parts[0].pairs.h)),
        held_out_ratio=squares[0] / squares[1],
        limits=settings.prediction,
    )
    lost = lost_time(found, everything)
    kept = _kept(noise, source, independent) | {"lag": remembered.lag, "lost_time": lost}
    return FieldRecord(found, verdict.as_data(), kept)


def _with_diffusion(
    found: IdentifiedField, recordings: Recordings, settings: IdentifySettings, *, pairs: int
) -> tuple[IdentifiedField, NoiseDiagnosis, DiffusionSource]:
    """The field with its D, what its residuals say, and where D is from.

    f does not depend on D, and whether noise is white does not either: so D can come last.
    """
    step, space = settings.sampling.pair_step, settings.space
    given = space.noise(len(recordings.names))
    if given is not None:
        found = replace(found, diffusion=given)
        return found, residual_noise(found, recordings, pair_step=step), DiffusionSource.GIVEN
    estimated = estimated_diffusion(found, pairs=pairs)
    if estimated is not None:
        with_own = replace(found, diffusion=estimated)
        noise = residual_noise(with_own, recordings, pair_step=step)
        if noise.kind == "process":
            return with_own, noise, DiffusionSource.ESTIMATED
    _check_units(space, recordings)
    return found, residual_noise(found, recordings, pair_step=step), DiffusionSource.UNIT


def _check_units(space: StateSpace, recordings: Recordings) -> None:
    units = [
        unit or space.unit(name) or None
        for name, unit in zip(recordings.names, recordings.units, strict=True)
    ]
    check_units(recordings.names, units)


def _held_out_verdict(
    found: IdentifiedField,
    fitted: IdentifiedField,
    parts: tuple[SnapshotPairs, SnapshotPairs],
    held_out: Recordings,
    *,
    fault: str | None,
    limits: PredictionLimits,
) -> Verdict:
    """Whether f holds for recordings that it was not fitted to."""
    if found.noise_free:
        labels = np.arange(min(len(held_out.labels), PREDICTED))
        errors = prediction_errors(found.dynamics, select_recordings(held_out, labels))
        return check_prediction(
            noise_fault=fault, errors=errors, mean_probability=None, held_out_ratio=1.0, limits=limits
        )
    training, unseen = parts
    squares = [
        float((residuals(fitted, pairs) ** 2 / pairs.h[:, None]).mean()) for pairs in (unseen, training)
    ]
    return check_prediction(
        noise_fault=fault,
        errors=None,
        mean_probability=mean_residual_probability(fitted, unseen),
        held_out_ratio=squares[0] / squares[1],
        limits=limits,
    )


def read(field: str | Path, outcome: str | Path) -> Identified:
    """What `write` wrote."""
    return Identified(read_field(field), read_outcomes(outcome)[0])


def write(
    identified: Identified, settings: IdentifySettings, *, field: str | Path, outcome: str | Path
) -> None:
    """Write f, an empty file where none was found, and what became of the step."""
    if identified.record is None:
        Path(field).touch()
    else:
        write_field(field, identified.record, settings.identification)
    write_outcomes(outcome, [identified.outcome])
