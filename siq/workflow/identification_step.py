"""The step that identifies f and checks its prediction of held-out recordings."""

from __future__ import annotations

from dataclasses import dataclass as plain_dataclass
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from pydantic.dataclasses import dataclass

from siq.data.correlation import MarkovLag, markov_lag
from siq.data.preparation import joined
from siq.data.recordings import (
    Recordings,
    SnapshotPairs,
    held_out_recordings,
    select_recordings,
    snapshot_pairs,
)
from siq.errors import NumericalFailure
from siq.inference.diffusion_model import constant_noise_probability, with_random_forces
from siq.inference.field_estimate import (
    UNLIKE_GIVEN,
    DiffusionSource,
    IdentifiedField,
    check_units,
    constant_noise,
    estimated_diffusion,
)
from siq.inference.flow_regression import fit_weighted, refit, residuals, with_given_noise, with_noise_formula
from siq.inference.hidden_velocities import HiddenMotion, identify_hidden_motion, inertia_test, seen_inertia
from siq.inference.identification import (
    FieldRecord,
    IdentificationOptions,
    carries_noise,
    field_library,
    identify_vector_field,
    with_stability,
)
from siq.inference.instrumental_variables import (
    identify_from_earlier,
    lagged_noise,
    lagged_pairs,
    lagged_parts,
    lost_time,
    mean_probability_from_earlier,
    possible_exposures,
    refit_from_earlier,
    residuals_from_earlier,
)
from siq.inference.kalman_filter import Noise
from siq.inference.library import CandidateLibrary, check_origin
from siq.inference.noisy_sensor import (
    HARMLESS,
    FilteredField,
    evidence,
    filtered_recordings,
    held_out_evidence,
    identify_by_likelihood,
    is_rounding,
    moved_by,
    rounding_bias,
    rounding_errors,
    rounding_text,
)
from siq.inference.observation import View, velocity_names
from siq.inference.residuals import (
    LARGE,
    SIGNIFICANT,
    NoiseDiagnosis,
    mean_residual_probability,
    prediction_errors,
    residual_noise,
    shared_errors,
)
from siq.numerics.randomness import Purpose, generator
from siq.quasipotential.certificate_tests import PredictionLimits, Verdict, check_prediction
from siq.systems.diffusion import Diffusion
from siq.workflow.study import STRICT, Sampling, StateSpace
from siq.workflow.tables import Outcome, Status, Step

SUSPECT = -1.0  # standard errors of the correlation of neighbouring residuals
FROM_ABOVE = 0.1  # of what means move by: a search finds its way down to no sensor noise, but not up from it
LEAST, MOST = 1e-3, 0.45  # of the residuals' variance: a sensor's share of it that a fit begins with


def beside_sensor_noise(
    found: IdentifiedField,
    recordings: Recordings,
    *,
    options: IdentificationOptions,
    pair_step: float | None,
    generator: np.random.Generator,
) -> FilteredField | None:
    """F by the likelihood of whole recordings, where their sensors are noisy; None where they are not.

    What could be sensor noise is asked of the likelihood from one standard error on: it would bias f long
    before it is significant.

    Parameters
    ----------
    found
        f of the regression of pairs.
    recordings
        Whole trajectories.
    options
        What makes a term significant.
    pair_step
        Longest time between samples that still belong together.
    generator
        Draws recordings again, for the stability of the terms.

    Raises
    ------
    NumericalFailure
        Where much sensor noise is seen and the likelihood leads to no f.
    """
    correlation, score = shared_errors(found, recordings, pair_step=pair_step)
    if not (score < SUSPECT).any():
        return None
    pairs = snapshot_pairs(recordings, pair_step=pair_step)
    if _harmless_rounding(found, recordings, pairs, correlation):
        return None
    much = bool(((score < -SIGNIFICANT) & (correlation < -LARGE)).any())
    share = np.clip(-correlation, LEAST, MOST)
    variance = np.diag(found.noise_rate) * float(np.median(pairs.h))
    start = Noise(share * variance, np.diag(found.noise_rate) * (1 - 2 * share))
    try:
        filtered = identify_by_likelihood(
            found.library, recordings, found.diffusion, start, pair_step=pair_step, generator=generator,
            false_terms=options.false_terms,
        )  # fmt: skip
    except (NumericalFailure, np.linalg.LinAlgError) as error:
        if much:
            raise NumericalFailure(f"the sensor is noisy, and f beside it is not found: {error}") from None
        return None
    return filtered if filtered.gain > 1 else None


