"""Identify: which f do the pairs of a run show, and does it predict recordings that were held out?"""

from __future__ import annotations

from dataclasses import dataclass as plain_dataclass
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from pydantic.dataclasses import dataclass

from siq.certificate.tests import PredictionLimits, Verdict, check_prediction
from siq.data.held_out import held_out_recordings
from siq.data.recordings import Recordings, SnapshotPairs, snapshot_pairs
from siq.data.selection import select_recordings
from siq.errors import NumericalFailure
from siq.estimation.innovations import Noise
from siq.identify.diffusion import DiffusionSource, check_units, estimated_diffusion
from siq.identify.flow_regression import refit, residuals
from siq.identify.identification import (
    IdentificationOptions,
    carries_noise,
    identify_vector_field,
)
from siq.identify.identified_field import IdentifiedField
from siq.identify.noisy_sensor import FilteredField, held_out_evidence, identify_by_likelihood
from siq.identify.prediction import prediction_errors
from siq.identify.random_forces import with_random_forces
from siq.identify.residuals import (
    LARGE,
    SIGNIFICANT,
    NoiseDiagnosis,
    mean_residual_probability,
    residual_noise,
    shared_errors,
)
from siq.identify.rounding import rounding_text
from siq.identify.selection import critical_values
from siq.identify.storage import FieldRecord, field_library, read_field, write_field
from siq.numerics.randomness import Purpose, generator
from siq.steps.outcomes import Outcome, Status, Step, read_outcomes, write_outcomes
from siq.steps.settings import STRICT, Sampling, StateSpace

SUSPECT = -1.0  # standard errors of the correlation of neighbouring residuals
UNDRIVEN = 0.05  # share of random forces in the residuals, below which nothing but sensors is noisy
LEAST, MOST = 1e-3, 0.45  # of the residuals' variance: a sensor's share of it that a fit begins with
MUCH = 0.02  # the same share, beyond which a regression of pairs is no answer
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
    if carries_noise(library, parts[0], options=options, integrator_step=maker):
        # Under noise every recording counts: all give the result, a part of them its test.
        everything = snapshot_pairs(recordings, pair_step=step)
        found = with_random_forces(identify_pairs(everything), everything)
        filtered = _beside_sensor_noise(found, recordings, settings)
        if filtered is not None:
            return _filtered_record(filtered, recordings, (training, held_out), settings)
        fitted = refit(found, parts[0])
    else:
        found = fitted = identify_pairs(parts[0])
    found, noise, source = _with_diffusion(
        found, recordings, settings, pairs=sum(len(part.h) for part in parts)
    )
    verdict = _held_out_verdict(
        found, fitted, parts, held_out, fault=noise.fault(recordings.names), limits=settings.prediction
    )
    kept = {
        "kind": noise.kind,
        "intensity": noise.intensity,
        "covariance": noise.covariance.tolist(),
        "correlation": noise.correlation,
        "correlation_score": noise.correlation_score,
        "measurement": noise.measurement.tolist(),
        "diffusion": str(source),
        "note": noise.note,
        "pairs": sum(len(part.h) for part in parts),
    }
    return FieldRecord(found, verdict.as_data(), kept)


def _beside_sensor_noise(
    found: IdentifiedField, recordings: Recordings, settings: IdentifySettings
) -> FilteredField | None:
    """F by the likelihood of whole recordings, where their sensors are noisy; None where they are not.

    What could be sensor noise is asked of the likelihood from one standard error on: it would bias f long
    before it is significant.
    """
    step = settings.sampling.pair_step
    correlation, score = shared_errors(found, recordings, pair_step=step)
    if not (score < SUSPECT).any() or not (1 + 2 * correlation > UNDRIVEN).any():
        return None
    share = np.clip(-correlation, LEAST, MOST)
    variance = np.diag(found.noise_rate) * float(np.median(snapshot_pairs(recordings, pair_step=step).h))
    start = Noise(share * variance, np.diag(found.noise_rate) * (1 - 2 * share))
    try:
        filtered = identify_by_likelihood(
            found.library, recordings, found, start, pair_step=step,
            critical=critical_values(found.library, false_terms=settings.identification.false_terms),
        )  # fmt: skip
    except (NumericalFailure, np.linalg.LinAlgError) as error:
        if (correlation < -MUCH).any():
            raise NumericalFailure(f"the sensor is noisy, and f beside it is not found: {error}") from None
        return None
    return filtered if filtered.gain > 1 else None


def _filtered_record(
    filtered: FilteredField,
    recordings: Recordings,
    parts: tuple[Recordings, Recordings],
    settings: IdentifySettings,
) -> FieldRecord:
    """What is kept of an f that was identified beside sensor noise."""
    step = settings.sampling.pair_step
    pairs = len(snapshot_pairs(recordings, pair_step=step).h)
    given = settings.space.noise(len(recordings.names))
    estimated = None if given is not None else estimated_diffusion(filtered.found, pairs=pairs)
    source = DiffusionSource.GIVEN if given is not None else DiffusionSource.ESTIMATED
    if given is None and estimated is None:
        source = DiffusionSource.UNIT
        check_units(recordings.names, _units(recordings, settings.space))
    diffusion = given or estimated or filtered.found.diffusion
    found = replace(filtered.found, diffusion=diffusion)
    intensity = diffusion.intensity(found.noise_rate)
    probability, ratio = held_out_evidence(filtered, *parts, pair_step=step)
    coloured = abs(filtered.score) > SIGNIFICANT and abs(filtered.correlation) > LARGE
    verdict = check_prediction(
        noise_fault=(
            f"the innovations of neighbouring samples are correlated ({filtered.correlation:.2f}) though"
            " noise of the sensor is allowed for: the random forces have a memory, or a state is missing"
        )
        if coloured else None,
        errors=None, mean_probability=probability, held_out_ratio=ratio, limits=settings.prediction,
    )  # fmt: skip
    sizes = np.sqrt(filtered.sensor)
    said = ", ".join(f"{size:.2g} in {name}" for size, name in zip(sizes, recordings.titles, strict=True))
    return FieldRecord(
        found,
        verdict.as_data(),
        {
            "kind": "coloured" if coloured else "process",
            "intensity": intensity,
            "covariance": (found.noise_rate / intensity).tolist(),
            "correlation": filtered.correlation,
            "correlation_score": filtered.score,
            "measurement": sizes.tolist(),
            "measurement_error": (sizes * filtered.sensor_error / 2).tolist(),
            "diffusion": str(source),
            "note": f"the noise of the sensor, {said}, was estimated beside f, which it does not bias",
            "pairs": pairs,
        },
    )


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
    check_units(recordings.names, _units(recordings, space))
    return found, residual_noise(found, recordings, pair_step=step), DiffusionSource.UNIT


def _units(recordings: Recordings, space: StateSpace) -> list[str | None]:
    """The unit of each state, None where nobody said."""
    named = zip(recordings.names, recordings.units, strict=True)
    return [unit or space.unit(name) or None for name, unit in named]


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
