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
from siq.data.markov_lag import markov_lag
from siq.data.recordings import Recordings, SnapshotPairs, snapshot_pairs
from siq.data.selection import joined, select_recordings
from siq.errors import NumericalFailure
from siq.identify.diffusion import UNLIKE_GIVEN, DiffusionSource, check_units, estimated_diffusion
from siq.identify.flow_regression import refit, residuals
from siq.identify.identification import (
    IdentificationOptions,
    carries_noise,
    identify_vector_field,
    with_stability,
)
from siq.identify.identified_field import IdentifiedField
from siq.identify.library import check_origin
from siq.identify.memory import possible_exposures
from siq.identify.noise_formula import constant_noise
from siq.identify.noise_regression import constant_noise_probability
from siq.identify.prediction import prediction_errors
from siq.identify.random_forces import with_random_forces
from siq.identify.residuals import (
    NoiseDiagnosis,
    mean_residual_probability,
    residual_noise,
)
from siq.identify.rounding import rounding_text
from siq.identify.storage import FieldRecord, field_library, read_field, write_field
from siq.identify.weighted_regression import fit_weighted, with_given_noise, with_noise_formula
from siq.numerics.randomness import Purpose, generator
from siq.steps.identify_beside_sensor import (
    beside_sensor_noise,
    filtered_record,
    means_over_exposures,
    units_of_states,
)
from siq.steps.identify_from_earlier import record_from_earlier
from siq.steps.identify_hidden import (
    advice_on_inertia,
    advice_on_velocities,
    hidden_record,
    with_inertia_asked,
)
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
        if not settings.identification.hidden_velocities:
            record = with_inertia_asked(record, recordings, pair_step=settings.sampling.pair_step)
    except (NumericalFailure, np.linalg.LinAlgError) as error:
        rounding = rounding_text(recordings, coarse=True)
        reason = str(error) if rounding is None else f"{error}; mind that {rounding}"
        hidden = settings.identification.hidden_velocities
        advice_of = advice_on_velocities if hidden else advice_on_inertia
        advice = advice_of(recordings, pair_step=settings.sampling.pair_step)
        reason = reason if advice is None else f"{reason}; {advice}"
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
    if options.hidden_velocities:
        return hidden_record(
            recordings, seed=settings.seed, number=number, space=settings.space, sampling=sampling,
            options=options, limits=settings.prediction,
        )  # fmt: skip
    held = held_out_recordings(recordings, generator=generator(settings.seed, number, Purpose.HOLD_OUT))
    held_out = select_recordings(recordings, np.flatnonzero(held))
    training = select_recordings(recordings, np.flatnonzero(~held))
    step, maker = sampling.pair_step, sampling.integrator_step
    parts = snapshot_pairs(training, pair_step=step), snapshot_pairs(held_out, pair_step=step)
    library = field_library(recordings.names, options)
    check_origin(library, recordings.values, names=recordings.titles)
    identify_pairs = partial(
        identify_vector_field,
        library,
        options=options,
        integrator_step=maker,
    )
    noisy = carries_noise(library, parts[0], options=options, integrator_step=maker)
    if noisy and maker is None and (memory := markov_lag(joined(recordings))).remembers:
        for exposure in possible_exposures(memory):
            draw = generator(settings.seed, number, Purpose.STABILITY)
            means = means_over_exposures(
                recordings, exposure, library=library, options=options, pair_step=step, generator=draw
            )
            if means is not None:
                return filtered_record(
                    means, recordings, (training, held_out), sampling=sampling, space=settings.space,
                    limits=settings.prediction,
                )  # fmt: skip
        return record_from_earlier(
            recordings, memory, held=held, library=library, options=options, space=settings.space,
            limits=settings.prediction,
        )  # fmt: skip
    if noisy:
        # Under noise every recording counts: all give the result, a part of them its test.
        everything = snapshot_pairs(recordings, pair_step=step)
        found = with_random_forces(identify_pairs(everything), everything)
        draw = generator(settings.seed, number, Purpose.STABILITY)
        filtered = beside_sensor_noise(found, recordings, options=options, pair_step=step, generator=draw)
        if filtered is not None:
            return filtered_record(
                filtered, recordings, (training, held_out), sampling=sampling, space=settings.space,
                limits=settings.prediction,
            )  # fmt: skip
    else:
        found = identify_pairs(parts[0])
    found, noise, source = _with_diffusion(
        found, recordings, settings, pairs=sum(len(part.h) for part in parts)
    )
    fitted = found
    if not found.noise_free:
        if found.diffusion.constant:
            draw = generator(settings.seed, number, Purpose.STABILITY)
            pairs = snapshot_pairs(recordings, pair_step=step)
            found = with_stability(found, pairs, options=options, generator=draw)
        fitted = (refit if found.diffusion.constant else fit_weighted)(found, parts[0])
    verdict = _held_out_verdict(
        found, fitted, parts, held_out, fault=noise.fault(recordings.names), limits=settings.prediction
    )
    kept = {
        **noise.as_data(),
        "diffusion": str(source),
        "note": "; ".join(
            each for each in (noise.note, _unlike(found, noise, source, recordings, settings)) if each
        )
        or None,
        "pairs": sum(len(part.h) for part in parts),
    }
    return FieldRecord(found, verdict.as_data(), kept)