def means_over_exposures(
    recordings: Recordings,
    exposure: float,
    *,
    library: CandidateLibrary,
    options: IdentificationOptions,
    pair_step: float | None,
    generator: np.random.Generator,
) -> FilteredField | None:
    """F by the likelihood of samples that are means over an exposure; None where they are no such means.

    They are such means if nothing is left in the innovations that neighbours share. The arguments are those
    of `beside_sensor_noise`, with the exposure, and the candidate functions.
    """
    identity = Diffusion.identity(library.dimension)
    try:
        moved, step = moved_by(View(library, identity, exposure).measured(recordings, pair_step))
        start = Noise(FROM_ABOVE * moved, moved / step)
        filtered = identify_by_likelihood(
            library, recordings, identity, start, pair_step=pair_step,
            false_terms=options.false_terms, generator=generator, exposure=exposure,
        )  # fmt: skip
    except (NumericalFailure, np.linalg.LinAlgError):
        return None
    remembers = abs(filtered.score) > SIGNIFICANT and abs(filtered.correlation) > LARGE
    return None if remembers or not filtered.found.noise_rate.any() else filtered


def filtered_record(
    filtered: FilteredField,
    recordings: Recordings,
    parts: tuple[Recordings, Recordings],
    *,
    sampling: Sampling,
    space: StateSpace,
    limits: PredictionLimits,
) -> FieldRecord:
    """What is kept of an f that was identified beside sensor noise.

    Parameters
    ----------
    filtered, recordings
        What was found, of which recordings.
    parts
        Those that train, and those that are held out.
    sampling, space, limits
        Of the step `identify`.
    """
    step = sampling.pair_step
    pairs = len(snapshot_pairs(recordings, pair_step=step).h)
    given = space.noise(recordings.names)
    estimated = None
    if given is None and filtered.found.noise is not None:
        estimated = filtered.found.diffusion
    elif given is None and filtered.found.noise_rate.any():
        estimated = estimated_diffusion(filtered.found, pairs=pairs)
    source = DiffusionSource.GIVEN if given is not None else DiffusionSource.ESTIMATED
    if given is None and estimated is None:
        source = DiffusionSource.UNIT
        check_units(recordings.names, units_of_states(recordings, space))
    diffusion = given or estimated or filtered.found.diffusion
    found = replace(filtered.found, diffusion=diffusion)
    if estimated is None:
        found = replace(found, noise=None, constant_noise=None)
    intensity = (
        found.intensity if found.noise is not None else _strength(filtered, diffusion, recordings, step)
    )
    probability, ratio = held_out_evidence(filtered, *parts, pair_step=step)
    forced = bool(found.noise_rate.any())
    error = intensity * filtered.intensity_error
    coloured = abs(filtered.score) > SIGNIFICANT and abs(filtered.correlation) > LARGE
    verdict = check_prediction(
        noise_fault=(
            f"the innovations of neighbouring samples are correlated ({filtered.correlation:.2f}) though"
            " noise of the sensor is allowed for: the random forces have a memory, or a state is missing;"
            " record that state, or keep every few samples only"
        )
        if coloured else None,
        errors=None, mean_probability=probability, held_out_ratio=ratio, limits=limits,
    )  # fmt: skip
    sizes = np.sqrt(filtered.sensor)
    said = ", ".join(f"{size:.2g} in {name}" for size, name in zip(sizes, recordings.titles, strict=True))
    notes = [f"the noise of the sensor, {said}, was estimated beside f and is allowed for"]
    if filtered.exposure is not None:
        unit = f" {recordings.time_unit}" if recordings.time_unit else ""
        every = View(found.library, diffusion, filtered.exposure).every(recordings)
        notes.append(f"each sample was taken as the mean over the {filtered.exposure:.3g}{unit} before it")
        if every > 1:
            notes.append(f"of {every} samples one was used, so that exposures do not overlap")
    if filtered.found.noise is not None and given is not None and given.constant:
        notes.append(UNLIKE_GIVEN)
    return FieldRecord(
        found,
        verdict.as_data(),
        {
            "kind": "coloured" if coloured else "process" if forced else "sensor",
            "intensity": intensity,
            "intensity_error": error if np.isfinite(error) else None,
            "covariance": (found.noise_rate / intensity if forced else np.eye(len(sizes))).tolist(),
            "correlation": filtered.correlation,
            "correlation_score": filtered.score,
            "measurement": sizes.tolist(),
            "measurement_error": (sizes * filtered.sensor_error / 2).tolist(),
            "diffusion": str(source),
            "exposure": filtered.exposure,
            "note": "; ".join(notes),
            "pairs": pairs,
        },
    )


def _strength(
    filtered: FilteredField, diffusion: Diffusion, recordings: Recordings, pair_step: float | None
) -> float:
    """ε of a D that is not the one that was found: the mean of ``tr D⁻¹(x) εD(x) / d`` over the states."""
    found = filtered.found
    if diffusion.constant:
        return diffusion.intensity(found.noise_rate)
    states = filtered_recordings(
        found, filtered.sensor, recordings, pair_step=pair_step, exposure=filtered.exposure
    ).values
    forces = found.noise_rate if found.noise is None else found.noise.diffusion(1.0).at(states)
    products = diffusion.precision_at(states) * forces
    return float(products.sum(axis=(1, 2)).mean() / states.shape[1])


def units_of_states(recordings: Recordings, space: StateSpace) -> list[str | None]:
    """The unit of each state, None where nobody said."""
    named = zip(recordings.names, recordings.units, strict=True)
    return [unit or space.unit(name) or None for name, unit in named]


def _harmless_rounding(
    found: IdentifiedField, recordings: Recordings, pairs: SnapshotPairs, correlation: np.ndarray
) -> bool:
    """Whether the noise of the sensor is that of rounding, and too little to bias f."""
    rounding = rounding_errors(recordings)
    size = np.diag(found.noise_rate) * float(np.median(pairs.h))
    measured = np.sqrt(np.maximum(-correlation, 0.0) * size)
    if not is_rounding(measured, rounding, correlation=float(correlation.min())):
        return False
    return rounding_bias(found, pairs, rounding) <= HARMLESS


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


def hidden_record(
    recordings: Recordings,
    *,
    seed: int,
    number: int,
    space: StateSpace,
    sampling: Sampling,
    options: IdentificationOptions,
    limits: PredictionLimits,
) -> FieldRecord:
    """f(x, v), D and both noises of recordings of positions, with the test on held-out recordings.

    Parameters
    ----------
    recordings
        Of positions.
    seed, number
        Of the study, and the run.
    space, sampling, options, limits
        Of the step `identify`.

    Raises
    ------
    NumericalFailure
        Where nothing is found, and where D is given: it would be that of positions, which no noise drives.
    """
    if space.diffusion is not None:
        raise NumericalFailure(
            "D is given for the positions, and noise drives the hidden velocities; leave the diffusion out,"
            " it is found"
        )
    library = field_library((*recordings.names, *velocity_names(recordings.names)), options)
    motion = identify_hidden_motion(
        library, recordings, false_terms=options.false_terms, pair_step=sampling.pair_step,
        generator=generator(seed, number, Purpose.STABILITY),
    )  # fmt: skip
    held = held_out_recordings(recordings, generator=generator(seed, number, Purpose.HOLD_OUT))
    parts = [select_recordings(recordings, np.flatnonzero(chosen)) for chosen in (~held, held)]
    view = View(library, motion.found.diffusion, None, hidden=True)
    probability, ratio = evidence(
        view, motion.found, motion.sensor, parts[0], parts[1], pair_step=sampling.pair_step
    )
    fault = _fault(motion)
    verdict = check_prediction(
        noise_fault=fault, errors=None, mean_probability=probability, held_out_ratio=ratio, limits=limits
    )
    sizes = np.sqrt(motion.sensor)
    forced = motion.intensity > 0
    if not forced and len({unit for unit in units_of_states(recordings, space) if unit}) > 1:
        raise NumericalFailure(
            "no random forces are seen that would show D, and the positions have different units, so that no"
            " unit matrix can stand for it; scale them to one unit"
        )
    error = motion.intensity * motion.intensity_error
    said = ", ".join(f"{size:.2g} in {name}" for size, name in zip(sizes, recordings.titles, strict=True))
    noises = "the forces' noise and that" if forced else "and the noise"
    return FieldRecord(
        motion.found,
        verdict.as_data(),
        {
            "kind": "coloured" if fault is not None else "process" if forced else "sensor",
            "intensity": motion.intensity,
            "intensity_error": error if np.isfinite(error) else None,
            "covariance": motion.found.diffusion.matrix.tolist(),
            "correlation": motion.correlation,
            "correlation_score": motion.score,
            "measurement": sizes.tolist(),
            "measurement_error": (sizes * motion.sensor_error / 2).tolist(),
            "diffusion": str(DiffusionSource.OF_VELOCITIES if forced else DiffusionSource.UNIT_OF_VELOCITIES),
            "note": f"velocities were not recorded: f, {noises} of the sensor, {said}, are by the likelihood"
            " of positions alone",
            "pairs": len(snapshot_pairs(recordings, pair_step=sampling.pair_step).h),
        },
    )