def _with_diffusion(
    found: IdentifiedField, recordings: Recordings, settings: IdentifySettings, *, pairs: int
) -> tuple[IdentifiedField, NoiseDiagnosis, DiffusionSource]:
    """The field with its D, what its residuals say, and where D is from.

    f does not depend on D, and whether noise is white does not either: so D can come last.
    """
    step, space = settings.sampling.pair_step, settings.space
    given, false_terms = space.noise(recordings.names), settings.identification.false_terms
    everything = snapshot_pairs(recordings, pair_step=step)
    if given is not None:
        found = with_given_noise(found, everything, given, false_terms=false_terms)
        return found, residual_noise(found, recordings, pair_step=step), DiffusionSource.GIVEN
    estimated = estimated_diffusion(found, pairs=pairs)
    if estimated is not None:
        own = constant_noise(found.library.symbols, found.noise_rate, samples=pairs)
        with_own = replace(found, diffusion=estimated, constant_noise=own)
        noise = residual_noise(with_own, recordings, pair_step=step)
        if noise.kind == "process":
            by_state = with_noise_formula(with_own, everything, false_terms=false_terms)
            if by_state is not None:
                by_formula = residual_noise(by_state, recordings, pair_step=step)
                return by_state, by_formula, DiffusionSource.ESTIMATED
            return with_own, noise, DiffusionSource.ESTIMATED
    check_units(recordings.names, units_of_states(recordings, space))
    return found, residual_noise(found, recordings, pair_step=step), DiffusionSource.UNIT


def _unlike(
    found: IdentifiedField,
    noise: NoiseDiagnosis,
    source: DiffusionSource,
    recordings: Recordings,
    settings: IdentifySettings,
) -> str | None:
    """What has to be said of a constant D that was given, where the recordings speak for another."""
    if source != DiffusionSource.GIVEN or noise.kind != "process" or not found.diffusion.constant:
        return None
    pairs = snapshot_pairs(recordings, pair_step=settings.sampling.pair_step)
    probability = constant_noise_probability(found, pairs, residuals(found, pairs))
    if probability >= settings.identification.false_terms:
        return None
    return UNLIKE_GIVEN


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
        float(
            fitted.diffusion.squared_speed(
                pairs.x0, residuals(fitted, pairs) / np.sqrt(pairs.h)[:, None]
            ).mean()
        )
        if not fitted.diffusion.constant
        else float((residuals(fitted, pairs) ** 2 / pairs.h[:, None]).mean())
        for pairs in (unseen, training)
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