def _fault(motion: HiddenMotion) -> str | None:
    """What speaks against a particle that white noise drives."""
    if abs(motion.score) <= SIGNIFICANT or abs(motion.correlation) <= LARGE:
        return None
    return (
        f"the innovations of neighbouring samples are correlated ({motion.correlation:.2f}) though velocities"
        " and noise of the sensor are allowed for: the random forces have a memory, or a further state is"
        " missing"
    )


def with_inertia_asked(
    record: FieldRecord, recordings: Recordings, *, pair_step: float | None
) -> FieldRecord:
    """The f of a position alone, refused where its recordings remember since it has inertia."""
    if record.memory is None and record.prediction["passed"]:
        return record
    advice = advice_on_inertia(recordings, pair_step=pair_step)
    if advice is None:
        return record
    reasons = [str(record.prediction["reason"]), advice]
    verdict = {
        **record.prediction,
        "passed": False,
        "reason": "; ".join(one for one in reasons if one),
    }
    return replace(record, prediction=verdict)


def advice_on_inertia(recordings: Recordings, *, pair_step: float | None) -> str | None:
    """What to do where a recorded position has inertia; None where that is not seen, or slight.

    Asked where f of the position alone has failed, or remembers.
    """
    if len(recordings.names) != 1:
        return None
    try:
        test = seen_inertia(recordings, pair_step=pair_step)
    except (NumericalFailure, np.linalg.LinAlgError):
        return None
    if test is None or not test.needs_velocity:
        return None
    return (
        f"{test.sentence(recordings.time_unit or '')}: set 'identification.hidden_velocities: true', in"
        " Python hidden_velocities=True, and the velocity is a state that was not recorded"
    )


def advice_on_velocities(recordings: Recordings, *, pair_step: float | None) -> str | None:
    """What to do where f(x, v) was not found of a position that shows no inertia, or a slight one.

    None where inertia is seen, and the velocity is needed.
    """
    if len(recordings.names) != 1:
        return None
    try:
        test = inertia_test(recordings, pair_step=pair_step)
    except (NumericalFailure, np.linalg.LinAlgError):
        return None
    if test.needs_velocity:
        return None
    said = test.sentence(recordings.time_unit or "")
    if test.undecided:
        return said
    return f"{said}: leave 'identification.hidden_velocities' out, the position alone is the state"


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

    def files(self) -> dict[str, Any]:
        """By the names of the rule."""
        return {"field": self.record, "identify_outcome": [self.outcome]}


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
    found, noise, source = _with_diffusion_identify(
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


def _with_diffusion_identify(
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
